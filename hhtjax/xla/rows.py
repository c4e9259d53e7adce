"""A row written into an array, each member of a batch its own: part of a kernel, where a scatter would be none."""

import math
from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir


def row_written(array, row, number):
    """The array (K, ...) with the row (...) in the place of that of a number, 0 to K - 1.

    In place, if nothing else needs the old array. Of `lax.dynamic_update_index_in_dim` vmap makes a scatter, even for
    one number that all members share.

    Args:
        array: (K, ...).
        row: (...).
        number: an integer scalar.

    Returns:
        An array like the one given.

    Raises:
        TypeError: shapes or types do not fit.

    >>> print(jax.vmap(row_written)(jnp.zeros((2, 3)), jnp.array([1.0, 2.0]), jnp.array([0, 2])))
    [[1. 0. 0.]
     [0. 0. 2.]]
    """
    if row.shape != array.shape[1:] or row.dtype != array.dtype:
        raise TypeError(f"row_written: a row like those of {array.shape} is needed; received {row.shape}, {row.dtype}.")
    return write_p.bind(array, row, number, axis=0)


def _written(array, row, number, *, axis):
    """Along an axis; those before are of members, with one number for all or one for each."""
    if not number.ndim:
        return lax.dynamic_update_index_in_dim(array, row, number, axis)
    members, shape = math.prod(number.shape), array.shape[axis:]
    row, number = row.reshape(members, 1, 1, *shape[1:]), number.reshape(members)

    def write(i, array):
        one = lax.dynamic_index_in_dim(row, i, keepdims=False)
        here = lax.dynamic_index_in_dim(number, i, keepdims=False)
        at = i.astype(number.dtype), here, *[jnp.zeros_like(here)] * (len(shape) - 1)
        return lax.dynamic_update_slice(array, one, at)

    return lax.fori_loop(0, members, write, array.reshape(members, *shape)).reshape(array.shape)


def _of_members(f, array, *others):
    """f(array, *others) of each member; the last of the others are numbers, one for each."""
    for _ in others[-1].shape:
        f = jax.vmap(f)
    return f(array, *others)


def _scattered(array, row, number, *, axis):
    """The same where many threads write at once."""
    return _of_members(partial(lax.dynamic_update_index_in_dim, axis=axis - number.ndim), array, row, number)


def _read(array, number, axis):
    """The rows of these numbers."""
    one = partial(lax.dynamic_index_in_dim, axis=axis - number.ndim, keepdims=False)
    return _of_members(one, array, number)


def _shape(array, row, number, *, axis):
    return ShapedArray(array.shape, array.dtype)


def _jvp(args, dots, *, axis):
    """Linear in the array and the row."""
    moves = map(ad.instantiate_zeros, dots[:2])
    return write_p.bind(*args, axis=axis), write_p.bind(*moves, args[2], axis=axis)


def _transpose(cotangent, array, row, number, *, axis):
    like = row.aval if ad.is_undefined_primal(row) else row
    if type(cotangent) is ad.Zero:
        return [ad.Zero(x.aval) if ad.is_undefined_primal(x) else None for x in (array, row, number)]
    to_array = write_p.bind(cotangent, jnp.zeros(like.shape, like.dtype), number, axis=axis)
    to_row = _read(cotangent, number, axis)
    return [x if ad.is_undefined_primal(y) else None for x, y in ((to_array, array), (to_row, row))] + [None]


def _batch(args, axes, *, axis):
    size = next(x.shape[a] for x, a in zip(args, axes, strict=True) if a is not None)
    array, row, number = (
        jnp.broadcast_to(x, (size, *jnp.shape(x))) if a is None else jnp.moveaxis(x, a, 0)
        for x, a in zip(args, axes, strict=True)
    )
    if axes[2] is None and not jnp.ndim(args[2]):
        number = args[2]
    elif number.ndim <= axis:  # shared by members of other batches
        number = jnp.broadcast_to(number.reshape(size, *[1] * axis), array.shape[: axis + 1])
    return write_p.bind(array, row, number, axis=axis + 1), 0


write_p = Primitive("hhtjax_row_written")
write_p.def_impl(_written)
write_p.def_abstract_eval(_shape)
batching.primitive_batchers[write_p] = _batch
ad.primitive_jvps[write_p] = _jvp
ad.primitive_transposes[write_p] = _transpose
mlir.register_lowering(write_p, mlir.lower_fun(_scattered, multiple_results=False))
mlir.register_lowering(write_p, mlir.lower_fun(_written, multiple_results=False), platform="cpu")
