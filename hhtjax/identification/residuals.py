"""Checks of the residuals of a fit, and of their weights."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.description import Array, PyTree, Real, freeze, is_array, is_concrete, thaw
from hhtjax.identification.arguments import check_real, require_prefix
from hhtjax.identification.least_squares import NO_SLOPE

if TYPE_CHECKING:
    from hhtjax.description.current import Reading


def check_residuals(caller: str, residuals: Callable | Reading, p: int, *args: PyTree) -> PyTree:
    """The shapes and dtypes of residuals(*args), after a check that they can determine p parameters."""

    def real(*args: PyTree) -> PyTree:
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
            f"{caller}: `residuals` must be traceable by JAX: use jax.numpy instead of NumPy, float() and `if` for all "
            "that depends on params, and arrays instead of columns of pandas (`x.to_numpy()`); received "
            f"{residuals!r}, whose error stands above."
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


def spread_weights(caller: str, weights: Real, shapes, name: str = "weights"):
    """The weight of every entry of the raveled residuals; name: of the argument."""

    def spread(weight: Real, branch) -> Array:
        weight = jnp.asarray(weight)

        def one(leaf) -> Array:
            if weight.shape != leaf.shape[: weight.ndim]:
                raise ValueError(
                    f"{caller}: `{name}` must have the leading axes of their residuals, {leaf.shape}; "
                    f"received {weight.shape}."
                )
            return jnp.broadcast_to(weight.reshape(weight.shape + (1,) * (leaf.ndim - weight.ndim)), leaf.shape)

        return jax.tree.map(lambda leaf: one(leaf).astype(leaf.dtype), branch)

    require_prefix(caller, name, weights, shapes, "what `residuals` return")
    return jax.tree.leaves(jax.tree.map(spread, weights, shapes))


def check_weights(caller: str, weights: PyTree):
    """Raises an error unless the weights are finite numbers or Booleans (False: a missing sample)."""
    if weights is None:
        raise TypeError(f"{caller}: `weights` must be a number, an array or a pytree of them; received None.")
    for path, leaf in jax.tree_util.tree_leaves_with_path(weights):
        where = f"{caller}: `weights{jax.tree_util.keystr(path)}`"
        if not isinstance(leaf, bool) and np.dtype(getattr(leaf, "dtype", float)).kind != "b":
            check_real(where, leaf)
            if is_concrete(leaf) and np.any(np.asarray(leaf) < 0):
                raise ValueError(f"{where} must not be negative; received {np.min(leaf)}.")


def first_bad(residual, weights, of_records=False):
    """Describes the first residual that makes the cost infinite or NaN: not finite and not missing, or too large."""
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


# ----------------------------------------------------------------------------
# A frequent mistake: (n, 1) minus (n,) broadcasts to (n, n), every sample minus every other. A fit never means this.


def require_own_samples(caller: str, residuals: Callable | Reading, shapes: PyTree, *args: PyTree):
    """Raises an error if a leaf of residuals(*args) is (n, n) only because ranks were promoted.

    Nothing is traced unless a leaf is (n, n). Two cases are taken as intended: an outer sum whose axes are written out,
    and one from which measurements of shape (n, n) are subtracted.
    """
    leaves = jax.tree_util.tree_leaves_with_path(shapes)
    square = [i for i, (_, leaf) in enumerate(leaves) if leaf.ndim == 2 and leaf.shape[0] == leaf.shape[1] > 1]
    if not square or not _promotes_ranks(residuals, args):
        return
    jaxpr = jax.make_jaxpr(lambda *args: residuals(*thaw(args)))(*freeze(args)).jaxpr
    makers = _makers(jaxpr)
    for i in square:
        path, leaf = leaves[i]
        if _spread(jaxpr.outvars[i], makers) == {0, 1}:
            n, where = leaf.shape[0], jax.tree_util.keystr(path)
            raise ValueError(
                f"{caller}: `residuals` must be one for each sample; received {leaf.shape}{where and f' at {where}'}, "
                f"from arrays ({n}, 1) and ({n},): every sample of one minus every sample of the other. Give both the "
                "same shape: `run.q[:, 0] - y`."
            )


def _promotes_ranks(residuals, args):
    """Whether JAX promotes a rank anywhere in residuals(*args)."""
    try:
        with jax.numpy_rank_promotion("raise"):
            jax.eval_shape(lambda *args: residuals(*thaw(args)), *freeze(args))
    except ValueError as error:
        return "rank_promotion" in str(error)
    return False


def _makers(jaxpr):
    """The equation of each variable."""
    return {y: equation for equation in jaxpr.eqns for y in equation.outvars}


def _spread(y, makers) -> set:
    """The axes along which a matrix varies if it is made of vectors by elementwise operations.

    The result is {0, 1, 2} if anything else, such as a matrix of measurements, enters it.
    """
    # a number in a program has `val`, and no maker
    other, shape = {0, 1, 2}, y.aval.shape
    if hasattr(y, "val") or min(shape, default=1) == 1:
        return {i for i, size in enumerate(shape) if size > 1}
    maker = makers.get(y)
    if maker is not None and maker.primitive.name == "jit":
        inner = maker.params["jaxpr"].jaxpr
        return _spread(inner.outvars[maker.outvars.index(y)], _makers(inner))
    if maker is None or len(maker.outvars) > 1 or not maker.invars:
        return other
    if maker.primitive.name == "broadcast_in_dim":
        source, dimensions = maker.invars[0], maker.params["broadcast_dimensions"]
        return {to for size, to in zip(source.aval.shape, dimensions, strict=True) if size > 1}
    if not all(jnp.ndim(x.aval) in (0, len(shape)) for x in maker.invars):
        return other
    return set().union(*(_spread(x, makers) for x in maker.invars))
