"""Derivatives of estimates in what a fit is given: forward = reverse = central differences of fits."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from helpers import ONE, ZERO

import hhtjax

t = jnp.linspace(0.0, 2.0, 30)
NOISE = 0.05 * np.random.default_rng(0).normal(size=(3, 30))
MEASURED = jnp.outer(jnp.array([3.0, -2.0, 1.0]), jnp.exp(-0.7 * t)) + 0.3 + NOISE
SLOW = partial(pytest.param, marks=pytest.mark.slow)
START = {"a": 1.0, "rate": 1.0}
TIGHT = {"tolerance": 1e-12, "covariance": False}


def free(params, start=0.0):
    return params["a"] * jnp.exp(-params["rate"] * t) + start


def dense(given):
    """What is measured is closed over; what is fixed, weights and a prior are arguments."""
    result = hhtjax.fit(
        lambda params: free(params, params["offset"]) - given["measured"],
        {"a": 1.0, "rate": 0.4, "offset": given["offset"]},
        transforms={"a": hhtjax.positive, "rate": hhtjax.bounded(0.1, 0.6), "offset": hhtjax.fixed},
        weights=given["weights"],
        prior={"a": hhtjax.Gaussian(given["mean"], 0.1), "rate": None, "offset": None},
        loss="soft_l1",
        **TIGHT,
    )
    return result.params, result.cost


def at_the_start(given):
    """The iterations of such a fit say nothing of its derivatives."""

    def residuals(params):
        return free(params) - given["measured"]

    found = hhtjax.fit(residuals, START, **TIGHT).params
    return hhtjax.fit(residuals, jax.lax.stop_gradient(found), **TIGHT).params


def by_descent(given):
    with jax.numpy_dtype_promotion("standard"):  # optax itself does not compute under strict promotion
        result = hhtjax.fit(lambda params: free(params) - given["measured"], START, optax.lbfgs(), **TIGHT)
    return result.params


def records(given):
    """Records are integers, by which the residuals find what they close over."""
    result = hhtjax.fit(
        lambda rate, start, i: (
            start["a"] * jnp.exp(-rate * t) + start["b"] - MEASURED[i] - jnp.where(i == 1, given["measured"], 0)
        ),
        1.0,
        records=np.arange(3),
        starts={"a": np.ones(3), "b": np.zeros(3)},
        weights=given["weights"],
        loss="huber",
        **TIGHT,
    )
    return result.params, result.starts


def simulated(given):
    """A force and residuals that close over what is differentiated."""
    system = hhtjax.System(ONE, lambda q, v, t, k: -k * q - given["offset"] * q**3 - 0.2 * v + jnp.cos(2 * t))

    def residuals(k):
        run = hhtjax.simulate(system, hhtjax.rk4(), ONE, ZERO, k, dt=2 / 29, num_steps=29)
        return run.q[:, 0] - jnp.cos(2 * t) - 0.1 * given["measured"]

    return hhtjax.fit(residuals, 5.0, **TIGHT).params


def given():
    return {
        "measured": MEASURED[0],
        "offset": jnp.array(0.3),
        "mean": jnp.array(2.9),
        "weights": jnp.linspace(10.0, 20.0, 30).at[5].set(0.0),
    }


def away(leaf):
    return jnp.cos(jnp.arange(1.0, leaf.size + 1)).reshape(leaf.shape) * jnp.where(leaf == 0, 0, 1)


@pytest.mark.slow
@pytest.mark.parametrize("estimate", [dense, at_the_start, by_descent, SLOW(records), SLOW(simulated)])
def test_estimates_have_the_derivatives_of_the_minimum(estimate):
    point = given()
    if estimate is records:
        point["weights"] = jnp.stack([point["weights"], point["weights"][::-1], 0 * point["weights"] + 15])
    direction = jax.tree.map(away, point)
    f = jax.jit(lambda given: jax.flatten_util.ravel_pytree(estimate(given))[0])
    h = 1e-4
    beside = [f(jax.tree.map(lambda x, d, h=h: x + h * d, point, direction)) for h in (h, -h)]
    value, forward = jax.jvp(f, (point,), (direction,))
    np.testing.assert_allclose(forward, (beside[0] - beside[1]) / (2 * h), rtol=1e-4, atol=1e-5)
    seed = jnp.sin(jnp.arange(1.0, value.size + 1))
    (slopes,) = jax.vjp(f, point)[1](seed)
    reverse = sum(jnp.vdot(x, d) for x, d in zip(*map(jax.tree.leaves, (slopes, direction)), strict=True))
    np.testing.assert_allclose(reverse, seed @ forward, rtol=1e-9)
    assert np.max(np.abs(forward)) > 0.01
