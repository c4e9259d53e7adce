"""The charts: error against time, against factorised matrices, and the gradient's error against time."""

import matplotlib.pyplot as plt

from experiments.report import COLOURS, MARKERS

PACKAGES = "ours", "diffrax", "SciPy", "MuJoCo", "exudyn"
SHOWN = {  # of a package: the methods that are drawn, where the page has all of them
    "ours": ("hht", "hht, converged", "hht, extrapolate=2", "hht, extrapolate=3", "rowda", "rk4"),
    "diffrax": ("diffrax Tsit5, PID", "diffrax Kvaerno3, PID", "diffrax Kvaerno5, PID", "diffrax ImplicitEuler, PID"),
    "SciPy": (
        "SciPy LSODA, C rhs",
        "SciPy Radau, C rhs",
        "SciPy DOP853, C rhs",
        "SciPy LSODA, jitted rhs",
        "SciPy Radau, jitted rhs",
        "SciPy DOP853, jitted rhs",
    ),
    "MuJoCo": ("MuJoCo implicitfast", "MuJoCo RK4"),
    "exudyn": ("exudyn generalised alpha",),
}


def style(package, number):
    """Colour by package, marker by method."""
    line = {"ls": "-", "lw": 1.4} if package == "ours" else {"ls": "--", "lw": 0.9}
    return line | {"color": COLOURS[PACKAGES.index(package)], "marker": MARKERS[number % len(MARKERS)], "ms": 3.5}


def panels(rows, names, x, labels, ylabel, shown=None):
    """A panel for each case; x: the key of the horizontal axis."""
    columns = min(2, len(names))
    lines = -(-len(names) // columns)
    drawn, axes = plt.subplots(lines, columns, figsize=(4.6 * columns, 0.9 + 2.9 * lines), squeeze=False)
    legend = {}
    for name, panel in zip(names, axes.ravel(), strict=False):
        for package in PACKAGES:
            mine = [r for r in rows if r["case"] == name and r["package"] == package]
            methods = list(dict.fromkeys(r["method"] for r in rows if r["package"] == package))
            if shown is not None:
                methods = [m for m in shown[package] if m in methods]
            for i, method in enumerate(methods):
                points = [r for r in mine if r["method"] == method and r["rms_error"] and r.get(x)]
                if points:
                    scale = 1e3 if x == "time_s" else 1
                    (line,) = panel.loglog(
                        [scale * r[x] for r in points], [r["rms_error"] for r in points], **style(package, i)
                    )
                    legend.setdefault(method if package != "ours" else f"ours: {method}", line)
        unit = next((r["unit"] for r in rows if r["case"] == name and "unit" in r), "1")
        panel.set(title=name, xlabel=labels[x], ylabel=ylabel.format(unit=unit))
        panel.title.set_fontsize(9)
        panel.set_ylim(top=min(10, panel.get_ylim()[1]))
    for panel in axes.ravel()[len(names) :]:
        panel.set_axis_off()
    drawn.legend(legend.values(), legend.keys(), loc="outside lower center", ncols=4, fontsize=7.5)
    return drawn


LABELS = {"time_s": "time of a run (ms)", "solves": "factorised matrices"}


def draw(report, rows, names, gradient_rows, gradient_names):
    """All figures."""
    for i, some in enumerate((names[:4], names[4:]), 1):
        figure = panels(rows, some, "time_s", LABELS, "RMS error of the positions ({unit})", SHOWN)
        report.figure(f"work_precision_time_{i}", figure)
        counted = {package: [m for m in methods if "Kvaerno" not in m] for package, methods in SHOWN.items()}
        figure = panels(rows, some, "solves", LABELS, "RMS error of the positions ({unit})", counted)
        report.figure(f"work_precision_solves_{i}", figure)
    labels = LABELS | {"time_s": "time of value and gradient (ms)"}
    figure = panels(gradient_rows, gradient_names, "time_s", labels, "relative error of the gradient")
    report.figure("work_precision_gradients", figure)
