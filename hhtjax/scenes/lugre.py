"""LuGre friction: a spring drags a mass over a surface, whose bristles bend by z before they slip.

    F = sigma0 z + sigma1 zdot + sigma2 v,    zdot = v - sigma0 |v| z/s(v),    s(v) = Fc + (Fs - Fc) exp(-(v/vs)^2)

C. Canudas de Wit, H. Olsson, K. Astrom, P. Lischinsky, IEEE Trans. Automatic Control 40, 1995, 419-425.
"""

from __future__ import annotations

import jax.numpy as jnp

from hhtjax.description import PyTree
from hhtjax.scenes import drawings
from hhtjax.scenes.scene import InternalScene, array
from hhtjax.systems.system import System


def mass(q, params: PyTree):
    """M = [m]."""
    return params["m"] * jnp.ones(1, q.dtype)


def internal(q, v, z, t, params: PyTree):
    """zdot, the rate of the bristles."""
    steady = params["coulomb"] + (params["static"] - params["coulomb"]) * jnp.exp(-((v / params["stribeck"]) ** 2))
    return v - params["sigma0"] * jnp.abs(v) * z / steady


def force(q, v, z, t, params: PyTree):
    """Q: the spring, whose far end moves at a constant speed, and friction."""
    friction = params["sigma0"] * z + params["sigma1"] * internal(q, v, z, t, params) + params["sigma2"] * v
    return params["k"] * (params["speed"] * t - q) - friction


@drawings.Drawing
def drawing(q, t, params: PyTree):
    """The mass on the surface, and the spring, whose far end moves. A spring at rest is drawn 0.5 m long."""
    half = 0.1
    end = params["speed"] * t + half + 0.5
    return [
        drawings.block((q[0], half), 2 * half, 2 * half),
        drawings.spring((q[0] + half, half), (end, half), half),
        drawings.arrow((end, half), (0.2, 0.0), 0.2),
        drawings.ground((-0.2, 0.0), (1.9, 0.0), 0.04, 20),
    ]


def stick_slip() -> InternalScene:
    """The experiment of the paper, Sec. III-C: a mass of 1 kg dragged at 0.1 m/s sticks and slips (SI units)."""
    params = {
        "m": 1.0, "k": 2.0, "speed": 0.1, "sigma0": 1e5, "sigma1": 1e5**0.5, "sigma2": 0.4,
        "coulomb": 1.0, "static": 1.5, "stribeck": 1e-3,
    }  # fmt: skip
    zero = array([0.0])
    return InternalScene(System(mass, force, internal=internal), params, zero, zero, 10.0, zero, drawing)
