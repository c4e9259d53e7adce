"""A step across events: find the first, step to it, change the velocity or the params, begin anew, go on to the end.

    0 = g(step(s, tau)),    e = step(s, tau),    v := reset(e),  params := switch(params),    s1 = step(begin(e), h - tau)

so that the grid stays what it was, and the order that of the stepper. tau is found on the cubic through g and its rate
at both ends, and made exact by two Newton steps on steps of size tau; its derivative is that of the implicit function.
A rest of a millionth of the step is a Taylor polynomial: skipping it would lose the derivative of tau.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from hhtjax.runs.loop import resized_step
from hhtjax.steppers.stepper import join_info
from hhtjax.systems import held

FINE, MANY, STAYS, ALONG, CORNER = range(5)  # what may be wrong, see `solution.EVENTS`
SHORT, TOGETHER = 1e-6, 1e-9  # parts of a step: a rest that needs no step; two events that are one
HALVINGS, IMPROVEMENTS = 52, 2


class Ways(NamedTuple):
    """How to step, and what to look for."""

    flat: Any
    stepper: Any
    events: Any
    max_events: int
    no_info: Any


class Log(NamedTuple):
    """The first events of a run, on vectors; see `Events`."""

    count: Any
    t: Any
    which: Any
    before: Any
    after: Any
    rate: Any

    def added(self, *entry):
        """The log with one event more, as long as there is room."""
        here = jnp.arange(self.t.size) == self.count
        rows = [jnp.where(here if x.ndim == 1 else here[:, None], y, x) for x, y in zip(self[1:], entry, strict=True)]
        return Log(self.count + 1, *rows)


class Met(NamedTuple):
    """What a run with events carries along: numbers that switches changed, whether it has ended, what went wrong (code
    and event), and the log."""

    modes: list
    ended: Any
    code: Any
    event: Any
    log: Log


class Part(NamedTuple):
    """What is left of a step: from `start` to `end`, of the size `rest`; `last` is the size that start.a is made for."""

    start: Any
    end: Any
    info: Any
    rest: Any
    last: Any
    met: Met
    divided: Any  # whether an event came before


class Found(NamedTuple):
    """Of each event: whether it falls into the part of a step, where about (0 to 1), whether it only touches there, and
    whether it lies beyond from start to end."""

    hit: Any
    place: Any
    touches: Any
    stays: Any
    size: Any  # of the guard


def asks(ways, s, s1, params, h):
    """Whether an event may fall into the step from s to s1: no more than a look at both ends."""
    (g0, d0), (g1, d1) = (ways.events.rates(ways.flat, x, params) for x in (s, s1))
    noted = jnp.asarray(ways.events.noted)
    below = (g1 <= 0) & (~noted | (g0 > 0))
    turns = (g0 > 0) & (g1 > 0) & (d0 < 0) & (d1 > 0)
    crossing = (g1 - g0 - d1 * h) / jnp.where(turns, d0 - d1, 1)  # of the tangents at both ends
    return jnp.any(below | (turns & (g0 + d0 * crossing <= 0)))


def pass_events(ways, params, carry):
    """The step across all events in it: (Part, h) -> (Part, h), of the first nothing but end, info and met to be used."""
    part, h = carry
    if held.holds(params):
        old = held.before(params, part.start.t, part.last)
        params = held.held_at(params, part.start.t + h / 2)
        part = part._replace(start=held.jump(ways.stepper, ways.flat, part.start, old, params))

    def slot(part, _):
        found = look(ways, part, params)
        go_on = jnp.any(found.hit) & (part.met.code == FINE) & ~part.met.ended
        return lax.cond(go_on, partial(meet, ways, params, h), lambda part, _: part, part, found), None

    part, _ = lax.scan(slot, part, None, length=ways.max_events)
    found, met = look(ways, part, params), part.met
    left = found.hit & ~found.touches
    bad = (left | found.stays) & (met.code == FINE) & ~met.ended
    code = jnp.where(jnp.any(left), MANY, STAYS).astype(met.code.dtype)
    first = jnp.min(jnp.where(bad, jnp.arange(bad.size), bad.size)).astype(met.event.dtype)
    flawed = jnp.any(bad)
    met = met._replace(code=jnp.where(flawed, code, met.code), event=jnp.where(flawed, first, met.event))

    def anew(part):
        s = part.end
        return begin(ways, s.q, s.v, s.t, ways.events.with_modes(params, part.met.modes), h)

    end = lax.cond(part.divided & ~met.ended, anew, lambda part: part.end, part)
    lost = jnp.where(met.code == FINE, 0, jnp.nan)
    end = end._replace(**{name: getattr(end, name) + lost.astype(end.v.dtype) for name in ("q", "v", "w")})
    return part._replace(end=end, met=met), h


def begin(ways, q, v, t, params, h):
    """The state at a new start."""
    return ways.stepper.begin(ways.flat, q, v, t, params, h)


def look(ways, part, params):
    """The events in what is left of a step, by the cubic through the guard and its rate at both ends."""
    now = ways.events.with_modes(params, part.met.modes)
    (g0, d0), (g1, d1) = (ways.events.rates(ways.flat, s, now) for s in (part.start, part.end))
    noted = jnp.asarray(ways.events.noted)
    d0, d1 = d0 * part.rest, d1 * part.rest
    a, b = 3 * (g1 - g0) - 2 * d0 - d1, 2 * (g0 - g1) + d0 + d1

    def cubic(x):
        return g0 + x * (d0 + x * (a + x * b))

    turns = (g0 > 0) & (g1 > 0) & (d0 < 0) & (d1 > 0)
    root = jnp.sqrt(jnp.maximum(a * a - 3 * b * d0, 0))
    lowest = jnp.where(turns, -d0 / jnp.where(turns, a + root, 1), 1)  # where the cubic has its minimum
    touches = turns & (cubic(lowest) < 0)
    hit = touches | ((g1 <= 0) & ((g0 > 0) | ((d0 > 0) & ~noted)))

    def halve(_, ends):
        low, high = ends
        middle = (low + high) / 2
        above = cubic(middle) > 0
        return jnp.where(above, middle, low), jnp.where(above, high, middle)

    _, place = lax.fori_loop(0, HALVINGS, halve, (jnp.zeros_like(g0), lowest))
    stays = (g1 < 0) & ~hit & ~noted
    return Found(hit, jnp.where(hit, place, jnp.inf), touches, stays, jnp.abs(g0) + jnp.abs(g1))


def meet(ways, params, h, part, found):
    """The part of the step behind its first event."""
    events, flat, met = ways.events, ways.flat, part.met
    numbers = jnp.arange(found.hit.size, dtype=met.event.dtype)
    i = jnp.min(jnp.where(found.place == jnp.min(found.place), numbers, numbers.size))
    this = (numbers == i).astype(h.dtype)
    now = events.with_modes(params, met.modes)
    tau = locate(ways, now, part, this, lax.stop_gradient(jnp.min(found.place)))
    e, info = resized_step(flat, ways.stepper, now, tau, part.last)(part.start)
    g, d = events.rates(flat, e, now)
    rate = pick(this, d)
    noise = 1e3 * float(jnp.finfo(h.dtype).eps)
    missed = ~(jnp.abs(pick(this, g)) <= 1e-3 * jnp.abs(rate) * h + noise * pick(this, found.size))

    v, modes = events.outcome(i, e.q, e.v, e.t, now)
    log = met.log.added(e.t, i, told(flat, e.v), told(flat, v), rate)
    noted, ends = (pick(this, jnp.asarray(x, h.dtype)) > 0 for x in (events.noted, events.ends))
    beside = ~noted & jnp.any(is_corner(g, d, h, this, events.noted))
    code = jnp.where(beside, CORNER, jnp.where(jnp.all(jnp.isfinite(v)), FINE, ALONG))
    code = jnp.where(missed, STAYS, jnp.where(jnp.all(jnp.isfinite(e.v)), code, FINE)).astype(met.code.dtype)
    after = Met(modes, ends, code, i, log)

    then = events.with_modes(params, modes)
    beyond = jnp.where(noted, float(jnp.finfo(h.dtype).eps) ** 0.5 * h, 0)  # so that it is not met again
    rest = jnp.where(ends, 0, part.rest - tau - beyond)
    size = jnp.maximum(rest, SHORT * h)
    q, v, _ = taylor(flat, e._replace(v=v), beyond)
    start = begin(ways, q, v, e.t + beyond, then, size)
    end, more = resized_step(flat, ways.stepper, then, size, size)(start)
    q, v, _ = taylor(flat, start, rest)
    end = choose(rest <= SHORT * h, flat.tidy(start._replace(q=q, v=v)), end)
    end = end._replace(t=jnp.where(ends, e.t, part.end.t))
    infos = join_info(choose(part.divided, part.info, ways.no_info), info)
    infos = join_info(infos, choose(rest <= SHORT * h, ways.no_info, more))
    new = Part(start, end, infos, rest, size, after, jnp.ones_like(part.divided))
    return choose(missed & (pick(this, found.touches.astype(h.dtype)) > 0), part, new)


def locate(ways, params, part, this, place):
    """tau, by Newton from where the cubic has its zero; differentiable as the implicit function of all else."""

    def reached(tau):
        return resized_step(ways.flat, ways.stepper, params, tau, part.last)(part.start)[0]

    def guard(tau):
        s = reached(tau)
        return pick(this, ways.events.guards(s.q, s.v, s.t, params))

    def search(_, tau):
        def improve(_, tau):
            g, d = ways.events.rates(ways.flat, reached(tau), params)
            g, d = pick(this, g), pick(this, d)
            return jnp.clip(tau - jnp.where(d < 0, g / d, 0), TOGETHER * part.rest, part.rest)

        return lax.fori_loop(0, IMPROVEMENTS, improve, tau)

    start = jnp.clip(place, TOGETHER, 1) * lax.stop_gradient(part.rest)
    return lax.custom_root(guard, start, search, lambda g, y: y / g(jnp.ones_like(y)))


def is_corner(g, d, h, this, noted):
    """Whether another event, of those that change something, is met at the same time."""
    near = max(TOGETHER, 8 * float(jnp.finfo(h.dtype).eps))
    return (this == 0) & ~jnp.asarray(noted) & (d < 0) & (jnp.abs(g) <= near * h * jnp.abs(d))


def taylor(flat, s, h):
    """q, v, t a very short time h later."""
    return flat.move(s.q, h * (s.v + h / 2 * s.w)), s.v + h * s.w, s.t + h


def told(flat, v):
    """What a user knows as v; of a first-order system as y."""
    return flat.located(v) if flat.positions else v


def pick(this, x):
    """The number of this event; others may be anything."""
    return jnp.sum(jnp.where(this > 0, x, 0))


def choose(where, x, y):
    """One of two trees."""
    return jax.tree.map(partial(jnp.where, where), x, y)


