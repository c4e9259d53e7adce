"""The two non-iterative steps of Kim et al. (2019), literally, for comparison and reproduction.

M. Kim et al., J. Mech. Sci. Tech. 33(3), 2019, 1087-1096. For work, use `hht`: it is second order
where these are not.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from hhtjax.boundary import require_number
from hhtjax.description import is_concrete
from hhtjax.linear_solve import solve
from hhtjax.steppers.stepper import Info, State, Stepper


def linearize_at_state(system, params, s):
    """M_n, Q_n, and the columns of Q_q - (M a)_q and of Q_v, all at (q_n, v_n, t_n)."""

    def forces(q, v):
        return system.force(q, v, s.t, params)

    eye = jnp.eye(s.q.size, dtype=s.q.dtype)
    Q, tangent = jax.linearize(forces, s.q, s.v)
    Q_q = jax.vmap(lambda e: tangent(e, jnp.zeros_like(e)), out_axes=1)(eye)
    Q_v = jax.vmap(lambda e: tangent(jnp.zeros_like(e), e), out_axes=1)(eye)
    Ma_q = jax.jacfwd(lambda q: system.inertia(q, s.w, params))(s.q)
    M = system.mass(s.q, params)
    return jnp.diag(M) if M.ndim == 1 else M, Q, Q_q, Q_v, Ma_q


@dataclass(frozen=True, eq=False)
class KimHHT(Stepper):
    """Kim's step; made by `kim_hht`."""

    alpha: Any
    order: int

    def begin(self, system, q, v, t, params, dt):
        """a_0 = M^-1 Q."""
        return State(t, q, v, system.acceleration(q, v, t, params))

    def bind(self, system, params, dt):
        """Eq. 10-14. The field w of the state holds a, which the recursion (12) carries on."""
        alpha = self.alpha
        beta, gamma = (1 - alpha) ** 2 / 4, 0.5 - alpha

        def step(s):
            M, Q, Q_q, Q_v, Ma_q = linearize_at_state(system, params, s)
            Jq, Jv = (1 + alpha) * Q_q - Ma_q, (1 + alpha) * Q_v
            drift = s.v + dt / 2 * (1 - 2 * beta / gamma) * s.w
            dv = solve(M - dt * gamma * Jv - dt**2 * beta * Jq, dt * (Q + gamma * dt * Jq @ drift))
            dq = dt * (drift + beta / gamma * dv)
            a = dv / (dt * gamma) + (1 - 1 / gamma) * s.w
            return State(s.t + dt, s.q + dq, s.v + dv, a), Info()

        return step


@dataclass(frozen=True, eq=False)
class KimImplicitEuler(Stepper):
    """Kim's baseline; made by `kim_implicit_euler`."""

    order: int = 1

    def begin(self, system, q, v, t, params, dt):
        """w_0 = M^-1 Q."""
        return State(t, q, v, system.acceleration(q, v, t, params))

    def bind(self, system, params, dt):
        """(M - h Q_v - h^2 Jq) dv = h (Q + h Jq v), Jq = Q_q - (M w)_q, then q1 = q + h v1."""

        def step(s):
            M, Q, Q_q, Q_v, Ma_q = linearize_at_state(system, params, s)
            Jq = Q_q - Ma_q
            v = s.v + solve(M - dt * Q_v - dt**2 * Jq, dt * (Q + dt * Jq @ s.v))
            q, t = s.q + dt * v, s.t + dt
            return State(t, q, v, system.acceleration(q, v, t, params)), Info()

        return step


def kim_hht(alpha=0.0) -> KimHHT:
    """The non-iterative HHT-alpha step of Kim et al. (2019), Eq. 8-14, as printed.

        Jq = (1 + alpha) Q_q - (M a)_q,   Jv = (1 + alpha) Q_v                 at (q, v, t)
        (M - h gamma Jv - h^2 beta Jq) dv = h [Q + gamma h Jq (v + (h/2)(1 - 2 beta/gamma) a)]
        dq = h [v + (h/2)(1 - 2 beta/gamma) a + (beta/gamma) dv]
        a1 = dv/(h gamma) + (1 - 1/gamma) a

    Order 2 only for alpha = 0 and forces without explicit time; order 1 otherwise. All tables of the
    paper were computed with alpha = 0. `solution.acceleration` holds a, whose recursion never
    meets the equation of motion again.

    Args:
        alpha: in [-1/3, 0].

    >>> import hhtjax
    >>> hhtjax.kim_hht(alpha=0.0).order, hhtjax.kim_hht(alpha=-0.1).order
    (2, 1)
    """
    alpha = require_number("kim_hht", "alpha", alpha, lambda x: -1 / 3 - 1e-12 <= x <= 0, "lie in [-1/3, 0]")
    return KimHHT(alpha, 2 if is_concrete(alpha) and alpha == 0 else 1)


def kim_implicit_euler() -> KimImplicitEuler:
    """The non-iterative implicit Euler step Kim et al. (2019) compare with.

        a = M^-1 Q,   Jq = Q_q - (M a)_q                                        at (q, v, t)
        (M - h Q_v - h^2 Jq) dv = h (Q + h Jq v),   v1 = v + dv,   q1 = q + h v1

    Order 1. The term (M a)_q, which the paper leaves out, is needed to find its numbers.

    >>> import hhtjax
    >>> hhtjax.kim_implicit_euler().order
    1
    """
    return KimImplicitEuler()
