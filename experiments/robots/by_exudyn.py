"""The same mechanisms in exudyn: a tree in minimal coordinates, armatures and servos as matrices on its coordinates.

Its implicit steps with their own Newton iteration: generalised alpha (spectral radius 0.9, index 3 for loops), and the
trapezoidal rule with constraints on velocities.
"""

from __future__ import annotations

import importlib
import time
from typing import Any

import numpy as np

from experiments.exudyn_run import settings
from hhtjax.bodies import Mechanism

WAYS = {"exudyn generalized alpha": "GeneralizedAlpha", "exudyn trapezoidal, index 2": "TrapezoidalIndex2"}
TOLERANCE = 1e-10  # of its Newton iteration, relative; with the default, 1e-8, errors end at 1e-7


def frames(robot: Mechanism) -> list[np.ndarray]:
    """For each node a rotation whose z axis is the axis of the joint: exudyn turns about x, y or z alone."""
    found = []
    for node in robot.model.tree.nodes:
        axis = np.asarray(node.axis)
        other = np.eye(3)[np.argmin(np.abs(axis))]
        x = np.cross(other, axis)
        x /= np.linalg.norm(x)
        found.append(np.column_stack([x, np.cross(axis, x), axis]))
    return found


def links(robot: Mechanism) -> list[tuple]:
    """Mass, centre and inertia about it of each node, one body or none on each, in the frames above."""
    p, turns = robot.params, frames(robot)
    found = [(0.0, np.zeros(3), np.zeros((3, 3))) for _ in robot.model.tree.nodes]
    for i, body in enumerate(robot.model.bodies):
        R = turns[body.node].T @ body.R
        centre = turns[body.node].T @ (np.asarray(body.point) + body.R @ np.asarray(p["com"][i]))
        found[body.node] = float(p["mass"][i]), centre, R @ np.asarray(p["inertia"][i]) @ R.T
    return found


def built(robot: Mechanism, q0: np.ndarray, v0: np.ndarray) -> tuple:
    """The system in exudyn, and its node."""
    exu, items = importlib.import_module("exudyn"), importlib.import_module("exudyn.itemInterface")
    p, nodes, turns = robot.params, robot.model.tree.nodes, frames(robot)
    n = len(nodes)
    if [node.slot for node in nodes] != list(range(n)) or any(node.kind != "hinge" for node in nodes):
        raise ValueError("by_exudyn: hinges alone, in the order of the coordinates.")
    system = exu.SystemContainer().AddSystem()
    node = system.AddNode(
        items.NodeGenericODE2(
            referenceCoordinates=[0.0] * n,
            initialCoordinates=np.asarray(q0).tolist(),
            initialCoordinates_t=np.asarray(v0).tolist(),
            numberOfODE2Coordinates=n,
        )
    )
    before = [np.eye(3) if x.parent < 0 else turns[x.parent] for x in nodes]
    masses, centres, inertias = zip(*links(robot), strict=True)
    tree = system.AddObject(
        items.ObjectKinematicTree(
            nodeNumber=node,
            gravity=np.asarray(p["gravity"]).tolist(),
            jointTypes=[exu.JointType.RevoluteZ] * n,
            linkParents=[x.parent for x in nodes],
            jointTransformations=exu.Matrix3DList(
                [B.T @ x.E @ T for B, x, T in zip(before, nodes, turns, strict=True)]
            ),
            jointOffsets=exu.Vector3DList([B.T @ np.asarray(x.offset) for B, x in zip(before, nodes, strict=True)]),
            linkInertiasCOM=exu.Matrix3DList(list(inertias)),
            linkCOMs=exu.Vector3DList(list(centres)),
            linkMasses=list(masses),
        )
    )
    stiffness, damping = np.asarray(p["stiffness"]), np.asarray(p["damping"])
    force = stiffness * np.asarray(p["springref"])
    for i, drive in enumerate(robot.model.drives):  # position servos
        stiffness, damping, force = stiffness.copy(), damping.copy(), force.copy()
        gear, kp, kv = (float(p[name][i]) for name in ("gear", "kp", "kv"))
        stiffness[drive.slot] += gear**2 * kp
        damping[drive.slot] += gear**2 * kv
        force[drive.slot] += gear * kp * float(p["ctrl"][i])
    system.AddObject(
        items.ObjectGenericODE2(
            nodeNumbers=[node],
            massMatrix=np.diag(np.asarray(p["armature"])),
            stiffnessMatrix=np.diag(stiffness),
            dampingMatrix=np.diag(damping),
            forceVector=force.tolist(),
        )
    )
    for loop in robot.model.loops:  # points of two bodies that are one, in the plane of the first axis
        ends = []
        for number, point in zip((loop.first, loop.second), loop.constants[:2], strict=True):
            place = robot.model.places[number]
            at = turns[place.node].T @ (np.asarray(place.point) + place.R @ np.asarray(point))
            ends.append(
                system.AddMarker(
                    items.MarkerKinematicTreeRigid(objectNumber=tree, linkNumber=place.node, localPosition=at.tolist())
                )
            )
        system.AddObject(items.ObjectJointSpherical(markerNumbers=ends, constrainedAxes=[1, 0, 1]))
    return system, node


def sampled_settings(duration: float, steps: int, samples: int) -> Any:
    """Of a run of so many steps."""
    found = settings(duration, steps)
    found.timeIntegration.newton.relativeTolerance = TOLERANCE
    found.solution.sensors.writePeriod = duration / samples
    return found


def path(robot: Mechanism, q0: np.ndarray, v0: np.ndarray, way: str, duration: float, steps: int, samples: int):
    """q at the samples, None where it failed, and the seconds of the run."""
    exu, items = importlib.import_module("exudyn"), importlib.import_module("exudyn.itemInterface")
    system, node = built(robot, q0, v0)
    out = items.SensorNode(nodeNumber=node, storeInternal=True, outputVariableType=exu.OutputVariableType.Coordinates)
    sensor = system.AddSensor(out)
    system.Assemble()
    exu.config.suppressWarnings = True
    options = sampled_settings(duration, steps, samples)
    start = time.perf_counter()
    try:
        system.SolveDynamic(options, solverType=getattr(exu.DynamicSolverType, WAYS[way]), showHints=False)
    except Exception:  # its own kinds
        return None, time.perf_counter() - start
    seconds = time.perf_counter() - start
    q = np.asarray(system.GetSensorStoredData(sensor))[1:, 1:]
    fine = len(q) == samples and np.all(np.isfinite(q)) and np.max(np.abs(q)) < 1e6
    return (q if fine else None), seconds


def accelerations(robot: Mechanism, q0: np.ndarray, v0: np.ndarray) -> np.ndarray:
    """At the start, without loops: by its mass matrix and its forces."""
    exu = importlib.import_module("exudyn")
    system, _ = built(robot, q0, v0)
    system.Assemble()
    solver = exu.MainSolverImplicitSecondOrder()
    solver.InitializeSolver(system, sampled_settings(1.0, 1, 1))
    solver.ComputeMassMatrix(system)
    M = np.array(solver.GetSystemMassMatrix())
    solver.ComputeODE2RHS(system)
    n = len(M)
    force = np.array(solver.GetSystemResidual())[:n]
    solver.FinalizeSolver(system, sampled_settings(1.0, 1, 1))
    return np.linalg.solve(M, force)
