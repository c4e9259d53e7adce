"""Runs with events: what they carry along, and what they tell."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from hhtjax.description.presentation import shown
from hhtjax.numerics.checkpointed_scan import checkpoint
from hhtjax.numerics.seldom import choose, seldom
from hhtjax.runs.event_failures import FINE
from hhtjax.runs.loop import first_failure
from hhtjax.runs.meeting import Log, Met, Part, Ways, asks, pass_events
from hhtjax.systems.events import flatten_events


@shown
class Events(NamedTuple):
    """The events of a run, in their order; with `keep_events` entries, NaN (of `which` -1) beyond those that were met.

    Attributes:
        count: how many were met, also those beyond the entries.
        t: (keep_events,), when; differentiable.
        which: (keep_events,), the number of the event.
        q: where, like q0 with a leading axis; None of a first-order system.
        before, after: v before and after each, like v0 with a leading axis; y of a first-order system.
        z: internal states there, None without.
        rate: (keep_events,), dg/dt before. Where it is small beside the velocities the motion grazes the guard, and
            derivatives are huge, at last infinite.
    """

    count: Any
    t: Any
    which: Any
    q: Any
    before: Any
    after: Any
    z: Any
    rate: Any


def loop_with_events(loop, flat, stepper, events, params, max_events, keep):
    """The `Loop` with events: its carry has `Met` behind (state, number of steps, first failure)."""
    start = loop.carry[0]
    stepper = stepper.astype(start.v.dtype)
    ways = Ways(flat, stepper, flatten_events(flat, events, params, stepper.redundant), max_events, loop.no_info)
    met = before_any(ways, start, params, keep)
    step = past_events(ways, params, loop.bound, loop.sizes)
    return loop._replace(carry=(*loop.carry, met), advance=step, past=partial(past_events, ways, params))


def past_events(ways, params, bound, sizes):
    """The step of a run with events, where `here`; else the same without a look at them.

    bound: params -> the step without. sizes: number of steps taken -> the size of this one, and of the one before.
    """
    events = ways.events
    fixed = None if events.modes(params) else bound(params)

    @checkpoint  # reverse mode would keep all that is in there for each step
    def across(part, h, params):
        return pass_events(ways, params, part, h)

    def step(carry, here=True):
        *run, met = carry
        now = events.with_modes(params, met.modes)
        (new, count, _), info = (fixed or bound(now))(tuple(run))
        state, before, failure = run
        h, last = sizes(before)
        if any(events.ends):
            new, info = choose(met.ended, state, new), choose(met.ended, ways.no_info, info)
        asked = asks(ways, state, new, now, h) & ~met.ended & here
        part = Part(state, new, info, h, last, met, jnp.zeros_like(met.ended), asked)
        part = seldom(across, asked, part, h, params)
        failure = first_failure(ways.flat, failure, count, part.end, part.info)
        return (part.end, count, failure, part.met), part.info

    return step


def before_any(ways, start, params, keep):
    """`Met` before the first event."""
    none, dtype = jnp.zeros((), jnp.int32), start.v.dtype

    def empty(*shape):
        return jnp.full((keep, *shape), jnp.nan, dtype)

    N = start.v.size
    log = Log(none, empty(), jnp.full(keep, -1, jnp.int32), empty(start.q.size), empty(N), empty(N), empty())
    return Met(ways.events.modes(params), jnp.array(False), none + FINE, none, log)


def with_told_events(flat, solution, met):
    """The `Solution` with its `Events`, and what was wrong with one of them."""
    log, n, q, z = met.log, flat.positions, None, None
    before, after, rows = log.before, log.after, flat.unravel
    if n:
        q, rows = jax.vmap(flat.unravel)(log.q), flat.unravel_rates
        before, after = before[:, :n], after[:, :n]
    if n not in (0, flat.size):
        z = jax.vmap(flat.unravel_internal)(log.before[:, n:])
    events = Events(log.count, log.t, log.which, q, jax.vmap(rows)(before), jax.vmap(rows)(after), z, log.rate)
    return solution._replace(events=events, failure=solution.failure._replace(event=met.code, guard=met.event))
