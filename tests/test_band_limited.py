"""Band-limited reconstruction: exact on what it promises, and the gain errors of the simpler ones as measured."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hhtjax

k = np.arange(600)
BETWEEN = 100.0 + np.arange(0, 400, 0.137)


@pytest.mark.slow
def test_harmonics_below_half_the_sampling_rate_are_met():
    """Two channels, 0.05 and 0.4 of the sampling rate, away from the ends; and every sample is met."""

    def exact(t):
        return np.stack([np.sin(2 * np.pi * 0.05 * t), 3.0 + np.cos(2 * np.pi * 0.4 * t)], axis=-1)

    u = jax.jit(lambda y: hhtjax.band_limited(y, 0.5, factor=16))(exact(k))
    np.testing.assert_allclose(u(0.5 * BETWEEN), exact(BETWEEN), atol=1e-3)
    np.testing.assert_allclose(u(0.5 * k), exact(k), atol=1e-12)
    assert np.abs(hhtjax.sampled(exact(k), 0.5)(0.5 * BETWEEN) - exact(BETWEEN)).max() > 0.2
    slope = jax.grad(lambda x: u(x)[0])(100.3)
    assert float(slope) == pytest.approx(2 * np.pi * 0.1 * np.cos(2 * np.pi * 0.1 * 100.3), abs=1e-3)


@pytest.mark.parametrize("order", [0, 1, 3])
def test_the_gain_error_is_that_of_the_reconstruction(order):
    """The amplitude at the harmonic's own frequency, by projection."""
    frequency = 0.11
    t = 100 + np.arange(0, 400, 0.05)
    u = np.asarray(hhtjax.sampled(np.cos(2 * np.pi * frequency * k), 1.0, order=order)(t))
    gain = 2 * abs(np.mean(u * np.exp(2j * np.pi * frequency * t)))
    assert hhtjax.spline_gain_error(frequency, 1.0, order) == pytest.approx(1 - float(gain), rel=0.02)


def test_bad_input_is_named():
    with pytest.raises(ValueError, match="band_limited: `factor` must be a positive integer; received 0"):
        hhtjax.band_limited(jnp.ones(9), 0.1, factor=0)
    with pytest.raises(ValueError, match=r"spline_gain_error: `frequency` must be below 1/\(2 dt\); received 3.0"):
        hhtjax.spline_gain_error(3.0, 1.0)
    with pytest.raises(ValueError, match="spline_gain_error: `order` must be 0, 1 or 3; received 2"):
        hhtjax.spline_gain_error(0.3, 1.0, order=2)
