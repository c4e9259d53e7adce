"""Figs. 17-23, the squeezer: HHT, the trapezoidal rule, and Newmark's method with damping, which is of order one."""

from functools import partial

import matplotlib.pyplot as plt
import numpy as np

from experiments.cardona_geradin1989 import animation
from experiments.cardona_geradin1989.index_1 import reference
from experiments.cardona_geradin1989.runs import constrained_hht
from experiments.report import COLOURS, MARKERS, side_by_side
from hhtjax import newmark, simulate
from hhtjax.plot import legend, subplots
from hhtjax.scenes import squeezer

DURATION, NUM_STEPS = 0.02, 400  # s; the paper's
CARRIED_ON = 3  # times as long, to see what diverges
METHODS = {
    "HHT, alpha = -0.1": constrained_hht(-0.1, "index3", None),
    "trapezoidal rule": constrained_hht(0.0, "index3", None),
    "Newmark + damping": newmark(0.3025, 0.6, formulation="index3", iterations=None),
    "HHT, alpha = -0.1, non-iterative": constrained_hht(-0.1, "index3"),
    "trapezoidal rule, non-iterative": constrained_hht(0.0, "index3"),
    "HHT, alpha = -0.1, non-iterative GGL": constrained_hht(-0.1, "ggl"),
    "trapezoidal rule, non-iterative GGL": constrained_hht(0.0, "ggl"),
}
FAST_METHODS = tuple(METHODS)[3:5]
DRAWN = squeezer.squeezer().params  # lengths and pivots
SHOWN = 0.0, 0.005, 0.0075, 0.01  # s, of the paper's Fig. 17
FRAMES, SMOKE_FRAMES = 75, 5  # of the animation


def run_method(name):
    """q, v, w and L of a run; unchecked, because the trapezoidal rule fails in the end."""
    system, params, q0, v0, _ = squeezer.squeezer()
    h, num_steps = DURATION / NUM_STEPS, CARRIED_ON * NUM_STEPS
    path = simulate(system, METHODS[name], q0, v0, params, dt=h, num_steps=num_steps)
    return [np.asarray(x) for x in (path.q, path.v, path.acceleration, path.multipliers)]


def node_5(q, v, w):
    """Of the joint between crank and coupler, the paper's node 5: x (mm), its acceleration (km/s^2); and beta (rad)."""
    beta, rate, slope, length = q[:, 0], v[:, 0], w[:, 0], DRAWN["rr"]
    return 1e3 * length * np.cos(beta), -1e-3 * length * (np.sin(beta) * slope + np.cos(beta) * rate**2), beta


def summarize(name, path, exact):
    """Errors of one run, at the end of the paper's time and of ours."""
    errors = [np.abs(x - y).max(axis=1) for x, y in zip(path, exact, strict=True)]
    numbers = {"method": name}
    for x, unit, error in zip(
        ("q", "v", "acceleration", "multiplier"), ("rad", "rad_s", "rad_s2", "N"), errors, strict=True
    ):
        numbers[f"{x}_error_at_{DURATION}_s_{unit}"] = float(error[NUM_STEPS])
        numbers[f"{x}_error_at_{CARRIED_ON * DURATION:.2g}_s_{unit}"] = float(error[-1])
    return numbers


def run(report, fast):
    """The paper's runs and the same without iterations, beside SciPy; figures and animation."""
    scene = squeezer.squeezer()
    times = np.linspace(0, CARRIED_ON * DURATION, CARRIED_ON * NUM_STEPS + 1)
    exact = reference(scene, times)
    report.progress("squeezer: reference by SciPy")
    names = FAST_METHODS if fast else tuple(METHODS)
    paths = dict(zip(names, side_by_side([partial(run_method, name) for name in names]), strict=True))
    entries = [summarize(name, path, exact) for name, path in paths.items()]
    print(
        f"Squeezer, h = {DURATION / NUM_STEPS:g} s: errors at t = {DURATION} s and at {CARRIED_ON * DURATION:.2g} s\n"
    )
    header = [
        "method",
        *(f"{x} {when}" for x in ("q (rad)", "v (rad/s)", "w (rad/s2)", "L (N)") for when in ("", "then")),
    ]
    report.table(header, [list(e.values()) for e in entries])
    report.figure("cardona_geradin1989_squeezer_configurations", configurations(times, exact[0]))
    if not fast:
        report.figure("cardona_geradin1989_squeezer", node_figure(times, exact, paths))
    animate(report, times, exact[0], SMOKE_FRAMES if fast else FRAMES)
    return {"h_s": DURATION / NUM_STEPS, "moment_N_m": scene.params["moment"], "entries": entries}


def along(angle):
    """Unit vector."""
    return np.array([np.cos(angle), np.sin(angle)])


def lines(q):
    """The mechanism as polylines (points, 2), in mm: K1 and K2, the triangle K3, K5 and K4, K7 and K6, the spring."""
    beta, theta, gamma, _, delta, _, epsilon = q
    A, B, C = (np.asarray(DRAWN[name]) for name in "ABC")
    crank = DRAWN["rr"] * along(beta)
    P = crank - DRAWN["d"] * along(beta + theta)
    D = B + DRAWN["sd"] * along(gamma) - DRAWN["sc"] * along(gamma + np.pi / 2)
    K5, K7 = A + DRAWN["zt"] * along(delta), A - DRAWN["u"] * along(epsilon + np.pi / 2)
    return [1e3 * np.stack(line) for line in ((0 * P, crank, P), (B, P, D, B), (A, K5, P), (A, K7, P), (D, C))]


NAMES = "K1, K2", "K3", "K4, K5", "K6, K7", "spring"


def draw_mechanism(axes, q, strength=1.0):
    """All lines, and the pivots."""
    for i, line in enumerate(lines(q)):
        style = {"ls": "--", "color": "0.4", "lw": 1} if i == 4 else {"color": COLOURS[i], "lw": 2}
        axes.plot(*line.T, marker="o", ms=3, alpha=strength, label=NAMES[i], **style)
    axes.plot(*1e3 * np.stack([np.zeros(2), *(DRAWN[name] for name in "ABC")]).T, "k^", ms=5)
    axes.set(aspect="equal", xlim=(-75, 25), ylim=(-45, 80), xlabel="x (mm)", ylabel="y (mm)")


def configurations(times, q):
    """Fig. 17: four times, the start faint behind."""
    drawn, panels = subplots(1, len(SHOWN), width=175, height=75, sharey=True)
    for axes, t in zip(panels, SHOWN, strict=True):
        if t:
            draw_mechanism(axes, q[0], 0.2)
        draw_mechanism(axes, q[np.searchsorted(times, t - 1e-9)])
        axes.set_title(f"t = {1e3 * t:g} ms")
        axes.label_outer()
    handles, names = panels[0].get_legend_handles_labels()
    drawn.legend(handles, names, loc="outside lower center", ncols=len(NAMES))
    return drawn


def node_figure(times, exact, paths):
    """Figs. 18 to 23, Fig. 20 carried on, and the errors of the accelerations."""
    hht, trapezoidal, damped, *_, ggl = METHODS
    names = hht, trapezoidal, damped, ggl
    colours, lines = dict(zip(names, COLOURS, strict=False)), dict(zip(names, ("-", "--", "-.", ":"), strict=True))
    panels = {  # which quantity of node_5, whose, until when
        "Figs. 18, 21: node 5": (0, (hht, trapezoidal, damped), 1),
        "Fig. 22: crank": (2, (hht, damped), 1),
        "Figs. 19, 23: node 5": (1, (hht, damped), 1),
        "Fig. 20: node 5": (1, (trapezoidal,), 1),
        "Fig. 20, carried on": (1, (trapezoidal, hht), CARRIED_ON),
    }
    labels = "x (mm)", "acceleration in x (km/s$^2$)", "angle (rad)"
    true = node_5(*exact[:3])
    moved = {name: node_5(*paths[name][:3]) for name in names}
    drawn, axes = subplots(3, 2, width=175, height=205)
    for panel, (title, (what, shown, until)) in zip(axes.flat, panels.items(), strict=False):
        few = slice(0, until * NUM_STEPS + 1)
        for name in shown:
            style = {"color": colours[name], "ls": lines[name], "lw": 1, "label": name.replace("alpha", "$\\alpha$")}
            panel.plot(1e3 * times[few], moved[name][what][few], **style)
        panel.plot(1e3 * times[few], true[what][few], color="black", ls=":", lw=1, label="exact")
        panel.set(ylabel=labels[what], xlabel="time (ms)")
        legend(panel, title=title)
    axes[2, 0].set_ylim(-40, 60)
    for i, name in enumerate(names):
        error = np.abs(paths[name][2] - exact[2])[1:].max(axis=1).reshape(-1, 20).max(axis=1)
        style = {"color": colours[name], "marker": MARKERS[i], "ms": 4, "lw": 1, "markevery": (i, 6), "label": name}
        axes[2, 1].semilogy(1e3 * times[20::20], error, **style)
    axes[2, 1].set(xlabel="time (ms)", ylabel="error of acceleration (rad/s$^2$)")
    legend(axes[2, 1], title="all angles")
    return drawn


def animate(report, times, q, frames):
    """The squeezer in motion until t = 0.03 s."""
    figure, axes = subplots(width=74, height=86)
    shown = np.searchsorted(times, np.linspace(0, squeezer.squeezer().duration, frames, endpoint=False) - 1e-9)

    def draw(i):
        axes.clear()
        draw_mechanism(axes, q[shown[i]])
        axes.set_title(f"t = {1e3 * times[shown[i]]:4.1f} ms")

    animation.save(report, "cardona_geradin1989_squeezer", figure, draw, frames)
    plt.close(figure)
