"""What the dry friction of joints does within a step where their directions may depend on each other.

As in friction_events.py sliding velocities go linearly between events, in directions that the rows of a basis have
(friction_rows.py):

    ds/dtheta = c - Wh (phi - base),    phi = sig f where sliding,    theta = (t - t0)/h

An event is that a joint which slides comes to rest; all that come to rest with it do so at once, as those of one
freedom. Who rests then, and who slides on, is the box problem of all joints at rest, with their mean loads in the
rest of the step. Another event is that loads which grow leave what joints at rest can hold.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from hhtjax.numerics.elimination import diagonal, matvec
from hhtjax.numerics.seldom import seldom
from hhtjax.steppers.friction_events import EVENTS, PIECES, Moment
from hhtjax.steppers.friction_law import Switch
from hhtjax.systems.friction_rows import leaves_box, slides_in_box, slight

BEYOND = 2.0  # theta of a step that is done


class Course(NamedTuple):
    """A step in which nobody switches: its ds/dtheta, and its friction, base = start + theta rise; limits; the rows,
    what a unit of force does to velocities in the step, what is rounding of that, and how large the terms of c are."""

    c: Any
    start: Any
    rise: Any
    f: Any
    rows: Any
    Wh: Any
    least: Any
    size: Any


def run_pieces(sf, s, sig, tau, f, W, rows, h, driven):
    """How joints come out of a step that start with s and, unless they stick, would come out with sf; what part of the
    step is left where the events were too many; and what would hold joints that stick if nobody switched. Distances are
    those beyond the ones of that step. W: fall of sf by units of friction; driven: where a part of s
    is prescribed."""
    smooth = f == 0  # where nothing rubs, nothing switches
    stuck, basis = (sig == 0) & ~smooth, rows.basis
    held = rows.solve(W, stuck, sf)
    still = sf - matvec(W, held)

    def of_basis(x):
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
    end = _to_the_end(begin, course)
    dtau = rows.solve(W, rows.carriers(~end.kept), sf - end.s)
    to = jnp.where(smooth, jnp.sign(sf - matvec(W, dtau)), end.sig)
    return Switch(end.s, to, dtau, end.slid - s0 - c / 2, end.kept), jnp.maximum(1 - end.theta, 0), held


@jax.custom_jvp
def _to_the_end(at, course):
    """The end of the step, by as many events as there are."""

    def unfinished(carry):
        at, i = carry
        return (at.theta < BEYOND) & (i < EVENTS * len(at.s))

    return lax.while_loop(unfinished, lambda x: (_piece(x[0], course), x[1] + 1), (at, 0))[0]


@_to_the_end.defjvp
def _(primals, tangents):
    return jax.jvp(_by_pieces, primals, tangents)


def _by_pieces(at, course):
    """The same in a fixed number of pieces, for reverse mode."""

    def visit(at, _):  # a `lax.cond` cannot be transposed in a batch, as this is the rule of a derivative
        return seldom(_piece, at.theta < BEYOND, at, course), None

    return lax.scan(visit, at, length=PIECES[0] + PIECES[1] * len(at.s))[0]


def _piece(at, course):
    """On to the next joints that come to rest or break away, or to the end of the step."""
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


def _change(sig, rests, course, theta):
    """phi - base where that is known, 0 for friction at rest."""
    return jnp.where(rests, 0, sig * course.f) - (course.start + theta * course.rise)


def _load(sig, rests, course, theta):
    """ds/dtheta where nothing holds joints at rest."""
    return course.c - matvec(course.Wh, _change(sig, rests, course, theta))


def _directions(at, course, middle):
    """Who slides, and where to; how long joints at rest are held; and who slides then, and where to.

    What the loads of the whole rest of the step leave at rest is held until they have grown beyond the limits. What
    they are beyond already slides at once, if their means are."""
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


def _speed(sig, rests, course, theta):
    """ds/dtheta with these directions, what rests being held."""
    change = _change(sig, rests, course, theta)
    change = change + course.rows.solve(course.Wh, rests, course.c - matvec(course.Wh, change))
    return jnp.where(rests, 0, course.c - matvec(course.Wh, change))
