"""A simple pendulum in three formulations: the rod as a constraint, a stiff spring instead of the rod, and one angle.

A point mass m (kg) at the distance l (m) from the origin, under gravity g (m/s^2) along -y. It starts at its lowest
point with a horizontal velocity. The default is that of Cardona, Geradin (1989), Sec. 4.1, read from their figure.

    cartesian   q = (x, y)    m w = m g + B^T L,  Phi = (x^2 + y^2 - l^2)/2 = 0; the tension of the rod is -l L
    elastic     q = (x, y)    m w = m g - k (r - l) (x, y)/r,  r = sqrt(x^2 + y^2)
    minimal     q = (angle from the lowest point,)    m l^2 w = -m g l sin q
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from hhtjax.checks import require_number
from hhtjax.description import Array, PyTree, Real
from hhtjax.scenes import drawings
from hhtjax.scenes.scene import EventScene, Scene, array
from hhtjax.systems.events import Event, impact
from hhtjax.systems.system import System

GRAVITY = 9.81
DURATION = 1.0


def point_mass(q: Array, params: PyTree) -> Array:
    """M = diag(m, m)."""
    return jnp.full(2, params["m"], q.dtype)


def weight(q: Array, v: Array, t: Real, params: PyTree) -> Array:
    """Q = (0, -m g)."""
    return jnp.array([0.0, -params["m"] * params["g"]], q.dtype)


def rod(q: Array, t: Real, params: PyTree) -> Array:
    """Phi = (x^2 + y^2 - l^2)/2."""
    return (jnp.sum(q**2, keepdims=True) - params["l"] ** 2) / 2


def weight_and_spring(q: Array, v: Array, t: Real, params: PyTree) -> Array:
    """Q with a spring of stiffness k (N/m) and rest length l between the origin and the mass."""
    r = jnp.sqrt(jnp.sum(q**2))
    return weight(q, v, t, params) - params["k"] * (r - params["l"]) / r * q


def inertia(q, params: PyTree):
    """M = [m l^2]."""
    return jnp.full(1, params["m"] * params["l"] ** 2, q.dtype)


def moment_of_weight(q, v, t, params: PyTree):
    """Q = [-m g l sin q]."""
    return -params["m"] * params["g"] * params["l"] * jnp.sin(q)


@drawings.Drawing
def drawing_cartesian(q, t, params: PyTree):
    """The rod; the wall, if there is one."""
    shapes = [drawings.bar(np.zeros(2), q)]
    if "wall" in params:
        x, length = params["wall"], params["l"]
        shapes.append(drawings.ground((x, -1.1 * length), (x, 0.0), 0.05 * length))
    return shapes


@drawings.Drawing
def drawing_elastic(q, t, params: PyTree):
    """The spring, and the mass as a small ball."""
    return [drawings.spring(np.zeros(2), q, 0.1 * params["l"]), drawings.wheel(q, 0.04 * params["l"])]


@drawings.Drawing
def drawing_minimal(q, t, params: PyTree):
    """The rod."""
    return [drawings.bar(np.zeros(2), params["l"] * np.array([np.sin(q[0]), -np.cos(q[0])]))]


def cartesian(speed: float = 2.505, length: float = 0.5) -> Scene:
    """The rod as a constraint.

    Args:
        speed: speed at the lowest point, in m/s. length: length of the rod, in m.

    Raises:
        TypeError, ValueError: speed is not a finite number, or length is not a positive one.
    """
    params = _params("cartesian", speed, length)
    start = array([0.0, -length]), array([speed, 0.0])
    return Scene(System(point_mass, weight, rod), params, *start, DURATION, drawing_cartesian)


def elastic(k: float = 1e6, speed: float = 2.505, length: float = 0.5) -> Scene:
    """A spring of stiffness k (N/m) instead of the rod. The difference from the motion with the rod falls as 1/k.

    The spring starts stretched so that it carries the weight and turns the mass, k (r - l) = m (g + speed^2/r). So it
    hardly vibrates. The frequency of such a vibration is sqrt(k/m).

    Args:
        k: stiffness, N/m.
        speed, length: as in `cartesian`.

    Raises:
        TypeError, ValueError: as `cartesian`, or k is not a positive number.
    """
    params = _params("elastic", speed, length)
    params["k"] = require_number("elastic", "k", k, lambda x: 0 < x < np.inf, "be positive and finite")
    b = k * length + params["m"] * GRAVITY
    r = (b + jnp.sqrt(b**2 + 4 * k * params["m"] * speed**2)) / (2 * k)
    start = array([0.0, -r]), array([speed, 0.0])
    return Scene(System(point_mass, weight_and_spring), params, *start, DURATION, drawing_elastic)


def minimal(speed: float = 2.505, length: float = 0.5) -> Scene:
    """The same motion as `cartesian` in one angle: (x, y) = l (sin q, -cos q).

    Args:
        speed, length: as in `cartesian`.

    Raises:
        TypeError, ValueError: as `cartesian`.
    """
    params = _params("minimal", speed, length)
    start = array([0.0]), array([speed / length])
    return Scene(System(inertia, moment_of_weight), params, *start, DURATION, drawing_minimal)


def room_before_wall(q, v, t, params: PyTree):
    """The distance of the mass from the wall, m."""
    return params["wall"] - q[0]


def walled(wall: float = 0.3, restitution: Real = 0.7) -> EventScene:
    """`cartesian` with a vertical wall in its way. The impulse of the impact obeys the constraint of the rod.

    Args:
        wall: x of the wall, in m; less than the length of the rod, 0.5 m. restitution: e, in [0, 1].

    Raises:
        TypeError, ValueError: the mass does not reach the wall.
    """
    scene = cartesian()
    length = scene.params["l"]
    require_number("walled", "wall", wall, lambda x: 0 < x < length, "be positive and less than the rod's 0.5")
    params = scene.params | {"wall": wall, "e": restitution}
    events = (Event(room_before_wall, reset=impact("e")),)
    return EventScene(scene.system, params, scene.q0, scene.v0, DURATION, events, drawing_cartesian)


def _params(caller: str, speed: float, length: float):
    require_number(caller, "speed", speed, np.isfinite, "be finite")
    require_number(caller, "length", length, lambda x: 0 < x < np.inf, "be positive and finite")
    return {"m": 1.0, "l": length, "g": GRAVITY}
