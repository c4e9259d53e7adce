"""An experiment in parts, one after the other.

A part is a module with `run(report, fast)`, which returns its numbers.
"""

import math
import os
from pathlib import Path
from typing import Any

import jax

from experiments.results import read


def rounded(x) -> Any:
    """Floats to seven digits, which keeps the committed JSON small; None for those that are not finite."""
    if isinstance(x, dict):
        return {key: rounded(value) for key, value in x.items()}
    if isinstance(x, (list, tuple)):
        return [rounded(value) for value in x]
    if isinstance(x, float):
        return float(f"{x:.7g}") if math.isfinite(x) else None
    return x


def run_parts(report, modules, fast):
    """{part: its numbers}."""
    numbers = {}
    for module in modules:
        name = module.__name__.rpartition(".")[2]
        report.progress(f"part {name}: {(module.__doc__ or '').splitlines()[0]}")
        numbers[name] = module.run(report, fast)
    return numbers


def earlier(report, module) -> dict:
    """The numbers in the folder of the run, otherwise those beside the experiment; none where there are neither."""
    places = report.out, Path(module.__file__).parent
    return next((x for place in places if (x := read(place / f"{report.name}.json"))), {})


def run_experiment(report, parts, fast, machine: Any = None):
    """All parts, one after the other: times are undisturbed, and they share what they compile.

    machine: what it is run on; by default in a few words.
    Where the report names parts, these alone are run, and their numbers put into those of the run before, or the
    committed ones.
    """
    if report.parts:
        before = earlier(report, parts[0])
        chosen = [part for part in parts if part.__name__.rpartition(".")[2] in report.parts]
        report.numbers(rounded(before | run_parts(report, chosen, fast)), before)
        return
    words = f"{os.cpu_count()} cores ({jax.devices()[0].device_kind}), jax {jax.__version__}"
    report.numbers(rounded({"machine": words if machine is None else machine} | run_parts(report, parts, fast)))
