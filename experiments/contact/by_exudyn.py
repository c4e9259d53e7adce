"""The disc in exudyn: a rolling disc with a stiff spring below it, and friction that is linear below a speed."""

from typing import Any

import numpy as np

from experiments.contact.scenes import GRAVITY
from experiments.exudyn_run import settings


def rolled(mu, v0, inertia, duration, steps, stiffness=1e6, zone=1e-4):
    """The speed at the end of a disc of 1 kg and radius 1 m that starts sliding. zone: m/s."""
    import exudyn as exu  # pyright: ignore[reportMissingImports]  # of an extra of its own
    from exudyn.utilities import RigidBodyInertia  # pyright: ignore[reportMissingImports]

    system: Any = exu.SystemContainer().AddSystem()
    ground = system.CreateGround()
    kind: Any = RigidBodyInertia
    of_body = kind(mass=1.0, inertiaTensor=np.diag([inertia, inertia, inertia]))
    sinks = GRAVITY / stiffness
    body = system.CreateRigidBody(
        inertia=of_body, referencePosition=[0, 0, 1 - sinks], initialVelocity=[0, v0, 0], gravity=[0, 0, -GRAVITY]
    )
    system.CreateRollingDiscPenalty(
        bodyNumbers=[ground, body], axisPosition=[0, 0, 0], axisVector=[1, 0, 0], discRadius=1.0, planeNormal=[0, 0, 1],
        contactStiffness=stiffness, contactDamping=2 * np.sqrt(stiffness), dryFriction=[mu, mu],
        dryFrictionProportionalZone=zone,
    )  # fmt: skip
    system.Assemble()
    system.SolveDynamic(settings(duration, steps), solverType=exu.DynamicSolverType.GeneralizedAlpha)
    return float(system.GetObjectOutputBody(body, exu.OutputVariableType.Velocity, [0, 0, 0])[1])
