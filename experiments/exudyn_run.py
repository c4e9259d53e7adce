"""What runs in exudyn share; imported only where they are asked for: it belongs to the extra `peers`."""

import importlib
from typing import Any


def settings(duration: float, steps: int) -> Any:
    """Of so many equal steps of generalised-alpha, spectral radius 0.9, that write no files."""
    found = importlib.import_module("exudyn").SimulationSettings()
    stepping = found.timeIntegration
    stepping.numberOfSteps, stepping.endTime, stepping.verboseMode = steps, duration, 0
    stepping.generalizedAlpha.spectralRadius = 0.9
    found.solution.file.write = False
    return found
