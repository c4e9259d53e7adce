"""Stiffness and damping of a measured oscillator (Silverbox), fitted by gradient through the step.

Model: m y'' + c y' + k y + k2 y^2 + k3 y^3 = u + offset, with u and y in V. Only the ratio of the mechanical
parameters to the gain of the input can be found from u and y: the gain is fixed to 1, so that m, c, k, k2
and k3 carry the unit of u over that of their power of y and t.
"""

import time
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import hhtjax
from experiments.identification import data
from experiments.identification.data import SAMPLING_RATE, WASHOUT, Record
from experiments.report import COLOURS, MARKERS, Report

SUBSTEPS = 8
MODEL = "m, c, k, k2, k3, offset"
UNITS = {"m": "s^2", "c": "s", "k": "1", "k2": "1/V", "k3": "1/V^2", "offset": "V"}
# a linear oscillator with the resonance at 68 Hz and 2 % of damping, seen in the spectrum
START = {"m": (2 * np.pi * 68) ** -2.0, "c": 0.04 / (2 * np.pi * 68), "k": 1.0, "k2": 0.0, "k3": 0.0, "offset": 0.0}
SCALE = {"m": 5e-6, "c": 1e-4, "k": 1.0, "k2": 1.0, "k3": 1.0, "offset": 0.01}
STATE_SCALE = {"y": 0.01, "v": 5.0}


def fit_training(record: Record, substeps: int, alpha: float, progress=False):
    """Parameters and initial state from the whole record; returns the result and the warm time in s."""
    record = Record(*map(jnp.asarray, record))

    def residuals(unknown):
        params, start = unknown
        return data.simulate(params, start, record.u, substeps, alpha) - record.y

    unknown, scale = (START, data.first_state(record)), (SCALE, STATE_SCALE)
    seconds = 0.0
    for _ in range(2):  # the first time compiles
        start = time.perf_counter()
        result = jax.block_until_ready(hhtjax.fit(residuals, unknown, scale=scale, progress=progress))
        seconds = time.perf_counter() - start
    return result, seconds


@partial(jax.jit, static_argnames="substeps")
def initial_state(params, head: Record, guess, substeps: int, alpha: float):
    """Position and velocity of the first sample, fitted to the samples of `head`."""

    def residuals(start):
        return data.simulate(params, start, head.u, substeps, alpha) - head.y

    return hhtjax.fit(residuals, guess, scale=STATE_SCALE).params


def score(params, record: Record, substeps: int, alpha: float):
    """Simulated output with the initial state fitted to the first samples; RMSE and largest error in mV."""
    head = Record(record.u[:WASHOUT], record.y[:WASHOUT])
    start = initial_state(params, head, data.first_state(record), substeps, alpha)
    output = np.asarray(data.simulate(params, start, record.u, substeps, alpha))
    return output, rmse(output - record.y), 1e3 * float(np.max(np.abs(output - record.y)[WASHOUT:]))


def rmse(error):
    """In mV, without the washout."""
    return 1e3 * float(np.sqrt(np.mean(np.asarray(error)[WASHOUT:] ** 2)))


def run(report: Report, fast: bool):
    """Fits, scores on the official test sets, and charts error and time against the step size."""
    sets = data.load(fast)
    if sets.measured:
        print("Silverbox, the measured record (Wigren and Schoukens 2013)." + " Parts of it only." * fast)
    else:
        print(f"GENERATED record, known parameters: the measured one was not found. To use it, {data.HOW_TO_GET_IT}.")
    report.progress(f"fitting {MODEL} and the initial state to {len(sets.train.y)} samples")
    result, seconds = fit_training(sets.train, SUBSTEPS, 0.0, progress=True)
    params, errors = result.params[0], result.standard_errors[0]
    report.progress(f"{result.reason}, {int(result.iterations)} iterations, {seconds:.2f} s after compilation")

    header = ["parameter", "estimate", "standard error", "unit"]
    rows = [[name, float(params[name]), float(errors[name]), UNITS[name]] for name in START]
    if not sets.measured:
        header.insert(2, "true")
        rows = [[*row[:2], data.GENERATED[row[0]], *row[2:]] for row in rows]
    report.table(header, rows)
    print("Standard errors assume white residuals; these are coloured, and the true ones about 4 times as large.")
    print("The gain of the input is fixed to 1: a common factor of all parameters cannot be identified.\n")

    scores: dict[str, Any] = {"train": (np.asarray(result.residual + sets.train.y), rmse(result.residual), None)}
    for name, record in sets.tests.items():
        scores[name] = score(params, record, SUBSTEPS, 0.0)
        report.progress(f"{name}: {scores[name][1]:.4f} mV")
    report.table(
        ["set", "RMSE mV", "largest mV", "RMS of the output mV"],
        [
            [name, value, "" if largest is None else largest, rmse(record.y)]
            for (name, (_, value, largest)), record in zip(
                scores.items(), [sets.train, *sets.tests.values()], strict=True
            )
        ],
    )
    plot_fit(report, sets, scores)
    plot_parameters(report, result)
    studies = step_size_study(report, sets, fast)

    summary = {f"{name}_mV": value for name, (_, value, _) in scores.items()}
    report.numbers(
        {
            **summary,
            "data": "measured" if sets.measured else "generated",
            "fast": fast,
            "models": {
                MODEL: {
                    **summary,
                    "largest_error_arrow_full_mV": scores["arrow_full"][2],
                    "alpha": 0.0,
                    "substeps": SUBSTEPS,
                    "fit_time_s": seconds,
                    "iterations": int(result.iterations),
                    "reason": result.reason,
                    **{f"{name}_in_{UNITS[name]}": float(params[name]) for name in START},
                    **{f"standard_error_{name}_in_{UNITS[name]}": float(errors[name]) for name in START},
                }
            },
            "by_step_size": studies,
        }
    )


def step_size_study(report: Report, sets, fast: bool):
    """RMSE, fit time and stiffness for other steps per sample and other alphas."""
    rows = []
    for alpha in (0.0,) if fast else (0.0, -0.05, -0.3):
        for substeps in (1, 4) if fast else (1, 2, 4, 8, 16):
            result, seconds = fit_training(sets.train, substeps, alpha)
            params = result.params[0]
            test = score(params, sets.tests["multisine"], substeps, alpha)[1]
            rows.append(
                {
                    "alpha": alpha,
                    "substeps": substeps,
                    "train_mV": rmse(result.residual),
                    "multisine_mV": test,
                    "fit_time_s": seconds,
                    "k": float(params["k"]),
                    "c_in_s": float(params["c"]),
                }
            )
            report.progress(f"alpha {alpha}, {substeps} steps per sample: test {test:.4f} mV, fit {seconds:.2f} s")
    report.table(list(rows[0]), [list(row.values()) for row in rows])
    plot_step_sizes(report, rows)
    return rows


def plot_fit(report: Report, sets, scores):
    """Measured and simulated output with the residual below: the whole arrow, and where it is loudest."""
    record, (output, value, _) = sets.tests["arrow_full"], scores["arrow_full"]
    seconds = np.arange(len(record.y)) / SAMPLING_RATE
    residual = 1e3 * (record.y - output)
    width, peak = int(0.25 * SAMPLING_RATE), int(np.argmax(np.abs(record.y)))
    first = min(max(0, peak - width // 2), len(record.y) - width)
    figure, axes = plt.subplots(2, 2, figsize=(9, 4.8), sharex="col", height_ratios=(2, 1))
    name = "measured" if sets.measured else "generated"
    parts = {
        f"arrow test set: RMSE {value:.3f} mV": slice(None),
        "a quarter of a second about its peak": slice(first, first + width),
    }
    for (upper, lower), (title, part) in zip(axes.T, parts.items(), strict=True):
        upper.plot(seconds[part], record.y[part], color="black", lw=1.5, label=f"{name} output")
        upper.plot(seconds[part], output[part], color=COLOURS[4], lw=1.0, ls="--", label="fitted model, simulated")
        upper.set_title(title, loc="left", fontsize=9)
        lower.plot(seconds[part], residual[part], color=COLOURS[0], lw=0.6)
        lower.set_xlabel("time (s)")
    axes[0, 0].set_ylabel("output y (V)")
    axes[1, 0].set_ylabel("residual (mV)")
    figure.legend(*axes[0, 1].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    report.figure("silverbox_fit", figure)


def plot_parameters(report: Report, result):
    """Estimates with their standard errors, relative to the estimate, and the cost over the iterations."""
    params, errors = result.params[0], result.standard_errors[0]
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.2), width_ratios=(3, 2))
    relative = [100 * float(errors[name] / abs(params[name])) for name in START]
    units = {name: "" if unit == "1" else f" {unit.replace('^2', '²')}" for name, unit in UNITS.items()}
    left.plot(relative, [f"{name} = {float(params[name]):.4g}{units[name]}" for name in START], "o", color=COLOURS[0])
    left.set_xscale("log")
    left.invert_yaxis()
    left.set_xlabel("standard error (% of the estimate), for white residuals")
    right.semilogy(np.asarray(result.history.cost), "o-", color=COLOURS[1])
    right.set_xlabel("iteration of Levenberg-Marquardt")
    right.set_ylabel("cost (V²)")
    report.figure("silverbox_parameters", figure)


def plot_step_sizes(report: Report, rows):
    """Test error, fit time and the identified stiffness against the steps per sample."""
    figure, axes = plt.subplots(1, 3, figsize=(10, 3.2))
    finest = max(row["substeps"] for row in rows)
    for i, alpha in enumerate(sorted({row["alpha"] for row in rows}, reverse=True)):
        mine = [row for row in rows if row["alpha"] == alpha]
        best = next(row["k"] for row in mine if row["substeps"] == finest)
        substeps = [row["substeps"] for row in mine]
        style = {"color": COLOURS[i], "marker": MARKERS[i], "label": f"alpha = {alpha}"}
        axes[0].plot(substeps, [row["multisine_mV"] for row in mine], **style)
        axes[1].plot(substeps, [row["fit_time_s"] for row in mine], **style)
        axes[2].plot(substeps[:-1], [100 * abs(row["k"] / best - 1) for row in mine[:-1]], **style)
    for axis, label in zip(
        axes, ("multisine test RMSE (mV)", "fit time, warm (s)", f"|k / k at {finest} steps - 1| (%)"), strict=True
    ):
        axis.set_xscale("log")
        axis.set_yscale("log")
        axis.set_xticks(sorted({row["substeps"] for row in rows}))
        for ticks in (axis.xaxis, axis.yaxis):
            ticks.set_major_formatter("{x:g}")
            ticks.set_minor_formatter("")
        axis.set_xlabel("steps per sample")
        axis.set_ylabel(label)
    axes[0].set_yticks([0.3, 0.5, 1.0, 2.0, 3.0])
    axes[1].set_yticks([0.05, 0.1, 0.2, 0.5, 1.0])
    axes[0].legend()
    report.figure("silverbox_step_size", figure)
