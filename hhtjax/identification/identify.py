"""Parameters from measurements: nonlinear least squares through the simulation.

    minimise  1/2 sum_i rho((w_i r_i(params))^2)  +  priors

with exact derivatives: Levenberg-Marquardt on forward-mode Jacobians for few parameters, any optax
optimiser on reverse-mode gradients for many.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from hhtjax.checks import require_function, require_integer, require_number
from hhtjax.description import PyTree, Real, all_concrete, current, is_concrete, is_tracing, thaw, with_data
from hhtjax.description.presentation import shown
from hhtjax.identification.arguments import (
    LEVENBERG_MARQUARDT,
    check_options,
    check_parameters,
    check_prior,
    check_records,
    check_scale,
    check_transforms,
    require_leading_axis,
)
from hhtjax.identification.identifiability import warn_undetermined
from hhtjax.identification.least_squares import BAD_START, NO_INFLUENCE
from hhtjax.identification.many_records import Many
from hhtjax.identification.parameter_vector import Data
from hhtjax.identification.problem import is_on_host, solve, solve_on_host
from hhtjax.identification.residuals import check_weights, first_bad
from hhtjax.identification.result import FitResult
from hhtjax.identification.sandwich import SEGMENTS
from hhtjax.runs.executors import Chunks, Work, collected, require_executor, sent

if TYPE_CHECKING:
    from hhtjax.identification.arguments import Options


def fit(
    residuals: Callable[..., Any],
    params0: PyTree,
    optimizer: PyTree = None,
    *,
    records: PyTree = None,
    starts: PyTree = None,
    transforms: PyTree = None,
    scale: PyTree = None,
    weights: PyTree = True,
    loss: str | Callable[[Any], Any] | None = None,
    prior: PyTree = None,
    max_iterations: int | None = None,
    tolerance: Real = 1e-8,
    covariance: bool = True,
    segments: int = SEGMENTS,
    progress: bool = False,
    executor: Executor | None = None,
    mesh: Mesh | None = None,
    chunk: int = 1,
) -> FitResult:
    """Finds the parameters that minimise the sum of squares of `residuals(params)`.

    Args:
        residuals: params -> any pytree of real arrays. JAX must be able to trace it, so that its derivatives are exact.
        params0: initial guess, any pytree of real numbers and arrays. Functions in it, as in an `equinox.Module`, stay
            unchanged.
        optimizer: "levenberg_marquardt", with forward-mode Jacobians, one column for each parameter; or any optax
            optimiser, with reverse-mode gradients of the cost. None: Levenberg-Marquardt for up to 64 free parameters,
            optax.lbfgs() for more.
        records: several experiments, or windows of one: any pytree whose leaves have a leading axis, with one entry for
            each record. Then `residuals(params, start, record)` returns the residuals of one record.
        starts: guesses of the unknowns that belong to a single record, such as its initial state: a pytree with the
            same leading axis. They are fitted too. Each step eliminates them (by a Schur complement) and solves for the
            parameters alone. So the Jacobian has the columns of one start only, however many records there are. Needs
            Levenberg-Marquardt and no prior.
        transforms: for each leaf of params0, or for whole branches: `positive`, `bounded(lower, upper)`, `fixed`,
            or None for no transform. Keys of dicts may be left out, which means None.
        scale: typical size of each parameter: a pytree like params0, whose leaves are numbers or arrays with the shape
            of the parameter. The optimiser works on params/scale where no transform is given. Default: |params0|, or 1
            where that is 0. Levenberg-Marquardt does its own scaling and uses this one only in its test of small steps.
        weights: w, for each leaf of the residuals, or for whole branches: numbers, or arrays over their leading
            axes. A weight is one over the standard deviation of the noise. 0 or False marks a missing sample, whose
            residual may be NaN.
        loss: rho, robust against outliers: "huber", "soft_l1", "cauchy", or an elementwise function with
            rho(z) = z for small z. The loss departs from a square where |w r| is about 1, so give weights. Standard
            errors are then those of an M-estimate. None: rho(z) = z.
        prior: for each leaf of params0, or for whole branches: `Gaussian(mean, deviation)`, or None. It adds
            1/2 ((p - mean)/deviation)^2 to the cost, so choose weights with which w r has unit variance.
        max_iterations: default 200, or 1000 with an optax optimiser.
        tolerance: relative. The fit has converged when the cosine between the residual and each column of the Jacobian
            is at most tolerance. It has also converged when this cosine is below 10 sqrt(tolerance) and the change of
            the cost, or the scaled step, is at most tolerance. With optax: the relative change of the cost, five times
            in a row.
        covariance: False leaves out the covariance. With optax the covariance costs one forward-mode Jacobian.
        segments: number of parts into which the leaves of the residuals are cut. Each part must be long compared with
            the correlation time of the residuals. Standard errors come from the scatter between the parts (the cluster
            covariance of `Uncertainty`). With `records`, parts are made of whole records if this gives at least 8
            parts, and more parts than parameters.
        progress: show cost and step of the last iteration in one line on stderr, and at the end why the fit stopped.
        executor: its workers evaluate the `records`, as for `parallel_map`. Needs Levenberg-Marquardt, and a call
            outside jit. A worker returns a small triangular matrix for each record, with one row and column for each
            unknown. Residuals and Jacobians are returned once, at the minimum, for the standard errors. Steps have no
            geodesic acceleration, because this would need the Jacobians in every step. So the fit may take more
            iterations. The minimum is the same.
        mesh: CPU devices that evaluate the records instead of an executor: `jax.make_mesh((2,), ("records",))`.
        chunk: number of records in each task of the executor.

    Compilation: `residuals` is traced and compiled once, and again when a value that it reads from outside has changed,
    as for `simulate`. Arrays are compared by their bytes. Float arrays that have changed become inputs of the compiled
    program, if the computation with them can be traced. So a loop over records of equal length, in which `residuals`
    reads a variable, compiles for the first two records only. Residuals that take a number out of such an array, as
    `float(y[0])` or `if y.max() > 1`, are compiled for every record.

    Derivatives: estimates have forward and reverse derivatives with respect to all inputs of the fit and to all values
    that its residuals read, except the initial guess. They are the derivatives of the minimum, by the implicit function
    theorem: H dx + (dg/dd) dd = 0. Here c is the cost, x are the fitted parameters, d the inputs, g = dc/dx and
    H = dg/dx. The derivatives are valid only if the fit has converged: check `result.code`, and use a small
    `tolerance`.

    Error control: residuals may simulate with `dt=adaptive(...)`, also in `sweep`. Levenberg-Marquardt fits with frozen
    steps, chooses the steps again at the estimate, and repeats this until the estimates change by less than a tenth of
    their standard errors. `result.choices` is the number of repetitions. If the error control leaves errors larger than
    the noise, the fit stops with the reason "the estimates change whenever steps are chosen anew". Then reduce rtol.

    The step size: residuals of a simulation contain the error of its steps, which shifts the estimates. Standard errors
    do not include this bias. Fit again with half the step, or use `refine`; `step_size_bias` predicts it.

    Returns:
        A `FitResult`. Outside jit and vmap, problems raise an error or a warning. Inside them, check `result.code`.

    Raises:
        TypeError, ValueError: an argument of a wrong kind; an initial guess that a transform excludes; no free
            parameter; more parameters than residuals. Also residuals that are not finite at params0 and not declared
            missing; that are (n, n), because (n, 1) and (n,) were subtracted; that do not depend on any parameter at
            params0; or that JAX cannot trace.

    Warns:
        IdentifiabilityWarning: the Jacobian at the solution is rank deficient. The warning names the parameters, and
            the combination of them that has no effect.

    References:
        Levenberg (1944); Marquardt (1963), with his scaling of the damping; Nocedal, Wright (2006), Ch. 10; geodesic
        acceleration: Transtrum, Sethna (2012). Robust losses: Triggs, McLauchlan, Hartley, Fitzgibbon (2000), as in
        SciPy's `least_squares`.

    >>> import jax.numpy as jnp, hhtjax
    >>> t = jnp.linspace(0.0, 1.0, 20)
    >>> measured = 3.0 * jnp.exp(-2.0 * t)
    >>> result = hhtjax.fit(lambda p: p["a"] * jnp.exp(-p["rate"] * t) - measured, {"a": 1.0, "rate": 1.0})
    >>> round(float(result.params["a"]), 3), round(float(result.params["rate"]), 3)
    (3.0, 2.0)
    """
    of_records = records is not None or starts is not None
    signature = "residuals(params, start, record)" if of_records else "residuals(params)"
    require_function("fit", "residuals", residuals, signature)
    params0 = check_parameters("fit", params0)
    options = check_options("fit", params0, optimizer, transforms, loss, max_iterations, covariance, segments, progress)
    data = _check_data("fit", params0, scale, weights, prior, tolerance)
    if of_records:
        data = data._replace(records=records, starts=check_records("fit", records, starts, prior, options.optimizer))
    alone = is_on_host(options, params0, data)
    options = options._replace(loss=options.loss and current(options.loss))
    solver = solve_on_host if alone else solve
    if executor is not None or mesh is not None:
        solver = partial(solve_on_host, many=_many(options, of_records, alone, executor, mesh, chunk))
    result = _solved(solver, residuals, options, params0, data)
    result = result._replace(params=thaw(result.params))
    return _finished("fit", result, weights) if is_concrete(result.code) else result


def _many(options: Options, of_records: bool, alone: bool, executor: Any, mesh: Any, chunk: int) -> Many:
    """Who evaluates the records, or an error."""
    if executor is not None and mesh is not None:
        raise ValueError("fit: give an `executor` or a `mesh`, not both.")
    if not of_records or options.optimizer != LEVENBERG_MARQUARDT:
        raise ValueError(
            "fit: an `executor` or a `mesh` needs `records` and Levenberg-Marquardt; without `records` use "
            "sweep(mesh=) in the residuals."
        )
    if not alone:
        raise TypeError("fit: with an `executor` or a `mesh`, call it outside jit, vmap and grad, on the CPU.")
    if mesh is not None and not isinstance(mesh, Mesh):
        raise TypeError(f"fit: `mesh` must be a jax.sharding.Mesh; received {mesh!r}.")
    if mesh is not None:
        mesh = Mesh(mesh.devices.ravel(), ("records",))  # whatever its shape and its types of axes
    return Many(require_executor("fit", executor), mesh, require_integer("fit", "chunk", chunk))


def _solved(solver, residuals: Callable, options: Options, params0: PyTree, data: PyTree) -> FitResult:
    """Runs a solver. Arrays that the residuals read are inputs of its program if an earlier fit has read other ones."""
    found = None if is_tracing() or data.records is not None else with_data(residuals)
    if found is not None:
        kind, arrays = found
        try:
            return solver(kind, options, params0, data._replace(read=arrays))
        except Exception:  # NumPy cannot take a tracer, say; what is wrong otherwise is told below
            kind.refuse()
    return solver(current(residuals), options, params0, data)


@shown
class Multistart(NamedTuple):
    """Result of `multistart`.

    Attributes:
        best: the `FitResult` with the lowest cost.
        all: a `FitResult` with a leading axis, one entry for each start.
    """

    best: FitResult
    all: FitResult


def multistart(
    residuals: Callable[..., Any],
    starts: PyTree,
    optimizer: PyTree = None,
    *,
    transforms: PyTree = None,
    scale: PyTree = None,
    weights: PyTree = True,
    loss: str | Callable[[Any], Any] | None = None,
    prior: PyTree = None,
    max_iterations: int | None = None,
    tolerance: Real = 1e-8,
    covariance: bool = True,
    segments: int = SEGMENTS,
    executor: Executor | None = None,
    chunk: int = 1,
    progress: bool = False,
) -> Multistart:
    """Runs `fit` from several initial guesses at once: vectorised, or on the workers of an executor.

    Args:
        starts: a pytree like params0. Each leaf has a leading axis, with one entry for each initial guess.
        scale: a pytree like params0. Default: the default scale of the first start.
        residuals, optimizer, transforms, weights, loss, prior, max_iterations, tolerance, covariance, segments: as in
            `fit`.
        executor: its workers run the fits, as for `parallel_map`. The call must be outside jit.
        chunk: number of starts in each task of the executor. All starts of a task iterate until the slowest has ended.
        progress: shows the iteration and the lowest cost so far in one line on stderr; with an executor, a bar of the
            finished tasks.

    Returns:
        A `Multistart`.

    Raises:
        TypeError, ValueError: as `fit`; leaves of `starts` with different leading lengths; residuals that are not
            finite at any start.
        NotImplementedError, RuntimeError: of an executor, as `parallel_map`.

    >>> import jax.numpy as jnp, hhtjax
    >>> t = jnp.linspace(0.0, 6.0, 50)
    >>> found = hhtjax.multistart(lambda w: jnp.sin(w * t) - jnp.sin(3.0 * t), jnp.array([0.5, 2.8, 6.0]))
    >>> round(float(found.best.params), 6), int(jnp.sum(found.all.cost < 1e-9))
    (3.0, 1)
    """
    require_function("multistart", "residuals", residuals, "residuals(params)")
    starts = check_parameters("multistart", starts, "starts")
    require_leading_axis("multistart", "`starts`", starts)
    first = jax.tree.map(lambda x: x[0], starts)
    options = check_options(
        "multistart", first, optimizer, transforms, loss, max_iterations, covariance, segments, progress
    )
    check_transforms("multistart", transforms, starts, "starts")
    data = _check_data("multistart", first, scale, weights, prior, tolerance)
    residuals, options = current(residuals), options._replace(loss=options.loss and current(options.loss))
    if executor is None:
        every = jax.vmap(lambda start: solve(residuals, options, start, data))(starts)
    else:
        fits = _Starts(residuals, options._replace(progress=""), jax.tree.structure((data, starts)))
        every = _by_workers(fits, data, starts, executor, chunk, progress)
    failed = (every.code == BAD_START) | (every.code == NO_INFLUENCE) | jnp.isnan(every.cost)
    cost = jnp.where(failed, jnp.inf, every.cost)
    best = jax.tree.map(lambda x: x[jnp.argmin(cost)], every)
    best, every = (result._replace(params=thaw(result.params)) for result in (best, every))
    return Multistart(_finished("multistart", best, weights) if is_concrete(best.code) else best, every)


@dataclass(frozen=True)
class _Starts:
    """The fits from some starts, a function of lists of arrays."""

    residuals: Callable
    options: Options
    structure: Any

    def __call__(self, shared: list, own: list) -> FitResult:
        data, starts = jax.tree.unflatten(self.structure, [*shared, *own])
        return jax.vmap(lambda start: solve.usual(self.residuals, self.options, start, data))(starts)


def _by_workers(fits: _Starts, data: Data, starts: PyTree, executor: Executor, chunk: int, progress: bool) -> FitResult:
    if not all_concrete((data, starts)):
        raise TypeError(
            "multistart: with an `executor`, all arguments must be known: call it outside jit, vmap and grad."
        )
    hands = require_executor("multistart", executor, progress=progress)
    shared, own = [sent(x) for x in jax.tree.leaves(data)], [np.asarray(x) for x in jax.tree.leaves(starts)]
    chunks = Chunks.of(len(own[0]), require_integer("multistart", "chunk", chunk))
    work = Work(fits, shared, lambda members: [x[members] for x in own], chunks, {})
    return jax.device_put(collected(work, hands))


def _check_data(caller: str, params0: PyTree, scale, weights: PyTree, prior: dict | None, tolerance: Real) -> Data:
    require_number(caller, "tolerance", tolerance, lambda x: x > 0, "be positive")
    check_weights(caller, weights)
    prior = None if prior is None else check_prior(caller, prior, params0)
    return Data(check_scale(caller, scale, params0), weights, prior, tolerance, None, None)


def _finished(caller: str, result: FitResult, weights: PyTree) -> FitResult:
    """The result of a fit outside jit: raises or warns about problems, and cuts the history to the iterations made."""
    code = int(result.code)
    if code == BAD_START:
        bad = first_bad(result.residual, weights, result.starts is not None)
        raise ValueError(f"{caller}: `residuals` must be finite at params0; received {bad}.")
    if code == NO_INFLUENCE:
        raise ValueError(f"{caller}: `residuals` must depend on params; their derivatives at params0 are all zero.")
    if result.uncertainty is not None:
        warn_undetermined(caller, result, stacklevel=4)
    done = int(result.iterations) + 1
    return result._replace(history=jax.tree.map(lambda x: x[:done], result.history), segments=int(result.segments))
