"""The generalised-alpha family in thirty lines: coefficients as data, the end of a step, and the residual there.

State (q, v, w, a) with w the acceleration and a the algorithmic one (Arnold and Bruls 2007):

    q1 = q + h v + h^2 [(1/2 - beta) a + beta a1]
    v1 = v + h [(1 - gamma) a + gamma a1]
    (1 - alpha_m) a1 + alpha_m a = (1 - alpha_f) w1 + alpha_f w
    r(w1) = M(q1) w1 - Q(q1, v1, t1) = 0

Second order for every alpha, for M(q) and for explicit time. (The form printed in the literature,
M(q1) a1 = (1 + alpha) Q1 - alpha Q0, is first order once M depends on q and alpha is not 0.)

On rotations the first two lines give the rotation vector of the increment, from zero, and its rate: see kinematics.py.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from hhtjax.description import Array, PyTree, Real

if TYPE_CHECKING:
    from hhtjax.steppers.stepper import State
    from hhtjax.systems.flat_system import FlatSystem


class Coefficients(NamedTuple):
    """alpha_m, alpha_f, beta, gamma of the formulas above; numbers, or tracers to differentiate."""

    alpha_m: Any
    alpha_f: Any
    beta: Any
    gamma: Any


def coefficients(alpha_m: float, alpha_f: Real) -> Coefficients:
    """Second order, with as much damping of high frequencies as the two weights allow: Chung, Hulbert (1993)."""
    shift = alpha_f - alpha_m
    return Coefficients(alpha_m, alpha_f, (1 + shift) ** 2 / 4, 0.5 + shift)


def hht_coefficients(alpha: Real) -> Coefficients:
    """Hilber, Hughes, Taylor (1977): alpha in [-1/3, 0]; alpha = 0 is the trapezoidal rule."""
    return coefficients(0.0, -alpha)


def weighted(weight: Real, x: Array) -> Real:
    """weight x; exactly 0, without a product, if the weight is the number 0."""
    return 0.0 if isinstance(weight, float) and weight == 0 else weight * x


def advance(c: Coefficients, s: State, dt: Array, w: Array):
    """The displacement from q, and v, w, a at t + dt, as affine functions of the new acceleration w."""
    a = (weighted(1 - c.alpha_f, w) + weighted(c.alpha_f, s.w) - weighted(c.alpha_m, s.a)) / (1 - c.alpha_m)
    x = dt * s.v + dt**2 * ((0.5 - c.beta) * s.a + c.beta * a)
    v = s.v + dt * ((1 - c.gamma) * s.a + c.gamma * a)
    return x, v, w, a


def residual(system: FlatSystem, params: PyTree, s: State):
    """M(q) w - Q(q, v, t): zero on the trajectory."""
    return system.residual(s.q, s.v, s.w, s.t, params)
