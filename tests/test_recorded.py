"""A run under error control in one pass is that over its steps in two, to rounding: values, derivatives, batches."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import zoo
from helpers import ONE, ZERO
from test_held import SYSTEM, VALUES

import hhtjax
from hhtjax.runs.controlled import run_in_one, run_in_two
from hhtjax.runs.problem import Problem
from hhtjax.scenes import pendulum

SWING = hhtjax.System(ONE, lambda q, v, t, k: -k * jnp.sin(q) - 0.1 * v)
ROD, FREE = pendulum.cartesian(), zoo.PROBLEMS["forced double pendulum"]
HELD = {"u": hhtjax.sampled(jnp.asarray(VALUES), times=np.array([0.0, 0.07, 0.08, 0.25, 0.31, 0.5]), order=0)}
LIGHT = hhtjax.hht(-0.3, linearize="predictor")
CASES = {  # system, stepper, q0, v0, params
    "jumps": (SYSTEM, LIGHT, np.array([0.4, -0.3]), np.array([0.0, 1.0]), HELD),
    "constraint": (ROD.system, LIGHT, ROD.q0, np.array([-ROD.q0[1], ROD.q0[0]]), ROD.params),
    "auto": (FREE.system, hhtjax.hht(), FREE.q0, FREE.v0, FREE.params),
    "dense output": (FREE.system, hhtjax.dopri5(), FREE.q0, FREE.v0, FREE.params),
    "first order": (hhtjax.FirstOrderSystem(lambda y, t, k: -k * y**3), hhtjax.rowda(), ONE, None, 4.0),
    "converged": (SWING, hhtjax.hht(iterations=None), ONE, ZERO, 9.0),
}
TIMES = np.sort(np.append(np.linspace(0, 0.6, 40)[1:], [0.07 + 1e-4, 0.07 + 2e-4, 0.2501]))  # several in one step too
CONTROL = hhtjax.adaptive(1e-3, 1e-6, max_steps=2000)


def problem_of(name):
    return Problem.checked("test", *CASES[name], 0.0, None)


def same(one, two, rtol=1e-8, atol=1e-10):
    assert jax.tree.structure(one) == jax.tree.structure(two)
    for x, y in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
        assert x.dtype == y.dtype
        np.testing.assert_allclose(x, y, rtol=rtol, atol=atol)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_values(name):
    one, two = (f(problem_of(name), TIMES, CONTROL) for f in (run_in_one, run_in_two))
    assert int(one[1].accepted) > 10
    # multipliers and accelerations of a constraint: rounding over h^2
    same(
        (one[0], one[1]._replace(dt=None, estimate=None)), (two[0], two[1]._replace(dt=None, estimate=None)), 1e-7, 1e-8
    )


@pytest.mark.slow
def test_derivatives_and_batches():
    """Are those of two passes, and nothing is chosen again for them."""

    def loss(run, k):
        problem = Problem.checked("test", SWING, LIGHT, ONE, ZERO, k, 0.0, None)
        return jnp.sum(run(problem, TIMES, CONTROL)[0].q ** 2)

    ks = jnp.array([9.0, 30.0])
    for change in (jax.grad, jax.jacfwd, lambda f: f):
        one, two = (jax.jit(jax.vmap(change(lambda k, run=run: loss(run, k))))(ks) for run in (run_in_one, run_in_two))
        same(one, two)


@pytest.mark.slow
def test_a_run_that_ends_early():
    """Is there up to its end, and NaN behind it."""
    run = hhtjax.simulate(SWING, LIGHT, ONE, ZERO, 9.0, dt=hhtjax.adaptive(1e-3, 1e-6, max_steps=20), times=TIMES)
    with pytest.raises(hhtjax.SimulationError, match=r"stopped at t = 0.\d+: max_steps=20 used up"):
        run.check()
    there = np.append(0.0, TIMES) <= float(run.steps.reached)
    assert there[1]
    assert not there[-1]
    np.testing.assert_array_equal(np.isfinite(run.q[:, 0]), there)
