"""The steps of many members: tried in blocks, each member at its own pace, and sorted again and again on the way."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.runs.choose import Bounds, as_steps, attempt, begin, is_walking
from hhtjax.xla import on_scalars, one_kernel

ROUND = 256  # tries of a block, before members are sorted anew


def choose_many(problem_of, data, axes, size, end, lanes, max_steps):
    """`Steps` of each member up to `end`, and (size, max_steps) the times at which they end; inf behind them.

    How many tries a member needs is not known before. So each round takes those that are not done, sorted by how many
    more their present steps would be, in blocks, and each block for a number of tries, or until the last is done.
    No tracer of autodiff may come in.

    Args:
        problem_of: one member's data -> its `Problem` and `Adaptive`.
        data, axes: a list of arrays, and 0 or None for each, as for `jax.vmap`.
        size, lanes: number of members, and of those in a block.
        max_steps: as in `adaptive`.
    """

    def parts(data):
        problem, control = problem_of(data)
        flat, q, v, t0, params = problem.flat()
        return control, flat, problem.stepper.astype(q.dtype), q, v, t0, params

    def ready(data):
        control, flat, stepper, q, v, t0, params = parts(data)
        bounds = Bounds.of(flat, stepper, control, t0, end)
        return bounds, begin(flat, stepper, q, v, t0, end, params, bounds)

    def trying(data, bounds):
        _, flat, stepper, _, _, _, params = parts(data)
        return partial(attempt, flat, stepper, params, end, bounds, max_steps)

    first = [x if axis is None else x[0] for x, axis in zip(data, axes, strict=True)]
    bounds, walk = ready(first)
    form = on_scalars(trying(first, bounds), walk)
    bounds, walks = jax.vmap(ready, (axes,))(data)
    walks = jax.vmap(form.like)(walks)

    def one_try(data, bounds, walk):
        """The next walk, and the time at which the step ends, NaN where none was accepted."""
        new, t = form.of(trying(data, bounds))(walk)
        new = jax.tree.map(partial(jnp.where, is_walking(walk, end)), new, walk)
        return new, jnp.where(new.accepted > walk.accepted, t, jnp.nan)

    def tries(walks, data, bounds):
        def unfinished(carry):
            walks, _, number = carry
            return jnp.any(is_walking(walks, end)) & (number < ROUND)

        def body(carry):
            walks, rows, number = carry
            walks, t = jax.vmap(one_try, (axes, 0, 0))(data, bounds, walks)
            return walks, lax.dynamic_update_index_in_dim(rows, t, number, 0), number + 1

        rows = jnp.full((ROUND, lanes), jnp.nan, end.dtype)  # of all members, so that no try writes to several places
        return lax.while_loop(unfinished, body, (walks, rows, jnp.zeros((), jnp.int32)))[:2]

    def block(order, number, carry):
        walks, ends = carry
        members = order[
            jnp.minimum(number * lanes + np.arange(lanes, dtype=np.int32), size - 1)
        ]  # the last one fills up
        mine = [x if axis is None else x[members] for x, axis in zip(data, axes, strict=True)]
        before, limits = (jax.tree.map(lambda x: x[members], tree) for tree in (walks, bounds))
        after, rows = one_kernel(tries, before, mine, limits)
        took = ~jnp.isnan(rows)
        places = jnp.where(took, before.accepted[None] + jnp.cumsum(took, axis=0, dtype=jnp.int32) - 1, max_steps)
        ends = ends.at[jnp.broadcast_to(members, places.shape), places].set(rows, mode="drop")
        return jax.tree.map(lambda x, y: x.at[members].set(y), walks, after), ends

    def rounds(carry):
        walks, _ = carry
        waiting = is_walking(walks, end)
        order = jnp.argsort(jnp.where(waiting, -(end - walks.state.t) / walks.h, jnp.inf))
        blocks = -(-jnp.sum(waiting, dtype=jnp.int32) // lanes)
        return lax.fori_loop(0, blocks, partial(block, order), carry)

    def unfinished(carry):
        return jnp.any(is_walking(carry[0], end))

    ends = jnp.full((size, max_steps), jnp.inf, end.dtype)
    walks, ends = lax.while_loop(unfinished, rounds, (walks, ends))
    t0 = jax.vmap(lambda data: parts(data)[5], (axes,), axis_size=size)(data)
    return jax.vmap(as_steps)(walks, ends, t0, bounds.least), ends
