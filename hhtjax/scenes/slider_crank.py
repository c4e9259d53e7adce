"""A planar slider-crank: a crank on a fixed pivot, a connecting rod, and a slider on the x axis. SI units.

q = (crank angle, rod angle, slider position): angles from the x axis in rad, x in m. The slider is at
x = l1 cos q1 + l2 cos q2, the joint of crank and rod at l1 (cos q1, sin q1).

Crank and rod are slender and uniform, of lengths l (2,) with l1 < l2; m (3,): masses of crank, rod and slider. Gravity
g acts along -y. A spring k, at rest at x = rest, and a damper c act on the slider, and a moment on the crank.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from hhtjax.description import Array, PyTree, Real
from hhtjax.scenes import drawings
from hhtjax.scenes.scene import Scene, array
from hhtjax.systems.system import System

GRAVITY = 9.80665


def mass(q: Array, params: PyTree) -> Array:
    """M = [[(m1/3 + m2) l1^2, m2 l1 l2 cos(q1 - q2)/2, 0], [., m2 l2^2/3, 0], [0, 0, m3]]."""
    (m1, m2, m3), (l1, l2) = params["m"], params["l"]
    coupling = m2 * l1 * l2 / 2 * jnp.cos(q[0] - q[1])
    return jnp.array([[(m1 / 3 + m2) * l1**2, coupling, 0.0], [coupling, m2 * l2**2 / 3, 0.0], [0.0, 0.0, m3]], q.dtype)


def force(q: Array, v: Array, t: Real, params: PyTree) -> Array:
    """Q: weight, inertia forces, the moment, the spring and the damper."""
    (m1, m2, _), (l1, l2), g = params["m"], params["l"], params["g"]
    coupling = m2 * l1 * l2 / 2 * jnp.sin(q[0] - q[1])
    return jnp.array(
        [
            params["moment"] - (m1 / 2 + m2) * g * l1 * jnp.cos(q[0]) - coupling * v[1] ** 2,
            -m2 / 2 * g * l2 * jnp.cos(q[1]) + coupling * v[0] ** 2,
            -params["k"] * (q[2] - params["rest"]) - params["c"] * v[2],
        ]
    )


def constraint(q: Array, t: Real, params: PyTree) -> Array:
    """Phi = (l1 cos q1 + l2 cos q2 - x, l1 sin q1 + l2 sin q2)."""
    l1, l2 = params["l"]
    return jnp.array(
        [l1 * jnp.cos(q[0]) + l2 * jnp.cos(q[1]) - q[2], l1 * jnp.sin(q[0]) + l2 * jnp.sin(q[1])],
    )


@drawings.Drawing
def drawing(q, t, params: PyTree):
    """Crank, rod and slider, which runs on the x axis; its spring, if there is one."""
    l1 = params["l"][0]
    pin = l1 * np.array([np.cos(q[0]), np.sin(q[0])])
    wide, high = 0.1, 0.06
    shapes = [
        drawings.bar(np.zeros(2), pin, (q[2], 0.0)),
        drawings.block((q[2], 0.0), wide, high),
        drawings.ground((0.2, -high / 2), (0.75, -high / 2), 0.02, 16),
    ]
    if not params["k"]:
        return shapes
    return [*shapes, drawings.spring((q[2] + wide / 2, 0.0), (0.95, 0.0), 0.04), drawings.wall_at(0.95, high, 1)]


def free() -> Scene:
    """No spring, no damper, no moment: the crank starts at 20 rad/s from the stretched position."""
    return _turning(20.0)


def driven() -> Scene:
    """From rest in the stretched position: a moment of 5 N m on the crank, a spring and a damper on the slider."""
    return _turning(0.0, moment=5.0, k=100.0, c=20.0)


def _turning(speed: float, **loads: float) -> Scene:
    """The scene from the stretched position, q = (0, 0, l1 + l2), with the crank at `speed`, rad/s."""
    l1, l2 = 0.15, 0.45
    params = {"m": (0.5, 1.0, 0.8), "l": (l1, l2), "g": GRAVITY, "rest": l2}
    params |= {"moment": 0.0, "k": 0.0, "c": 0.0} | loads
    v0 = array([speed, -speed * l1 / l2, 0.0])
    return Scene(System(mass, force, constraint), params, array([0.0, 0.0, l1 + l2]), v0, 1.0, drawing)
