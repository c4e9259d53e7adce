"""Stiffness and damping of a measured oscillator (Silverbox), fitted by gradient through the step.

Model: m y'' + (c + c2 y^2 + d |y'| + e y y') y' + k y + k2 y^2 + k3 y^3 = u(t - delay) + offset, with u and y in V;
c2 and d belong to the models with 8 and 10 parameters, e and the delay to the one with 10. Only the ratio of the
mechanical parameters to the gain of the input can be found from u and y: the gain is fixed to 1, so that m, c, k, k2
and k3 carry the unit of u over that of their power of y and t.
"""

import time
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.identification import data
from experiments.identification.data import (
    LINEAR,
    RESONANCE,
    SAMPLING_RATE,
    SCALE,
    START,
    STATE_SCALE,
    WASHOUT,
    Record,
    training_residuals,
)
from experiments.identification.scatter import over_scatter
from experiments.parts import rounded
from experiments.report import COLOURS, MARKERS, Report
from hhtjax.plot import fit_against_data, legend, subplots
from hhtjax.runs.extrapolate import richardson

SUBSTEPS = 8
MODELS = {
    "6 parameters": LINEAR,
    "8 parameters": (*LINEAR, "c2", "d"),
    "10 parameters": (*LINEAR, "c2", "d", "e", "delay"),
}
BEST = "10 parameters"
UNITS = {"m": "s^2", "c": "s", "k": "1", "k2": "1/V", "k3": "1/V^2", "offset": "V"}
UNITS |= {"c2": "s/V^2", "d": "s^2/V", "e": "s^2/V", "delay": "s"}


def fit_training(record: Record, substeps: int, alpha: float, terms=LINEAR):
    """Parameters and initial state from the whole record; returns the result, and seconds, warm and with compiling."""
    residuals = training_residuals(record, substeps, alpha)
    guess = {name: START.get(name, 0.0) for name in terms}
    unknown, scale = (guess, data.first_state(record)), ({name: SCALE[name] for name in terms}, STATE_SCALE)
    seconds = []
    for _ in range(2):  # the first time compiles
        start = time.perf_counter()
        result = jax.block_until_ready(hhtjax.fit(residuals, unknown, scale=scale))
        seconds.append(time.perf_counter() - start)
    return result, min(seconds), seconds[0]


@partial(jax.jit, static_argnames="substeps")
def initial_state(params, u, head, guess, substeps: int, alpha: float):
    """Position and velocity of the first sample, fitted to the first outputs."""

    def residuals(start):
        return data.simulate(params, start, u, len(head), substeps, alpha) - head

    return hhtjax.fit(residuals, guess, scale=STATE_SCALE, covariance=False).params


def score(params, record: Record, substeps: int, alpha: float):
    """Simulated output with the initial state fitted to the first samples; RMSE and largest error in mV."""
    u = data.reconstruct(record.u)
    head = data.beginning(u, WASHOUT)
    start = initial_state(params, head, record.y[:WASHOUT], data.first_state(record), substeps, alpha)
    output = np.asarray(data.simulate(params, start, u, len(record.y), substeps, alpha))
    return output, rmse(output - record.y), 1e3 * float(np.max(np.abs(output - record.y)[WASHOUT:]))


def rmse(error):
    """In mV, without the washout."""
    return 1e3 * float(np.sqrt(np.mean(np.asarray(error)[WASHOUT:] ** 2)))


def run(report: Report, fast: bool, full: bool = False):
    """The best model's fit, scores on the official test sets, and chart; full: all models, and what the step size does.

    fast: the whole of it with one model and a part of the data.
    """
    sets = data.load(fast)
    tell(sets, fast)
    names = ["6 parameters"] if fast else list(MODELS) if full else [BEST]
    models, linear, best = {}, None, names[-1]
    for name in names:
        report.progress(
            f"fitting {name} and the initial state to {len(sets.train.y)} samples, twice: the first compiles"
        )
        fit = fit_training(sets.train, SUBSTEPS, 0.0, MODELS[name])
        linear = fit if MODELS[name] == LINEAR else linear
        models[name] = scored(report, sets, fit, name == best, full)
        if name == best and (fast or full):
            plot_parameters(report, fit[0])
    sizes = ("train", *sets.tests)
    report.table(
        ["RMSE in mV", *sizes, "fit, warm, s", "with compiling, s"],
        [
            [name, *(model[f"{part}_mV"] for part in sizes), model["fit_time_s"], model["fit_with_compilation_s"]]
            for name, model in models.items()
        ],
    )
    numbers = {f"{part}_mV": models[best][f"{part}_mV"] for part in sizes}
    numbers |= {"data": "measured" if sets.measured else "generated", "fast": fast, "models": models}
    if fast or full:
        numbers["by_step_size"] = step_size_study(report, sets, fast, linear)
    else:
        print("All models, and the bias of the estimates by step size: python -m experiments silverbox --full\n")
    report.numbers(rounded(numbers))


def tell(sets, fast: bool):
    """Where the data come from, and what is assumed of the input."""
    if sets.measured:
        print("Silverbox, the measured record (Wigren and Schoukens 2013)." + " Parts of it only." * fast)
    else:
        print(f"GENERATED record, known parameters: the measured one was not found. To use it, {data.HOW_TO_GET_IT}.")
    loss = hhtjax.spline_gain_error(RESONANCE, 1 / SAMPLING_RATE)
    print(f"Input: band-limited. A cubic spline would lose {100 * loss:.2g} % of the gain at {RESONANCE:g} Hz.")
    print("The gain of the input is fixed to 1: a common factor of all parameters cannot be identified.\n", flush=True)


def scored(report: Report, sets, fit, chart: bool, full: bool):
    """One model by its fit: its errors on all sets, charted as soon as they are known, and all of it as numbers."""
    result, seconds, compiling = fit
    params = result.params[0]
    costs = ", ".join(f"{x:.4g}" for x in np.asarray(result.history.cost)[: int(result.iterations) + 1])
    report.progress(f"{int(result.iterations)} iterations in {seconds:.2f} s after compilation; cost in V^2: {costs}")
    report.progress(result.reason)
    scores: dict[str, Any] = {"train": (np.asarray(result.residual + sets.train.y), rmse(result.residual), None)}
    for name, record in sets.tests.items():
        scores[name] = score(params, record, SUBSTEPS, 0.0)
        report.progress(f"{name}: {scores[name][1]:.4f} mV")
        if chart and name == "arrow_full":
            plot_fit(report, sets, scores)
    errors, naive = result.standard_errors[0], result.errors(result.uncertainty.naive)[0]
    header = ["parameter", "estimate", "standard error", "error / naive", "unit"]
    rows = [[n, float(params[n]), float(errors[n]), float(errors[n] / naive[n]), UNITS[n]] for n in params]
    if not sets.measured:
        header.insert(2, "true")
        rows = [[*row[:2], data.GENERATED.get(row[0], 0.0), *row[2:]] for row in rows]
    report.table(header, rows)
    numbers = {
        **{f"{name}_mV": value for name, (_, value, _) in scores.items()},
        "largest_error_arrow_full_mV": scores["arrow_full"][2],
        "cost_in_V^2": float(result.cost),
        "alpha": 0.0,
        "substeps": SUBSTEPS,
        "fit_time_s": seconds,
        "fit_with_compilation_s": compiling,
        "iterations": int(result.iterations),
        "reason": result.reason,
        **{f"{name}_in_{UNITS[name]}": float(params[name]) for name in params},
        **{f"standard_error_{name}_in_{UNITS[name]}": float(errors[name]) for name in params},
    }
    if full:
        numbers["standard_error_over_scatter"] = over_scatter(report, sets.train, result, SUBSTEPS)
    return numbers


def step_size_study(report: Report, sets, fast: bool, known):
    """RMSE, fit time, and the bias of stiffness and damping, for other steps per sample and other alphas.

    The bias predicted is that of the linear part's amplification matrix; the one measured is against Richardson's
    value of the three finest steps. Agreement: the relative change of his value from those steps to steps half as long.
    known: the fit with SUBSTEPS and alpha = 0.
    """
    rows, agreement = [], {}
    for alpha in (0.0,) if fast else (0.0, -0.05, -0.3):
        counts = (SUBSTEPS // 2, SUBSTEPS) if fast else (1, 2, 4, 8, 16)
        fits = [
            known if (substeps, alpha) == (SUBSTEPS, 0.0) else fit_training(sets.train, substeps, alpha)
            for substeps in counts
        ]
        ratios = np.array([[float(fit[0].params[0][name] / fit[0].params[0]["m"]) for name in "kc"] for fit in fits])
        exact = richardson(list(ratios[-3:]), 2)
        for levels in () if fast else (2, 3):
            before, after = (richardson(list(x[-levels:]), 2) for x in (ratios[:-1], ratios))
            agreement[f"alpha {alpha}, {levels} levels"] = dict(zip(("k/m", "c/m"), before / after - 1, strict=True))
        for substeps, (result, seconds, _), ratio in zip(counts, fits, ratios, strict=True):
            params = result.params[0]
            test = score(params, sets.tests["multisine"], substeps, alpha)[1]
            m, c, k = (jnp.reshape(params[name], (1,)) for name in ("m", "c", "k"))
            linear = hhtjax.LinearSystem(m, c, k)
            dt = 1 / SAMPLING_RATE / substeps
            bias = hhtjax.step_size_bias(linear, hhtjax.hht(alpha), None, dt, q=jnp.zeros(1))
            rows.append(
                {
                    "alpha": alpha,
                    "substeps": substeps,
                    "wh": float(bias.wh[0]),
                    "train_mV": rmse(result.residual),
                    "multisine_mV": test,
                    "fit_time_s": seconds,
                    "k/m bias %": 100 * (ratio[0] / exact[0] - 1),
                    "predicted k %": 100 * float(bias.stiffness_bias[0]),
                    "c/m bias %": 100 * (ratio[1] / exact[1] - 1),
                    "predicted c %": 100 * float(bias.damping_bias[0]),
                }
            )
            report.progress(f"alpha {alpha}, {substeps} steps per sample: test {test:.4f} mV, fit {seconds:.2f} s")
    report.table(list(rows[0]), [list(row.values()) for row in rows])
    if agreement:
        report.table(["Richardson pairs", "k/m", "c/m"], [[name, *by.values()] for name, by in agreement.items()])
    plot_step_sizes(report, rows)
    return {"rows": rows, "richardson_agreement": agreement}


def plot_fit(report: Report, sets, scores):
    """Measured and simulated output with the residual below: the whole arrow, and where it is loudest."""
    record, (output, value, _) = sets.tests["arrow_full"], scores["arrow_full"]
    seconds = np.arange(len(record.y)) / SAMPLING_RATE
    width, peak = int(0.25 * SAMPLING_RATE), int(np.argmax(np.abs(record.y)))
    first = min(max(0, peak - width // 2), len(record.y) - width)
    figure, axes = subplots(3, 2, width=175, height=135, height_ratios=(3, 2, 3))
    spectra = figure.add_subplot(axes[2, 0].get_gridspec()[2, :])
    for panel in axes[2]:
        panel.remove()
    names = "measured" if sets.measured else "generated", "fitted model, simulated"
    words = {"unit": "mV", "ylabel": "output", "names": names}
    signals = seconds, 1e3 * record.y, 1e3 * output
    fit_against_data(*signals, **words, ax=(axes[0, 0], axes[1, 0], spectra))
    fit_against_data(*signals, **words, show=seconds[[first, first + width - 1]], ax=axes[:2, 1])
    legend(axes[0, 0], title=f"arrow test set: RMSE {value:.3f} mV", alignment="left")
    legend(axes[0, 1], title="a quarter of a second about its peak", alignment="left")
    for panel in axes[:2, 1]:
        panel.set_ylabel("")
    report.figure("silverbox_fit", figure)


def plot_parameters(report: Report, result):
    """Estimates with their standard errors, relative to the estimate, and the cost over the iterations."""
    params, errors = result.params[0], result.standard_errors[0]
    figure, (left, right) = subplots(1, 2, width=175, height=70, width_ratios=(3, 2))
    relative = [100 * float(errors[name] / abs(params[name])) for name in params]
    units = {name: "" if unit == "1" else f" {unit.replace('^2', '²')}" for name, unit in UNITS.items()}
    left.plot(relative, [f"{name} = {float(params[name]):.4g}{units[name]}" for name in params], "o", color=COLOURS[0])
    left.set_xscale("log")
    left.invert_yaxis()
    left.set_xlabel("standard error (% of the estimate)")
    right.semilogy(np.asarray(result.history.cost), "o-", color=COLOURS[1])
    right.set_xlabel("iteration of Levenberg-Marquardt")
    right.set_ylabel("cost (V²)")
    report.figure("silverbox_parameters", figure)


def plot_step_sizes(report: Report, rows):
    """Test error, and the bias of stiffness and damping, measured and predicted, against the steps per sample."""
    figure, axes = subplots(1, 3, width=175, height=65)
    for i, alpha in enumerate(sorted({row["alpha"] for row in rows}, reverse=True)):
        mine = [row for row in rows if row["alpha"] == alpha]
        substeps = [row["substeps"] for row in mine]
        style = {"color": COLOURS[i], "marker": MARKERS[i], "label": f"alpha = {alpha}"}
        axes[0].plot(substeps, [row["multisine_mV"] for row in mine], **style)
        for axis, what in zip(axes[1:], "kc", strict=True):
            axis.plot(substeps, [abs(row[f"{what}/m bias %"]) for row in mine], **style, ls="none")
            axis.plot(substeps, [abs(row[f"predicted {what} %"]) for row in mine], color=COLOURS[i], lw=1)
    labels = "multisine test RMSE (mV)", "bias of k/m (%)", "bias of c/m (%)"
    for axis, label in zip(axes, labels, strict=True):
        axis.set_xscale("log")
        axis.set_yscale("log")
        axis.set_xticks(sorted({row["substeps"] for row in rows}))
        for ticks in (axis.xaxis, axis.yaxis):
            ticks.set_major_formatter("{x:g}")
            ticks.set_minor_formatter("")
        axis.set_xlabel("steps per sample")
        axis.set_ylabel(label)
    axes[0].set_yticks([0.3, 0.5, 1.0, 2.0, 3.0])
    legend(axes[0])
    axes[1].set_title("marks measured, lines predicted", loc="left")
    report.figure("silverbox_step_size", figure)
