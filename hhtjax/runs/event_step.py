"""A step with events: find the first event, step to it, change the velocity or the params, restart, finish the step.

    0 = g(step(s, tau)),   e = step(s, tau),   v := reset(e),  params := switch(params),   s1 = step(begin(e), h - tau)

The time grid does not change, and the order is that of the stepper. tau is first found on the cubic through g and its
rate at both ends, and then made exact by Newton's method on steps of size tau. Its derivative follows from the
implicit-function theorem. If the remainder is shorter than a millionth of the step, it is a Taylor polynomial: without
it the derivative of tau would be lost.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.description import Array, PyTree, Real
from hhtjax.numerics.batched_cond import call_where, if_any, tree_where
from hhtjax.numerics.checkpointed_scan import checkpoint
from hhtjax.primitives import staged
from hhtjax.runs.solution import ALONG, CORNER, FINE, MANY, NEGATIVE, NO_NUMBER, SINGULAR, STAYS, THROWN, row_of
from hhtjax.steppers.stepper import behind_jump, entered, join_info
from hhtjax.steppers.variable_step import drifted, resized_step
from hhtjax.systems import zero_order_hold
from hhtjax.systems.sampled import SLOP

if TYPE_CHECKING:
    from hhtjax.steppers.stepper import Info, State, Stepper
    from hhtjax.systems.events import FlatEvents
    from hhtjax.systems.flat_system import FlatSystem


def asks(context: EventContext, s: State, s1: State, params: PyTree, over: list, h: Array) -> Array:
    """Whether the step from s to s1 may contain an event: a check of the guards at both ends, in few operations."""
    (g0, d0), (g1, d1) = context.events.still.both(context.flat, *lax.stop_gradient((s, s1)), params, over, h)
    noted = np.asarray(context.events.noted) & ~np.asarray(context.events.timed)
    if any(context.events.timed):
        g1 = g1 - lateness(context.events, s1.t)
    below = ~(g1 > 0) & (~noted | (g0 > 0) | (d0 > 0))
    cross_below = g0 * (d1 - d0) <= d0 * (g1 - g0 - d1 * h)  # tangents at both ends; a division is dear
    return jnp.any(below | ((d0 < 0) & (d1 > 0) & cross_below))


def pass_events(context: EventContext, params: PyTree, part: SubStep, h: Array):
    """The step with all its events: a `SubStep`, of which end, info and met are used; and the records of the events:
    rows, and whether each exists. Members that have not asked are unchanged."""
    context = context.during(params, part.start.t, h)
    if context.middle is not None:
        known, t = context.events.with_modes(params, part.met.modes), part.start.t
        old, new = zero_order_hold.before(known, t, part.last), context.params(params, part.met.modes)
        here = zero_order_hold.passed(known, t, part.last, h)
        part = part._replace(start=behind_jump(context.stepper, context.flat, part.start, old, new, h, here))

    @checkpoint  # what all slots keep for reverse mode takes longer to compile than to compute one again
    def slot(part: SubStep, _):
        going = part.asked & (part.met.code == FINE) & ~part.met.ended
        return if_any(partial(meet_or_flag, context), going, (part, unnoted(part.start)), going, h, params)

    part, noted = lax.scan(slot, part, length=context.slots)
    part = flag(part, part.asked & ~part.met.ended, MANY, jnp.ones_like(part.passed))
    met = part.met

    def anew(s: State, params: PyTree) -> State:
        return begin(context, s, s.v, params, h, moves=False)

    now = context.params(params, met.modes)
    end = call_where(anew, (part.divided > 0) & ~met.ended, part.end, now)

    def known(s: State) -> State:
        lost = {name: jnp.where(met.code == FINE, getattr(s, name), jnp.nan) for name in ("q", "v", "w")}
        return s._replace(**lost)

    if met.pieces is not None:
        met = met._replace(pieces=met.pieces._replace(end=known(met.pieces.end)))
    return part._replace(end=known(end), met=met), noted


def unnoted(s: State):
    """An empty row, and False for its existence."""
    row = row_of(s.t, jnp.zeros((), jnp.int32), s.t, s.q, s.v, s.v)
    return jnp.full_like(row, jnp.nan), jnp.array(False)


def meet_or_flag(context: EventContext, now: tuple, going: Array, h: Array, params: PyTree):
    """The remainder after its first event, if there is one, and the record of the event; also what went wrong."""
    part, noted = now
    found = look(context, part, params, h)
    here = going & jnp.any(found.hit)
    part = flag(part, going & ~here, NEGATIVE, found.negative)
    part = flag(part, going & ~here, STAYS, found.stays)
    part = flag(part, going & ~here, NO_NUMBER, found.unknown)
    part = part._replace(asked=jnp.where(going, here, part.asked))
    return call_where(partial(meet, context), here, (part, noted), found, h, params)


def flag(part: SubStep, bad: Array, code: int, which: Array) -> SubStep:
    """The part with the failure code, if something went wrong at the first of these events."""
    met = part.met
    bad = bad & jnp.any(which) & (met.code == FINE)
    first = jnp.min(jnp.where(which, jnp.arange(which.size, dtype=met.event.dtype), which.size))
    met = met._replace(code=jnp.where(bad, code, met.code), event=jnp.where(bad, first, met.event))
    return part._replace(met=met)


def begin(context: EventContext, e: State, v: Array, params: PyTree, h: Array, moves: bool = True) -> State:
    """The state from which a step of size h starts anew, after e with velocities v; moves: whether the velocities may
    have changed."""
    new = staged(lambda q, v, t, h: entered(context.stepper, context.flat, q, v, t, params, h, moves=moves)[1])(
        e.q, v, e.t, h
    )
    return new if e.contact is None else new._replace(contact=new.contact.following(e.contact, e.t))


def meet(context: EventContext, now: tuple, found: Found, h: Array, params: PyTree):
    """The remainder of the step after its first event, and the record of the event."""
    part, *_ = now
    events, met = context.events, part.met
    known = lax.stop_gradient((params, met.modes, part))
    tau, near = lax.stop_gradient(first_time(context, context.params(*known[:2]), known[2], found, h))
    i, this = first_of(events, part, found, near)
    now = context.params(params, met.modes)
    tau = located(context, now, part, this, found, tau, h)
    e, info = reached(context, now, part, tau, h)
    Ldot = events.slope(part.start, part.end, part.rest)
    g, d = events.rates(context.flat, e, now, met.over, Ldot)
    rate = pick(this, d)
    missed = ~(jnp.abs(pick(this, g)) <= beside_zero(rate, h, pick(this, found.size)))
    missed = missed & ~(pick(this, found.jumped.astype(h.dtype)) > 0)
    v, modes = events.outcome(i, e, now, events.with_modes(params, met.modes))
    row = row_of(e.t, i, rate, e.q, e.v, v)

    over = events.passed(i, met.over)
    again = jnp.asarray(events.timed)  # a time that is over is no longer its guard
    passed = part._replace(passed=part.passed | ((this > 0) & ~again), met=met._replace(over=over))
    new = behind(context, part, (e, info, tau, g, d), (v, modes, over), i, this, near, h, params)
    noted, touches = (pick(this, jnp.asarray(x, h.dtype)) > 0 for x in (events.noted, found.touches))
    new = tree_where(noted, passed, new)  # what changes nothing divides no step
    stays, many = missed & jnp.all(jnp.isfinite(e.v)), ~noted & (part.divided == context.max_events)
    code = jnp.where(many, MANY, jnp.where(stays, STAYS, new.met.code)).astype(met.code.dtype)
    new = new._replace(met=new.met._replace(code=code, event=jnp.where(stays | many, i, new.met.event)))
    none = missed & touches
    return tree_where(none, passed, new), (row, ~none & ~many)


def behind(
    context: EventContext,
    part: SubStep,
    at: tuple,
    outcome: tuple,
    i: Array,
    this: Array,
    near: Array,
    h: Array,
    params: PyTree,
) -> SubStep:
    """The remainder of the step after event i. at: the state and the `Info` before it, its time, and g and dg/dt of all
    events."""
    events, (e, info, tau, g, d), (v, modes, over) = context.events, at, outcome
    then = context.params(params, modes)
    ends = pick(this, jnp.asarray(events.ends, h.dtype)) > 0
    rest = jnp.where(ends, 0, part.rest - tau)
    start = begin(context, e, v, then, h)  # whole: what is left may be far too short to tell what is stiff
    end, more = go(context, then, start, rest, h, h)
    end = end._replace(t=jnp.where(ends, e.t, part.end.t))

    g1, d1 = events.rates(context.flat, start, then, over, events.slope(start, end, rest))
    near_and_due = near & ~part.passed & ~jnp.asarray(events.noted)
    going_on = jnp.any(part.due)
    beside = jnp.where(going_on, part.beside, near_and_due)
    due = jnp.where(going_on, part.due, near_and_due) & ~(this > 0)
    same = (jnp.abs(d1 - d) <= nearness(h) * jnp.abs(d)) & (jnp.abs(g1 - g) <= nearness(h) * h * jnp.abs(d))
    same = same | jnp.asarray(events.timed)  # nothing changes those
    corner = jnp.any(beside & ~(this > 0) & ~same)  # in another order they might have other outcomes
    code = jnp.where(corner, CORNER, jnp.where(jnp.all(jnp.isfinite(v)), FINE, ALONG))
    if context.flat.num_constraints:
        code = jnp.where((code == FINE) & ~jnp.all(jnp.isfinite(start.w)), SINGULAR, code)
    code = jnp.where(jnp.all(jnp.isfinite(e.v)), code, FINE).astype(part.met.code.dtype)

    pieces = None if part.met.pieces is None else part.met.pieces.divided(e, start, end, modes)
    met = EventState(modes, ends, code, i, pieces=pieces, over=over)
    infos = join_info(join_info(tree_where(part.divided > 0, part.info, context.no_info), info), more)
    asked = asks(context, start, end, then, over, rest) | jnp.any(due)
    passed = part.passed & near & (d1 < 0)
    new = SubStep(start, end, infos, rest, h, met, part.divided + 1, asked, passed, beside, due)
    slack = nearness(h) * h * (jnp.abs(d) + jnp.abs(d1)) + shaken(events.still, start, then, over)
    slack = slack + ROUNDINGS * eps(h) * jnp.abs(g)
    jumps = (g > slack) & (g1 < -slack) & ~near & ~(this > 0)
    jumps = jumps & ~jnp.asarray(np.asarray(events.noted) | np.asarray(events.forced))
    return flag(new, ~ends, THROWN, jumps)


# ----------------------------------------------------------------------------
# What a step across events is made of: how to step, what the run carries along, and what is left of the step.


SHORT = 1e-6  # part of a step: a rest that needs no step


class EventContext(NamedTuple):
    """How to step, and which events to look for."""

    flat: FlatSystem
    stepper: Stepper
    events: FlatEvents
    max_events: int
    no_info: Info
    reach: Callable  # of `reaching`
    keep: int = 0  # how many events are noted
    middle: Array | None = None  # of the step, where inputs are held

    def during(self, params: PyTree, t: Array, h: Array) -> EventContext:
        """The context for a step of size h from t on."""
        return self._replace(middle=t + h / 2) if zero_order_hold.holds(params) else self

    @property
    def slots(self) -> int:
        """The largest number of searches in a step. Up to max_events events divide it. Between them, each recorded
        event may happen once, and one event may only seem to touch its guard. The last search finds none."""
        return (self.max_events + 1) * (2 + sum(self.events.noted))

    def params(self, params: PyTree, modes: list):
        """The params with these modes, as they are in this step."""
        params = self.events.with_modes(params, modes)
        return params if self.middle is None else zero_order_hold.held_at(params, self.middle)


class EventState(NamedTuple):
    """The data of events that a run carries: numbers that switches changed, whether it has ended, what went wrong (code
    and event), the `Log`, the pieces of the last step if it is sampled within steps, and for each event with known
    times how many of them have passed."""

    modes: list
    ended: Array
    code: Array
    event: Array
    log: Any = None
    pieces: Any = None
    over: PyTree = ()


class SubStep(NamedTuple):
    """The remainder of a step: from `start` to `end`, of size `rest`; `last` is the step size for which start.a was
    computed.

    For each event: whether the motion has passed it, although the guard may not show it; whether it happened at the
    start, together with others; whether it must still happen there."""

    start: Any
    end: State
    info: Info
    rest: Array
    last: Array
    met: EventState
    divided: Array  # number of events that came before and divided the step
    asked: Array  # whether there may be one
    passed: Array
    beside: Array
    due: Array

    @classmethod
    def whole(
        cls,
        context: EventContext,
        start: State,
        end: State,
        info: Info,
        h: Array,
        last: Array,
        met: EventState,
        asked: Real = False,
    ):
        """A step."""
        none, no = jnp.zeros(len(context.events.noted), bool), jnp.zeros_like(met.ended)
        return cls(start, end, info, h, last, met, jnp.zeros_like(met.event), no | asked, none, none, none)


def go(context: EventContext, params: PyTree, s: State, tau: Array, last: Array, h: Array):
    """The step tau from a state, and its `Info`; a Taylor polynomial if tau is very short, 0, or negative by
    rounding."""
    return context.reach(params, s, tau, last, h)


def reaching(flat: FlatSystem, stepper: Stepper, no_info: Info):
    """The function that `go` calls; one for all places of a program, so that it is traced once."""

    @staged
    def reach(params: PyTree, s: State, tau: Array, last: Array, h: Array):
        short = tau <= SHORT * h
        s1, info = resized_step(flat, stepper, params, jnp.maximum(tau, SHORT * h), last)(s)
        return tree_where(short, drifted(flat, s, tau), s1), tree_where(short, no_info, info)

    return reach


# ----------------------------------------------------------------------------
# A step across events in its pieces, each smooth: what lies between the ends of a step is read off in one of them.


class Pieces(NamedTuple):
    """The parts of a step between its events, in their order: states (max_events + 1, ...) at which they start and end.
    Unused parts start at infinity. modes: the numbers that switches have changed, for each part, if needed."""

    start: Any
    end: Any
    modes: PyTree = ()

    @classmethod
    def none(cls, state: State, number: int, modes=()) -> Pieces:
        """Empty storage for `number` parts, for states of this form."""
        like, modes = jax.tree.map(lambda x: jnp.stack([jnp.zeros_like(x)] * number), (state, modes))
        return cls(like._replace(t=jnp.full_like(like.t, jnp.inf)), like, modes)

    def whole(self, start, end, modes=()):
        """A step without events."""

        def first(rows: Array, x: Array) -> Array:
            return jnp.concatenate([x[None], rows[1:]])

        pieces = jax.tree.map(first, self, Pieces(start, end, modes if self.modes else self.modes))
        later = jnp.full_like(pieces.start.t[1:], jnp.inf)
        return pieces._replace(start=pieces.start._replace(t=jnp.concatenate([pieces.start.t[:1], later])))

    def divided(self, event, start, end, modes=()) -> Pieces:
        """The last part ends at an event, and a new part follows."""
        new = jnp.sum(jnp.isfinite(self.start.t), dtype=jnp.int32)

        def put(rows: Array, x: Array, here: Array) -> Array:
            here = jnp.arange(len(rows), dtype=new.dtype) == here
            return jnp.where(here.reshape(-1, *[1] * x.ndim), x[None], rows)

        ends = jax.tree.map(partial(put, here=new - 1), self.end, event)
        pairs = (self.start, start), (ends, end), (self.modes, modes if self.modes else self.modes)
        return Pieces(*(jax.tree.map(partial(put, here=new), old, x) for old, x in pairs))

    def around(self, t: Array) -> Pieces:
        """The start and the end of the part that contains a time, and its modes."""
        i = jnp.maximum(jnp.sum(self.start.t <= t, dtype=jnp.int32) - 1, 0)
        return jax.tree.map(lambda rows: lax.dynamic_index_in_dim(rows, i, keepdims=False), self)


# ----------------------------------------------------------------------------
# When the first of the events in a part of a step happens.


TOGETHER = 1e-9  # part of a step: two events that are one
ON_CUBIC, IMPROVEMENTS = 10, 40  # iterations, at most
NEARLY = 1e-8  # part of a step: the next iteration would change a rounding
ROUNDINGS = 16  # of the terms of a guard, and of what it changes by in a step, that count as zero
JUDGED = 1e-3  # part of a step: of a shorter rest the next step tells whether the motion leaves the guard
ENOUGH = 1e-8  # part of a step by which Newton changes tau before its last, quadratic improvement


class Found(NamedTuple):
    """For each event: whether it happens in this part of a step; whether a jump before made it happen; its approximate
    position (0 to 1); an upper bound of the position; whether it only touches the guard; whether the motion stays
    beyond the guard, and whether the previous event caused this; whether the guard is NaN; and the size of the
    guard."""

    hit: Array
    jumped: Array
    place: Array
    limit: Array
    touches: Array
    stays: Array
    negative: Array
    unknown: Array
    size: Array


def look(context: EventContext, part: SubStep, params: PyTree, h: Array) -> Found:
    """The events in the remainder of a step, from the cubic through the guard and its rate at both ends."""
    part, params = lax.stop_gradient((part, params))
    now = context.params(params, part.met.modes)
    events, over = context.events.still, part.met.over
    (g0, d0), (g1, d1) = events.both(context.flat, part.start, part.end, now, over, part.rest)
    rounding = shaken(events, part.end, now, over) + ROUNDINGS * eps(h) * h * jnp.maximum(jnp.abs(d0), jnp.abs(d1))
    rounding = jnp.where(jnp.isfinite(rounding), rounding, 0)
    g1 = g1 - lateness(events, part.end.t)
    noted, timed, forced = (jnp.asarray(x) for x in (events.noted, events.timed, events.forced))
    rising = (d0 > 0) & (d1 > 0)
    left = rising & (g1 > -nearness(g1) * h * d1)  # behind an event g is a rounding of either sign
    negative = (part.divided > 0) & (g0 < -beside_zero(d0, h, jnp.abs(g0) + jnp.abs(g1)))
    returns = (d0 > 0) & ~rising & (~noted | (g0 > -nearness(g0) * h * d0))
    d0, d1 = d0 * part.rest, d1 * part.rest
    a, b = 3 * (g1 - g0) - 2 * d0 - d1, 2 * (g0 - g1) + d0 + d1

    def cubic(x: Array) -> Array:
        return g0 + x * (d0 + x * (a + x * b))

    turns = (d0 < 0) & (d1 > 0)
    root = jnp.sqrt(jnp.maximum(a * a - 3 * b * d0, 0))
    bottom = jnp.where(turns, -d0 / jnp.where(turns, a + root, 1), 1)  # where the cubic has its minimum
    below = turns & (cubic(bottom) < -rounding)
    turns = turns & (g0 > 0) & (g1 > 0)
    touches, lowest = turns & below, jnp.where(turns, bottom, 1)
    rests = (g0 <= rounding) & (g1 >= -rounding) & ~below & ~timed  # at its guard to rounding: the next step tells
    fresh = (part.divided == 0) & (g0 <= 0) & (g0 >= -rounding)  # at its guard, and not by an event of this step
    falls = fresh & (((d0 <= 0) & (g1 < -rounding)) | below) & ~noted
    at_once = falls | ((g0 <= 0) & (g1 <= 0) & (timed | (forced & ~noted)))
    hit = ~part.passed & (touches | ((g1 <= 0) & ((g0 > 0) | returns) & ~rests) | at_once)
    hit, lowest = jnp.where(jnp.any(part.due), part.due, hit), jnp.where(part.due | at_once, 0, lowest)

    def improve(now: tuple):
        low, high, x, _, k = now
        y, slope = cubic(x), d0 + x * (2 * a + x * 3 * b)
        low, high = jnp.where(y > 0, x, low), jnp.where(y > 0, high, x)
        new = improved(x, y, slope, low, high)
        return low, high, new, jnp.max(jnp.where(hit, jnp.abs(new - x), 0)), k + 1

    def unfinished(now: tuple) -> Array:
        *_, change, k = now
        return (change > NEARLY) & (k < ON_CUBIC)

    first = jnp.zeros_like(g0), lowest, lowest / 2, jnp.full_like(part.rest, jnp.inf), 0
    place = lax.while_loop(unfinished, improve, first)[2]
    stays = (g1 < -rounding) & (part.rest > JUDGED * h) & ~hit & ~left & ~noted
    unknown = jnp.isnan(g1) & jnp.all(jnp.isfinite(part.end.q)) & jnp.all(jnp.isfinite(part.end.v))
    place = jnp.where(hit, place, jnp.inf)
    found = Found(
        hit, at_once & hit & forced, place, lowest, touches, stays, stays & negative, unknown, jnp.abs(g0) + jnp.abs(g1)
    )
    return lax.stop_gradient(found)


def shaken(events: FlatEvents, s: State, params: PyTree, over: list) -> Array:
    """How much each guard changes if q and v change by roundings of their terms."""

    def moved(x: Array) -> Array:
        k = np.arange(x.size)
        uneven = np.where(k % 2, -1, 1) * (0.75 + 0.618034 * k % 0.5)
        return x * (1 + ROUNDINGS * eps(x) * jnp.asarray(uneven, x.dtype))

    return jnp.abs(events.guards(s._replace(q=moved(s.q), v=moved(s.v)), params, over) - events.guards(s, params, over))


def lateness(events: FlatEvents, t: Array) -> Array:
    """How much later than the end of a step an event may be, by rounding, and still belong to the step."""
    return jnp.where(jnp.asarray(events.timed), SLOP * eps(t) * jnp.abs(t), 0)


def first_time(context: EventContext, params: PyTree, part: SubStep, found: Found, h: Array):
    """The time of the first of the events, and which events happen at that time. Newton's method on all of them starts
    from the zero of the first cubic. It is kept between a time at which no guard is negative and one at which some
    guard is."""

    def unfinished(now: tuple) -> Array:
        *_, change, k = now
        return (change > ENOUGH * h) & (k < IMPROVEMENTS)

    def improve(now: tuple):
        low, high, tau, *_, k = now
        s, _ = reached(context, params, part, tau, h)
        g, d = events.rates(context.flat, s, params, part.met.over, Ldot)
        above = jnp.all((g > 0) | ~found.hit)
        low, high = jnp.where(above, tau, low), jnp.where(above, high, tau)
        times = jnp.where(d < 0, tau - g / jnp.where(d < 0, d, 1), jnp.inf)
        times = jnp.where(jnp.abs(times - high) <= nearness(h) * h, jnp.minimum(times, high), times)  # but for rounding
        within = found.hit & ((times > low) | (times == tau)) & (times <= high)
        new = jnp.min(jnp.where(within, times, jnp.inf))
        new = jnp.where(new < jnp.inf, new, (low + high) / 2)
        near = jnp.abs(times - new) <= nearness(h) * h
        return low, high, new, near, jnp.abs(new - tau), k + 1

    events = context.events.still
    Ldot = events.slope(part.start, part.end, part.rest)
    tau = jnp.clip(jnp.min(found.place), 0, 1) * part.rest
    high = jnp.min(jnp.where(found.hit, found.limit, 1)) * part.rest
    begin = jnp.zeros_like(tau), high, tau, jnp.zeros_like(found.hit), jnp.full_like(tau, jnp.inf), 0
    _, _, tau, near, *_ = lax.while_loop(unfinished, improve, begin)
    return tau, near


def first_of(events: FlatEvents, part: SubStep, found: Found, near: Array):
    """The index of the event to be handled now, and 1 for it. Of simultaneous events the recorded ones are first, so
    that they see the unchanged motion, and one that ends the run is last."""
    ranks = np.where(events.noted, 0, np.where(events.ends, 2, 1)) * len(events.noted)
    order = jnp.asarray(ranks + np.arange(ranks.size), jnp.int32)
    there = near & ~part.passed
    there = jnp.where(jnp.any(there), there, found.hit & (found.place == jnp.min(found.place)))
    there = jnp.where(jnp.any(part.due), part.due, there)
    this = there & (order == jnp.min(jnp.where(there, order, 3 * order.size)))
    numbers = jnp.arange(order.size, dtype=jnp.int32)
    return jnp.min(jnp.where(this, numbers, numbers.size)), this.astype(found.place.dtype)


def reached(context: EventContext, params: PyTree, part: SubStep, tau: Array, h: Array):
    """`go` from the start of a part. If a guard uses multipliers, these are blended from linear interpolation to the
    values of the step. The latter have order 2, but in a very short step they differ from those at the start, and a
    guard must not jump."""
    s, info = go(context, params, part.start, tau, part.last, h)
    if any(context.events.forced):
        line = part.start.L + tau * context.events.slope(part.start, part.end, part.rest)
        s = s._replace(L=line + tau / jnp.where(part.rest > 0, part.rest, 1) * (s.L - line))
    return s, info


def located(
    context: EventContext, params: PyTree, part: SubStep, this: Array, found: Found, tau: Array, h: Array
) -> Array:
    """The time of an event, with its derivative; if multipliers have jumped below zero it is the time of the start."""
    jumped = pick(this, found.jumped.astype(h.dtype)) > 0

    def guard(tau: Array):
        s, _ = reached(context, params, part, tau, h)
        g = pick(this, context.events.guards(s, params, part.met.over))
        return jnp.where(jumped, -tau, g) if any(context.events.forced) else g

    return lax.custom_root(guard, tau, lambda _, tau: tau, lambda g, y: y / g(jnp.ones_like(y)))


def improved(x: Array, y: Array, slope: Array, low: Array, high: Array) -> Array:
    """A zero by a step of Newton's method from x, if y falls there and the step stays in its bounds; else the middle of
    the bounds."""
    new = x - y / jnp.where(slope < 0, slope, 1)
    return jnp.where((slope < 0) & (new >= low) & (new <= high), new, (low + high) / 2)


def beside_zero(rate: Array, h: Array, size: Array) -> Array:
    """How far from zero a guard may be at its event, if its terms are of this size."""
    return 1e-3 * jnp.abs(rate) * h + 1e3 * eps(h) * size


def nearness(x: Real) -> float:
    """The fraction of a step within which two times count as equal."""
    return max(TOGETHER, 1e3 * eps(x))


def eps(x: Real) -> float:
    """A rounding of 1."""
    return float(jnp.finfo(x.dtype).eps)


def pick(this: Array, x: Array) -> Array:
    """The value for this event; those of others may be anything."""
    return jnp.sum(jnp.where(this > 0, x, 0))
