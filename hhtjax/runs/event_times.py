"""When the first of the events in a part of a step happens."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.runs.event_parts import go

TOGETHER = 1e-9  # part of a step: two events that are one
ON_CUBIC, IMPROVEMENTS = 10, 40  # iterations, at most
NEARLY = 1e-8  # part of a step: the next iteration would change a rounding
ENOUGH = 1e-8  # part of a step by which Newton changes tau before its last, quadratic improvement


class Found(NamedTuple):
    """Of each event: whether it falls into the part of a step, where about (0 to 1), before where, whether it only
    touches there, whether the motion stays beyond it, and was made to by the event before, whether it is no number, and
    how large the guard is."""

    hit: Any
    place: Any
    limit: Any
    touches: Any
    stays: Any
    negative: Any
    unknown: Any
    size: Any


def falls_and_rises(g0, d0, g1, d1):
    """Whether a guard that is positive at both ends may be zero between them."""
    return (g0 > 0) & (g1 > 0) & (d0 < 0) & (d1 > 0)


def look(ways, part, params, h):
    """The events in what is left of a step, by the cubic through the guard and its rate at both ends."""
    part, params = lax.stop_gradient((part, params))
    now = ways.params(params, part.met.modes)
    (g0, d0), (g1, d1) = (ways.events.rates(ways.flat, s, now) for s in (part.start, part.end))
    noted = jnp.asarray(ways.events.noted)
    rising = (d0 > 0) & (d1 > 0)
    left = rising & (g1 > -nearness(g1) * h * d1)  # behind an event g is a rounding of either sign
    negative = (part.divided > 0) & (g0 < -beside_zero(d0, h, jnp.abs(g0) + jnp.abs(g1)))
    returns = (d0 > 0) & ~rising & (~noted | (g0 > -nearness(g0) * h * d0))
    d0, d1 = d0 * part.rest, d1 * part.rest
    a, b = 3 * (g1 - g0) - 2 * d0 - d1, 2 * (g0 - g1) + d0 + d1

    def cubic(x):
        return g0 + x * (d0 + x * (a + x * b))

    turns = falls_and_rises(g0, d0, g1, d1)
    root = jnp.sqrt(jnp.maximum(a * a - 3 * b * d0, 0))
    lowest = jnp.where(turns, -d0 / jnp.where(turns, a + root, 1), 1)  # where the cubic has its minimum
    touches = turns & (cubic(lowest) < 0)
    hit = ~part.passed & (touches | ((g1 <= 0) & ((g0 > 0) | returns)))
    hit, lowest = jnp.where(jnp.any(part.due), part.due, hit), jnp.where(part.due, 0, lowest)

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
    place = jnp.where(hit, place, jnp.inf)
    found = Found(hit, place, lowest, touches, stays, stays & negative, unknown, jnp.abs(g0) + jnp.abs(g1))
    return lax.stop_gradient(found)


def first_time(ways, params, part, found, h):
    """When the first of the events happens, and which are at that time: by Newton on all of them, kept between where
    none is beyond its guard and where one is, from where the first cubic has its zero."""

    def unfinished(now):
        *_, change, k = now
        return (change > ENOUGH * h) & (k < IMPROVEMENTS)

    def improve(now):
        low, high, tau, *_, k = now
        s, _ = go(ways, params, part.start, tau, part.last, h)
        g, d = ways.events.rates(ways.flat, s, params)
        above = jnp.all((g > 0) | ~found.hit)
        low, high = jnp.where(above, tau, low), jnp.where(above, high, tau)
        times = jnp.where(d < 0, tau - g / jnp.where(d < 0, d, 1), jnp.inf)
        times = jnp.where(jnp.abs(times - high) <= nearness(h) * h, jnp.minimum(times, high), times)  # but for rounding
        within = found.hit & ((times > low) | (times == tau)) & (times <= high)
        new = jnp.min(jnp.where(within, times, jnp.inf))
        new = jnp.where(new < jnp.inf, new, (low + high) / 2)
        near = jnp.abs(times - new) <= nearness(h) * h
        return low, high, new, near, jnp.abs(new - tau), k + 1

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


def located(ways, params, part, this, tau, h):
    """The time of an event, with its derivative."""

    def guard(tau):
        s, _ = go(ways, params, part.start, tau, part.last, h)
        return pick(this, ways.events.guards(s.q, s.v, s.t, params))

    return lax.custom_root(guard, tau, lambda _, tau: tau, lambda g, y: y / g(jnp.ones_like(y)))


def improved(x, y, slope, low, high):
    """A zero by a step of Newton's method from x, where y falls; the middle where it does not, or leaves its bounds."""
    new = x - y / jnp.where(slope < 0, slope, 1)
    return jnp.where((slope < 0) & (new >= low) & (new <= high), new, (low + high) / 2)


def beside_zero(rate, h, size):
    """How far from zero a guard may be where its event was found, of numbers of this size."""
    return 1e-3 * jnp.abs(rate) * h + 1e3 * float(jnp.finfo(h.dtype).eps) * size


def nearness(x):
    """The part of a step within which two times are one."""
    return max(TOGETHER, 1e3 * float(jnp.finfo(x.dtype).eps))


def pick(this, x):
    """The number of this event; others may be anything."""
    return jnp.sum(jnp.where(this > 0, x, 0))
