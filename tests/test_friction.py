"""Dry friction: orders, rest, derivatives, one factorisation, batches, dtypes."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from friction_problems import free_vibration, free_vibration_exact

import hhtjax
from hhtjax.steppers.residual import Coefficients

FAMILY = [*map(hhtjax.hht, (0.0, -0.05, -0.3)), *map(hhtjax.generalized_alpha, (0.0, 0.5, 1.0))]
COLUMNS = zip(*(s.coefficients for s in FAMILY), strict=True)
STACKED = replace(FAMILY[0], coefficients=Coefficients(*map(jnp.array, COLUMNS)))
NUM_STEPS = 400, 1600


def run(case, stepper, num_steps, save_every=1):
    system, params, q0, v0, duration = case
    dt = duration / num_steps
    return hhtjax.simulate(system, stepper, q0, v0, params, dt=dt, num_steps=num_steps, save_every=save_every)


@pytest.fixture(scope="module")
def family():
    """The free vibration by each of FAMILY, with each of NUM_STEPS."""
    return [jax.vmap(lambda s, n=n: run(free_vibration(), s, n))(STACKED) for n in NUM_STEPS]


def test_order_two_through_reversals(family):
    errors = []
    for found in family:
        q, v = free_vibration_exact(np.asarray(found.t[0]))
        errors.append([np.max(np.abs(np.asarray(x)[..., 0] - y), axis=1) for x, y in ((found.q, q), (found.v, v))])
    order = np.log(np.divide(*errors)) / np.log(NUM_STEPS[1] / NUM_STEPS[0])
    assert np.all(np.abs(order - 2) < 0.1), order


def test_what_stopped_stays(family):
    """Exactly: no creep, and no acceleration that alternates, also for alpha = 0."""
    for found in family:
        stuck = np.asarray(found.sticking[..., 0])
        assert np.all(stuck[:, -1] & (np.sum(stuck, axis=1) > 0.1 * stuck.shape[1]))
        for member, here in enumerate(stuck):
            q, tau = found.q[member, here, 0], found.friction[member, here, 0]
            assert np.ptp(q) == 0
            np.testing.assert_array_equal(found.v[member, here], 0)
            np.testing.assert_array_equal(found.acceleration[member, here], 0)
            np.testing.assert_allclose(tau[1:], -100 * q[1:], rtol=1e-12)
