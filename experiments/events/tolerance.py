"""Error against tolerance: events under error control, and how many steps they take."""

import numpy as np

import hhtjax
from experiments.events.reference import SCENES, reference
from experiments.report import COLOURS, MARKERS
from hhtjax.plot import subplots

METHODS = {"hht": hhtjax.hht(), "rowda": hhtjax.rowda(), "dopri5": hhtjax.dopri5()}
TOLERANCES = {"hht": range(2, 7), "rowda": range(2, 8), "dopri5": range(2, 9)}  # powers of 1/10
CASES = "ball", "impact oscillator", "bump stop"
SAMPLES, MOST = 100, 100_000
APART = 1e-3  # of a scene's time: samples nearer to an event are left out, since v jumps there
LINES = {"hht": "-", "rowda": "--", "dopri5": ":"}


def samples(name):
    """Times away from events, q and v there, and the number of events."""
    duration = SCENES[name].duration
    times = np.linspace(0, duration, SAMPLES + 1)
    q, v, events = reference(name, times)
    away = np.min(np.abs(times[:, None] - np.array(events)), axis=1) > APART * duration
    away[0] = False  # the start
    return times[away], q[away], v[away], len(events)


def measure(name, method, power, wanted):
    """A row: the largest error of q and of v, as parts of the largest there, over rtol."""
    scene, (times, q, v, count) = SCENES[name], wanted
    rtol = 10.0**-power
    run = hhtjax.simulate(
        scene.system, METHODS[method], scene.q0, scene.v0, scene.params,
        dt=hhtjax.adaptive(rtol, 1e-3 * rtol, max_steps=MOST), times=times, events=scene.events,
    )  # fmt: skip
    run.check()
    errors = [np.max(np.abs(x[1:] - y)) / np.max(np.abs(y)) for x, y in ((run.q, q), (run.v, v))]
    return {
        "scene": name, "method": method, "rtol": rtol, "error_over_rtol": float(max(errors) / rtol),
        "steps": int(run.steps.accepted), "rejected": int(run.steps.rejected),
        "right_number_of_events": int(run.events.count) == count, "events": count,
    }  # fmt: skip


def fitted(seed=0):
    """Restitution of the ball from a noisy record, by runs whose steps are chosen, then frozen."""
    scene, noise = SCENES["ball"], 1e-3
    times, q, *_ = samples("ball")
    times, record = times[::2], q[::2] + noise * np.random.default_rng(seed).standard_normal(q[::2].shape)

    def residuals(unknown):
        run = hhtjax.simulate(
            scene.system, hhtjax.rowda(), scene.q0, scene.v0, scene.params | unknown,
            dt=hhtjax.adaptive(1e-6, 1e-9, max_steps=1000), times=times, events=scene.events,
        )  # fmt: skip
        return run.q[1:] - record

    found = hhtjax.fit(residuals, {"e": 0.7})
    low, high = (float(x["e"]) for x in found.interval())
    return {
        "noise_m": noise, "samples": len(times), "truth": float(scene.params["e"]),
        "estimate": float(found.params["e"]), "low": low, "high": high,
        "choices": int(np.asarray(found.choices)), "converged": bool(found.converged),
    }  # fmt: skip


def run(report, fast):
    """All scenes and methods, a figure, and a fit; the smoke run has one scene and method, and no fit."""
    rows, methods = [], list(TOLERANCES.items())
    for name in CASES[:1] if fast else CASES:
        wanted = samples(name)
        for method, powers in methods[:1] if fast else methods:
            rows += [measure(name, method, power, wanted) for power in (list(powers)[:2] if fast else powers)]
            report.progress(str(rows[-1]))
    figure(report, rows)
    return {"rows": rows} if fast else {"rows": rows, "fit": fitted()}


def figure(report, rows):
    """Errors over the tolerance, and over the steps."""
    drawn, (left, right) = subplots(1, 2, width=180, height=95)
    for i, name in enumerate(CASES):
        for method in METHODS:
            mine = [row for row in rows if (row["scene"], row["method"]) == (name, method)]
            style = {"color": COLOURS[i], "marker": MARKERS[i], "ms": 3.5, "lw": 1, "ls": LINES[method]}
            error = [row["error_over_rtol"] * row["rtol"] for row in mine]
            left.loglog([row["rtol"] for row in mine], error, label=f"{name}, {method}", **style)
            right.loglog([row["steps"] for row in mine], error, **style)
    ends = np.array([1e-8, 1e-2])
    left.loglog(ends, ends, color="black", lw=0.8, label="error = rtol")
    left.set(xlabel="rtol", ylabel="largest error, relative")
    right.set(xlabel="steps", ylabel="largest error, relative")
    drawn.legend(handles=left.lines, loc="outside lower center", ncols=4)
    report.figure("events_tolerance", drawn)
