"""Error against time and linear solves: our steppers beside ten other packages."""

import importlib.metadata
import importlib.util

from experiments.benchmarks.measure import machine
from experiments.work_precision import compiled_peers, diffrax_peers, drake_peers, engines, ours, scipy_peers
from experiments.work_precision.cases import cases, reference
from experiments.work_precision.figures import draw
from experiments.work_precision.timing import LONGEST, lines, show, times

PEERS = {  # module: its distribution
    **{name: name for name in ("diffrax", "mujoco", "exudyn", "heyoka", "numbalsoda", "casadi")},
    **{"sksundae": "scikit-sundae", "pydiffsol": "pydiffsol", "pydrake": "drake"},
}
NEEDS = {"sksundae": ("numba",)}  # which compiles its right-hand side
PRIMARY = "stiff double pendulum"  # every method and every kind of step-size control
ELSEWHERE = "hht", "hht, converged", "hht, extrapolate=2", "hht, extrapolate=3", "rowda", "rodas5p", "rk4", "tsit5"
CHAINS = (
    "free double pendulum",
    PRIMARY,
    "stiff chain of 8",
)  # which MuJoCo, exudyn and Drake can have; with the reactions of all joints
ENGINES = {
    "mujoco": engines.mujoco_entries,
    "exudyn": engines.exudyn_entries,
    "pydrake": drake_peers.drake_entries,
}
UNLIKE = {  # what compiles for long is left out
    "stiff chain of 8": ("hht", "hht, converged", "hht, extrapolate=2", "rowda", "rodas5p", "rk4"),
    "squeezer": ("hht", "hht, converged", "hht, extrapolate=2", "rodas5p", "rk4", "tsit5"),
}
UNCONTROLLED = {  # what compiles for long is left out
    "squeezer": tuple(x for x in ours.CONTROLLED if x.split(",")[0] not in ("rowda", "dopri5"))
}
SIZES = tuple(2**n for n in range(12))


def installed():
    """Modules of the peers that are there."""
    return [name for name in PEERS if all(map(importlib.util.find_spec, (name, *NEEDS.get(name, ()))))]


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
    for module, entries in compiled_peers.ENTRIES.items():
        rows += entries(name) if module in installed else []
    for module, entries in ENGINES.items():
        rows += entries(name) if module in installed and name in CHAINS else []
    report.progress(f"{name}: the others")
    return rows


def run(report, fast):
    """All cases."""
    found, there = machine(), installed()
    missing = [distribution for module, distribution in PEERS.items() if module not in there]
    if missing:
        print(f"Not installed, and left out: {', '.join(missing)}.", flush=True)
    names = ["forced Duffing"] if fast else list(cases())
    rows, summary = [], {}
    for name in names:
        reference(name)
        unit = cases()[name].unit
        mine = [{**r, "unit": unit} for r in measure(report, name, fast, there)]
        summary[name] = times(mine)
        rows += mine
        print(f"{name}: ms to an RMS error ({unit}) of")
        show(report, summary[name])
    charts = lines(rows)
    if not fast:
        draw(report, charts, names)
    return {
        "machine": found,
        "versions": {name: importlib.metadata.version(name) for name in ("scipy", *(PEERS[x] for x in there))},
        "not_installed": missing,
        "longest_s": LONGEST,
        "calls_s": ours.calls(PRIMARY if not fast else names[0]),
        "times": summary,
        "lines": charts,
    }
