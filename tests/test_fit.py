"""Least squares: known parameters recovered, uncertainty, stop reasons, and every complaint."""

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from scipy.optimize import least_squares

import hhtjax

t = jnp.linspace(0.0, 2.0, 60)
TRUE = {"a": 3.0, "decay": jnp.array([0.5, 2.0])}


def model(params):
    return params["a"] * jnp.exp(-params["decay"][0] * t) + jnp.exp(-params["decay"][1] * t)


NOISE = 0.01 * np.random.default_rng(0).normal(size=60)


def decay_residuals(params):
    return {"signal": model(params) - model(TRUE) - NOISE, "nothing": jnp.zeros((2, 3))}


START = {"a": 1.0, "decay": jnp.array([0.2, 4.0])}


@pytest.fixture
def _promotion():
    """optax itself does not compute under strict promotion."""
    with jax.numpy_dtype_promotion("standard"):
        yield


@pytest.mark.compiled
def test_estimate_and_naive_covariance_are_scipys(capfd):
    """With progress on stderr; a second start costs no tracing."""
    calls = []

    def residuals(params):
        calls.append(1)
        return decay_residuals(params)

    result = hhtjax.fit(residuals, START, progress=True)
    jax.effects_barrier()
    assert jax.tree.structure(result.params) == jax.tree.structure(START)
    compiled = jax.jit(lambda x: decay_residuals({"a": x[0], "decay": x[1:]})["signal"])
    scipys = least_squares(lambda x: np.asarray(compiled(x)), [1.0, 0.2, 4.0], xtol=1e-14, ftol=1e-14)
    np.testing.assert_allclose([result.params["a"], *result.params["decay"]], scipys.x, rtol=1e-5)
    covariance = 2 * scipys.cost / (t.size + 6 - 3) * np.linalg.inv(scipys.jac.T @ scipys.jac)
    np.testing.assert_allclose(result.uncertainty.naive, covariance, rtol=1e-3)
    assert result.residual["nothing"].shape == (2, 3)
    assert np.all(np.isfinite(result.history.cost))
    assert result.history.cost.shape == (int(result.iterations) + 1,)
    shown = capfd.readouterr().err
    assert shown.count("\n") == 1  # one line stays
    _, *lines = shown.split("\r")
    assert len(lines) == int(result.iterations) + 1
    assert lines[0].startswith("fit: iteration 0, cost ")
    assert lines[0].rstrip().endswith(", start")
    assert ", step " in lines[1]
    assert result.reason in lines[-1]
    count = len(calls)
    hhtjax.fit(residuals, {"a": 2.0, "decay": jnp.array([0.3, 3.0])}, progress=True)
    assert len(calls) == count


@pytest.mark.usefixtures("_promotion")
def test_scale_sets_the_steps_of_an_optax_optimiser():
    def residuals(params):
        return (jnp.stack([params["small"] * 1e6, params["large"]]) - 1.0) * jnp.ones(2)

    start = {"small": 0.0, "large": 0.0}
    scaled = hhtjax.fit(
        residuals, start, optax.adam(0.05), scale={"small": 1e-6, "large": 1.0}, max_iterations=500, covariance=False
    )
    assert scaled.covariance is None
    assert float(scaled.params["small"]) == pytest.approx(1e-6, rel=1e-2)
    assert float(scaled.params["large"]) == pytest.approx(1.0, rel=1e-2)


@pytest.mark.slow
def test_float32_stays_float32():
    start = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), START)
    data = model(TRUE).astype(jnp.float32)
    time = t.astype(jnp.float32)

    def residuals(params):
        return params["a"] * jnp.exp(-params["decay"][0] * time) + jnp.exp(-params["decay"][1] * time) - data

    result = hhtjax.fit(residuals, start)
    assert result.params["a"].dtype == result.cost.dtype == result.covariance.dtype == jnp.float32
    assert float(result.params["a"]) == pytest.approx(3.0, rel=1e-2)


def test_reasons_for_stopping():
    early = hhtjax.fit(decay_residuals, START, max_iterations=2, covariance=False)
    assert early.reason == "stopped: max_iterations reached"
    assert not early.converged
    assert early.history.cost.shape == (3,)

    def with_a_wrong_derivative(p):
        return (2 * jax.lax.stop_gradient(p) - p - 1.0) * jnp.ones(2)

    at_minimum = hhtjax.fit(with_a_wrong_derivative, 1.0, covariance=False)
    assert at_minimum.iterations == 0
    assert at_minimum.reason == "converged: the gradient vanishes to within tolerance"
    assert hhtjax.fit(with_a_wrong_derivative, 2.0, covariance=False).reason == "stopped: no step lowers the cost"


def test_a_step_into_nowhere_is_taken_back():
    """The full step leaves the domain of the logarithm: it counts as one that does not lower the cost."""
    result = hhtjax.fit(lambda p: jnp.stack([jnp.log(p) + 3.0, jnp.log(p) + 3.0]), 5.0, covariance=False)
    assert result.converged
    assert float(result.params) == pytest.approx(np.exp(-3.0), rel=1e-6)


@pytest.mark.slow
def test_poor_starts_reach_the_minimum():
    """A spring set in motion by a force, all 16 starts with every parameter 3 times too large or too small.

    12 do with Marquardt's damping alone, whose first steps make a stiffness or a damping of exp(10) or exp(-10).
    """
    time = jnp.linspace(0.0, 1.5, 40)

    def model(p):
        decay, square = p["c"] / 2, p["k"] - p["c"] ** 2 / 4
        w = jnp.sqrt(jnp.abs(square))
        cos, sin = jnp.where(square > 0, jnp.cos(w * time), jnp.cosh(w * time)), jnp.sin(w * time)
        sin = jnp.where(square > 0, sin, jnp.sinh(w * time)) / w
        return p["force"] / p["k"] * (1 - jnp.exp(-decay * time) * (cos + decay * sin)) + p["drift"] * time

    true = {"k": 30.0, "c": 1.0, "force": 20.0, "drift": 0.3}
    measured = model(true) + 1e-3 * jnp.asarray(np.random.default_rng(0).normal(size=40))
    factors = 3.0 ** np.array(list(product((-1, 1), repeat=4)))
    starts = {name: x * factors[:, i] for i, (name, x) in enumerate(true.items())}
    found = hhtjax.multistart(
        lambda p: model(p) - measured,
        starts,
        transforms={"k": hhtjax.positive, "c": hhtjax.positive, "force": None, "drift": None},
        covariance=False,
    )
    assert np.all(found.all.converged)
    np.testing.assert_allclose(found.all.cost, found.best.cost, rtol=1e-6)


def test_damping_follows_the_gain():
    """A step that does lower the cost, but by a twentieth of what was predicted, is followed by more damping."""
    result = hhtjax.fit(lambda p: jnp.arctan(p) * jnp.ones(1), 1.35, max_iterations=1, covariance=False)
    before, after = map(float, result.history.cost)
    slope, lam = 1 / (1 + 1.35**2), 1e-3
    predicted = before * (1 - (lam / (1 + lam)) ** 2)
    assert 1.35 - np.arctan(1.35) / slope < -1  # the step goes far beyond
    gain = (before - after) / predicted
    assert 0 < gain < 0.1
    assert result.history.damping[1] == pytest.approx(lam * (1 - (2 * gain - 1) ** 3), rel=1e-9)


def test_small_steps_under_damping_are_no_convergence():
    """Beyond a kink the slope is 1e9 times less than what the damping remembers, and all steps are tiny for a while."""
    kinked = hhtjax.fit(lambda p: (p + 1e9 * jnp.maximum(p - 1, 0)) * jnp.ones(1), 2.0, covariance=False)
    assert kinked.converged
    assert float(kinked.params) == pytest.approx(0.0, abs=1e-6)


def lorenz(p, duration):
    """Of which residuals grow by exp(0.9 t): here by 1e10."""

    def rate(s):
        return jnp.stack([10 * (s[1] - s[0]), s[0] * (p - s[2]) - s[1], s[0] * s[1] - 8 / 3 * s[2]])

    def step(s, _):
        middle = s + 0.005 * rate(s)
        s = s + 0.01 * rate(middle)
        return s, s

    return jax.lax.scan(step, jnp.array([1.0, 1.0, 20.0]), None, length=round(100 * duration))[1]


@pytest.mark.parametrize("duration", [25.0, 35.0])
def test_a_small_step_into_a_steep_gradient_is_no_convergence(duration):
    """Chaos calls every step small. The minimum itself is known by its gradient, or by a residual that is rounding."""
    data = lorenz(28.0, duration)

    def residuals(p):
        return lorenz(p, duration) - data

    lost = hhtjax.fit(residuals, 28.00001, covariance=False)
    r, J = jnp.ravel(residuals(lost.params)), jnp.ravel(jax.jacfwd(residuals)(lost.params))
    cosine = jnp.abs(r @ J) / jnp.linalg.norm(r) / jnp.linalg.norm(J)
    assert not lost.converged or cosine < 1e-3
    assert lost.iterations > 1
    assert hhtjax.fit(residuals, 28.0, covariance=False).converged


@pytest.mark.usefixtures("_promotion")
@pytest.mark.parametrize("optimizer", [None, optax.lbfgs()])
def test_residuals_that_do_not_depend_on_the_parameters_are_told(optimizer):
    with pytest.raises(ValueError, match="fit: `residuals` must depend on params; their derivatives at params0"):
        hhtjax.fit(lambda p: jnp.ones(4), {"k": 1.0}, optimizer, covariance=False)


def test_undetermined_parameters_are_named():
    def residuals(params):
        return {"r": params["a"] * params["b"] * t - 2.0 * t + params["c"] - 1.0}

    start = {"a": 1.0, "b": 1.5, "c": 0.3, "unused": jnp.ones(1)}
    transforms = {"a": None, "b": None, "c": None, "unused": hhtjax.positive}
    said = r"no standard error for a, b, unused\[0\]: .* a, b only through their product; unused\[0\] not at all"
    with pytest.warns(hhtjax.identification.IdentifiabilityWarning, match=said) as warned:
        result = hhtjax.fit(residuals, start, transforms=transforms)
    assert warned[0].filename == __file__
    lines = result.summary().splitlines()
    assert lines[2].split() == ["a", f"{float(result.params['a']):.6g}", "undetermined"]
    why = "undetermined: a, b, unused[0]: the residuals determine a, b only through their product; unused[0] not at all"
    assert why in lines
    assert "largest correlation" not in result.summary()
    assert "at a bound" not in result.summary()
    assert float(result.params["a"] * result.params["b"]) == pytest.approx(2.0, rel=1e-6)
    assert np.isinf(result.standard_errors["a"])
    assert np.isfinite(result.standard_errors["c"])
    assert not np.isnan(result.covariance).any()


@pytest.mark.parametrize("weights", [True, np.array([True, True, False])])
def test_as_many_residuals_as_parameters(weights):
    target = np.array([1.0, 2.0, 5.0])[: np.size(weights) if np.ndim(weights) else 2]
    with pytest.warns(hhtjax.identification.IdentifiabilityWarning, match="as many residuals as parameters"):
        result = hhtjax.fit(lambda p: jnp.append(p, p[0])[: len(target)] - target, jnp.zeros(2), weights=weights)
    np.testing.assert_allclose(result.params, [1.0, 2.0])
    assert np.isinf(result.standard_errors).all()
    assert "as many residuals as parameters" in result.summary()


DATA = jnp.zeros(5)


def against_a_global(p):
    return p - DATA


def test_other_data_behind_the_same_name_are_seen(monkeypatch):
    assert float(hhtjax.fit(against_a_global, 2.0).params) == pytest.approx(0.0, abs=1e-9)
    monkeypatch.setitem(globals(), "DATA", jnp.ones(5))
    assert float(hhtjax.fit(against_a_global, 2.0).params) == pytest.approx(1.0)
