"""A step across events: find the first, step to it, change the velocity or the params, begin anew, go on to the end.

    0 = g(step(s, tau)),   e = step(s, tau),   v := reset(e),  params := switch(params),   s1 = step(begin(e), h - tau)

so that the grid stays what it was, and the order that of the stepper. tau is found on the cubic through g and its rate
at both ends, and made exact by Newton, on steps of size tau; its derivative is that of the implicit function.
A rest of a millionth of the step is a Taylor polynomial: skipping it would lose the derivative of tau.
"""

from functools import partial

import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.description import freeze, thaw
from hhtjax.numerics.checkpointed_scan import checkpoint
from hhtjax.numerics.seldom import choose, if_any, seldom
from hhtjax.runs.event_failures import ALONG, CORNER, FINE, MANY, NEGATIVE, NO_NUMBER, SINGULAR, STAYS, THROWN
from hhtjax.runs.event_log import row_of
from hhtjax.runs.event_parts import Met, Part, go
from hhtjax.runs.event_times import (
    ROUNDINGS,
    beside_zero,
    eps,
    first_of,
    first_time,
    lateness,
    located,
    look,
    nearness,
    pick,
    reached,
    shaken,
)
from hhtjax.steppers.stepper import entered, join_info
from hhtjax.systems import held
from hhtjax.xla import staged


def asks(ways, s, s1, params, over, h):
    """Whether an event may fall into the step from s to s1: no more than a look at both ends, in few operations."""
    (g0, d0), (g1, d1) = ways.events.still.both(ways.flat, *lax.stop_gradient((s, s1)), params, over, h)
    noted = np.asarray(ways.events.noted) & ~np.asarray(ways.events.timed)
    if any(ways.events.timed):
        g1 = g1 - lateness(ways.events, s1.t)
    below = ~(g1 > 0) & (~noted | (g0 > 0) | (d0 > 0))
    cross_below = g0 * (d1 - d0) <= d0 * (g1 - g0 - d1 * h)  # tangents at both ends; a division is dear
    return jnp.any(below | ((d0 < 0) & (d1 > 0) & cross_below))


def pass_events(ways, params, part, h):
    """The step across all events in it: a `Part`, of which end, info and met are to be used, and what to note of
    them, rows and whether each is there. Members that have not asked stay as they are. params
    are as `freeze` leaves them, here and in what this calls, and `Ways.params` thaws them."""
    ways = ways.during(params, part.start.t, h)
    if ways.middle is not None:
        known, t = ways.events.with_modes(params, part.met.modes), part.start.t
        old, new = held.before(known, t, part.last), ways.params(params, part.met.modes)
        here = held.passed(known, t, part.last, h)
        part = part._replace(start=held.jump(ways.stepper, ways.flat, part.start, old, new, h, here))

    @checkpoint  # what all slots keep for reverse mode takes longer to compile than to compute one again
    def slot(part, _):
        going = part.asked & (part.met.code == FINE) & ~part.met.ended
        return if_any(partial(meet_or_flag, ways), going, (part, unnoted(part.start)), going, h, params)

    part, noted = lax.scan(slot, part, length=ways.slots)
    part = flag(part, part.asked & ~part.met.ended, MANY, jnp.ones_like(part.passed))
    met = part.met

    def anew(s, params):
        return begin(ways, s.q, s.v, s.t, thaw(params), h, moves=False)

    now = freeze(ways.params(params, met.modes))
    end = seldom(anew, (part.divided > 0) & ~met.ended, part.end, now)

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


def meet_or_flag(ways, now, going, h, params):
    """The part behind its first event, if it has one, and what to note; with what is wrong, if something is."""
    part, noted = now
    found = look(ways, part, params, h)
    here = going & jnp.any(found.hit)
    part = flag(part, going & ~here, NEGATIVE, found.negative)
    part = flag(part, going & ~here, STAYS, found.stays)
    part = flag(part, going & ~here, NO_NUMBER, found.unknown)
    part = part._replace(asked=jnp.where(going, here, part.asked))
    return seldom(partial(meet, ways), here, (part, noted), found, h, params)


def flag(part, bad, code, which):
    """The part with what went wrong, if it did: at the first of these events."""
    met = part.met
    bad = bad & jnp.any(which) & (met.code == FINE)
    first = jnp.min(jnp.where(which, jnp.arange(which.size, dtype=met.event.dtype), which.size))
    met = met._replace(code=jnp.where(bad, code, met.code), event=jnp.where(bad, first, met.event))
    return part._replace(met=met)


def begin(ways, q, v, t, params, h, moves=True):
    """The state from which a step of size h goes at a new start; moves: whether its velocity may be another."""
    return staged(lambda q, v, t, h: entered(ways.stepper, ways.flat, q, v, t, params, h, moves=moves)[1])(q, v, t, h)


def meet(ways, now, found, h, params):
    """The part of the step behind its first event, and what to note of that."""
    part, *_ = now
    events, met = ways.events, part.met
    known = lax.stop_gradient((params, met.modes, part))
    tau, near = lax.stop_gradient(first_time(ways, ways.params(*known[:2]), known[2], found, h))
    i, this = first_of(events, part, found, near)
    now = ways.params(params, met.modes)
    tau = located(ways, now, part, this, found, tau, h)
    e, info = reached(ways, now, part, tau, h)
    Ldot = events.slope(part.start, part.end, part.rest)
    g, d = events.rates(ways.flat, e, now, met.over, Ldot)
    rate = pick(this, d)
    missed = ~(jnp.abs(pick(this, g)) <= beside_zero(rate, h, pick(this, found.size)))
    missed = missed & ~(pick(this, found.jumped.astype(h.dtype)) > 0)
    v, modes = events.outcome(i, e, now, events.with_modes(params, met.modes))
    row = row_of(e.t, i, rate, e.q, e.v, v)

    over = events.passed(i, met.over)
    again = jnp.asarray(events.timed)  # a time that is over is no longer its guard
    passed = part._replace(passed=part.passed | ((this > 0) & ~again), met=met._replace(over=over))
    new = behind(ways, part, (e, info, tau, g, d), (v, modes, over), i, this, near, h, params)
    noted, touches = (pick(this, jnp.asarray(x, h.dtype)) > 0 for x in (events.noted, found.touches))
    new = choose(noted, passed, new)  # what changes nothing divides no step
    stays, many = missed & jnp.all(jnp.isfinite(e.v)), ~noted & (part.divided == ways.max_events)
    code = jnp.where(many, MANY, jnp.where(stays, STAYS, new.met.code)).astype(met.code.dtype)
    new = new._replace(met=new.met._replace(code=code, event=jnp.where(stays | many, i, new.met.event)))
    none = missed & touches
    return choose(none, passed, new), (row, ~none & ~many)


def behind(ways, part, at, outcome, i, this, near, h, params):
    """The part of the step behind event i. at: the state and the `Info` before it, when, and g and dg/dt of all."""
    events, (e, info, tau, g, d), (v, modes, over) = ways.events, at, outcome
    then = ways.params(params, modes)
    ends = pick(this, jnp.asarray(events.ends, h.dtype)) > 0
    rest = jnp.where(ends, 0, part.rest - tau)
    start = begin(ways, e.q, v, e.t, then, h)  # whole: what is left may be far too short to tell what is stiff
    end, more = go(ways, then, start, rest, h, h)
    end = end._replace(t=jnp.where(ends, e.t, part.end.t))

    g1, d1 = events.rates(ways.flat, start, then, over, events.slope(start, end, rest))
    near_and_due = near & ~part.passed & ~jnp.asarray(events.noted)
    going_on = jnp.any(part.due)
    beside = jnp.where(going_on, part.beside, near_and_due)
    due = jnp.where(going_on, part.due, near_and_due) & ~(this > 0)
    same = (jnp.abs(d1 - d) <= nearness(h) * jnp.abs(d)) & (jnp.abs(g1 - g) <= nearness(h) * h * jnp.abs(d))
    same = same | jnp.asarray(events.timed)  # nothing changes those
    corner = jnp.any(beside & ~(this > 0) & ~same)  # in another order they might have other outcomes
    code = jnp.where(corner, CORNER, jnp.where(jnp.all(jnp.isfinite(v)), FINE, ALONG))
    if ways.flat.num_constraints:
        code = jnp.where((code == FINE) & ~jnp.all(jnp.isfinite(start.w)), SINGULAR, code)
    code = jnp.where(jnp.all(jnp.isfinite(e.v)), code, FINE).astype(part.met.code.dtype)

    pieces = None if part.met.pieces is None else part.met.pieces.divided(e, start, end, modes)
    met = Met(modes, ends, code, i, pieces=pieces, over=over)
    infos = join_info(join_info(choose(part.divided > 0, part.info, ways.no_info), info), more)
    asked = asks(ways, start, end, then, over, rest) | jnp.any(due)
    passed = part.passed & near & (d1 < 0)
    new = Part(start, end, infos, rest, h, met, part.divided + 1, asked, passed, beside, due)
    slack = nearness(h) * h * (jnp.abs(d) + jnp.abs(d1)) + shaken(events.still, start, then, over)
    slack = slack + ROUNDINGS * eps(h) * jnp.abs(g)
    jumps = (g > slack) & (g1 < -slack) & ~near & ~(this > 0)
    jumps = jumps & ~jnp.asarray(np.asarray(events.noted) | np.asarray(events.forced))
    return flag(new, ~ends, THROWN, jumps)
