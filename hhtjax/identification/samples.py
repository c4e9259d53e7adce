"""Residuals of every sample less every other: (n, 1) less (n,) is (n, n) to NumPy, which is never meant in a fit."""

import jax
import jax.numpy as jnp

from hhtjax.description import freeze, thaw


def require_own_samples(caller, residuals, shapes, *args):
    """An error where a leaf of residuals(*args) is (n, n), made by promoting a rank, and of no data of that size.

    Nothing is traced unless a leaf is (n, n). What is written on purpose is let through: an outer sum whose two ranks
    are written out, and one from which measurements (n, n) are taken.
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
                f"of arrays ({n}, 1) and ({n},), each sample of one less all of the other. Give both the same shape: "
                "`run.q[:, 0] - y`."
            )


def _promotes_ranks(residuals, args):
    """Whether JAX has to, somewhere."""
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
    """Along which axes a matrix varies that elementwise operations make of vectors; both twice, {0, 1, 2}, where
    anything else, such as a matrix of measurements, is in it."""
    # a number in a program has `val`, and no maker
    other, shape = {0, 1, 2}, y.aval.shape
    if hasattr(y, "val") or min(shape, default=1) == 1:
        return {i for i, size in enumerate(shape) if size > 1}
    maker = makers.get(y)
    if maker is not None and "jaxpr" in maker.params and maker.primitive.name in ("pjit", "jit"):
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
