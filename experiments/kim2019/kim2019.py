"""Kim et al. (2019): every table and figure beside the printed values, and what the paper does not say."""

import io
import math
import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor
from contextlib import redirect_stdout

import jax

from experiments.kim2019 import alpha, arm, linear, order, repaired, splitting, stability, tables, timing, vehicle
from experiments.report import Report

PARTS = {
    "stability": stability,
    "linear": linear,
    "order": order,
    "splitting": splitting,
    "tables": tables,
    "alpha": alpha,
    "repaired": repaired,
    "timing": timing,
    "vehicle": vehicle,
    "arm": arm,
}
GROUPS = (
    list(PARTS)[:4],
    list(PARTS)[4:8],
    ["vehicle"],
    ["arm"],
)  # a process each in the smoke run; tables' share runs


def rounded(x):
    """Floats to seven digits, which keeps the committed JSON small; None for those that are not finite."""
    if isinstance(x, dict):
        return {key: rounded(value) for key, value in x.items()}
    if isinstance(x, (list, tuple)):
        return [rounded(value) for value in x]
    if isinstance(x, float):
        return float(f"{x:.7g}") if math.isfinite(x) else None
    return x


def run_parts(report, names, fast):
    """{part: its numbers}."""
    numbers = {}
    for name in names:
        report.progress(f"part {name}: {(PARTS[name].__doc__ or '').splitlines()[0]}")
        numbers[name] = PARTS[name].run(report, fast)
    return numbers


def run_group(report, names):
    """The same in a process of its own, fast: numbers, what it printed, and the files it wrote."""
    with redirect_stdout(io.StringIO()) as text:
        numbers = run_parts(report, names, fast=True)
    return numbers, text.getvalue(), report.written


def run(report: Report, fast: bool):
    """All parts: one after the other, so that times are undisturbed; the smoke run in as many processes as cores."""
    numbers: dict = {"machine": f"{os.cpu_count()} cores ({jax.devices()[0].device_kind}), jax {jax.__version__}"}
    if fast:
        with ProcessPoolExecutor(os.cpu_count(), multiprocessing.get_context("spawn")) as pool:
            for found, text, written in pool.map(run_group, [report] * len(GROUPS), GROUPS):
                numbers |= found
                report.written += written
                print(text, end="")
    else:
        numbers |= run_parts(report, PARTS, fast)
    report.numbers(rounded(numbers))
