"""What the residuals of a fit return, checked, and the weights of it."""

import math

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.description import freeze, is_array, is_concrete, thaw
from hhtjax.identification.arguments import check_real, require_prefix
from hhtjax.identification.progress import NO_SLOPE


def check_residuals(caller, residuals, p, *args):
    """The shapes and dtypes of residuals(*args), if they are good for p parameters."""

    def real(*args):
        result = residuals(*args)
        for path, leaf in jax.tree_util.tree_leaves_with_path(result):
            if not (is_array(leaf) or isinstance(leaf, (int, float))):
                where = f" at {jax.tree_util.keystr(path)}" if path else ""
                raise TypeError(f"{caller}: `residuals` must return real arrays; received {leaf!r}{where}.")
        return result

    try:
        shapes = jax.eval_shape(lambda *args: real(*thaw(args)), *freeze(args))
    except (jax.errors.TracerArrayConversionError, jax.errors.ConcretizationTypeError) as error:
        raise TypeError(
            f"{caller}: `residuals` must be traceable by JAX, with jax.numpy in place of NumPy, float() and `if` "
            f"wherever params come in; received {residuals!r}, whose error stands above."
        ) from error
    leaves = jax.tree.leaves(shapes)
    for leaf in leaves:
        if not jnp.issubdtype(leaf.dtype, jnp.floating):
            raise TypeError(f"{caller}: `residuals` must return real floats; received {leaf.dtype}.")
    m = sum(math.prod(x.shape) for x in leaves)
    if m < p:
        raise ValueError(
            f"{caller}: `residuals` must return at least as many numbers as there are parameters, {p}; received {m}."
        )
    return shapes


def spread_weights(caller, weights, shapes, name="weights"):
    """The weight of every entry of the raveled residuals; name: of the argument."""

    def spread(weight, branch):
        weight = jnp.asarray(weight)

        def one(leaf):
            if weight.shape != leaf.shape[: weight.ndim]:
                raise ValueError(
                    f"{caller}: `{name}` must have the leading axes of their residuals, {leaf.shape}; "
                    f"received {weight.shape}."
                )
            return jnp.broadcast_to(weight.reshape(weight.shape + (1,) * (leaf.ndim - weight.ndim)), leaf.shape)

        return jax.tree.map(lambda leaf: one(leaf).astype(leaf.dtype), branch)

    require_prefix(caller, name, weights, shapes, "what `residuals` return")
    return jax.tree.leaves(jax.tree.map(spread, weights, shapes))


def check_weights(caller, weights):
    """Finite numbers, or Booleans: True to keep, False for a missing sample."""
    if weights is None:
        raise TypeError(f"{caller}: `weights` must be a number, an array or a pytree of them; received None.")
    for path, leaf in jax.tree_util.tree_leaves_with_path(weights):
        where = f"{caller}: `weights{jax.tree_util.keystr(path)}`"
        if not isinstance(leaf, bool) and np.dtype(getattr(leaf, "dtype", float)).kind != "b":
            check_real(where, leaf)
            if is_concrete(leaf) and np.any(np.asarray(leaf) < 0):
                raise ValueError(f"{where} must not be negative; received {np.min(leaf)}.")


def first_bad(residual, weights, of_records=False):
    """Words for what a sum of squares cannot have: entries not finite and not declared missing, or too large."""
    present = spread_weights("fit", weights, residual)
    values = [
        (path, np.where(np.asarray(w) == 0, 0, np.asarray(leaf)))
        for (path, leaf), w in zip(jax.tree_util.tree_leaves_with_path(residual), present, strict=True)
    ]
    total = sum(x.size for _, x in values)
    bad = sum(int(np.sum(~np.isfinite(x))) for _, x in values)
    for path, x in values:
        if not np.all(np.isfinite(x)):
            index = tuple(int(i) for i in np.argwhere(~np.isfinite(x))[0])
            missing = "" if weights is not True else "; give missing samples the weight False"
            where = f"residuals{jax.tree_util.keystr(path)}{list(index)}"
            if of_records:
                where += f", record {index[0]}" + (f", sample {index[1]}" if len(index) > 1 else "")
            return f"{x[index]} at {where} ({bad} of {total} entries){missing}"
    with np.errstate(over="ignore"):
        squares = sum(np.sum(x**2) for _, x in values)
    if not np.isfinite(squares):
        largest = max(np.max(np.abs(x)) for _, x in values if x.size)
        return f"values up to {largest:.3g}, whose squares overflow; take other units"
    return NO_SLOPE
