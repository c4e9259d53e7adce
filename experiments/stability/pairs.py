"""Scenes whose runs are graded by the worse of two quantities, each relative to its own motion about the mean.

The reference is a fine run of one of the methods, with a quarter of the finest step.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.cells import FARTHEST, Reference, march, position, relative_error, rms
from experiments.stability.grades import ALPHAS, Outcome, cells, page


class Study(NamedTuple):
    """cases; methods: name -> alpha -> stepper; reference, quick: names of two; halvings: number of step sizes;
    record: state -> the two quantities; track: state -> what stays bounded; causes: by scene."""

    cases: list
    methods: dict
    reference: str
    quick: str
    halvings: int
    record: Any
    track: Any = position
    causes: dict | None = None


@partial(jax.jit, static_argnames=("make", "record", "track"))
def simulate_all(scene, num_steps, make, record, track):
    """`march` for each alpha."""

    def simulate_one(alpha):
        stepper = make(alpha)
        start = stepper.init(scene.system, scene.q0, scene.v0, scene.params, scene.duration / num_steps)
        return march(stepper, start, scene, num_steps, record, track)

    return jax.vmap(simulate_one)(jnp.array(ALPHAS))


def solve_references(study, case, num_steps, method):
    """Of both quantities, with alpha = -0.05."""
    pair, farthest, _ = simulate_all(case.scene, num_steps, study.methods[method], study.record, study.track)
    i = ALPHAS.index(-0.05)
    fine = [np.asarray(x[i]) for x in pair]
    return [Reference(x, rms(x - x.mean(axis=0), (0, 1)), float(farthest[i])) for x in fine]


def assess(study, case, sizes, references, method) -> Outcome:
    """One method on one scene."""
    errors, bounded = [], []
    for num_steps in sizes:
        pair, farthest, _ = simulate_all(case.scene, num_steps, study.methods[method], study.record, study.track)
        both = [relative_error(np.asarray(x), num_steps, y) for x, y in zip(pair, references, strict=True)]
        errors.append(np.maximum(*both))  # NaN if either is
        bounded.append(np.asarray(farthest) <= FARTHEST * references[0].reach)
    return Outcome(np.array(errors), np.array(bounded))


def run_study(report, study, name, fast):
    """Grades every cell, and draws the page; of the smoke run, the fast scenes with one method without iterations."""
    outcomes, sizes = {}, {}
    for case in study.cases:
        if fast and not case.fast:
            continue
        steps = [case.fewest * 2**i for i in range(study.halvings)][:: 3 if fast else 1]
        methods = [study.quick] if fast else list(study.methods)
        reference = study.quick if fast else study.reference
        references = solve_references(study, case, 4 * steps[-1], reference)
        outcomes[case.name] = {method: assess(study, case, steps, references, method) for method in methods}
        sizes[case.name] = steps
        report.progress(f"{name}: {case.name}")
    found = cells(outcomes, sizes)
    report.figure(name, page(found, study.causes or {}))
    return found
