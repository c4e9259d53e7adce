"""A body on a shaking table: it rides on the table, is thrown off, flies, and lands on the table again.

    m y'' = -m g + L,   riding: y = A sin(W t), L >= 0,   in flight: L = 0,   landing: y' becomes that of the table

In this run events switch a constraint on and off. The number of constraints of a run is fixed. So while this one is
off, it fixes a separate coordinate s instead, on which no force acts, and which is always 0.

    Phi = on (y - A sin(W t)) + (1 - on) s

(Without s, on (y - A sin(W t)) = 0 would leave a multiplier without an equation. redundant="least_squares" can solve
that, with a singular value decomposition in each step.) The body leaves the table when its multiplier falls to zero, at
sin(W t) = g/(A W^2). Then it follows a parabola up to the next contact.
J. Guckenheimer, P. Holmes, Nonlinear Oscillations, Dynamical Systems, and Bifurcations of Vector Fields, 1983, Ch. 2.4.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from hhtjax.description import PyTree
from hhtjax.scenes import drawings
from hhtjax.scenes.scene import EventScene, array
from hhtjax.systems.events import Event, impact
from hhtjax.systems.system import System

GRAVITY = 9.81


def mass(q, params: PyTree):
    """M, a diagonal: the masses of the body and of s. That of s has no effect."""
    return params["m"] * jnp.ones(2, q.dtype)


def weight(q, v, t, params: PyTree):
    """Q; no force acts on s."""
    return jnp.array([-params["m"] * params["g"], 0.0], q.dtype)


def over_table(q, t, params: PyTree):
    """Height of the body over the table, m."""
    return q[0] - params["A"] * jnp.sin(params["W"] * t)


def contact(q, t, params: PyTree):
    """Phi: keeps the body on the table, or s at 0."""
    on = params["on"]
    return (on * over_table(q, t, params) + (1 - on) * q[1])[None]


def before_landing(q, v, t, params: PyTree):
    """A guard that falls to zero when the flying body meets the table."""
    return jnp.where(params["on"] == 1, 1.0, over_table(q, t, params))


def before_leaving(q, v, t, params: PyTree, multipliers):
    """A guard that falls to zero when the contact force of the riding body does."""
    return jnp.where(params["on"] == 1, multipliers[0], 1.0)


def land(params: PyTree):
    """Switches the constraint on."""
    return params | {"on": 0 * params["on"] + 1}


def leave(params: PyTree):
    """Switches the constraint off."""
    return params | {"on": 0 * params["on"]}


@drawings.Drawing
def drawing(q, t, params: PyTree):
    """The body, and the table at its height."""
    size, height = 0.1, params["A"] * np.sin(params["W"] * t)
    return [
        drawings.block((0.0, q[0] + size / 2), size, size),
        drawings.ground((-2 * size, height), (2 * size, height), 0.2 * size),
    ]


EVENTS = LANDING, LEAVING = Event(before_landing, reset=impact(0.0), switch=land), Event(before_leaving, switch=leave)


def shaken_table(strength: float = 2.0) -> EventScene:
    """Two flights in 1.3 s. The body starts on the table, at its mean height (SI units).

    Args:
        strength: A W^2/g, the largest acceleration of the table over g; above 1 it throws the body off.

    >>> float(shaken_table().params["A"])
    0.1962
    """
    params = {"m": 0.5, "g": GRAVITY, "A": strength * GRAVITY / 100.0, "W": 10.0, "on": 1.0}
    v0 = array([10.0 * params["A"], 0.0])
    return EventScene(System(mass, weight, contact), params, array([0.0, 0.0]), v0, 1.3, EVENTS, drawing)
