"""Step sizes as data: one call for all, orders, maps of many members, devices, workers, large systems, real time."""

from experiments.parts import run_experiment
from experiments.report import Report
from experiments.sweeps import devices, large, map, on_paper, one_call, orders, real_time, workers

PARTS = map, real_time, one_call, devices, workers, on_paper, orders, large


def run(report: Report, fast: bool):
    """All parts."""
    run_experiment(report, PARTS, fast)
