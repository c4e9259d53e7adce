"""Solves of large systems: the same steps and derivatives as the dense solve, at a cost that grows with n alone."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hhtjax
from hhtjax.numerics.structured_solve import Banded
from hhtjax.scenes import pendulum

SOLVES = {"tridiagonal": hhtjax.banded(1), "blocks": hhtjax.banded(2), "cg": hhtjax.conjugate_gradients(40)}


def springs(q, v, t, params):
    """A chain of hardening springs and dampers, held at one end."""
    drift = jnp.diff(q, prepend=0.0)
    tension = params["k"] * drift + 100.0 * drift**3 + 0.1 * jnp.diff(v, prepend=0.0)
    return jnp.diff(tension, append=0.0)


def energy(k, n, stepper):
    """Of the end of a run: a number to differentiate."""
    run = hhtjax.simulate(
        hhtjax.System(np.ones(n), springs), stepper, np.linspace(0, 1, n), np.zeros(n), {"k": k}, dt=0.1, num_steps=3
    )
    return jnp.sum(run.q[-1] ** 2)


@pytest.mark.slow
@pytest.mark.parametrize("p", [1, 3])
def test_banded_solves_the_matrix_and_its_transpose(p):
    n, i, rng = 11, np.arange(11), np.random.default_rng(p)
    A = np.where(abs(i[:, None] - i) <= p, rng.normal(size=(n, n)), 0) + 8 * np.eye(n)
    b = rng.normal(size=n)
    solve = Banded(p).of_map(lambda x: jnp.asarray(A) @ x, jnp.asarray(b))
    np.testing.assert_allclose(solve(jnp.asarray(b)), np.linalg.solve(A, b), rtol=1e-12)
    np.testing.assert_allclose(solve(jnp.asarray(b), trans=1), np.linalg.solve(A.T, b), rtol=1e-12)


@pytest.fixture(scope="module")
def dense():
    """Value and derivative with the library's own solve."""
    return value_and_derivatives(hhtjax.hht(linearize="predictor"))


def value_and_derivatives(stepper):
    """Reverse and forward."""
    f = partial(energy, n=9, stepper=stepper)
    return jax.jit(lambda k: (*jax.value_and_grad(f)(k), jax.jvp(f, (k,), (1.0,))[1]))(30.0)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tridiagonal", "blocks"])
def test_steps_and_derivatives_are_those_of_the_dense_solve(name, dense):
    found = value_and_derivatives(hhtjax.hht(linearize="predictor", solve=SOLVES[name]))
    np.testing.assert_allclose(found, dense, rtol=1e-10)


@pytest.mark.slow
def test_too_few_iterations_leave_an_error_and_newton_reports_it(dense):
    left = energy(30.0, 9, hhtjax.hht(linearize="predictor", solve=hhtjax.conjugate_gradients(2)))
    assert 1e-8 < abs(left / dense[0] - 1) < 1e-2
    banded, cg = (
        energy(30.0, 9, hhtjax.hht(iterations=None, solve=solve)) for solve in (SOLVES["tridiagonal"], SOLVES["cg"])
    )
    np.testing.assert_allclose(banded, cg, rtol=1e-10)


@pytest.mark.slow
def test_memory_of_a_gradient_grows_with_the_number_of_unknowns():
    stepper = hhtjax.hht(linearize="predictor", solve=SOLVES["cg"])

    def temporary(n):
        program = jax.jit(jax.grad(partial(energy, n=n, stepper=stepper))).lower(30.0).compile()
        return program.memory_analysis().temp_size_in_bytes

    assert temporary(4000) < 11 * temporary(400)


def test_what_they_do_not_solve_is_refused():
    scene = pendulum.cartesian()
    with pytest.raises(NotImplementedError, match="leave out `solve` with constraints; received Banded"):
        hhtjax.simulate(
            scene.system, hhtjax.hht(solve=hhtjax.banded(1)), scene.q0, scene.v0, scene.params, dt=1e-3, num_steps=1
        )
    for make, name in ((hhtjax.banded, "half_bandwidth"), (hhtjax.conjugate_gradients, "iterations")):
        for value in (0, -1, 1.5, True):
            with pytest.raises(ValueError, match=f"{make.__name__}: `{name}` must be a positive integer"):
                make(value)


PAIRS = 701 * np.eye(8) - 300 * (np.eye(8, k=2) + np.eye(8, k=-2))  # springs of next neighbours: half-bandwidth 2


def pairs(q, v, t, params):
    """They, and a hardening spring of each coordinate."""
    return -(PAIRS @ q) - q**3


def run_pairs(n=8, num_steps=3, **options):
    stepper = hhtjax.hht(**options)
    return hhtjax.simulate(
        hhtjax.System(np.ones(n), pairs), stepper, np.linspace(0, 1, n) ** 2, np.zeros(n), dt=0.1, num_steps=num_steps
    )


def halved(A, b):
    """No solve at all."""
    return b / 2


WRONG = {"banded": hhtjax.banded(1), "cg": hhtjax.conjugate_gradients(1), "user": halved}


@pytest.mark.parametrize("name", WRONG)
@pytest.mark.parametrize("iterations", [1, None])
def test_a_solve_that_leaves_a_residual_fails_by_name(name, iterations):
    run = run_pairs(solve=WRONG[name], iterations=iterations, num_steps=1)
    assert run.info.solve_residual.max() > 1e-3
    with pytest.raises(
        hhtjax.SimulationError, match=r"step 1 .*the linear solve of the step leaves a residual of [0-9.]+ of"
    ):
        run.check()


def by_lu(A, b):
    return jnp.linalg.solve(A, b)


@pytest.mark.slow
@pytest.mark.parametrize("solve", [hhtjax.banded(2), hhtjax.conjugate_gradients(20), by_lu])
def test_one_that_solves_reports_rounding_and_passes(solve):
    run = run_pairs(solve=solve)
    run.check()
    assert run.info.solve_residual.max() < 1e-12
    assert run.info.solved.all()
    own = run_pairs()
    assert own.info.solve_residual is None
    assert own.failure.solve is None
    np.testing.assert_allclose(run.q, own.q, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_inexact_solves_are_accepted_to_a_tolerance():
    loose = run_pairs(solve=hhtjax.conjugate_gradients(3, tolerance=0.5), iterations=None)
    loose.check()
    assert loose.info.solve_residual.max() > 1e-6
    np.testing.assert_allclose(loose.q, run_pairs(iterations=None).q, rtol=1e-9, atol=1e-12)
    for make in (hhtjax.banded, hhtjax.conjugate_gradients):
        with pytest.raises(ValueError, match=f"{make.__name__}: `tolerance` must be positive; received 0.0"):
            make(1, tolerance=0.0)


@pytest.mark.slow
def test_of_a_linear_system_a_batch_and_a_sweep():
    n = 8
    system = hhtjax.LinearSystem(np.ones(n), None, PAIRS)
    stepper = hhtjax.hht(solve=hhtjax.banded(1))
    start = np.linspace(0, 1, n) ** 2, np.zeros(n)

    def run(scale):
        return hhtjax.simulate(system, stepper, start[0] * scale, start[1], dt=0.1, num_steps=2)

    batch = jax.vmap(run)(jnp.array([0.0, 1.0]))  # at rest there is nothing to solve
    with pytest.raises(hhtjax.SimulationError, match=r"member 1 \(1 of 2 failed\), step 1 .*the linear solve"):
        batch.check()
    runs = hhtjax.sweep(system, stepper, *start, dts=jnp.array([0.1, 1e-5]), duration=0.1, num_samples=1)
    with pytest.raises(hhtjax.SimulationError, match="the linear solve"):
        runs.check()
