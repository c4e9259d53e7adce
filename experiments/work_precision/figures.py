"""The charts: error against time, against factorised matrices, and the gradient's error against time."""

import matplotlib.pyplot as plt

from experiments.report import COLOURS, MARKERS

PACKAGES = "ours", "diffrax", "SciPy", "MuJoCo", "exudyn"
SHOWN = {  # of a package: the methods that are drawn, where the page has all of them
    "ours": ("hht", "hht, converged", "hht, extrapolate=2", "hht, extrapolate=3", "rowda", "rk4"),
    "diffrax": ("diffrax Tsit5, PID", "diffrax Kvaerno3, PID", "diffrax Kvaerno5, PID"),
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


OURS = COLOURS[0], COLOURS[0], COLOURS[6], COLOURS[6], COLOURS[5], COLOURS[5]


def style(package, number):
    """Colour by package, of ours by kind; marker by method."""
    line = {"ls": "-", "lw": 1.4} if package == "ours" else {"ls": "--", "lw": 0.9}
    colour = OURS[number % len(OURS)] if package == "ours" else COLOURS[PACKAGES.index(package)]
    return line | {"color": colour, "marker": MARKERS[number % len(MARKERS)], "ms": 3.5}


def panels(lines, names, x, xlabel, ylabel, shown=None):
    """A panel for each case; x: the key of the horizontal axis; shown: {package: methods}, by default all."""
    columns = min(2, len(names))
    height = -(-len(names) // columns)
    drawn, axes = plt.subplots(height, columns, figsize=(4.6 * columns, 0.9 + 2.9 * height), squeeze=False, dpi=88)
    legend = {}
    for name, panel in zip(names, axes.ravel(), strict=True):
        for package in PACKAGES:
            methods = list(dict.fromkeys(line["method"] for line in lines if line["package"] == package))
            methods = methods if shown is None else [m for m in shown[package] if m in methods]
            for line in lines:
                if line["case"] != name or line["method"] not in methods or x not in line:
                    continue
                points = [(a, e) for a, e in zip(line[x], line["rms_error"], strict=True) if a and e]
                if points:
                    scale = 1e3 if x == "time_s" else 1
                    (drawn_line,) = panel.loglog(
                        [scale * a for a, _ in points],
                        [e for _, e in points],
                        **style(package, methods.index(line["method"])),
                    )
                    label = line["method"] if package != "ours" else f"ours: {line['method']}"
                    legend.setdefault(label, drawn_line)
            unit = next((line["unit"] for line in lines if line["case"] == name and "unit" in line), "1")
        panel.set(xlabel=xlabel, ylabel=ylabel.format(unit=unit))
        panel.set_title(name, fontsize=9)
        panel.set_ylim(max(1e-10, panel.get_ylim()[0]), min(10, panel.get_ylim()[1]))
    drawn.legend(legend.values(), legend.keys(), loc="outside lower center", ncols=4, fontsize=7.5)
    return drawn


def draw(report, lines, names, gradient_lines, gradient_names):
    """All figures."""
    counted = {package: [m for m in methods if "Kvaerno" not in m] for package, methods in SHOWN.items()}
    error = "RMS error of the positions ({unit})"
    for i, some in enumerate((names[:4], names[4:]), 1):
        report.figure(f"work_precision_time_{i}", panels(lines, some, "time_s", "time of a run (ms)", error, SHOWN))
        report.figure(
            f"work_precision_solves_{i}", panels(lines, some, "solves", "factorised matrices", error, counted)
        )
    label = "time of value and gradient (ms)"
    figure = panels(gradient_lines, gradient_names, "time_s", label, "relative error of the gradient")
    report.figure("work_precision_gradients", figure)
