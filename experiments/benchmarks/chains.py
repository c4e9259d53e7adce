"""Chains of 8, 16 and 64 pendulums: a step of ours against the obvious one, three Jacobians and LAPACK."""

from functools import partial

import numpy as np

import hhtjax
from experiments.benchmarks import obvious
from experiments.benchmarks.chain import FORMULATIONS, chain
from experiments.benchmarks.measure import compiled, least_seconds

ALPHA = -0.05
DT = 1e-4
STEPPER = hhtjax.hht(ALPHA, linearize="predictor")


def plain(scene, num_steps, q0):
    """The last position, by the obvious step."""
    return obvious.run(STEPPER, scene.system, scene.params, q0, scene.v0, DT, num_steps)[0]


def ours(scene, num_steps, q0):
    """The last position."""
    options = {"dt": DT, "num_steps": num_steps, "save_every": num_steps}
    return hhtjax.simulate(scene.system, STEPPER, q0, scene.v0, scene.params, **options).q[-1]


def measure(N, num_steps, repeats, formulations):
    """us per step of both, in every formulation."""
    programs, rows = {}, []
    for formulation in formulations:
        for name, function in (("ours", ours), ("obvious", plain)):
            scene = chain(N, k=1.0, c=0.01, formulation=formulation)
            program, seconds = compiled(partial(function, scene, num_steps), scene.q0)
            programs[name, formulation] = partial(program, scene.q0)
            rows.append({"N": N, "step": name, "formulation": formulation, "compile_s": seconds})
    times = least_seconds(programs, repeats)
    worst = times["obvious", formulations[0]]
    exact = np.asarray(programs["obvious", formulations[0]]())
    for row in rows:
        key = row["step"], row["formulation"]
        row["us_per_step"] = 1e6 * times[key] / num_steps
        row["faster_than_obvious_same_functions"] = times["obvious", row["formulation"]] / times[key]
        row["faster_than_obvious_N2"] = worst / times[key]
        row["difference_rad"] = float(np.abs(np.asarray(programs[key]()) - exact).max())
    return rows


def run(report, fast):
    """All sizes."""
    rows = []
    names = list(FORMULATIONS)
    for N, num_steps in ((3, 50),) if fast else ((8, 2000), (16, 500), (64, 50)):
        rows += measure(N, num_steps, 2 if fast else 7, names[1:] if fast else names)
        report.progress(f"chain of {N}")
    report.table(list(rows[0]), [list(row.values()) for row in rows])
    return {"rows": rows}
