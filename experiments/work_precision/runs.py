"""Error against time, linear solves, and of gradients: our steppers, diffrax, SciPy, MuJoCo and exudyn."""

import importlib.metadata
import importlib.util

from experiments.benchmarks.measure import machine
from experiments.parts import rounded
from experiments.report import Report
from experiments.work_precision import diffrax_peers, engines, gradients, ours, scipy_peers
from experiments.work_precision.cases import cases, reference
from experiments.work_precision.figures import draw
from experiments.work_precision.timing import LONGEST, lines, time_to

PEERS = "diffrax", "mujoco", "exudyn"
PRIMARY = "stiff double pendulum"  # every method and every kind of step-size control
ELSEWHERE = "hht", "hht, converged", "hht, extrapolate=2", "hht, extrapolate=3", "rowda", "rk4"
CHAINS = (
    "free double pendulum",
    PRIMARY,
    "stiff chain of 8",
)  # which MuJoCo and exudyn can have; with the reactions of all joints
UNLIKE = {  # what compiles for long is left out
    "stiff chain of 8": ("hht", "hht, converged", "hht, extrapolate=2", "rowda", "rk4"),
    "squeezer": ("hht", "hht, converged", "hht, extrapolate=2", "rk4"),
}
UNCONTROLLED = {"squeezer": ("hht, adaptive", "dopri5, adaptive")}  # rowda compiles for minutes there
SIZES = tuple(2**n for n in range(12))
LEVELS = 1e-2, 1e-3, 1e-4, 1e-6, 1e-8


def measure(report, name, fast, installed):
    """Rows of all methods on a case."""
    if fast:
        rows = ours.entries(name, (1, 4), ("hht", "rk4"))
        rows += ours.controlled_entries(name, ours.TOLERANCES[:2], ("dopri5, adaptive",))
        return rows + scipy_peers.entries(name, scipy_peers.TOLERANCES[:2], ("LSODA",))
    primary = name == PRIMARY
    rows = ours.entries(name, SIZES, None if primary else UNLIKE.get(name, ELSEWHERE))
    rows += ours.controlled_entries(name, only=UNCONTROLLED.get(name, tuple(ours.CONTROLLED)))
    report.progress(f"{name}: ours")
    rows += scipy_peers.entries(name)
    if "diffrax" in installed:
        rows += diffrax_peers.entries(name, primary)
    if name in CHAINS and "mujoco" in installed:
        rows += engines.mujoco_entries(name)
    if name in CHAINS and "exudyn" in installed:
        rows += engines.exudyn_entries(name)
    report.progress(f"{name}: the others")
    return rows


def times(rows):
    """[{method, package, time to each level}] of one case."""
    found = []
    for method in dict.fromkeys(r["method"] for r in rows):
        mine = [r for r in rows if r["method"] == method]
        found.append(
            {
                "method": method,
                "package": mine[0]["package"],
                "time_s": {f"{level:g}": time_to(mine, level) for level in LEVELS},
            }
        )
    return found


def show(report, entries):
    """Times in ms."""
    rows = [[e["method"], *("-" if t is None else 1e3 * t for t in e["time_s"].values())] for e in entries]
    report.table(["method", *(f"{level:g}" for level in LEVELS)], rows)


def run(report: Report, fast: bool):
    """All cases, then the gradients."""
    installed = [name for name in PEERS if importlib.util.find_spec(name)]
    missing = [name for name in PEERS if name not in installed]
    if missing:
        print(f"Not installed, and left out: {', '.join(missing)}.", flush=True)
    found = machine()
    names = ["forced Duffing"] if fast else list(cases())
    rows, summary = [], {}
    for name in names:
        reference(name)
        unit = cases()[name].unit
        mine = [{**r, "unit": unit} for r in measure(report, name, fast, installed)]
        summary[name] = times(mine)
        rows += mine
        print(f"{name}: ms to an RMS error ({unit}) of")
        show(report, summary[name])
    scenes = ["forced Duffing"] if fast else list(gradients.SCENES)
    gradient_rows = gradients.entries(scenes, fast, installed)
    gradient_summary = {name: times([r for r in gradient_rows if r["case"] == name]) for name in scenes}
    for name in scenes:
        print(f"{name}: ms to a relative error of the gradient of")
        show(report, gradient_summary[name])
    charts, gradient_charts = lines(rows), lines(gradient_rows)
    if not fast:
        draw(report, charts, names, gradient_charts, scenes)
    numbers = {
        "machine": found,
        "versions": {name: importlib.metadata.version(name) for name in ("scipy", *installed)},
        "not_installed": missing,
        "longest_s": LONGEST,
        "times": summary,
        "gradient_times": gradient_summary,
        "lines": charts,
        "gradient_lines": gradient_charts,
    }
    report.numbers(rounded(numbers))
