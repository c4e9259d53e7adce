"""Levenberg-Marquardt on the problems of More, Garbow and Hillstrom, against MINPACK with the same Jacobians."""

import jax.numpy as jnp
import numpy as np
import pytest
from mgh import PROBLEMS, jacobian
from scipy.optimize import least_squares

import hhtjax
from hhtjax.identification.arguments import check_options
from hhtjax.identification.gauss_newton import Seen
from hhtjax.identification.least_squares import CONVERGED, levenberg_marquardt
from hhtjax.identification.problem import HostProblem

LIMIT = check_options("fit", 0.0, None, None, None, None, True, 2, False).max_iterations


def is_minimum(problem, cost):
    return any(abs(2 * cost - known) <= 1e-4 * known + 1e-10 for known in problem.minima)


def by_minpack(problem):
    """Runs and Jacobians of MINPACK, at the tolerances of `fit`."""
    count = {"runs": 0, "jacobians": 0}

    def runs(x):
        count["runs"] += 1
        return problem.residuals(x)

    def jacobians(x):
        count["jacobians"] += 1
        return jacobian(problem.residuals, x)

    x0 = np.array(problem.start, float)
    least_squares(runs, x0, jacobians, method="lm", x_scale="jac", ftol=1e-8, xtol=1e-8, gtol=1e-8, max_nfev=10_000)
    return count["runs"] - 1, count["jacobians"] - 1  # SciPy evaluates the start once more


def by_fit(problem):
    """Runs, each with its Jacobian, the cost, and why it ended: of what `fit` does around compiled residuals."""
    runs = 0

    def see(x):
        nonlocal runs
        runs += 1
        r = problem.residuals(x)
        return Seen(r, jacobian(problem.residuals, x), np.sum(r**2) / 2, None, None)

    x0 = np.array(problem.start, float)
    limits = np.full(x0.size, np.inf), np.float64(1e-8), LIMIT, False
    best, _, _, code = levenberg_marquardt(HostProblem(see), x0, *limits)
    return runs, float(best.cost), code


@pytest.mark.slow
def test_minima_are_found_in_fewer_runs_than_minpack_takes():
    """All of them, within the default number of iterations; in all a third fewer runs, and fewer Jacobians."""
    with np.errstate(all="ignore"):
        found = {name: by_fit(problem) for name, problem in PROBLEMS.items()}
        known = np.array([by_minpack(problem) for problem in PROBLEMS.values()])
    for name, (runs, cost, code) in found.items():
        assert is_minimum(PROBLEMS[name], cost), name
        assert code in CONVERGED, name
        assert runs <= 100, name
    runs = np.array([runs for runs, _, _ in found.values()])
    assert np.sum(runs) < 0.67 * np.sum(known[:, 0])
    assert np.sum(runs) < 0.75 * np.sum(known[:, 1])
    assert np.max(runs - known[:, 0]) <= 15


def test_a_curved_valley_through_the_whole_of_fit():
    """From (-12, 10) it took 155 iterations."""

    def valley(x):
        return jnp.stack([10 * (x[1] - x[0] ** 2), 1 - x[0]])

    result = hhtjax.fit(valley, jnp.array([-12.0, 10.0]), covariance=False)
    np.testing.assert_allclose(result.params, 1.0, rtol=1e-7)
    assert int(result.iterations) <= 16
