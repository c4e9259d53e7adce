"""A scene: a system with everything that a run needs besides a stepper and a step size."""

from __future__ import annotations

from typing import Any, NamedTuple, Self

import jax.numpy as jnp
import numpy as np

from hhtjax.description import Array, PyTree, all_concrete
from hhtjax.description.presentation import shown
from hhtjax.scenes.drawings import Drawing
from hhtjax.systems.events import Event
from hhtjax.systems.system import LinearSystem, System


class _Drawn(tuple):
    """A named tuple with a drawing. The drawing is not an entry: it is not unpacked, and not a leaf of the pytree."""

    drawing: Drawing | None = None

    @classmethod
    def _with(cls, drawing: Drawing | None, entries: tuple) -> Self:
        scene = tuple.__new__(cls, entries)
        scene.drawing = drawing
        return scene

    def _replace(self, /, **changes: Any) -> Self:
        """The scene with some entries replaced."""
        return self._with(self.drawing, super()._replace(**changes))  # pyright: ignore[reportAttributeAccessIssue]


class _Scene(NamedTuple):
    system: System | LinearSystem
    params: PyTree
    q0: PyTree
    v0: PyTree
    duration: float


class _EventScene(NamedTuple):
    system: System | LinearSystem
    params: PyTree
    q0: PyTree
    v0: PyTree
    duration: float
    events: tuple[Event, ...]


class _InternalScene(NamedTuple):
    system: System
    params: PyTree
    q0: PyTree
    v0: PyTree
    duration: float
    z0: PyTree


@shown
class Scene(_Drawn, _Scene):
    """A system with all data of a run except stepper and step size: `system, params, q0, v0, duration = scene`.

    Attributes:
        system, params: the system and its parameters.
        q0, v0: initial position and velocity.
        duration: s.
        drawing: a `hhtjax.scenes.drawings.Drawing` for `hhtjax.plot.animation`, or None. It is not unpacked.
    """

    def __new__(cls, system, params, q0, v0, duration, drawing=None):
        return cls._with(drawing, (system, params, q0, v0, duration))


@shown
class EventScene(_Drawn, _EventScene):
    """A system with events, with all data of a run except stepper and step size.

    Attributes:
        system, params: the system and its parameters.
        q0, v0: initial position and velocity.
        duration: s.
        events: events of the run, a tuple of `Event`.
        drawing: a `hhtjax.scenes.drawings.Drawing` for `hhtjax.plot.animation`, or None. It is not unpacked.
    """

    def __new__(cls, system, params, q0, v0, duration, events, drawing=None):
        return cls._with(drawing, (system, params, q0, v0, duration, events))


@shown
class InternalScene(_Drawn, _InternalScene):
    """A system with internal states, with all data of a run except stepper and step size.

    Attributes:
        system, params: the system and its parameters.
        q0, v0, z0: initial position, velocity and internal states.
        duration: s.
        drawing: a `hhtjax.scenes.drawings.Drawing` for `hhtjax.plot.animation`, or None. It is not unpacked.
    """

    def __new__(cls, system, params, q0, v0, duration, z0, drawing=None):
        return cls._with(drawing, (system, params, q0, v0, duration, z0))


def array(values: PyTree) -> Array:
    """An array of floats. Known values are converted by NumPy, because NumPy compiles nothing."""
    dtype = jnp.result_type(float)
    known = all_concrete(values)
    return jnp.asarray(np.asarray(values, dtype) if known else values, dtype)
