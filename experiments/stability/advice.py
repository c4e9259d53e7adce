"""What `suggest_step_size` says before a run, against what the gallery measured: the step, and which cells are wrong.

Measured: the step from which on all errors of q are below a limit, on a line in the logarithms between neighbours.
Advised: with the scene's duration, by runs; and without, from the modes of the initial state alone. A silently wrong
cell is flagged if its step is longer than the one advised for 5 %.
"""

import jax.numpy as jnp
import numpy as np

from experiments.stability.gallery import ALPHAS, METHODS, results
from experiments.stability.grades import WRONG, plain
from experiments.stability.scenes import all_cases
from hhtjax.analysis import suggest_step_size

LIMITS = 0.05, 0.01
CONTACT = "Hertz contact", "hard stop", "dissipative contact"
ADVISED = (
    "HHT\nauto",
    "HHT\nconverged",
    "HHT\npredictor",
    "HHT\nheld",
    "HHT\nstate",
    "Rosenbrock\nL-stable",
    "ROWDA",
)


def measured_step(error, steps_s, limit):
    """The longest step from which on all are below the limit, in s; None if there is none, or no coarser one."""
    fails = np.flatnonzero(~(error < limit))
    if not len(fails) or fails[-1] == len(error) - 1:
        return None
    i = fails[-1]
    if not np.isfinite(error[i]):
        return float(steps_s[i + 1])
    slope = np.log(error[i] / error[i + 1])
    return float(steps_s[i + 1] * (steps_s[i] / steps_s[i + 1]) ** (np.log(limit / error[i + 1]) / slope))


def advised_step(case, stepper, **options):
    """dt in s; None where the advisor declines."""
    system, params, q0, v0, _ = case.scene
    try:
        return suggest_step_size(system, stepper, q0, v0, params, **options).dt
    except ValueError:
        return None


def as_data(make, alpha):
    """A stepper whose alpha is an array: it is compiled once for all."""
    return make(jnp.asarray(alpha))


def entry(case, method, column, outcome, sizes):
    """Measured and advised steps of one method, with what was flagged."""
    make, damped = METHODS[method]
    alpha = ALPHAS[column]
    stepper = as_data(make, alpha)
    duration = float(case.scene.duration)
    steps = duration / np.array(sizes)
    error = np.where(outcome.bounded[:, column], outcome.error[:, column], np.inf)
    wrong = outcome.grade[:, column] == WRONG
    by_runs = {limit: advised_step(case, stepper, tolerance=limit, duration=duration) for limit in LIMITS}
    by_modes = advised_step(case, stepper, tolerance=0.01)
    limit = by_runs[LIMITS[0]] or 0.0
    return {
        "scene": case.name,
        "method": plain(method),
        "alpha": alpha if damped else None,
        "contact": case.name in CONTACT,
        "measured_s": {str(x): measured_step(error, steps, x) for x in LIMITS},
        "advised_s": {str(x): dt for x, dt in by_runs.items()},
        "advised_by_modes_s": by_modes,
        "silently_wrong": int(wrong.sum()),
        "flagged": int((wrong & (steps > limit)).sum()),
        "flagged_by_modes": int((wrong & (steps > (by_modes or 0.0))).sum()),
    }


def factors(entries, limit):
    """Advised over measured, of the scenes without contact."""
    pairs = [(e["advised_s"][str(limit)], e["measured_s"][str(limit)]) for e in entries if not e["contact"]]
    return np.array([a / m for a, m in pairs if a and m])


def misses(entries):
    """The cases without contact whose advised step is beyond 1.5 of the measured one, or missing."""
    found = []
    for e in entries:
        for limit, measured in e["measured_s"].items():
            advised = e["advised_s"][limit]
            if not e["contact"] and measured and (not advised or not 1 / 1.5 < advised / measured < 1.5):
                which = {key: e[key] for key in ("scene", "method", "alpha")}
                found.append({**which, "limit": limit, "advised_over_measured": advised and advised / measured})
    return found


def run(report, fast):
    """Advice for some methods on all scenes."""
    outcomes, sizes, _ = results(report, fast)
    entries = []
    for case in all_cases():
        if case.name not in outcomes:
            continue
        for method in ADVISED[:1] if fast else ADVISED:
            outcome = outcomes[case.name][method]
            columns = range(1 if fast else outcome.error.shape[1])
            entries += [entry(case, method, i, outcome, sizes[case.name]) for i in columns]
        report.progress(f"advice: {case.name}")
    print("Step for a given error of q: advised over measured\n")
    keys = [str(limit) for limit in LIMITS]
    rows = []
    for e in entries:
        pairs = [(e["advised_s"][key], e["measured_s"][key]) for key in keys]
        ratios = [a / m if a and m else float("nan") for a, m in pairs]
        flags = [f"{e[key]}/{e['silently_wrong']}" for key in ("flagged", "flagged_by_modes")]
        rows.append([f"{e['scene']}, {e['method']} {'' if e['alpha'] is None else e['alpha']}", *ratios, *flags])
    report.table(["scene, method", *keys, "flagged", "by modes"], rows)
    summary = {
        str(limit): {
            "cases": len(x := factors(entries, limit)),
            "within_1.5": int(np.sum((x < 1.5) & (x > 1 / 1.5))),
            "least": float(x.min(initial=np.inf)),
            "largest": float(x.max(initial=0)),
        }
        for limit in LIMITS
    }
    totals = {key: sum(e[key] for e in entries) for key in ("silently_wrong", "flagged", "flagged_by_modes")}
    print(summary, totals, flush=True)
    methods = len({e["method"] for e in entries})
    unflagged = [
        {**{key: e[key] for key in ("scene", "method", "alpha")}, "cells": e["silently_wrong"] - e["flagged"]}
        for e in entries
        if e["flagged"] < e["silently_wrong"]
    ]
    found = {"misses": misses(entries), "unflagged": unflagged}
    return {"methods": methods, "summary": summary, "totals": totals, **found}
