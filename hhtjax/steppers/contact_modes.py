"""What contacts do within a step, on their rates y = (dg/dt, s) alone: who is closed, who sticks, who slides where to.

With modes all is linear in the forces f = (f_N, f_T): to rates that they change by A f, added to y,

    closed: (y + A f)_N = 0      sticking: (y + A f)_T = 0      sliding: f_T = -sig mu f_N      open: f = 0

A step in which nobody switches is one such problem. One with switches is gone through from switch to switch. Between
them the forces go linearly: a closed contact lets go where f_N falls to 0, one that sticks breaks away where |f_T|
grows to mu f_N, one that slides stops where s = 0. Behind each of these the modes of all contacts are a linear
complementarity problem: what one does may move the others.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.description import Array
from hhtjax.numerics.batched_cond import call_where
from hhtjax.numerics.coulomb import choice, inverted
from hhtjax.numerics.dense_lu import matvec

SWITCHES = 4, 2  # in a step, and for each contact
ROUNDING = 64  # of the largest force, that a force may be beyond what its mode allows
FINE, NO_FORCES, MANY, JAMMED = 0.0, 1.0, 2.0, 3.0  # codes of a step


class Modes(NamedTuple):
    """closed: (m,), 1 or 0; sig: (m,), the direction of sliding, -1 or 1, and 0 where a contact sticks."""

    closed: Array
    sig: Array

    def which(self, mu: Array):
        """Which contacts are closed, which of these stick, and which slide."""
        closed = self.closed > 0
        slides = closed & ((self.sig != 0) | (mu == 0))
        return closed, closed & ~slides, slides

    def held(self, mu: Array) -> Array:
        """(2 m,): which rates are 0."""
        closed, stuck, _ = self.which(mu)
        return jnp.concatenate([closed, stuck])


def matrix(A: Array, modes: Modes, mu: Array) -> Array:
    """S, of the rows for these modes."""
    m = len(mu)
    closed, stuck, slides = modes.which(mu)
    one = jnp.eye(2 * m, dtype=A.dtype)
    sliding = one[m:] + (modes.sig * mu)[:, None] * one[:m]
    along = jnp.where(stuck[:, None], A[m:], jnp.where(slides[:, None], sliding, one[m:]))
    return jnp.concatenate([jnp.where(closed[:, None], A[:m], one[:m]), along])


def right_side(y: Array, f: Array, modes: Modes, mu: Array) -> Array:
    """b with S x = b for the change x of the forces f, to which the rates y belong."""
    m = len(mu)
    closed, stuck, slides = modes.which(mu)
    along = jnp.where(slides, -f[m:] - modes.sig * mu * f[:m], -f[m:])
    return jnp.concatenate([jnp.where(closed, -y[:m], -f[:m]), jnp.where(stuck, -y[m:], along)])


def settled(K: Array, y: Array, modes: Modes, mu: Array):
    """The modes behind an instant, of contacts that are closed, and stick or slide as `modes` say, there: who lets go,
    and who begins to slide; and the code. y: dy/dt without forces, K: what a unit of force adds to it."""
    closed, _, slides = modes.which(mu)
    found = choice(K, y, mu, jnp.zeros_like(mu), closed, jnp.where(slides, modes.sig, 0))
    code = jnp.where(found.jams, JAMMED, jnp.where(found.found, FINE, NO_FORCES)).astype(y.dtype)
    return Modes(found.pushes.astype(y.dtype), jnp.where(found.pushes, found.sig, 0)), code


class Course(NamedTuple):
    """A step in which nobody switches: its dy/dtheta, theta = (t - t0)/h, its forces, start + theta rise; and what a
    unit of force changes y by in the time h."""

    slope: Array
    start: Array
    rise: Array
    Kh: Array
    mu: Array


class Moment(NamedTuple):
    """Within a step: theta, the rates, the modes, the integral of the rates over theta, the forces, the code."""

    theta: Array
    y: Array
    modes: Modes
    moved: Array
    f: Array
    code: Any


def to_the_end(at: Moment, course: Course) -> Moment:
    """The end of the step, behind all switches."""

    def visit(at: Moment, _):
        return call_where(piece, at.theta < 1, at, course), None

    first, more = SWITCHES
    at = lax.scan(visit, at, length=first + more * len(course.mu))[0]
    many = (at.theta < 1) & (at.code == FINE)
    return at._replace(code=jnp.where(many, MANY, at.code).astype(at.y.dtype))


def piece(at: Moment, course: Course) -> Moment:
    """On to the next switch, or to the end of the step."""
    slope, start, rise, Kh, mu = course
    m = len(mu)
    soon = at.theta + np.sqrt(float(jnp.finfo(slope.dtype).eps)) * (1 - at.theta)
    modes, code = settled(Kh, slope - matvec(Kh, start + soon * rise), at.modes, mu)
    change = inverted(matrix(Kh, modes, mu))
    first, last = (known + change(right_side(slope, known, modes, mu)) for known in (start, start + rise))

    def force(theta: Array) -> Array:
        return first + theta * (last - first)

    middle = (1 + at.theta) / 2
    held = modes.held(mu)
    speed = jnp.where(held, 0, slope + matvec(Kh, force(middle) - (start + middle * rise)))
    y = jnp.where(held, 0, at.y)
    until, stops = _first_switch(at.theta, y, speed, first, last, modes, mu)
    theta = jnp.minimum(until, 1)
    y1 = y + (theta - at.theta) * speed
    who = (stops <= until) & (until < 1)
    y1 = jnp.concatenate([y1[:m], jnp.where(who, 0, y1[m:])])
    moved = at.moved + (theta - at.theta) * (y + y1) / 2
    modes = modes._replace(sig=jnp.where(who, 0, modes.sig))
    return Moment(theta, y1, modes, moved, force(theta), jnp.maximum(at.code, code))


def _first_switch(theta: Array, y: Array, speed: Array, first: Array, last: Array, modes: Modes, mu: Array):
    """When the first contact switches, infinite where none does; and when each of those that slide stops."""
    m = len(mu)
    closed, stuck, slides = modes.which(mu)

    noise = ROUNDING * float(jnp.finfo(y.dtype).eps) * jnp.max(jnp.abs(first) + jnp.abs(last))

    def crossing(a: Array, b: Array, some: Array) -> Array:
        """Where what goes from a to b falls below 0, by more than rounding in the end."""
        falls = some & (b < -noise) & (b < a)
        there = a / jnp.where(falls, a - b, 1)
        return jnp.where(falls, jnp.where(there > theta, there, theta), jnp.inf)

    limits = [mu * f[:m] for f in (first, last)]
    times = [crossing(first[:m], last[:m], closed)]
    times += [crossing(limits[0] - d * first[m:], limits[1] - d * last[m:], stuck) for d in (1, -1)]
    turning = slides & (mu > 0) & (modes.sig * speed[m:] < 0)
    wait = -y[m:] / jnp.where(turning, speed[m:], 1)
    stops = jnp.where(turning, theta + jnp.where(wait > 0, wait, 0), jnp.inf)
    return jnp.min(jnp.stack([*times, stops])), stops
