"""A mass that runs into stops with a spring and a damper: a bump stop on one side, or backlash between two stops.

    m w = -k q + A cos(W t) - on K (q - gap) - on C v,    on = 1 beyond the gap, 0 before

The damper makes the force jump at the gap. So `on` is a mode in params that an event switches, and no step crosses the
jump. The stop has no mass and no preload, and stays attached to the mass until the mass is back at the gap.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from hhtjax.description import PyTree
from hhtjax.scenes import drawings
from hhtjax.scenes.scene import EventScene, array
from hhtjax.systems.events import Event
from hhtjax.systems.system import System


def mass(q, params: PyTree):
    """M = [m]."""
    return params["m"] * jnp.ones(1, q.dtype)


def spring_and_drive(q, v, t, params: PyTree):
    """Q without stops."""
    return params["A"] * jnp.cos(params["W"] * t) - params["k"] * q


def with_upper(q, v, t, params: PyTree):
    """Q with a stop at q = gap."""
    push = params["K"] * (q - params["gap"]) + params["C"] * v
    return spring_and_drive(q, v, t, params) - params["upper"] * push


def with_both(q, v, t, params: PyTree):
    """Q with stops at q = gap and q = -gap."""
    push = params["K"] * (q + params["gap"]) + params["C"] * v
    return with_upper(q, v, t, params) - params["lower"] * push


def before_upper(q, v, t, params: PyTree):
    """A guard that falls to zero at q = gap, on the way there and on the way back."""
    return (params["gap"] - q[0]) * (1 - 2 * params["upper"])


def before_lower(q, v, t, params: PyTree):
    """As `before_upper`, at q = -gap."""
    return (params["gap"] + q[0]) * (1 - 2 * params["lower"])


def turn_upper(params: PyTree):
    """Switches the upper stop on or off."""
    return params | {"upper": 1 - params["upper"]}


def turn_lower(params: PyTree):
    """Switches the lower stop on or off."""
    return params | {"lower": 1 - params["lower"]}


@drawings.Drawing
def drawing_with_upper(q, t, params: PyTree):
    """The mass on its spring, and the stop, whose plate moves with the mass during contact."""
    half, end = 0.1, params["gap"] + 0.5
    plate = max(q[0], params["gap"]) + half
    stop = drawings.spring((plate, half), (end, half), half), drawings.bar((plate, 0.04), (plate, 0.16))
    return [*drawings.on_a_spring(q[0], size=2 * half), *stop, drawings.wall_at(end, 2 * half, 1)]


@drawings.Drawing
def drawing_with_both(q, t, params: PyTree):
    """The mass between its two stops."""
    size, gap = 0.008, params["gap"]
    shapes = drawings.on_a_spring(q[0], size=size, force=np.cos(params["W"] * t), sprung=False)
    for side in (-1, 1):
        plate, end = side * (max(side * q[0], gap) + size / 2), side * 3.5 * size
        shapes.append(drawings.spring((plate, size / 3), (end, size / 3), size / 3))
        shapes.append(drawings.wall_at(end, size, side))
    return shapes


UPPER, LOWER = Event(before_upper, switch=turn_upper), Event(before_lower, switch=turn_lower)


def bump_stop() -> EventScene:
    """A mass that starts at 3 m/s and runs three times into a stop 0.3 m away, without a drive (SI units)."""
    params = {"m": 1.0, "k": 20.0, "A": 0.0, "W": 0.0, "K": 400.0, "C": 5.0, "gap": 0.3, "upper": 0.0}
    return EventScene(System(mass, with_upper), params, array([0.0]), array([3.0]), 3.0, (UPPER,), drawing_with_upper)


def backlash() -> EventScene:
    """A mass driven to and fro between two stops 10 mm apart. It crosses their surfaces 11 times (SI units)."""
    params = {
        "m": 1.0, "k": 0.0, "A": 20.0, "W": 20.0, "K": 1e4, "C": 20.0, "gap": 0.005, "upper": 0.0, "lower": 0.0,
    }  # fmt: skip
    events = UPPER, LOWER
    return EventScene(System(mass, with_both), params, array([0.0]), array([0.0]), 0.5, events, drawing_with_both)
