"""Samples between the ends of steps: read off from the two states around each of the times."""

from typing import Any

import jax
import jax.numpy as jnp

from hhtjax.runs.interpolate import between, on_axes
from hhtjax.runs.loop import as_path, as_solution, saved
from hhtjax.runs.output import output_at
from hhtjax.runs.solution import Solution
from hhtjax.steppers.stepper import State, public
from hhtjax.systems import held

TINY = 1e-9  # part of a run


def kept(flat, stepper, state):
    """What is saved of a state, and what its dense output adds."""
    extra = None
    if stepper.dense_term:
        e_q, e_v = state.memory
        extra = public(flat, State(state.t, e_q, e_v, 0 * e_v))
        extra = extra.q, (None if flat.positions == 0 else extra.v), extra.z
    return saved(flat, state), extra


def solution_at(flat, start, around, times, reached, info, failure):
    """The `Solution` at the times, each between the two states of which `around` has what `kept` makes of them; NaN
    beyond what was reached, and before them. Without, one that knows the times."""
    if around is None:
        nothing: Any = None
        t = jnp.concatenate([start.t[None], times])
        return Solution(t, nothing, nothing, nothing, nothing, nothing, info, failure)
    (first, _), (second, extra) = around
    pair = [as_solution(flat, start, path, None, info, failure) for path in (first, second)]
    a, b = (jax.tree.map(lambda x: x[1:], run._replace(dt=None, info=None, failure=None)) for run in pair)
    start = jax.tree.map(lambda x: x[:1], pair[0]._replace(dt=None, info=None, failure=None))
    found = read_between(flat, a, b, extra, times, reached, times[-1] - start.t[0])
    path = jax.tree.map(lambda x, y: jnp.concatenate([x, y]), start, found._replace(t=times))
    return path._replace(info=pair[1].info, failure=pair[1].failure)


def read_between(flat, a, b, extra, times, reached, long):
    """The values at each of the times, between those of a and b."""
    # a part of a step that is a rounding, behind an event, is the beginning of a long one
    H = jnp.where(b.t - a.t > TINY * long, b.t - a.t, long)
    s = jnp.where((a.t <= times) & (times <= reached), (times - a.t) / H, jnp.nan)
    found = between(a, b, H, s)
    return found if extra is None else with_dense_term(flat, found, extra, s, H)


def with_dense_term(flat, found, extra, s, H):
    """`found`, with s^2 (1 - s)^2 times what the stepper's dense output adds to cubics, and the rate of that."""
    weight, rate = (s * (1 - s)) ** 2, 2 * s * (1 - s) * (1 - 2 * s) / H
    e_q, e_v, e_z = extra
    terms = [("q", flat.unravel, weight, e_q)]
    if flat.positions:
        terms += [("v", flat.unravel_rates, weight, e_v), ("acceleration", flat.unravel_rates, rate, e_v)]
        terms += [("z", flat.unravel_internal, weight, e_z), ("zdot", flat.unravel_internal, rate, e_z)]
    else:
        terms += [("v", flat.unravel_rates, rate, e_q)]
    for name, unravel, factor, e in terms:
        if e is not None:
            more = jax.vmap(unravel)(factor[:, None] * e)
            found = found._replace(**{name: jax.tree.map(jnp.add, getattr(found, name), more)})
    return found


def output_between(flat, output, params, pair, time, long):
    """What `output` gives at a time between a pair of what `kept` has made of states; long: of `read_between`."""
    (a, _), (b, extra) = jax.tree.map(lambda x: x[None], pair)
    a, b, times = as_path(flat, a), as_path(flat, b), time[None]
    found = read_between(flat, a, b, extra, times, times, long)
    if held.holds(params):  # as the step has had them
        params = held.held_at(params, (a.t[0] + b.t[0]) / 2)
    return output_at(output, jax.tree.map(lambda x: x[0], found), time, params)


def with_output(run, start, found, times, reached):
    """The `Solution` with the output at its start and at the times; NaN beyond what was reached."""

    def joined(x, y):
        if jnp.issubdtype(y.dtype, jnp.floating):
            y = jnp.where(on_axes(times <= reached, y), y, jnp.nan)
        return jnp.concatenate([x[None], y])

    return run._replace(output=jax.tree.map(joined, start, found))
