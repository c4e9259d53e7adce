"""A row written into an array, each member of a batch its own: part of a kernel, where a scatter would be none."""

import math
from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from hhtjax.xla.transforms import batch_size, in_front


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
    return write_p.bind(array, row[None], number, members=0, axis=0)


def block_written(array, block, number, axis=0):
    """The array with a block in the place of what stands there along an axis from a number on; as `row_written`.

    Args:
        array: of any shape.
        block: of the same, but for its length along the axis.
        number: an integer scalar; a block that would stand out is put at the end.
        axis: one of the array's.

    Returns:
        An array like the one given.

    Raises:
        TypeError: shapes or types do not fit.

    >>> print(block_written(jnp.zeros((2, 4)), jnp.ones((2, 2)), jnp.array(1), axis=1))
    [[0. 1. 1. 0.]
     [0. 1. 1. 0.]]
    """
    length = block.shape[axis] if block.ndim == array.ndim else 0
    if (*array.shape[:axis], length, *array.shape[axis + 1 :]) != block.shape or block.dtype != array.dtype:
        raise TypeError(
            f"block_written: a part of {array.shape} along axis {axis} is needed; "
            f"received {block.shape}, {block.dtype}."
        )
    return write_p.bind(array, block, number, members=0, axis=axis)


def written(array, block, number, *, members, axis):
    """Along an axis of a member's; so many axes before are of members, with one number for all or one for each."""
    if not number.ndim:
        return lax.dynamic_update_slice_in_dim(array, block, number, members + axis)
    count, shape = math.prod(number.shape), array.shape[members:]
    block, number = block.reshape(count, *block.shape[members:]), number.reshape(count)

    def write(i, array):
        one = lax.dynamic_index_in_dim(block, i)
        here = lax.dynamic_index_in_dim(number, i, keepdims=False)
        return lax.dynamic_update_slice(array, one, place(i, here, len(shape), axis))

    return lax.fori_loop(0, count, write, array.reshape(count, *shape)).reshape(array.shape)


def place(member, number, axes, axis):
    """Where a member's block starts, that has so many axes."""
    start = [jnp.zeros_like(number)] * axes
    start[axis] = number
    return [member.astype(number.dtype), *start]


def _of_members(f, array, *others):
    """f(array, *others) of each member; the last of the others are numbers, one for each."""
    for _ in others[-1].shape:
        f = jax.vmap(f)
    return f(array, *others)


def _scattered(array, block, number, *, members, axis):
    """The same where many threads write at once."""
    one = partial(lax.dynamic_update_slice_in_dim, axis=members + axis - number.ndim)
    return _of_members(one, array, block, number)


def _shape(array, block, number, *, members, axis):
    return ShapedArray(array.shape, array.dtype)


def _jvp(args, dots, **params):
    """Linear in the array and the block."""
    moves = map(ad.instantiate_zeros, dots[:2])
    return write_p.bind(*args, **params), write_p.bind(*moves, args[2], **params)


def _transpose(cotangent, array, block, number, *, members, axis):
    like = block.aval if ad.is_undefined_primal(block) else block
    if type(cotangent) is ad.Zero:
        return [ad.Zero(x.aval) if ad.is_undefined_primal(x) else None for x in (array, block, number)]
    to_array = write_p.bind(cotangent, jnp.zeros(like.shape, like.dtype), number, members=members, axis=axis)
    length, along = like.shape[members + axis], members + axis - number.ndim
    to_block = _of_members(lambda x, n: lax.dynamic_slice_in_dim(x, n, length, along), cotangent, number)
    return [x if ad.is_undefined_primal(y) else None for x, y in ((to_array, array), (to_block, block))] + [None]


def _batch(args, axes, *, members, axis):
    size = batch_size(args, axes)
    array, block, number = (in_front(x, a, size) for x, a in zip(args, axes, strict=True))
    if axes[2] is None and not jnp.ndim(args[2]):
        number = args[2]
    elif number.ndim <= members:  # shared by members of other batches
        number = jnp.broadcast_to(number.reshape(size, *[1] * members), array.shape[: members + 1])
    return write_p.bind(array, block, number, members=members + 1, axis=axis), 0


write_p = Primitive("hhtjax_row_written")
write_p.def_impl(written)
write_p.def_abstract_eval(_shape)
batching.primitive_batchers[write_p] = _batch
ad.primitive_jvps[write_p] = _jvp
ad.primitive_transposes[write_p] = _transpose
mlir.register_lowering(write_p, mlir.lower_fun(_scattered, multiple_results=False))
mlir.register_lowering(write_p, mlir.lower_fun(written, multiple_results=False), platform="cpu")
