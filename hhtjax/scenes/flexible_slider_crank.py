"""Simeon's flexible slider-crank: a crank that turns at a given speed, an elastic rod, and a slider. SI units.

q = (phi1, phi2, x, w1, w2, u1, u2): phi1 and phi2 are the angles of crank and rod from the x axis, in rad. x is the
position of the slider on this axis, in m. The others are elastic displacements of the rod, in m, in the frame through
both its ends. At the distance s l2 from the crank, s = 0 ... 1, the displacement across the rod is
w1 sin(pi s) + w2 sin(2 pi s). The displacement along the rod is a quadratic in s: 0 at the crank, u1 in the middle and
u2 at the slider.

m (2,): masses of rod and slider. J (2,): moments of inertia of the crank about its pivot, and of the rod about its end.
EA, EI: stiffnesses of the rod; D (4, 4): its damping. stiffening: the factor of the energy EA/2 l2 int u' w'^2 ds, by
which tension stiffens the rod.

The numbers are those of the test set, including its rounding of pi. In all terms of u^2 the test set has 15 times the
mass that follows from the shape functions; this scene has it, too.

References:
    Simeon (1996), Modelling a flexible slider crank mechanism by a mixed system of DAEs and PDEs, Mathematical
    Modelling of Systems 2, 1-18; Mazzia, Magherini, Test Set for IVP Solvers (2008), problem "Slider crank".
    Multipliers here are minus those of the test set.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import block_diag

from hhtjax.description import Array, PyTree, Real
from hhtjax.scenes import drawings
from hhtjax.scenes.scene import Scene, array
from hhtjax.systems.system import System

PI = 3.1415927
BENDING, STRETCHING, COUPLING = [PI**4 / 2, PI**4 * 8], [[16 / 3, -8 / 3], [-8 / 3, 7 / 3]], 80 / (9 * PI**2)


def integrals(dtype: Any):
    """Integrals over s of the shape functions of w and of u: alone, times s, and times each other; and of the products
    of those of w and u."""
    alone = [2 / PI, 0.0], [2 / 3, 1 / 6]
    times_s = [1 / PI, -1 / (2 * PI)], [1 / 3, 1 / 6]
    twice = [[0.5, 0.0], [0.0, 0.5]], [[8.0, 1.0], [1.0, 2.0]]
    mixed = [[16 / PI**3, 1 / PI - 8 / PI**3], [0.0, -1 / (2 * PI)]]
    return [jnp.array(x, dtype) for x in (*alone, *times_s, *twice, mixed)]


def mass(q: Array, params: PyTree) -> Array:
    """M, from the kinetic energy of crank, slider, and rod in its moving frame."""
    (m2, m3), (J1, J2), (l1, l2) = params["m"], params["J"], params["l"]
    w, u, (W, U, SW, SU, WW, UU, WU) = q[3:5], q[5:], integrals(q.dtype)
    s, c = jnp.sin(q[0] - q[1]), jnp.cos(q[0] - q[1])
    M12 = m2 * l1 * (c * (l2 / 2 + U @ u) + s * W @ w)
    M22 = J2 + m2 * (2 * l2 * SU @ u + w @ WW @ w + u @ UU @ u)
    crank = jnp.concatenate([jnp.array([J1 + m2 * l1**2, M12, 0.0]), m2 * l1 * c * W, -m2 * l1 * s * U])
    rod = jnp.concatenate([jnp.array([M12, M22, 0.0]), m2 * (l2 * SW + WU @ u), -m2 * w @ WU])
    slider = jnp.zeros(7, q.dtype).at[2].set(m3)
    upper = jnp.stack([crank, rod, slider])
    return jnp.block([[upper], [upper[:, 3:].T, m2 * block_diag(WW, UU)]])


def elastic_force(w: Array, u: Array, params: PyTree):
    """Elastic forces on w and on u: minus the derivatives of the energy of the rod."""
    EA, EI, l2 = params["EA"], params["EI"], params["l"][1]
    pull = params["stiffening"] * EA / 2 * (PI / l2) ** 2
    mixed, product = COUPLING * (4 * u[0] - 2 * u[1]), w[0] * w[1]
    on_w = pull * jnp.array([u[1] * w[0] + mixed * w[1], 4 * u[1] * w[1] + mixed * w[0]])
    on_u = pull * jnp.array([4 * COUPLING * product, w[0] ** 2 / 2 + 2 * w[1] ** 2 - 2 * COUPLING * product])
    bending, stretching = jnp.array(BENDING, w.dtype), jnp.array(STRETCHING, u.dtype)
    return -EI / l2**3 * bending * w - on_w, -EA / l2 * stretching @ u - on_u


def force(q: Array, v: Array, t: Real, params: PyTree) -> Array:
    """Q: inertia forces of the moving frame, and the elastic and damping forces of the rod."""
    m2, (l1, l2) = params["m"][0], params["l"]
    w, u, w_dot, u_dot, (turn1, turn2) = q[3:5], q[5:], v[3:5], v[5:], v[:2]
    W, U, _, SU, WW, UU, WU = integrals(q.dtype)
    s, c = jnp.sin(q[0] - q[1]), jnp.cos(q[0] - q[1])
    along, across = l2 / 2 + U @ u, W @ w
    crank = turn2**2 * (c * across - s * along) - 2 * turn2 * (c * U @ u_dot + s * W @ w_dot)
    rod = l1 * turn1**2 * (s * along - c * across)
    rod -= 2 * turn2 * (l2 * SU @ u_dot + w_dot @ WW @ w + u_dot @ UU @ u)
    on_w = turn2**2 * WW @ w + l1 * turn1**2 * s * W - 2 * turn2 * WU @ u_dot
    on_u = turn2**2 * (UU @ u + l2 * SU) + l1 * turn1**2 * c * U + 2 * turn2 * w_dot @ WU
    inertia = m2 * jnp.concatenate([jnp.array([l1 * crank, rod, 0.0]), on_w, on_u])
    elastic = jnp.concatenate(elastic_force(w, u, params)) - params["D"] @ v[3:]
    return inertia.at[3:].add(elastic)


def constraint(q: Array, t: Real, params: PyTree) -> Array:
    """Phi = (l1 sin phi1 + l sin phi2, x - l1 cos phi1 - l cos phi2, phi1 - speed t) with l = l2 + u2."""
    l1, l2 = params["l"]
    length = l2 + q[6]
    return jnp.array(
        [
            l1 * jnp.sin(q[0]) + length * jnp.sin(q[1]),
            q[2] - l1 * jnp.cos(q[0]) - length * jnp.cos(q[1]),
            q[0] - params["speed"] * t,
        ]
    )


@drawings.Drawing
def drawing(q, t, params: PyTree):
    """Crank, rod and slider, which runs on the x axis; the rod's displacements are to scale."""
    l1, l2 = params["l"]
    pin = l1 * np.array([np.cos(q[0]), np.sin(q[0])])
    s = np.linspace(0, 1, 13)
    across = q[3] * np.sin(PI * s) + q[4] * np.sin(2 * PI * s)
    along = l2 * s + 4 * q[5] * s * (1 - s) + q[6] * s * (2 * s - 1)
    c, d = np.cos(q[1]), np.sin(q[1])
    rod = pin + np.stack([c * along - d * across, d * along + c * across], axis=-1)
    return [
        drawings.bar(np.zeros(2), pin),
        drawings.Shape(rod, "spring"),
        drawings.block((q[2], 0.0), 0.06, 0.04),
        drawings.ground((0.1, -0.02), (0.5, -0.02), 0.015, 16),
    ]


def flexible_slider_crank(stiffening: bool = False, damping: bool = False) -> Scene:
    """The crank turns by 15 rad at 150 rad/s, from the stretched position. The rod hardly vibrates at first.

    The published end values are those without stiffening and damping. The undamped rod bends at 1.3e3 and 5.1e3 rad/s
    and vibrates lengthwise at 6.6e3 and 2.3e4 rad/s. To reproduce the published values, steps must resolve all of
    these. The start is the published one, except for the slider's position, which is rounded to 1e-10 m there.

    Args:
        stiffening: whether tension stiffens the rod.
        damping: whether the rod's vibrations are damped, by half a per cent.

    >>> from hhtjax.scenes.flexible_slider_crank import flexible_slider_crank
    >>> [round(float(x), 3) for x in flexible_slider_crank().v0[:2]]
    [150.0, -74.996]
    """
    area, m2, l1, l2 = 0.008**2, 0.151104, 0.15, 0.3
    along = np.array([[115.41877276323955, -131.344243996026], [-131.344243996026, 210.8710918578409]])
    D = np.block([[np.diag([5.0, 25.0]), np.zeros((2, 2))], [np.zeros((2, 2)), along]])
    params = {"m": array([m2, 0.075552]), "J": array([0.002727, 0.0045339259]), "l": array([l1, l2])}
    params |= {"EA": 2e11 * area, "EI": 2e11 * area**2 / 12, "speed": 150.0}
    params |= {"D": array(damping * D), "stiffening": float(stiffening)}
    u1, u2 = 1.03339863e-05, 1.69327969e-05
    w1_dot, w2_dot, u1_dot, u2_dot = (
        0.444896112581599,
        0.00463433931923867,
        -1.78591076000055e-06,
        -2.68938671997904e-06,
    )
    q0 = array([0.0, 0.0, l1 + l2 + u2, 0.0, 0.0, u1, u2])
    v0 = array([150.0, -150.0 * l1 / (l2 + u2), u2_dot, w1_dot, w2_dot, u1_dot, u2_dot])
    return Scene(System(mass, force, constraint), params, q0, v0, 0.1, drawing)
