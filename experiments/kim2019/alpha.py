"""What the paper does not say (1): its tables were computed with alpha = 0."""

import numpy as np

from experiments.kim2019 import pendulum, printed
from experiments.report import COLOURS, MARKERS
from hhtjax.plot import subplots

ALPHAS = pendulum.ALPHAS
COLUMNS = {"conventional HHT": 1, "non-iterative HHT": 2}


def run(report, fast):
    """|ours / printed - 1| against alpha for the entries that the paper's reference does not spoil."""
    numbers, rows = [], []
    for scene in ("free",) if fast else ("stiff", "free"):
        for method, column in COLUMNS.items():
            for i in (2, 3):  # h = 1e-2, 1e-1
                h = printed.STEP_SIZES[i]
                ours = pendulum.rms_errors(scene, method, h)[0]
                theirs = np.array([printed.read(scene, i, angle)[1][column] for angle in (0, 1)])
                deviation = np.max(abs(ours / theirs - 1), axis=1)  # of both angles
                numbers.append({"scene": scene, "method": method, "h_s": h, "deviation": deviation.tolist()})
                rows.append([scene, method, f"{h:g}", *deviation])
        report.progress(f"{scene} pendulum: {len(ALPHAS)} values of alpha")
    print("Deviation from the printed RMS errors, the larger of both angles, against alpha")
    report.table(["scene", "method", "h (s)", *(f"{alpha:g}" for alpha in ALPHAS)], rows)
    report.figure("kim2019_alpha_is_zero", figure(numbers))
    return {"alpha": list(ALPHAS), "entries": numbers}


def figure(numbers):
    """One line for each entry of the tables; alpha = 0 at the left edge."""
    drawn, axes = subplots(width=175, height=110)
    x = np.array([1e-4, *(-alpha for alpha in ALPHAS[1:])])
    for k, entry in enumerate(numbers):
        label = f"{entry['scene']}, {entry['method']}, h = {entry['h_s']:g} s"
        style = {"color": COLOURS[k], "marker": MARKERS[k], "ms": 4, "lw": 1, "label": label}
        axes.loglog(x, np.maximum(entry["deviation"], 1e-6), **style)
    axes.set_xticks(x, [f"{alpha:g}" for alpha in ALPHAS])
    axes.minorticks_off()
    axes.axhline(2e-3, color="k", lw=0.8, ls=":")
    axes.annotate("within 0.2 %", (x[-1], 1.8e-3), ha="right", va="top")
    axes.set_xlabel(r"$\alpha$ of our run")
    axes.set_ylabel("|RMS error, ours / printed - 1|")
    drawn.legend(loc="outside lower center", ncols=2)
    return drawn
