"""Bodies that rest, stick, slide, let go and land: order, closed forms, derivatives, fits, gaps, cost, and other ways."""

from experiments.contact import closed_forms, derivatives, limits, order
from experiments.parts import run_experiment
from experiments.report import Report

PARTS = closed_forms, order, derivatives, limits


def run(report: Report, fast: bool):
    """All parts."""
    run_experiment(report, PARTS, fast)
