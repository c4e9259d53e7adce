"""Runs with events: what they carry along, and what they tell."""

from functools import partial

import jax.numpy as jnp

from hhtjax.description import freeze
from hhtjax.numerics.batched_cond import choose, if_any
from hhtjax.numerics.checkpointed_scan import checkpoint
from hhtjax.primitives import in_turn
from hhtjax.runs.event_step import Met, Part, Pieces, Ways, asks, pass_events, reaching, unnoted
from hhtjax.runs.loop import first_failure
from hhtjax.runs.solution import FINE, Log
from hhtjax.steppers.stepper import step_start
from hhtjax.systems.events import flatten_events


def loop_with_events(loop, flat, stepper, events, params, max_events, keep, in_pieces=False, with_modes=False):
    """The `Loop` with events: its carry has `Met` behind (state, number of steps, first failure).

    in_pieces: whether that has the `Pieces` of the last step; with_modes: whether these have the modes.
    """
    start = loop.carry[0]
    stepper = stepper.astype(start.v.dtype)
    flat_events = flatten_events(flat, events, params, (start.q, start.v, start.t), stepper.redundant)
    ways = Ways(flat, stepper, flat_events, max_events, loop.no_info, reaching(flat, stepper, loop.no_info), keep)
    met = before_any(ways, params, start.t)
    met = met._replace(log=Log.empty(unnoted(start)[0], keep, ways.slots))
    if in_pieces:
        met = met._replace(pieces=Pieces.none(start, max_events + 1, met.modes if with_modes else ()))
    step = past_events(ways, params, loop.bound, loop.sizes)
    more = {"past": partial(past_events, ways, params), "now": lambda met: flat_events.with_modes(params, met.modes)}
    return loop._replace(carry=(*loop.carry, met), advance=step, **more)


def past_events(ways, params, bound, sizes):
    """The step of a run with events, which rests where not `here`.

    bound: params -> the step without. sizes: number of steps taken -> the size of this one, and of the one before.
    """
    events, pass_them = ways.events, passing(ways)
    fixed = None if events.switches else bound(params)

    def step(carry, here=None):
        *run, met = carry
        now = events.with_modes(params, met.modes)
        (new, count, _), info = (fixed or bound(now))(tuple(run))
        state, before, failure = run
        h, last = sizes(before)
        if any(events.ends):
            new, info = choose(met.ended, state, new), choose(met.ended, ways.no_info, info)
        # before the branch: LLVM makes no vector instructions of a choice between what comes out of one
        new, count = at_rest(here, (new, count), (state, before))
        if met.pieces is not None:
            begun = step_start(ways.stepper, ways.flat, now, h, last, state)[1]
            met = met._replace(pieces=at_rest(here, met.pieces.whole(begun, new, met.modes), met.pieces))
        part = Part.whole(ways, state, new, info, h, last, met._replace(log=None))
        counts = None if here is None else (before, count)
        asked = may_meet(ways, part, h, params)
        part, log = if_any(pass_them, asked, (part, met.log), counts, h, freeze(params), kept=False)
        told = first_failure(ways.flat, failure, count, part.end, part.info)
        return (part.end, count, at_rest(here, told, failure), part.met._replace(log=log)), part.info

    return step


def may_meet(ways, part, h, params):
    """Whether there may be an event in a step."""
    now = ways.during(params, part.start.t, h).params(params, part.met.modes)
    asked = asks(ways, part.start, part.end, now, part.met.over, h)
    return asked & ~part.met.ended if any(ways.events.ends) else asked


def passing(ways):
    """The function of a step and the log, with the counts of steps before and after it, that passes its events."""

    @checkpoint  # reverse mode would keep all that is in there for each step
    def noted(now, h, params):
        part, log = now
        part, (rows, there) = pass_events(ways, params, part, h)
        return part, log.with_more(rows, there, ways.keep)

    def pass_them(now, counts, h, params):
        part, log = now
        # who asks, anew: what is needed here alone is nothing that a step without events has to keep
        asked = may_meet(ways, part, h, params)
        if counts is not None:
            asked = asked & (counts[0] != counts[1])  # members that do not rest
        return in_turn(noted, asked, (part._replace(asked=asked), log), h, params)

    return pass_them


def at_rest(here, new, old):
    """The new, or, where a member of a sweep rests, the old."""
    return new if here is None else choose(here, new, old)


def before_any(ways, params, t):
    """`Met` before the first event."""
    none = jnp.zeros((), jnp.int32)
    return Met(ways.events.modes(params), jnp.array(False), none + FINE, none, over=ways.events.before_any(t))


def with_told_events(flat, solution, met, keep):
    """The `Solution` with its `Events`, and what was wrong with one of them."""
    failure = solution.failure._replace(event=met.code, guard=met.event)
    return solution._replace(events=met.log.told(flat, keep), failure=failure)
