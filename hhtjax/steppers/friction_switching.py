"""The switches of several joints with dry friction within a step: from event to event, as each switch accelerates
others.

Between events the sliding velocities are linear in time. p is the difference of the friction from that of the step in
which no joint switches. It is known for sliding joints; for joints at rest it keeps the velocity at 0,

    ds/dtheta = c - Wh p,    p = (sig f - base) where sliding,    (c - Wh p) = 0 where at rest,    theta = (t - t0)/h.

Events: a sliding joint comes to rest, or the load of a joint at rest exceeds its limit and it starts to slide. The
first joint to do so switches; of several at the same time, the first of them, until none is left (Murty 1974: finite,
as K is positive). No small number bounds how many switches this takes, so values come from a loop that ends with the
step. Derivatives need a fixed number, but only of the pieces between instants, however many joints switch at one
instant.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from hhtjax.description import Array, Real
from hhtjax.numerics.batched_cond import call_where, tree_where
from hhtjax.numerics.dense_lu import diagonal, matvec
from hhtjax.systems.friction import ROUNDING, solve_some, solver_of_some
from hhtjax.systems.friction_rows import leaves_box, slides_in_box, slight

EVENTS = 64  # per joint and step: none needs so many, but without an end are those of a K that is not positive
PIECES = 4, 2  # and per joint, of a step that is differentiated; of 100 000 violent ones about one needs more


class Moment(NamedTuple):
    """Within a step: time since its start over h, sliding velocities, directions, distances over h, which joints kept
    their state."""

    theta: Array
    s: Any
    sig: Array
    slid: Array
    kept: Array


class Steady(NamedTuple):
    """A step without switches: its ds/dtheta, and its friction, base = start + theta rise; limits; and Wh."""

    c: Array
    start: Any
    rise: Array
    f: Any
    Wh: Array


def run_events(sf: Array, s: Array, sig: Array, tau: Array, f: Array, W: Array, Wh: Array):
    """The state of joints at the end of a step that start with s and, unless they stick, would end with sf; and the
    fraction of the step that is left if there were too many events. W: decrease of sf per unit of friction; Wh:
    decrease of s in a time h."""
    smooth = f == 0  # where nothing rubs, nothing switches
    stuck = (sig == 0) & ~smooth
    held = solve_some(W, stuck, sf)
    still = sf - matvec(W, held)
    start, rise = jnp.where(stuck, tau, sig * f), jnp.where(stuck, held - tau, 0)
    begin = Moment(jnp.zeros((), s.dtype), jnp.where(stuck, 0, s), sig, jnp.zeros_like(s), ~stuck)
    end = _to_the_end(begin, Steady(jnp.where(stuck, 0, still - s), start, rise, f, Wh))
    s1 = jnp.where(end.kept, still, end.s)
    dtau = solve_some(W, ~end.kept, sf - s1)
    to = jnp.where(smooth, jnp.sign(sf - matvec(W, dtau)), end.sig)
    return Switch(s1, to, dtau, end.slid, end.kept), 1 - end.theta


@jax.custom_jvp
def _to_the_end(at: Moment, steady: Steady) -> Moment:
    """The end of the step, with as many events as occur."""

    def unfinished(carry: tuple) -> Array:
        at, i = carry
        return (at.theta < 1) & (i < EVENTS * len(at.s))

    return lax.while_loop(unfinished, lambda x: (_event(x[0], steady), x[1] + 1), (at, 0))[0]


@_to_the_end.defjvp
def _(primals: tuple, tangents: tuple):
    return jax.jvp(_by_pieces, primals, tangents)


def _by_pieces(at: Moment, steady: Steady) -> Moment:
    """As above in a fixed number of pieces, for reverse mode."""

    def piece(at: Moment, steady: Steady) -> Moment:
        return _event(_settled(at, steady), steady)

    def visit(at: Moment, _):  # a `lax.cond` cannot be transposed in a batch, as this is the rule of a derivative
        return call_where(piece, at.theta < 1, at, steady), None

    return lax.scan(visit, at, length=PIECES[0] + PIECES[1] * len(at.s))[0]


def _settled(at: Moment, steady: Steady) -> Moment:
    """Handles the events at the present instant; joints that switch have s = 0, also in derivatives."""
    sig, keeps = _switching(*lax.stop_gradient((at, steady)))
    return at._replace(s=jnp.where(keeps, at.s, 0), sig=sig, kept=at.kept & keeps)


def _switching(at: Moment, steady: Steady):
    """Directions after the events at the present instant, and which joints keep their state."""

    def unfinished(carry: tuple) -> Array:
        _, more, i = carry
        return more & (i < EVENTS * len(at.s))

    def visit(carry: tuple):
        at, _, i = carry
        wait, *rest = _next(at, steady)
        due = jnp.min(wait) <= 0
        after = _on(at, wait, *rest)
        return tree_where(due, after, at), due & (after.theta < 1), i + 1

    begin = at._replace(kept=jnp.ones_like(at.kept))
    end, *_ = lax.while_loop(unfinished, visit, (begin, at.theta < 1, 0))
    return end.sig, end.kept


def _event(at: Moment, steady: Steady) -> Moment:
    """Advances to the next event, and handles it; or to the end of the step."""
    return _on(at, *_next(at, steady))


def _on(at: Moment, wait: Array, to: Array, speed: Array) -> Moment:
    first, rest = jnp.argmin(wait), 1 - at.theta
    due = wait[first] < rest
    go = jnp.where(due, wait[first], rest)
    who = due & (jnp.arange(len(wait)) == first)
    s = at.s + go * speed
    slid = at.slid + go * (at.s + s) / 2
    theta = jnp.where(due, at.theta + go, 1)
    return Moment(theta, jnp.where(who, 0, s), jnp.where(who, to, at.sig), slid, at.kept & ~who)


def _next(at: Moment, steady: Steady):
    """The time until each joint switches, its new direction, and ds/dtheta until then."""
    f, smooth = steady.f, steady.f == 0
    rests = (at.sig == 0) & ~smooth
    rate, load = _motion(at.sig, rests, steady)
    middle = (1 + at.theta) / 2
    speed = rate(middle)
    stops = ~rests & ~smooth & (at.sig * speed < 0)
    until_rest = jnp.maximum(-at.s / jnp.where(stops, speed, 1), 0)

    now, end = load(at.theta), load(1.0)
    d = jnp.sign(end)
    beyond = d * now >= f
    most = f + ROUNDING * float(jnp.finfo(f.dtype).eps) * jnp.max(f)  # else it could stop and break away for ever
    breaks = rests & jnp.where(beyond, d * load(middle) > most, d * end > most)
    grows = breaks & ~beyond
    crossed = (1 - at.theta) * (f - d * now) / jnp.where(grows, d * (end - now), 1)
    wait = jnp.where(stops, until_rest, jnp.where(breaks, jnp.where(grows, crossed, 0), jnp.inf))
    return wait, jnp.where(rests, d, 0), speed


def _motion(sig: Array, rests: Array, steady: Steady):
    """ds/dtheta and the friction as functions of theta, with these directions; both are linear."""
    c, start, rise, f, Wh = steady
    p = [jnp.where(rests, 0, sig * f - start), jnp.where(rests, 0, -rise)]
    hold = solver_of_some(Wh, rests)
    p = [x + hold(y - matvec(Wh, x)) for x, y in zip(p, (c, jnp.zeros_like(c)), strict=True)]

    def rate(theta: Array) -> Array:
        return jnp.where(rests, 0, c - matvec(Wh, p[0] + theta * p[1]))

    return rate, lambda theta: start + p[0] + theta * (rise + p[1])


# ----------------------------------------------------------------------------
# What dry friction does within one step, on the sliding velocities alone.
#
# A joint goes into the step with the velocity s and would come out of it with b, if it kept its friction. It may
#
#     keep it:        sig b >= 0
#     stop:           at theta h, theta = s/(s - b), where b crosses zero, and stay
#     reverse:        go on from there with the acceleration of the other branch, D/h: s1 = (1 - theta) D
#     hold:           stick, if the force that holds it, b/W, is no larger than the limit f
#     break away:     at theta h, where the load has grown to f; then s1 = (1 - theta) (b - W f)


DEPENDENT = 2.0  # `Info.friction` where rows that are taken to be independent are not
SETTLED = 1e-9  # change of friction over its limit that passes; 1000 roundings in float32


class Switch(NamedTuple):
    """The state of joints at the end of a step: sliding velocity s, direction, change of friction tau, the distance
    slid over h, and whether they kept their friction."""

    s: Any
    sig: Array
    tau: Array
    slid: Array
    kept: Array


def switch(b: Array, s: Array, sig: Array, tau: Array, f: Array, W: Array, Wh: Array) -> Switch:
    """Each joint separately, elementwise. W: decrease of b per unit of friction; Wh: decrease of s in a time h."""
    slides, smooth = sig != 0, f == 0  # where nothing rubs, nothing switches
    keeps = slides & (sig * b >= 0) | smooth
    D = b - s + 2 * sig * f * Wh
    reverses = sig * D < 0
    ratio = s / jnp.where(slides & ~keeps, s - b, 1)
    theta_slid = jnp.clip(jnp.where(slides & ~keeps, ratio, 1), 0, 1)
    s_slid = jnp.where(keeps, b, jnp.where(reverses, (1 - theta_slid) * D, 0))

    load = b / jnp.where(W == 0, 1, W)
    d = jnp.sign(load)
    holds = jnp.abs(load) <= f
    breaks = ~slides & ~holds & ~smooth
    rise = d * (load - tau)
    crossed = (f - d * tau) / jnp.where(breaks & (rise > 0), rise, 1)
    theta_stuck = jnp.where(breaks & (rise > 0), jnp.clip(crossed, 0, 1), 0)
    s_stuck = jnp.where(breaks, (1 - theta_stuck) * (b - W * d * f), 0)

    s1 = jnp.where(keeps, b, jnp.where(slides, s_slid, s_stuck))
    new = jnp.where(slides, jnp.where(reverses, -sig, 0), jnp.where(holds, 0, d))
    new = jnp.where(keeps, jnp.where(smooth, jnp.sign(b), sig), new)
    slid = jnp.where(slides, (theta_slid * s + (1 - theta_slid) * s1) / 2, (1 - theta_stuck) * s1 / 3)
    return Switch(s1, new, jnp.where(keeps, 0, (b - s1) / jnp.where(W == 0, 1, W)), slid, keeps)


def is_settled(left: Array) -> Array:
    """Whether this fraction of a step may be left."""
    return left <= max(SETTLED, 1e3 * float(jnp.finfo(left.dtype).eps))


# ----------------------------------------------------------------------------
# What the dry friction of joints does within a step where their directions may depend on each other.
#
# As above, sliding velocities go linearly between events, in directions that the rows of a basis have
# (friction_rows.py):
#
#     ds/dtheta = c - Wh (phi - base),    phi = sig f where sliding,    theta = (t - t0)/h
#
# An event is that a joint which slides comes to rest; all that come to rest with it do so at once, as those of one
# freedom. Who rests then, and who slides on, is the box problem of all joints at rest, with their mean loads in the
# rest of the step. Another event is that loads which grow leave what joints at rest can hold.


BEYOND = 2.0  # theta of a step that is done


class Course(NamedTuple):
    """A step without switches: its ds/dtheta, and its friction, base = start + theta rise; limits; the rows; the effect
    of a unit of force on velocities in the step, and what counts as rounding of it; and the size of the terms of c."""

    c: Array
    start: Any
    rise: Array
    f: Any
    rows: Any
    Wh: Array
    least: Array
    size: Array


def run_pieces(sf: Array, s: Array, sig: Array, tau: Array, f: Array, W: Array, rows, h: Array, driven: Array):
    """The state of joints at the end of a step that start with s and, unless they stick, would end with sf; the
    fraction of the step that is left if there were too many events; and the forces that would hold sticking joints if
    no joint switched. Distances are relative to those of that step. W: decrease of sf per unit of friction; driven:
    where a part of s is prescribed."""
    smooth = f == 0  # where nothing rubs, nothing switches
    stuck, basis = (sig == 0) & ~smooth, rows.basis
    held = rows.solve(W, stuck, sf)
    still = sf - matvec(W, held)

    def of_basis(x: Array) -> Array:
        return matvec(rows.C.T, jnp.where(basis, x, 0))

    moving = jnp.where(stuck, 0, s)
    ends = [jnp.where(driven, x - of_basis(x), 0) for x in (moving, still)]
    s0 = jnp.where(stuck, 0, of_basis(moving) + ends[0])
    c = of_basis(jnp.where(stuck, 0, still - s)) + ends[1] - ends[0]
    size = (
        jnp.abs(ends[0]) + jnp.abs(ends[1]) + matvec(jnp.abs(rows.C.T), jnp.where(basis, jnp.abs(sf) + jnp.abs(s), 0))
    )
    turned = ~stuck & ~smooth & (sig * s0 < -slight(s.dtype) * size)  # as its direction did, within the step
    start, rise = jnp.where(stuck, tau, sig * f), jnp.where(stuck, held - tau, 0)
    course = Course(c, start, rise, f, rows, h * rows.K, h * rows.least, lax.stop_gradient(size))
    begin = Moment(jnp.zeros((), s.dtype), s0, jnp.where(turned, -sig, sig), jnp.zeros_like(s), ~stuck & ~turned)
    end = _dependent_to_the_end(begin, course)
    dtau = rows.solve(W, rows.carriers(~end.kept), sf - end.s)
    to = jnp.where(smooth, jnp.sign(sf - matvec(W, dtau)), end.sig)
    return Switch(end.s, to, dtau, end.slid - s0 - c / 2, end.kept), jnp.maximum(1 - end.theta, 0), held


@jax.custom_jvp
def _dependent_to_the_end(at: Moment, course: Course) -> Moment:
    """The end of the step, with as many events as occur."""

    def unfinished(carry: tuple) -> Array:
        at, i = carry
        return (at.theta < BEYOND) & (i < EVENTS * len(at.s))

    return lax.while_loop(unfinished, lambda x: (_piece(x[0], course), x[1] + 1), (at, 0))[0]


@_dependent_to_the_end.defjvp
def _(primals, tangents):
    return jax.jvp(_dependent_by_pieces, primals, tangents)


def _dependent_by_pieces(at, course):
    """As above in a fixed number of pieces, for reverse mode."""

    def visit(at, _):  # a `lax.cond` cannot be transposed in a batch, as this is the rule of a derivative
        return call_where(_piece, at.theta < BEYOND, at, course), None

    return lax.scan(visit, at, length=PIECES[0] + PIECES[1] * len(at.s))[0]


def _piece(at: Moment, course: Course) -> Moment:
    """Advances to the next joints that come to rest or start to slide, or to the end of the step."""
    f, smooth, rest = course.f, course.f == 0, 1 - at.theta
    middle = (1 + at.theta) / 2
    sig, until, breaks = _directions(at, course, middle)
    rests = (sig == 0) & ~smooth
    speed = _speed(sig, rests, course, middle)
    stops = ~rests & ~smooth & (sig * speed < 0)
    wait = jnp.where(stops, jnp.maximum(-at.s / jnp.where(stops, speed, 1), 0), jnp.inf)
    first = jnp.minimum(wait[jnp.argmin(wait)], until)
    due = first < rest
    go = jnp.where(due, first, rest)
    soon = go + slight(f.dtype)
    who = due & (wait <= soon)
    s = at.s + go * speed
    slid = at.slid + go * (at.s + s) / 2
    theta = jnp.where(due, at.theta + go, jnp.where(at.theta < 1, 1.0, BEYOND))
    to = jnp.where(who, 0, jnp.where(due & (until <= soon), breaks, sig))
    return Moment(theta, jnp.where(who | rests, 0, s), to, slid, at.kept & ~who)


def _change(sig: Array, rests: Array, course: Course, theta: Real) -> Array:
    """phi - base where it is known, 0 for friction at rest."""
    return jnp.where(rests, 0, sig * course.f) - (course.start + theta * course.rise)


def _load(sig: Array, rests: Array, course: Course, theta: Real) -> Array:
    """ds/dtheta if nothing holds joints at rest."""
    return course.c - matvec(course.Wh, _change(sig, rests, course, theta))


def _directions(at: Moment, course: Course, middle: Array):
    """Which joints slide, and in which direction; how long joints at rest are held; and which of them slide then, and
    in which direction.

    Joints that the loads of the whole rest of the step leave at rest are held until the loads exceed the limits. Joints
    whose loads exceed the limits already slide at once, if their mean loads do too."""
    sig, rests = at.sig, (at.sig == 0) & (course.f != 0)
    known, there = lax.stop_gradient((course, at.theta))
    load = _load(sig, rests, known, lax.stop_gradient(middle))
    now, _ = slides_in_box(known.Wh, known.least, rests, load, known.f, known.size)
    loads = [_load(sig, rests, course, x) for x in (0.0, 1.0)]
    time, leave = leaves_box(course.Wh, known.least, rests, loads, course.f, known.size)
    until = time - at.theta
    grows = lax.stop_gradient(time) > there + slight(time.dtype)
    fixed = rests & (diagonal(known.Wh) <= known.least)  # whose motion is prescribed
    sig = jnp.where(rests & (fixed | ~grows), now, sig)
    return sig, jnp.where(grows, until, jnp.inf), jnp.where(rests & (leave != 0), leave, sig)


def _speed(sig: Array, rests: Array, course: Course, theta: Array) -> Array:
    """ds/dtheta with these directions, with joints at rest held."""
    change = _change(sig, rests, course, theta)
    change = change + course.rows.solve(course.Wh, rests, course.c - matvec(course.Wh, change))
    return jnp.where(rests, 0, course.c - matvec(course.Wh, change))
