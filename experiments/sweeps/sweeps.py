"""Step sizes as data: orders of all steppers, maps of many members, large systems, many devices, real time."""

from experiments.parts import run_experiment
from experiments.report import Report
from experiments.sweeps import large, real_time

GROUPS = [large], [real_time]


def run(report: Report, fast: bool):
    """All parts."""
    run_experiment(report, GROUPS, fast)
