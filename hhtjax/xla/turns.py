"""What few members of a batch ask for, done for each of them by itself, one after the other."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.core import eval_jaxpr
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from hhtjax.xla.gate import is_on
from hhtjax.xla.interpreter import alone, evaluate
from hhtjax.xla.rows import place, write_p
from hhtjax.xla.two_ways import no_tangent


def in_turn(f, asked, carry, *more):
    """f(carry, *more), which leaves the carry as it is where not `asked`: a batch visits only members that ask.

    One after the other, so that a member takes what it takes alone: for what few of them need at a time, with long
    chains of scalars. Derivatives are those of f, for the whole batch at once.

    Args:
        f: a function of pytrees of arrays that returns one like the carry.
        asked: a boolean scalar.
        carry, *more: pytrees of arrays.

    Returns:
        f(carry, *more).

    Raises:
        TypeError: f returns something else than the carry is. Whatever f raises.

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

    def on_leaves(*leaves):
        after, found = jax.tree.flatten(f(*structure.unflatten(leaves)))
        types = [[(x.shape, x.dtype) for x in map(jnp.asarray, xs)] for xs in (after, leaves[: like.num_leaves])]
        if found != like or types[0] != types[1]:
            raise TypeError(f"in_turn: the function returns {found} of {types[0]}; the carry is {like} of {types[1]}.")
        return after

    trace = jax.make_jaxpr(on_leaves)(*leaves)
    leaves = [*leaves, *trace.consts]
    closed = _closed(lambda *x: eval_jaxpr(trace.jaxpr, x[count:], *x[:count]), *leaves)
    return like.unflatten(turn_p.bind(asked, *leaves, closed=closed, number=like.num_leaves))


def _closed(f, *like):
    """The jaxpr of f, which closes over no tracer."""
    return jax.make_jaxpr(f)(*(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in map(jnp.asarray, like)))


def _all_at_once(asked, *args, closed, number):
    return eval_jaxpr(closed.jaxpr, closed.consts, *args)


class _Own(NamedTuple):
    """What a member has of an array of the whole batch."""

    array: Any
    member: Any
    number: int  # of the argument

    def taken(self):
        return lax.dynamic_index_in_dim(self.array, self.member, keepdims=False)


def _put(x, own):
    """The array of the batch, with what a member has now."""
    if isinstance(x, _Own) and x.number == own.number:
        return x.array
    return lax.dynamic_update_index_in_dim(own.array, x.taken() if isinstance(x, _Own) else x, own.member, 0)


def _apply(eqn, values):
    """The results of one operation; what is written into a member's own stays in its place."""
    if eqn.primitive is write_p and isinstance(values[0], _Own) and eqn.params["members"] == 0:
        own, block, number = values
        at = place(own.member, number, block.ndim, eqn.params["axis"])
        return [own._replace(array=lax.dynamic_update_slice(own.array, block[None], at))]
    return alone(eqn)(*(x.taken() if isinstance(x, _Own) else x for x in values))


def _one_by_one(asked, *args, closed, number, mapped):
    """For each member that asks; mapped: which of the arguments differ between them."""
    numbers = jnp.arange(asked.size, dtype=jnp.int32)

    def next_from(i):
        return jnp.min(jnp.where(asked & (numbers >= i), numbers, asked.size)).astype(numbers.dtype)

    def visit(now):
        i, carry = now
        pairs = zip((*carry, *args[number:]), mapped, strict=True)
        mine = [_Own(x, i, k) if own else x for k, (x, own) in enumerate(pairs)]
        after = evaluate(closed.jaxpr, [*closed.consts, *mine], _apply)
        return next_from(i + 1), [_put(x, own) for x, own in zip(after, mine[:number], strict=True)]

    return lax.while_loop(lambda now: now[0] < asked.size, visit, (next_from(0), list(args[:number])))[1]


def _batch(args, axes, *, closed, number):
    """The carry differs between members, whatever else does."""
    size = next(x.shape[axis] for x, axis in zip(args, axes, strict=True) if axis is not None)
    mapped = [i < number or axis is not None for i, axis in enumerate(axes[1:])]
    asked, *args = (x if axis is None else jnp.moveaxis(x, axis, 0) for x, axis in zip(args, axes, strict=True))
    args = [
        jnp.broadcast_to(x, (size, *x.shape)) if own and axis is None else x
        for x, own, axis in zip(args, mapped, axes[1:], strict=True)
    ]
    if axes[0] is None:
        f = jax.vmap(partial(_all_at_once, None, closed=closed, number=number), [0 if own else None for own in mapped])
        return turn_p.bind(asked, *args, closed=_closed(f, *args), number=number), [0] * number

    def f(*x):
        return _one_by_one(x[-1], *x[:-1], closed=closed, number=number, mapped=mapped)

    return turn_p.bind(jnp.any(asked), *args, asked, closed=_closed(f, *args, asked), number=number), [0] * number


def _jvp(args, dots, *, closed, number):
    """Of those that move."""
    moving = [i for i, dot in enumerate(dots) if type(dot) is not ad.Zero and dot.dtype != jax.dtypes.float0]

    def f(*moved):
        now = list(args)
        for i, x in zip(moving, moved, strict=True):
            now[i] = x
        return _all_at_once(*now, closed=closed, number=number)

    after, found = jax.jvp(f, [args[i] for i in moving], [dots[i] for i in moving])
    return after, [no_tangent(x) if x.dtype == jax.dtypes.float0 else x for x in found]


turn_p = Primitive("hhtjax_in_turn")
turn_p.multiple_results = True
turn_p.def_impl(_all_at_once)
turn_p.def_effectful_abstract_eval(lambda asked, *args, closed, number: (closed.out_avals, closed.effects))
batching.primitive_batchers[turn_p] = _batch
ad.primitive_jvps[turn_p] = _jvp
mlir.register_lowering(turn_p, mlir.lower_fun(_all_at_once, multiple_results=True))
