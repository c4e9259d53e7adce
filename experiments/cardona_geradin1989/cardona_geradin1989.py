"""Cardona and Geradin (1989): the figures on constraints, and the same without iterations, drift and damping."""

from experiments.cardona_geradin1989 import (
    drift,
    formulations,
    infinity,
    mechanisms,
    pendulum,
    squeezer,
    top,
    work_precision,
)
from experiments.parts import run_experiment
from experiments.report import Report

PARTS = infinity, pendulum, formulations, drift, mechanisms, squeezer, work_precision, top


def run(report: Report, fast: bool):
    """All parts."""
    run_experiment(report, PARTS, fast)
