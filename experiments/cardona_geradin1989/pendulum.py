"""Figs. 4-7, the constrained pendulum: where accelerations grow, where they settle, and what needs no damping.

Two starts. From consistent initial values there is next to nothing to grow. A program that takes the first
accelerations and multipliers for zero shakes the constraint by the whole tension; that would explain why the paper's
damped runs oscillate at first.
"""

from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from experiments.cardona_geradin1989.runs import STARTS, constrained_hht, trace
from experiments.report import COLOURS, MARKERS
from hhtjax.plot import legend, subplots
from hhtjax.scenes import pendulum

SPEED, STEP_SIZE = 2.505, 5e-3  # m/s, s
READINGS = [(speed, h) for speed in (1.505, 2.505) for h in (5e-3, 5e-2)]  # of the paper's Fig. 3
DURATION = 1.0  # s, of the paper's figures
NUM_STEPS = 400  # beyond the figures, to see what growth leads to
METHODS = {
    "trapezoidal rule": constrained_hht(0.0, "index3", None),
    "HHT, alpha = -0.05": constrained_hht(-0.05, "index3", None),
    "HHT, alpha = -0.1": constrained_hht(-0.1, "index3", None),
    "trapezoidal rule, non-iterative": constrained_hht(0.0, "index3"),
    "HHT, alpha = -0.1, non-iterative": constrained_hht(-0.1, "index3"),
    "trapezoidal rule, non-iterative GGL": constrained_hht(0.0, "ggl"),
}
FAST_METHODS = tuple(METHODS)[:3]
TRAPEZOIDAL = "trapezoidal rule"


def run_method(name, speed, h, start):
    """q, w (steps + 1, 2) and the tension (steps + 1,) in N."""
    scene = pendulum.cartesian(speed)
    path = trace(scene, METHODS[name], h, NUM_STEPS, start == "zero")
    return np.asarray(path.q), np.asarray(path.w), -scene.params["l"] * np.asarray(path.L)[:, 0]


def exact(speed, times):
    """q, w and tension by SciPy, from the pendulum in one angle."""
    length, g = pendulum.cartesian().params["l"], pendulum.GRAVITY
    options = {"t_eval": times, "rtol": 1e-12, "atol": 1e-13}
    start = 0.0, speed / length
    run = solve_ivp(lambda t, y: (y[1], -g / length * np.sin(y[0])), (0, times[-1]), start, "DOP853", **options)
    angle, rate = run.y
    along, across = (np.stack(x, axis=1) for x in ((np.sin(angle), -np.cos(angle)), (np.cos(angle), np.sin(angle))))
    w = -(g * np.sin(angle))[:, None] * across - (length * rate**2)[:, None] * along
    return length * along, w, g * np.cos(angle) + length * rate**2


def readings():
    """What the trapezoidal rule does with each reading of the paper's v0 and h, over its 1 s."""
    rows = []
    for speed, h in READINGS:
        steps = round(DURATION / h)
        entry: dict[str, Any] = {"v0_m_s": speed, "h_s": h}
        for start in STARTS:
            q, w, _ = (x[: steps + 1] for x in run_method(TRAPEZOIDAL, speed, h, start))
            entry[f"ax_from_{start}_start_m_s2"] = [float(w[1:, 0].min()), float(w[1:, 0].max())]
            entry["rise_m"] = float(q[:, 1].max() - q[0, 1])
            entry["swing_m"] = float(np.abs(q[:, 0]).max())
        rows.append(entry)
    return rows


def largest(x, times, begin, end):
    """Largest |x| at the times in [begin, end]."""
    return float(np.max(np.abs(x[(times >= begin - 1e-9) & (times <= end + 1e-9)])))


def run(report, fast):
    """Runs of all methods from both starts; the readings of the paper's numbers."""
    times = STEP_SIZE * np.arange(NUM_STEPS + 1)
    true = exact(SPEED, times)
    names = FAST_METHODS if fast else METHODS
    paths = {(name, start): run_method(name, SPEED, STEP_SIZE, start) for name in names for start in STARTS}
    entries = []
    for (name, start), path in paths.items():
        q, w, tension = (x - y for x, y in zip(path, true, strict=True))
        entries.append(
            {
                "method": name,
                "start": start,
                "position_error_m": largest(np.hypot(*q.T), times, 0, DURATION),
                "ax_error_near_0.2_s_m_s2": largest(w[:, 0], times, 0.1, 0.2),
                "ax_error_near_1_s_m_s2": largest(w[:, 0], times, 0.9, 1.0),
                "tension_error_near_0.2_s_N": largest(tension, times, 0.1, 0.2),
                "tension_error_near_1_s_N": largest(tension, times, 0.9, 1.0),
                "tension_error_near_2_s_N": largest(tension, times, 1.9, 2.0),
            }
        )
    print(f"Pendulum, v0 = {SPEED} m/s, h = {STEP_SIZE} s: largest errors of the tension, N\n")
    keys = [f"tension_error_near_{t}_s_N" for t in ("0.2", "1", "2")]
    report.table(
        ["method", "start", "0.1-0.2 s", "0.9-1 s", "1.9-2 s"],
        [[e["method"], e["start"], *(e[k] for k in keys)] for e in entries],
    )
    report.figure("cardona_geradin1989_pendulum", paper_figure(times, true, paths))
    if not fast:
        report.figure("cardona_geradin1989_pendulum_tension", tension_figure(times, true, paths))
    return {"v0_m_s": SPEED, "h_s": STEP_SIZE, "entries": entries, "readings": readings()}


def paper_figure(times, true, paths):
    """The paper's Figs. 4 to 7."""
    drawn, axes = subplots(2, 2, width=175, height=140, sharex=True)
    shown = times <= DURATION + 1e-9
    t = times[shown]
    q = paths["HHT, alpha = -0.05", "zero"][0][shown]
    axes[0, 0].plot(t, q[:, 0], label="horizontal, x")
    axes[0, 0].plot(t, q[:, 1] - q[0, 1], ls="--", label="vertical, y - y(0)")
    axes[0, 0].set_ylabel("displacement (m)")
    legend(axes[0, 0], title="Fig. 4: positions")
    panels = {
        axes[0, 1]: ("Fig. 5: trapezoidal rule", ["trapezoidal rule"]),
        axes[1, 0]: ("Fig. 6: HHT", ["HHT, alpha = -0.05", "HHT, alpha = -0.1"]),
        axes[1, 1]: ("Fig. 7: both", ["trapezoidal rule", "HHT, alpha = -0.05"]),
    }
    for panel, (title, names) in panels.items():
        for name in names:
            i = list(METHODS).index(name)
            style = {"color": COLOURS[i], "lw": 0.7 if i == 0 else 1.3, "label": name.replace("alpha", "$\\alpha$")}
            panel.plot(t[1:], paths[name, "zero"][1][shown][1:, 0], **style)
        panel.plot(t, true[1][shown][:, 0], color="black", ls=":", lw=1, label="exact")
        panel.set_ylabel("horizontal acceleration (m/s$^2$)")
        legend(panel, title=title)
    axes[1, 0].set_ylim(-12.5, 12.5)
    for panel in axes[1]:
        panel.set_xlabel("time (s)")
    return drawn


def tension_figure(times, true, paths):
    """Error of the tension against the number of steps, from both starts."""
    drawn, panels = subplots(1, 2, width=175, height=85, sharey=True)
    for panel, start in zip(panels, STARTS, strict=True):
        for i, name in enumerate(METHODS):
            error = np.abs(paths[name, start][2] - true[2])[1:]
            worst = error.reshape(-1, 10).max(axis=1)
            style = {"marker": MARKERS[i], "ms": 4, "lw": 1, "mfc": "none" if i > 2 else None, "markevery": (i, 5)}
            panel.semilogy(np.arange(1, 41) * 10, worst, color=COLOURS[i], label=name, **style)
        panel.set(title=f"from {start} initial accelerations", xlabel="number of steps")
    panels[0].set_ylabel("error of the tension (N), largest of 10 steps")
    drawn.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return drawn
