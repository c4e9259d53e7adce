"""An identified model as C: from data to a step in hard real time, its speed, and deadlines kept and missed."""

from experiments.benchmarks.measure import machine
from experiments.export import pendulum, real_time, speed
from experiments.parts import run_experiment
from experiments.report import Report

PARTS = pendulum, speed, real_time


def run(report: Report, fast: bool):
    """All parts."""
    run_experiment(report, PARTS, fast, machine())
