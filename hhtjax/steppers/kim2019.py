"""The three steps of Kim et al. (2019), literally, for comparison and reproduction.

M. Kim et al., J. Mech. Sci. Tech. 33(3), 2019, 1087-1096. For your own problems use `hht`, which has second order where
these do not.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from hhtjax.description import Array, PyTree, Real, is_concrete
from hhtjax.jaxpr import linear_map
from hhtjax.numerics.dense_lu import factorize
from hhtjax.numerics.linear_solve import solve
from hhtjax.steppers.implicit_solve import newton
from hhtjax.steppers.options import Options, check_options, require_alpha
from hhtjax.steppers.residual import hht_coefficients
from hhtjax.steppers.stepper import Info, State, Stepper
from hhtjax.systems import kinematics
from hhtjax.systems.constraints import acceleration_and_multipliers, reaction

if TYPE_CHECKING:
    from hhtjax.systems.flat_system import FlatSystem


def linearize_at_state(system: FlatSystem, params: PyTree, s: State):
    """M_n, Q_n, and the columns of Q_q - (M a)_q and of Q_v, all at (q_n, v_n, t_n)."""

    def forces(q: Array, v: Array) -> Array:
        return system.force(q, v, s.t, params)

    zero = jnp.zeros_like(s.v)
    Q, tangent = jax.linearize(forces, s.q, s.v)
    Q_q = linear_map(lambda x: tangent(system.located(x), zero), zero)
    Q_v = linear_map(lambda x: tangent(system.located(zero), x), zero)
    Ma_q = system.widened(jax.jacfwd(lambda q: system.inertia(q, s.w, s.t, params))(s.q))
    return system.full_mass(s.q, s.t, params), Q, Q_q, Q_v, Ma_q


@dataclass(frozen=True, eq=False)
class KimHHT(Stepper):
    """Kim's step; made by `kim_hht`."""

    alpha: Any
    order: int

    def begin(self, system: FlatSystem, q: Array, v: Array, t: Array, params: PyTree, dt: Array) -> State:
        """a_0 = M^-1 Q."""
        return State(t, q, v, system.acceleration(q, v, t, params))

    def bind(self, system: FlatSystem, params: PyTree, dt: Array):
        """Eq. 10-14. The field w of the state holds a, which recursion (12) updates."""
        alpha = self.alpha
        beta, gamma = hht_coefficients(alpha)[2:]

        def step(s: State):
            M, Q, Q_q, Q_v, Ma_q = linearize_at_state(system, params, s)
            Jq, Jv = (1 + alpha) * Q_q - Ma_q, (1 + alpha) * Q_v
            drift = s.v + dt / 2 * (1 - 2 * beta / gamma) * s.w
            dv = solve(M - dt * gamma * Jv - dt**2 * beta * Jq, dt * (Q + gamma * dt * Jq @ drift))
            dq = dt * (drift + beta / gamma * dv)
            a = dv / (dt * gamma) + (1 - 1 / gamma) * s.w
            return State(s.t + dt, s.q + system.located(dq), s.v + dv, a), Info()

        return step


@dataclass(frozen=True, eq=False)
class ConventionalHHT(Stepper):
    """The method that Kim's step is derived from; made by `conventional_hht`."""

    alpha: Any
    order: int
    fictive_time: bool
    options: Options

    solves_constraints = True
    solves_rotations = True

    def begin(self, system: FlatSystem, q: Array, v: Array, t: Array, params: PyTree, dt: Array) -> State:
        """a_0 = M^-1 Q, with the reactions of constraints in Q."""
        if system.num_constraints:
            a, L = acceleration_and_multipliers(system, q, v, t, params)
            return State(t, q, v, a, L=L)
        return State(t, q, v, system.acceleration(q, v, t, params))

    def bind(self, system: FlatSystem, params: PyTree, dt: Array):
        """Eq. 5-7, with Eq. 1 for q1 and v1. The field w of the state holds a."""
        alpha = self.alpha
        beta, gamma = hht_coefficients(alpha)[2:]
        late = (1 + alpha) * dt if self.fictive_time else dt

        n, m = system.size, system.num_constraints

        def force(s: State, t: Array) -> Array:
            Q = system.force(s.q, s.v, t, params)
            return Q + reaction(system, s.q, s.t, params, s.L) if m else Q

        def step(s: State):
            Q0 = force(s, s.t)

            def path(z: Array):
                a = z[:n]
                x = dt * s.v + dt**2 * ((0.5 - beta) * s.w + beta * a)
                v = s.v + dt * ((1 - gamma) * s.w + gamma * a)
                v, a, _ = kinematics.end_of_chart(system.blocks, x, v, a, a)
                return State(s.t + dt, system.move(s.q, x), v, a, L=z[n:] if m else None, memory=x)

            def r(s1: State) -> Array:
                now = system.inertia(s1.q, s1.w, s1.t, params) - (1 + alpha) * force(s1, s.t + late)
                # both terms in components that work on the rate of x; for Q0 that is so already
                now = kinematics.pull_back(system.blocks, s1.memory, now) + alpha * Q0
                if not m:
                    return now
                return jnp.concatenate([now, system.constraint(s1.q, s1.t, params) / (beta * dt**2)])

            z = jnp.concatenate([s.w, s.L]) if m else s.w
            z, info = newton(system, r, path, z, s, factorize, self.options.tolerance, self.options.max_iterations)
            return system.tidy(path(z)._replace(memory=None)), info

        return step


@dataclass(frozen=True, eq=False)
class KimImplicitEuler(Stepper):
    """Kim's baseline; made by `kim_implicit_euler`."""

    order: int = 1

    def begin(self, system: FlatSystem, q: Array, v: Array, t: Array, params: PyTree, dt: Array) -> State:
        """w_0 = M^-1 Q."""
        return State(t, q, v, system.acceleration(q, v, t, params))

    def bind(self, system: FlatSystem, params: PyTree, dt: Array):
        """(M - h Q_v - h^2 Jq) dv = h (Q + h Jq v), Jq = Q_q - (M w)_q, then q1 = q + h v1."""

        def step(s: State):
            M, Q, Q_q, Q_v, Ma_q = linearize_at_state(system, params, s)
            Jq = Q_q - Ma_q
            v = s.v + solve(M - dt * Q_v - dt**2 * Jq, dt * (Q + dt * Jq @ s.v))
            q, t = s.q + system.located(dt * v), s.t + dt
            return State(t, q, v, system.acceleration(q, v, t, params)), Info()

        return step


def kim_hht(alpha: Real = 0.0) -> KimHHT:
    """The non-iterative HHT-alpha step of Kim et al. (2019), Eq. 8-14, as printed.

        Jq = (1 + alpha) Q_q - (M a)_q,   Jv = (1 + alpha) Q_v                 at (q, v, t)
        (M - h gamma Jv - h^2 beta Jq) dv = h [Q + gamma h Jq (v + (h/2)(1 - 2 beta/gamma) a)]
        dq = h [v + (h/2)(1 - 2 beta/gamma) a + (beta/gamma) dv]
        a1 = dv/(h gamma) + (1 - 1/gamma) a

    Order 2 only for alpha = 0 and forces without explicit time; order 1 otherwise. All tables of the paper were
    computed with alpha = 0. `solution.acceleration` holds a. Its recursion never evaluates the equation of motion
    again, so a does not satisfy it exactly.

    Args:
        alpha: in [-1/3, 0].

    Returns:
        A `Stepper`.

    Raises:
        TypeError, ValueError: an argument of the wrong kind, or out of its range.

    >>> import hhtjax
    >>> hhtjax.kim_hht(alpha=0.0).order, hhtjax.kim_hht(alpha=-0.1).order
    (2, 1)
    """
    alpha = require_alpha("kim_hht", alpha)
    return KimHHT(alpha, _order(alpha))


def conventional_hht(
    alpha: Real = 0.0, fictive_time: bool = True, tolerance: Real = 1e-10, max_iterations: int = 20
) -> ConventionalHHT:
    """The conventional, iterative HHT-alpha of Kim et al. (2019), Eq. 1-7, as printed.

        M(q1) a1 = (1 + alpha) Q(q1, v1, t~) - alpha Q(q, v, t),   t~ = t + (1 + alpha) h,

    Newton solves it, with q1 and v1 from Newmark's formulas. Order 2 for alpha = 0, and for constant M and forces
    without explicit time; otherwise order 1. The reasons: M(q1) multiplies an acceleration at the time t + (1 + alpha)
    h, and the weights and t~ both contain alpha, so it counts twice. `hht(alpha, iterations=None)` is the method
    without these faults.

    With rotations and constraints it is the step of Cardona and Geradin (1989), Eq. 36 and 73-81: Phi(q1) = 0, with B^T
    L among the forces. In the chart of the rotation vector psi from R, forces at different times are combined as forces
    conjugate to psidot,

        T(psi)^T [J A1 - (1 + alpha) Q1] + alpha Q = 0

    which has order 1 too, for every alpha but 0, unless J is spherical.

    Args:
        alpha: in [-1/3, 0].
        fictive_time: False for t~ = t + h, the form of Cardona and Geradin (1989), Eq. 79.
        tolerance, max_iterations: as in `hht`.

    `solution.acceleration` holds a, which is the acceleration at the time t + alpha h.

    Returns:
        A `Stepper`.

    Raises:
        TypeError, ValueError: an argument of the wrong kind, or out of its range.

    >>> import hhtjax
    >>> hhtjax.conventional_hht(alpha=0.0).order, hhtjax.conventional_hht(alpha=-0.1).order
    (2, 1)
    """
    alpha = require_alpha("conventional_hht", alpha)
    if not isinstance(fictive_time, bool):
        raise TypeError(f"conventional_hht: `fictive_time` must be True or False; received {fictive_time!r}.")
    options = check_options("conventional_hht", iterations=None, tolerance=tolerance, max_iterations=max_iterations)
    return ConventionalHHT(alpha, _order(alpha), fictive_time, options)


def kim_implicit_euler() -> KimImplicitEuler:
    """The non-iterative implicit Euler step with which Kim et al. (2019) compare.

        a = M^-1 Q,   Jq = Q_q - (M a)_q                                        at (q, v, t)
        (M - h Q_v - h^2 Jq) dv = h (Q + h Jq v),   v1 = v + dv,   q1 = q + h v1

    Order 1. The paper omits the term (M a)_q, but its numbers can only be reproduced with it.

    >>> import hhtjax
    >>> hhtjax.kim_implicit_euler().order
    1
    """
    return KimImplicitEuler()


def _order(alpha: Real) -> int:
    return 2 if is_concrete(alpha) and alpha == 0 else 1
