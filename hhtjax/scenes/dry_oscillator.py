"""A mass on a spring that slides on a dry surface: free, or driven by a sine, with stiction.

    m w = -k q - c v + A sin(W t) - tau,    |tau| <= F (1 + stiction exp(-|v|/vs))

The free motion without damping and stiction consists of half cosines, in turn about F/k and -F/k. It ends when the
spring is too weak to move the mass.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from hhtjax.description import Array, PyTree, Real
from hhtjax.scenes import drawings
from hhtjax.scenes.scene import Scene, array
from hhtjax.systems.system import System


def mass(q: Array, params: PyTree) -> Array:
    """M = [m]."""
    return params["m"] * jnp.ones(1, q.dtype)


def force(q: Array, v: Array, t: Real, params: PyTree) -> Array:
    """Q, without the friction."""
    return params["A"] * jnp.sin(params["W"] * t) - params["k"] * q - params["c"] * v


def limit(q: Array, v: Array, t: Real, params: PyTree):
    """F, with a Stribeck curve."""
    return params["F"] * (1 + params["stiction"] * jnp.exp(-jnp.abs(v) / params["vs"]))


@drawings.Drawing
def drawing(q, t, params: PyTree):
    """The mass on its spring and the surface; an arrow for the force, if there is one."""
    force = np.sin(params["W"] * t) if params["A"] else None
    return drawings.on_a_spring(q[0], size=0.3, force=force)


SYSTEM = System(mass, force, friction=limit)


def free() -> Scene:
    """A free motion: the mass reverses five times, then it sticks (SI units)."""
    params = {"m": 1.0, "k": 100.0, "c": 0.0, "A": 0.0, "W": 0.0, "F": 4.0, "stiction": 0.0, "vs": 0.05}
    return Scene(SYSTEM, params, array([0.5]), array([0.0]), 2.2, drawing)


def driven(stiction: float = 0.3) -> Scene:
    """A driven motion with 20 switches between sticking and slipping (SI units).

    Args:
        stiction: relative increase of the limit from fast sliding to rest; 0: Coulomb's law.

    Returns:
        A `Scene`.

    >>> float(driven(stiction=0.5).params["stiction"])
    0.5
    """
    params = {"m": 1.0, "k": 20.0, "c": 0.1, "A": 6.0, "W": 2.0, "F": 3.0, "stiction": stiction, "vs": 0.05}
    return Scene(SYSTEM, params, array([0.0]), array([0.0]), 15.0, drawing)
