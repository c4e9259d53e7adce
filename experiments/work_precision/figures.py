"""The charts: error against time, against factorised matrices, and the gradient's error against time.

`python -m experiments.work_precision.figures` draws them again from the committed numbers.
"""

import json
import textwrap
from pathlib import Path

import numpy as np

from experiments.report import COLOURS, MARKERS, Report
from hhtjax.plot import subplots, work_precision

WORST = 10  # error beyond which a run is not drawn
PACKAGES = (
    *("ours", "diffrax", "SciPy", "MuJoCo", "exudyn", "heyoka", "numbalsoda", "CasADi", "sksundae", "diffsol"),
    "Drake",
)
SHOWN = {  # of a package: the methods that are drawn, where the page has all of them
    "ours": (
        *("hht", "hht, extrapolate=2", "rowda", "rodas5p", "tsit5"),
        *(f"{x}, adaptive" for x in ("hht", "extrapolated", "rodas5p", "tsit5", "dop853", "taylor")),
    ),
    "diffrax": ("diffrax Tsit5, PID", "diffrax Kvaerno5, PID"),
    "SciPy": ("SciPy LSODA, C rhs", "SciPy LSODA, jitted rhs"),
    "MuJoCo": ("MuJoCo implicitfast", "MuJoCo RK4"),
    "exudyn": ("exudyn generalised alpha",),
    "heyoka": ("heyoka Taylor",),
    "numbalsoda": ("numbalsoda LSODA", "numbalsoda DOP853"),
    "CasADi": ("CasADi CVODES",),
    "sksundae": ("sksundae CVODE BDF",),
    "diffsol": ("diffsol tsit45", "diffsol bdf"),
    "Drake": ("Drake Radau3",),
}

BOTH = "forward", "reverse"
GRADIENTS = {
    "ours": tuple(
        f"{method}, {mode}"
        for method in (
            "hht, predictor",
            "hht, extrapolate=2",
            "rodas5p",
            "rodas5p, adaptive",
            "rk4",
            "taylor, adaptive",
        )
        for mode in BOTH
    ),
    "diffrax": tuple(f"diffrax {solver}, {mode}" for solver in ("Tsit5", "Kvaerno3", "Kvaerno5") for mode in BOTH),
    "SciPy": ("SciPy LSODA, differences",),
    "heyoka": ("heyoka Taylor, forward",),
    "CasADi": ("CasADi CVODES, forward",),
}

# colour and marker of each method of ours: Okabe and Ito's colours, with error control Tol's muted ones
OURS = {
    "hht": ("#0072B2", "o"),
    "hht, predictor": ("#0072B2", "o"),
    "hht, extrapolate=2": ("#56B4E9", "s"),
    "rowda": ("#009E73", "^"),
    "rodas5p": ("#D55E00", "D"),
    "tsit5": ("#E69F00", "v"),
    "rk4": ("#E69F00", "v"),
    "hht, adaptive": ("#332288", "P"),
    "extrapolated, adaptive": ("#CC79A7", "X"),
    "rodas5p, adaptive": ("#882255", "*"),
    "tsit5, adaptive": ("#999933", "o"),
    "dop853, adaptive": ("#44AA99", "s"),
    "taylor, adaptive": ("#000000", "^"),
}
THEIRS = {
    **dict(zip(PACKAGES[1:5], COLOURS[1:5], strict=True)),
    **{"heyoka": "#e7298a", "numbalsoda": "#8c2d04", "CasADi": "#6a51a3", "sksundae": "#b279d6"},
    **{"diffsol": "#1b7837", "Drake": "#a6761d"},
}


def kind(method):
    """The method without the mode of its gradient."""
    return method.removesuffix(", forward").removesuffix(", reverse")


def style(package, method, number):
    """Colour and marker by method, of others by package and its number there; hollow for a gradient in reverse mode."""
    line = {"ls": "-", "lw": 1.4} if package == "ours" else {"ls": "--", "lw": 0.9}
    theirs = THEIRS.get(package), MARKERS[(PACKAGES.index(package) + 3 * number) % len(MARKERS)]
    colour, marker = OURS[kind(method)] if package == "ours" else theirs
    hollow = {"mfc": "white"} if method.endswith(", reverse") else {}
    return line | {"color": colour, "marker": marker, "ms": 4} | hollow


def curves(lines, case, x, shown):
    """{package: {method: (work, errors, style)}}, in the order of their settings; times in ms."""
    found = {package: {} for package in PACKAGES}
    scale = 1e3 if x == "time_s" else 1
    for package in PACKAGES:
        methods = list(dict.fromkeys(line["method"] for line in lines if line["package"] == package))
        methods = [m for m in shown.get(package, ()) if m in methods]
        kinds = list(dict.fromkeys(map(kind, methods)))
        for method in methods:
            mine = [line for line in lines if (line["case"], line["method"]) == (case, method) and x in line]
            pairs = [pair for line in mine for pair in zip(line[x], line["rms_error"], strict=True)]
            points = [(scale * a, e) for a, e in pairs if a and e and e < WORST]
            if points:
                look = style(package, method, kinds.index(kind(method)))
                found[package][method] = (*np.array(points).T, look)
    return found


def front(panel, packages, label):
    """The least error that any of these methods reaches with that much work, in grey behind the curves."""
    points = [
        (a, e) for methods in packages for work, error, _ in methods.values() for a, e in zip(work, error, strict=True)
    ]
    if points:
        work, error = np.array(sorted(points)).T
        panel.step(work, np.minimum.accumulate(error), where="post", color="#bbbbbb", lw=3, zorder=1, label=label)


def panels(lines, names, x, xlabel, ylabel, shown):
    """A row for each case: our methods, then those of others, each with the best of the other side in grey.

    x: the key of the horizontal axis; shown: {package: methods}.
    """
    drawn, grid = subplots(len(names), 2, width=175, height=25 + 50 * len(names), squeeze=False, sharey="row")
    keys = {}, {}
    for row, name in zip(grid, names, strict=True):
        found = curves(lines, name, x, shown)
        ours, others = [found["ours"]], [found[package] for package in PACKAGES[1:]]
        for panel, mine, rest, label, key in zip(
            row, (ours, others), (others, ours), ("best of others", "best of ours"), keys, strict=True
        ):
            front(panel, rest, label)
            points = {method: (work, error) for methods in mine for method, (work, error, _) in methods.items()}
            looks = {method: look for methods in mine for method, (_, _, look) in methods.items()}
            if points:
                work_precision(points, lines=looks, xlabel="", ylabel="", key=False, ax=panel)
            handles, labels = panel.get_legend_handles_labels()
            key |= dict(zip(labels, handles, strict=True))
        unit = next((line["unit"] for line in lines if line["case"] == name and "unit" in line), "1")
        row[0].set_ylabel("\n".join([*textwrap.wrap(name, 26), ylabel.format(unit=unit)]))
        row[0].set_ylim(max(1e-12, row[0].get_ylim()[0]), row[0].get_ylim()[1])
    for panel in grid[-1]:
        panel.set_xlabel(xlabel)
    key = keys[0] | keys[1]
    drawn.legend(key.values(), key.keys(), loc="outside upper center", ncols=4 if max(map(len, key)) < 22 else 3)
    return drawn


def draw(report, lines, names):
    """The figures of runs."""
    counted = {package: [m for m in methods if "Kvaerno" not in m] for package, methods in SHOWN.items()}
    error = "RMS error ({unit})"
    for i, some in enumerate(filter(None, (names[:4], names[4:])), 1):
        report.figure(f"work_precision_time_{i}", panels(lines, some, "time_s", "time of a run (ms)", error, SHOWN))
        report.figure(
            f"work_precision_solves_{i}", panels(lines, some, "solves", "factorised matrices", error, counted)
        )


def gradient_figures(names):
    """{name of a figure: scenes}."""
    return {
        name: some
        for name, some in {"work_precision_gradients": names[:4], "work_precision_gradients_2": names[4:]}.items()
        if some
    }


def draw_gradients(report, lines, names):
    """The figures of gradients."""
    for name, some in gradient_figures(names).items():
        label = "time of value and gradient (ms)"
        report.figure(name, panels(lines, some, "time_s", label, "relative error", GRADIENTS))


def redraw(here: Path):
    """The figures of the numbers in a folder, into it."""
    numbers, report = json.loads((here / "work_precision.json").read_text()), Report("work_precision", here)
    draw(report, numbers["lines"], list(numbers["times"]))
    draw_gradients(report, numbers["gradient_lines"], list(numbers["gradient_times"]))


if __name__ == "__main__":
    redraw(Path(__file__).parent)
