"""Robots: accuracy against steps and time beside MuJoCo and exudyn; loops, long chains, gradients, humanoids.

Mechanisms of `hhtjax.bodies`, and the same as MJCF and as a tree of exudyn: a peer is run where its accelerations at
the start are ours to 1e-8. Four parts, of which `--parts accuracy,costs` runs some.
"""

import numpy as np

from experiments.parts import run_experiment
from experiments.report import COLOURS, MARKERS, Report
from experiments.results import read
from experiments.robots import accuracy, costs, humanoids, loops
from hhtjax.plot import subplots

PARTS = [accuracy, costs, loops, humanoids]
METHODS = [  # in the figures, and with colours that stay
    "hht", "MuJoCo RK4", "MuJoCo implicitfast", "MuJoCo implicit", "MuJoCo discrete", "exudyn generalized alpha",
    "exudyn trapezoidal, index 2", "MuJoCo implicitfast, stiffest loop",
]  # fmt: skip


def run(report: Report, fast: bool):
    """All parts, their figures and numbers."""
    run_experiment(report, PARTS, fast)
    numbers = read(report.out / f"{report.name}.json") or {}
    cases = numbers["accuracy"]["cases"]
    report.figure("robots_time", errors(cases, "time_s"))
    report.figure("robots_steps", errors(cases, "h_s"))


def errors(cases: list, over: str):
    """Error against the step size ("h_s") or the time of a run ("time_s"), a panel for each case."""
    columns = 2
    rows = -(-(len(cases) + 1) // columns)
    figure, axes = subplots(rows, columns, width=150, height=46 * rows)
    panels = np.ravel(axes)
    for panel, case in zip(panels, cases, strict=False):
        for name in METHODS:
            if name in case["methods"]:
                x = case["methods"][name]
                error = np.array([np.nan if e is None else e for e in x["error_rad"]], float)
                panel.loglog(1e3 * np.array(x[over], float), error, **style(name))
        panel.set(xlabel="time of a run (ms)" if over == "time_s" else "step size (ms)", ylabel="largest error (rad)")
        panel.set_title(
            case["case"].replace("flexible joints, ", "flexible joints: ").replace(" N m/rad", ""), fontsize=7
        )
        found = [e for x in case["methods"].values() for e in x["error_rad"] if e]
        panel.set_ylim(max(min(found) / 3, 1e-12), min(10.0, 3 * max(found)))
        panel.grid(alpha=0.25, lw=0.5)
    legend = panels[len(cases)]
    for name in METHODS:
        if any(name in case["methods"] for case in cases):
            legend.plot([], [], label=name, **style(name))
    legend.legend(loc="center", fontsize=7, frameon=False)
    for panel in panels[len(cases) :]:
        panel.set_axis_off()
    return figure


def style(name: str) -> dict:
    """Of a method's line: what others cover is thick, and behind them."""
    i = METHODS.index(name)
    thick = {"hht": 2.5, "MuJoCo implicitfast": 2.2, "MuJoCo implicit": 1.4, "exudyn generalized alpha": 1.8}
    return {"color": COLOURS[i], "marker": MARKERS[i], "ms": 2.5, "lw": thick.get(name, 0.9), "zorder": 2 + i / 10}
