"""The same oscillator in exudyn: a spring with friction that is linear below a speed, or sticks by a stiff spring."""

from functools import partial

import numpy as np

from experiments.exudyn_run import settings

WAYS = {  # exudyn's own words for them
    "exudyn, linear below 0.1 mm/s": {"frictionProportionalZone": 1e-4},
    "exudyn, sticking stiffness 1e6 N/m": {"stickingStiffness": 1e6, "stickingDamping": 1e3},
}


def path(params, way, A, W, constant, duration, steps, samples):
    """q at the start and the samples, under the load A sin(W t) + constant."""
    import exudyn as exu  # pyright: ignore[reportMissingImports]  # of an extra of its own
    from exudyn import itemInterface as items  # pyright: ignore[reportMissingImports]
    from exudyn.utilities import CreateSymbolicUserFunction  # pyright: ignore[reportMissingImports]

    system = exu.SystemContainer().AddSystem()
    node = system.AddNode(items.Node1D(referenceCoordinates=[0.0]))
    system.AddObject(items.Mass1D(mass=float(params["m"]), nodeNumber=node))
    ground = system.AddNode(items.NodePointGround())
    ends = [system.AddMarker(items.MarkerNodeCoordinate(nodeNumber=n, coordinate=0)) for n in (ground, node)]
    options = dict(WAYS[way])
    if "stickingStiffness" in options:  # it remembers where it sticks
        memory = items.NodeGenericData(initialCoordinates=[1, 0, 0], numberOfDataCoordinates=3)
        options["nodeNumber"] = system.AddNode(memory)
    spring = partial(items.CoordinateSpringDamperExt, markerNumbers=ends, dynamicFrictionForce=float(params["F"]))
    system.AddObject(spring(stiffness=float(params["k"]), damping=float(params["c"]), **options))
    push = system.AddLoad(items.LoadCoordinate(markerNumber=ends[1], load=0.0))
    function = CreateSymbolicUserFunction(
        system, lambda mbs, t, _: A * exu.symbolic.sin(W * t) + constant, "loadUserFunction", itemIndex=push
    )
    system.SetLoadParameter(push, "loadUserFunction", function)
    out = items.SensorNode(nodeNumber=node, storeInternal=True, outputVariableType=exu.OutputVariableType.Coordinates)
    sensor = system.AddSensor(out)
    system.Assemble()
    how = settings(duration, steps)
    how.solution.sensors.writePeriod = duration / samples
    system.SolveDynamic(how, solverType=exu.DynamicSolverType.GeneralizedAlpha)
    return np.asarray(system.GetSensorStoredData(sensor))[:, 1]
