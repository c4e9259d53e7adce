"""A fit outside of all transformations: residuals and Jacobians by a compiled program, all around them in NumPy.

Levenberg-Marquardt and the covariances are a thousand small operations, which run once an iteration, and which XLA
would compile anew with every function of residuals: of a pendulum's fit that was two thirds of the time. They are the
lines of a fit inside a jit (`hhtjax.numerics.either`). Where runs choose their steps, for records, and for many
residuals, the whole fit is one program, `solve`, as it is there.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from hhtjax.description import all_concrete, freeze, is_tracing
from hhtjax.identification.arguments import LEVENBERG_MARQUARDT
from hhtjax.identification.gauss_newton import Dense, DenseTrial, dense_trial
from hhtjax.identification.least_squares import levenberg_marquardt
from hhtjax.identification.losses import Objective
from hhtjax.identification.problem import Coordinates, dense_parts, dense_solution, longest_steps, result_of, solve
from hhtjax.identification.progress import BAD_START
from hhtjax.numerics.hoisted import hoisted
from hhtjax.runs.freezing import chooses_steps
from hhtjax.xla import Programs, is_untouched

MANY = 100_000  # entries of a Jacobian; with more, memory that one program keeps saves more time than compiling takes
NUMBERS = "cost", "history", "iterations", "code", "uncertainty"  # of a `FitResult`, from NumPy


class Kept(NamedTuple):
    """Of a point, for the result."""

    estimates: Any  # of `Objective.estimating`; None where they are J, r, None
    residual: Any
    params: Any
    slope: Any


@jax.tree_util.register_static
@dataclass(frozen=True)
class Kind:
    """What is known of a fit when it has been traced."""

    chooses_steps: bool
    shapes: tuple


@partial(jax.jit, static_argnums=(0, 1))
def _begin(residuals, options, params0, data):
    """The vector x to start from, the weights, and the kind of the fit."""
    coordinates = Coordinates(options.transforms, params0, data.scale)
    parts = dense_parts(residuals, coordinates, data)
    return coordinates.x0, parts.w, Kind(chooses_steps(*hoisted(parts.f, coordinates.x0), coordinates.x0), parts.shapes)


@partial(Programs, static_argnums=(0, 1))
def _see(residuals, options, x, params0, data):
    """The `Seen` of x, with a `Kept`."""
    coordinates = Coordinates(options.transforms, params0, data.scale)
    parts = dense_parts(residuals, coordinates, data)
    problem = Dense(parts.f, Objective(parts.w, options.loss, parts.m), coordinates.bend())
    seen = problem.see(x)
    r, _ = seen.read
    estimates = None if options.loss is None else problem.objective.estimating(*seen.read)
    kept = Kept(estimates, parts.unravel(r[: parts.m]), freeze(coordinates.params(x)), coordinates.slope(x))
    return seen._replace(read=kept)


class Outside(NamedTuple):
    """A `Dense` problem. see: x -> its `Seen`."""

    see: Any

    def look(self, x, D):
        """The trial at x, with D from the trials before."""
        seen = self.see(x)
        numbers = jax.tree.map(np.asarray, seen._replace(read=None))
        return dense_trial(x, numbers._replace(read=(numbers.r, numbers.J, seen.read)), D)

    def nothing(self, x):
        """A trial before the first evaluation."""
        zero = np.zeros_like(x)
        square, number = np.zeros((x.size, x.size), x.dtype), np.zeros((), x.dtype)
        return DenseTrial(x, None, number + np.inf, number, zero, zero, zero, square, zero)

    step, length, cosine = Dense.step, Dense.length, Dense.cosine


def is_outside(options, *given):
    """Whether a fit with these options, given these pytrees, can be done so."""
    is_free = is_untouched() and not is_tracing() and all_concrete(given)
    return is_free and options.optimizer == LEVENBERG_MARQUARDT and jax.default_backend() == "cpu"


def solve_outside(residuals, options, params0, data):
    """`solve`, where nothing is being traced."""
    x0, w, kind = _begin(residuals, options, params0, data)
    if kind.chooses_steps or w.size * x0.size > MANY:
        return solve(residuals, options, params0, data)
    x0, w = np.asarray(x0), np.asarray(w)
    tolerance = np.maximum(np.asarray(data.tolerance, x0.dtype), 10 * np.finfo(x0.dtype).eps)
    warned = np.geterr()

    def see(x):
        with np.errstate(**warned):  # the user's functions may be traced here
            return _see(residuals, options, x, params0, data)

    problem = Outside(see)
    longest = longest_steps(options.transforms, jax.tree.leaves(params0))
    with np.errstate(all="ignore"):
        limits = tolerance, options.max_iterations, options.progress
        best, history, iterations, code = levenberg_marquardt(problem, x0, longest, *limits)
        r, J, kept = best.read
        estimates = (J, r, None) if kept.estimates is None else jax.tree.map(np.asarray, kept.estimates)
        ended = history, iterations, code.astype(np.int32), None
        found = dense_solution(best.x, best.cost, ended, kept.residual, estimates, kind.shapes, w)
        if code == BAD_START:
            options = options._replace(covariance=False)  # of numbers that are not finite
        result = result_of(options, data, found, kept.params, np.asarray(kept.slope))
    numbers = {name: getattr(result, name) for name in NUMBERS}
    return result._replace(**jax.device_put(numbers))
