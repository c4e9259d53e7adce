"""Contacts that rest, stick, slide, let go and land: order, formulas, derivatives, fits, gaps, cost, other ways."""

from experiments.contact import closed_forms, cost, derivatives, films, limits, order, parameters, peers
from experiments.parts import run_experiment
from experiments.report import Report

PARTS = films, closed_forms, order, peers, derivatives, parameters, limits, cost


def run(report: Report, fast: bool):
    """All parts."""
    run_experiment(report, PARTS, fast)
