"""Errors of q, v and contact forces against steps and time, beside impulses at the end of steps, and stiff springs."""

import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.contact import reference
from experiments.contact.other_ways import by_impulses, by_springs
from experiments.contact.scenes import SCENES, run_of, simulate
from experiments.report import COLOURS, MARKERS
from hhtjax.plot import LINES, subplots

SAMPLES = 40
STEPS = tuple(40 * 2**i for i in range(7))
MORE = tuple(40 * 4**i for i in range(6))  # of the other ways
MOST = 20480  # of the reference
ALPHAS = 0.0, -0.05, -0.3
STIFFNESSES = 1e5, 1e7
ROUNDS = 9
OURS, IMPULSES = "Contact", "impulses at the end of steps"
SPRINGS = tuple(f"springs, {k:.0e} N/m" for k in STIFFNESSES)
KINDS = "q", "v", "force"


def forces(run):
    """(K + 1, m + 1): the normal forces, and the sum of friction, which is all that is determined of it."""
    return jnp.concatenate([run.contact.normal, jnp.sum(run.contact.friction, axis=1, keepdims=True)], axis=1)


def columns(run):
    """What is compared."""
    return run.q, run.v, forces(run)


@partial(jax.jit, static_argnames=("name", "longest"))
def path(name, alpha, dt, longest):
    """All steps of one program for all step sizes, whose further steps are unused, and the step that failed."""
    run = simulate(SCENES[name], dt, longest, stepper=hhtjax.hht(alpha=alpha, linearize="predictor"))
    return columns(run), run.failure.step


def largest(found, exact):
    """Of each kind."""
    return [float(np.max(np.abs(np.asarray(x) - np.asarray(y)))) for x, y in zip(found, exact, strict=True)]


def slopes(steps, errors):
    """Of lines through the logarithms from 320 steps on; None where errors are rounding."""
    some = [i for i, n in enumerate(steps) if n >= min(320, steps[-1] // 4)]
    x, y = np.log(np.asarray(steps)[some]), np.log(np.maximum(np.asarray(errors)[some], 1e-300))
    exact = np.max(np.asarray(errors)[some], axis=0) < 1e-11
    return [None if e else float(-np.polyfit(x, y[:, i], 1)[0]) for i, e in enumerate(exact)]


def orders(report, name, exact, steps):
    """A row for each alpha."""
    rows, scene = [], SCENES[name]
    for alpha in ALPHAS:
        errors, failed = [], 0
        for n in steps:
            found, step = path(name, alpha, scene.T / n, steps[-1])
            errors.append(largest([x[: n + 1 : n // SAMPLES] for x in found], exact))
            failed += 0 < int(step) <= n
        rows.append(
            {
                "scene": name, "alpha": alpha, "steps": list(steps),
                **{f"error_{kind}": [e[i] for e in errors] for i, kind in enumerate(KINDS)},
                "slopes": dict(zip(KINDS, slopes(steps, errors), strict=True)), "failed": failed,
            }
        )  # fmt: skip
        report.progress(f"{name}, alpha = {alpha:g}: {rows[-1]['slopes']}")
    return rows


def ways(scene, steps):
    """{way: program}, which give q and v at the samples."""
    dt, every = scene.T / steps, steps // SAMPLES
    found: dict = {IMPULSES: lambda params: by_impulses(scene, dt, steps, every, params)[:2]}
    for way, k in zip(SPRINGS, STIFFNESSES, strict=True):

        def soft(params, k=k):
            run = by_springs(scene, k, dt, steps, every, params)
            return run.q, run.v, run.failure.step

        found[way] = soft

    def ours(params):
        run = run_of(scene, steps, every, **params)
        return run.q, run.v, run.failure.step

    return {OURS: ours} | found if steps <= STEPS[-1] else found


def beside(report, name, exact, sizes, rounds):
    """Rows of all ways, with the least of their times, taken in turn."""
    scene, rows = SCENES[name], []
    for steps in sizes:
        programs = {way: jax.jit(run) for way, run in ways(scene, steps).items()}
        results = {way: jax.block_until_ready(run(scene.params)) for way, run in programs.items()}
        times = {way: [] for way in programs}
        for _ in range(rounds):
            for way, run in programs.items():
                begun = time.perf_counter()
                jax.block_until_ready(run(scene.params))
                times[way].append(time.perf_counter() - begun)
        for way, found in results.items():
            errors = dict(zip(("error_q", "error_v"), largest(found[:2], exact[:2]), strict=True))
            named = len(found) > 2 and int(found[2]) > 0
            rows.append(
                {"scene": name, "way": way, "steps": steps, **errors, "time_s": min(times[way]), "named": named}
            )
        report.progress(f"{name}, {steps} steps: " + ", ".join(f"{r['error_q']:.1e}" for r in rows[-len(results) :]))
    return rows


def run(report, fast):
    """All scenes; the smoke run has the ball, with few steps."""
    names = list(SCENES)[:1] if fast else list(SCENES)
    steps, most = (STEPS[:3], 640) if fast else (STEPS, MOST)
    rows, others, checks = [], [], {}
    for name in names:
        scene = SCENES[name]
        best = run_of(scene, most, most // SAMPLES)
        exact = [np.asarray(x) for x in columns(best)]
        known = reference.motion(name, scene, np.asarray(best.t))
        if known is not None:
            checks[name] = {"deviation_of_reference_from_DOP853": largest(exact[:2], known)}
        rows += orders(report, name, exact, steps)
        others += beside(report, name, exact, MORE[:1] if fast else MORE, 3 if fast else ROUNDS)
    figure(report, rows)
    figure_of_ways(report, others, names)
    return {"rows": rows, "ways": others, "references": checks, "reference_steps": most, "samples": SAMPLES}


def figure(report, rows):
    """Errors of q, v and forces against steps, alpha = -0.05."""
    drawn, axes = subplots(1, 3, width=180, height=75, sharex=True)
    rows = [row for row in rows if row["alpha"] == ALPHAS[1]]
    units = "m, rad", "m/s, rad/s", "N"
    for panel, kind, unit in zip(axes, KINDS, units, strict=True):
        for i, row in enumerate(rows):
            style = {"color": COLOURS[i], "marker": MARKERS[i], "ls": LINES[i], "ms": 4}
            errors = np.maximum(row[f"error_{kind}"], 1e-13)
            panel.loglog(row["steps"], errors, label=row["scene"], **style)
        n = np.asarray(rows[0]["steps"], float)
        panel.loglog(n, 0.3 * (n / n[0]) ** -2, color="black", lw=0.8, label="order 2")
        panel.set(xlabel="steps", ylabel=f"largest error of {kind} ({unit})")
    drawn.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=6)
    report.figure("contact_order", drawn)


def figure_of_ways(report, rows, names):
    """Errors of q of all ways against steps and against time, a column for each scene."""
    drawn, axes = subplots(2, len(names), width=180, height=110, sharey="col", squeeze=False)
    for j, name in enumerate(names):
        for i, way in enumerate((OURS, IMPULSES, *SPRINGS)):
            mine = [row for row in rows if (row["scene"], row["way"]) == (name, way)]
            style = {"color": COLOURS[i], "marker": MARKERS[i], "ls": LINES[i], "ms": 3, "lw": 1.8 if i == 0 else 1}
            for panel, key, scale in ((axes[0, j], "steps", 1), (axes[1, j], "time_s", 1e3)):
                y = np.clip([row["error_q"] for row in mine], None, 1e2)
                panel.loglog([scale * row[key] for row in mine], y, label=way, **style)
        axes[0, j].set(title=name, xlabel="steps")
        axes[1, j].set(xlabel="time (ms)")
    for panel in axes[:, 0]:
        panel.set_ylabel("error of q (m, rad)")
    drawn.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=4)
    report.figure("contact_ways", drawn)
