"""Error against time, linear solves, and of gradients: our steppers, diffrax, SciPy, MuJoCo and exudyn."""

from experiments.parts import earlier, rounded
from experiments.report import Report
from experiments.work_precision import gradients, runs

PARTS = runs, gradients


def run(report: Report, fast: bool):
    """All cases, then the gradients."""
    before = earlier(report, runs) if report.parts else None
    numbers = dict(before or {})
    for part in PARTS:
        if not report.parts or part.__name__.rpartition(".")[2] in report.parts:
            numbers |= part.run(report, fast)
    report.numbers(rounded(numbers), before)
