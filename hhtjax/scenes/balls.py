"""Balls in one dimension: one bounces on a floor, with or without drag; two collide.

    m w = -m g - c |v| v,   v+ = -e v  at q = floor

Without drag (c = 0), a ball that starts at rest at the height h has its impacts k = 1, 2, ... at the times
t_k = T (1/2 + e + ... + e^(k-1)) with T = sqrt(8 h/g). It is at rest from the time T (1/2 + e/(1 - e)) on, after
infinitely many impacts in a finite time.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from hhtjax.description import Array, PyTree, Real
from hhtjax.scenes import drawings
from hhtjax.scenes.scene import EventScene, array
from hhtjax.systems.events import Event, impact
from hhtjax.systems.system import System

GRAVITY = 9.81


def mass(q: Array, params: PyTree) -> Array:
    """M, a diagonal."""
    return params["m"] * jnp.ones(q.size, q.dtype)


def weight_and_drag(q, v, t, params: PyTree):
    """Q of a ball."""
    return -params["m"] * params["g"] - params["c"] * jnp.abs(v) * v


def no_force(q: Array, v: Array, t: Real, params: PyTree) -> Array:
    """Q of balls on a level line."""
    return jnp.zeros(q.size, q.dtype)


def height(q, v, t, params: PyTree):
    """The height over the floor, m."""
    return q[0] - params["floor"]


def distance(q: Array, v: Array, t: Real, params: PyTree) -> Array:
    """The distance between the two balls, m."""
    return q[1] - q[0] - params["diameter"]


@drawings.Drawing
def ball_over_floor(q, t, params: PyTree):
    """A ball of 5 cm, whose lowest point is at the height q."""
    floor = params["floor"]
    return [
        drawings.wheel((0.0, q[0] + 0.05), 0.05),
        drawings.ground((-0.4, floor), (0.4, floor), 0.04),
    ]


@drawings.Drawing
def balls_on_a_line(q, t, params: PyTree):
    """Two balls on a level floor."""
    r = params["diameter"] / 2
    start, end = np.array([-0.2, 0.0]), np.array([1.3, 0.0])
    return [*(drawings.wheel((x, r), r) for x in q), drawings.ground(start, end, 0.04, 14)]


def bouncing(restitution: Real = 0.8, drag: float = 0.1) -> EventScene:
    """A ball dropped from 1 m, with two impacts in 1.5 s (SI units).

    Args:
        restitution: e, in [0, 1]. drag: c, kg/m.

    >>> float(bouncing(drag=0.0).params["c"])
    0.0
    """
    params = {"m": 1.0, "g": GRAVITY, "c": drag, "floor": 0.0, "e": restitution}
    events = (Event(height, reset=impact("e")),)
    return EventScene(System(mass, weight_and_drag), params, array([1.0]), array([0.0]), 1.5, events, ball_over_floor)


def two(restitution: Real = 1.0) -> EventScene:
    """A ball runs into another of the same mass, which is at rest. With e = 1 they exchange velocities (SI units).

    Args:
        restitution: e, in [0, 1].
    """
    params = {"m": 1.0, "diameter": 0.1, "e": restitution}
    events = (Event(distance, reset=impact("e")),)
    return EventScene(
        System(mass, no_force), params, array([0.0, 0.5]), array([1.0, 0.0]), 1.0, events, balls_on_a_line
    )
