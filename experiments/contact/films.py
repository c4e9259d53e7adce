"""Pictures of the scenes, and films of the rocking block, the hopper and the rod."""

from typing import Any

import numpy as np

from experiments.cardona_geradin1989.animation import save
from experiments.contact.scenes import SCENES, run_of, shaken
from experiments.report import COLOURS
from hhtjax.plot import LINES, subplots

FRAMES, PER_SECOND = 60, 20


def corners(q, points):
    """Of a body, in space."""
    s, c = np.sin(q[2]), np.cos(q[2])
    return np.array([[q[0] + c * x - s * y, q[1] + s * x + c * y] for x, y in points])


def spring(low, high, turns=8):
    """A zigzag."""
    y = np.linspace(low, high, 2 * turns + 1)
    x = np.where(np.arange(y.size) % 2, 0.08, -0.08)
    x[[0, -1]] = 0
    return np.stack([x, y], 1)


def box(x, y, width, height):
    """A rectangle about x, standing at y."""
    return np.array([[-1, 0], [1, 0], [1, 2], [-1, 2], [-1, 0]]) * [width / 2, height / 2] + [x, y]


BLOCK = [(-0.25, -1), (0.25, -1), (0.25, 1), (-0.25, 1), (-0.25, -1)]


def lines_of(name, q):
    """Polylines of a scene at q."""
    if name == "rock":
        return [corners(q, BLOCK)]
    if name == "rod":
        return [corners(q, [(-1, 0), (1, 0)])]
    if name == "hopper":
        lower, upper = q[1], q[0] - 0.6
        return [box(0, lower, 0.5, 0.2), spring(lower + 0.2, upper + 0.4), box(0, upper + 0.4, 0.6, 0.3)]
    if name == "ball":
        angle = np.linspace(0, 2 * np.pi, 30)
        return [np.stack([q[0] + 0.05 * np.cos(angle), q[1] + 0.05 + 0.05 * np.sin(angle)], 1)]
    return [box(q[i], q[3 + i], 0.8, 0.98) for i in range(3)]  # the stack


LIMITS = {"rock": ((-0.6, 0.8), (-0.1, 2.2)), "hopper": ((-0.8, 0.8), (-0.1, 1.6)), "rod": ((-0.8, 1.8), (-0.1, 1.9))}


def film(report, name, path: Any):
    """NAME's motion, slowed down to three seconds; closed contacts are told in the title."""
    drawn, axes = subplots(width=52, height=58)
    axes.set(xlim=LIMITS[name][0], ylim=LIMITS[name][1], aspect="equal")
    axes.grid(False)
    axes.axhline(0, color="black", lw=1)
    q, t = np.asarray(path.q), np.asarray(path.t)
    closed, sticking = (np.asarray(x) for x in (path.contact.closed, path.contact.sticking))
    bodies = [axes.plot(*x.T, color=COLOURS[0], lw=2)[0] for x in lines_of(name, q[0])]

    def draw(i):
        for line, x in zip(bodies, lines_of(name, q[i]), strict=True):
            line.set_data(*x.T)
        says = [
            "sticks" if s and name != "hopper" else "touches" if c else "open"
            for c, s in zip(closed[i], sticking[i], strict=True)
        ]
        axes.set_title(f"t = {t[i]:.2f} s: {', '.join(says)}")

    drawn.canvas.draw()
    drawn.set_layout_engine("none")  # which would be solved anew for each frame
    save(report, f"contact_{name}", drawn, draw, len(q), PER_SECOND)


def strips(report, paths):
    """Some instants of each scene on one another, dark at the end."""
    ratios = {"width_ratios": [1.5, 1.6, 0.8, 1.2, 0.8]}
    drawn, axes = subplots(1, len(paths), width=180, height=62, gridspec_kw=ratios)
    for panel, (name, run) in zip(axes, paths.items(), strict=True):
        q, t = np.asarray(run.q), np.asarray(run.t)
        panel.axhline(0, color="black", lw=0.8)
        panel.set_title(name)
        panel.locator_params(axis="x", nbins=3)
        if name == "hopper":
            for i, body in enumerate(("upper", "lower")):
                panel.plot(t, q[:, i], color=COLOURS[i], ls=LINES[i])
                panel.text(0.0, (1.25, 0.3)[i], body, color=COLOURS[i])
            panel.set(xlabel="time (s)")
            continue
        last = len(q) // 2 if name == "rod" else len(q) - 1
        some = np.linspace(0, last, 25 if name == "ball" else 7).round().astype(int)
        for k, i in enumerate(some):
            for line in lines_of(name, q[i]):
                panel.plot(*line.T, color=COLOURS[0], alpha=0.2 + 0.8 * k / len(some), lw=1)
        if name == "ball":
            panel.plot(q[:, 0], q[:, 1] + 0.05, color=COLOURS[7], lw=0.6)
        if name == "rock":
            panel.set_xticks((-0.3, 0.3))
        panel.set_aspect("equal")
        panel.set(xlabel="x (m)")
    axes[0].set_ylabel("y (m)")
    report.figure("contact_scenes", drawn)


def run(report, fast):
    """Films and pictures; the smoke run has none."""
    if fast:
        return {}
    paths = {name: run_of(SCENES[name], 40 * FRAMES, 40) for name in ("ball", "rod", "rock", "hopper")}
    for name in LIMITS:
        film(report, name, paths[name])
    paths["stack"] = run_of(shaken(2.4), 40 * FRAMES, 40)
    strips(report, paths)
    return {"frames": FRAMES, "failed": [int(run.failure.step) for run in paths.values()]}
