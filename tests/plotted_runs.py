"""A run and a sweep for the tests of charts: two springs in a dict."""

from functools import cache

import jax
import jax.numpy as jnp

import hhtjax


def spring(q, v, t, params):
    return jax.tree.map(lambda q, v: -params["k"] * q - 0.1 * v, q, v)


SYSTEM = hhtjax.System(lambda q, params: jnp.eye(2), spring)
PARAMS = {"k": jnp.asarray(4.0)}
Q0 = {"phi": jnp.asarray(1.0), "x": jnp.asarray(0.5)}
V0 = {"phi": jnp.asarray(0.0), "x": jnp.asarray(1.0)}


@cache
def run():
    return hhtjax.simulate(SYSTEM, hhtjax.hht(), Q0, V0, PARAMS, dt=0.1, num_steps=20)


@cache
def sweep():
    dts = jnp.logspace(-3, -1.3, 6)
    return hhtjax.sweep(SYSTEM, hhtjax.hht(), Q0, Q0, PARAMS, dts=dts, duration=1.0, num_samples=5)


@cache
def fit():
    """A sine with an offset, in noise."""
    t = jnp.arange(200.0) / 10
    record = 2 * jnp.sin(t) + 0.5 + 0.1 * jax.random.normal(jax.random.key(0), t.shape)
    return hhtjax.fit(lambda p: p["a"] * jnp.sin(t) + p["b"] - record, {"a": 1.0, "b": 0.0})
