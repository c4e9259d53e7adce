"""The spinning top of Cardona, Geradin (1989), Sec. 4.2: a disk on a massless rod that turns freely about the origin.

The disk of mass m (kg) and radius a (m) is at the distance l (m) along material axis 2, about which it spins. Gravity g
(m/s^2) is along -z. Om is the material angular velocity (rad/s). I is the inertia about the centre of the disk, and
J = I + m l^2 diag(1, 0, 1) the inertia about the origin (kg m^2).

    minimal      q = R            J A = l e2 x R^T (-m g e3) - Om x J Om
    constrained  q = {R, x}       m xddot = -m g e3 + L,   I A = -Om x I Om - l e2 x R^T L,   Phi = x - l R e2 = 0

The first needs 3 unknowns per step. The second needs 9, or 12 with `formulation="ggl"`. L (N) is the force of the rod
on the disk.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.checks import require_number
from hhtjax.description import Array, PyTree, Real
from hhtjax.numerics.dense_lu import matvec
from hhtjax.rotation import cross
from hhtjax.scenes import drawings
from hhtjax.scenes.scene import Scene, array
from hhtjax.systems.system import System

DURATION = 0.5


def disk_inertia(params: PyTree) -> Array:
    """I = m a^2/4 diag(1, 2, 1)."""
    quarter = params["m"] * params["a"] ** 2 / 4
    return jnp.array([quarter, 2 * quarter, quarter])


def inertia(q: Array, params: PyTree) -> Array:
    """J, a diagonal."""
    offset = params["m"] * params["l"] ** 2
    return disk_inertia(params) + jnp.array([offset, 0.0, offset], q.dtype)


def weight(params: PyTree) -> Array:
    """-m g e3, in spatial components."""
    return jnp.array([0.0, 0.0, -params["m"] * params["g"]])


def moment(R: Array, Om: Array, t: Real, params: PyTree) -> Array:
    """l e2 x R^T (-m g e3) - Om x J Om."""
    arm = jnp.array([0.0, params["l"], 0.0])
    return cross(arm, matvec(R.T, weight(params))) - cross(Om, inertia(R, params) * Om)


def mass(q: dict, params: PyTree) -> Array:
    """The diagonal of M: I and m."""
    return jnp.concatenate([disk_inertia(params), jnp.full(3, params["m"], q["x"].dtype)])


def force(q: dict, v: dict, t: Real, params: PyTree):
    """Gyroscopic moment and weight."""
    Om = v["R"]
    return {"R": -cross(Om, disk_inertia(params) * Om), "x": weight(params)}


def rod(q: dict, t: Real, params: PyTree) -> Array:
    """Phi = x - l R e2, in m."""
    return q["x"] - params["l"] * q["R"][:, 1]


@drawings.Drawing
def drawing_minimal(R, t, params: PyTree):
    """The rod, and the disk with one spoke, which shows the spin."""
    x, a = params["l"] * R[:, 1], params["a"]
    return [drawings.bar(np.zeros(3), x), drawings.wheel(x, a, R[:, 0], R[:, 2])]


@drawings.Drawing
def drawing_constrained(q, t, params: PyTree):
    """The rod, and the disk at its own position."""
    return [drawings.bar(np.zeros(3), q["x"]), drawings.wheel(q["x"], params["a"], q["R"][:, 0], q["R"][:, 2])]


def minimal(spin: float = 150.0, inclination: float = 0.0) -> Scene:
    """The top as a rotation alone.

    By default it starts with its rod horizontal, along y. It turns about the vertical at exactly the rate with which it
    later passes its lowest point: Om = spin (0, 1, -2 a^2/(a^2 + 4 l^2)).

    Args:
        spin: angular velocity about the rod, in rad/s. inclination: angle of the rod above the horizontal, in rad.

    Raises:
        TypeError, ValueError: an argument is not a finite number.
    """
    params, R, Om = _start("minimal", spin, inclination)
    return Scene(System(inertia, moment), params, array(R), array(spin * Om), DURATION, drawing_minimal)


def constrained(spin: float = 150.0, inclination: float = 0.0) -> Scene:
    """The same motion as a free disk whose centre the rod constrains: 6 coordinates, 3 constraints.

    Args:
        spin, inclination: as in `minimal`.

    Raises:
        TypeError, ValueError: as `minimal`.
    """
    params, R, Om = _start("constrained", spin, inclination)
    arm = params["l"] * np.array([0.0, 1.0, 0.0])
    q0, v0 = {"R": R, "x": R @ arm}, {"R": spin * Om, "x": spin * (R @ np.cross(Om, arm))}
    q0, v0 = jax.tree.map(array, (q0, v0))
    return Scene(System(mass, force, rod), params, q0, v0, DURATION, drawing_constrained)


def _start(caller: str, spin: float, inclination: float):
    require_number(caller, "spin", spin, np.isfinite, "be finite")
    require_number(caller, "inclination", inclination, np.isfinite, "be finite")
    a, length = 0.25, 1.0
    c, s = np.cos(inclination), np.sin(inclination)
    R = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    Om = np.array([0.0, 1.0, -2 * a**2 / (a**2 + 4 * length**2)])  # with a spin of 1
    return {"m": 15.0, "a": a, "l": length, "g": 9.81}, R, Om
