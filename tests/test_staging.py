"""Staging changes the compiled program, and nothing else."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hhtjax
from hhtjax import staging

N = 5


def links(q, v, t, params):
    """Five pendulums, coupled."""
    return -jnp.sin(q[:, None] - q[None, :]) @ v**2 - params * jnp.sin(q)


def value_and_gradient(params):
    def force(*args):
        return links(*args)  # new for JAX, which would take the program of the other call

    def end(params):
        system = hhtjax.System(jnp.arange(1.0, N + 1), force)
        q0 = jnp.linspace(0.1, 1.0, N)
        run = hhtjax.simulate(system, hhtjax.hht(), q0, 0 * q0, params, dt=0.05, num_steps=20, save_every=20)
        return jnp.sum(run.q[-1] ** 2)

    return jax.jit(jax.value_and_grad(end))(params)


def test_a_staged_run_is_the_plain_run(monkeypatch):
    staged = value_and_gradient(2.0)
    monkeypatch.setattr(staging, "SMALL", N)
    assert np.allclose(staged, value_and_gradient(2.0), rtol=1e-12, atol=0)


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="stages on the CPU only")
def test_on_the_cpu_shared_values_are_computed_once():
    def sines(size):
        def f(x):
            y = staging.staged(jnp.sin, size)(x)
            return jnp.cumsum(y * x), y[::-1] * x

        return jax.jit(f).lower(jnp.ones(N)).compile().as_text().count(" sine(")

    assert sines(N) == 1
    assert sines(staging.SMALL) == 2  # fused into both users
