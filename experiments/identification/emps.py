"""Mass and dry friction of a positioning axis (EMPS benchmark), from open-loop motion with set-valued friction.

    M q'' = g u(t - delay) - Fv q' - Fa |q'| - offset - tau,    tau = F sign(q') sliding, |tau| <= F sticking

with F = Fc, in some models with a part that grows with the motor's force, or that is only there at low speed. The axis
integrates: a constant force of 0.05 N moves it by a millimetre within the record. Models are fitted to the training
record and chosen there, by the error on parts of it that were left out; the test record is scored with what was chosen.
"""

import time

import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.identification import emps_data as data
from experiments.parts import rounded
from experiments.report import COLOURS, MARKERS, Report
from hhtjax.plot import held_out, legend, subplots

COULOMB = ("M", "Fc", "offset")
VISCOUS = ("M", "Fv", "Fc", "offset")
MODELS = {
    "Coulomb alone": COULOMB,
    "viscous": VISCOUS,
    "viscous, two directions": (*VISCOUS, "Fa"),
    "viscous, friction by load": (*VISCOUS, "load"),
    "viscous, stiction": (*VISCOUS, "Fs"),
    "viscous, input delay": (*VISCOUS, "delay"),
    "viscous, two directions, stiction": (*VISCOUS, "Fa", "Fs"),
}
UNITS = {"M": "kg", "Fv": "N_s/m", "Fa": "N_s/m", "Fc": "N", "Fs": "N", "offset": "N", "delay": "s", "load": "1"}
SCALE = {"M": 100.0, "Fv": 200.0, "Fa": 20.0, "Fc": 20.0, "Fs": 2.0, "offset": 3.0, "delay": 1e-3, "load": 0.01}
PUBLISHED = {"M": 95.1089, "Fv": 203.5034, "Fc": 20.3935, "offset": -3.1648}  # by the benchmark's authors
CUTOFF = 20.0  # Hz, of the force regression
SLIDING = 0.005  # m/s, above which it looks
FOLDS = 5
# The cost has a kink wherever a stop falls on another step, and no vanishing gradient at a minimum there: most fits end
# by their iterations, the last of which change next to nothing, and where they end is not always the least of all. So
# each starts again from points drawn from the covariance of its estimate, which follows the valley.
ITERATIONS, AGAIN, LAST, RESTARTS = 16, 10, 5, 5  # of a fit, of one from an estimate; the last ones; starts
TOLERANCE = 1e-5
VALLEY = 1 + 0.02 * np.arange(-3, 4)  # of the estimate


def run(report: Report, fast: bool):
    """Regression of forces, fits of all models, the choice among them, its score, and what a fit cannot know."""
    sets = data.load(fast)
    if sets.measured:
        print("EMPS, the records of the benchmark (Janot, Gautier, Brunot 2019)." + " Parts of them only." * fast)
    else:
        print(f"GENERATED records: those of the benchmark were not found. To use them, {data.HOW_TO_GET_IT}.")
    numbers = {"data": "measured" if sets.measured else "generated", "fast": fast}
    regressed = {part: regression(getattr(sets, part), sets.hold) for part in data.PARTS}
    numbers["force_regression"] = {part: by_unit(own) for part, own in regressed.items()}
    report.table(["force regression", *VISCOUS], [[n, *(own[x] for x in VISCOUS)] for n, own in regressed.items()])
    models = {name: terms for name, terms in MODELS.items() if not fast or terms in (COULOMB, VISCOUS)}
    fits = {name: fit(report, sets, name, terms, regressed["train"]) for name, terms in models.items()}
    compared = compare(report, sets, fits, numbers, fast)
    chosen = fits[compared.chosen]
    print(f"{compared.chosen}, on the training record:\n{chosen.summary()}\n")
    numbers |= {"chosen": compared.chosen, "estimate": estimate(chosen)}
    numbers["standard_error_over_naive"] = over_naive(chosen)
    numbers["published_parameters"] = by_unit(PUBLISHED) | scores(sets, PUBLISHED | {"delay": sets.hold})
    if not fast:
        numbers["other_friction"] = other_friction(report, sets, chosen)
    numbers["valley"] = {name: valley(report, sets, chosen, name, fast) for name in ("M", "Fc")[: 2 - fast]}
    plot_fit(report, sets, chosen)
    plot_valley(report, numbers["valley"], chosen)
    report.numbers(rounded(numbers))


def by_unit(own):
    """Numbers by name and unit."""
    return {f"{name}_in_{UNITS[name]}": float(own[name]) for name in own}


def scores(sets, own):
    """Errors of both records."""
    return {f"{part}_mm": data.score(own, getattr(sets, part))[1] for part in data.PARTS}


def regression(record, hold):
    """M, Fv, Fc and the offset from forces alone: least squares of M a + Fv v + Fc sign(v) + offset = g u, filtered.

    Motion, input and sign go through the same filter, so that its smearing cancels; samples near a stop are left out.
    """
    t = data.DT * np.arange(len(record.u))
    late = np.interp(t - hold, t, record.u)
    _, v, a = (np.asarray(x) for x in hhtjax.band_limited_motion(record.y, data.DT, CUTOFF))
    filtered = [np.asarray(hhtjax.band_limited_motion(x, data.DT, CUTOFF)[0]) for x in (np.sign(v), data.GAIN * late)]
    end = int(2 / CUTOFF / data.DT)
    kept = (np.abs(v) > SLIDING) & (np.arange(len(t)) >= end) & (np.arange(len(t)) < len(t) - end)
    X = np.stack([a, v, filtered[0], np.ones_like(v)], axis=1)[kept]
    return dict(zip(VISCOUS, np.linalg.lstsq(X, filtered[1][kept], rcond=None)[0].tolist(), strict=True))


def training(sets):
    """The function of the parameters that is fitted, mm."""
    u, y = data.reconstruct(sets.train.u), jnp.asarray(sets.train.y)
    return lambda own: 1e3 * (data.simulate(own, u, y[0], len(y)) - y)


RESIDUALS = {}  # one function for each data set, so that its programs are compiled once


def residuals_of(sets):
    """The same function each time."""
    return RESIDUALS.setdefault((len(sets.train.y), sets.measured), training(sets))


def options(own, terms):
    """Arguments of a fit of some of the parameters."""
    return {
        "transforms": {name: None if name in terms else hhtjax.fixed for name in own},
        "scale": {name: SCALE[name] for name in own},
        "tolerance": TOLERANCE,
    }


def fit(report, sets, name, terms, start):
    """A model by the error of its simulated position, from the force regression on, and from near the estimate."""
    own = {x: jnp.asarray(start.get(x, 0.0)) for x in terms} | {"delay": jnp.asarray(sets.hold)}
    begun = time.perf_counter()
    every = {"max_iterations": ITERATIONS, **options(own, terms)}
    result, costs, rng = hhtjax.fit(residuals_of(sets), own, **every), [], np.random.default_rng(0)
    for _ in range(1 if len(sets.train.y) < 20_000 else RESTARTS):
        costs.append(float(result.cost))
        again = hhtjax.fit(residuals_of(sets), drawn(result, rng), **every)
        result = min(result, again, key=lambda x: float(x.cost))
    seconds = time.perf_counter() - begun
    rms = data.score(result.params, sets.train)[1]
    report.progress(f"{name}: {rms:.4f} mm; {seconds:.1f} s with compiling; costs {np.round([*costs, result.cost], 1)}")
    return result


def drawn(result, rng):
    """Parameters near an estimate, by its covariance."""
    names = [name for name, free in zip(sorted(result.params), result.free, strict=True) if free]
    away = dict(zip(names, rng.multivariate_normal(np.zeros(len(names)), result.uncertainty.covariance), strict=True))
    return {name: x + away.get(name, 0.0) for name, x in result.params.items()}


def compare(report, sets, fits, numbers, fast):
    """Errors on parts of the training record left out; the test record is scored beside it, and has no say."""
    report.progress(f"each model again, with one of {FOLDS} parts of the training record left out")
    again = {"max_iterations": AGAIN, "tolerance": TOLERANCE}
    compared = hhtjax.compare(fits, residuals_of(sets), folds=2 if fast else FOLDS, progress=True, **again)
    print(f"{compared.summary()}\n")
    found = {}
    for i, (name, result) in enumerate(fits.items()):
        found[name] = scores(sets, result.params) | {
            "parameters": int(compared.parameters[i]),
            "held_out_mm": float(compared.cross_validated[i]),
            "behind_the_best": float(compared.behind[i, 0] / (compared.behind[i, 1] or 1.0)),
            "BIC_less_the_least": float(compared.bic[i] - compared.bic.min()),
            "iterations": int(result.iterations),
            "reason": result.reason,
            "still_lowered_by": lowered_last(result),
        }
    columns = ("parameters", "train_mm", "held_out_mm", "behind_the_best", "test_mm")
    report.table(["model", *columns], [[name, *(row[c] for c in columns)] for name, row in found.items()])
    numbers |= {"observations": compared.observations, "worth_independent": compared.effective, "models": found}
    if not fast:
        figure, ax = subplots(1, 1, width=130, height=75)
        held_out(compared, unit="mm", ax=ax).set_xscale("log")
        report.figure("emps_models", figure)
    return compared


def lowered_last(result):
    """The relative change of the cost in the last iterations."""
    cost = np.asarray(result.history.cost)
    return float(cost[-1 - min(LAST, len(cost) - 1)] / cost[-1] - 1)


def estimate(result):
    """Parameters, standard errors, ends of intervals."""
    lower, upper = result.interval()
    free = [name for name in result.params if result.standard_errors[name] > 0]
    return by_unit(result.params) | {
        f"{what}_{name}_in_{UNITS[name]}": float(x[name])
        for what, x in {"standard_error": result.standard_errors, "lower": lower, "upper": upper}.items()
        for name in free
    }


def over_naive(result):
    """The least and the largest ratio of a standard error to the textbook's."""
    naive = result.errors(result.uncertainty.naive)
    ratios = [float(result.standard_errors[name] / naive[name]) for name in naive if naive[name] > 0]
    return [min(ratios), max(ratios)]


def other_friction(report, sets, result):
    """Not a score: the same model with friction and offset fitted to the test record, which says what has changed."""
    u, y = data.reconstruct(sets.test.u), jnp.asarray(sets.test.y)
    again = hhtjax.fit(
        lambda own: 1e3 * (data.simulate(own, u, y[0], len(y)) - y),
        dict(result.params),
        max_iterations=AGAIN,
        **options(result.params, ("Fc", "offset")),
    )
    ratio = float(again.params["Fc"] / result.params["Fc"])
    error = data.score(again.params, sets.test)[1]
    report.progress(f"with Fc and offset of the test record itself: {error:.3f} mm, Fc {100 * (ratio - 1):+.2f} %")
    return {"test_mm": error, "Fc_over_training": ratio, "offset_in_N": float(again.params["offset"])}


def valley(report, sets, result, name, fast):
    """One parameter held at several values and all others fitted again: errors of both records."""
    terms = [x for x in result.params if result.standard_errors[x] > 0 and x != name]
    rows, own = [], {}
    for factor in VALLEY[::3] if fast else VALLEY:
        own = dict(result.params) | {name: result.params[name] * factor}
        again = hhtjax.fit(residuals_of(sets), own, max_iterations=AGAIN, covariance=False, **options(own, terms))
        rows.append(by_unit(again.params) | scores(sets, again.params))
    key = f"{name}_in_{UNITS[name]}"
    report.table([key, "train mm", "test mm"], [[f"{row[key]:.4g}", row["train_mm"], row["test_mm"]] for row in rows])
    return rows


def plot_fit(report, sets, result):
    """The test record with its simulation, and the errors of both records."""
    figure, (upper, lower) = subplots(2, 1, width=120, height=95, sharex=True)
    t = data.DT * np.arange(len(sets.test.y))
    errors = {part: data.score(result.params, getattr(sets, part))[0] for part in data.PARTS}
    upper.plot(t, 1e3 * sets.test.y, color="black", lw=1.6, label="measured" if sets.measured else "generated")
    upper.plot(t, 1e3 * sets.test.y + errors["test"], color=COLOURS[4], lw=1.0, ls="--", label="simulated, open loop")
    upper.set_ylabel("test record, q (mm)")
    for i, (part, error) in enumerate(errors.items()):
        lower.plot(t, error, color=COLOURS[i], lw=1.0, ls=("-", "--")[i], label=f"{part} record")
    lower.set(xlabel="time (s)", ylabel="error (mm)")
    legend(upper)
    legend(lower)
    report.figure("emps_fit", figure)


def plot_valley(report, found, result):
    """Errors over mass and friction, all other parameters fitted again."""
    figure, axes = subplots(1, 2, width=150, height=62, sharey=True)
    for ax, (name, rows) in zip(axes[: len(found)], found.items(), strict=True):
        x = [row[f"{name}_in_{UNITS[name]}"] for row in rows]
        for i, part in enumerate(data.PARTS):
            ax.plot(x, [row[f"{part}_mm"] for row in rows], color=COLOURS[i], marker=MARKERS[i], label=part)
        ends = [float(end[name]) for end in result.interval()]
        ax.axvspan(*ends, color="#808080", alpha=0.15, lw=0, label="95 % interval")
        ax.axvline(float(result.params[name]), color="black", lw=0.8, ls=":", label="estimate")
        ax.set_xlabel(f"{name} ({UNITS[name]})")
    axes[0].set_ylabel("RMSE (mm)")
    legend(axes[0])
    report.figure("emps_valley", figure)
