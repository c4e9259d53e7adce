"""Operator splitting: implicit with the initial tangent, explicit for the rest of the force. A baseline.

M. Nakashima, T. Kaminosono, M. Ishida, K. Ando, 4th U.S. Nat. Conf. Earthquake Eng., 1990; D. Combescure, P. Pegon,
Soil Dyn. Earthquake Eng. 16, 1997, 427-443: the methods with which Kim et al. (2019) compare (refs. 12-14). For your
own problems use `hht`, which linearises anew in every step.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp

from hhtjax.description import Array, PyTree, Real, is_concrete
from hhtjax.numerics.batched_cond import tree_where
from hhtjax.numerics.dense_lu import matvec
from hhtjax.numerics.linear_solve import solve
from hhtjax.steppers.generalized_alpha import GeneralizedAlpha
from hhtjax.steppers.options import check_options, require_alpha
from hhtjax.steppers.residual import hht_coefficients
from hhtjax.steppers.stepper import Info, State, Stepper

if TYPE_CHECKING:
    from hhtjax.systems.flat_system import FlatSystem


class Memory(NamedTuple):
    """K, C: initial stiffness and damping, (n, n); P: the weighted force at the end of the last step, (n,)."""

    K: Array
    C: Array
    P: Array


@dataclass(frozen=True, eq=False)
class OperatorSplitting(Stepper):
    """The method, in both forms; made by `operator_splitting`."""

    alpha: Any
    modified: bool
    order: int

    def begin(self, system: FlatSystem, q: Array, v: Array, t: Array, params: PyTree, dt: Array) -> State:
        """a_0 = M^-1 Q, and the tangent used for the whole run."""
        K, C = (-jax.jacfwd(system.force, argnums=i)(q, v, t, params) for i in (0, 1))
        memory = Memory(system.widened(K), C, self.weighted_force(system, q, v, t, params))
        return State(t, q, v, system.acceleration(q, v, t, params), memory=memory)

    def smoothed(
        self,
        system: FlatSystem,
        state: State,
        params: PyTree,
        dt: Array,
        moves: bool = True,
        resolves: bool = False,
        alone: bool = False,
    ) -> State:
        """The state from which the first step starts, as in the `hht` family."""
        s = self.hht.smoothed(system, state._replace(memory=None), params, dt, moves, resolves, alone)
        return self.begun(system, s, params, state.memory)

    def begun(self, system: FlatSystem, s: State, params: PyTree, memory: Memory) -> State:
        """Converts a state of the `hht` family to one of this method."""
        left = system.residual(s.q, s.v, s.w, s.t, params)  # not 0 of what is stiff
        P = self.weighted_force(system, s.q, s.v, s.t, params) + left
        return s._replace(a=None, memory=memory._replace(P=P))

    def throws(self, system):
        """True if there are positions."""
        return system.positions > 0

    def grown(self, system: FlatSystem, state, params: PyTree, dt: Array):
        """As in the `hht` family."""
        s = self.hht.grown(system, state._replace(a=state.w, memory=None), params, dt)
        return tree_where(jnp.any(s.v != state.v), self.begun(system, s, params, state.memory), state)

    def jumped(self, system: FlatSystem, before, after, old, new, dt: Array, answer):
        """The state after a jump of held inputs, as in `hht`; P is updated by the change of the forces."""
        K, C, P = before.memory
        both = before._replace(memory=None), after._replace(memory=None)
        s = self.hht.jumped(system, *both, old, new, dt, answer)

        def unweighted(s, params: PyTree):
            return system.force(s.q, s.v, s.t, params) - self.weighted_force(system, s.q, s.v, s.t, params)

        change = system.inertia(s.q, s.w - before.w, s.t, new)
        P = P + change - (unweighted(s, new) - unweighted(before, old))
        return s._replace(memory=Memory(K, C, P))

    @property
    def hht(self) -> Stepper:
        """The method of the `hht` family to which it is equal on linear systems."""
        return GeneralizedAlpha(hht_coefficients(self.alpha), 2, check_options("operator_splitting"))

    def weighted_force(self, system: FlatSystem, q: Array, v: Array, t: Array, params: PyTree) -> Array:
        """P, the force that alpha weighs: Q, or in the modified form Q at rest."""
        return system.force(q, jnp.zeros_like(v) if self.modified else v, t, params)

    def bind(self, system: FlatSystem, params: PyTree, dt: Array):
        """The step. The field w of the state holds a."""
        alpha = self.alpha
        beta, gamma = hht_coefficients(alpha)[2:]

        def step(s: State):
            K, C, P0 = s.memory
            stiffness, damping = dt**2 * beta * K, dt * gamma * C  # what a1 takes off the predicted forces
            implicit = stiffness + damping
            weighted = stiffness if self.modified else implicit

            t = s.t + dt
            guess = s.w if system.positions == 0 else jnp.zeros_like(s.w)  # of a1; of y', whose M is 1, as it was
            q = s.q + system.located(dt * s.v) + system.located(dt**2 * (0.5 - beta) * s.w)
            v = s.v + dt * ((1 - gamma) * s.w + gamma * guess)
            Q = system.force(q, v, t, params)
            P = self.weighted_force(system, q, v, t, params)
            a = solve(system.full_mass(q, t, params) + implicit + alpha * weighted, Q - guess + alpha * (P - P0))
            memory = Memory(K, C, P - matvec(weighted, a))
            return State(t, q + system.located(dt**2 * beta * a), v + dt * gamma * a, guess + a, memory=memory), Info()

        return step


def operator_splitting(alpha: Real = -0.05, modified: bool = False) -> OperatorSplitting:
    """The alpha-operator-splitting method: one solve per step, and no Jacobian but the one at the start.

        q~ = q + h v + h^2 (1/2 - beta) a,   v~ = v + h (1 - gamma) a,   beta = (1 - alpha)^2/4,  gamma = 1/2 - alpha
        q1 = q~ + h^2 beta a1,   v1 = v~ + h gamma a1
        Q1 = Q(q~, v~, t1) - K0 (q1 - q~) - C0 (v1 - v~),   K0 = -Q_q,  C0 = -Q_v  at the start of the run
        M(q~) a1 = Q1 + alpha (P1 - P)

    P is Q. With `modified` it is the force at rest, P1 = Q(q~, 0, t1) - K0 (q1 - q~), so alpha does not weigh the
    damping. The sources assume a constant M; XLA then factorises it once per run. M(q~) is an extension, and K0 does
    not contain -(M a)_q.

    Order 2 for constant M and C = -Q_v, with any stiffness and explicit time; with `modified` and alpha other than 0
    only if C = 0. Otherwise order 1: v~ has an error O(h), and so has every velocity-dependent force that C0 does not
    contain (such as centrifugal forces, so every mechanism). `order` is the one for constant M and C. On linear systems
    the standard form is equal to `hht(alpha)`. For a `FirstOrderSystem` v~ = y + h (1 - gamma) y' + h gamma y' = y + h
    y', and the order is the same for any f(y, t).

    An undamped oscillator of mass m, with stiffness k now and k0 at the start, is stable for

        -4 alpha k <= (1 - alpha)^2 k0    and    h^2 [(1 - 4 alpha^2) (k - k0) - (1 + 2 alpha) alpha^2 k0] <= 4 m:

    for every h while it softens. Once it has stiffened beyond the first bound (1.4 times for alpha = -0.3, 5.5 for
    -0.05) its amplitude grows for every h, however small, at a rate O(h^3). With alpha = 0 the second bound is h^2 (k -
    k0) <= 4 m: q~ then takes the steps of velocity Verlet with the mass M + h^2 K0/4.

    Runs start as those of `hht` do, not with a = M^-1 Q as in the sources.

    `solution.acceleration` holds a, which is the acceleration at the time t + alpha h.

    Args:
        alpha: in [-1/3, 0].
        modified: True for the form in which numerical damping acts on the stiffness force only.

    Returns:
        A `Stepper`.

    Raises:
        ValueError, TypeError: an argument out of its range or of the wrong kind.

    >>> import hhtjax
    >>> hhtjax.operator_splitting(alpha=-0.1).order, hhtjax.operator_splitting(alpha=-0.1, modified=True).order
    (2, 1)
    """
    alpha = require_alpha("operator_splitting", alpha)
    if not isinstance(modified, bool):
        raise TypeError(f"operator_splitting: `modified` must be True or False; received {modified!r}.")
    order = 2 if not modified or (is_concrete(alpha) and alpha == 0) else 1
    return OperatorSplitting(alpha, modified, order)
