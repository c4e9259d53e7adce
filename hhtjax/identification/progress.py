"""How a fit went: why it ended, its history, and what it shows on the way."""

from typing import Any, NamedTuple

import jax
import numpy as np

from hhtjax.description.presentation import overwrite, shown
from hhtjax.numerics.either import namespace_of, with_entry

RUNNING, COST, STEP, GRADIENT, LIMIT, STUCK, BAD_START, NO_INFLUENCE, UNSETTLED = range(9)
CONVERGED = COST, STEP, GRADIENT
REASONS = {
    RUNNING: "still running",
    COST: "converged: the cost changes by less than tolerance",
    STEP: "converged: the step is smaller than tolerance",
    GRADIENT: "converged: the gradient vanishes to within tolerance",
    LIMIT: "stopped: max_iterations reached",
    STUCK: "stopped: no step lowers the cost",
    BAD_START: "failed: the residual is not finite at params0",
    NO_INFLUENCE: "failed: no parameter changes the residual at params0",
    UNSETTLED: "stopped: the estimates change whenever steps are chosen anew; take a smaller rtol",
}
NO_SLOPE = (
    "a finite residual with a derivative that is not finite: roots, norms and max(x, 0)**1.5 have none, or no second "
    "one, at 0, where max(x, 1e-12) has"
)


@shown
class History(NamedTuple):
    """The course of a fit, per iteration, the start first.

    Attributes:
        cost: after the iteration.
        step: largest entry of the step in the scaled coordinates, 0 where it was taken back.
        damping: of Levenberg-Marquardt (None for optax).
    """

    cost: Any
    step: Any
    damping: Any


def record(history, i, *values):
    """The history with the values of iteration i; None where there are none."""
    return History(*(None if x is None else with_entry(x, i, y) for x, y in zip(history, values, strict=True)))


def show(iteration, cost, step, code):
    """A line on stderr, the same one at every iteration; at the end with the reason."""

    def tell(iteration, cost, step, code):
        what = f"step {float(step):.3g}" if step else "no step" if iteration else "start"
        what = what if code == RUNNING else REASONS[int(code)]
        overwrite(f"fit: iteration {int(iteration)}, cost {float(cost):.9g}, {what}", last=code != RUNNING)

    if namespace_of(cost) is np:
        tell(iteration, cost, step, code)
    else:
        jax.debug.callback(tell, iteration, cost, step, code)
