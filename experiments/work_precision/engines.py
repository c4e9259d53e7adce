"""MuJoCo and exudyn: chains of links with their own joints, springs and dampers, for which they are made."""

import importlib
from functools import partial
from typing import Any

import numpy as np

from experiments.work_precision.cases import SAMPLES, cases
from experiments.work_precision.timing import sweep

SIZES = tuple(2**n for n in range(14))
INTEGRATORS = "implicitfast", "RK4"
TINY = 1e-12  # kg m^2, of the point masses


def links(name):
    """Of a case: masses, lengths, stiffness, damping, gravity along the zero direction and across it, start."""
    params, q0 = cases()[name].scene.params, cases()[name].scene.q0
    n = q0.size
    m, length, k, c = (np.broadcast_to(np.asarray(params[key], float), n) for key in "mlkc")
    gravity = (params["g"], 0.0) if name == "stiff chain of 8" else (0.0, -params["g"])
    return m, length, k, c, gravity, np.asarray(q0)


def mujoco_model(m, length, k, c, gravity, integrator):
    """Hinges about z, point masses at the ends."""
    mujoco: Any = importlib.import_module("mujoco")  # of an extra of its own

    body = ""
    for i in reversed(range(len(m))):
        offset = length[i - 1] if i else 0.0
        body = (
            f'<body pos="{offset:.17g} 0 0"><joint type="hinge" axis="0 0 1" stiffness="{k[i]:.17g}" '
            f'damping="{c[i]:.17g}"/><inertial pos="{length[i]:.17g} 0 0" mass="{m[i]:.17g}" '
            f'diaginertia="{TINY} {TINY} {TINY}"/>{body}</body>'
        )
    text = (
        f'<mujoco><compiler autolimits="false"/><option gravity="{gravity[0]} {gravity[1]} 0" '
        f'integrator="{integrator}"><flag contact="disable"/></option><worldbody>{body}</worldbody></mujoco>'
    )
    return mujoco.MjModel.from_xml_string(text)


def mujoco_entries(name, sizes=SIZES):
    """Rows; all steps of a run in one call of `mujoco.rollout`."""
    mujoco: Any = importlib.import_module("mujoco")  # of an extra of its own
    rollout: Any = importlib.import_module("mujoco.rollout")

    mujoco.set_mju_user_warning(lambda text: None)
    duration, rows = cases()[name].scene.duration, []
    m, length, k, c, gravity, q0 = links(name)
    for integrator in INTEGRATORS:
        model = mujoco_model(m, length, k, c, gravity, integrator)
        data = mujoco.MjData(model)
        data.qpos[:] = np.diff(q0, prepend=0.0)
        whole = mujoco.mjtState.mjSTATE_FULLPHYSICS
        start = np.zeros(mujoco.mj_stateSize(model, whole))
        mujoco.mj_getState(model, data, start, whole)

        def solve(substeps, model=model, data=data, start=start):
            model.opt.timestep = duration / (SAMPLES * substeps)
            path, _ = rollout.rollout(model, data, start[None], nstep=SAMPLES * substeps)
            relative = path[0, substeps - 1 :: substeps, 1 : 1 + len(q0)]
            return np.cumsum(relative, axis=1), None

        tried = partial(sweep, name, f"MuJoCo {integrator}", "MuJoCo", solve, sizes)
        rows += tried(lambda n: {"h_s": duration / (SAMPLES * n)})
    return rows


def exudyn_system(m, length, k, c, gravity, q0):
    """A kinematic tree with springs and dampers in its joints, and the number of the sensor of its coordinates."""
    import exudyn as exu  # pyright: ignore[reportMissingImports]
    from exudyn import itemInterface as items  # pyright: ignore[reportMissingImports]

    n = len(m)
    system = exu.SystemContainer().AddSystem()
    node = system.AddNode(
        items.NodeGenericODE2(
            referenceCoordinates=[0.0] * n,
            initialCoordinates=np.diff(q0, prepend=0.0).tolist(),
            initialCoordinates_t=[0.0] * n,
            numberOfODE2Coordinates=n,
        )
    )
    turns, offsets, inertias, centres = (
        exu.Matrix3DList(),
        exu.Vector3DList(),
        exu.Matrix3DList(),
        exu.Vector3DList(),
    )
    for i in range(n):
        turns.Append(np.eye(3))
        offsets.Append([length[i - 1] if i else 0.0, 0.0, 0.0])
        inertias.Append(TINY * np.eye(3))
        centres.Append([length[i], 0.0, 0.0])
    system.AddObject(
        items.ObjectKinematicTree(
            nodeNumber=node,
            jointTypes=[exu.JointType.RevoluteZ] * n,
            linkParents=list(range(-1, n - 1)),
            jointTransformations=turns,
            jointOffsets=offsets,
            linkInertiasCOM=inertias,
            linkCOMs=centres,
            linkMasses=m.tolist(),
            gravity=[*gravity, 0.0],
            jointPControlVector=k.tolist(),
            jointDControlVector=c.tolist(),
            jointPositionOffsetVector=[0.0] * n,
            jointVelocityOffsetVector=[0.0] * n,
        )
    )
    kind = exu.OutputVariableType.Coordinates
    sensor = system.AddSensor(
        items.SensorNode(nodeNumber=node, outputVariableType=kind, storeInternal=True, writeToFile=False)
    )
    system.Assemble()
    return system, sensor


def exudyn_entries(name, sizes=SIZES):
    """Rows of its generalised-alpha method with a spectral radius of 0.9, that of our alpha = -0.05."""
    import exudyn as exu  # pyright: ignore[reportMissingImports]

    duration = cases()[name].scene.duration
    m, length, k, c, gravity, q0 = links(name)
    system, sensor = exudyn_system(m, length, k, c, gravity, q0)

    def solve(substeps):
        settings = exu.SimulationSettings()
        stepping = settings.timeIntegration
        stepping.numberOfSteps, stepping.endTime = SAMPLES * substeps, duration
        stepping.generalizedAlpha.spectralRadius = 0.9
        stepping.verboseMode = 0
        settings.solutionSettings.writeSolutionToFile = False
        settings.solutionSettings.sensorsWritePeriod = duration / SAMPLES
        try:
            system.SolveDynamic(settings, solverType=exu.DynamicSolverType.GeneralizedAlpha)
        except (RuntimeError, ValueError):
            return None, None
        path = np.asarray(system.GetSensorStoredData(sensor))[1:, 1 : 1 + len(q0)]
        return np.cumsum(path, axis=1), None

    tried = partial(sweep, name, "exudyn generalised alpha", "exudyn", solve, sizes)
    return tried(lambda n: {"h_s": duration / (SAMPLES * n)})
