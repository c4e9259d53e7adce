"""A driven oscillator with a rigid stop on one side: periodic impacts, period doubling, chaos.

    m w + c v + k q = A cos(W t)  for q < wall,    v+ = -e v  at q = wall

References: S. W. Shaw, P. J. Holmes, A periodically forced piecewise linear oscillator, J. Sound Vib. 90 (1983);
J. M. T. Thompson, R. Ghaffari, Chaos after period-doubling bifurcations in the resonance of an impact oscillator,
Phys. Lett. A 91 (1982).
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from hhtjax.description import PyTree, Real
from hhtjax.scenes import drawings
from hhtjax.scenes.scene import EventScene, array
from hhtjax.systems.events import Event, impact
from hhtjax.systems.system import System


def mass(q, params: PyTree):
    """M = [m]."""
    return params["m"] * jnp.ones(1, q.dtype)


def force(q, v, t, params: PyTree):
    """Q, without the stop."""
    return params["A"] * jnp.cos(params["W"] * t) - params["k"] * q - params["c"] * v


def room(q, v, t, params: PyTree):
    """The distance to the stop, m."""
    return params["wall"] - q[0]


@drawings.Drawing
def drawing(q, t, params: PyTree):
    """The mass on its spring, the stop on its right, and an arrow for the force."""
    size = 0.3
    shapes = drawings.on_a_spring(q[0], size=size, force=np.cos(params["W"] * t))
    return [*shapes, drawings.wall_at(params["wall"] + size / 2, size, 1)]


def driven(restitution: Real = 0.8) -> EventScene:
    """The stop is at the rest position. The drive has 2.6 times the natural frequency without stop (SI units).

    Args:
        restitution: e, in [0, 1].
    """
    params = {"m": 1.0, "c": 0.05, "k": 1.0, "A": 1.0, "W": 2.6, "wall": 0.0, "e": restitution}
    events = (Event(room, reset=impact("e")),)
    return EventScene(System(mass, force), params, array([-0.5]), array([0.0]), 20.0, events, drawing)
