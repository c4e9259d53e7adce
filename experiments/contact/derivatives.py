"""Derivatives of the end of a run: forward, reverse, and central differences of the same run; beside the other ways."""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from experiments.contact import reference
from experiments.contact.other_ways import by_impulses, by_springs
from experiments.contact.scenes import SCENES, simulate
from experiments.report import COLOURS, MARKERS
from hhtjax.plot import LINES, subplots

CASES = [  # scene, parameter, which q, and at what part of the duration
    ("ball", "e", 1, 0.4), ("ball", "mu", 0, 1.0), ("table", "mu", 0, 1.0), ("rock", "tilt", 2, 1.0),
    ("rod", "mu", 0, 1.0), ("rod", "v0", 0, 1.0), ("hopper", "A", 0, 1.0), ("hopper", "k", 0, 1.0),
]  # fmt: skip
STEPS = 40, 160, 640, 2560
STRIDE = 1e-6  # of central differences, of the parameter
WAYS = {"Contact": "forward", "impulses": "impulses", "springs": "springs"}


@partial(jax.jit, static_argnames=("way", "case", "longest"))
def end_of(way, case, x, dt, step, longest):
    """q_i at a step, of the parameter x: one program for all step sizes, whose further steps are unused."""
    name, parameter, i, _ = CASES[case]
    scene = SCENES[name]
    params = scene.params | {parameter: x}
    if way == "impulses":
        return by_impulses(scene, dt, longest, params=params).q[step, i]
    if way == "springs":
        return by_springs(scene, 1e5, dt, longest, params=params).q[step, i]
    return simulate(scene, dt, longest, params=params).q[step, i]


@partial(jax.jit, static_argnames=("way", "case", "longest", "reverse"))
def derivative(way, case, x, dt, step, longest, reverse=False):
    """Of it in x."""
    return (jax.grad if reverse else jax.jacfwd)(lambda x: end_of(way, case, x, dt, step, longest))(x)


def central(end, x):
    """By differences."""
    h = STRIDE * x
    return float((end(x + h) - end(x - h)) / (2 * h))


def of_motion(name, parameter, i, part):
    """By differences of DOP853's motion; None where there is none."""
    scene = SCENES[name]
    times, x = np.array([0.0, part * scene.T]), float(scene.params[parameter])

    def end(x):
        return reference.motion(name, scene, times, **{parameter: x})[0][-1, i]

    return None if reference.motion(name, scene, times) is None else central(end, x)


def row_of(report, case, sizes, fast):
    """One case, all step sizes; in a smoke run without reverse mode and other ways."""
    name, parameter, _, part = CASES[case]
    scene, longest = SCENES[name], sizes[-1]
    x = jnp.asarray(scene.params[parameter])
    row = {"scene": name, "parameter": parameter, "steps": list(sizes), "of_DOP853": of_motion(*CASES[case])}
    for n in sizes:
        at = scene.T / n, round(part * n), longest
        forward, reverse = (float(derivative("Contact", case, x, *at, mode and not fast)) for mode in (False, True))
        difference = central(lambda x, at=at: end_of("Contact", case, x, *at), x)
        row.setdefault("forward", []).append(forward)
        row.setdefault("forward_minus_reverse", []).append(abs(forward / reverse - 1))
        row.setdefault("difference_from_central", []).append(abs(forward / difference - 1))
        for way in ("impulses", "springs"):
            row.setdefault(way, []).append(math.nan if fast else float(derivative(way, case, x, *at)))
    report.progress(f"{row}")
    return row


def run(report, fast):
    """All cases; the smoke run has one, at a few steps."""
    rows = [row_of(report, i, STEPS[:2] if fast else STEPS, fast) for i in range(1 if fast else len(CASES))]
    figure(report, rows)
    return {"rows": rows, "stride": STRIDE}


def truth(row):
    """The derivative of the motion: DOP853's, else that of the finest run."""
    return row["forward"][-1] if row["of_DOP853"] is None else row["of_DOP853"]


def figure(report, rows):
    """Relative errors of derivatives over steps, of the motion; and those against differences of the same run."""
    drawn, axes = subplots(1, 4, width=180, height=75, sharey=True)
    titles = "Contact: against the motion", "impulses", "springs, 1e5 N/m", "Contact: against differences"
    for i, row in enumerate(rows):
        style = {"color": COLOURS[i], "marker": MARKERS[i], "ls": LINES[i], "ms": 3, "lw": 1}
        steps, label = np.asarray(row["steps"]), f"{row['scene']}, {row['parameter']}"
        for panel, key in zip(axes, WAYS.values(), strict=False):
            error = np.abs(np.asarray(row[key], float) / truth(row) - 1)
            error = np.clip(error, 1e-13, 1e6)
            some = slice(None, -1) if row["of_DOP853"] is None and key == "forward" else slice(None)
            panel.loglog(steps[some], error[some], label=label, **style)
        axes[-1].loglog(steps, np.maximum(row["difference_from_central"], 1e-13), label=label, **style)
    for panel, title in zip(axes, titles, strict=True):
        panel.set(title=title, xlabel="steps")
    axes[0].set_ylabel("relative error of a derivative")
    drawn.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=4)
    report.figure("contact_derivatives", drawn)
