"""Figs. 9-15, the spinning top: as the paper solved it, as a rotation alone, and with one linear solve per step."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from scipy.integrate import solve_ivp

from experiments.cardona_geradin1989 import animation
from experiments.cardona_geradin1989.runs import constrained_hht, end, trace
from experiments.report import COLOURS, MARKERS, side_by_side
from hhtjax import conventional_hht, hht, newmark
from hhtjax.plot import error_against_h, legend, subplots
from hhtjax.rotation import log
from hhtjax.scenes import top

DURATION, NUM_STEPS = 0.5, 100  # s; steps of 5 ms, where the OCR of the paper has 0.05 s, in which the top turns once
METHODS = {
    "HHT, literal, alpha = -0.05": conventional_hht(-0.05, fictive_time=False),
    "trapezoidal rule": constrained_hht(0.0, "index3", None),
    "Newmark + damping": newmark(0.275625, 0.55, formulation="index3", iterations=None),
    "non-iterative GGL, alpha = -0.05": constrained_hht(-0.05, "ggl"),
    "HHT, repaired, alpha = -0.05": constrained_hht(-0.05, "index3", None),
}
FIGURED = tuple(METHODS)[:4]
CASES = {  # of the convergence chart: form of the top, and stepper with alpha = -0.05
    "x and R, GGL": (top.constrained, constrained_hht(-0.05, "ggl")),
    "x and R, index 3": (top.constrained, constrained_hht(-0.05, "index3")),
    "x and R, GGL, Lie": (top.constrained, hht(-0.05, kinematics="lie")),
    "R alone": (top.minimal, hht(-0.05)),
    "R alone, Lie": (top.minimal, hht(-0.05, kinematics="lie")),
    "R alone, literal HHT": (top.minimal, conventional_hht(-0.05, fictive_time=False)),
}
LADDER = 100, 200, 400, 800, 1600, 3200
FRAMES, SMOKE_FRAMES = 50, 4


def exact(times):
    """x, its acceleration, R and Om by SciPy, from the top as a rotation alone."""
    scene = top.minimal()

    @jax.jit
    def acceleration(R, Om):
        return top.moment(R, Om, 0.0, scene.params) / top.inertia(R, scene.params)

    def rate(t, y):
        R, Om = y[:9].reshape(3, 3), y[9:]
        return np.concatenate([(R @ np.cross(Om, -np.eye(3))).ravel(), acceleration(R, Om)])

    y0 = np.concatenate([np.ravel(scene.q0), scene.v0])
    y = solve_ivp(rate, (0, times[-1]), y0, "DOP853", times, rtol=1e-12, atol=1e-13).y.T
    R, Om = y[:, :9].reshape(-1, 3, 3), y[:, 9:]
    A = jax.vmap(acceleration)(R, Om)
    arm = np.array([0.0, scene.params["l"], 0.0])
    x2 = np.cross(A, arm) + np.cross(Om, np.cross(Om, arm))
    return R @ arm, np.einsum("tij,tj->ti", R, x2), R, Om


def place(state):
    """The centre of the disk."""
    return state.q["x"] if isinstance(state.q, dict) else state.q[..., :, 1]


def convergence(name, ladder):
    """Largest error of the place of the disk at the end, for each number of steps."""
    make, stepper = CASES[name]
    true = exact(np.array([0.0, DURATION]))[0][-1]
    return [float(np.max(np.abs(place(end(make(), stepper, n)[0]) - true))) for n in ladder]


def run(report, fast):
    """The paper's runs beside the exact motion; orders; figures and animation."""
    scene, times = top.constrained(), np.linspace(0, DURATION, NUM_STEPS + 1)
    true = exact(times)
    names = FIGURED[-1:] if fast else tuple(METHODS)
    paths = {name: trace(scene, METHODS[name], DURATION / NUM_STEPS, NUM_STEPS, False) for name in names}
    paths = {name: (np.asarray(path.q["x"]), np.asarray(path.w["x"])) for name, path in paths.items()}
    entries = [
        {
            "method": name,
            "x_error_m": float(np.max(np.abs(x[-1] - true[0][-1]))),
            "ax_error_last_fifth_m_s2": float(np.max(np.abs(w - true[1])[-NUM_STEPS // 5 :, 0])),
        }
        for name, (x, w) in paths.items()
    ]
    print(f"Spinning top, x, R and 3 multipliers, h = {DURATION / NUM_STEPS:g} s: errors at t = {DURATION} s\n")
    report.table(["method", "x (m)", "x acceleration, last 0.1 s (m/s2)"], [list(e.values()) for e in entries])
    cases = tuple(CASES)[:1] if fast else tuple(CASES)
    ladder = LADDER[:2] if fast else LADDER
    errors = dict(zip(cases, side_by_side([partial(convergence, name, ladder) for name in cases]), strict=True))
    print("Error of x at the end, in m, by the number of steps\n")
    report.table(["formulation", *map(str, ladder)], [[name, *values] for name, values in errors.items()])
    animate(report, scene, SMOKE_FRAMES if fast else FRAMES)
    if not fast:
        report.figure("cardona_geradin1989_top", motion_figure(times, paths["non-iterative GGL, alpha = -0.05"], true))
        report.figure("cardona_geradin1989_top_methods", methods_figure(times, paths, true))
        report.figure("cardona_geradin1989_top_orders", orders_figure(errors))
    return {"h_s": DURATION / NUM_STEPS, "entries": entries, "steps": list(ladder), "x_error_m": errors}


def motion_figure(times, path, true):
    """Figs. 9-12: the path of the disk, and the exact rotation it belongs to."""
    drawn, axes = subplots(2, 2, width=175, height=140)
    axes[0, 0].remove()
    fine = np.linspace(0, DURATION, 2001)
    x, _, R, Om = exact(fine)
    space: Any = drawn.add_subplot(2, 2, 1, projection="3d")
    space.plot(*x.T, color=COLOURS[0], lw=1, label="exact")
    space.plot(*path[0].T, MARKERS[0], color=COLOURS[1], ms=2.5, label="non-iterative, 100 steps")
    space.plot(*zip((0, 0, 0), x[0], strict=True), color="black", lw=1)
    space.set(xlabel="x (m)", ylabel="y (m)", zlabel="z (m)", title="Fig. 9: path of the disk")
    space.tick_params(pad=-1)
    space.set_box_aspect(None, zoom=0.85)
    space.set(xticks=(-0.5, 0, 0.5), yticks=(0, 0.5, 1), zticks=(-1, -0.5, 0))
    space.legend(loc="upper left", bbox_to_anchor=(-0.3, 1.1))
    panels = axes.flat[1:]
    psi = np.array(jax.vmap(log)(jnp.asarray(R)))
    jumps = np.abs(np.diff(psi, axis=0)).max(axis=1) > 1
    psi[1:][jumps] = np.nan  # at pi, where psi and -psi are the same rotation
    spatial = np.einsum("tij,tj->ti", R, Om)
    for i, axis in enumerate("xyz"):
        style = {"color": COLOURS[i], "ls": ("-", "--", ":")[i], "lw": 1, "label": axis}
        panels[0].plot(fine, psi[:, i], **style)
        panels[1].plot(fine, spatial[:, i], **style)
    panels[2].plot(fine, Om[:, 0], color=COLOURS[0], lw=1)
    panels[0].set_ylabel("component (rad)")
    panels[1].set_ylabel("component (rad/s)")
    panels[2].set(title="Fig. 12: material angular velocity across the rod", ylabel="$\\Omega_1$ (rad/s)")
    legend(panels[0], title="Fig. 10: rotation vector")
    legend(panels[1], title="Fig. 11: angular velocity in space")
    for panel in panels:
        panel.set_xlabel("time (s)")
    return drawn


def methods_figure(times, paths, true):
    """Figs. 13-15: accelerations of the paper's three methods, and where each takes the disk."""
    drawn, panels = subplots(1, 3, width=175, height=85)
    hilber, trapezoidal, damped, ours = FIGURED
    for panel, title, names in (
        (panels[0], "Fig. 13", (trapezoidal, hilber)),
        (panels[1], "Fig. 14", (damped, ours)),
    ):
        for name in names:
            i = list(METHODS).index(name)
            panel.plot(times, paths[name][1][:, 0], color=COLOURS[i], lw=1, label=name.replace("alpha", "$\\alpha$"))
        panel.plot(times, true[1][:, 0], color="black", ls=":", lw=1, label="exact")
        panel.set(xlabel="time (s)", ylabel="$\\ddot x$ (m/s$^2$)")
        panel.set_title(f"{title}: acceleration")
    for i, name in enumerate(FIGURED):
        distance = np.linalg.norm(paths[name][0] - true[0], axis=1)
        panels[2].semilogy(times[2:], distance[2:], color=COLOURS[i], lw=1.2, label=name.replace("alpha", "$\\alpha$"))
    panels[2].set(xlabel="time (s)", ylabel="distance (m)")
    panels[2].set_title("Fig. 15: from the exact path")
    key = dict(zip(*reversed(panels[2].get_legend_handles_labels()), strict=True))
    key["exact"] = panels[0].lines[-1]
    drawn.legend(key.values(), key.keys(), loc="outside lower center", ncols=3)
    return drawn


def orders_figure(errors):
    """Error of the place of the disk against the step."""
    drawn, panel = subplots(width=85, height=90)
    h = DURATION / np.array(LADDER)
    error_against_h({name: (h, np.array(values)) for name, values in errors.items()}, slopes=(1, 2), unit="m", ax=panel)
    panel.set_ylabel("error of the disk's place at 0.5 s (m)")
    return drawn


def animate(report, scene, frames):
    """The rod, the disk and the path of its centre."""
    path = trace(scene, METHODS["non-iterative GGL, alpha = -0.05"], DURATION / NUM_STEPS, NUM_STEPS, False)
    x, R = np.asarray(path.q["x"]), np.asarray(path.q["R"])
    angles = np.linspace(0, 2 * np.pi, 40)
    rim = scene.params["a"] * np.stack([np.cos(angles), 0 * angles, np.sin(angles)])
    with plt.rc_context({"figure.constrained_layout.use": False}):  # the axes fill the figure
        figure = plt.figure(figsize=(3.4, 3.4), dpi=80)
    space = figure.add_axes((0, 0, 1, 1), projection="3d")

    def draw(frame):
        i = frame * NUM_STEPS // frames
        space.clear()
        space.set(xlim=(-1, 1), ylim=(-1, 1), zlim=(-1.2, 0.3), xticklabels=[], yticklabels=[], zticklabels=[])
        space.plot(*x[: i + 1].T, color=COLOURS[1], lw=1)
        space.plot(*np.stack([0 * x[i], x[i]]).T, color="black", lw=1.5)
        edge = x[i][:, None] + R[i] @ rim
        space.plot(*edge, color=COLOURS[0], lw=1.5)
        for spoke in (0, 10):
            space.plot(*edge[:, [spoke, spoke + 20]], color=COLOURS[0], lw=0.8)

    animation.save(report, "cardona_geradin1989_top", figure, draw, frames)
    plt.close(figure)
