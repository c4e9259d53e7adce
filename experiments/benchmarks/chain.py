"""A planar chain of N pendulums, in absolute angles: the scene for systems of many unknowns. SI units.

Point masses m at the ends of massless links of length l, angles q from the downward vertical, springs k and dampers c
between neighbours. With mu_ij = m (N - max(i, j)), the mass that hangs on both links,

    M_ij = mu_ij l^2 cos(q_i - q_j),    Q_i = -sum_j mu_ij l^2 sin(q_i - q_j) v_j^2 - mu_ii g l sin q_i + joint torques
"""

import jax.numpy as jnp
import numpy as np

from hhtjax.scenes.scene import Scene
from hhtjax.systems.system import System


def hanging(N, params):
    """mu_ij l^2."""
    i = np.arange(float(N))
    return params["m"] * params["l"] ** 2 * (N - np.maximum(i[:, None], i[None, :]))


def joint_torques(q, v, params):
    """Of springs and dampers between neighbours, the first of them to the ceiling."""
    relative, rates = (jnp.diff(x, prepend=0.0) for x in (q, v))
    torque = -params["k"] * relative - params["c"] * rates
    return torque - jnp.append(torque[1:], 0.0)


def weight(q, params):
    """-mu_ii g l sin q_i."""
    N = q.size
    return -params["m"] * params["g"] * params["l"] * (N - np.arange(float(N))) * jnp.sin(q)


def mass(q, params):
    """M, with the cosines of all differences: N^2 of them."""
    return hanging(q.size, params) * jnp.cos(q[:, None] - q[None, :])


def force(q, v, t, params):
    """Q, with the sines of all differences."""
    spin = (hanging(q.size, params) * jnp.sin(q[:, None] - q[None, :])) @ v**2
    return joint_torques(q, v, params) + weight(q, params) - spin


def mass_by_2n(q, params):
    """The same M from 2 N values: cos(a - b) = cos a cos b + sin a sin b."""
    s, c = jnp.sin(q), jnp.cos(q)
    return hanging(q.size, params) * (c[:, None] * c[None, :] + s[:, None] * s[None, :])


def force_by_2n(q, v, t, params):
    """The same Q from 2 N values: sin(a - b) = sin a cos b - cos a sin b."""
    s, c = jnp.sin(q), jnp.cos(q)
    mu, v2 = hanging(q.size, params), v**2
    spin = s * (mu @ (c * v2)) - c * (mu @ (s * v2))
    return joint_torques(q, v, params) + weight(q, params) - spin


def inertia_by_2n(q, w, params):
    """M(q) w without M: the Jacobian takes products of N x N matrices, and no N x N x N array."""
    s, c = jnp.sin(q), jnp.cos(q)
    mu = hanging(q.size, params)
    return c * (mu @ (c * w)) + s * (mu @ (s * w))


FORMULATIONS = {
    "N^2 sines": System(mass, force),
    "2 N sines": System(mass_by_2n, force_by_2n, inertia=inertia_by_2n),
}


def chain(N, k=0.0, c=0.0, formulation="2 N sines", duration=1.0) -> Scene:
    """N links of 1/N m and 1/N kg, held out at 60 degrees from the vertical and let go.

    Args:
        N: their number. k, c: stiffness (N m/rad) and damping (N m s/rad) of the joints.
        formulation: a key of FORMULATIONS.
    """
    params = {"m": 1 / N, "l": 1 / N, "k": k, "c": c, "g": 9.81}
    return Scene(FORMULATIONS[formulation], params, jnp.full(N, np.pi / 3), jnp.zeros(N), duration)
