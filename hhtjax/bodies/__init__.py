"""Mechanisms from bodies and joints, or from model files: their equations in minimal coordinates as a `System`."""

from hhtjax.bodies.description import (
    Body,
    Connect,
    Couple,
    Joint,
    Marker,
    Motor,
    Weld,
    denavit_hartenberg,
    flexible,
)
from hhtjax.bodies.equations import Frame
from hhtjax.bodies.mechanism import (
    Mechanism,
    forces,
    frames,
    inertial_parameters,
    inverse_dynamics,
    mass_matrix,
    regressor,
    tree,
)
from hhtjax.bodies.model_file import load

__all__ = [
    "Body",
    "Connect",
    "Couple",
    "Frame",
    "Joint",
    "Marker",
    "Mechanism",
    "Motor",
    "Weld",
    "denavit_hartenberg",
    "flexible",
    "forces",
    "frames",
    "inertial_parameters",
    "inverse_dynamics",
    "load",
    "mass_matrix",
    "regressor",
    "tree",
]
