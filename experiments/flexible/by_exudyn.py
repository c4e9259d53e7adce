"""The same beam in exudyn: the same elements, generalised alpha, full or modified Newton, one thread.

Its elements have consistent masses; `lumped` gives them none, and each node a rigid body instead. Constraints hold the
first node, on positions (index 3). Its module without range checks is taken where it is imported here first.
"""

from __future__ import annotations

import importlib
import sys
import time
from typing import Any, NamedTuple

import jax
import numpy as np

from experiments.flexible.beam import LARGEST_LAG, SECONDS, SPEED, Beam, hub_angle, masses, pendulum, straight

SOLVERS = "EigenSparse", "EigenSparseSymmetric", "EXUdense"
NEWTON = {"full Newton": False, "modified Newton": True}
RADIUS = 0.9  # the spectral radius
TOLERANCES = 1e-8, 1e-7, 1e-6, 1e-5, 1e-4  # of its Newton iteration, relative; the first is its default


def modules() -> tuple[Any, Any]:
    """exudyn and its items."""
    if "exudyn" not in sys.modules and not hasattr(sys, "exudynFast"):
        sys.exudynFast = True  # pyright: ignore[reportAttributeAccessIssue]
    return importlib.import_module("exudyn"), importlib.import_module("exudyn.itemInterface")


class Model(NamedTuple):
    """A system of exudyn, the node at the tip, and all of them."""

    system: Any
    tip: int
    nodes: list


def hold(system: Any, first: int, beam: Beam):
    """Constraints on the coordinates of the first node; the hub's angle by a function that exudyn calls."""
    _, items = modules()
    ground = system.AddNode(items.NodePointGround())
    end = system.AddMarker(items.MarkerNodeCoordinate(nodeNumber=ground, coordinate=0))
    for i in range(beam.held):
        marker = system.AddMarker(items.MarkerNodeCoordinate(nodeNumber=first, coordinate=i))
        driven = {}
        if i == 2 and beam.hub == "spun":
            driven = {"offsetUserFunction": angle, "offsetUserFunction_t": angle_rate}
        system.AddObject(items.CoordinateConstraint(markerNumbers=[end, marker], **driven))


def angle(system: Any, t: float, item: int, offset: float) -> float:
    """`hub_angle` of the spin-up in plain Python."""
    if t >= SECONDS:
        return SPEED * (t - SECONDS / 2)
    turn = 2 * np.pi / SECONDS
    return float(SPEED / SECONDS * (t * t / 2 + (np.cos(turn * t) - 1) / turn**2))


def angle_rate(system: Any, t: float, item: int, offset: float) -> float:
    """Its rate."""
    turn = 2 * np.pi / SECONDS
    return SPEED if t >= SECONDS else float(SPEED / SECONDS * (t - np.sin(turn * t) / turn))


def built(beam: Beam, lumped: bool = True) -> Model:
    """Geometrically exact elements, assembled."""
    exu, items = modules()
    system = exu.SystemContainer().AddSystem()
    places, shares = straight(beam), masses(beam)
    nodes = [system.AddNode(items.NodeRigidBody2D(referenceCoordinates=place.tolist())) for place in places]
    carried = 0.0 if lumped else 1.0
    for pair in zip(nodes[:-1], nodes[1:], strict=True):
        element = system.AddObject(
            items.ObjectBeamGeometricallyExact2D(
                nodeNumbers=list(pair),
                length=beam.length / beam.elements,
                massPerLength=carried * beam.rhoA,
                crossSectionInertia=carried * beam.rhoI,
                bendingStiffness=beam.EI,
                axialStiffness=beam.EA,
                shearStiffness=beam.GA,
            )
        )
        if not lumped:
            weigh(system, element, beam.gravity)
    for node, (mass, _, inertia) in zip(nodes, shares, strict=True) if lumped else ():
        body = system.AddObject(items.ObjectRigidBody2D(mass=mass, inertia=inertia, nodeNumber=node))
        weigh(system, body, beam.gravity)
    hold(system, nodes[0], beam)
    system.Assemble()
    return Model(system, nodes[-1], nodes)


def weigh(system: Any, body: int, gravity: float):
    """The weight of a body, along -y."""
    _, items = modules()
    if gravity:
        marker = system.AddMarker(items.MarkerBodyMass(bodyNumber=body))
        system.AddLoad(items.LoadMassProportional(markerNumber=marker, loadVector=[0.0, -gravity, 0.0]))


def cable(beam: Beam) -> Model:
    """ANCF cable elements (no shear), consistent masses, on the beam's length, stiffness and hub; assembled."""
    exu, items = modules()
    system = exu.SystemContainer().AddSystem()
    nodes = [
        system.AddNode(items.NodePoint2DSlope1(referenceCoordinates=[float(x), 0.0, 1.0, 0.0]))
        for x in straight(beam)[:, 0]
    ]
    for pair in zip(nodes[:-1], nodes[1:], strict=True):
        element = system.AddObject(
            items.ObjectANCFCable2D(
                nodeNumbers=list(pair),
                length=beam.length / beam.elements,
                massPerLength=beam.rhoA,
                bendingStiffness=beam.EI,
                axialStiffness=beam.EA,
            )
        )
        weigh(system, element, beam.gravity)
    if beam.hub == "spun":
        raise ValueError("cable: `beam` must be pinned or clamped.")
    ground = system.AddNode(items.NodePointGround())
    end = system.AddMarker(items.MarkerNodeCoordinate(nodeNumber=ground, coordinate=0))
    for i in (0, 1) if beam.hub is None else (0, 1, 3):  # clamped: the slope along y too
        marker = system.AddMarker(items.MarkerNodeCoordinate(nodeNumber=nodes[0], coordinate=i))
        system.AddObject(items.CoordinateConstraint(markerNumbers=[end, marker]))
    system.Assemble()
    return Model(system, nodes[-1], nodes)


def settings(dt: float, steps: int, modified: bool, solver: str, tolerance: float) -> Any:
    """Of a run of so many steps."""
    exu, _ = modules()
    found = exu.SimulationSettings()
    stepping = found.timeIntegration
    stepping.numberOfSteps, stepping.endTime, stepping.verboseMode = steps, steps * dt, 0
    stepping.adaptiveStep = False
    stepping.generalizedAlpha.spectralRadius = RADIUS
    stepping.newton.useModifiedNewton = modified
    stepping.newton.relativeTolerance = tolerance
    found.linearSolver.solverType = getattr(exu.LinearSolverType, solver)
    found.linearSolver.reuseAnalyzedPattern = True
    found.parallel.numberOfThreads = 1
    found.solution.file.write = False
    return found


class Ran(NamedTuple):
    """Seconds of a run, coordinates of the nodes at its end (nodes, k), and iterations and Jacobians a step."""

    seconds: float
    q: np.ndarray
    iterations: float
    jacobians: float


def run(model: Model, dt: float, steps: int, modified: bool, solver: str, tolerance: float) -> Ran | None:
    """From the start; None where it fails."""
    exu, _ = modules()
    options = settings(dt, steps, modified, solver, tolerance)
    talks = exu.config.printToConsole
    exu.config.suppressWarnings, exu.config.printToConsole = True, False
    start = time.perf_counter()
    try:
        model.system.SolveDynamic(
            options, solverType=exu.DynamicSolverType.GeneralizedAlpha, storeSolver=True, showHints=False
        )
    except Exception:  # its own kinds
        return None
    finally:
        exu.config.printToConsole = talks
    seconds = time.perf_counter() - start
    coordinates = exu.OutputVariableType.Coordinates
    q = np.array([model.system.GetNodeOutput(node, coordinates) for node in model.nodes])
    if not np.all(np.isfinite(q)):
        return None
    done = model.system.sys["dynamicSolver"].it
    return Ran(seconds, q, done.newtonStepsCount / steps, done.newtonJacobiCount / steps)


def tightest(model: Model, dt: float, steps: int, modified: bool, solver: str = SOLVERS[0]) -> float | None:
    """The smallest of TOLERANCES with which it comes to its end: rounding bounds what its iteration can reach."""
    return next((x for x in TOLERANCES if run(model, dt, steps, modified, solver, x)), None)
