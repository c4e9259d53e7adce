"""Speed, as ratios within one run: against C, by structure, of batches and gradients, of chains, of compilation."""

from experiments.benchmarks import against_c, batches, chains, compile_time, gradients, many_unknowns, structure
from experiments.benchmarks.measure import machine
from experiments.parts import run_experiment
from experiments.report import Report

GROUPS = [against_c, structure, batches, many_unknowns], [gradients, chains, compile_time]  # two processes if fast


def run(report: Report, fast: bool):
    """All parts."""
    found = machine()
    for name, value in found.items():
        print(f"{name:<16}{value}", flush=True)
    run_experiment(report, GROUPS, fast, found)
