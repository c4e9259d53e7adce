"""The C that the library is measured against does the same arithmetic, the charts are read rightly, and the pages."""

import json
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hhtjax
from experiments.__main__ import main
from experiments.benchmarks import accelerator, native, page
from experiments.benchmarks.chain import FORMULATIONS, chain
from experiments.cardona_geradin1989.index_1 import unconstrained
from experiments.work_precision import gradients, ours
from experiments.work_precision.cases import cases, linkage
from experiments.work_precision.timing import time_to
from hhtjax.scenes import double_pendulum


@pytest.mark.slow
@pytest.mark.parametrize("as_printed", [False, True])
def test_c_steps_like_the_library(as_printed):
    if not native.libraries():
        pytest.skip("no C compiler here")
    scene, q0 = double_pendulum.stiff(as_printed), np.array([0.3, -0.2])
    options = {"dt": 1e-3, "num_steps": 100}
    run = hhtjax.simulate(
        scene.system,
        hhtjax.hht(-0.1, linearize="predictor", start="simple"),  # as in C
        jnp.asarray(q0),
        scene.v0,
        scene.params,
        **options,
    )
    ours = np.concatenate([run.q[-1], run.v[-1], run.acceleration[-1]])
    batch = q0[:, None] + np.array([[0.0, 0.1, 0.2], [0.0, 0.0, 0.3]])
    libraries = native.libraries().values()
    assert np.float64(1e-300) * np.float64(1e-10) > 0  # to load them has not made the processor flush small numbers
    for found in libraries:
        single = native.Run(found, scene, q0, *options.values(), -0.1, save=True)
        np.testing.assert_allclose(single()[:6], ours, rtol=1e-9, atol=1e-11)
        np.testing.assert_allclose(single.path[:, :2], run.q[1:], rtol=1e-9)
        np.testing.assert_allclose(native.Run(found, scene, batch, *options.values(), -0.1)()[:6, 0], ours, rtol=1e-8)


@pytest.mark.slow
def test_the_accelerator_is_measured_where_there_is_one(tmp_path, capsys, monkeypatch):
    """The program of --gpu runs here, with few members, and without diffrax, whose program is the larger one; in full
    it says that there is none."""
    monkeypatch.setattr(accelerator, "is_installed", lambda name: False)
    with pytest.raises(SystemExit, match=r"benchmarks --gpu: JAX finds no accelerator, only .*cpu:0.*; --fast tries"):
        main(["benchmarks", "--gpu", "--out", str(tmp_path)])
    with pytest.raises(SystemExit):
        main(["silverbox", "--gpu"])
    assert "--gpu is for benchmarks" in capsys.readouterr().err
    assert main(["benchmarks", "--gpu", "--fast", "--out", str(tmp_path)]) == 0
    found = json.loads((tmp_path / "benchmarks.json").read_text())["accelerator"]
    (row,) = found["pendulums"]
    assert all(x < 1e-3 for x in row["median_difference_rad"].values())
    assert "| 8 |" in page.accelerator(found)


@pytest.mark.filterwarnings("ignore:simulate. in float32")
@pytest.mark.parametrize("precision", [np.float32, np.float64])
def test_lorenz_steps_keep_their_precision(precision):
    y, h = np.array([1.0, 0.0, 0.0]), accelerator.LORENZ_DT

    def rate(y):
        return np.asarray(accelerator.lorenz(y, 0.0, 20.0))

    for _ in range(2):
        k1 = rate(y)
        k2 = rate(y + h / 2 * k1)
        k3 = rate(y + h / 2 * k2)
        y = y + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(y + h * k3))
    found = accelerator.lorenz_end(2, jnp.asarray(20.0, precision))
    assert found.dtype == precision
    np.testing.assert_allclose(found, y, rtol=1e-6 if precision == np.float32 else 1e-13)


def test_both_formulations_of_the_chain_are_one():
    scene = chain(5, k=2.0, c=0.1)
    q, v = jnp.linspace(-1.0, 2.0, 5), jnp.linspace(3.0, -1.0, 5)
    first, second = FORMULATIONS.values()
    M, Q = (jax.jit(f)(*x, scene.params) for f, x in ((first.mass, (q,)), (first.force, (q, v, 0.0))))
    np.testing.assert_allclose(second.mass(q, scene.params), M, atol=1e-14)
    np.testing.assert_allclose(second.force(q, v, 0.0, scene.params), Q, atol=1e-13)
    np.testing.assert_allclose(second.inertia(q, v, scene.params), M @ v, atol=1e-13)


@pytest.mark.slow
def test_both_eliminations_of_the_squeezer_are_one():
    """In values and derivatives, far from its start."""
    case = linkage()
    params, rng = case.scene.params, np.random.default_rng(0)
    q, v = case.scene.q0 + 0.01 * rng.normal(size=7), 50 * jnp.asarray(rng.normal(size=7))

    @partial(jax.jit, static_argnums=0)
    def both(force, q, v):
        return jax.jvp(partial(force, t=jnp.zeros(()), params=params), (q, v), (v, q))

    forms = unconstrained(case.scene.system, 7), case.ode[0]
    for one, other in zip(*(both(form.force, q, v) for form in forms), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-10 * np.max(np.abs(one)))


def test_time_to_an_error_is_read_off_the_line_between_runs():
    points = [(1.0, None), (1.0, 1e-1), (10.0, 1e-3), (12.0, 1e-2), (100.0, 1e-5)]
    rows = [{"time_s": t, "rms_error": error} for t, error in points]
    assert time_to(rows, 1e-2) == pytest.approx(10**0.5)
    assert time_to(rows, 1e-4) == pytest.approx(10**1.5)
    assert time_to(rows, 0.5) == 1.0
    assert time_to(rows, 1e-6) is None


@pytest.mark.slow
def test_errors_of_controlled_runs_follow_their_tolerances():
    rows = ours.controlled_entries("forced Duffing", (1e-3, 1e-5), ("dopri5, adaptive",))
    assert [row["tolerance"] for row in rows] == [1e-3, 1e-5]
    for row in rows:
        assert 0.01 < row["rms_error"] / row["tolerance"] < 30


@pytest.mark.slow
@pytest.mark.parametrize("method", ["dopri5, adaptive", pytest.param("rowda, adaptive", marks=pytest.mark.every)])
def test_errors_of_controlled_gradients_are_within_their_tolerance(method):
    rows = gradients.controlled_rows("forced Duffing", (1e-3,), (method,))
    assert len(rows) == 2
    for row in rows:
        assert row["rms_error"] / row["setting"] < 100


def test_gradients_are_taken_on_all_scenes():
    assert set(gradients.SCENES) == set(cases())
    assert all(2 <= gradients.start(name).size <= 4 for name in gradients.SCENES)


def test_more_steps_are_allowed_only_where_the_default_is_used_up():
    asked = []

    def rows_for(most, tolerances):
        asked.append((most, tolerances))
        return [{"rms_error": x if most * x > 1 else None} for x in tolerances[:3]]  # finer ones are not tried

    rows = ours.while_needed(rows_for, [1e-2, 1e-3, 3e-5, 1e-9])
    assert asked == [(10_000, [1e-2, 1e-3, 3e-5, 1e-9]), (100_000, [3e-5])]
    assert [row["rms_error"] for row in rows] == [1e-2, 1e-3, 3e-5]
