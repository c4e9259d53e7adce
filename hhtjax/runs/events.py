"""Runs with events: what they carry along, and what they tell."""

from functools import partial

import jax
import jax.numpy as jnp

from hhtjax.numerics.checkpointed_scan import checkpoint
from hhtjax.numerics.seldom import choose, seldom
from hhtjax.runs.event_failures import FINE
from hhtjax.runs.event_log import Events
from hhtjax.runs.event_pieces import Pieces
from hhtjax.runs.loop import first_failure
from hhtjax.runs.meeting import Met, Part, Ways, asks, pass_events
from hhtjax.systems import held
from hhtjax.systems.events import flatten_events


def loop_with_events(loop, flat, stepper, events, params, max_events, keep, in_pieces=False):
    """The `Loop` with events: its carry has `Met` behind (state, number of steps, first failure).

    in_pieces: whether that has the `Pieces` of the last step.
    """
    start = loop.carry[0]
    stepper = stepper.astype(start.v.dtype)
    ways = Ways(flat, stepper, flatten_events(flat, events, params, stepper.redundant), max_events, loop.no_info)
    met = before_any(ways, start, params, keep)
    if in_pieces:
        met = met._replace(pieces=Pieces.none(start, max_events + 1))
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
        if met.pieces is not None:
            begun = held.entered(ways.stepper, ways.flat, now, h, last, state)[1]
            met = met._replace(pieces=choose(here, met.pieces.whole(begun, new), met.pieces))
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
    which, q = jnp.full(keep, -1, jnp.int32), empty(start.q.size)
    log = Events(none, empty(), which, q, empty(N), empty(N), None, empty())
    return Met(ways.events.modes(params), jnp.array(False), none + FINE, none, log)


def with_told_events(flat, solution, met):
    """The `Solution` with its `Events`, and what was wrong with one of them."""
    log, n = met.log, flat.positions
    z = None if n in (0, flat.size) else jax.vmap(flat.unravel_internal)(log.before[:, n:])
    q, rows = (jax.vmap(flat.unravel)(log.q), flat.unravel_rates) if n else (None, flat.unravel)
    before, after = (jax.vmap(lambda v: rows(flat.located(v) if n else v))(v) for v in (log.before, log.after))
    events = log._replace(q=q, before=before, after=after, z=z)
    return solution._replace(events=events, failure=solution.failure._replace(event=met.code, guard=met.event))
