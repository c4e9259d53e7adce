"""Kim et al. (2019): every table and figure beside the printed values, and what the paper does not say."""

from experiments.kim2019 import alpha, arm, linear, order, repaired, splitting, stability, tables, timing, vehicle
from experiments.parts import run_experiment
from experiments.report import Report

PARTS = stability, linear, order, splitting, tables, alpha, repaired, timing, vehicle, arm


def run(report: Report, fast: bool):
    """All parts."""
    run_experiment(report, PARTS, fast)
