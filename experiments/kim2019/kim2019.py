"""Kim et al. (2019): every table and figure beside the printed values, and what the paper does not say."""

import math
import os

import jax

from experiments.kim2019 import alpha, arm, linear, order, repaired, splitting, stability, tables, timing, vehicle
from experiments.report import Report

PARTS = {
    "stability": stability,
    "linear": linear,
    "tables": tables,
    "timing": timing,
    "alpha": alpha,
    "order": order,
    "repaired": repaired,
    "splitting": splitting,
    "vehicle": vehicle,
    "arm": arm,
}


def rounded(x):
    """Floats to seven digits, which keeps the committed JSON small; None for those that are not finite."""
    if isinstance(x, dict):
        return {key: rounded(value) for key, value in x.items()}
    if isinstance(x, (list, tuple)):
        return [rounded(value) for value in x]
    if isinstance(x, float):
        return float(f"{x:.7g}") if math.isfinite(x) else None
    return x


def run(report: Report, fast: bool):
    """All parts, one after the other; README.md beside this file is made from the JSON by `page`."""
    numbers: dict = {"machine": f"{os.cpu_count()} cores ({jax.devices()[0].device_kind}), jax {jax.__version__}"}
    for name, part in PARTS.items():
        report.progress(f"part {name}: {(part.__doc__ or '').splitlines()[0]}")
        numbers[name] = part.run(report, fast)
    report.numbers(rounded(numbers))
