"""Runs that failed are told at once, outside of jit: by a warning, or, if asked for, by an error."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hhtjax

REPULSION = hhtjax.System(jnp.ones(1), lambda q, v, t, params: params * q**3)
CONVERGED = hhtjax.hht(iterations=None)
START = 5 * jnp.ones(1), jnp.zeros(1)
GRID = {"dt": 0.01, "num_steps": 200}


def run(strength, **options):
    return hhtjax.simulate(REPULSION, CONVERGED, *START, strength, **{**GRID, **options})


def runs(strengths, **options):
    return hhtjax.sweep(
        REPULSION, CONVERGED, *START, strengths, dts=[0.01, 0.01], duration=2.0, num_samples=4,
        in_axes=(None, None, None, 0), **options,
    )  # fmt: skip


def said(solution):
    """The sentence of `check`."""
    with pytest.raises(hhtjax.SimulationError) as caught:
        solution.check()
    return str(caught.value)


@pytest.fixture(autouse=True)
def telling():
    with warnings.catch_warnings():
        warnings.simplefilter("error", hhtjax.FailedRunWarning)
        yield


def test_a_run_that_failed_warns_with_the_sentence_of_check():
    with pytest.warns(hhtjax.FailedRunWarning) as caught:
        solution = run(1.0)
    assert [str(x.message) for x in caught] == [said(solution)]
    assert caught[0].filename == __file__
    with pytest.warns(hhtjax.FailedRunWarning, match="^interpolate: of a run that failed: step "):
        hhtjax.interpolate(solution, 0.015)
    with pytest.raises(hhtjax.SimulationError) as error:
        run(1.0, throw=True)
    assert str(error.value) == said(solution)
    run(-1.0, throw=True)  # a spring


def test_a_sweep_names_the_first_member_that_failed():
    with pytest.warns(hhtjax.FailedRunWarning, match=r"^sweep: member 1 .*, step \d+ ") as caught:
        solution = runs(jnp.array([-1.0, 1.0]))
    assert len(caught) == 1
    assert solution.failed.tolist() == [False, True]
    with pytest.raises(hhtjax.SimulationError, match=r"^sweep: member 1"):
        runs(jnp.array([-1.0, 1.0]), throw=True)
    runs(jnp.array([-1.0, -2.0]), throw=True)


@pytest.mark.slow
def test_what_error_control_gave_up_is_told():
    control = {"dt": hhtjax.adaptive(1e-6, 1e-9, max_steps=20), "num_steps": None, "times": jnp.array([2.0])}
    with pytest.warns(hhtjax.FailedRunWarning, match="max_steps=20 used up"):
        run(1.0, **control)


@pytest.mark.slow
def test_inside_jit_and_vmap_failures_travel_as_data():
    strengths = jnp.array([-1.0, 1.0])
    assert jax.jit(lambda k: run(k, throw=True).failed)(1.0)
    np.testing.assert_array_equal(jax.vmap(lambda k: run(k, throw=True).failed)(strengths), [False, True])
    with pytest.warns(hhtjax.FailedRunWarning):  # without jit a derivative knows
        jax.jvp(lambda k: run(k).q[-1], (1.0,), (1.0,))
