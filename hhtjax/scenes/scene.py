"""A scene: a system with everything that a run needs besides a stepper and a step size."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from hhtjax.description import Array, PyTree, all_concrete
from hhtjax.description.presentation import shown
from hhtjax.scenes.drawings import Drawing
from hhtjax.systems.events import Event
from hhtjax.systems.system import LinearSystem, System


@shown
class Scene(NamedTuple):
    """A system, and what a run needs besides a stepper and a step size.

    Attributes:
        system, params: what moves.
        q0, v0: initial position and velocity.
        duration: s.
        drawing: a `hhtjax.scenes.drawings.Drawing`, what `hhtjax.plot.animation` draws; or None.
    """

    system: System | LinearSystem
    params: PyTree
    q0: PyTree
    v0: PyTree
    duration: float
    drawing: Drawing | None = None


@shown
class EventScene(NamedTuple):
    """A system with events, and what a run needs besides a stepper and a step size.

    Attributes:
        system, params: what moves.
        q0, v0: initial position and velocity.
        duration: s.
        events: what happens on the way, a tuple of `Event`.
        drawing: a `hhtjax.scenes.drawings.Drawing`, what `hhtjax.plot.animation` draws; or None.
    """

    system: System | LinearSystem
    params: PyTree
    q0: PyTree
    v0: PyTree
    duration: float
    events: tuple[Event, ...]
    drawing: Drawing | None = None


@shown
class InternalScene(NamedTuple):
    """A system with internal states, and what a run needs besides a stepper and a step size.

    Attributes:
        system, params: what moves.
        q0, v0, z0: initial position, velocity and internal states.
        duration: s.
        drawing: a `hhtjax.scenes.drawings.Drawing`, what `hhtjax.plot.animation` draws; or None.
    """

    system: System
    params: PyTree
    q0: PyTree
    v0: PyTree
    duration: float
    z0: PyTree
    drawing: Drawing | None = None


def array(values: PyTree) -> Array:
    """An array of floats; of numbers by NumPy, which has nothing to compile."""
    dtype = jnp.result_type(float)
    known = all_concrete(values)
    return jnp.asarray(np.asarray(values, dtype) if known else values, dtype)
