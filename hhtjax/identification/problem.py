"""A fit as one compiled program: from checked arguments to a `FitResult`."""

import math
from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from hhtjax.description import freeze
from hhtjax.identification.arguments import LEVENBERG_MARQUARDT, Options
from hhtjax.identification.arrow import Arrow, free_of_own
from hhtjax.identification.descent import Smooth, descend
from hhtjax.identification.gauss_newton import Dense, with_jacobian
from hhtjax.identification.implicit import at_minimum
from hhtjax.identification.least_squares import levenberg_marquardt
from hhtjax.identification.losses import Objective
from hhtjax.identification.parts import Coordinates, Data, dense_parts, first, longest_steps, record_parts
from hhtjax.identification.result import FitResult
from hhtjax.identification.rounds import in_rounds
from hhtjax.identification.sandwich import LEAST, count_segments, in_time, uncertainty, used_up, variance_inflation
from hhtjax.numerics.either import namespace_of
from hhtjax.numerics.hoisted import hoisted
from hhtjax.runs.freezing import chooses_steps, with_steps_for
from hhtjax.xla import Programs


class _Solved(NamedTuple):
    """x and what belongs to it. J, pull, bend: of `Objective.estimating` there, J None if not asked for; leaves: pull
    as a pytree's leaves, of the given sizes; present: how many rows are not missing; block: how many stay in one
    segment."""

    x: Any
    cost: Any
    history: Any
    iterations: Any
    code: Any
    choices: Any
    residual: Any
    starts: Any
    J: Any
    pull: Any
    bend: Any
    leaves: Any
    sizes: list
    present: Any
    block: int = 1


@partial(Programs, static_argnums=(0, 1))
def solve(residuals, options: Options, params0, data: Data) -> FitResult:
    """The fit, with what it says about itself as data."""
    coordinates = Coordinates(options.transforms, params0, data.scale)
    limits = limits_of(options, data, coordinates.x0)
    branch = _solve_dense if data.records is None else _solve_records
    found = branch(residuals, options, coordinates, data, limits)
    params, slope = freeze(coordinates.params(found.x)), coordinates.slope(found.x)
    return result_of(options, data, found, params, slope)


def limits_of(options, data, x):
    """The tolerance, at least 10 roundings of numbers like x; how many iterations at most; whether to show them."""
    xp, least = namespace_of(x), 10 * float(jnp.finfo(x.dtype).eps)
    return xp.maximum(xp.asarray(data.tolerance, x.dtype), least), options.max_iterations, options.progress


def result_of(options, data, found, params, slope):
    """What is known of a solution. slope: dp/dx of the fitted entries."""
    believed, segments = None, 0
    if options.covariance:
        segments = count_segments(found.sizes, options.segments, found.block)
        J = found.J / slope[None, :]
        tau = variance_inflation(found.leaves, data.records is not None)
        believed = uncertainty(J, found.pull, found.bend, found.present, found.sizes, segments, tau, found.block)
    ended = found.residual, found.cost, found.history, found.iterations, found.code
    return FitResult(params, *ended, options.transforms, believed, segments, found.starts, data.weights, found.choices)


def _solve_dense(residuals, options, coordinates, data, limits):
    parts = dense_parts(residuals, coordinates, data)
    f, w, m = parts.f, parts.w, parts.m
    call, given = hoisted(f, coordinates.x0)
    by_jacobians = options.optimizer == LEVENBERG_MARQUARDT

    def problem_of(given, w, f=None):
        f, objective = f or partial(call, given), Objective(w, options.loss, m)
        return Dense(f, objective, coordinates.bend()) if by_jacobians else Smooth(f, objective)

    problem, frozen = problem_of(given, w, f), None
    if by_jacobians and chooses_steps(call, given, coordinates.x0):
        frozen = partial(_dense_with_frozen_steps, problem)
    find = partial(_minimise, problem, frozen, coordinates.x0, coordinates.longest, options.optimizer, limits)
    x, read, ended = at_minimum(find, problem_of, coordinates.x0.size, given, w)
    r, J = read or (with_jacobian(f, x) if options.covariance else (f(x), None))
    estimates = (None, r, None) if J is None else problem.objective.estimating(r, J)
    return dense_solution(x, problem.objective.cost(r), ended, parts.unravel(r[:m]), estimates, parts.shapes, w)


def dense_solution(x, cost, ended, residual, estimates, shapes, w) -> _Solved:
    """ended: history, its length, the code, and how often steps were chosen; estimates: of `Objective.estimating`;
    shapes: of the leaves of the residuals."""
    (J, pull, bend), (history, iterations, code, choices) = estimates, ended
    xp, sizes = namespace_of(w), [math.prod(shape) for shape in shapes]
    m = sum(sizes)
    leaves = [y.reshape(shape) for y, shape in zip(xp.split(pull[:m], np.cumsum(sizes)[:-1]), shapes, strict=True)]
    order = np.concatenate([in_time(shapes), np.arange(m, w.size)])
    if J is not None and np.any(np.diff(order) < 0):
        J, pull, bend = (y if y is None else y[order] for y in (J, pull, bend))
    ended = x, cost, history, iterations, code, choices, residual, None
    return _Solved(*ended, J, pull, bend, leaves, sizes, xp.sum(w != 0))


def _solve_records(residuals, options, coordinates, data, limits):
    parts, p = record_parts(residuals, coordinates, data), coordinates.x0.size
    w, own0 = parts.w, parts.own0
    one = coordinates.x0, own0[0], first(data.records)
    call, given = hoisted(parts.f, *one)

    def problem_of(given, w, records, f=None):
        objective = Objective(w.ravel(), options.loss, w.size)
        return Arrow(f or partial(call, given), objective, records, p, coordinates.bend())

    problem = problem_of(given, w, data.records, parts.f)
    frozen = partial(_with_frozen_steps, problem) if chooses_steps(call, given, *one) else None
    x0 = jnp.concatenate([coordinates.x0, own0.ravel()])
    longest = longest_steps(options.transforms, coordinates.leaves, own0.size)
    find = partial(_minimise, problem, frozen, x0, longest, options.optimizer, limits)
    x, read, ended = at_minimum(find, problem_of, p, given, w, data.records)
    cost, residual = problem.objective.cost(read[0].ravel()), parts.unravel(read[0])
    starts = parts.unravel_start(problem.split(x)[1])
    estimates = problem.estimates(*read)
    return records_solution(x, cost, ended, residual, starts, estimates, parts.shapes, w, p, options.segments)


def records_solution(x, cost, ended, residual, starts, estimates, shapes, w, p, segments) -> _Solved:
    """As `dense_solution`. estimates: of the derivatives by a record's own unknowns, and then by the p shared ones;
    shapes: with the records in front."""
    (both, pull, bend), (history, iterations, code, choices) = estimates, ended
    xp, (count, whole) = namespace_of(w), w.shape
    k = both.shape[-1] - p
    ends = np.cumsum([math.prod(shape[1:]) for shape in shapes])[:-1]
    leaves = [y.reshape(shape) for y, shape in zip(xp.split(pull.reshape(w.shape), ends, axis=1), shapes, strict=True)]
    present = xp.sum(w != 0) - used_up(w != 0, k)
    block = whole if count_segments([w.size], segments, whole) >= max(LEAST, p + 1) else 1
    J = free_of_own(both, bend, count, p)
    ended = x[:p], cost, history, iterations, code, choices, residual, starts
    return _Solved(*ended, J, pull, bend, leaves, [w.size], present, block)


def _minimise(problem, frozen, x0, longest, optimizer, limits):
    """x, what the problem reads there, and the history, its length, the code, and how often steps were chosen.

    frozen: y, fresh -> the problem with steps as for y, unless they are chosen anew; None where runs choose none.
    """
    if isinstance(problem, Smooth):
        x, *ended = descend(problem, x0, optimizer, *limits)
        return x, (), (*ended, None)
    if frozen is None:
        best, *ended = *levenberg_marquardt(problem, x0, longest, *limits), None
    else:
        best, *ended = in_rounds(frozen, x0, longest, *limits)
    return best.x, best.read, tuple(ended)


def _dense_with_frozen_steps(problem, y, fresh):
    """A `Dense` problem with steps of its runs as for y, unless they are chosen anew."""
    return problem._replace(f=lambda x: with_steps_for(problem.f, x, jnp.where(fresh, x, y)))


def _with_frozen_steps(problem, y, fresh):
    """An `Arrow` problem with steps of its runs as for y, unless they are chosen anew."""
    y, own_y = problem.split(y)

    def f(x, own, record):
        record, own_y = record
        here, there = jnp.concatenate([x, own]), jnp.concatenate([y, own_y])

        def residuals(both):
            return problem.f(both[: problem.p], both[problem.p :], record)

        return with_steps_for(residuals, here, jnp.where(fresh, here, there))

    return problem._replace(f=f, records=(problem.records, own_y))
