"""Speed, as ratios within one run: against C, by structure, of batches, gradients, chains, first and later calls."""

from experiments.benchmarks import (
    accelerator,
    against_c,
    batches,
    calls,
    chains,
    compile_time,
    first_call,
    gradients,
    many_unknowns,
    structure,
)
from experiments.benchmarks.measure import machine
from experiments.parts import run_experiment
from experiments.report import Report

PARTS = against_c, structure, batches, many_unknowns, gradients, chains, compile_time, first_call, calls
ON_ACCELERATOR = (accelerator,)  # --gpu: on another machine than the rest


def run(report: Report, fast: bool):
    """All parts."""
    found = machine()
    for name, value in found.items():
        print(f"{name:<16}{value}", flush=True)
    run_experiment(report, PARTS + ON_ACCELERATOR if report.parts else PARTS, fast, found)
