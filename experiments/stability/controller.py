"""The step controller: its constants scanned on every other scene of the gallery, and judged on those between.

A run takes n steps, the rejected ones included, for an error e over the tolerance; with a method of order p it would
take n e^(1/p) for an error of the tolerance. Work is that, over the same of today's constants: the geometric mean over
scenes, methods and tolerances. Runs that fail, or lose the motion (errors above 30 %), with either constants are left
out, and counted.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.cells import SAMPLES, geometric_mean, solve_reference
from experiments.report import side_by_side
from experiments.stability.gallery import FAST_SCENES
from experiments.stability.scenes import all_cases
from hhtjax.runs.controlled_run import run_over, verified
from hhtjax.runs.error_control import PI, Controller, select_steps
from hhtjax.runs.inputs import Problem

RTOLS = 1e-2, 1e-3, 1e-4, 1e-5
ATOL = 1e-3  # over rtol
MAX_STEPS = 20_000
METHODS = {"hht": hhtjax.hht(), "rowda": hhtjax.rowda(), "dopri5": hhtjax.dopri5()}
LOW, HIGH = 0.02, 10.0  # of errors, over the tolerance
LOST = 0.3  # of the motion
EXPONENTS = (1.0, 0.0), (0.7, 0.0), (0.7, 0.2), (0.7, 0.4), (0.7, 0.6), (0.5, 0.2), (0.5, 0.4), (0.9, 0.4), (0.4, 0.3)
GRID = {
    "exponents": {f"{p:g}, {i:g}": PI._replace(proportional=p, integral=i) for p, i in EXPONENTS},
    "safety": {f"{x:g}": PI._replace(safety=x) for x in (0.7, 0.8, 0.85, 0.9, 0.95)},
    "most": {f"{x:g}": PI._replace(most=x) for x in (1.25, 1.5, 2.0)},
    "least": {f"{x:g}": PI._replace(least=x) for x in (0.1, 0.2, 0.5)},
}  # growth by more than 2 is unstable for some methods


class Outcome(NamedTuple):
    """Of one run: tries of steps, those rejected, error of q over rtol max|q| + atol, whether it ends too early or far
    off, and whether `verify` says so."""

    tries: int
    rejected: int
    error: float
    failed: bool
    alarm: bool


@partial(jax.jit, static_argnames="method")
def controlled(scene, rtol, controller, method):
    """Steps, error of the run by halved steps over what is asked for, and q."""
    system, params, q0, v0, duration = scene
    times = duration * jnp.arange(1, SAMPLES + 1) / SAMPLES
    problem = Problem.checked("controller", system, METHODS[method], q0, v0, params, 0.0, None)
    control = hhtjax.adaptive(rtol, ATOL * rtol, max_steps=MAX_STEPS)
    steps, ends, _ = select_steps(problem, times[-1], control, controller=controller)
    run, finer = (run_over(problem, times, ends, steps.accepted, halved=halved) for halved in (False, True))
    alarm = verified(run, finer, control, METHODS[method].order)
    return steps._replace(dt=None), jnp.max(alarm["error"]) > alarm["allowed"], run.q


def assess(case, reference, method):
    """{parameter: {value: an `Outcome` for each tolerance}}."""

    def one(controller, rtol):
        controller = Controller(*map(jnp.float64, controller))
        steps, alarm, q = controlled(case.scene, rtol, controller, method)
        size = np.abs(reference.q).max()
        error = np.abs(np.asarray(q)[1:] - reference.q).max() / (rtol * (size + ATOL))
        tries = int(steps.accepted + steps.rejected)
        failed = bool(steps.stop) or not rtol * error < LOST
        return Outcome(tries, int(steps.rejected), float(error), failed, bool(alarm))

    found = {}  # today's constants are in the grid of each parameter

    def row(controller):
        if controller not in found:
            found[controller] = [one(controller, rtol) for rtol in RTOLS]
        return found[controller]

    return {name: {value: row(c) for value, c in values.items()} for name, values in GRID.items()}


def work(outcome, order):
    """Steps for an error of the tolerance."""
    return outcome.tries * outcome.error ** (1 / order)


def judged(outcomes, today, orders):
    """One row of the table: what a controller does, over today's."""
    pairs = [(x, y, p) for x, y, p in zip(outcomes, today, orders, strict=True) if not (x.failed or y.failed)]
    return {
        "work": geometric_mean([work(x, p) / work(y, p) for x, y, p in pairs]),
        "steps": geometric_mean([x.tries / y.tries for x, y, _ in pairs]),
        "rejected_percent": 100 * sum(x.rejected for x, _, _ in pairs) / sum(x.tries for x, _, _ in pairs),
        "median_error": float(np.median([x.error for x, _, _ in pairs])),
        "outside": sum(not LOW <= x.error <= HIGH for x, _, _ in pairs),
        "alarms": sum(x.alarm for x, _, _ in pairs),
        "runs": len(pairs),
        "failed": sum(x.failed for x in outcomes),
    }


def table(found, orders):
    """[{parameter, value, ...}], of runs found as {parameter: {value: outcomes}}."""
    today = found["safety"][f"{PI.safety:g}"]
    return [
        {"parameter": name, "value": value} | judged(outcomes, today, orders)
        for name, values in found.items()
        for value, outcomes in values.items()
    ]


def run(report, fast):
    """All scenes: the first, third, ... to tune on, the others held out."""
    cases = [x for x in all_cases() if not fast or x.name in FAST_SCENES]
    methods = list(METHODS)[:1] if fast else list(METHODS)
    halves = {"tuned": cases[::2], "held_out": cases[1::2]}
    numbers: dict = {"rtol": RTOLS, "methods": methods, "today": PI._asdict()}
    for half, members in halves.items():
        found, orders = {name: {value: [] for value in values} for name, values in GRID.items()}, []
        for case in members:
            reference = solve_reference(case)
            for by in side_by_side([partial(assess, case, reference, m) for m in methods]):
                for name, values in by.items():
                    for value, outcomes in values.items():
                        found[name][value] += outcomes
            orders += [METHODS[m].order for m in methods for _ in RTOLS]
            jax.clear_caches()  # programs of other scenes are of no use
            report.progress(f"controller: {case.name}")
        rows = table(found, orders)
        report.table(list(rows[0]), [list(row.values()) for row in rows])
        numbers[half] = {"scenes": [x.name for x in members], "table": rows}
    return numbers
