"""Error against time, linear solves, of gradients and of batches: our steppers beside ten other packages."""

from experiments.parts import earlier, rounded
from experiments.report import Report
from experiments.work_precision import batches, gradients, runs

PARTS = runs, gradients, batches


def run(report: Report, fast: bool):
    """All cases, then the gradients, and batches."""
    before = earlier(report, runs) if report.parts else None
    numbers = dict(before or {})
    for part in PARTS:
        if not report.parts or part.__name__.rpartition(".")[2] in report.parts:
            numbers |= part.run(report, fast)
    report.numbers(rounded(numbers), before)
