"""Humanoids of the package dm_control in the air, beside MuJoCo."""

from experiments.report import Report
from experiments.robots import costs


def run(report: Report, fast: bool) -> dict:
    """Times of steps and of first calls; why not, where they are skipped."""
    return costs.humanoids(report, fast)
