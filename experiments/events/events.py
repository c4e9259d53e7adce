"""Events and impacts inside a step: order, derivatives, period doubling, Zeno, cost, fits through them, and peers."""

from experiments.events import cost, gradients, order, parameters, peers, poincare, zeno
from experiments.parts import run_experiment
from experiments.report import Report

GROUPS = [order, gradients, zeno], [poincare, cost, parameters, peers]  # two processes if fast


def run(report: Report, fast: bool):
    """All parts."""
    run_experiment(report, GROUPS, fast)
