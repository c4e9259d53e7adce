"""Where every method fails, by scene, step size and numerical damping; who notices; long runs; peers."""

from experiments.parts import run_experiment
from experiments.report import Report
from experiments.stability import (
    adaptive,
    advice,
    constrained,
    controller,
    drift,
    dry,
    gallery,
    peers,
    reported,
    rotating,
    stops,
    tolerances,
)

PARTS = (
    *(gallery, reported, advice, adaptive, tolerances, controller),
    *(dry, stops, constrained, rotating, drift, peers),
)


def run(report: Report, fast: bool):
    """All parts."""
    run_experiment(report, PARTS, fast)
