"""Fully implicit Euler: the generalised-alpha machinery with another update."""

from dataclasses import dataclass

from hhtjax.steppers.generalized_alpha import GeneralizedAlpha
from hhtjax.steppers.options import check_options
from hhtjax.steppers.residual import Coefficients


@dataclass(frozen=True, eq=False)
class ImplicitEuler(GeneralizedAlpha):
    """Implicit Euler; made by `implicit_euler`."""

    def advance(self, s, dt, w):
        """v1 = v + h w1, x = h v1."""
        v = s.v + dt * w
        return dt * v, v, w, w


def implicit_euler(iterations=None, tolerance=1e-10, max_iterations=20, solve=None) -> ImplicitEuler:
    """Implicit Euler, v1 = v + h w1, q1 = q + h v1, M(q1) w1 = Q(q1, v1, t1), solved by Newton.

    Order 1, L-stable, strongly damping: the reference for robustness, not for accuracy. Constraints (GGL), rotations
    (in charts), internal states and dry friction are solved as by `hht`.

    Args:
        iterations: None, Newton until `tolerance`; k, that many Newton iterations.
        tolerance, max_iterations, solve: as in `hht`.

    Returns:
        A `Stepper`.

    Raises:
        TypeError, ValueError: an argument of the wrong kind, or out of its range.

    >>> import hhtjax
    >>> hhtjax.implicit_euler().order
    1
    """
    newton = {"iterations": iterations, "tolerance": tolerance, "max_iterations": max_iterations}
    options = check_options("implicit_euler", **newton, linearize="predictor", start="simple", solve=solve)
    return ImplicitEuler(Coefficients(0.0, 0.0, 1.0, 1.0), 1, options)
