"""Error against time, linear solves, of gradients and of batches: our steppers beside ten other packages."""

from experiments.parts import earlier, rounded
from experiments.report import Report
from experiments.work_precision import batches, choices, gradients, runs

PARTS = runs, gradients, batches, choices


def run(report: Report, fast: bool):
    """All cases, then the gradients, batches, and what is chosen for each case."""
    before = earlier(report, runs) if report.parts else None
    numbers = dict(before or {})
    for part in PARTS:
        if not report.parts or part.__name__.rpartition(".")[2] in report.parts:
            numbers |= part.run(report, fast)
    report.numbers(rounded(numbers), before)
