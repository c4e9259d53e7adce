"""A step across events: find the first, step to it, change the velocity or the params, begin anew, go on to the end.

    0 = g(step(s, tau)),   e = step(s, tau),   v := reset(e),  params := switch(params),   s1 = step(begin(e), h - tau)

so that the grid stays what it was, and the order that of the stepper. tau is found on the cubic through g and its rate
at both ends, and made exact by Newton, on steps of size tau; its derivative is that of the implicit function.
A rest of a millionth of the step is a Taylor polynomial: skipping it would lose the derivative of tau.
"""

from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax

from hhtjax.description import freeze, thaw
from hhtjax.numerics.seldom import choose, if_any, seldom
from hhtjax.runs.event_failures import ALONG, CORNER, FINE, MANY, NO_NUMBER, STAYS
from hhtjax.runs.event_log import row_of
from hhtjax.runs.event_parts import Met, Part
from hhtjax.runs.loop import resized_step
from hhtjax.steppers.stepper import join_info
from hhtjax.systems import held
from hhtjax.xla import staged

SHORT, TOGETHER = 1e-6, 1e-9  # parts of a step: a rest that needs no step; two events that are one
ON_CUBIC, IMPROVEMENTS = 10, 40  # iterations, at most
NEARLY = 1e-8  # part of a step: the next iteration would change a rounding
ENOUGH = 1e-8  # part of a step by which Newton changes tau before its last, quadratic improvement


class Found(NamedTuple):
    """Of each event: whether it falls into the part of a step, where about (0 to 1), before where, whether it only
    touches there, whether the motion stays beyond it, whether it is no number, and how large the guard is."""

    hit: Any
    place: Any
    limit: Any
    touches: Any
    stays: Any
    unknown: Any
    size: Any


def asks(ways, s, s1, params, h):
    """Whether an event may fall into the step from s to s1: no more than a look at both ends, in few operations."""
    (g0, d0), (g1, d1) = (ways.events.rates(ways.flat, x, params) for x in lax.stop_gradient((s, s1)))
    noted = jnp.asarray(ways.events.noted)
    below = ~(g1 > 0) & (~noted | (g0 > 0))
    cross_below = g0 * (d1 - d0) <= d0 * (g1 - g0 - d1 * h)  # tangents at both ends; a division is dear
    return jnp.any(below | ((d0 < 0) & (d1 > 0) & cross_below))


def falls_and_rises(g0, d0, g1, d1):
    """Whether a guard that is positive at both ends may be zero between them."""
    return (g0 > 0) & (g1 > 0) & (d0 < 0) & (d1 > 0)


def pass_events(ways, params, part, h):
    """The step across all events in it: a `Part`, of which end, info and met are to be used, and what to note of
    up to max_events + 1 of them, rows and whether each is there. Members that have not asked stay as they are. params
    are as `freeze` leaves them, here and in what this calls, and `Ways.params` thaws them."""
    ways = ways.during(params, part.start.t, h)
    if ways.middle is not None:
        old = held.before(ways.events.with_modes(params, part.met.modes), part.start.t, part.last)
        new = ways.params(params, part.met.modes)
        part = part._replace(start=held.jump(ways.stepper, ways.flat, part.start, old, new))

    def slot(part, number):
        going = part.asked & (part.met.code == FINE) & ~part.met.ended
        return if_any(partial(meet_or_flag, ways), going, (part, unnoted(part.start)), going, number, h, params)

    part, noted = lax.scan(slot, part, jnp.arange(ways.max_events + 1, dtype=jnp.int32))
    met = part.met

    def anew(s, params):
        return begin(ways, s.q, s.v, s.t, thaw(params), h)

    now = freeze(ways.params(params, met.modes))
    end = seldom(anew, part.divided & ~met.ended, part.end, now)

    def known(s):
        lost = {name: jnp.where(met.code == FINE, getattr(s, name), jnp.nan) for name in ("q", "v", "w")}
        return s._replace(**lost)

    if met.pieces is not None:
        met = met._replace(pieces=met.pieces._replace(end=known(met.pieces.end)))
    return part._replace(end=known(end), met=met), noted


def unnoted(s):
    """The row of no event, and that it is not there."""
    row = row_of(s.t, jnp.zeros((), jnp.int32), s.t, s.q, s.v, s.v)
    return jnp.full_like(row, jnp.nan), jnp.array(False)


def meet_or_flag(ways, now, going, number, h, params):
    """The part behind its first event, if it has one, and what to note; with what is wrong, if something is."""
    part, noted = now
    found = look(ways, part, params, h)
    here = going & jnp.any(found.hit)
    part = flag(part, going & ~here, STAYS, found.stays)
    part = flag(part, going & ~here, NO_NUMBER, found.unknown)
    part = flag(part, here & (number == ways.max_events), MANY, found.hit & ~found.touches)
    return seldom(partial(meet, ways), here & (number < ways.max_events), (part, noted), found, h, params)


def flag(part, bad, code, which):
    """The part with what went wrong, if it did: at the first of these events."""
    met = part.met
    bad = bad & jnp.any(which) & (met.code == FINE)
    first = jnp.min(jnp.where(which, jnp.arange(which.size, dtype=met.event.dtype), which.size))
    met = met._replace(code=jnp.where(bad, code, met.code), event=jnp.where(bad, first, met.event))
    return part._replace(met=met)


def begin(ways, q, v, t, params, h):
    """The state at a new start."""
    return staged(lambda q, v, t, h: ways.stepper.begin(ways.flat, q, v, t, params, h))(q, v, t, h)


def look(ways, part, params, h):
    """The events in what is left of a step, by the cubic through the guard and its rate at both ends."""
    part, params = lax.stop_gradient((part, params))
    now = ways.params(params, part.met.modes)
    (g0, d0), (g1, d1) = (ways.events.rates(ways.flat, s, now) for s in (part.start, part.end))
    noted = jnp.asarray(ways.events.noted)
    rising = (d0 > 0) & (d1 > 0)
    left = rising & (g1 > -nearness(g1) * h * d1)  # behind an event g is a rounding of either sign
    d0, d1 = d0 * part.rest, d1 * part.rest
    a, b = 3 * (g1 - g0) - 2 * d0 - d1, 2 * (g0 - g1) + d0 + d1

    def cubic(x):
        return g0 + x * (d0 + x * (a + x * b))

    turns = falls_and_rises(g0, d0, g1, d1)
    root = jnp.sqrt(jnp.maximum(a * a - 3 * b * d0, 0))
    lowest = jnp.where(turns, -d0 / jnp.where(turns, a + root, 1), 1)  # where the cubic has its minimum
    touches = turns & (cubic(lowest) < 0)
    hit = touches | ((g1 <= 0) & ((g0 > 0) | ((d0 > 0) & ~rising & ~noted)))

    def improve(now):
        low, high, x, _, k = now
        y, slope = cubic(x), d0 + x * (2 * a + x * 3 * b)
        low, high = jnp.where(y > 0, x, low), jnp.where(y > 0, high, x)
        new = improved(x, y, slope, low, high)
        return low, high, new, jnp.max(jnp.where(hit, jnp.abs(new - x), 0)), k + 1

    def unfinished(now):
        *_, change, k = now
        return (change > NEARLY) & (k < ON_CUBIC)

    first = jnp.zeros_like(g0), lowest, lowest / 2, jnp.full_like(part.rest, jnp.inf), 0
    place = lax.while_loop(unfinished, improve, first)[2]
    stays = (g1 < 0) & ~hit & ~left & ~noted
    unknown = jnp.isnan(g1) & jnp.all(jnp.isfinite(part.end.q)) & jnp.all(jnp.isfinite(part.end.v))
    return Found(hit, jnp.where(hit, place, jnp.inf), lowest, touches, stays, unknown, jnp.abs(g0) + jnp.abs(g1))


def meet(ways, now, found, h, params):
    """The part of the step behind its first event, and what to note of that."""
    part, *_ = now
    events, flat, met = ways.events, ways.flat, part.met
    numbers = jnp.arange(found.hit.size, dtype=met.event.dtype)
    i = jnp.min(jnp.where(found.place == jnp.min(found.place), numbers, numbers.size))
    this = (numbers == i).astype(h.dtype)
    now = ways.params(params, met.modes)
    tau = locate(ways, now, part, this, found, h)
    e, info = go(ways, now, part.start, tau, part.last, h)
    before = e
    g, d = events.rates(flat, e, now)
    rate = pick(this, d)
    noise = 1e3 * float(jnp.finfo(h.dtype).eps)
    missed = ~(jnp.abs(pick(this, g)) <= 1e-3 * jnp.abs(rate) * h + noise * pick(this, found.size))

    v, modes = events.outcome(i, e.q, e.v, e.t, now, events.with_modes(params, met.modes))
    row = row_of(e.t, i, rate, e.q, e.v, v)
    noted, ends = (pick(this, jnp.asarray(x, h.dtype)) > 0 for x in (events.noted, events.ends))
    beside = ~noted & jnp.any(is_corner(g, d, h, this, events.noted))
    code = jnp.where(beside, CORNER, jnp.where(jnp.all(jnp.isfinite(v)), FINE, ALONG))
    code = jnp.where(missed, STAYS, jnp.where(jnp.all(jnp.isfinite(e.v)), code, FINE)).astype(met.code.dtype)

    then = ways.params(params, modes)
    beyond = jnp.where(noted, float(jnp.finfo(h.dtype).eps) ** 0.5 * h, 0)  # so that it is not met again
    rest = jnp.where(ends, 0, part.rest - tau - beyond)
    size = jnp.maximum(rest, SHORT * h)
    e = drifted(flat, e._replace(v=v), beyond)
    start = begin(ways, e.q, e.v, e.t, then, size)
    end, more = go(ways, then, start, rest, size, h)
    end = end._replace(t=jnp.where(ends, e.t, part.end.t))
    pieces = None if met.pieces is None else met.pieces.divided(before, start, end)
    after = Met(modes, ends, code, i, pieces=pieces)
    infos = join_info(join_info(choose(part.divided, part.info, ways.no_info), info), more)
    new = Part(start, end, infos, rest, size, after, jnp.ones_like(part.divided), asks(ways, start, end, then, rest))
    none = missed & (pick(this, found.touches.astype(h.dtype)) > 0)
    return choose(none, part, new), (row, ~none)


def go(ways, params, s, tau, last, h):
    """The step tau from a state, and its `Info`; a Taylor polynomial where tau is very short, 0 or a rounding below."""
    return ways.reach(freeze(params), s, tau, last, h)


def reaching(flat, stepper, no_info):
    """What `go` calls: one function for all places of a program, so that it is traced once."""

    @staged
    def reach(params, s, tau, last, h):
        short = tau <= SHORT * h
        s1, info = resized_step(flat, stepper, thaw(params), jnp.maximum(tau, SHORT * h), last)(s)
        return choose(short, drifted(flat, s, tau), s1), choose(short, no_info, info)

    return reach


def locate(ways, params, part, this, found, h):
    """tau, by Newton, kept between what is above and below, from where the cubic has its zero; differentiable."""

    def reached(tau):
        return go(ways, params, part.start, tau, part.last, h)[0]

    def guard(tau):
        s = reached(tau)
        return pick(this, ways.events.guards(s.q, s.v, s.t, params))

    def search(_, tau):
        def unfinished(carry):
            _, _, _, change, k = carry
            return (change > ENOUGH * h) & (k < IMPROVEMENTS)

        def improve(carry):
            low, high, tau, _, k = carry
            g, d = (pick(this, x) for x in ways.events.rates(ways.flat, reached(tau), params))
            low, high = jnp.where(g > 0, tau, low), jnp.where(g > 0, high, tau)
            new = improved(tau, g, d, low, high)
            return low, high, new, jnp.abs(new - tau), k + 1

        begin = jnp.zeros_like(tau), pick(this, found.limit) * part.rest, tau, jnp.full_like(tau, jnp.inf), 0
        return lax.while_loop(unfinished, improve, begin)[2]

    start = jnp.clip(jnp.min(found.place), 0, 1) * part.rest
    return lax.custom_root(guard, lax.stop_gradient(start), search, lambda g, y: y / g(jnp.ones_like(y)))


def improved(x, y, slope, low, high):
    """A zero by a step of Newton's method from x, where y falls; the middle where it does not, or leaves its bounds."""
    new = x - y / jnp.where(slope < 0, slope, 1)
    return jnp.where((slope < 0) & (new >= low) & (new <= high), new, (low + high) / 2)


def is_corner(g, d, h, this, noted):
    """Whether another event, of those that change something, is met at the same time."""
    return (this == 0) & ~jnp.asarray(noted) & (d < 0) & (jnp.abs(g) <= nearness(g) * h * jnp.abs(d))


def nearness(x):
    """The part of a step within which two times are one."""
    return max(TOGETHER, 1e3 * float(jnp.finfo(x.dtype).eps))


def drifted(flat, s, h):
    """The state a very short time h later."""
    s1 = s._replace(t=s.t + h, q=flat.move(s.q, h * (s.v + h / 2 * s.w)), v=s.v + h * s.w)
    return flat.tidy(s1)


def pick(this, x):
    """The number of this event; others may be anything."""
    return jnp.sum(jnp.where(this > 0, x, 0))
