"""Events and impacts inside a step: order, tolerances, derivatives, period doubling, Zeno, cost, fits, and peers."""

from experiments.events import cost, gradients, order, parameters, peers, poincare, tolerance, zeno
from experiments.parts import run_experiment
from experiments.report import Report

PARTS = order, gradients, zeno, tolerance, poincare, cost, parameters, peers


def run(report: Report, fast: bool):
    """All parts."""
    run_experiment(report, PARTS, fast)
