"""Robust losses: the minimum is SciPy's from near and far, and standard errors are the scatter of the estimates."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares

import hhtjax
from hhtjax.identification.losses import LOSSES, Objective

x = jnp.linspace(0.0, 10.0, 500)
random = np.random.default_rng(0)
CLEAN = 2.0 * jnp.sin(x) + 0.5 + 1e-3 * random.normal(size=500)
SPOILT = CLEAN + (random.uniform(size=500) < 0.1) * random.uniform(-3.0, 3.0, size=500)
WEIGHT = 1e3
SOME = ["huber", *(pytest.param(loss, marks=pytest.mark.slow) for loss in ("soft_l1", "cauchy"))]
FAR, NEAR = {"a": 10.0, "b": 5.0}, {"a": 2.01, "b": 0.49}


def line(params, data=CLEAN):
    return params["a"] * jnp.sin(x) + params["b"] - data


def spoilt_line(params):
    return line(params, SPOILT)


def cosine(residuals, params, loss):
    """Of the angle between the residuals and the columns of their Jacobian, both weighted by the loss."""
    r, J = WEIGHT * residuals(params), jax.jacfwd(residuals)(params)
    root = jnp.sqrt(jax.vmap(jax.grad(LOSSES[loss]))(r**2))
    r, columns = root * r, jnp.stack([root * J["a"], root * J["b"]])
    return jnp.max(jnp.abs(columns @ r) / jnp.linalg.norm(columns, axis=1) / jnp.linalg.norm(r))


@pytest.mark.parametrize("loss", LOSSES)
def test_robust_losses_are_scipys(loss):
    """As its cost at the start."""
    z = np.linspace(-4.0, 4.0, 9)
    with warnings.catch_warnings(action="ignore"):
        scipys = least_squares(lambda _: z, [0.0], loss=loss, max_nfev=1).cost
    assert float(Objective(jnp.ones(9), LOSSES[loss], 9).cost(z)) == pytest.approx(scipys, rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("residuals", [line, spoilt_line])
@pytest.mark.parametrize("loss", SOME)
def test_converged_is_converged(residuals, loss):
    """Residuals of about 1 and of 1e4, where Huber's loss has no curvature at all, and Cauchy's a negative one."""

    def weighted(values):
        return WEIGHT * np.asarray(residuals(dict(zip(("a", "b"), values, strict=True))))

    scipys = least_squares(weighted, [2.0, 0.5], loss=loss, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    for start in (FAR, NEAR):
        found = hhtjax.fit(residuals, start, weights=WEIGHT, loss=loss, covariance=False)
        assert found.converged
        assert cosine(residuals, found.params, loss) < 1e-4
        if loss != "cauchy" or start is NEAR:  # it has other minima
            assert float(found.cost) == pytest.approx(scipys.cost, rel=1e-7)
            np.testing.assert_allclose([found.params["a"], found.params["b"]], scipys.x, atol=2e-6)


@pytest.mark.slow
@pytest.mark.parametrize("loss", SOME)
def test_standard_errors_are_the_scatter(loss):
    """With and without outliers; a linear problem, of which 300 noises are fitted at once."""

    def estimate(key, outliers):
        e = jax.random.normal(key, (500,))
        e = jnp.where(jax.random.uniform(jax.random.fold_in(key, 1), (500,)) < outliers, 20 * e, e)
        result = hhtjax.fit(lambda p: line(p, 2.0 * jnp.sin(x) + 0.5 + 1e-3 * e), NEAR, weights=WEIGHT, loss=loss)
        return result.params, jax.tree.map(jnp.square, result.standard_errors), jnp.diagonal(result.uncertainty.naive)

    fits = jax.jit(jax.vmap(estimate, in_axes=(0, None)))
    for outliers in (0.0, 0.1):
        params, variances, naive = fits(jax.random.split(jax.random.key(0), 300), outliers)
        for i, name in enumerate(params):
            scatter = float(np.std(params[name]))
            assert np.sqrt(np.mean(variances[name])) == pytest.approx(scatter, rel=0.12)
            assert np.sqrt(np.mean(naive[:, i])) == pytest.approx(scatter, rel=0.12)


@pytest.mark.slow
def test_profile_is_the_parabola_of_the_robust_error():
    """With weights that are three times too small, too."""
    result = hhtjax.fit(spoilt_line, NEAR, weights=WEIGHT / 3, loss="huber")
    values = float(result.params["a"]) + float(result.standard_errors["a"]) * np.array([-1.0, 0.0, 1.0])
    found = hhtjax.identification.profile(spoilt_line, result, "a", values, weights=WEIGHT / 3, loss="huber")
    np.testing.assert_allclose(found.deviance, [1, 0, 1], atol=0.15)


@pytest.mark.slow
def test_robust_errors_with_eliminated_starts_are_those_of_the_dense_fit():
    records = jnp.reshape(SPOILT, (5, 100))
    at = jnp.reshape(x, (5, 100))

    def of_record(params, start, record):
        x, y = record
        return params["a"] * jnp.sin(x) + start - y

    def dense(both):
        return jax.vmap(of_record, in_axes=(None, 0, 0))(both[0], both[1], (at, records))

    options = {"weights": WEIGHT, "loss": "soft_l1", "tolerance": 1e-12}
    starts = jnp.full(5, 0.4)
    found = hhtjax.fit(of_record, {"a": 2.1}, records=(at, records), starts=starts, **options)
    expected = hhtjax.fit(dense, ({"a": 2.1}, starts), **options)
    assert float(found.params["a"]) == pytest.approx(float(expected.params[0]["a"]), rel=1e-7)
    np.testing.assert_allclose(found.starts, expected.params[1], rtol=1e-6)
    np.testing.assert_allclose(found.uncertainty.naive, expected.uncertainty.naive[:1, :1], rtol=1e-4)
    np.testing.assert_allclose(found.uncertainty.inverse, expected.uncertainty.inverse[:1, :1], rtol=1e-4)


@pytest.mark.slow
def test_a_loss_without_curvature_has_no_standard_error():
    """Two clusters of residuals beyond the bend of the loss, at +-10: between them the cost is level."""
    data = jnp.where(jnp.arange(40) < 20, 10.0, -10.0)
    with pytest.warns(hhtjax.identification.IdentifiabilityWarning, match="params: most residuals are so large"):
        result = hhtjax.fit(lambda p: p - data, 0.5, loss="huber")
    assert result.converged
    assert np.isinf(result.standard_errors)
