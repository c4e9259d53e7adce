"""Six parameters of a hysteretic oscillator (Bouc-Wen benchmark), fitted through the step with its internal state.

    m y'' + c y' + k y + z = u(t),    z' = alpha y' - beta (gamma |y'| z + delta y' |z|)

beta, gamma and delta enter as beta gamma and beta delta only, and these are fitted; the exponent of |z| is known, 1.
The training record alone is used. The model has the structure of the system that made the data: its errors stand beside
those of black boxes, which know nothing of it, for scale only.
"""

import time

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.identification import bouc_wen_data as data
from experiments.parts import rounded
from experiments.report import COLOURS, Report
from hhtjax.plot import error_against_h, fit_against_data, subplots
from hhtjax.scenes import bouc_wen

SUBSTEPS = 5  # of the fit
UNITS = {"m": "kg", "c": "N_s/m", "k": "N/m", "alpha": "N/m", "beta_gamma": "1/m", "beta_delta": "1/m"}
OFF = {"m": 1.2, "c": 0.75, "k": 0.85, "alpha": 1.2, "beta_gamma": 0.7, "beta_delta": 1.25}  # where the fit starts
BLACK_BOXES = {"NFIR": 1.63e-4, "dynoNet": 4.52e-5, "polynomial state space": 1.87e-5}  # m, multisine, published


def run(report: Report, fast: bool):
    """Scores the true parameters at several step sizes, fits them from another start, and scores the fit."""
    sets = data.load(fast)
    if sets.measured:
        print("Bouc-Wen, the records of the benchmark (Noel and Schoukens 2016)." + " Parts of them only." * fast)
    else:
        print(f"GENERATED records: those of the benchmark were not found. To use them, {data.HOW_TO_GET_IT}.")
    table = true_parameters(report, sets, fast)
    numbers, outputs = identify(report, sets, SUBSTEPS)
    if not fast:
        numbers["with_half_the_step"], _ = identify(report, sets, 2 * SUBSTEPS)
    if sets.measured and not fast:
        numbers["black_boxes_multisine_m"] = BLACK_BOXES
    plot(report, sets, outputs, table)
    numbers |= {"true_parameters": table, "data": "benchmark" if sets.measured else "generated", "fast": fast}
    report.numbers(rounded(numbers))


def true_parameters(report: Report, sets, fast):
    """RMSE of both tests with the parameters that made them, by steps in a sample and alpha: the method alone."""
    rows = []
    for alpha in (0.0, -0.05):
        for substeps in (1, SUBSTEPS) if fast else (1, 2, SUBSTEPS, 10, data.FINEST):
            row = {"alpha": alpha, "substeps": substeps}
            for name, record in sets.tests.items():
                if name == "multisine" or substeps <= SUBSTEPS:  # the input between the samples of a sweep is not known
                    row[f"{name}_m"] = data.score(bouc_wen.BENCHMARK, record, substeps, jnp.asarray(alpha))[1]
            rows.append(row)
            report.progress(f"alpha {alpha}, {substeps} steps in a sample: {row['multisine_m']:.3g} m")
    names = list(rows[0])
    report.table(names, [[row.get(name, "") for name in names] for row in rows])
    return rows


def identify(report: Report, sets, substeps):
    """The fit to the training record, what it found and left of the tests, and the simulated outputs of these."""
    record = sets.train
    u = data.reconstruct(record.u, record.period, substeps)
    y = jnp.asarray(record.y)

    def residuals(params):
        return data.simulate(params, u, len(record.y), substeps) - y

    truth = bouc_wen.BENCHMARK
    guess = {name: value * OFF[name] for name, value in truth.items()}
    scale = {name: abs(value) for name, value in guess.items()}
    begun = time.perf_counter()
    result = jax.block_until_ready(hhtjax.fit(residuals, guess, scale=scale, progress=True))
    seconds = time.perf_counter() - begun
    report.progress(f"{result.reason}, {int(result.iterations)} iterations, {seconds:.1f} s with compiling")
    rows = [
        [n, float(result.params[n]), truth[n], float(result.params[n] / truth[n] - 1) * 100, guess[n],
         float(result.standard_errors[n]), UNITS[n]]
        for n in truth
    ]  # fmt: skip
    report.table(["parameter", "estimate", "true", "off by %", "start", "standard error", "unit"], rows)
    numbers = {
        "train_samples": len(record.y),
        "train_error_m": float(np.sqrt(np.mean(np.asarray(result.residual) ** 2))),
        "substeps": substeps,
        "iterations": int(result.iterations),
        "reason": result.reason,
        "fit_with_compilation_s": seconds,
        "off_by_percent": {name: row[3] for name, row in zip(truth, rows, strict=True)},
        "start_over_truth": OFF,
        **{f"{name}_in_{UNITS[name]}": row[1] for name, row in zip(truth, rows, strict=True)},
        **{f"standard_error_{name}_in_{UNITS[name]}": row[5] for name, row in zip(truth, rows, strict=True)},
    }
    outputs = {}
    for name, test in sets.tests.items():
        outputs[name], error = data.score(result.params, test, substeps)
        numbers[f"{name}_error_m"] = error
        report.progress(f"{name}: {error:.3g} m rms of {np.std(test.y):.3g} m")
    return numbers, outputs


def plot(report: Report, sets, outputs, table):
    """A part of the multisine with the error of the fitted model, and the error of the method by step size."""
    record, output = sets.tests["multisine"], outputs["multisine"]
    part = slice(0, 200)
    t = data.DT * np.arange(len(record.y))[part]
    figure, ((upper, steps), (lower, sweep)) = subplots(2, 2, width=175, height=110, height_ratios=(3, 2))
    names = "benchmark" if sets.measured else "generated", "fitted model"
    curves = 1e3 * record.y[part], 1e3 * output[part]
    fit_against_data(t, *curves, names=names, unit="mm", ylabel="multisine, y", ax=(upper, lower))
    errors = {}
    for alpha in sorted({row["alpha"] for row in table}, reverse=True):
        rows = [row for row in table if row["alpha"] == alpha]
        errors[f"alpha = {alpha}"] = [data.DT / x["substeps"] for x in rows], [1e6 * x["multisine_m"] for x in rows]
    error_against_h(errors, slopes=(2,), ax=steps)
    steps.set_ylabel("RMSE, true parameters (μm)")
    error = outputs["sinesweep"] - sets.tests["sinesweep"].y
    sweep.plot(data.DT * np.arange(len(error)), 1e6 * error, color=COLOURS[0], lw=0.3)
    sweep.set_ylabel("error of the sweep (μm)")
    sweep.set_xlabel("time (s)")
    report.figure("bouc_wen", figure)
