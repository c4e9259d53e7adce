"""The same beam in exudyn: the same elements, generalised alpha, full or modified Newton, one thread.

Its elements have consistent masses; `lumped` gives them none, and each node a rigid body instead. Constraints hold the
first node, on positions (index 3). Its module without range checks is taken where nothing imported it before.
"""

from __future__ import annotations

import importlib
import sys
import time
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from experiments.flexible.beam import SECONDS, SPEED, Beam, in_hub, masses, pendulum, straight
from experiments.flexible.native_beam import Run, library

SOLVER = "EigenSparse"
DTS, FINE = (1e-2, 5e-3, 2e-3, 1e-3, 5e-4), 5e-5  # s
RADIUS = 0.9  # the spectral radius
TOLERANCES = 1e-10, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2  # of its residuals, absolute; the first is its default


def modules() -> tuple[Any, Any]:
    """exudyn and its items."""
    if "exudyn" not in sys.modules and not hasattr(sys, "exudynFast"):
        sys.exudynFast = True  # pyright: ignore[reportAttributeAccessIssue]
    return importlib.import_module("exudyn"), importlib.import_module("exudyn.itemInterface")


class Model(NamedTuple):
    """A system of exudyn, a sensor of the coordinates of the tip, and what these are at first."""

    system: Any
    sensor: int
    reference: np.ndarray


def hub_angle(system: Any, t: float, item: int, offset: float) -> float:
    """That of the spin-up, as exudyn calls it."""
    if t >= SECONDS:
        return SPEED * (t - SECONDS / 2)
    turn = 2 * np.pi / SECONDS
    return float(SPEED / SECONDS * (t * t / 2 + (np.cos(turn * t) - 1) / turn**2))


def hub_rate(system: Any, t: float, item: int, offset: float) -> float:
    """Its rate."""
    turn = 2 * np.pi / SECONDS
    return SPEED if t >= SECONDS else float(SPEED / SECONDS * (t - np.sin(turn * t) / turn))


def hold(system: Any, node: int, coordinates: tuple[int, ...], beam: Beam):
    """Constraints on coordinates of a node; number 2 is the angle, which the hub of the spin-up gives."""
    _, items = modules()
    ground = system.AddNode(items.NodePointGround())
    end = system.AddMarker(items.MarkerNodeCoordinate(nodeNumber=ground, coordinate=0))
    for i in coordinates:
        marker = system.AddMarker(items.MarkerNodeCoordinate(nodeNumber=node, coordinate=i))
        spun = beam.hub == "spun" and i == 2
        driven = {"offsetUserFunction": hub_angle, "offsetUserFunction_t": hub_rate} if spun else {}
        system.AddObject(items.CoordinateConstraint(markerNumbers=[end, marker], **driven))


def weigh(system: Any, body: int, gravity: float):
    """The weight of a body, along -y."""
    _, items = modules()
    if gravity:
        marker = system.AddMarker(items.MarkerBodyMass(bodyNumber=body))
        system.AddLoad(items.LoadMassProportional(markerNumber=marker, loadVector=[0.0, -gravity, 0.0]))


def finished(system: Any, tip: int, reference: list[float]) -> Model:
    """Assembled, with its sensor."""
    exu, items = modules()
    coordinates = exu.OutputVariableType.Coordinates
    sensor = system.AddSensor(items.SensorNode(nodeNumber=tip, storeInternal=True, outputVariableType=coordinates))
    system.Assemble()
    return Model(system, sensor, np.array(reference))


def built(beam: Beam, lumped: bool = True) -> Model:
    """Geometrically exact elements."""
    exu, items = modules()
    system = exu.SystemContainer().AddSystem()
    places, shares = straight(beam), masses(beam)
    nodes = [system.AddNode(items.NodeRigidBody2D(referenceCoordinates=place.tolist())) for place in places]
    carried = 0.0 if lumped else 1.0
    section = {"massPerLength": carried * beam.rhoA, "crossSectionInertia": carried * beam.rhoI}
    section |= {"bendingStiffness": beam.EI, "axialStiffness": beam.EA, "shearStiffness": beam.GA}
    section["length"] = beam.length / beam.elements
    for pair in pairwise(nodes):
        element = system.AddObject(items.ObjectBeamGeometricallyExact2D(nodeNumbers=list(pair), **section))
        weigh(system, element, 0.0 if lumped else beam.gravity)
    for node, (mass, _, inertia) in zip(nodes, shares, strict=True) if lumped else ():
        body = system.AddObject(items.ObjectRigidBody2D(mass=mass, inertia=inertia, nodeNumber=node))
        weigh(system, body, beam.gravity)
    hold(system, nodes[0], tuple(range(beam.held)), beam)
    return finished(system, nodes[-1], places[-1].tolist())


def cable(beam: Beam) -> Model:
    """ANCF cable elements, of no shear and with consistent masses, with the length, mass and stiffness of the beam.

    Raises:
        ValueError: the beam is spun: slopes have no angle to give.
    """
    if beam.hub == "spun":
        raise ValueError("cable: `beam` must be pinned or clamped; received one on a hub that turns.")
    exu, items = modules()
    system = exu.SystemContainer().AddSystem()
    places = [[float(x), 0.0, 1.0, 0.0] for x in straight(beam)[:, 0]]
    nodes = [system.AddNode(items.NodePoint2DSlope1(referenceCoordinates=place)) for place in places]
    section = {"length": beam.length / beam.elements, "massPerLength": beam.rhoA}
    section |= {"bendingStiffness": beam.EI, "axialStiffness": beam.EA}
    for pair in pairwise(nodes):
        weigh(system, system.AddObject(items.ObjectANCFCable2D(nodeNumbers=list(pair), **section)), beam.gravity)
    hold(system, nodes[0], (0, 1) if beam.hub is None else (0, 1, 3), beam)  # clamped: the slope's y, too
    return finished(system, nodes[-1], places[-1])


class Ran(NamedTuple):
    """Seconds of a run, coordinates of the tip at the samples (samples, k), and iterations and Jacobians a step."""

    seconds: float
    tip: np.ndarray
    iterations: float
    jacobians: float


def settings(dt: float, steps: int, every: int, modified: bool, solver: str, tolerance: float) -> Any:
    """Of a run of so many steps."""
    exu, _ = modules()
    found = exu.SimulationSettings()
    stepping = found.timeIntegration
    stepping.numberOfSteps, stepping.endTime, stepping.verboseMode = steps, steps * dt, 0
    stepping.adaptiveStep = False
    stepping.generalizedAlpha.spectralRadius = RADIUS
    stepping.newton.useModifiedNewton, stepping.newton.absoluteTolerance = modified, tolerance
    found.linearSolver.solverType = getattr(exu.LinearSolverType, solver)
    found.linearSolver.reuseAnalyzedPattern = True
    found.parallel.numberOfThreads = 1
    found.solution.file.write = False
    found.solution.sensors.writePeriod = every * dt
    return found


def run(
    model: Model, dt: float, steps: int, modified: bool, tolerance: float, *, solver: str = SOLVER, every: int = 0
) -> Ran | None:
    """From the start, with a sample after each `every` steps, by default at the end alone; None where it fails."""
    exu, _ = modules()
    options = settings(dt, steps, every or steps, modified, solver, tolerance)
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
    tip = np.asarray(model.system.GetSensorStoredData(model.sensor))[1:, 1:] + model.reference
    if len(tip) != steps // (every or steps) or not np.all(np.isfinite(tip)):
        return None
    done = model.system.sys["dynamicSolver"].it
    return Ran(seconds, tip, done.newtonStepsCount / steps, done.newtonJacobiCount / steps)


def tightest(model: Model, dt: float, steps: int, modified: bool) -> float | None:
    """The smallest of TOLERANCES with which it comes to its end: rounding bounds what its iteration can reach."""
    return next((x for x in TOLERANCES if run(model, dt, steps, modified, x)), None)


def speed(model: Model, unknowns: int, dt: float, steps: int, modified: bool, repeats: int = 3) -> dict | None:
    """What a step takes, the least of several runs; None where none of TOLERANCES works."""
    tolerance = tightest(model, dt, steps, modified)
    if tolerance is None:
        return None
    ran = [run(model, dt, steps, modified, tolerance) for _ in range(repeats)]
    best = min((x for x in ran if x is not None), key=lambda x: x.seconds)
    return {
        "unknowns": unknowns,
        "newton": "modified" if modified else "full",
        "tolerance": tolerance,
        "ns_per_step_and_unknown": 1e9 * best.seconds / steps / unknowns,
        "iterations_per_step": best.iterations,
        "jacobians_per_step": best.jacobians,
        "tip_m": best.tip[-1, :2].tolist(),
    }


def speeds(fast: bool = False, dt: float = 1e-3) -> list[dict]:
    """Of the falling beam, lumped and consistent, and of a cable of 1000 elements; full and modified Newton."""
    sizes = (10,) if fast else (10, 100, 1000)
    models = [
        (f"beam, {'lumped' if lumped else 'consistent'}", built(pendulum(size), lumped), pendulum(size).unknowns)
        for size in sizes
        for lumped in (True, False)
    ]
    size = sizes[-1]
    models.append(("ANCF cable", cable(pendulum(size)), 4 * (size + 1) - 2))
    rows = []
    for name, model, unknowns in models:
        steps = 20 if fast else max(200, 300_000 // unknowns)
        for modified in (False, True):
            row = speed(model, unknowns, dt, steps, modified, 1 if fast else 3)
            rows.append({"model": name, "newton": "modified" if modified else "full"} | (row or {}))
    return rows


def errors(beam: Beam, duration: float, dts: tuple, lumped: bool = True, sample: float = 0.05) -> list[dict]:
    """For several steps: seconds of a run, and the error of the tip's place (RMS over the samples, m).

    It is that of the steps alone, against the C source with steps of FINE; None without a compiler. Of the spin-up, the
    largest lag and the stretch after it, too, m.
    """
    model, exact = built(beam, lumped), None
    if (found := library()) is not None:
        exact = Run(found, beam, FINE, round(duration / FINE)).tip(round(sample / FINE))
    rows = []
    for dt in dts:
        for modified in (False, True):
            steps, every = round(duration / dt), round(sample / dt)
            tolerance = tightest(model, dt, steps, modified)
            ran = None if tolerance is None else run(model, dt, steps, modified, tolerance, every=every)
            row = {"dt_s": dt, "newton": "modified" if modified else "full", "tolerance": tolerance}
            rows.append(row | (judged(beam, ran, exact, sample) if ran else {}))
    return rows


def judged(beam: Beam, ran: Ran, exact: np.ndarray | None, sample: float) -> dict:
    """Seconds and errors of a run."""
    error = None if exact is None else float(np.sqrt(np.mean(np.sum((ran.tip - exact)[:, :2] ** 2, axis=1))))
    row = {"seconds": ran.seconds, "tip_error_m": error, "iterations_per_step": ran.iterations}
    if beam.hub == "spun":
        times = sample * np.arange(1, len(ran.tip) + 1)
        lag, stretch = in_hub(beam, ran.tip, times)
        steady = stretch[times > SECONDS]
        row |= {"largest_lag_m": float(lag.min()), "stretch_m": float(steady.mean()) if steady.size else None}
    return row


def spin_up(fast: bool = False, elements: int = 32) -> list[dict]:
    """`errors` of the spin-up, 20 s."""
    return errors(Beam(elements), 2.0 if fast else 20.0, DTS[:2] if fast else DTS)


def fall(fast: bool = False, elements: int = 32) -> list[dict]:
    """`errors` of the falling beam, 2 s: it bends far."""
    return errors(pendulum(elements), 0.1 if fast else 2.0, DTS[:2] if fast else DTS)
