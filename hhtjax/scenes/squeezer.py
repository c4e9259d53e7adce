"""Andrews' squeezing mechanism: seven bodies, seven angles, six constraints. SI units.

A constant moment turns the crank K1. Its coupler K2 ends in a joint P, which connects three more branches: K3, which
is pivoted at B and held by a spring; K4 on K5; and K6 on K7. K5 and K7 are pivoted at A.

q = (beta, theta, gamma, phi, delta, omega, epsilon): the angles in rad of K1, of K2 relative to K1, of K3, of K4
relative to K5, of K5, of K6 relative to K7, and of K7. Lengths, masses m and moments of inertia I (7,), and the pivots
A, B, C have the names of the test set. c0 (N/m) and l0 (m) are stiffness and rest length of the spring from K3 to C.

References:
    Schiehlen (ed.), Multibody Systems Handbook (1990); Mazzia, Magherini, Test Set for IVP Solvers (2008), problem
    "Andrews' squeezing mechanism"; Cardona, Geradin (1989), Sec. 4.3. Multipliers here are minus those of the test set.
"""

from __future__ import annotations

from operator import itemgetter

import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import block_diag

from hhtjax.checks import require_number
from hhtjax.description import Array, PyTree, Real
from hhtjax.scenes import drawings
from hhtjax.scenes.scene import Scene, array
from hhtjax.systems.system import System


def along(angle: Array) -> Array:
    """The unit vector at an angle from the x axis."""
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)])


def across(angle: Array):
    """The vector of `along`, turned by a right angle."""
    return jnp.stack([-jnp.sin(angle), jnp.cos(angle)])


def mass(q: Array, params: PyTree) -> Array:
    """M, block diagonal: K1 and K2; K3; K4 and K5; K6 and K7."""
    _, theta, _, phi, _, omega, _ = q
    m1, m2, m3, m4, m5, m6, m7 = params["m"]
    I1, I2, I3, I4, I5, I6, I7 = params["I"]
    ra, rr, da, sa, sb, ta, tb = itemgetter("ra", "rr", "da", "sa", "sb", "ta", "tb")(params)
    e, ea, zt, zf, fa, u, ua, ub = itemgetter("e", "ea", "zt", "zf", "fa", "u", "ua", "ub")(params)

    def two_bars(inner: Array, outer: Array, coupling: Array):
        """The entries M11, M12 and M22 of an inner and an outer bar. inner, outer: inertias about pivot and joint;
        inner includes the outer mass at the joint."""
        return inner + 2 * coupling + outer, outer + coupling, outer

    K1, K12, K2 = two_bars(I1 + m1 * ra**2 + m2 * rr**2, I2 + m2 * da**2, -m2 * rr * da * jnp.cos(theta))
    K5, K45, K4 = two_bars(
        I5 + m5 * (ta**2 + tb**2) + m4 * zt**2, I4 + m4 * (e - ea) ** 2, m4 * zt * (e - ea) * jnp.sin(phi)
    )
    K7, K67, K6 = two_bars(
        I7 + m7 * (ua**2 + ub**2) + m6 * u**2, I6 + m6 * (zf - fa) ** 2, -m6 * u * (zf - fa) * jnp.sin(omega)
    )
    K3 = I3 + m3 * (sa**2 + sb**2)
    blocks = [[K1, K12], [K12, K2]], [[K3]], [[K4, K45], [K45, K5]], [[K6, K67], [K67, K7]]
    return block_diag(*map(jnp.array, blocks))


def spring_moment(gamma: Array, params: PyTree) -> Array:
    """Moment of the spring on K3 about B."""
    sd, sc, c0, l0, B, C = itemgetter("sd", "sc", "c0", "l0", "B", "C")(params)
    spring = B + sd * along(gamma) - sc * across(gamma) - C
    length = jnp.sqrt(jnp.sum(spring**2))
    return -c0 * (1 - l0 / length) * jnp.sum(spring * (sd * across(gamma) + sc * along(gamma)))


def force(q: Array, v: Array, t: Real, params: PyTree) -> Array:
    """Q: the moment on the crank, the spring, and the inertia forces within the pairs of bars."""
    _, theta, gamma, phi, _, omega, _ = q
    beta_dot, theta_dot, _, phi_dot, delta_dot, omega_dot, epsilon_dot = v
    m2, m4, m6 = params["m"][1], params["m"][3], params["m"][5]
    rr, da, e, ea, zt, zf, fa, u = itemgetter("rr", "da", "e", "ea", "zt", "zf", "fa", "u")(params)

    def two_bars(slope: Array, inner: Array, outer: Array):
        """Inertia forces on the inner and the outer bar; slope: the derivative of their coupling in M."""
        return -slope * outer * (outer + 2 * inner), slope * inner**2

    K1, K2 = two_bars(m2 * rr * da * jnp.sin(theta), beta_dot, theta_dot)
    K5, K4 = two_bars(m4 * zt * (e - ea) * jnp.cos(phi), delta_dot, phi_dot)
    K7, K6 = two_bars(-m6 * u * (zf - fa) * jnp.cos(omega), epsilon_dot, omega_dot)
    return jnp.array([K1 + params["moment"], K2, spring_moment(gamma, params), K4, K5, K6, K7])


def constraint(q: Array, t: Real, params: PyTree) -> Array:
    """Phi: P as the end of K2, minus P as the end of K3, of K4 on K5, and of K6 on K7; two components each."""
    beta, theta, gamma, phi, delta, omega, epsilon = q
    rr, d, ss, e, zt, zf, u, A, B = itemgetter("rr", "d", "ss", "e", "zt", "zf", "u", "A", "B")(params)
    P = rr * along(beta) - d * along(beta + theta)
    return jnp.concatenate(
        [
            P - (B - ss * across(gamma)),
            P - (A + zt * along(delta) - e * across(phi + delta)),
            P - (A + zf * along(omega + epsilon) - u * across(epsilon)),
        ]
    )


@drawings.Drawing
def drawing(q, t, params: PyTree):
    """The bars, branch by branch, starting with K1 and K2; and the spring."""
    beta, theta, gamma, _, delta, _, epsilon = q
    A, B, C = (params[x] for x in "ABC")

    def along(angle):
        return np.array([np.cos(angle), np.sin(angle)])

    def across(angle):
        return np.array([-np.sin(angle), np.cos(angle)])

    crank = params["rr"] * along(beta)
    P = crank - params["d"] * along(beta + theta)
    held = B + params["sd"] * along(gamma) - params["sc"] * across(gamma)
    return [
        drawings.bar(np.zeros(2), crank, P),
        drawings.bar(B, P, held, B),
        drawings.bar(A, A + params["zt"] * along(delta), P),
        drawings.bar(A, A - params["u"] * across(epsilon), P),
        drawings.spring(held, C, 0.008),
    ]


def squeezer(moment: float = 0.033) -> Scene:
    """From rest under a constant moment on the crank. With the default moment it turns two and a half times in 0.03 s.

    q0 closes the loops only for the lengths of the test set.

    Args:
        moment: moment on the crank, N m.

    Raises:
        TypeError, ValueError: moment is not a finite number.
    """
    params = {
        "m": array([0.04325, 0.00365, 0.02373, 0.00706, 0.07050, 0.00706, 0.05498]),
        "I": array([2.194e-6, 4.410e-7, 5.255e-6, 5.667e-7, 1.169e-5, 5.667e-7, 1.912e-5]),
        "A": array([-0.06934, -0.00227]),
        "B": array([-0.03635, 0.03273]),
        "C": array([0.014, 0.072]),
        "moment": require_number("squeezer", "moment", moment, np.isfinite, "be finite"),
    }
    params |= {"rr": 0.007, "ra": 0.00092, "d": 0.028, "da": 0.0115}  # K1, K2
    params |= {"ss": 0.035, "sa": 0.01874, "sb": 0.01043, "sc": 0.018, "sd": 0.02, "c0": 4530.0, "l0": 0.07785}  # K3
    params |= {"e": 0.02, "ea": 0.01421, "zt": 0.04, "ta": 0.02308, "tb": 0.00916}  # K4, K5
    params |= {"zf": 0.02, "fa": 0.01421, "u": 0.04, "ua": 0.01228, "ub": 0.00449}  # K6, K7
    gamma, phi, delta, epsilon = 0.455279819163070380, 0.222668390165885885, 0.487364979543842550, 1.23054744454982119
    q0 = array([-0.0617138900142764496, 0.0, gamma, phi, delta, -phi, epsilon])
    return Scene(System(mass, force, constraint), params, q0, array(np.zeros(7)), 0.03, drawing)
