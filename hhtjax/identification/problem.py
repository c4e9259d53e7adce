"""A fit as one compiled program: from checked arguments to a `FitResult`."""

import math
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from hhtjax.description import freeze, thaw
from hhtjax.identification import transforms as tf
from hhtjax.identification.arguments import LEVENBERG_MARQUARDT, Options, check_residuals, spread_weights
from hhtjax.identification.arrow import Arrow
from hhtjax.identification.descent import Smooth, descend
from hhtjax.identification.gauss_newton import Dense, with_jacobian
from hhtjax.identification.implicit import at_minimum
from hhtjax.identification.least_squares import levenberg_marquardt
from hhtjax.identification.losses import Objective
from hhtjax.identification.result import FitResult
from hhtjax.identification.rounds import in_rounds
from hhtjax.identification.sandwich import LEAST, count_segments, in_time, uncertainty, used_up, variance_inflation
from hhtjax.numerics.either import namespace_of
from hhtjax.numerics.hoisted import hoisted
from hhtjax.runs.freezing import chooses_steps, with_steps_for
from hhtjax.xla import Programs


class Data(NamedTuple):
    """The traced arguments of a fit besides params0: pytrees, or None where there is nothing."""

    scale: Any
    weights: Any
    prior: Any
    tolerance: Any
    records: Any
    starts: Any


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


class Coordinates:
    """params as a function of the vector x that the optimiser moves."""

    def __init__(self, transforms, params0, scale):
        self.leaves, self.structure = jax.tree.flatten(params0)
        self.scales = jax.tree.leaves(scale)
        self.transforms = transforms
        self.free = [i for i, T in enumerate(transforms) if T is not tf.fixed]
        start = [transforms[i].coordinate(self.leaves[i], self.scales[i]) for i in self.free]
        x0, self.unravel = ravel_pytree(start)
        self.x0 = x0.astype(x0.dtype)  # as x is later: what is traced for a Python number is traced anew
        self.longest = longest_steps(transforms, self.leaves)

    def free_leaves(self, x):
        """The fitted leaves."""
        return [
            self.transforms[i].parameter(y, self.scales[i]) for i, y in zip(self.free, self.unravel(x), strict=True)
        ]

    def params(self, x):
        """All leaves, as params0 has them."""
        changed = dict(zip(self.free, self.free_leaves(x), strict=True))
        return thaw(self.structure.unflatten([changed.get(i, leaf) for i, leaf in enumerate(self.leaves)]))

    def bend(self):
        """x -> p''/p' of the fitted entries; None where no bound makes it differ from 0."""

        def of(x):
            leaves = zip(self.free, self.unravel(x), strict=True)
            return ravel_pytree([self.transforms[i].bend(y) for i, y in leaves])[0]

        return None if np.all(np.isinf(self.longest)) else of

    def slope(self, x):
        """dp/dx of the fitted entries."""
        return jax.jvp(lambda x: ravel_pytree(self.free_leaves(x))[0], (x,), (jnp.ones_like(x),))[1]

    def of_prior(self, prior):
        """Means and standard deviations for the fitted leaves."""
        pairs = [self.structure.flatten_up_to(prior)[i] for i in self.free]
        return [pair.mean for pair in pairs], [pair.deviation for pair in pairs]


def longest_steps(transforms, leaves):
    """Of the vector x, within which a transform is about straight, (p,)."""
    steps = [np.full(np.size(x), T.longest_step) for T, x in zip(transforms, leaves, strict=True) if T is not tf.fixed]
    return np.concatenate(steps)


@partial(Programs, static_argnums=(0, 1))
def solve(residuals, options: Options, params0, data: Data) -> FitResult:
    """The fit, with what it says about itself as data."""
    coordinates = Coordinates(options.transforms, params0, data.scale)
    tolerance = jnp.asarray(data.tolerance, coordinates.x0.dtype)
    tolerance = jnp.maximum(tolerance, 10 * float(jnp.finfo(tolerance.dtype).eps))
    limits = tolerance, options.max_iterations, options.progress
    branch = _solve_dense if data.records is None else _solve_records
    found = branch(residuals, options, coordinates, data, limits)
    params, slope = freeze(coordinates.params(found.x)), coordinates.slope(found.x)
    return result_of(options, data, found, params, slope)


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


class DenseParts(NamedTuple):
    """Of a fit without records: residuals and priors f(x) (m + k,), their weights w, and the first m as a pytree."""

    f: Any
    w: Any
    unravel: Any
    shapes: tuple  # of the leaves of the residuals

    @property
    def m(self):
        """How many are no priors."""
        return sum(map(math.prod, self.shapes))


def dense_parts(residuals, coordinates, data) -> DenseParts:
    """One residual function of all parameters, with priors as further rows."""
    shapes = check_residuals("fit", residuals, coordinates.x0.size, coordinates.params(coordinates.x0))
    leaves = spread_weights("fit", data.weights, shapes)
    w, unravel = ravel_pytree(jax.tree.unflatten(jax.tree.structure(shapes), leaves))
    if data.prior is not None:
        means, deviations = coordinates.of_prior(data.prior)
        w = jnp.concatenate([w, 1 / ravel_pytree(deviations)[0]])

    def f(x):
        r, _ = ravel_pytree(residuals(coordinates.params(x)))
        if data.prior is None:
            return r
        away = [p - mean for p, mean in zip(coordinates.free_leaves(x), means, strict=True)]
        return jnp.concatenate([r, ravel_pytree(away)[0]])

    return DenseParts(f, w, unravel, tuple(leaf.shape for leaf in leaves))


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
    """One residual function of each record, with a start of its own."""
    _, unravel_start = ravel_pytree(_first(data.starts))
    own0 = jax.vmap(lambda start: ravel_pytree(start)[0])(data.starts)

    def every(params, starts, records):
        return jax.vmap(partial(residuals, params))(starts, records)

    unknowns, params0 = coordinates.x0.size + own0.size, coordinates.params(coordinates.x0)
    shapes = check_residuals("fit", every, unknowns, params0, data.starts, data.records)
    weights = jax.tree.unflatten(jax.tree.structure(shapes), spread_weights("fit", data.weights, shapes))
    w = jax.vmap(lambda x: ravel_pytree(x)[0])(weights)
    _, unravel = ravel_pytree(_first(weights))
    p = coordinates.x0.size

    def f(x, own, record):
        return ravel_pytree(residuals(coordinates.params(x), unravel_start(own), record))[0]

    first = coordinates.x0, own0[0], _first(data.records)
    call, given = hoisted(f, *first)

    def problem_of(given, w, records, f=None):
        objective = Objective(w.ravel(), options.loss, w.size)
        return Arrow(f or partial(call, given), objective, records, p, coordinates.bend())

    problem = problem_of(given, w, data.records, f)
    frozen = partial(_with_frozen_steps, problem) if chooses_steps(call, given, *first) else None
    x0 = jnp.concatenate([coordinates.x0, own0.ravel()])
    longest = np.concatenate([coordinates.longest, np.full(own0.size, np.inf)])
    find = partial(_minimise, problem, frozen, x0, longest, options.optimizer, limits)
    x, read, (history, iterations, code, choices) = at_minimum(find, problem_of, p, given, w, data.records)
    residual, starts = jax.vmap(unravel)(read[0]), jax.vmap(unravel_start)(problem.split(x)[1])
    cost = problem.objective.cost(read[0].ravel())
    J, pull, bend = problem.free_of_own(*read)
    x = x[:p]
    of_pull = jax.tree.leaves(jax.vmap(unravel)(pull.reshape(w.shape)))
    present = jnp.sum(w != 0) - used_up(w != 0, own0.shape[1])
    whole = w.shape[1]
    block = whole if count_segments([w.size], options.segments, whole) >= max(LEAST, p + 1) else 1
    ended = x, cost, history, iterations, code, choices, residual, starts
    return _Solved(*ended, J, pull, bend, of_pull, [w.size], present, block)


def _first(tree):
    """Of its leading axis."""
    return jax.tree.map(lambda x: x[0], tree)


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
