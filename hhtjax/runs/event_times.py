"""When the first of the events in a part of a step happens."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.runs.event_parts import go
from hhtjax.systems.sampled import SLOP

TOGETHER = 1e-9  # part of a step: two events that are one
ON_CUBIC, IMPROVEMENTS = 10, 40  # iterations, at most
NEARLY = 1e-8  # part of a step: the next iteration would change a rounding
ROUNDINGS = 16  # of the terms of a guard, and of what it changes by in a step, that count as zero
JUDGED = 1e-3  # part of a step: of a shorter rest the next step tells whether the motion leaves the guard
ENOUGH = 1e-8  # part of a step by which Newton changes tau before its last, quadratic improvement


class Found(NamedTuple):
    """Of each event: whether it falls into the part of a step, whether by a jump before that, where about (0 to 1),
    before where, whether it only touches there, whether the motion stays beyond it, and was made to by the event
    before, whether it is no number, and how large the guard is."""

    hit: Any
    jumped: Any
    place: Any
    limit: Any
    touches: Any
    stays: Any
    negative: Any
    unknown: Any
    size: Any


def look(ways, part, params, h):
    """The events in what is left of a step, by the cubic through the guard and its rate at both ends."""
    part, params = lax.stop_gradient((part, params))
    now = ways.params(params, part.met.modes)
    events, over = ways.events.still, part.met.over
    (g0, d0), (g1, d1) = events.both(ways.flat, part.start, part.end, now, over, part.rest)
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

    def cubic(x):
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
    stays = (g1 < -rounding) & (part.rest > JUDGED * h) & ~hit & ~left & ~noted
    unknown = jnp.isnan(g1) & jnp.all(jnp.isfinite(part.end.q)) & jnp.all(jnp.isfinite(part.end.v))
    place = jnp.where(hit, place, jnp.inf)
    found = Found(
        hit, at_once & hit & forced, place, lowest, touches, stays, stays & negative, unknown, jnp.abs(g0) + jnp.abs(g1)
    )
    return lax.stop_gradient(found)


def shaken(events, s, params, over):
    """How much each guard changes where q and v do by roundings: of the size of those of its terms."""

    def moved(x):
        k = np.arange(x.size)
        uneven = np.where(k % 2, -1, 1) * (0.75 + 0.618034 * k % 0.5)
        return x * (1 + ROUNDINGS * eps(x) * jnp.asarray(uneven, x.dtype))

    return jnp.abs(events.guards(s._replace(q=moved(s.q), v=moved(s.v)), params, over) - events.guards(s, params, over))


def lateness(events, t):
    """By how much an event may come after the end of a step, by rounding, and still be one of it."""
    return jnp.where(jnp.asarray(events.timed), SLOP * eps(t) * jnp.abs(t), 0)


def first_time(ways, params, part, found, h):
    """When the first of the events happens, and which are at that time: by Newton on all of them, kept between where
    none is beyond its guard and where one is, from where the first cubic has its zero."""

    def unfinished(now):
        *_, change, k = now
        return (change > ENOUGH * h) & (k < IMPROVEMENTS)

    def improve(now):
        low, high, tau, *_, k = now
        s, _ = reached(ways, params, part, tau, h)
        g, d = events.rates(ways.flat, s, params, part.met.over, Ldot)
        above = jnp.all((g > 0) | ~found.hit)
        low, high = jnp.where(above, tau, low), jnp.where(above, high, tau)
        times = jnp.where(d < 0, tau - g / jnp.where(d < 0, d, 1), jnp.inf)
        times = jnp.where(jnp.abs(times - high) <= nearness(h) * h, jnp.minimum(times, high), times)  # but for rounding
        within = found.hit & ((times > low) | (times == tau)) & (times <= high)
        new = jnp.min(jnp.where(within, times, jnp.inf))
        new = jnp.where(new < jnp.inf, new, (low + high) / 2)
        near = jnp.abs(times - new) <= nearness(h) * h
        return low, high, new, near, jnp.abs(new - tau), k + 1

    events = ways.events.still
    Ldot = events.slope(part.start, part.end, part.rest)
    tau = jnp.clip(jnp.min(found.place), 0, 1) * part.rest
    high = jnp.min(jnp.where(found.hit, found.limit, 1)) * part.rest
    begin = jnp.zeros_like(tau), high, tau, jnp.zeros_like(found.hit), jnp.full_like(tau, jnp.inf), 0
    _, _, tau, near, *_ = lax.while_loop(unfinished, improve, begin)
    return tau, near


def first_of(events, part, found, near):
    """The number of the event to be met now, and 1 for it: of those at one time the noted ones are first, for they see
    the motion as it comes, and one that ends the run is last."""
    ranks = np.where(events.noted, 0, np.where(events.ends, 2, 1)) * len(events.noted)
    order = jnp.asarray(ranks + np.arange(ranks.size), jnp.int32)
    there = near & ~part.passed
    there = jnp.where(jnp.any(there), there, found.hit & (found.place == jnp.min(found.place)))
    there = jnp.where(jnp.any(part.due), part.due, there)
    this = there & (order == jnp.min(jnp.where(there, order, 3 * order.size)))
    numbers = jnp.arange(order.size, dtype=jnp.int32)
    return jnp.min(jnp.where(this, numbers, numbers.size)), this.astype(found.place.dtype)


def reached(ways, params, part, tau, h):
    """`go` from the start of a part. Where a guard sees multipliers they go over from a line to those of the step:
    these are of order 2, but in a very short one they are not those of the start, and a guard must not jump."""
    s, info = go(ways, params, part.start, tau, part.last, h)
    if any(ways.events.forced):
        line = part.start.L + tau * ways.events.slope(part.start, part.end, part.rest)
        s = s._replace(L=line + tau / jnp.where(part.rest > 0, part.rest, 1) * (s.L - line))
    return s, info


def located(ways, params, part, this, found, tau, h):
    """The time of an event, with its derivative; of multipliers that have jumped below zero that of the start."""
    jumped = pick(this, found.jumped.astype(h.dtype)) > 0

    def guard(tau):
        s, _ = reached(ways, params, part, tau, h)
        g = pick(this, ways.events.guards(s, params, part.met.over))
        return jnp.where(jumped, -tau, g) if any(ways.events.forced) else g

    return lax.custom_root(guard, tau, lambda _, tau: tau, lambda g, y: y / g(jnp.ones_like(y)))


def improved(x, y, slope, low, high):
    """A zero by a step of Newton's method from x, where y falls; the middle where it does not, or leaves its bounds."""
    new = x - y / jnp.where(slope < 0, slope, 1)
    return jnp.where((slope < 0) & (new >= low) & (new <= high), new, (low + high) / 2)


def beside_zero(rate, h, size):
    """How far from zero a guard may be where its event was found, of numbers of this size."""
    return 1e-3 * jnp.abs(rate) * h + 1e3 * eps(h) * size


def nearness(x):
    """The part of a step within which two times are one."""
    return max(TOGETHER, 1e3 * eps(x))


def eps(x):
    """A rounding of 1."""
    return float(jnp.finfo(x.dtype).eps)


def pick(this, x):
    """The number of this event; others may be anything."""
    return jnp.sum(jnp.where(this > 0, x, 0))
