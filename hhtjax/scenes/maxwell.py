"""A mass on a spring and Maxwell branches, each a spring and a damper in series, with very different time constants."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from hhtjax.description import PyTree
from hhtjax.scenes import drawings
from hhtjax.scenes.scene import InternalScene, array
from hhtjax.systems.system import System


def mass(q, params: PyTree):
    """M = [m]."""
    return params["m"] * jnp.ones(1, q.dtype)


def force(q, v, z, t, params: PyTree):
    """Q: spring, the forces z of the branches, and an input."""
    return params["amplitude"] * jnp.cos(params["frequency"] * t) - params["k"] * q - jnp.sum(z)


def internal(q, v, z, t, params: PyTree):
    """zdot = k v - z/tau of each branch."""
    return params["stiffness"] * v - z / params["tau"]


@drawings.Drawing
def drawing(q, t, params: PyTree):
    """The mass on its mount, drawn as a spring and a piece of rubber for the branches; an arrow for the force."""
    size, wall = 0.02, -0.07
    low, high = 0.25 * size, 0.7 * size
    face = q[0] - size / 2
    return [
        drawings.block((q[0], size / 2), size, size),
        drawings.block(((wall + face) / 2, low), face - wall, 0.4 * size),
        drawings.spring((wall, high), (face, high), 0.3 * size),
        drawings.arrow((q[0] + size / 2, size / 2), (size * np.cos(params["frequency"] * t), 0.0), size),
        drawings.wall_at(wall, size, -1),
        drawings.ground((wall, 0.0), (0.05, 0.0), 0.2 * size, 12),
    ]


def vibration() -> InternalScene:
    """A rubber mount driven near its resonance, with time constants of 1 s, 30 ms and 0.1 ms (SI units)."""
    params = {
        "m": 2.0, "k": 800.0, "amplitude": 5.0, "frequency": 22.0,
        "stiffness": array([100.0, 200.0, 1e4]), "tau": array([1.0, 3e-2, 1e-4]),
    }  # fmt: skip
    system = System(mass, force, internal=internal)
    return InternalScene(system, params, array([0.01]), array([0.0]), 2.0, array([0.5, 0.0, 0.0]), drawing)
