"""A row of four-bar loops in one model, with redundant rows."""

from experiments.report import Report
from experiments.robots import costs


def run(report: Report, fast: bool) -> dict:
    """Its rows, gaps and times."""
    return costs.four_bars(report, fast)
