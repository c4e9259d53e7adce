"""Runs with events: what they carry along, and what they tell."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from hhtjax.description.presentation import shown
from hhtjax.numerics.seldom import seldom
from hhtjax.runs.loop import first_failure
from hhtjax.runs.meeting import FINE, Log, Met, Part, Ways, asks, choose, pass_events, told
from hhtjax.systems.events import flatten_events


@shown
class Events(NamedTuple):
    """The events of a run, in their order; with `keep_events` entries, NaN (of `which` -1) beyond those that were met.

    Attributes:
        count: how many were met, also those beyond the entries.
        t: (keep_events,), when; differentiable.
        which: (keep_events,), the number of the event.
        before, after: v before and after each, like v0 with a leading axis; y of a first-order system.
        rate: (keep_events,), dg/dt before. Where it is small beside the velocities the motion grazes the guard, and
            derivatives are huge, at last infinite.
    """

    count: Any
    t: Any
    which: Any
    before: Any
    after: Any
    rate: Any


def loop_with_events(loop, flat, stepper, events, params, max_events, keep):
    """The `Loop` with events: its carry has `Met` behind (state, number of steps, first failure)."""
    stepper = stepper.astype(loop.carry[0].v.dtype)
    flat_events = flatten_events(flat, events, params, stepper.redundant)
    ways = Ways(flat, stepper, flat_events, max_events, loop.no_info)
    fixed = None if flat_events.modes(params) else loop.bound(params)

    def step(carry):
        *run, met = carry
        state, count, failure = run
        now = flat_events.with_modes(params, met.modes)
        (new, after, _), info = (fixed or loop.bound(now))(tuple(run))
        h, last = loop.sizes(count)
        if any(flat_events.ends):
            new, info = choose(met.ended, state, new), choose(met.ended, loop.no_info, info)
        part = Part(state, new, info, h, last, met, jnp.zeros_like(met.ended))
        asked = asks(ways, state, new, now, h) & ~met.ended
        part, _ = seldom(partial(pass_events, ways, params), asked, (part, h))
        failure = first_failure(flat, failure, after, part.end, part.info)
        return (part.end, after, failure, part.met), part.info

    met = before_any(flat, flat_events, loop.carry[0], params, keep)
    return loop._replace(carry=(*loop.carry, met), advance=step)


def before_any(flat, events, start, params, keep):
    """`Met` before the first event."""
    none, nan = jnp.zeros((), jnp.int32), jnp.full(keep, jnp.nan, start.v.dtype)
    rows = jnp.full((keep, told(flat, start.v).size), jnp.nan, start.v.dtype)
    log = Log(none, nan, jnp.full(keep, -1, jnp.int32), rows, rows, nan)
    return Met(events.modes(params), jnp.array(False), none + FINE, none, log)


def with_told_events(flat, solution, met):
    """The `Solution` with its `Events`, and what was wrong with one of them."""
    rows, log = flat.unravel_rates if flat.positions else flat.unravel, met.log
    events = Events(log.count, log.t, log.which, jax.vmap(rows)(log.before), jax.vmap(rows)(log.after), log.rate)
    return solution._replace(events=events, failure=solution.failure._replace(event=met.code, guard=met.event))
