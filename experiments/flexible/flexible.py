"""Flexible bodies of many elements: what a step costs, beside C and exudyn; scenes with known answers; a fit.

Beams, cables, lattices and chains of rods are put together by `hhtjax.System.from_elements`. Each part says more.
"""

from experiments.flexible import accuracy, material, scaling, scenes
from experiments.parts import run_experiment
from experiments.report import Report

PARTS = (scaling, scenes, accuracy, material)


def run(report: Report, fast: bool):
    """All parts."""
    run_experiment(report, PARTS, fast)
