"""The charts of this page."""

from __future__ import annotations

from typing import Any

import numpy as np

from experiments.report import COLOURS, MARKERS
from hhtjax.plot import legend, subplots

STYLES = {
    way: {"color": COLOURS[i], "marker": MARKERS[i], "ms": 4, "lw": 1.2}
    for i, way in enumerate(
        ["elements", "banded", "dense", "C, plain", "C, two-sided, vectorised", "exudyn, full Newton",
         "exudyn, modified Newton"]
    )
}  # fmt: skip
STYLES["factor and solve, SciPy's order"] = STYLES["C, plain"]
STYLES["factor and solve, our order"] = STYLES["C, two-sided, vectorised"]
NAMES = {"elements": "hhtjax, elements", "banded": "hhtjax, banded(p)", "dense": "hhtjax, dense"}


def scaling(report: Any, rows: list[dict]) -> None:
    """Time per step and unknown against unknowns, a panel for each scene."""
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    figure, panels = subplots(2, 3, width=180, height=125)
    flat = panels.ravel()
    handles: dict = {}
    for axes, scene in zip(flat, scenes, strict=False):
        mine = [row for row in rows if row["scene"] == scene]
        for way in dict.fromkeys(row["way"] for row in mine):
            points = [(row["unknowns"], row["ns_per_step_and_unknown"]) for row in mine if row["way"] == way]
            (line,) = axes.loglog(*zip(*points, strict=True), **STYLES[way])
            handles.setdefault(NAMES.get(way, way), line)
        axes.set(xlabel="unknowns", ylabel="ns per step and unknown", title=scene)
    flat[-1].axis("off")
    names = list(handles)
    flat[-1].legend([handles[name] for name in names], names, loc="center left", fontsize=7, frameon=False)
    report.figure("flexible_scaling", figure)
