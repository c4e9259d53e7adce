"""Operations on single members of a batch inside a kernel: writing a row, and evaluating members one by one."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.core import ShapedArray, eval_jaxpr
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jax.interpreters import partial_eval as pe

from hhtjax.description import Array, PyTree, Real
from hhtjax.primitives.compat import is_on
from hhtjax.primitives.interpreter import alone, evaluate, holds_jaxprs
from hhtjax.primitives.two_mode_derivative import batch_size, in_front, no_tangent

if TYPE_CHECKING:
    from jax.extend.core import ClosedJaxpr, JaxprEqn


def row_written(array: Array, row: Array, number: Array) -> Array:
    """The array (K, ...) with one row replaced by `row` (...).

    The array is changed in place if nothing else needs the old one. Under vmap `lax.dynamic_update_index_in_dim`
    becomes a scatter, even if all members share the number. This function does not, so it can be part of a kernel.

    Args:
        array: (K, ...).
        row: (...).
        number: index of the row, 0 to K - 1, an integer scalar.

    Returns:
        An array like the one given.

    Raises:
        TypeError: shapes or types do not match.

    >>> print(jax.vmap(row_written)(jnp.zeros((2, 3)), jnp.array([1.0, 2.0]), jnp.array([0, 2])))
    [[1. 0. 0.]
     [0. 0. 2.]]
    """
    if row.shape != array.shape[1:] or row.dtype != array.dtype:
        raise TypeError(f"row_written: a row like those of {array.shape} is needed; received {row.shape}, {row.dtype}.")
    return write_p.bind(array, row[None], number, members=0, axis=0)


def block_written(array: Array, block: Array, number: Array, axis: int = 0) -> Array:
    """The array with a part along an axis replaced by `block`; otherwise as `row_written`.

    Args:
        array: an array of any shape.
        block: an array of the same shape, except for its length along the axis.
        number: index along the axis at which the block begins, an integer scalar. A block that would exceed the array
            is moved to its end.
        axis: an axis of the array.

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


def written(array: Array, block: Array, number: Array, *, members: int, axis: int) -> Array:
    """Along an axis of a member's; so many axes before are of members, with one number for all or one for each."""
    if not number.ndim:
        return lax.dynamic_update_slice_in_dim(array, block, number, members + axis)
    count, shape = math.prod(number.shape), array.shape[members:]
    block, number = block.reshape(count, *block.shape[members:]), number.reshape(count)

    def write(i: Array, array: Array) -> Array:
        one = lax.dynamic_index_in_dim(block, i)
        here = lax.dynamic_index_in_dim(number, i, keepdims=False)
        return lax.dynamic_update_slice(array, one, place(i, here, len(shape), axis))

    return lax.fori_loop(0, count, write, array.reshape(count, *shape)).reshape(array.shape)


def place(member: Array, number: Array, axes: int, axis: int):
    """Where a member's block starts, that has so many axes."""
    start = [jnp.zeros_like(number)] * axes
    start[axis] = number
    return [member.astype(number.dtype), *start]


def _of_members(f: Callable, array: Array, *others: Array) -> Array:
    """f(array, *others) of each member; the last of the others are numbers, one for each."""
    for _ in others[-1].shape:
        f = jax.vmap(f)
    return f(array, *others)


def _scattered(array, block, number, *, members, axis):
    """The same where many threads write at once."""
    one = partial(lax.dynamic_update_slice_in_dim, axis=members + axis - number.ndim)
    return _of_members(one, array, block, number)


def _shape(array, block, number, *, members: int, axis: int):
    return ShapedArray(array.shape, array.dtype)


def _jvp(args: tuple, dots: tuple, **params: PyTree):
    """Linear in the array and the block."""
    moves = map(ad.instantiate_zeros, dots[:2])
    return write_p.bind(*args, **params), write_p.bind(*moves, args[2], **params)


def _transpose(cotangent: Array, array, block, number: Array, *, members: int, axis: int):
    like = block.aval if ad.is_undefined_primal(block) else block
    if type(cotangent) is ad.Zero:
        return [ad.Zero(x.aval) if ad.is_undefined_primal(x) else None for x in (array, block, number)]
    to_array = write_p.bind(cotangent, jnp.zeros(like.shape, like.dtype), number, members=members, axis=axis)
    length, along = like.shape[members + axis], members + axis - number.ndim
    to_block = _of_members(lambda x, n: lax.dynamic_slice_in_dim(x, n, length, along), cotangent, number)
    return [x if ad.is_undefined_primal(y) else None for x, y in ((to_array, array), (to_block, block))] + [None]


def _batch(args: tuple, axes: tuple, *, members: int, axis: int):
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


# ----------------------------------------------------------------------------
# What few members of a batch ask for, done for each of them by itself, one after the other.


def in_turn(f: Callable, asked: Array, carry: PyTree, *more: PyTree):
    """f(carry, *more) if `asked`, otherwise the carry. In a batch only the members that ask are evaluated, one by one.

    Each of them takes as long as it would alone. Use it for long chains of scalar operations that few members need at a
    time. Derivatives are those of f, for the whole batch at once. f must return the carry unchanged if not `asked`.

    Args:
        f: a function of pytrees of arrays that returns a pytree like the carry.
        asked: a boolean scalar.
        carry, *more: pytrees of arrays.

    Returns:
        f(carry, *more).

    Raises:
        TypeError: f returns a pytree unlike the carry. Whatever f raises.

    >>> def halved(x):
    ...     return in_turn(lambda x: jnp.where(x > 1, x / 2, x), x > 1, x)
    >>> print(jax.vmap(halved)(jnp.array([4.0, 0.5])))
    [2.  0.5]
    """
    if jax.default_backend() != "cpu" or not is_on():
        return f(carry, *more)
    leaves, structure = jax.tree.flatten((carry, *more))
    leaves = [jnp.asarray(x) for x in leaves]
    like, count = jax.tree.structure(carry), len(leaves)

    def on_leaves(*leaves: Array):
        after, found = jax.tree.flatten(f(*structure.unflatten(leaves)))
        types = [[(x.shape, x.dtype) for x in map(jnp.asarray, xs)] for xs in (after, leaves[: like.num_leaves])]
        if found != like or types[0] != types[1]:
            raise TypeError(f"in_turn: the function returns {found} of {types[0]}; the carry is {like} of {types[1]}.")
        return after

    trace = jax.make_jaxpr(on_leaves)(*leaves)
    leaves = [*leaves, *trace.consts]
    closed = _closed(lambda *x: eval_jaxpr(trace.jaxpr, x[count:], *x[:count]), *leaves)
    return like.unflatten(turn_p.bind(asked, *leaves, closed=closed, at_once=closed, number=like.num_leaves))


def _closed(f: Callable, *like: PyTree) -> ClosedJaxpr:
    """The jaxpr of f, which closes over no tracer."""
    return jax.make_jaxpr(f)(*(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in like))


def _evaluated(closed: ClosedJaxpr, *args: Array):
    return eval_jaxpr(closed.jaxpr, closed.consts, *args)


class _Own(NamedTuple):
    """The part of an array of the whole batch that belongs to one member."""

    array: Array
    member: Array
    number: int  # of the argument


def _taken(x):
    """A member's number itself."""
    return lax.dynamic_index_in_dim(x.array, x.member, keepdims=False) if isinstance(x, _Own) else x


def _put(x, own) -> Array:
    """The array of the batch, with what a member has now."""
    if isinstance(x, _Own) and x.number == own.number:
        return x.array
    return lax.dynamic_update_index_in_dim(own.array, _taken(x), own.member, 0)


def _apply(eqn: JaxprEqn, values: list):
    """The results of one operation; what is written into a member's own stays in its place."""
    if eqn.primitive is write_p and isinstance(values[0], _Own) and eqn.params["members"] == 0:
        own, block, number = values[0], *map(_taken, values[1:])
        at = place(own.member, number, block.ndim, eqn.params["axis"])
        return [own._replace(array=lax.dynamic_update_slice(own.array, block[None], at))]
    return alone(eqn)(*map(_taken, values))


def _one_by_one(closed: ClosedJaxpr, mapped: list, number: int, *args):
    """Evaluates each member that asks, by the last argument. mapped: which other arguments differ between members."""
    *args, asked = args
    numbers = jnp.arange(asked.size, dtype=jnp.int32)

    def next_from(i: Real) -> Array:
        return jnp.min(jnp.where(asked & (numbers >= i), numbers, asked.size)).astype(numbers.dtype)

    def visit(now: tuple):
        i, carry = now
        pairs = zip((*carry, *args[number:]), mapped, strict=True)
        mine = [_Own(x, i, k) if own else x for k, (x, own) in enumerate(pairs)]
        after = evaluate(closed.jaxpr, [*closed.consts, *mine], _apply)
        return next_from(i + 1), [_put(x, own) for x, own in zip(after, mine[:number], strict=True)]

    return lax.while_loop(lambda now: now[0] < asked.size, visit, (next_from(0), args[:number]))[1]


def _batch_turns(args, axes: tuple, *, closed, at_once, number: int):
    """The carry differs between members, whatever else does."""
    size = batch_size(args, axes)
    mapped = [i < number or axis is not None for i, axis in enumerate(axes[1:])]
    asked, *args = (x if axis is None else jnp.moveaxis(x, axis, 0) for x, axis in zip(args, axes, strict=True))
    args = [
        jnp.broadcast_to(x, (size, *x.shape)) if own and axis is None else x
        for x, own, axis in zip(args, mapped, axes[1:], strict=True)
    ]

    def together(closed: ClosedJaxpr, *args: Array):
        return jax.vmap(partial(_evaluated, closed), [0 if own else None for own in mapped])(*args[: len(mapped)])

    values = partial(together, closed)
    if axes[0] is not None:
        args, asked = [*args, asked], jnp.any(asked)
        values = partial(_one_by_one, closed, mapped, number)
    forms = {"closed": _closed(values, *args), "at_once": _closed(partial(together, at_once), *args)}
    return turn_p.bind(asked, *args, **forms, number=number), [0] * number


def _jvp_turns(args: tuple, dots: tuple, *, at_once: ClosedJaxpr, **params: PyTree):
    """Of those that move."""
    moving = [i for i, dot in enumerate(dots) if type(dot) is not ad.Zero and dot.dtype != jax.dtypes.float0]

    def f(*moved: Array):
        now = list(args)
        for i, x in zip(moving, moved, strict=True):
            now[i] = x
        return _evaluated(at_once, *now[1:])

    after, found = jax.jvp(f, [args[i] for i in moving], [dots[i] for i in moving])
    return after, [no_tangent(x) if x.dtype == jax.dtypes.float0 else x for x in found]


def _needed(used: list, *more: JaxprEqn):
    """Removes unused entries of the carry, and operations that only they need."""
    eqn = more[-1]  # a newer JAX tells more
    if eqn.effects:
        return [True] * len(eqn.invars), eqn
    if not any(used):
        return [False] * len(eqn.invars), None
    params, forms = eqn.params, ("closed", "at_once")
    inputs = [pe.dce_jaxpr(params[form].jaxpr, used)[1] for form in forms]
    carry = [i for i, x in enumerate(used) if x]
    places = carry + [i for i, x in enumerate(map(max, *inputs)) if x and i not in carry]
    kept = [eqn.invars[1 + i] for i in places]

    def of(closed: ClosedJaxpr) -> ClosedJaxpr:
        pruned, _ = pe.dce_jaxpr(closed.jaxpr, used, instantiate=True)

        def f(*args: Array):
            given = dict(zip(places, args, strict=True))
            nobody = (jnp.zeros(x.shape, x.dtype) for x in closed.in_avals)
            return eval_jaxpr(pruned, closed.consts, *(given.get(i, x) for i, x in enumerate(nobody)))

        return _closed(f, *(x.aval for x in kept))

    new = dict.fromkeys(forms, of(params["closed"]))
    if params["at_once"] is not params["closed"]:
        new["at_once"] = of(params["at_once"])
    outvars = [eqn.outvars[i] for i in carry]
    new = eqn.replace(invars=[eqn.invars[0], *kept], outvars=outvars, params={**new, "number": len(carry)})
    return [True, *(i in places for i in range(len(eqn.invars) - 1))], new


def values(asked: Array, *args: Array, closed: ClosedJaxpr, **params: PyTree):
    """What the function of `in_turn` gives, whoever has asked."""
    return _evaluated(closed, *args)


# closed: the function; at_once: the same in the form of which derivatives are taken
turn_p = holds_jaxprs(Primitive("hhtjax_in_turn"))
turn_p.multiple_results = True
turn_p.def_impl(values)
turn_p.def_effectful_abstract_eval(lambda *args, closed, **params: (closed.out_avals, closed.effects))
batching.primitive_batchers[turn_p] = _batch_turns
ad.primitive_jvps[turn_p] = _jvp_turns
pe.dce_rules[turn_p] = _needed
mlir.register_lowering(turn_p, mlir.lower_fun(values, multiple_results=True))
