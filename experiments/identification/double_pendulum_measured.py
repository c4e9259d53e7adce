"""A measured double pendulum: inertia, gravity and friction from angles with gaps, scored on an unseen trial.

Model, with q from the downward vertical: M = [[1, B cos(q1 - q2)], [., A]], weights g1 sin q1 and g2 sin q2, and joints
with friction. The tracker's angles are q less an offset. Only ratios to the inertia of the first link can be found.

The residuals are the model's error more than noise: so each angle weighs one over its RMS residual, and the best
parameters depend on how long the model is to predict. Which windows to fit for that is chosen within the training
trial, each quarter of it predicted by a fit to the rest.
"""

import time
from functools import cache, partial
from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.identification import pendulum_data
from experiments.report import COLOURS, MARKERS, Report
from hhtjax.plot import legend, subplots

DT = 1e-3  # s; the unseen trial turns at up to 35 rad/s
HORIZONS = (0.125, 0.25, 0.5, 1.0, 2.0)  # s, of the windows of one fit after the other
SHOWN = 0.5  # s, of the windows for the table of parameters
SCORED = (0.25, 0.5, 1.0)  # s
LONG = HORIZONS[-1]
QUARTERS = 4
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


@cache
def errors(num_steps):
    """The function (params, start, record) -> simulated less measured angles, rad; missing samples included."""

    def residuals(params, start, record):
        run = pendulum_data.simulate(params, start["q"], start["v"], DT, num_steps)
        return hhtjax.identification.wrap_angle(hhtjax.interpolate(run, record.t).q - params["offset"] - record.y)

    return residuals


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


def transforms_of(params):
    """Inertia and weights are positive."""
    return POSITIVE | {name: None for name in params if name not in POSITIVE}


def fit_progressively(params0, trial, horizons, **options):
    """One fit after the other, each with longer windows from where the last one ended; and its windows."""
    used = []

    def problem(duration, before):
        records, starts = cut(trial, duration)
        if before is not None:
            starts = states_at(records.begin, used[-1], before)
        used.append(records)
        residuals, weights = errors(steps_of(records)), jnp.asarray(records.present, float)
        return {"residuals": residuals, "records": records, "starts": starts, "weights": weights}

    return hhtjax.fit_progressively(problem, params0, horizons, transforms=transforms_of(params0), **options), used[-1]


def refit(result, records, kept=True, **options):
    """The fit again, each angle with one over its RMS residual as weight, to the windows that are kept."""
    present = np.asarray(records.present)
    sizes = np.sqrt(np.mean(np.asarray(result.residual) ** 2, axis=(0, 1), where=present))
    weights = jnp.asarray(present * np.reshape(kept, (-1, 1, 1)) / sizes)
    return hhtjax.fit(
        errors(steps_of(records)), result.params, records=records, starts=result.starts, weights=weights,
        transforms=transforms_of(result.params), **options,
    )  # fmt: skip


@partial(jax.jit, static_argnames="num_steps")
@partial(jax.vmap, in_axes=(None, 0, 0, None, None))
def initial_states(params, start, record, until, num_steps):
    """Start of a window fitted to its samples until a time, and all its residuals."""
    weights = record.present & (record.t <= until)[:, None]
    residuals = partial(errors(num_steps), params)
    result = hhtjax.fit(lambda start: residuals(start, record), start, weights=weights, covariance=False)
    return result.params, result.residual


def squares(params, trial, duration, inside=(0.0, np.inf)):
    """Sum of squares, rad^2, and number of angles, in windows of a trial with refitted initial states.

    First to the windows' beginnings: over a second, a start by differences ends in a local minimum. inside: the times
    between which whole windows count.
    """
    records, starts = cut(trial, duration)
    residual = None
    for until in SCORED[: SCORED.index(duration) + 1]:
        starts, residual = initial_states(params, starts, records, until, steps_of(records))
    begin, end = records.begin, records.begin + jnp.max(records.t, axis=1)
    counted = np.asarray(records.present & ((begin >= inside[0]) & (end <= inside[1]))[:, None, None])
    return np.array([np.sum(np.asarray(residual)[counted] ** 2), np.sum(counted)])


def score(params, trial, lengths):
    """RMSE in mrad for each length of windows."""
    return [milliradians(squares(params, trial, duration)) for duration in lengths]


def cross_validation(trial, result, records, lengths):
    """The same for each quarter of the trial, with the parameters of a fit to windows that have no part in it."""
    total = np.zeros((len(lengths), 2))
    begin, end = np.asarray(records.begin), np.asarray(records.begin + jnp.max(records.t, axis=1))
    ends = np.linspace(0, trial.t[-1], QUARTERS + 1)
    for quarter in pairwise(ends):
        kept = (end <= quarter[0]) | (begin >= quarter[1])
        params = refit(result, records, kept, covariance=False).params
        total += [squares(params, trial, duration, quarter) for duration in lengths]
    return [milliradians(row) for row in total]


def milliradians(total):
    """Root of the mean of a sum of squares in rad^2."""
    return 1e3 * float(np.sqrt(total[0] / total[1]))


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
    for name, extra in list(FRICTION.items())[: 1 if fast else None]:
        begin = time.perf_counter()
        params0 = START | dict.fromkeys(extra, (0.0, 0.0))
        first, records = fit_progressively(params0, train, up_to(SCORED[0] if fast else SHOWN), covariance=False)
        result = refit(first, records)
        seconds = time.perf_counter() - begin
        report.progress(f"{name}: {rmse(result.residual, records):.3f} mrad on the training windows, {result.reason}")
        numbers["models"][name] = {
            "train_mrad": rmse(result.residual, records),
            "fit_with_compilation_s": seconds,
            "parameters": table_of(report, result),
        }
    numbers |= prediction(report, train, test, SCORED[:1] if fast else SCORED)
    if not fast:
        numbers["long_windows_mrad"] = long_windows(report, train)
    report.numbers(numbers)
    plot(report, numbers)


def up_to(duration):
    """The horizons until this one."""
    return HORIZONS[: HORIZONS.index(duration) + 1]


def prediction(report: Report, train, test, lengths):
    """Errors in predicting the held-out quarters of one trial and the whole other one, by windows fitted and scored.

    test_mrad: for each length scored, with the windows that predict the held-out quarters best.
    """
    held_out, unseen = [], []
    for duration in lengths:
        result, records = fit_progressively(START, train, up_to(duration), covariance=False)
        held_out.append(cross_validation(train, result, records, lengths))
        unseen.append(score(refit(result, records, covariance=False).params, test, lengths))
        report.progress(f"windows of {duration} s fitted, {QUARTERS} quarters and the other trial predicted")
    header = [f"{duration} s" for duration in lengths]
    for name, found in (("held-out quarters", held_out), ("unseen trial", unseen)):
        rows = [[f"{duration} s", *row] for duration, row in zip(lengths, found, strict=True)]
        report.table([f"{name}, mrad: windows fitted, scored", *header], rows)
    best = np.argmin(held_out, axis=0)
    return {
        "windows_s": list(lengths),
        "held_out_mrad": held_out,
        "unseen_mrad": unseen,
        "chosen_windows_s": [lengths[row] for row in best],
        "test_mrad": {name: unseen[row][i] for i, (name, row) in enumerate(zip(header, best, strict=True))},
    }


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
    """Windows of LONG from the start values, at once and by a progressive horizon, by friction model."""
    found = {}
    for name in ("viscous", "viscous and dry"):
        params0 = START | dict.fromkeys(FRICTION[name], (0.0, 0.0))
        for how, horizons in {"at once": (LONG,), "progressive horizon": HORIZONS}.items():
            result, records = fit_progressively(params0, train, horizons, covariance=False)
            found[f"{name}, {how}"] = rmse(result.residual, records)
    report.table([f"windows of {LONG} s from a poor start", "RMSE mrad"], [[k, v] for k, v in found.items()])
    return found


def plot(report: Report, numbers):
    """Errors of predictions by the length of their windows, and the friction of each model."""
    figure, (left, right) = subplots(1, 2, width=175, height=80, width_ratios=(2, 3))
    scored = numbers["windows_s"]
    for i, (name, values) in enumerate({
        "the unseen trial": list(numbers["test_mrad"].values()),
        "held-out quarters of the other": np.min(numbers["held_out_mrad"], axis=0),
    }.items()):  # fmt: skip
        left.loglog(scored, values, marker=MARKERS[i], color=COLOURS[i], label=name)
    left.set_xticks(scored, [f"{x:g}" for x in scored])
    ticks = (1, 1.5, 2, 3, 4, 5, 6, 7)
    left.set_yticks(ticks, [f"{x:g}" for x in ticks])
    legend(left)
    left.minorticks_off()
    left.set_xlabel("window predicted (s)")
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
    legend(right)
    report.figure("double_pendulum_measured", figure)
