"""One degree of freedom: m w + c v + k q + k2 q^2 + k3 q^3 = u(t) + offset, Duffing's oscillator."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from hhtjax.description import Array, PyTree, Real
from hhtjax.scenes import drawings
from hhtjax.scenes.scene import Scene, array
from hhtjax.systems.system import System


def mass(q: Array, params: PyTree) -> Array:
    """M = [m]."""
    return jnp.asarray(params["m"], q.dtype).reshape(1)


def restoring(q: Array, v: Array, params: PyTree) -> Array:
    """-(c v + k q + k2 q^2 + k3 q^3)."""
    return -(params["c"] * v + q * (params["k"] + q * (params["k2"] + q * params["k3"])))


def force(q: Array, v: Array, t: Real, params: PyTree) -> Array:
    """Q with a harmonic input, u = amplitude cos(frequency t)."""
    return restoring(q, v, params) + params["amplitude"] * jnp.cos(params["frequency"] * t)


def sampled_force(q: Array, v: Array, t: Real, params: PyTree) -> Array:
    """Q with a measured input. params is a pair (parameters, u), with u made by `hhtjax.sampled`."""
    params, u = params
    return restoring(q, v, params) + u(t) + params["offset"]


def sampled_mass(q: Array, params: PyTree) -> Array:
    """M for `sampled_force`."""
    return mass(q, params[0])


@drawings.Drawing
def drawing(q, t, params: PyTree):
    """The mass on its spring; an arrow for the force, if there is one."""
    force = np.cos(params["frequency"] * t) if params["amplitude"] else None
    return drawings.on_a_spring(q[0], size=0.6, force=force)


@drawings.Drawing
def sampled_drawing(q, t, params: PyTree):
    """The mass on its spring."""
    return drawings.on_a_spring(q[0], size=0.1)


def driven() -> Scene:
    """A hardening oscillator driven near its resonance (SI units)."""
    params = {"m": 1.0, "c": 0.2, "k": 1.0, "k2": 0.0, "k3": 1.0, "amplitude": 0.8, "frequency": 1.3}
    return Scene(System(mass, force), params, array([0.5]), array([0.0]), 10.0, drawing)


def hardening_spring() -> Scene:
    """A mass released on a stiff hardening spring, 100 q + 10^4 q^3. Here `linearize="predictor"` fails first."""
    params = {"m": 1.0, "c": 0.0, "k": 100.0, "k2": 0.0, "k3": 1e4, "amplitude": 0.0, "frequency": 0.0}
    return Scene(System(mass, force), params, array([1.0]), array([0.0]), 2.0, drawing)


def measured(params: PyTree, u, q0: PyTree, v0: PyTree, duration) -> Scene:
    """An oscillator under a sampled input.

    Args:
        params: those of `driven`, with offset instead of amplitude and frequency.
        u: the input, made by `hhtjax.sampled`.
        q0, v0: initial position and velocity, numbers.
        duration: duration of the run, s.
    """
    start = jnp.reshape(q0, (1,)), jnp.reshape(v0, (1,))
    return Scene(System(sampled_mass, sampled_force), (params, u), *start, duration, sampled_drawing)
