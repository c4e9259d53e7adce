"""Two tanks that overflow, a first-order system under a held input; the model chosen by cross-validation.

The equations and their further terms are in `tanks_data`. Each model starts from the estimate of the one that it adds
to, and the first one is fitted to a part of the record before the whole. Estimates and choice use the training record
alone: its quarters are left out in turn, and simulated by the fit to the rest. The test record is scored from the
initial state of the training record, as the benchmark has it, and also with the lower level of its first samples.
"""

import time

import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.identification import tanks_data as data
from experiments.parts import rounded
from experiments.report import COLOURS, Report
from hhtjax.plot import estimates, fit_against_data, legend, subplots

SUBSTEPS = 2
QUARTERS = 4
ITERATIONS = 100
HEAD = 25  # samples at the start that every fold keeps: they alone tell the initial state
FIRST = 400  # samples of the part that the first model is fitted to before the whole
UNITS = {"k1": "V^0.5/s", "k2": "V^0.5/s", "k3": "V^0.5/s", "k4": "1/s", "u0": "V", "x1": "V", "x2": "V"}
UNITS |= {"over": "1", "rim": "V", "caught": "1/V", "linear": "1/s", "jump": "V", "stick": "V", "pressure": "V^0.5"}
SCALE = {"k1": 0.03, "k2": 0.05, "k3": 0.08, "k4": 0.03, "u0": 1.0, "x1": 5.0, "x2": 5.0}
SCALE |= {"over": 1.0, "rim": 1.0, "caught": 0.05, "linear": 0.02, "jump": 0.3, "stick": 1.0, "pressure": 0.5}
START = {"k1": 0.035, "k2": 0.05, "k3": 0.06, "k4": 0.03, "u0": 0.0, "x1": 6.0, "x2": 5.2}
# each adds these to the model named, with the values to start from; None for what it leaves out
MODELS = {
    "Torricelli, upper rim": (None, START),
    "overflow into the lower tank, its rim": ("Torricelli, upper rim", {"over": 1.0, "rim": 10.3}),
    "inflow by the lower level": ("overflow into the lower tank, its rim", {"caught": 0.03}),
    "reading that sticks": ("inflow by the lower level", {"jump": 0.3, "stick": 5.4}),
    "jet's pressure": ("reading that sticks", {"pressure": 0.1}),
    "linear outflow": ("jet's pressure", {"k3": None, "linear": 0.03, "caught": 0.4, "k2": 0.015}),
}
PUBLISHED = {"linear": 0.75, "Volterra": 0.54, "Gaussian process state space": 0.45, "nonlinear state space": 0.34,
             "neural state space": 0.33, "grey box with overflow": 0.18}  # fmt: skip


def run(report: Report, fast: bool):
    """Fits the models, compares them by cross-validation, and scores the one chosen on the test record."""
    sets = data.load(fast)
    if sets.measured:
        print("Cascaded tanks, the measured records (Schoukens et al. 2016)." + " Parts of them only." * fast)
    else:
        print(f"GENERATED records: the measured ones were not found. To use them, {data.HOW_TO_GET_IT}.")
    results = {}
    for name in list(MODELS)[:2] if fast else MODELS:
        before, terms = MODELS[name]
        start = dict(terms if before is None else results[before].params | terms)
        start = {key: value for key, value in start.items() if value is not None}
        results[name] = fit_record(report, name, sets.train, start)
    rows = compare(report, sets, results)
    report.table(list(rows[0]), [list(row.values()) for row in rows])
    chosen = min(rows, key=lambda row: row["left_out_V"])["model"]
    print(f"Chosen by the parts left out of the training record: {chosen}.\n")
    result = results[chosen]
    numbers = of_chosen(report, sets, result) | {"models": rows, "chosen": chosen}
    if sets.measured and not fast:
        numbers["published_test_V"] = PUBLISHED
    plot(report, sets, result, rows)
    numbers |= {"data": "measured" if sets.measured else "generated", "fast": fast}
    report.numbers(rounded(numbers))


def compare(report: Report, sets, results):
    """Rows of the models: errors in V, of each quarter, too, as simulated by the fit to all the rest.

    Simulations run through the quarter left out, whose outputs have no weight; the fits start from the estimates.
    """
    report.progress("each model again, with a quarter of the training record left out")
    keep = np.arange(len(sets.train.y)) < HEAD
    compared = hhtjax.compare(
        results, residuals_of(sets.train), folds=QUARTERS, always=keep, max_iterations=ITERATIONS, progress=True
    )
    print(f"{compared.summary()}\n")
    return [
        {
            "model": name,
            "parameters": len(result.params),
            "train_V": rmse(result.residual),
            "left_out_V": float(compared.cross_validated[i]),
            "behind_the_best": float(compared.behind[i, 0] / (compared.behind[i, 1] or 1.0)),
            "test_V": rmse(simulated(result.params, sets.test) - sets.test.y),
            "fit_converged": bool(result.converged),
        }
        for i, (name, result) in enumerate(results.items())
    ]


def residuals_of(record, samples=None):
    """The simulated reading of the first samples, or of all, less the measured one: a function of the parameters."""
    u, y = (jnp.asarray(x[:samples]) for x in record)
    return lambda own: data.simulate(own, u, SUBSTEPS) - y


def fit_record(report: Report, name, record, start):
    """The least squares of the simulated reading; the first model is fitted to a part of the record before."""
    begun = time.perf_counter()
    parts = sorted({min(FIRST, len(record.y)), len(record.y)} if name == next(iter(MODELS)) else {len(record.y)})
    result = hhtjax.fit_progressively(
        lambda n, _: {"residuals": residuals_of(record, n)},
        start,
        parts,
        scale={name: SCALE[name] for name in start},
        max_iterations=ITERATIONS,
    )
    seconds = time.perf_counter() - begun
    report.progress(f"{name}: {rmse(result.residual):.3f} V, {seconds:.0f} s with compiling; {result.reason}")
    return result


def simulated(params, record, start=None):
    """The reading over a record."""
    return np.asarray(data.simulate(params, jnp.asarray(record.u), SUBSTEPS, start=start))


def rmse(error):
    """In V."""
    return float(np.sqrt(np.mean(np.asarray(error) ** 2)))


def of_chosen(report: Report, sets, result):
    """Estimates with intervals, errors of the test record from either start, and what the step does to them."""
    lower, upper = result.interval()
    errors, naive = result.standard_errors, result.errors(result.uncertainty.naive)
    report.table(
        ["parameter", "estimate", "lower", "upper", "error / naive", "unit"],
        [[n, *(float(x[n]) for x in (result.params, lower, upper)), float(errors[n] / naive[n]), UNITS[n]]
         for n in result.params],
    )  # fmt: skip
    first = float(np.mean(sets.test.y[: data.INITIAL]))
    finer = {
        f"{substeps}": rmse(np.asarray(data.simulate(result.params, jnp.asarray(sets.test.u), substeps)) - sets.test.y)
        for substeps in (SUBSTEPS, 2 * SUBSTEPS, 8 * SUBSTEPS)
    }
    numbers = {
        "parameters": len(result.params),
        "train_V": rmse(result.residual),
        "test_V": rmse(simulated(result.params, sets.test) - sets.test.y),
        "test_from_its_first_samples_V": rmse(simulated(result.params, sets.test, first) - sets.test.y),
        "test_by_steps_in_a_sample_V": finer,
        "reason": result.reason,
        "estimates": {f"{n}_in_{UNITS[n]}": float(x) for n, x in result.params.items()},
        "interval_95": {n: [float(lower[n]), float(upper[n])] for n in result.params},
        "standard_error_over_naive": {n: float(errors[n] / naive[n]) for n in result.params},
    }
    report.progress(
        f"test: {numbers['test_V']:.4f} V; {numbers['test_from_its_first_samples_V']:.4f} V by its first samples"
    )
    return numbers


def plot(report: Report, sets, result, rows):
    """The test record with residual and spectra, and beside them the models' errors and the chosen one's intervals."""
    figure, axes = subplots(3, 2, width=175, height=150, width_ratios=(3, 2), height_ratios=(3, 2, 3))
    t = data.DT * np.arange(len(sets.test.y))
    fit_against_data(
        t, sets.test.y, simulated(result.params, sets.test), unit="V", ylabel="lower level, test", ax=axes[:, 0]
    )
    for place in axes[:, 1]:
        place.remove()
    grid = axes[0, 0].get_gridspec()
    upper, lower = figure.add_subplot(grid[0, 1]), figure.add_subplot(grid[1:, 1])
    styles = {"train_V": ("training", "o"), "left_out_V": ("left out", "s"), "test_V": ("test", "^")}
    for i, (key, (label, marker)) in enumerate(styles.items()):
        upper.plot(
            [row["parameters"] for row in rows], [row[key] for row in rows], marker, color=COLOURS[i], label=label
        )
    upper.set(xlabel="parameters", ylabel="RMSE (V)")
    upper.set_ylim(bottom=0)
    legend(upper)
    estimates(result, ax=lower)
    report.figure("tanks", figure)
