"""A chain of rods in space: bodies in R^3 x SO(3), each hung by a spherical joint on the one before. SI units.

Rod i has its centre at x_i and its material axis 3 along R_i e3; r is its radius of gyration about that axis. The first
joint is the origin. Gravity g (m/s^2) is along -z.

    q = {"R": (N, 3, 3), "x": (N, 3)}, v = {"R": Om (N, 3), "x": (N, 3)}

    I A = -Om x I Om,    m xddot = -m g e3,    I = m diag(l^2/12 + r^2/2, l^2/12 + r^2/2, r^2)

    Phi_i = x_i + R_i (l/2) e3 - (x_(i-1) - R_(i-1) (l/2) e3) = 0,  3 N components; the multipliers are the forces (N)
    of the joints on the rods below
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.checks import require_integer, require_number
from hhtjax.description import PyTree
from hhtjax.rotation import cross
from hhtjax.scenes.scene import Scene, array
from hhtjax.systems.system import System


def inertia(params: PyTree):
    """The diagonal of I, kg m^2."""
    m, l2, r2 = params["m"], params["l"] ** 2, params["r"] ** 2
    return m * jnp.stack([l2 / 12 + r2 / 2, l2 / 12 + r2 / 2, r2])


def mass(q, params: PyTree):
    """The diagonal of M."""
    N = len(q["x"])
    return jnp.concatenate([jnp.tile(inertia(params), N), jnp.full(3 * N, params["m"])])


def force(q, v, t, params: PyTree):
    """Gyroscopic moments and weights."""
    Om = v["R"]
    weight = jnp.stack([jnp.zeros_like(params["g"]), jnp.zeros_like(params["g"]), -params["m"] * params["g"]])
    return {"R": -jax.vmap(cross)(Om, inertia(params)[None, :] * Om), "x": jnp.tile(weight, (len(Om), 1))}


def joints(q, t, params: PyTree):
    """Phi: upper end of each rod, less the lower end of the rod above."""
    half = params["l"] / 2 * q["R"][:, :, 2]
    above = jnp.concatenate([jnp.zeros_like(half[:1]), (q["x"] - half)[:-1]])
    return (q["x"] + half - above).ravel()


def body_chain(bodies=3, spin=5.0) -> Scene:
    """Rods of 1 kg and 0.5 m, held out in a line at 60 degrees from the vertical and let go while they spin.

    Args:
        bodies: N, their number. spin: of each about its own axis, in rad/s.

    Raises:
        TypeError, ValueError: bodies is no positive integer, or spin no finite number.

    >>> (body_chain(bodies=2).q0["x"].round(3) + 0.0).tolist()
    [[0.217, 0.0, -0.125], [0.65, 0.0, -0.375]]
    """
    require_number("body_chain", "spin", spin, np.isfinite, "be finite")
    N = require_integer("body_chain", "bodies", bodies)
    length, c, s = 0.5, np.cos(np.pi / 3), np.sin(np.pi / 3)
    R = np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
    x = -length * (np.arange(N) + 0.5)[:, None] * R[:, 2]
    q0, v0 = {"R": np.tile(R, (N, 1, 1)), "x": x}, {"R": array(N * [[0.0, 0.0, spin]]), "x": np.zeros((N, 3))}
    params = {"m": 1.0, "l": length, "r": 0.05, "g": 9.81}
    params, q0, v0 = jax.tree.map(array, (params, q0, v0))
    return Scene(System(mass, force, joints), params, q0, v0, 2.0)
