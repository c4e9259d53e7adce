"""Bouc-Wen hysteresis: one degree of freedom with a restoring force z that depends on the past motion.

    m w + c v + k q + z = u(t),    zdot = alpha v - beta (gamma |v| |z|^(nu - 1) z + delta v |z|^nu)

The parameters of `benchmark` are those of J.-P. Noel, M. Schoukens, "Hysteretic benchmark with a dynamic nonlinearity",
Workshop on Nonlinear System Identification Benchmarks, Brussels 2016, with nu = 1. Only the products beta gamma and
beta delta enter the equation.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from hhtjax.description import Array, PyTree, Real
from hhtjax.scenes import drawings
from hhtjax.scenes.scene import InternalScene, array
from hhtjax.systems.system import System


def mass(q: Array, params: PyTree) -> Array:
    """M = [m]."""
    return params["m"] * jnp.ones(1, q.dtype)


def restoring(q: Array, v: Array, z: Array, params: PyTree) -> Array:
    """-(c v + k q + z)."""
    return -(params["c"] * v + params["k"] * q + z)


def force(q: Array, v: Array, z: Array, t: Real, params: PyTree) -> Array:
    """Q with a harmonic input, u = amplitude sin(frequency t)."""
    return restoring(q, v, z, params) + params["amplitude"] * jnp.sin(params["frequency"] * t)


def internal(q: Array, v: Array, z: Array, t: Real, params: PyTree) -> Array:
    """zdot, for nu = 1."""
    return params["alpha"] * v - params["beta_gamma"] * jnp.abs(v) * z - params["beta_delta"] * v * jnp.abs(z)


def sampled_mass(q, params: PyTree):
    """M for `sampled_force`."""
    return mass(q, params[0])


def sampled_force(q, v, z, t, params: PyTree):
    """Q with a measured input. params is a pair (parameters, u), with u made by `hhtjax.sampled` or similar."""
    params, u = params
    return restoring(q, v, z, params) + u(t)


def sampled_internal(q, v, z, t, params: PyTree):
    """zdot for `sampled_force`."""
    return internal(q, v, z, t, params[0])


BENCHMARK = {"m": 2.0, "c": 10.0, "k": 5e4, "alpha": 5e4, "beta_gamma": 0.8e3, "beta_delta": -1.1e3}
SIZE = 1e-3  # m, of the block in drawings


@drawings.Drawing
def drawing(q, t, params: PyTree):
    """The mass and its spring; an arrow for the force."""
    return drawings.on_a_spring(q[0], size=SIZE, force=np.sin(params["frequency"] * t))


@drawings.Drawing
def sampled_drawing(q, t, params: PyTree):
    """The mass and its spring."""
    return drawings.on_a_spring(q[0], size=SIZE)


SAMPLED = System(sampled_mass, sampled_force, internal=sampled_internal)


def benchmark() -> InternalScene:
    """The oscillator of the benchmark, driven at 30 Hz, below its resonance (SI units)."""
    params = {**BENCHMARK, "amplitude": 100.0, "frequency": 2 * jnp.pi * 30.0}
    zero = array([0.0])
    return InternalScene(System(mass, force, internal=internal), params, zero, zero, 0.1, zero, drawing)


def measured(params: PyTree, u, duration) -> InternalScene:
    """The oscillator at rest, under a given input u.

    Args:
        params: structured like `BENCHMARK`. u: force, N, a function of time that is a pytree, as from `hhtjax.sampled`.
        duration: duration of the run, s.
    """
    zero = array([0.0])
    return InternalScene(SAMPLED, (params, u), zero, zero, duration, zero, sampled_drawing)
