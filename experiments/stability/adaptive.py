"""The gallery under error control: no step size to choose, a tolerance of 1 %; what is wrong then, and who says so.

A cell is one run, with and without `verify`. It is

    accurate         error below 10 (atol + rtol max|q|), which is what `verify` promises; a tenth by "tighten"
    named            an error of `check`, or of the steps
    beyond           the error is larger, and nobody says so, but below 100 % as in the gallery
    silently wrong   above 100 %, and nobody says so
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.cells import SAMPLES, relative_error, solve_reference
from experiments.report import side_by_side
from experiments.stability.gallery import FAST_SCENES, METHODS, Method
from experiments.stability.grades import ALPHAS, page, plain
from experiments.stability.scenes import all_cases

RTOL, ATOL = 1e-2, 1e-5
ALARM = 10
WAYS = {"no": False, "halved": True, "tolerance": "tolerance", "tighten": "tighten"}  # of `verify`
TRIES = {"tighten": 200_000}  # of steps, at most; else the default
CONTROLLED = {name: x for name, x in METHODS.items() if x.make(-0.05).estimate_order} | {
    "dopri5": Method(lambda _: hhtjax.dopri5(), damped=False)
}
GRADES = {
    "silently wrong: error above 100 %": "#D55E00",
    "beyond ten times the tolerance, unnoticed": "#F5DFB0",
    "named by check()": "#999999",
    "accurate: error within ten times the tolerance": "#0072B2",
}
LETTERS = "wbnA"
WRONG, BEYOND, NAMED, GOOD = range(4)
CAUSES = {
    "hardening spring": "Its phase drifts, which no estimate of a step sees: named, or mended by smaller steps.",
    "van der Pol, mu = 1000": "Halved steps miss the jumps, a false alarm; explicit steps would be millions.",
    "elastic pendulum, k = 1e8": "Linearised at the state, or explicit, 10 000 steps are used up, which is named.",
}


class Cell(NamedTuple):
    """One run: error of q over ten times the tolerance, and by the RMS of the motion; tries of steps; what is said."""

    error: float
    relative: float
    tries: int
    said: str | None

    @property
    def grade(self):
        """An index into GRADES."""
        if self.said is not None:
            return NAMED
        return GOOD if self.error <= 1 else BEYOND if self.relative < 1 else WRONG

    @property
    def is_false_alarm(self):
        """Whether it is named for its error, and right."""
        return self.said is not None and self.error <= 1


@partial(jax.jit, static_argnames=("method", "verify"))
def controlled(scene, alpha, method, verify):
    """A run under error control, read off at the sample times."""
    system, params, q0, v0, duration = scene
    times = duration * jnp.arange(1, SAMPLES + 1) / SAMPLES
    control = hhtjax.adaptive(RTOL, ATOL, verify=verify, max_steps=TRIES.get(verify, 10_000))
    return hhtjax.simulate(system, CONTROLLED[method].make(alpha), q0, v0, params, dt=control, times=times)


def graded(run, reference):
    """The `Cell` of a run."""
    try:
        run.check()
        said = None
    except hhtjax.SimulationError as error:
        said = str(error)
    q = np.asarray(run.q)[1:]
    allowed = ALARM * (RTOL * np.abs(reference.q).max() + ATOL)
    error = np.abs(q - reference.q).max() / allowed
    tries = run.steps.accepted + run.steps.rejected
    return Cell(float(error), float(relative_error(q, SAMPLES, reference)), int(tries), said)


def assess(case, reference, method):
    """For each alpha the `Cell` of each of WAYS; the third is run only where the second names an error of the run."""
    found = []
    for alpha in ALPHAS if CONTROLLED[method].damped else ALPHAS[:1]:
        run = controlled(case.scene, alpha, method, True)
        alone, verified = graded(run._replace(error=None), reference), graded(run, reference)
        again = verified
        if verified.said != alone.said:
            again = graded(controlled(case.scene, alpha, method, "tolerance"), reference)
        tight = graded(controlled(case.scene, alpha, method, "tighten"), reference)
        found.append((alone, verified, again, tight))
    return found


def counts(everything):
    """How many cells of each grade there are, by way."""
    names = dict(zip(("silently_wrong", "beyond", "named", "accurate"), (WRONG, BEYOND, NAMED, GOOD), strict=True))
    return {
        way: {name: sum(cells[i].grade == grade for cells in everything) for name, grade in names.items()}
        | {
            "within_the_tolerance": sum(cells[i].said is None and ALARM * cells[i].error <= 1 for cells in everything),
            "false_alarms": sum(cells[i].is_false_alarm for cells in everything),
        }
        for i, way in enumerate(WAYS)
    }


def run(report, fast):
    """All scenes, methods and alphas."""
    scenes, everything = {}, []
    methods = list(CONTROLLED)[1:2] if fast else list(CONTROLLED)
    for case in all_cases():
        if fast and case.name not in FAST_SCENES:
            continue
        reference = solve_reference(case)
        found = side_by_side([partial(assess, case, reference, method) for method in methods])
        by_method = {plain(method): x for method, x in zip(methods, found, strict=True)}
        everything += [cells for x in found for cells in x]
        scenes[case.name] = {
            "grades": {
                m: ["".join(LETTERS[x.grade] for x in cells) for cells in rows] for m, rows in by_method.items()
            },
            "tries": {m: [cells[0].tries for cells in rows] for m, rows in by_method.items()},
            "error": {m: [cells[0].error for cells in rows] for m, rows in by_method.items()},
            "tightened": {
                m: [{"tries": x[-1].tries, "error": ALARM * x[-1].error, "said": x[-1].said} for x in rows]
                for m, rows in by_method.items()
            },
        }
        jax.clear_caches()  # programs of other scenes are of no use
        report.progress(f"adaptive: {case.name}")
    found = counts(everything)
    print(f"Runs with adaptive(rtol={RTOL:g}, atol={ATOL:g}), by how they are verified\n")
    report.table(["verify", *found["no"]], [[way, *x.values()] for way, x in found.items()])
    columns = f"verify = {', '.join(map(str, WAYS.values()))}"
    report.figure("stability_adaptive", page(scenes, CAUSES, GRADES, LETTERS, columns))
    return {
        "rtol": RTOL,
        "atol": ATOL,
        "tries": TRIES,
        "not_controlled": [plain(x) for x in METHODS if x not in CONTROLLED],
        "cells": found,
        "scenes": scenes,
    }
