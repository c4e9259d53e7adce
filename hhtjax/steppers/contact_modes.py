"""Modes of contacts: which are closed, which stick, and in which direction others slide; and the first switch in a
step.

With modes, the forces f = (f_N, f_T) depend linearly on rates y = (dg/dt, s), or on their derivatives,

    closed: (y + K f)_N = 0      sticking: (y + K f)_T = 0      sliding: f_T = -sig mu f_N      open: f = 0

A closed contact separates when f_N falls below 0. A sticking one starts to slide when |f_T| exceeds mu f_N. A sliding
one stops when s = 0, and an open one lands when its gap falls to 0. Between both ends of a step f and s are taken as
linear, and gaps as cubics, which is sufficient for order 2.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax

from hhtjax.description import Array
from hhtjax.numerics.coulomb import proximal

ROUNDING = 64  # of what a force, a rate or a gap is made of, that it may be beyond what its mode allows
ON_CUBIC, NEARLY = 40, 1e-9  # iterations at most, and the change of theta that is the last
TOGETHER = 1e-9  # part of a step: two switches that are one


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
        """(2 m,): which rates are held at 0."""
        closed, stuck, _ = self.which(mu)
        return jnp.concatenate([closed, stuck])

    def behind(self, switch: Switch) -> Modes:
        """The modes after a switch, without landings."""
        sig = jnp.where(switch.breaks != 0, -switch.breaks, jnp.where(switch.stops > 0, 0, self.sig))
        return Modes(self.closed * (1 - switch.lets), sig)


def matrix(A: Array, modes: Modes, mu: Array) -> Array:
    """S, of the rows for these modes."""
    m = len(mu)
    closed, stuck, slides = modes.which(mu)
    one = jnp.eye(2 * m, dtype=A.dtype)
    sliding = one[m:] + (modes.sig * mu)[:, None] * one[:m]
    along = jnp.where(stuck[:, None], A[m:], jnp.where(slides[:, None], sliding, one[m:]))
    return jnp.concatenate([jnp.where(closed[:, None], A[:m], one[:m]), along])


def right_side(y: Array, f: Array, modes: Modes, mu: Array) -> Array:
    """b with S x = b for the change x of the forces f, for the rates y."""
    m = len(mu)
    closed, stuck, slides = modes.which(mu)
    along = jnp.where(slides, -f[m:] - modes.sig * mu * f[:m], -f[m:])
    return jnp.concatenate([jnp.where(closed, -y[:m], -f[:m]), jnp.where(stuck, -y[m:], along)])


def presses(K: Array, modes: Modes, mu: Array) -> Array:
    """(m,): the effect of a normal force on the gap of each contact, including its friction, beyond rounding. If it is
    not positive the contact jams (Painleve)."""
    m = len(mu)
    small = proximal(K.dtype)
    return jnp.stack([K[i, i] - modes.sig[i] * mu[i] * K[i, m + i] - small * jnp.abs(K[i, i]) for i in range(m)])


class Switch(NamedTuple):
    """Which contacts switch at an instant, (m,): 1 if one separates, stops or lands; and for one that starts to slide
    the sign of its friction. 0 elsewhere."""

    lets: Array
    breaks: Array
    stops: Array
    lands: Array

    @classmethod
    def none(cls, like: Array) -> Switch:
        """No switch."""
        return cls(*[jnp.zeros_like(like)] * 4)

    def any(self) -> Array:
        """Whether a contact switches."""
        return jnp.any((self.lets + jnp.abs(self.breaks) + self.stops + self.lands) > 0)


class Course(NamedTuple):
    """A step h in which no contact switched: the gaps, rates and forces at its start and at its end; and the rounding
    of each."""

    h: Array
    gap: tuple[Array, Array]
    y: tuple[Array, Array]
    f: tuple[Array, Array]
    rounding: tuple[Array, Array, Array]


def asks(course: Course, modes: Modes, mu: Array):
    """Which contacts cannot keep their mode to the end of the step: those that separate, slide, stop, land (m,). If a
    gap turns around in between, a landing may be a false alarm."""
    m = len(mu)
    closed, stuck, slides = modes.which(mu)
    of_gap, of_rate, of_force = course.rounding
    (f_N, f_T), s = (course.f[1][:m], course.f[1][m:]), course.y[1][m:]
    (g0, g1), (d0, d1) = course.gap, (course.h * y[:m] for y in course.y)
    lets, breaks = closed & (f_N < -of_force), stuck & (jnp.abs(f_T) > mu * f_N + of_force)
    stops = slides & (mu > 0) & (modes.sig * s < -of_rate)
    crosses = g0 * (d1 - d0) <= d0 * (g1 - g0 - d1)  # tangents at both ends cross below 0
    return lets, breaks, stops, ~closed & ((g1 < -of_gap) | ((d0 < 0) & (d1 > 0) & crosses))


def first_switch(course: Course, modes: Modes, mu: Array):
    """The time of the first switch, as a fraction of the step, 1 if there is none; and the `Switch`."""
    m = len(mu)
    lets, breaks, stops, lands = asks(course, modes, mu)
    f0, f1 = course.f
    side = jnp.sign(f1[m:])
    times = [
        _on_line(f0[:m], f1[:m], lets),
        _on_line(mu * f0[:m] - side * f0[m:], mu * f1[:m] - side * f1[m:], breaks),
        _on_line(modes.sig * course.y[0][m:], modes.sig * course.y[1][m:], stops),
        _on_cubic(course, lands),
    ]
    flat = jnp.concatenate(times)
    first = jnp.arange(4 * m) == jnp.argmin(lax.stop_gradient(flat))
    theta = jnp.sum(jnp.where(first & (flat < 1), flat, 0)) + jnp.where(jnp.any(flat < 1), 0, 1)
    now = [(t <= theta + TOGETHER) & (t < 1) for t in times]
    lets, breaks, stops, lands = (x.astype(mu.dtype) for x in now)
    return theta, Switch(lets, breaks * side, stops, lands)


def _on_line(a: Array, b: Array, some: Array) -> Array:
    """The position at which a value that changes from a to b < 0 is 0; infinite for others."""
    some = some & (b < 0)
    a = jnp.maximum(a, 0)
    return jnp.where(some, a / jnp.where(some, a - b, 1), jnp.inf)


def _on_cubic(course: Course, some: Array) -> Array:
    """The positions at which gaps fall to 0, on the cubics through both ends; infinite if they do not."""
    m = len(some)
    (g0, g1), (d0, d1) = course.gap, (course.h * y[:m] for y in course.y)
    a, b = 3 * (g1 - g0) - 2 * d0 - d1, 2 * (g0 - g1) + d0 + d1

    def cubic(x: Array) -> Array:
        return g0 + x * (d0 + x * (a + x * b))

    root = jnp.sqrt(jnp.maximum(a * a - 3 * b * d0, 0))
    below = jnp.where(d0 > 0, a - root, a + root)
    turn = -d0 / jnp.where(below != 0, below, 1)  # the first place where it turns around
    turn = jnp.where((below != 0) & (turn > 0) & (turn < 1), turn, 1)
    ends = g1 < -course.rounding[0]
    some = some & (ends | (cubic(turn) < -course.rounding[0]))
    bounds = jnp.where((d0 > 0) & ends, turn, 0), jnp.where(ends, 1, turn)

    def unfinished(now: tuple) -> Array:
        *_, change, k = now
        return (change > NEARLY) & (k < ON_CUBIC)

    def improve(now: tuple):
        low, high, x, _, k = now
        y, slope = cubic(x), d0 + x * (2 * a + x * 3 * b)
        low, high = jnp.where(y > 0, x, low), jnp.where(y > 0, high, x)
        new = x - y / jnp.where(slope < 0, slope, -1)
        new = jnp.where((slope < 0) & (new > low) & (new < high), new, (low + high) / 2)
        return low, high, new, jnp.max(jnp.where(some, jnp.abs(new - x), 0)), k + 1

    begin = *bounds, (bounds[0] + bounds[1]) / 2, jnp.ones_like(course.h), jnp.zeros((), jnp.int32)
    x = lax.stop_gradient(lax.while_loop(unfinished, improve, lax.stop_gradient(begin))[2])
    slope = lax.stop_gradient(d0 + x * (2 * a + x * 3 * b))
    return jnp.where(some, jnp.clip(x - cubic(x) / jnp.where(slope < 0, slope, -jnp.inf), 0, 1), jnp.inf)
