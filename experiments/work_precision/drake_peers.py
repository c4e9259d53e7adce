"""Drake: chains of links as its own bodies and joints, with springs and dampers, under its error control."""

from functools import partial
from typing import Any

import numpy as np

from experiments.work_precision.cases import SAMPLES, cases
from experiments.work_precision.compiled_peers import TOLERANCES, named, row_of
from experiments.work_precision.engines import TINY, links
from experiments.work_precision.timing import sweep

SCHEMES = {"Radau3": "radau3", "implicit Euler": "implicit_euler", "RungeKutta5": "runge_kutta5"}
EXPLICIT = ("RungeKutta5",)  # whose run of the stiff double pendulum had not ended after a minute


def chain(m, length, k, c, gravity):
    """The finalised plant: hinges about z, point masses at the ends."""
    plants, trees = named("pydrake.multibody.plant"), named("pydrake.multibody.tree")
    math = named("pydrake.math")

    plant = plants.MultibodyPlant(time_step=0.0)
    parent, offset = plant.world_body(), 0.0
    for i in range(len(m)):
        spin = trees.RotationalInertia(TINY, TINY, TINY)
        end = np.array([length[i], 0.0, 0.0])
        inertia = trees.SpatialInertia.MakeFromCentralInertia(m[i], end, spin)
        body = plant.AddRigidBody(f"link{i}", inertia)
        here = plant.AddFrame(
            trees.FixedOffsetFrame(f"hinge{i}", parent.body_frame(), math.RigidTransform([offset, 0.0, 0.0]))
        )
        joint = plant.AddJoint(
            trees.RevoluteJoint(f"joint{i}", here, body.body_frame(), [0.0, 0.0, 1.0], damping=float(c[i]))
        )
        plant.AddForceElement(trees.RevoluteSpring(joint, 0.0, float(k[i])))
        parent, offset = body, length[i]
    plant.mutable_gravity_field().set_gravity_vector([*gravity, 0.0])
    plant.Finalize()
    return plant


def simulator(plant, q0, duration, scheme, tolerance) -> Any:
    """A simulator, and the log of its states at the sample times."""
    analysis, frame = named("pydrake.systems.analysis"), named("pydrake.systems.framework")
    primitives: Any = named("pydrake.systems.primitives")

    builder = frame.DiagramBuilder()
    builder.AddSystem(plant)
    sink = primitives.LogVectorOutput(plant.get_state_output_port(), builder, duration / SAMPLES)
    run = analysis.Simulator(builder.Build())
    config = analysis.SimulatorConfig()
    config.integration_scheme, config.accuracy, config.max_step_size = scheme, tolerance, duration
    config.use_error_control = True
    analysis.ApplySimulatorConfig(config, run)
    return run, sink


def start(run, plant, sink, relative):
    """Back to the start, with an empty log."""
    context: Any = run.get_mutable_context()
    context.SetTime(0.0)
    plant.SetPositionsAndVelocities(plant.GetMyMutableContextFromRoot(context), relative)
    sink.FindMutableLog(context).Clear()
    run.Initialize()
    return context


def drake_entries(name, tolerances=TOLERANCES):
    """Rows; its steps end at every sample, which its log asks for."""
    case, rows = cases()[name], []
    m, length, k, c, gravity, q0 = links(name)
    n, duration = len(q0), case.scene.duration
    relative = np.concatenate([np.diff(q0, prepend=0.0), np.zeros(n)])
    for called, scheme in SCHEMES.items():
        if name.startswith("stiff") and called in EXPLICIT:
            continue
        made = {}

        def solve(tolerance, scheme=scheme, made=made):
            if tolerance not in made:
                plant = chain(m, length, k, c, gravity)
                made[tolerance] = plant, *simulator(plant, q0, duration, scheme, tolerance)
            plant, run, sink = made[tolerance]
            try:
                context = start(run, plant, sink, relative)
                run.AdvanceTo(duration)
            except RuntimeError:
                return None, None
            path = sink.FindLog(context).data()[:n, 1:].T
            return np.cumsum(path, axis=1), None

        tried = partial(sweep, name, f"Drake {called}", "Drake", solve, tolerances)
        rows += tried(row_of, True)
    return rows
