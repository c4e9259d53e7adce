"""Silverbox: which physics the model with 10 parameters lacks, by a score test and by parts left out of the training.

Terms are added to the model of `silverbox` one after the other: of each kind of candidates the one that the score test
puts first is fitted, and of these the one is kept that predicts parts left out of the training record best. The test
sets have no say in it. Forces, less them in m y'' = ..., and readings:

    v = y',   x' = (y - x)/FAST,   s' = (y^2 - s)/SLOW:   a relaxing spring, a slow drift of the stiffness
    reading = y + amplitude_lag y^2 v + ...:   later by -amplitude_lag y^2
"""

import time
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.identification import data
from experiments.identification.data import SAMPLING_RATE, SCALE, STATE_SCALE, WASHOUT, Record
from experiments.identification.silverbox import BEST, MODELS, rmse
from experiments.parts import rounded
from experiments.report import COLOURS, MARKERS, Report
from hhtjax.identification import score_test
from hhtjax.plot import legend, subplots
from hhtjax.scenes import duffing

SUBSTEPS = 4  # of rk4, more exact than the 8 non-iterative ones of `silverbox`
ROUNDS = 2  # terms added
WORTH = 1 / 3  # of the largest drop of the cost that the score test promises: candidates below are not fitted
FOLDS = 8  # of the training record, left out in turn
FAST, SLOW = 2e-3, 0.3  # s
FORCES = {  # name: force over its parameter, and the parameter's typical size and unit
    "k4": (lambda y, v, z: y**4, 1.0, "1/V^3"),
    "k5": (lambda y, v, z: y**5, 10.0, "1/V^4"),
    "asymmetric": (lambda y, v, z: y * jnp.abs(y), 0.1, "1/V"),
    "coulomb": (lambda y, v, z: jnp.tanh(v), 1e-4, "V"),
    "v2": (lambda y, v, z: v**2, 1e-8, "s^2/V"),
    "v3": (lambda y, v, z: v**3, 1e-9, "s^3/V^2"),
    "c1": (lambda y, v, z: y * v, 1e-4, "s/V"),
    "c_abs": (lambda y, v, z: jnp.abs(y) * v, 1e-4, "s/V"),
    "c4": (lambda y, v, z: y**4 * v, 1e-2, "s/V^4"),
    "d2": (lambda y, v, z: y**2 * jnp.abs(v) * v, 1e-5, "s^2/V^3"),
    "above": (lambda y, v, z: jnp.maximum(jnp.abs(y) - 0.15, 0) ** 2 * jnp.sign(y), 1.0, "1/V"),
    "relaxing": (lambda y, v, z: z[0], 1e-2, "1"),
    "relaxing_cubic": (lambda y, v, z: y**2 * z[0], 1.0, "1/V^2"),
    "drift": (lambda y, v, z: y * z[1], 1.0, "1/V^2"),
}
READINGS = {
    "bent": (lambda y, v: y**2, 1e-2, "1/V"),
    "bent3": (lambda y, v: y**3, 1e-1, "1/V^2"),
    "amplitude_lag": (lambda y, v: y**2 * v, 1e-4, "s/V^2"),
}
CANDIDATES = FORCES | READINGS
WITH_STATES = "relaxing", "relaxing_cubic", "drift"
STIFFNESS = "k4", "k5", "asymmetric", "above"
KINDS = [  # the first of each is fitted
    {name for name in FORCES if name not in WITH_STATES + STIFFNESS},
    set(STIFFNESS),
    set(WITH_STATES),
    set(READINGS),
]


def force(q, v, t, params, z=(0.0, 0.0)):
    """That of `silverbox`, less those of the candidates that params names."""
    own, _ = params
    y, rate = q, v
    return data.force(q, v, t, params) - sum(
        own[name] * term(y, rate, z) for name, (term, *_) in FORCES.items() if name in own
    )


def force_with_states(q, v, z, t, params):
    """The same with x and s."""
    return force(q, v, t, params, (z[:1], z[1:]))


def relaxation(q, v, z, t, params):
    """Rates of x and s."""
    return jnp.concatenate([(q - z[:1]) / FAST, (q**2 - z[1:]) / SLOW])


PLAIN = hhtjax.System(duffing.sampled_mass, force)
STATES = hhtjax.System(duffing.sampled_mass, force_with_states, internal=relaxation)


def simulate(own, start, u, samples, substeps=SUBSTEPS):
    """Output at the samples, in V, by rk4; internal states only where a term has them."""
    states = any(name in own for name in WITH_STATES)
    run = hhtjax.simulate(
        STATES if states else PLAIN,
        hhtjax.rk4(),
        jnp.reshape(start["y"], (1,)),
        jnp.reshape(start["v"], (1,)),
        (own, u),
        dt=1 / SAMPLING_RATE / substeps,
        num_steps=(samples - 1) * substeps,
        save_every=substeps,
        z0=jnp.zeros(2) if states else None,
    )
    y, v = run.q[:, 0], run.v[:, 0]
    return y + sum(own[name] * term(y, v) for name, (term, *_) in READINGS.items() if name in own)


def run(report: Report, fast: bool):
    """Adds terms one by one, and tells how the kept and the dropped ones do on the test sets."""
    sets = data.load(fast)
    if sets.measured:
        print("Silverbox, the measured record (Wigren and Schoukens 2013)." + " Parts of it only." * fast)
    else:
        print(f"GENERATED record: the measured one was not found. To use it, {data.HOW_TO_GET_IT}.")
    u = data.reconstruct(sets.train.u)
    train, own = sets.train, {name: data.START.get(name, 0.0) for name in MODELS[BEST]}
    kept = fitted(report, train, u, BEST, (own, data.first_state(train)))
    rows, tests = [], []
    for _ in range(1 if fast else ROUNDS):
        unknown = kept.result.params
        tests.append(ranked(report, train, u, unknown))
        tried = [
            fitted(report, train, u, f"+ {name}", (unknown[0] | {name: 0.0}, unknown[1]))
            for name in first_of_each(tests[-1])[: 1 if fast else None]
        ]
        left_out = compare([kept, *tried], fast)
        rows += [scored(report, sets.tests, kept, left_out) | {"kept": True}] if not rows else []
        kept = min(tried, key=lambda fit: left_out[fit.name])
        rows += [scored(report, sets.tests, fit, left_out) | {"kept": fit is kept} for fit in tried]
    shown = [key for key in rows[0] if key not in ("estimates", "standard_errors", "unit")]
    report.table(shown, [[row[key] for key in shown] for row in rows])
    plot(report, rows)
    numbers = {"models": rows, "score_tests": tests, "substeps": SUBSTEPS, "parts": FOLDS}
    report.numbers(rounded(numbers | {"data": "measured" if sets.measured else "generated", "fast": fast}))


def ranked(report: Report, record: Record, u, unknown):
    """{candidate: what the score test says of it}, the largest drop of the cost first; unknown: as fitted."""
    absent = {name: 0.0 for name in CANDIDATES if name not in unknown[0]}
    size = {name: CANDIDATES[name][1] for name in absent}

    def residuals(unknown, candidates):
        own, start = unknown
        scaled = {name: size[name] * x for name, x in candidates.items()}
        return simulate(own | scaled, start, u, len(record.y)) - jnp.asarray(record.y)

    found = score_test(residuals, unknown, absent)
    drop = {n: (float(d), float(s)) for n, d, s in zip(found.names, found.cost_drop, found.statistic, strict=True)}
    drop = dict(sorted(drop.items(), key=lambda item: -item[1][0]))
    report.table(["candidate", "cost drop %", "statistic"], [[n, 100 * d, s] for n, (d, s) in drop.items()])
    return {n: {"cost_drop_percent": 100 * d, "statistic": s} for n, (d, s) in drop.items()}


def first_of_each(ranking):
    """The first candidate of each kind, in the order of the ranking, if it promises enough."""
    least = WORTH * max(found["cost_drop_percent"] for found in ranking.values())
    first = {next((name for name in ranking if name in kind), None) for kind in KINDS}
    return [name for name in ranking if name in first and ranking[name]["cost_drop_percent"] >= least]


class Fit(NamedTuple):
    """A model, its residuals in V, and what `fit` makes of them."""

    name: str
    residuals: Any
    result: Any


def fitted(report: Report, record: Record, u, name, guess):
    """The `Fit` of parameters and initial state, from this guess on."""
    begun = time.perf_counter()
    y = jnp.asarray(record.y)
    sizes = SCALE | {key: size for key, (_, size, _) in CANDIDATES.items()}

    def residuals(unknown):
        own, start = unknown
        return simulate(own, start, u, len(y)) - y

    result = hhtjax.fit(residuals, guess, scale=({key: sizes[key] for key in guess[0]}, STATE_SCALE))
    report.progress(f"{name}: {time.perf_counter() - begun:.0f} s with compiling; {result.reason}")
    return Fit(name, residuals, result)


def compare(fits, fast):
    """{model: RMSE in mV} of parts of the training record, each predicted by the fit to all the others."""
    parts = 2 if fast else FOLDS
    always = np.arange(len(fits[0].result.residual)) < WASHOUT
    results, functions = ({fit.name: getattr(fit, key) for fit in fits} for key in ("result", "residuals"))
    compared = hhtjax.compare(results, functions, folds=parts, always=always, progress=True)
    print(f"{compared.summary()}\n")
    return {name: 1e3 * float(x) for name, x in zip(compared.names, compared.cross_validated, strict=True)}


def scored(report: Report, tests, fit, left_out):
    """A row of errors in mV, and of estimates."""
    own, errors = fit.result.params[0], fit.result.standard_errors[0]
    row = {
        "model": fit.name,
        "parameters": len(own),
        "train_mV": rmse(fit.result.residual),
        "left_out_mV": left_out[fit.name],
    }
    for test in ("arrow_full", "arrow_no_extrapolation", "multisine"):
        error = test_error(own, tests[test])
        row[f"{test}_mV"] = rmse(error)
        if test == "arrow_full":
            row["largest_arrow_full_mV"] = 1e3 * float(np.max(np.abs(error[WASHOUT:])))
    report.progress(f"{fit.name}: left out {row['left_out_mV']:.4f} mV, arrow {row['arrow_full_mV']:.4f} mV")
    return row | {
        "estimates": {key: float(x) for key, x in own.items()},
        "standard_errors": {key: float(errors[key]) for key in own},
    }


def test_error(own, record: Record):
    """Simulated less measured output, in V, with the initial state fitted to the first samples."""
    u = data.reconstruct(record.u)
    head, y = data.beginning(u, WASHOUT), jnp.asarray(record.y)

    def residuals(start):
        return simulate(own, start, head, WASHOUT) - y[:WASHOUT]

    start = hhtjax.fit(residuals, data.first_state(record), scale=STATE_SCALE, covariance=False).params
    return np.asarray(simulate(own, start, u, len(y)) - y)


def plot(report: Report, rows):
    """Errors of the models against their parameters: kept ones joined, dropped ones hollow."""
    figure, ax = subplots(1, 1, width=85, height=75)
    sets = {"train_mV": "training", "left_out_mV": "left out of it", "arrow_full_mV": "arrow, full"}
    sets |= {"arrow_no_extrapolation_mV": "arrow, no extrapolation", "multisine_mV": "multisine"}
    kept = [row for row in rows if row["kept"]]
    for i, (key, label) in enumerate(sets.items()):
        style = {"color": COLOURS[i], "marker": MARKERS[i]}
        ax.plot([row["parameters"] for row in kept], [row[key] for row in kept], label=label, **style)
        dropped = [row for row in rows if not row["kept"]]
        ax.plot([row["parameters"] for row in dropped], [row[key] for row in dropped], ls="none", mfc="none", **style)
    ax.set_xticks(sorted({row["parameters"] for row in rows}))
    ax.set(xlabel="parameters", ylabel="RMSE (mV)")
    legend(ax, ncols=2)
    report.figure("silverbox_terms", figure)
