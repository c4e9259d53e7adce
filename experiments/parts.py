"""An experiment in parts: one after the other, or, in the smoke run, groups of them in processes side by side.

A part is a module with `run(report, fast)`, which returns its numbers.
"""

import importlib
import io
import math
import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor
from contextlib import redirect_stdout
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


def run_group(report, names):
    """The same in a process of its own, fast: numbers, what it printed, and the files it wrote."""
    with redirect_stdout(io.StringIO()) as text:
        numbers = run_parts(report, map(importlib.import_module, names), fast=True)
    return numbers, text.getvalue(), report.written


def run_experiment(report, groups, fast, machine: Any = None):
    """All parts: one after the other, so that times are undisturbed; the smoke run in as many processes as cores.

    groups: lists of parts that share what they compute. machine: what it is run on; by default in a few words.
    Where the report names parts, these alone are run, and their numbers put into those of the run before, or the
    committed ones.
    """
    if report.parts:
        before = earlier(report, groups[0][0])
        chosen = [part for group in groups for part in group if part.__name__.rpartition(".")[2] in report.parts]
        report.numbers(rounded(before | run_parts(report, chosen, fast)), before)
        return
    words = f"{os.cpu_count()} cores ({jax.devices()[0].device_kind}), jax {jax.__version__}"
    numbers: dict = {"machine": words if machine is None else machine}
    if fast:
        names = [[module.__name__ for module in group] for group in groups]
        with ProcessPoolExecutor(os.cpu_count(), multiprocessing.get_context("spawn")) as pool:
            for found, text, written in pool.map(run_group, [report] * len(names), names):
                numbers |= found
                report.written += written
                print(text, end="")
    else:
        numbers |= run_parts(report, [module for group in groups for module in group], fast)
    report.numbers(rounded(numbers))
