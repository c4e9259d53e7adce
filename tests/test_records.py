"""Records with initial states of their own: the elimination against the dense fit, and windows of measured data."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hhtjax
from hhtjax.identification import wrap_angle

t = jnp.linspace(0.0, 2.0, 30)
AMPLITUDES = jnp.array([1.0, -0.5, 2.0])
NOISE = 0.01 * np.random.default_rng(0).normal(size=(3, 30))


def wave(params, start, t):
    return start["a"] * jnp.exp(-params["decay"] * t) * jnp.cos(params["w"] * t + start["phase"])


GUESS = {"decay": 0.4, "w": 2.7}
STARTS = {"a": 0.8 * AMPLITUDES, "phase": jnp.full(3, 0.1)}
CLEAN = jax.vmap(lambda a: wave({"decay": 0.3, "w": 3.0}, {"a": a, "phase": 0.2}, t))(AMPLITUDES)
MEASURED = (CLEAN + NOISE).at[1, 4].set(jnp.nan)


@pytest.mark.slow
def test_eliminated_starts_are_those_of_the_dense_fit():
    """Shared parameters, starts, cost, and the naive covariance that starts leave to the shared ones."""
    present = jnp.isfinite(MEASURED)
    result = hhtjax.fit(
        lambda params, start, record: wave(params, start, t) - record,
        GUESS,
        records=MEASURED,
        starts=STARTS,
        transforms={"decay": hhtjax.positive, "w": None},
        weights=present,
        tolerance=1e-12,
    )

    def dense(unknown):
        params, starts = unknown
        return jax.vmap(lambda start: wave(params, start, t))(starts) - MEASURED

    expected = hhtjax.fit(dense, (GUESS, STARTS), weights=present, tolerance=1e-12)
    assert result.converged
    assert int(result.iterations) <= 8  # Gauss-Newton, so the steps are right
    for found, known in zip(
        jax.tree.leaves((result.params, result.starts)), jax.tree.leaves(expected.params), strict=True
    ):
        np.testing.assert_allclose(found, known, rtol=1e-6)
    assert float(result.cost) == pytest.approx(float(expected.cost), rel=1e-10)
    assert result.residual.shape == (3, 30)
    np.testing.assert_allclose(result.uncertainty.naive, expected.uncertainty.naive[:2, :2], rtol=1e-4)


@pytest.mark.slow
def test_segments_are_whole_records_and_empty_ones_have_no_starts():
    """The slope of lines with offsets of their own, 6 of 24 records without data: its errors are those of NumPy."""
    y, x = np.random.default_rng(0).normal(size=(24, 10)), np.arange(10) - 4.5
    present = np.arange(24) % 4 > 0

    def residuals(slope, start, record):
        return slope * x + start - record

    result = hhtjax.fit(residuals, 0.0, records=y, starts=np.zeros(24), weights=present)
    r = (y - y.mean(axis=1, keepdims=True))[present]
    information = 18 * x @ x
    slope = np.sum(r @ x) / information
    r = r - slope * x
    assert float(result.params) == pytest.approx(slope, rel=1e-6)
    naive = np.sum(r**2) / (180 - 18 - 1) / information
    cluster = np.sum((r @ x) ** 2) / (1 - 1 / 18) / information**2
    assert float(result.uncertainty.naive[0, 0]) == pytest.approx(naive, rel=1e-6)
    assert float(result.uncertainty.cluster[0, 0]) == pytest.approx(cluster, rel=1e-6)
    assert float(result.uncertainty.degrees[0]) == pytest.approx(17, rel=1e-6)


def test_windows_follow_the_clock():
    clock = np.array([0.0, 0.1, 0.2, 0.45, 0.5, 0.6, 0.8, 0.9])
    y = np.stack([clock, np.where(clock == 0.2, np.nan, 10 * clock)], axis=1)
    cut = hhtjax.windows(clock, y, duration=0.35, present=np.isfinite(y))
    np.testing.assert_allclose(cut.begin, [0.0, 0.45])
    np.testing.assert_allclose(cut.t + cut.begin[:, None], [[0.0, 0.1, 0.2, 0.2], [0.45, 0.5, 0.6, 0.8]])
    np.testing.assert_array_equal(cut.present[0], [[1, 1], [1, 1], [1, 0], [0, 0]])
    np.testing.assert_allclose(cut.y[1, :, 1], [4.5, 5.0, 6.0, 8.0])
    assert hhtjax.windows([1e9, 1e9 + 1, 1e9 + 2], np.zeros(3), duration=1e-9).present.sum() == 2  # one sample each
    with pytest.raises(ValueError, match="windows: `t`, `y` and `present` must have equal lengths, not 0"):
        hhtjax.windows([], [], duration=0.3)
    with pytest.raises(ValueError, match="windows: `y` must be finite, or declared missing"):
        hhtjax.windows(clock, y, duration=0.3)
    with pytest.raises(ValueError, match=r"windows: `t` must increase; received 0.05 at sample 2"):
        hhtjax.windows([0.0, 0.1, 0.05], np.zeros(3), duration=0.05)
    with pytest.raises(ValueError, match="windows: `t`, `y` and `present` must have equal lengths"):
        hhtjax.windows(clock, y[:-1], duration=0.3)
    with pytest.raises(ValueError, match=r"windows: `duration` must be less than the record's, 0.9; received 2"):
        hhtjax.windows(clock, clock, duration=2)


def test_angles_are_wrapped_with_the_slope_of_one():
    np.testing.assert_allclose(wrap_angle(jnp.array([3.5, -7.0, 1.0])), [3.5 - 2 * np.pi, 2 * np.pi - 7.0, 1.0])
    assert jax.grad(wrap_angle)(3.5) == 1


def test_bad_records_are_named():
    def residuals(params, start, record):
        return wave(params, start, t) - record

    with pytest.raises(ValueError, match=r"fit: `records` and `starts` must be given together; .* by jax\.vmap\."):
        hhtjax.fit(residuals, GUESS, records=MEASURED)
    with pytest.raises(ValueError, match=r"`starts` must have the same leading axis in all leaves; .*\(2,\), \(3,\)"):
        hhtjax.fit(residuals, GUESS, records=MEASURED[:2], starts=STARTS)
    with pytest.raises(ValueError, match="fit: `records` must be used with Levenberg-Marquardt and without a prior"):
        hhtjax.fit(residuals, GUESS, records=MEASURED, starts=STARTS, prior=hhtjax.Gaussian(0.0, 1.0))
