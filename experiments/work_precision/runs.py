"""Error against time and linear solves: our steppers, diffrax, SciPy, MuJoCo and exudyn."""

import importlib.metadata
import importlib.util

from experiments.benchmarks.measure import machine
from experiments.work_precision import diffrax_peers, engines, ours, scipy_peers
from experiments.work_precision.cases import cases, reference
from experiments.work_precision.figures import draw
from experiments.work_precision.timing import LONGEST, lines, show, times

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


def run(report, fast):
    """All cases."""
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
    charts = lines(rows)
    if not fast:
        draw(report, charts, names)
    return {
        "machine": found,
        "versions": {name: importlib.metadata.version(name) for name in ("scipy", *installed)},
        "not_installed": missing,
        "longest_s": LONGEST,
        "times": summary,
        "lines": charts,
    }
