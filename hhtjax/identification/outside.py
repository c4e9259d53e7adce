"""A fit outside of all transformations: residuals and Jacobians by a compiled program, all around them in NumPy.

Levenberg-Marquardt and the covariances are a thousand small operations, which run once an iteration, and which XLA
would compile anew with every function of residuals: of a pendulum's fit that was two thirds of the time. They are the
lines of a fit inside a jit (`hhtjax.numerics.either`). Where runs choose their steps, and for many residuals, the whole
fit is one program, `solve`, as it is there.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.description import all_concrete, freeze, is_tracing, programs
from hhtjax.identification.arguments import LEVENBERG_MARQUARDT
from hhtjax.identification.arrow import Arrow, ArrowTrial, arrow_trial
from hhtjax.identification.gauss_newton import Dense, DenseTrial, dense_trial
from hhtjax.identification.least_squares import levenberg_marquardt
from hhtjax.identification.losses import Objective
from hhtjax.identification.parts import Coordinates, dense_parts, first, longest_steps, record_parts
from hhtjax.identification.problem import dense_solution, limits_of, records_solution, result_of, solve
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
    starts: Any
    stretch: Any  # of `Objective.stretch`


@jax.tree_util.register_static
@dataclass(frozen=True)
class Kind:
    """What is known of a fit when it has been traced."""

    p: int  # unknowns, but those of records
    shapes: tuple  # of the leaves of the residuals
    chooses_steps: bool


@partial(jax.jit, static_argnums=(0, 1))
def _begin(residuals, options, params0, data):
    """The vector x to start from, the weights, and the kind of the fit."""
    coordinates = Coordinates(options.transforms, params0, data.scale)
    x0 = coordinates.x0
    if data.records is None:
        parts = dense_parts(residuals, coordinates, data)
        own, one = [], (x0,)
    else:
        parts = record_parts(residuals, coordinates, data)
        own, one = [parts.own0.ravel()], (x0, parts.own0[0], first(data.records))
    kind = Kind(x0.size, parts.shapes, chooses_steps(*hoisted(parts.f, *one), *one))
    return jnp.concatenate([x0, *own]), parts.w, kind


programs.add(_begin)


@partial(Programs, static_argnums=(0, 1))
def _see(residuals, options, x, params0, data):
    """The `Seen` of x, with a `Kept`."""
    coordinates = Coordinates(options.transforms, params0, data.scale)
    p, starts = coordinates.x0.size, None
    if data.records is None:
        parts = dense_parts(residuals, coordinates, data)
        problem = Dense(parts.f, Objective(parts.w, options.loss, parts.m), coordinates.bend())
        seen = problem.see(x)
        residual = parts.unravel(seen.read[0][: parts.m])
    else:
        parts = record_parts(residuals, coordinates, data)
        objective = Objective(parts.w.ravel(), options.loss, parts.w.size)
        problem = Arrow(parts.f, objective, data.records, p, coordinates.bend())
        seen = problem.see(x)
        residual, starts = parts.unravel(seen.read[0]), parts.unravel_start(problem.split(x)[1])
    stretch = problem.objective.stretch(seen.read[0].ravel())
    estimates = None if options.loss is None else problem.estimates(*seen.read)
    kept = Kept(estimates, residual, freeze(coordinates.params(x[:p])), coordinates.slope(x[:p]), starts, stretch)
    return seen._replace(read=kept)


class Outside(NamedTuple):
    """A `Dense` problem. see: x -> its `Seen`."""

    see: Callable

    def look(self, x, D):
        """The trial at x, with D from the trials before."""
        return dense_trial(x, _in_numpy(self.see(x)), D)

    def nothing(self, x):
        """A trial before the first evaluation."""
        zero = np.zeros_like(x)
        square, number = np.zeros((x.size, x.size), x.dtype), np.zeros((), x.dtype)
        return DenseTrial(x, None, number + np.inf, number, zero, zero, zero, square, zero)

    def weighted(self, trial):
        """As of `Dense`."""
        _, J, kept = trial.read
        return _weighted(J, kept)

    step, damped, length, cosine, offset = Dense.step, Dense.damped, Dense.length, Dense.cosine, Dense.offset
    bending = Dense.bending


class OutsideRecords(NamedTuple):
    """An `Arrow` problem. see: x -> its `Seen`."""

    see: Callable
    p: int
    count: int

    def look(self, x, D):
        """The trial at x, with D from the trials before."""
        return arrow_trial(x, _in_numpy(self.see(x)), D, self.p)

    def nothing(self, x):
        """A trial before the first evaluation."""
        k, zero, number = (x.size - self.p) // self.count, np.zeros_like(x), np.zeros((), x.dtype)
        R = np.zeros((self.count, 1, k + self.p), x.dtype)
        return ArrowTrial(x, None, number + np.inf, number, zero, zero, R[:, :, k:], R[:, :, :k], R[:, :, 0])

    def weighted(self, trial):
        """As of `Arrow`."""
        _, J, kept = trial.read
        return _weighted(J, kept)

    step, damped, length, cosine, offset = Arrow.step, Arrow.damped, Arrow.length, Arrow.cosine, Arrow.offset
    bending = Arrow.bending


def _weighted(J, kept):
    """w J, whose rows in a least-squares problem are others where there is a loss."""
    if kept is None or kept.estimates is None:
        return J, None
    wJ, _, _ = kept.estimates
    return np.reshape(wJ, J.shape), np.reshape(kept.stretch, J.shape[:-1])


def _in_numpy(seen):
    """A `Seen` of NumPy arrays, but for what is kept beside r and J."""
    seen, kept = jax.tree.map(np.asarray, seen._replace(read=None)), seen.read
    return seen._replace(read=(seen.r, seen.J, kept))


def is_outside(options, *given):
    """Whether a fit with these options, given these pytrees, can be done so."""
    is_free = is_untouched() and not is_tracing() and all_concrete(given)
    return is_free and options.optimizer == LEVENBERG_MARQUARDT and jax.default_backend() == "cpu"


def solve_outside(residuals, options, params0, data):
    """`solve`, where nothing is being traced."""
    x0, w, kind = _begin(residuals, options, params0, data)
    columns = x0.size if w.ndim == 1 else kind.p + (x0.size - kind.p) // len(w)
    if kind.chooses_steps or w.size * columns > MANY:
        return solve(residuals, options, params0, data)
    x0, w, warned = np.asarray(x0), np.asarray(w), np.geterr()

    def see(x):
        with np.errstate(**warned):  # the user's functions may be traced here
            return _see(residuals, options, x, params0, data)

    problem = Outside(see) if w.ndim == 1 else OutsideRecords(see, kind.p, len(w))
    longest = longest_steps(options.transforms, jax.tree.leaves(params0), x0.size - kind.p)
    with np.errstate(all="ignore"):
        limits = limits_of(options, data, x0)
        best, history, iterations, code = levenberg_marquardt(problem, x0, longest, *limits)
        found, kept = _solution(best, (history, iterations, code.astype(np.int32), None), kind, w, options.segments)
        if code == BAD_START:
            options = options._replace(covariance=False)  # of numbers that are not finite
        result = result_of(options, data, found, kept.params, np.asarray(kept.slope))
    numbers = {name: getattr(result, name) for name in NUMBERS}
    return result._replace(**jax.device_put(numbers))


def _solution(best, ended, kind, w, segments):
    """What the best trial says, and its `Kept`."""
    r, J, kept = best.read
    estimates = kept.estimates
    if estimates is None:
        estimates = J.reshape(r.size, -1), r.ravel(), None
    estimates = jax.tree.map(np.asarray, estimates)
    if w.ndim == 1:
        return dense_solution(best.x, best.cost, ended, kept.residual, estimates, kind.shapes, w), kept
    ended = ended, kept.residual, kept.starts, estimates, kind.shapes
    return records_solution(best.x, best.cost, *ended, w, kind.p, segments), kept
