"""The same with constraints: both formulations, with one solve and with Newton, on three mechanisms.

A cell is as good as the worse of q and of the multipliers L, each relative to its own motion about the mean: index 3
with the trapezoidal rule has q right and L wrong. The reference is Newton's, stabilised, with a quarter of the finest
step.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.cells import FARTHEST, Reference, march, relative_error, rms
from experiments.linearization.scenes import Case
from experiments.stability.grades import ALPHAS, Outcome
from hhtjax.scenes import pendulum, slider_crank, squeezer

HALVINGS = 7
REFERENCE = "GGL\nNewton"
METHODS = {
    REFERENCE: {"formulation": "ggl", "iterations": None},
    "GGL\none solve": {"formulation": "ggl"},
    "index 3\nNewton": {"formulation": "index3", "iterations": None},
    "index 3\none solve": {"formulation": "index3"},
}
INDEX_3 = "Index 3 with alpha = 0: multipliers grow with every step, by a Jordan block at infinity; GGL has none."
CAUSES = {
    "pendulum on a rod": INDEX_3,
    "slider-crank": INDEX_3,
    "squeezer": "Only the coarsest steps are wrong; with GGL even they stay bounded.",
}


def cases() -> list[Case]:
    """A swinging point, a driven slider-crank, Andrews' squeezer."""
    return [
        Case("pendulum on a rod", pendulum.cartesian()._replace(duration=4.0), 16, "", fast=True),
        Case("slider-crank", slider_crank.driven(), 16, ""),
        Case("squeezer", squeezer.squeezer(), 32, ""),
    ]


def position_and_multipliers(state):
    """What is compared."""
    return state.q, state.L


@partial(jax.jit, static_argnames="method")
def simulate_all(scene, num_steps, method, alphas):
    """`march` for each alpha."""

    def simulate_one(alpha):
        stepper = hhtjax.hht(alpha, **METHODS[method])
        start = stepper.init(scene.system, scene.q0, scene.v0, scene.params, scene.duration / num_steps)
        return march(stepper, start, scene, num_steps, position_and_multipliers)

    return jax.vmap(simulate_one)(alphas)


def solve_references(case, num_steps):
    """Of q and of L, with alpha = -0.05."""
    path, farthest, _ = simulate_all(case.scene, num_steps, REFERENCE, jnp.array([-0.05]))
    q, L = (np.asarray(x[0]) for x in path)
    return [Reference(x, rms(x - x.mean(axis=0), (0, 1)), float(farthest[0])) for x in (q, L)]


def assess(case, sizes, references, method) -> Outcome:
    """One method on one scene."""
    errors, bounded = [], []
    for num_steps in sizes:
        path, farthest, _ = simulate_all(case.scene, num_steps, method, jnp.array(ALPHAS))
        both = [relative_error(np.asarray(x), num_steps, y) for x, y in zip(path, references, strict=True)]
        errors.append(np.maximum(*both))  # NaN if either is
        bounded.append(np.asarray(farthest) <= FARTHEST * references[0].reach)
    return Outcome(np.array(errors), np.array(bounded))


def outcomes_and_sizes(report, fast):
    """By scene, and by method: all outcomes, and the numbers of steps."""
    outcomes, sizes = {}, {}
    for case in cases():
        if fast and not case.fast:
            continue
        steps = [case.fewest * 2**i for i in range(HALVINGS)][:: 3 if fast else 1]
        references = solve_references(case, (1 if fast else 4) * steps[-1])
        methods = [REFERENCE] if fast else METHODS
        outcomes[case.name] = {method: assess(case, steps, references, method) for method in methods}
        sizes[case.name] = steps
        report.progress(case.name)
    return outcomes, sizes
