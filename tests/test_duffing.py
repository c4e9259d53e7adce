"""Duffing's oscillator against its formula."""

import jax.numpy as jnp
import numpy as np
import pytest

import hhtjax
from hhtjax.scenes import duffing

PARAMS = {"m": 2.0, "c": 0.3, "k": 5.0, "k2": 0.7, "k3": 1.9, "amplitude": 0.8, "frequency": 1.3, "offset": 0.1}
Q, V, T = 1.4, -0.6, 0.9
SPRINGS = -(0.3 * V + 5.0 * Q + 0.7 * Q**2 + 1.9 * Q**3)


def test_harmonic_input():
    found = duffing.force(jnp.array([Q]), jnp.array([V]), T, PARAMS)
    assert float(found[0]) == pytest.approx(SPRINGS + 0.8 * np.cos(1.3 * T), rel=1e-14)
    assert duffing.mass(jnp.array([Q]), PARAMS).tolist() == [2.0]


@pytest.mark.slow
def test_sampled_input():
    u = hhtjax.sampled(jnp.arange(5.0) ** 2, dt=0.5)  # 4 t^2
    found = duffing.sampled_force(jnp.array([Q]), jnp.array([V]), T, (PARAMS, u))
    assert float(found[0]) == pytest.approx(SPRINGS + 4 * T**2 + 0.1, rel=1e-12)
