"""A measured double pendulum: inertia, gravity and friction from angles with gaps, scored on an unseen trial.

Model, with q from the downward vertical: M = [[1, B cos(q1 - q2)], [., A]], weights g1 sin q1 and g2 sin q2, and joints
with friction. The tracker's angles are q less an offset. Only ratios to the inertia of the first link can be found.
"""

import time
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import hhtjax
from experiments.identification import pendulum_data
from experiments.report import COLOURS, MARKERS, Report

DT = 1e-3  # s; the unseen trial turns at up to 35 rad/s
HORIZONS = (0.125, 0.25, 0.5)  # s, of the windows of one fit after the other
LONG = 2.0  # s
START = {"A": 0.5, "B": 0.3, "g1": 40.0, "g2": 30.0, "viscous": (0.1, 0.1), "offset": jnp.zeros(2)}
UNITS = {"A": "1", "B": "1", "g1": "1/s^2", "g2": "1/s^2", "viscous": "1/s", "offset": "rad", "dry": "1/s^2"}
UNITS["quadratic"] = "1"
POSITIVE = {name: hhtjax.positive if name in ("A", "B", "g1", "g2") else None for name in START}
FRICTION = {"viscous": (), "viscous and dry": ("dry",), "viscous and quadratic": ("quadratic",)}


def cut(trial, duration):
    """Windows of a trial as records, and a start for each from its first sample."""
    records = hhtjax.windows(trial.t, trial.angle, duration)
    first = np.searchsorted(trial.t, records.begin)
    starts = {"q": jnp.asarray(trial.angle[first]), "v": jnp.asarray(trial.rate[first])}
    return jax.tree.map(jnp.asarray, records), starts


def errors(params, start, record, num_steps):
    """Simulated less measured angles, rad; missing samples included."""
    run = pendulum_data.simulate(params, start["q"], start["v"], DT, num_steps)
    return hhtjax.wrap_angle(hhtjax.interpolate(run, record.t).q - params["offset"] - record.y)


def problem_at(trial, duration, before):
    """The fit to windows of a duration, whose starts are those of the fit to shorter ones before, if there was one."""
    records, starts = cut(trial, duration)
    if before is not None:
        starts = states_at(records.begin, *before)
    residuals = partial(errors, num_steps=steps_of(records))
    return records, {"residuals": residuals, "records": records, "starts": starts, "weights": records.present}


def steps_of(records):
    """Steps of a window."""
    return int(np.ceil(float(jnp.max(records.t)) / DT))


def states_at(times, records, result):
    """q and v at times of the record, on the trajectories of fitted windows."""
    window, num_steps = jnp.searchsorted(records.begin, times, side="right") - 1, steps_of(records)

    @jax.jit
    @jax.vmap
    def state(time, begin, start):
        run = pendulum_data.simulate(result.params, start["q"], start["v"], DT, num_steps)
        return hhtjax.interpolate(run, jnp.minimum(time - begin, run.t[-1]))

    found = state(times, records.begin[window], jax.tree.map(lambda x: x[window], result.starts))
    return {"q": found.q, "v": found.v}


def fit_progressively(params0, trial, horizons):
    """One fit after the other, each with longer windows from where the last one ended; and its windows."""
    transforms = POSITIVE | {name: None for name in params0 if name not in POSITIVE}
    used = []

    def problem(duration, result):
        records, arguments = problem_at(trial, duration, None if result is None else (used[-1], result))
        used.append(records)
        return arguments

    return hhtjax.fit_progressively(problem, params0, horizons, transforms=transforms), used[-1]


def score(params, trial, duration):
    """RMSE in mrad over the windows of a trial, with the initial states of the windows refitted.

    First to the windows' beginnings: over a second, a start by differences ends in a local minimum.
    """
    records, starts = cut(trial, duration)
    residuals = partial(errors, params, num_steps=steps_of(records))

    @jax.jit
    @partial(jax.vmap, in_axes=(0, 0, None))
    def refit(start, record, until):
        weights = record.present & (record.t <= until)[:, None]
        result = hhtjax.fit(lambda start: residuals(start, record), start, weights=weights, covariance=False)
        return result.params, result.residual

    residual = None
    for until in (0.25, 0.5, 1.0):
        if until <= duration:
            starts, residual = refit(starts, records, until)
    return rmse(residual, records)


def rmse(residual, records):
    """In mrad, of the samples that are present."""
    return 1e3 * float(np.sqrt(np.mean(np.asarray(residual)[np.asarray(records.present)] ** 2)))


def run(report: Report, fast: bool):
    """Fits, scores on the unseen trial, compares friction models, and tries long windows from a poor start."""
    train, test, measured = pendulum_data.load()
    if measured:
        print("Double pendulum, motion-tracked (Schmidt and Lipson 2009): one trial to fit, one to score.")
    else:
        print(f"GENERATED trials, known parameters. To use the measured ones, {pendulum_data.HOW_TO_GET_IT}.")
    numbers: dict[str, Any] = {
        "data": "measured" if measured else "generated",
        "fast": fast,
        "dt_in_s": DT,
        "models": {},
    }
    best = None
    for name, extra in list(FRICTION.items())[: 1 if fast else None]:
        begin = time.perf_counter()
        params0 = START | dict.fromkeys(extra, (0.0, 0.0))
        result, records = fit_progressively(params0, train, HORIZONS)
        seconds = time.perf_counter() - begin
        report.progress(f"{name}: {rmse(result.residual, records):.3f} mrad on the training windows, {result.reason}")
        numbers["models"][name] = {
            "train_mrad": rmse(result.residual, records),
            "cost_in_rad^2": float(result.cost),
            "fit_with_compilation_s": seconds,
            "parameters": table_of(report, result),
        }
        best = result if best is None else best
    assert best is not None
    horizons = (0.25,) if fast else (0.25, 0.5, 1.0)
    numbers["test_mrad"] = {f"{horizon} s": score(best.params, test, horizon) for horizon in horizons}
    report.table(["unseen trial, window", "RMSE mrad"], [[k, v] for k, v in numbers["test_mrad"].items()])
    if not fast:
        numbers["long_windows_mrad"] = long_windows(report, train)
    report.numbers(numbers)
    plot(report, numbers)


def table_of(report: Report, result):
    """Prints estimates with intervals; returns them as numbers."""
    lower, upper = result.interval()
    rows, found = [], {}
    for name in result.params:
        parts = [np.ravel(jnp.stack(jax.tree.leaves(tree[name]))) for tree in (result.params, lower, upper)]
        naive = np.ravel(jnp.stack(jax.tree.leaves(result.errors(result.uncertainty.naive)[name])))
        error = np.ravel(jnp.stack(jax.tree.leaves(result.standard_errors[name])))
        for i, (value, low, high) in enumerate(zip(*parts, strict=True)):
            entry = name if len(parts[0]) == 1 else f"{name}{i + 1}"
            rows.append([entry, float(value), f"{low:.4g} .. {high:.4g}", float(error[i] / naive[i]), UNITS[name]])
            found[f"{entry}_in_{UNITS[name]}"] = [float(value), float(low), float(high)]
    report.table(["parameter", "estimate", "95 % interval", "error / naive", "unit"], rows)
    return found


def long_windows(report: Report, train):
    """Windows of LONG from the start values: at once, and by a progressive horizon."""
    single, records = fit_progressively(START, train, (LONG,))
    progressive, records = fit_progressively(START, train, (*HORIZONS, 1.0, LONG))
    found = {"at once": rmse(single.residual, records), "progressive horizon": rmse(progressive.residual, records)}
    report.table([f"windows of {LONG} s from a poor start", "RMSE mrad"], [[k, v] for k, v in found.items()])
    return found


def plot(report: Report, numbers):
    """The unseen trial's error by window, and the friction of each model."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4), width_ratios=(2, 3))
    horizons = [float(name.split()[0]) for name in numbers["test_mrad"]]
    left.loglog(horizons, list(numbers["test_mrad"].values()), "o-", color=COLOURS[0])
    left.set_xticks(horizons, [f"{h:g}" for h in horizons])
    left.minorticks_off()
    left.set_xlabel("window of the unseen trial (s)")
    left.set_ylabel("RMSE of the angles (mrad)")
    terms = [f"{name}{joint}" for name in ("viscous", "dry", "quadratic") for joint in (1, 2)]
    for i, (model, content) in enumerate(numbers["models"].items()):
        known = {name.split("_in_")[0]: value for name, value in content["parameters"].items()}
        at = [k for k, name in enumerate(terms) if name in known]
        value, low, high = np.array([known[terms[k]] for k in at]).T
        right.errorbar(
            np.array(at) + 0.15 * (i - 1), value, [value - low, high - value], fmt=MARKERS[i], color=COLOURS[i],
            label=model, capsize=3,
        )  # fmt: skip
    right.axhline(0, color="black", lw=0.8)
    right.set_xticks(range(len(terms)), [f"{name[:-1]}\njoint {name[-1]}" for name in terms])
    right.set_ylabel("coefficient, with its 95 % interval\n(per inertia of link 1, SI)")
    right.legend()
    report.figure("double_pendulum_measured", figure)
