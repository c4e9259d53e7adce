"""The charts of this page."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.ticker import NullFormatter

from experiments.report import COLOURS, MARKERS
from hhtjax.plot import legend, subplots

STYLES = {
    way: {"color": COLOURS[i], "marker": MARKERS[i], "ms": 4, "lw": 1.2}
    for i, way in enumerate(
        ["elements", "banded", "dense", "C, plain", "C, two-sided, vectorised", "exudyn, full Newton",
         "exudyn, modified Newton"]
    )
}  # fmt: skip
STYLES["factor and solve, SciPy's order"] = {"color": COLOURS[7], "marker": "*", "ms": 5, "lw": 1.2}
STYLES["factor and solve, our order"] = STYLES["factor and solve, SciPy's order"] | {"ls": "--", "mfc": "white"}
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
        found = np.log10([row["ns_per_step_and_unknown"] for row in mine])
        axes.set(xlabel="unknowns", ylabel="ns per step and unknown", title=scene)
        axes.set_ylim(10 ** np.floor(found.min()), 10 ** np.ceil(found.max()))
        axes.xaxis.set_minor_formatter(NullFormatter())
    flat[-1].axis("off")
    names = list(handles)
    flat[-1].legend([handles[name] for name in names], names, loc="center left", fontsize=7, frameon=False)
    report.figure("flexible_scaling", figure)


def scenes(report: Any, drawn: dict) -> None:
    """What moves, a panel for each scene."""
    figure, panels = subplots(2, 3, width=180, height=125)
    a, b, c, d, e, f = panels.ravel()
    path = drawn["spin_up"]
    a.plot(path["t_s"], path["lag_m"], color=COLOURS[0])
    a.set(xlabel="time (s)", ylabel="lag of the tip (m)", title="spin-up")
    b.plot(*drawn["at_rest"]["shape"]["r"].T, color=COLOURS[0])
    b.plot([0, 2], [0, 0], color="0.7", lw=1)
    b.set(xlabel="x (m)", ylabel="y (m)", title="cantilever of ANCF elements", aspect="equal")
    four_bar(c, drawn["flexible_four_bar"])
    bend = drawn["flexible_four_bar"]
    for i, name in enumerate(("crank", "coupler", "rocker")):
        d.plot(bend["t_s"], 1e3 * bend["deflections_m"][i], color=COLOURS[i], label=name, lw=1)
    d.set(xlabel="time (s)", ylabel="bend of the middle (mm)", title="four-bar: deflections")
    d.legend(loc="upper left", fontsize=7)
    path = drawn["rope"]
    shades = np.linspace(0.15, 1, min(9, len(path["t_s"])))
    for i, shade in zip(np.linspace(0, len(path["t_s"]) - 1, len(shades)).astype(int), shades, strict=True):
        e.plot(*path["r_m"][i].T, color=COLOURS[0], alpha=shade, lw=1)
    e.set(xlabel="x (m)", ylabel="y (m)", title="cable, later is darker", aspect="equal")
    path = drawn["struck"]
    speed = np.linalg.norm(path["v_m_per_s"][-1], axis=1).reshape(path["side"], path["side"])
    image = f.imshow(np.log10(np.maximum(speed, 1e-4)), origin="lower", cmap="cividis", vmin=-3, vmax=0.5)
    f.grid(False)
    f.set(xlabel="x (m)", ylabel="y (m)", title=f"lattice after {path['t_s'][-1]:.2g} s")
    figure.colorbar(image, ax=f, label="log10 of the speed (m/s)", shrink=0.8)
    report.figure("flexible_scenes", figure)


def four_bar(axes: Any, path: dict, moments: int = 5) -> None:
    """Its places at a few times."""
    number, r = path["number"], path["r_m"]
    last = len(r) - 1
    for k, i in enumerate(np.linspace(0 if last < 20 else last - 40, last, moments).astype(int)):
        for link in range(3):
            own = r[i, link * (number + 1) : (link + 1) * (number + 1)]
            axes.plot(*own.T, color=COLOURS[link], lw=1.2, alpha=0.25 + 0.75 * k / (moments - 1))
    axes.plot([0, 1], [0, 0], "k^", ms=5)
    axes.set(xlabel="x (m)", ylabel="y (m)", title="four-bar, later is darker", aspect="equal")


def slider_crank(report: Any, points: list[dict]) -> None:
    """The error of its end against steps and time."""
    figure, (left, right) = subplots(1, 2, width=160, height=75, sharey=True)
    for i, way in enumerate(dict.fromkeys(row["way"] for row in points)):
        mine = [row for row in points if row["way"] == way]
        for axes, key, scale in ((left, "steps", 1), (right, "seconds", 1e3)):
            x = [scale * row[key] for row in mine]
            axes.loglog(x, [row["error"] for row in mine], color=COLOURS[i], marker=MARKERS[i], label=way)
    left.set(xlabel="steps", ylabel="largest error of the end (rad, m)")
    right.set(xlabel="time of a run (ms)")
    for axes in (left, right):
        axes.axhline(1e-6, color="0.6", ls=":", lw=0.8)
    legend(left)
    report.figure("flexible_slider_crank", figure)


def accuracy(report: Any, parts: dict[str, list[dict]]) -> None:
    """Error of the tip against seconds, a panel for each scene."""
    figure, panels = subplots(1, len(parts), width=170, height=85)
    names = list(dict.fromkeys(row["way"] for rows in parts.values() for row in rows))
    for axes, (scene, rows) in zip(np.atleast_1d(panels), parts.items(), strict=True):
        for i, way in enumerate(names):
            mine = [row for row in rows if row["way"] == way and row.get("tip_error_m")]
            if mine:
                x, y = [row["seconds"] for row in mine], [row["tip_error_m"] for row in mine]
                axes.loglog(x, y, color=COLOURS[i], marker=MARKERS[i], label=way)
        axes.set(xlabel="time of a run (s)", ylabel="error of the tip (RMS, m)", title=scene)
    entries = np.atleast_1d(panels)[0].get_legend_handles_labels()
    figure.legend(*entries, loc="outside lower center", ncols=5, fontsize=7)
    report.figure("flexible_accuracy", figure)


def material(report: Any, drawn: dict) -> None:
    """The record and its fit, what is left, and where the tip feels the stiffness."""
    figure, (left, middle, right) = subplots(1, 3, width=180, height=70)
    left.plot(drawn["t_s"], drawn["record_m"], ".", ms=2, color="0.6", label="record")
    left.plot(drawn["t_s"], drawn["fitted_m"], color=COLOURS[0], label="fit")
    left.plot(drawn["t_s"], drawn["start_m"], color=COLOURS[1], ls="--", lw=1, label="start")
    left.set(xlabel="time (s)", ylabel="height of the tip (m)")
    legend(left)
    x, y = drawn["ellipse"]
    middle.plot(x, 1e3 * y, color=COLOURS[0], label="95 %")
    middle.plot(drawn["fit"][0], 1e3 * drawn["fit"][1], "o", color=COLOURS[0], label="fit")
    middle.plot(drawn["truth"][0], 1e3 * drawn["truth"][1], "X", color=COLOURS[1], label="truth")
    middle.set(xlabel="EI (N m²)", ylabel="damping of the material (ms)")
    legend(middle)
    right.plot(drawn["places_m"], drawn["gradient"], color=COLOURS[2])
    right.set(xlabel="place of the element (m)", ylabel="slope of the last height in\nln EI of an element (mm)")
    report.figure("flexible_material", figure)
