"""The ball in exudyn: contact by a stiff spring, with a damper or with a law that gives the restitution."""

import numpy as np

from experiments.exudyn_run import settings

# exudyn's impactModel: 0 a linear damper, 2 the law of Gonthier et al. and Carvalho, Martins, of the restitution
LAWS = {"spring and damper": 0, "restitution": 2}


def fallen(law, gravity, e, duration, steps, stiffness, shortened=False):
    """q at the end, from 1 m and rest, and how many steps it took. stiffness: of the ground, N/m, for 1 kg.

    shortened: whether it may take shorter steps where the contact begins and ends.
    """
    import exudyn as exu  # pyright: ignore[reportMissingImports]  # of an extra of its own
    from exudyn import itemInterface as items  # pyright: ignore[reportMissingImports]

    model = LAWS[law]
    system = exu.SystemContainer().AddSystem()
    node = system.AddNode(items.Node1D(referenceCoordinates=[0.0], initialCoordinates=[1.0]))
    system.AddObject(items.Mass1D(mass=1.0, nodeNumber=node))
    ground = system.AddNode(items.NodePointGround())
    ends = [system.AddMarker(items.MarkerNodeCoordinate(nodeNumber=n, coordinate=0)) for n in (ground, node)]
    numbers = [1.0, 0.0][: 1 + (model > 0)]  # the gap, and the speed of the impact
    memory = system.AddNode(items.NodeGenericData(initialCoordinates=numbers, numberOfDataCoordinates=len(numbers)))
    ratio = -np.log(e) / np.hypot(np.pi, np.log(e))
    damping = 0.0 if model else 2 * ratio * np.sqrt(stiffness)
    contact = {"impactModel": model, "restitutionCoefficient": e, "contactDamping": damping}
    system.AddObject(
        items.ObjectContactCoordinate(markerNumbers=ends, nodeNumber=memory, contactStiffness=stiffness, **contact)
    )
    system.AddLoad(items.LoadCoordinate(markerNumber=ends[1], load=-gravity))
    system.Assemble()
    how = settings(duration, steps)
    stepping = how.timeIntegration
    stepping.adaptiveStep = stepping.discontinuous.useRecommendedStepSize = shortened
    stepping.minimumStepSize = 1e-12
    stepping.discontinuous.iterationTolerance = 1e-3
    stepping.discontinuous.maxIterations, stepping.discontinuous.ignoreMaxIterations = 10, True
    system.SolveDynamic(how, solverType=exu.DynamicSolverType.GeneralizedAlpha, storeSolver=True)
    q = system.GetNodeOutput(node, exu.OutputVariableType.Coordinates)
    return float(np.ravel(q)[0]), int(system.sys["dynamicSolver"].it.currentStepIndex) - 1
