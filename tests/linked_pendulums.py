"""Five coupled pendulums, whose runs are compiled anew with each call, and how they were compiled."""

import jax
import jax.numpy as jnp
import pytest

import hhtjax
from hhtjax.primitives import compat
from hhtjax.primitives.interpreter import asked

on_cpu = pytest.mark.skipif(
    jax.default_backend() != "cpu" or not compat.is_on(),
    reason="kernels are cut on the CPU only",
)
N = 5
LIGHT = hhtjax.hht(linearize="predictor")  # half the program of "auto"


def links(q, v, t, params):
    """Five pendulums, coupled."""
    return -jnp.sin(q[:, None] - q[None, :]) @ v**2 - params * jnp.sin(q)


def end(params, q0=None, stepper=LIGHT):
    """Of a short run of the links; all of it new for JAX, which would take the program of the last call."""
    system = hhtjax.System(jnp.arange(1.0, N + 1), lambda *args: links(*args))
    q0 = jnp.linspace(0.1, 1.0, N) if q0 is None else q0
    return hhtjax.simulate(system, stepper, q0, 0 * q0, params, dt=0.05, num_steps=20, save_every=20).q[-1]


def loss(params, stepper=LIGHT):
    return jnp.sum(end(params, stepper=stepper) ** 2)


def paths(f, *args):
    return hhtjax.explain(f, *args).paths


def run(f, *args):
    """f(*args), of which functions are taken as they are, and the verdicts; compiled once."""
    arrays = [x for x in args if not callable(x)]
    token = asked.set(told := {})
    lowered = jax.jit(lambda *arrays: f(*(x for x in args if callable(x)), *arrays)).lower(*arrays)
    asked.reset(token)
    return lowered.compile()(*arrays), tuple(told.values())
