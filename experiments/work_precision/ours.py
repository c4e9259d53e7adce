"""Our steppers, as compiled loops, and under error control."""

from functools import partial

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

import hhtjax
from experiments.work_precision.cases import SAMPLES, cases, flat, march
from experiments.work_precision.timing import sweep
from hhtjax.primitives import one_kernel
from hhtjax.runs.extrapolate import richardson

SMOOTH = hhtjax.hht(linearize="predictor")
METHODS = {  # name: stepper, levels of extrapolation, factorised matrices of a step if it does not count them
    "hht": (hhtjax.hht(), 1, None),
    "hht, predictor": (SMOOTH, 1, None),
    "hht, converged": (hhtjax.hht(iterations=None), 1, None),
    "hht, extrapolate=2": (SMOOTH, 2, None),
    "hht, extrapolate=3": (SMOOTH, 3, None),
    "rosenbrock": (hhtjax.rosenbrock(), 1, 1),
    "rowda": (hhtjax.rowda(), 1, 1),
    "rowda, extrapolate=2": (hhtjax.rowda(), 2, 1),
    "rk4": (hhtjax.rk4(), 1, 4),
}
CONTROLLED = {  # by `adaptive`; those but the first take the system without constraints and rotations
    "hht, adaptive": SMOOTH,
    "rowda, adaptive": hhtjax.rowda(),
    "dopri5, adaptive": hhtjax.dopri5(),
}
TOLERANCES = tuple(10.0**-n for n in range(2, 12))
MOST_STEPS = 10_000, 100_000  # the default, and what a user takes where `check` says that this is used up
PLAIN = "rosenbrock", "rowda", "rowda, extrapolate=2", "rk4"  # take the system without constraints and rotations


def run(system, stepper, levels, q0, v0, duration, size, params, substeps):
    """As `march`, extrapolated; the first `size` numbers of each position."""

    def march_by(substeps):
        path, solves = march(system, stepper, q0, v0, params, duration, substeps)
        return path[:, :size], solves

    if levels == 1:
        return march_by(substeps)
    paths, solves = jax.lax.map(march_by, substeps * 2 ** jnp.arange(levels))  # a loop, so that one program serves all
    return richardson(list(paths), stepper.order), jnp.sum(solves)


def entries(name, sizes, only=None):
    """Rows of all methods on a case."""
    case = cases()[name]
    system, params, q0, v0, duration = case.scene
    vector, unravel = ravel_pytree(params)  # a call takes longer with every array that it is handed
    counts = {n: jnp.asarray(n) for n in sizes}  # a Python number would be made an array in every call
    rows = []
    for method, (stepper, levels, solves) in METHODS.items():
        if only is not None and method not in only:
            continue
        start = case.ode if method in PLAIN else (system, q0, v0)

        # what stays the same is not passed on
        fixed = partial(run, start[0], stepper, levels, *start[1:], duration, case.size)
        program = jax.jit(lambda vector, n, fixed=fixed: one_kernel(lambda x, n: fixed(unravel(x), n), vector, n))

        def solve(substeps, program=program, levels=levels, solves=solves):
            path, count = program(vector, counts[substeps])
            return path, count if solves is None else solves * SAMPLES * substeps * (2**levels - 1)

        rows += sweep(name, method, "ours", solve, sizes, lambda n: {"h_s": duration / (SAMPLES * n)})
    return rows


def controlled(name, method, unravel, most):
    """A function of the tolerance and the parameters, as a vector: the `Solution` at the sample times."""
    case = cases()[name]
    system, q0, v0 = (case.scene.system, case.scene.q0, case.scene.v0) if method.startswith("hht") else case.ode

    def solve(tolerance, vector):
        dt = hhtjax.adaptive(tolerance, 1e-2 * tolerance, max_steps=most)
        return hhtjax.simulate(system, CONTROLLED[method], q0, v0, unravel(vector), dt=dt, times=case.times)

    return solve


def while_needed(rows_for, tolerances):
    """Rows for the tolerances with max_steps as it is by default; for those that need more, with more."""
    rows = []
    for most in MOST_STEPS:
        found = rows_for(most, tolerances)
        rows += [row for row in found if row["rms_error"] is not None or most == MOST_STEPS[-1]]
        tolerances = [x for x, row in zip(tolerances, found, strict=False) if row["rms_error"] is None]
        if not tolerances:
            break
    return rows


def controlled_rows(name, method, most, tolerances):
    """Rows of one method, with so many steps at most."""
    case = cases()[name]
    vector, unravel = ravel_pytree(case.scene.params)
    numbers = {x: jnp.asarray(x) for x in tolerances}
    solution = controlled(name, method, unravel, most)

    def positions(tolerance, vector):
        found = solution(tolerance, vector)
        return jax.vmap(flat)(found.q)[1:, : case.size], found.steps.stop

    program = jax.jit(lambda tolerance, vector: one_kernel(positions, tolerance, vector, around=True))

    def solve(tolerance):
        path, stop = program(numbers[tolerance], vector)
        return None if stop else path, None

    return sweep(name, method, "ours", solve, tolerances, lambda x: {"tolerance": x})


def controlled_entries(name, tolerances=TOLERANCES, only=tuple(CONTROLLED)):
    """Rows of the methods under error control; their tolerances are as those of the others."""
    return [row for m in only for row in while_needed(partial(controlled_rows, name, m), tolerances)]
