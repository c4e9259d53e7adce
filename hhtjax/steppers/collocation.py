"""Collocation methods: the equation of motion holds at t + theta h, beyond the end of the step. Classical baselines.

The formulas are those of `collocation`; theta = 1 is Newmark's method.

E. Wilson, I. Farhoomand, K. Bathe, Earthquake Eng. Struct. Dyn. 1, 1973, 241-252; H. Hilber, T. Hughes, Earthquake Eng.
Struct. Dyn. 6, 1978, 99-117.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from hhtjax.checks import require_number
from hhtjax.description import Array, PyTree, Real
from hhtjax.numerics.dense_lu import factorize
from hhtjax.steppers.generalized_alpha import GeneralizedAlpha
from hhtjax.steppers.implicit_solve import newton
from hhtjax.steppers.options import Options, check_options
from hhtjax.steppers.residual import Coefficients, residual
from hhtjax.steppers.smooth_start import Corrections
from hhtjax.steppers.stepper import State, Stepper

if TYPE_CHECKING:
    from hhtjax.systems.flat_system import FlatSystem


def newmark_step(system: FlatSystem, s: State, h: Array, w: Array, beta: Real) -> State:
    """State at t + h by Newmark's formulas with gamma = 1/2, given the acceleration there."""
    t, q = s.t + h, s.q + system.located(h * s.v) + system.located(h**2 * ((0.5 - beta) * s.w + beta * w))
    return State(t, q, s.v + h / 2 * (s.w + w), w)


class Beginning(GeneralizedAlpha):
    """Newmark's method, used for the start of a collocation method.

    w+ = (1 - 4 R^3 + 3 R^4) M^-1 Q, which is (1 - R)^2 (1 + 2 R + 3 R^2) M^-1 Q. For a stiff damper h w+ falls to 0
    faster than with 1 - R^5. For a step that half resolves a layer, 1 - R^5 leaves an error of 5e-3 of F/k (1 - 50 q -
    5 v from rest), this formula 7e-4, and the best possible start, which uses the solution, 3e-4."""

    corrections = Corrections(4, -3.0)


@dataclass(frozen=True, eq=False)
class Collocation(Stepper):
    """A collocation method; made by `collocation` and `wilson`."""

    beta: Any
    theta: Any
    options: Options
    order: int = 2

    def begin(self, system: FlatSystem, q: Array, v: Array, t: Array, params: PyTree, dt: Array) -> State:
        """w0 = M^-1 Q."""
        return State(t, q, v, system.acceleration(q, v, t, params))

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
        """The state from which the first step starts, as in the `hht` family, for the step 2 theta h."""
        dt = 2 * self.theta * dt
        return self.beginning.smoothed(system, state, params, dt, moves, resolves, alone)._replace(a=None)

    def jumped(self, system: FlatSystem, before, after, old, new, dt: Array, answer):
        """The state after a jump of held inputs."""
        return self.beginning.jumped(system, before, after, old, new, 2 * self.theta * dt, answer)

    def throws(self, system):
        """True if there are positions."""
        return system.positions > 0

    def grown(self, system: FlatSystem, state, params: PyTree, dt: Array):
        """As in the `hht` family."""
        lagging = state._replace(a=state.w)
        return self.beginning.grown(system, lagging, params, 2 * self.theta * dt)._replace(a=None)

    @property
    def beginning(self) -> Beginning:
        """The method for the start of runs, and after jumps."""
        return Beginning(Coefficients(0.0, 0.0, self.beta, 0.5), 2, self.options)

    def bind(self, system: FlatSystem, params: PyTree, dt: Array):
        """Newton for w_c; the state carries w1, which obeys the equation of motion only within O(h^2)."""
        beta, theta, options = self.beta, self.theta, self.options
        r = partial(residual, system, params)

        def step(s: State):
            def path(w: Array):
                return newmark_step(system, s, theta * dt, w, beta)

            w, info = newton(system, r, path, s.w, s, factorize, options.tolerance, options.max_iterations)
            return newmark_step(system, s, dt, s.w + (w - s.w) / theta, beta), info

        return step


def collocation(beta: Any, theta: Any, tolerance: Real = 1e-10, max_iterations: int = 20) -> Collocation:
    """The collocation method of Hilber and Hughes, with gamma = 1/2.

        w_c = (1 - theta) w + theta w1                                              at t_c = t + theta h
        q_c = q + theta h v + (theta h)^2 [(1/2 - beta) w + beta w_c],   v_c = v + theta h [(1 - gamma) w + gamma w_c]
        M(q_c) w_c = Q(q_c, v_c, t_c)

    and q1, v1 are the same with theta = 1 and w1 for w_c.

    Order 2. Unconditionally stable for theta >= 1 and

        theta/(2 (theta + 1)) >= beta >= (2 theta^2 - 1)/(4 (2 theta^3 - 1))

    If a run started from w = M^-1 Q with a step far longer than a period, the first q1 would overshoot by a factor of
    order h^2. Runs therefore start as those of `hht` do.

    Args:
        beta: in (0, 1/4]; theta: 1 or more; numbers, or tracers to differentiate.
        tolerance, max_iterations: of Newton's iteration, as in `hht`.

    Returns:
        A `Stepper`.

    Raises:
        ValueError, TypeError: an argument out of its range or of the wrong kind.

    References:
        Hilber, Hughes (1978).

    >>> from hhtjax.steppers.collocation import collocation
    >>> collocation(beta=0.18, theta=1.287301).order
    2
    """
    return _collocation("collocation", beta, theta, tolerance, max_iterations)


def wilson(theta: Real = 1.4, tolerance: Real = 1e-10, max_iterations: int = 20) -> Collocation:
    """Wilson's theta method: acceleration linear in time up to t + theta h, where the equation of motion holds.

    This is `collocation` with beta = 1/6. Order 2. Unconditionally stable for theta >= 1.366, where 2 theta^2 - 2 theta
    >= 1. A start away from rest with a step far longer than a period 2 pi/omega gives q1 = q [1 - (omega h)^2 (1 -
    1/theta)/2].

    Args:
        theta: 1 or more.
        tolerance, max_iterations: of Newton's iteration, as in `hht`.

    Returns:
        A `Stepper`.

    Raises:
        ValueError, TypeError: an argument out of its range or of the wrong kind.

    References:
        Wilson, Farhoomand, Bathe (1973); Cardona, Geradin (1989), Sec. 2.

    >>> import hhtjax
    >>> hhtjax.wilson().theta
    1.4
    """
    return _collocation("wilson", 1 / 6, theta, tolerance, max_iterations)


def _collocation(caller: str, beta: Real, theta: Real, tolerance: Real, max_iterations: int):
    beta = require_number(caller, "beta", beta, lambda x: 0 < x <= 0.25, "lie in (0, 1/4]")
    theta = require_number(caller, "theta", theta, lambda x: x >= 1, "be 1 or more")
    options = check_options(caller, iterations=None, tolerance=tolerance, max_iterations=max_iterations)
    return Collocation(beta, theta, options)
