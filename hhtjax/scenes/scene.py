"""A scene: a system with everything that a run needs besides a stepper and a step size."""

from typing import Any, NamedTuple

from hhtjax.description.presentation import shown
from hhtjax.systems.system import LinearSystem, System


@shown
class Scene(NamedTuple):
    """A system, and what a run needs besides a stepper and a step size.

    Attributes:
        system, params: what moves.
        q0, v0: initial position and velocity.
        duration: s.
    """

    system: System | LinearSystem
    params: Any
    q0: Any
    v0: Any
    duration: float
