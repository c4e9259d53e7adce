"""Sine and cosine by polynomials, against numpy's in extended precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hhtjax
from hhtjax import trigonometry
from hhtjax.scenes import double_pendulum


def arguments():
    """All over the range, near zero, and next to multiples of pi/4."""
    random = np.random.default_rng(0)
    turns = random.integers(-127_000, 127_000, 200_000) * (np.pi / 4)
    small = random.uniform(-1, 1, 20_000) * 10.0 ** random.uniform(-300, 0, 20_000)
    return np.concatenate(
        [
            random.uniform(-trigonometry.RANGE, trigonometry.RANGE, 400_000),
            np.linspace(-10, 10, 200_001),
            turns,
            np.nextafter(turns, np.inf),
            small,
            [0.0, trigonometry.RANGE, -trigonometry.RANGE],
        ]
    )


@pytest.mark.slow
@pytest.mark.skipif(np.finfo(np.longdouble).nmant < 63, reason="no extended precision to compare with")
def test_within_two_units_in_the_last_place():
    x = arguments()
    for found, exact in zip(jax.jit(trigonometry.sincos)(x), (np.sin, np.cos), strict=True):
        value = exact(x.astype(np.longdouble))
        unit = np.spacing(np.abs(value.astype(float)))
        assert np.max(np.abs(np.asarray(found) - value) / unit) < 2


def test_beyond_the_range_there_is_no_number():
    x = jnp.array([1.001e5, -1.001e5, jnp.inf, jnp.nan])
    for found in trigonometry.sincos(x):
        assert np.isnan(found).all()


@pytest.mark.slow
def test_derivatives_forward_and_reverse_of_first_and_second_order():
    x = jnp.linspace(-7.0, 7.0, 29)
    for ours, theirs, slope in (
        (trigonometry.sin, jnp.sin, jnp.cos),
        (trigonometry.cos, jnp.cos, lambda x: -jnp.sin(x)),
    ):
        forward, reverse, second = (jax.vmap(d(ours))(x) for d in (jax.jacfwd, jax.grad, jax.hessian))
        np.testing.assert_array_equal(forward, reverse)
        np.testing.assert_allclose(forward, slope(x), atol=1e-15)
        np.testing.assert_allclose(second, -theirs(x), atol=1e-15)


def test_other_dtypes():
    x = jnp.array([0.3, 40.0], jnp.float32)
    for found, exact in zip(trigonometry.sincos(x), (jnp.sin(x), jnp.cos(x)), strict=True):
        assert found.dtype == jnp.float32
        np.testing.assert_array_equal(found, exact)
    assert float(trigonometry.sin(2)) == pytest.approx(np.sin(2.0), rel=1e-15)
    with pytest.raises(TypeError, match="sincos: `x` must be real; received an array of complex128"):
        trigonometry.sincos(jnp.array(1j))


@pytest.mark.slow
def test_the_double_pendulum_moves_alike_with_both():
    ends = []
    for module in (jnp, trigonometry):
        system, params, _, v0, _ = double_pendulum.stiff(trigonometry=module)
        assert system == double_pendulum.stiff(trigonometry=module).system
        run = hhtjax.simulate(system, hhtjax.hht(), jnp.array([0.3, -0.2]), v0, params, dt=1e-3, num_steps=100)
        ends.append(run.q[-1])
    assert np.abs(ends[0] - 0.3).max() > 1e-3
    np.testing.assert_allclose(ends[0], ends[1], rtol=1e-12)
