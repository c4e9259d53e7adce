"""A fit from checked arguments to a `FitResult`: as one compiled program, or with its small algebra in NumPy."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import zero_from_primal

from hhtjax.description import Array, PyTree, Real, all_concrete, freeze, is_tracing, programs
from hhtjax.identification.arguments import LEVENBERG_MARQUARDT, Options
from hhtjax.identification.bordered_least_squares import Arrow, ArrowTrial, arrow_trial, free_of_own
from hhtjax.identification.gauss_newton import Dense, DenseTrial, dense_trial, with_jacobian
from hhtjax.identification.least_squares import BAD_START, History, Smooth, descend, in_rounds, levenberg_marquardt
from hhtjax.identification.losses import Objective
from hhtjax.identification.parameter_vector import Coordinates, Data, dense_parts, first, longest_steps, record_parts
from hhtjax.identification.result import FitResult
from hhtjax.identification.sandwich import LEAST, count_segments, in_time, uncertainty, used_up, variance_inflation
from hhtjax.numerics.array_namespace import namespace_of
from hhtjax.numerics.closures import hoisted
from hhtjax.primitives import is_untouched
from hhtjax.runs.frozen_steps import chooses_steps, with_steps_for
from hhtjax.xla import Programs

if TYPE_CHECKING:
    from hhtjax.description.current import Reading
    from hhtjax.identification.gauss_newton import Seen
    from hhtjax.identification.many_records import Many


class _Solved(NamedTuple):
    """The solution x, and the residuals and Jacobian there.

    J, pull, bend: from `Objective.estimating`; J is None without covariance. leaves: pull as leaves of a pytree, with
    the given sizes. present: number of rows that are not missing. block: number of rows that stay in one segment.
    """

    x: Any
    cost: Any
    history: History
    iterations: Array
    code: Array
    choices: Array
    residual: PyTree
    starts: PyTree
    J: Any
    pull: Any
    bend: Any
    leaves: Any
    sizes: list
    present: Array
    block: int = 1


@partial(Programs, static_argnums=(0, 1))
def solve(residuals: Callable | Reading, options: Options, params0: PyTree, data: Data) -> FitResult:
    """The fit as one program. Its verdict is a code in the result; nothing is raised."""
    coordinates = Coordinates(options.transforms, params0, data.scale)
    limits = limits_of(options, data, coordinates.x0)
    branch = _solve_dense if data.records is None else _solve_records
    found = branch(residuals, options, coordinates, data, limits)
    params, slope = freeze(coordinates.params(found.x)), coordinates.slope(found.x)
    return result_of(options, data, found, params, slope)


def limits_of(options: Options, data: PyTree, x: Real):
    """The tolerance, at least 10 roundings of numbers like x; how many iterations at most; whose to show."""
    xp, least = namespace_of(x), 10 * float(jnp.finfo(x.dtype).eps)
    return xp.maximum(xp.asarray(data.tolerance, x.dtype), least), options.max_iterations, options.progress


def result_of(options: Options, data: PyTree, found, params: PyTree, slope: Real) -> FitResult:
    """The `FitResult` of a solution. slope: dp/dx of the fitted entries."""
    believed, segments = None, 0
    if options.covariance:
        segments = count_segments(found.sizes, options.segments, found.block)
        J = found.J / slope[None, :]
        tau = variance_inflation(found.leaves, data.records is not None)
        believed = uncertainty(J, found.pull, found.bend, found.present, found.sizes, segments, tau, found.block)
    ended = found.residual, found.cost, found.history, found.iterations, found.code
    return FitResult(params, *ended, options.transforms, believed, segments, found.starts, data.weights, found.choices)


def _solve_dense(
    residuals: Callable | Reading, options: Options, coordinates: Coordinates, data: PyTree, limits: tuple
):
    parts = dense_parts(residuals, coordinates, data)
    f, w, m = parts.f, parts.w, parts.m
    call, given = hoisted(f, coordinates.x0)
    by_jacobians = options.optimizer == LEVENBERG_MARQUARDT

    def problem_of(given: list, w: Array, f: Callable | None = None) -> Dense | Smooth:
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
    """The `_Solved` of a fit without records.

    ended: history, its length, the code, and how often steps were chosen. estimates: from `Objective.estimating`.
    shapes: shapes of the leaves of the residuals.
    """
    (J, pull, bend), (history, iterations, code, choices) = estimates, ended
    xp, sizes = namespace_of(w), [math.prod(shape) for shape in shapes]
    m = sum(sizes)
    leaves = [y.reshape(shape) for y, shape in zip(xp.split(pull[:m], np.cumsum(sizes)[:-1]), shapes, strict=True)]
    order = np.concatenate([in_time(shapes), np.arange(m, w.size)])
    if J is not None and np.any(np.diff(order) < 0):
        J, pull, bend = (y if y is None else y[order] for y in (J, pull, bend))
    ended = x, cost, history, iterations, code, choices, residual, None
    return _Solved(*ended, J, pull, bend, leaves, sizes, xp.sum(w != 0))


def _solve_records(residuals, options, coordinates, data: PyTree, limits):
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
    """The `_Solved` of a fit of records; arguments as for `dense_solution`.

    estimates: with the columns of a record's own unknowns first, then those of the p shared ones. shapes: with the
    records as first axis.
    """
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


def _minimise(problem, frozen: Callable | None, x0: Array, longest: np.ndarray, optimizer, limits: tuple):
    """Minimises; returns x, the problem's `read` there, and (history, its length, code, how often steps were chosen).

    frozen: (y, fresh) -> the problem with the steps that its runs take at y, or with `fresh` with steps chosen anew.
    None if the runs do not choose steps.
    """
    if isinstance(problem, Smooth):
        x, *ended = descend(problem, x0, optimizer, *limits)
        return x, (), (*ended, None)
    if frozen is None:
        best, *ended = *levenberg_marquardt(problem, x0, longest, *limits), None
    else:
        best, *ended = in_rounds(frozen, x0, longest, *limits)
    return best.x, best.read, tuple(ended)


def _dense_with_frozen_steps(problem, y: Array, fresh: Array) -> Dense:
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


# ----------------------------------------------------------------------------
# A fit outside jit, vmap and grad: a compiled program evaluates residuals and Jacobians, NumPy does everything else.
#
# Levenberg-Marquardt and the covariances are a thousand small operations. They run once an iteration, and XLA would
# compile them again for every new function of residuals: in the fit of a pendulum this took two thirds of the time.
# Both ways share the same code (`hhtjax.numerics.array_namespace`). If runs choose their steps, and for many residuals,
# the whole fit is one program, `solve`, as inside jit.


MANY = 100_000  # entries of a Jacobian; with more, memory that one program keeps saves more time than compiling takes
NUMBERS = "cost", "history", "iterations", "code", "uncertainty"  # of a `FitResult`, from NumPy


class Kept(NamedTuple):
    """Values at a point that the `FitResult` needs."""

    estimates: Any  # of `Objective.estimating`; None where they are J, r, None
    residual: PyTree
    params: PyTree
    slope: Any
    starts: PyTree
    stretch: Any  # of `Objective.stretch`


@jax.tree_util.register_static
@dataclass(frozen=True)
class Kind:
    """Static facts about a fit, known once it has been traced."""

    p: int  # unknowns, but those of records
    shapes: tuple  # of the leaves of the residuals
    chooses_steps: bool


@partial(jax.jit, static_argnums=(0, 1))
def _begin(residuals: Callable | Reading, options: Options, params0: PyTree, data: PyTree):
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
def _see(
    residuals: Callable | Reading, options: Options, x: Array, params0: PyTree, data: PyTree, rows: tuple | None = None
) -> Seen:
    """The `Seen` of x, with a `Kept`. rows: the result of `Arrow.read` there, if it is known already."""
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
        seen = problem.seen(x, *(rows or problem.read(x)))
        residual, starts = parts.unravel(seen.read[0]), parts.unravel_start(problem.split(x)[1])
    stretch = problem.objective.stretch(seen.read[0].ravel())
    estimates = None if options.loss is None else problem.estimates(*seen.read)
    kept = Kept(estimates, residual, freeze(coordinates.params(x[:p])), coordinates.slope(x[:p]), starts, stretch)
    return seen._replace(read=kept)


class HostProblem(NamedTuple):
    """A `Dense` problem. see: x -> its `Seen`."""

    see: Callable

    def look(self, x: np.ndarray, D: np.ndarray) -> DenseTrial:
        """The trial at x, with D from the trials before."""
        return dense_trial(x, _in_numpy(self.see(x)), D)

    def nothing(self, x: np.ndarray) -> DenseTrial:
        """A trial before the first evaluation."""
        zero = np.zeros_like(x)
        square, number = np.zeros((x.size, x.size), x.dtype), np.zeros((), x.dtype)
        return DenseTrial(x, None, number + np.inf, number, zero, zero, zero, square, zero)

    def weighted(self, trial: DenseTrial):
        """As of `Dense`."""
        _, J, kept = trial.read
        return _weighted(J, kept)

    step, damped, length, cosine, offset = Dense.step, Dense.damped, Dense.length, Dense.cosine, Dense.offset
    bending = Dense.bending


class HostRecords(NamedTuple):
    """An `Arrow` problem. see: x -> its `Seen`."""

    see: Callable
    p: int
    count: int

    def look(self, x: np.ndarray, D: np.ndarray) -> ArrowTrial:
        """The trial at x, with D from the trials before."""
        return arrow_trial(x, _in_numpy(self.see(x)), D, self.p)

    def nothing(self, x: np.ndarray) -> ArrowTrial:
        """A trial before the first evaluation."""
        k, zero, number = (x.size - self.p) // self.count, np.zeros_like(x), np.zeros((), x.dtype)
        R = np.zeros((self.count, 1, k + self.p), x.dtype)
        return ArrowTrial(x, None, number + np.inf, number, zero, zero, R[:, :, k:], R[:, :, :k], R[:, :, 0])

    def weighted(self, trial: ArrowTrial):
        """As of `Arrow`."""
        _, J, kept = trial.read
        return _weighted(J, kept)

    step, damped, length, cosine, offset = Arrow.step, Arrow.damped, Arrow.length, Arrow.cosine, Arrow.offset
    bending = Arrow.bending


def _weighted(J: np.ndarray, kept: Kept):
    """w J, and the squared factors of its rows in the least-squares problem; None without a loss, where they are 1."""
    if kept is None or kept.estimates is None:
        return J, None
    wJ, _, _ = kept.estimates
    return np.reshape(wJ, J.shape), np.reshape(kept.stretch, J.shape[:-1])


def _in_numpy(seen: Seen) -> Seen:
    """A `Seen` with NumPy arrays, except in its `Kept`."""
    seen, kept = jax.tree.map(np.asarray, seen._replace(read=None)), seen.read
    return seen._replace(read=(seen.r, seen.J, kept))


def is_on_host(options: Options, *given: PyTree) -> bool:
    """Whether a fit with these options and inputs can run with NumPy: on the CPU, and outside jit, vmap and grad."""
    is_free = is_untouched() and not is_tracing() and all_concrete(given)
    return is_free and options.optimizer == LEVENBERG_MARQUARDT and jax.default_backend() == "cpu"


def solve_on_host(
    residuals: Callable | Reading, options: Options, params0: PyTree, data: PyTree, many: Many | None = None
) -> FitResult:
    """`solve`, when nothing is being traced. many: the workers that evaluate records; None: this process."""
    x0, w, kind = _begin(residuals, options, params0, data)
    columns = x0.size if w.ndim == 1 else kind.p + (x0.size - kind.p) // len(w)
    if many is None and (kind.chooses_steps or w.size * columns > MANY):
        return solve(residuals, options, params0, data)
    x0, w, warned = np.asarray(x0), np.asarray(w), np.geterr()

    def see(x: np.ndarray, rows: tuple | None = None) -> Seen:
        with np.errstate(**warned):  # the user's functions may be traced here
            return _see(residuals, options, x, params0, data, rows)

    elsewhere = None
    if many is not None:
        _require_equal_steps(kind)
        elsewhere = many.problem(residuals, options, params0, data, w, kind.p)
    problem = elsewhere or (HostProblem(see) if w.ndim == 1 else HostRecords(see, kind.p, len(w)))
    longest = longest_steps(options.transforms, jax.tree.leaves(params0), x0.size - kind.p)
    with np.errstate(all="ignore"):
        limits = limits_of(options, data, x0)
        best, history, iterations, code = levenberg_marquardt(problem, x0, longest, *limits)
        if elsewhere is not None:
            best = best._replace(read=_in_numpy(see(best.x, elsewhere.rows(best.x))).read)
        found, kept = _solution(best, (history, iterations, code.astype(np.int32), None), kind, w, options.segments)
        if code == BAD_START:
            options = options._replace(covariance=False)  # of numbers that are not finite
        result = result_of(options, data, found, kept.params, np.asarray(kept.slope))
    numbers = {name: getattr(result, name) for name in NUMBERS}
    return result._replace(**jax.device_put(numbers))


def _require_equal_steps(kind: Kind):
    """Raises an error for residuals that choose their steps: all workers would have to choose the same."""
    if kind.chooses_steps:
        raise NotImplementedError(
            "fit: with an `executor` or a `mesh`, residuals must not simulate under error control: take equal steps."
        )


def _solution(best, ended, kind, w, segments):
    """The `_Solved` of the best trial, and its `Kept`."""
    r, J, kept = best.read
    estimates = kept.estimates
    if estimates is None:
        estimates = J.reshape(r.size, -1), r.ravel(), None
    estimates = jax.tree.map(np.asarray, estimates)
    if w.ndim == 1:
        return dense_solution(best.x, best.cost, ended, kept.residual, estimates, kind.shapes, w), kept
    ended = ended, kept.residual, kept.starts, estimates, kind.shapes
    return records_solution(best.x, best.cost, *ended, w, kind.p, segments), kept


# ----------------------------------------------------------------------------
# Derivatives of estimates: those of the minimum, by the implicit function theorem, not of the iterations that find it.
#
# At a minimum x of a cost c(x, d) the slope g = dc/dx is 0, whatever the data d, so that
#
#     H dx + (dg/dd) dd = 0,      H = dg/dx
#
# with the second derivatives of the residuals, which Gauss-Newton leaves out.


def at_minimum(solve: Callable, problem_of: Callable, p: int, *data: PyTree):
    """solve(), with the derivatives of the minimum in `data`.

    Args:
        solve: () -> (x, the problem's `read(x)`, further results), where the last have zero derivatives.
        problem_of: the problem as a function of the data.
        p: number of unknowns shared by all records. Those of single records follow in x, record by record.
        data: pytrees of arrays.
    """
    call, closed_over = hoisted(solve)

    @jax.custom_jvp
    def found(closed_over: list, data: PyTree):
        return call(closed_over)

    @found.defjvp
    def _(primals: tuple, tangents: tuple):
        x, values, more = found(*primals)
        data, moved = primals[1], tangents[1]
        dx = _response(problem_of, p, x, data, moved)
        _, change = jax.jvp(lambda x, data: problem_of(*data).read(x), (x, data), (dx, moved))
        return (x, values, more), (dx, change, jax.tree.map(zero_from_primal, more))

    return found(closed_over, data)


def _response(problem_of: Callable, p: int, x: Array, data: PyTree, moved: tuple) -> Array:
    """dx for the tangent `moved` of the data. Unknowns of single records are eliminated; all are perturbed at once."""
    g, along = jax.jvp(lambda data: problem_of(*data).slopes(x), (data,), (moved,))
    count, size = g.shape

    def near(small: Array) -> Array:
        return problem_of(*data).slopes(x + jnp.concatenate([small[:p], jnp.tile(small[p:], count)]))

    H = jax.jacfwd(near)(jnp.zeros(size, x.dtype))  # (records, slopes, unknowns)
    A, B, C = H[:, :p, :p], H[:, :p, p:], H[:, p:, p:]
    if size == p:
        return -_inverse(jnp.sum(A, axis=0)) @ jnp.sum(along, axis=0)
    C = jax.vmap(_inverse)(C)
    ahead = B @ C
    S = jnp.sum(A - ahead @ jnp.swapaxes(B, 1, 2), axis=0)
    shared = -_inverse(S) @ (jnp.sum(along[:, :p], axis=0) - jnp.einsum("bpk,bk->p", ahead, along[:, p:]))
    own = -jnp.einsum("bkj,bj->bk", C, along[:, p:]) - jnp.einsum("bpk,p->bk", ahead, shared)
    return jnp.concatenate([shared, own.ravel()])


def _inverse(H: Array) -> Array:
    """Pseudoinverse of a symmetric H whose unknowns differ in size; 0 in directions in which H is singular."""
    D = jnp.sqrt(jnp.abs(jnp.diagonal(H)))
    D = jnp.where(D == 0, 1, D)
    sizes = jnp.outer(D, D)
    return jnp.linalg.pinv(H / sizes, hermitian=True) / sizes
