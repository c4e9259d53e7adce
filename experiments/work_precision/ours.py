"""Our steppers, by `jax.jit` of `hhtjax.simulate`: with constant steps, and under error control."""

from functools import partial

import jax
import jax.numpy as jnp

import hhtjax
from experiments.benchmarks.measure import least_seconds
from experiments.work_precision.cases import SAMPLES, cases, flat
from experiments.work_precision.timing import sweep

SMOOTH = hhtjax.hht(linearize="predictor")
METHODS = {  # name: stepper, levels of extrapolation, factorised matrices of a step; None: counted, or one
    "hht": (hhtjax.hht(), 1, None),
    "hht, predictor": (SMOOTH, 1, None),
    "hht, converged": (hhtjax.hht(iterations=None), 1, None),
    "hht, extrapolate=2": (SMOOTH, 2, None),
    "hht, extrapolate=3": (SMOOTH, 3, None),
    "rosenbrock": (hhtjax.rosenbrock(), 1, 1),
    "rowda": (hhtjax.rowda(), 1, 1),
    "rowda, extrapolate=2": (hhtjax.rowda(), 2, 1),
    "rodas5p": (hhtjax.rodas5p(), 1, 1),
    "rk4": (hhtjax.rk4(), 1, 4),
    "tsit5": (hhtjax.tsit5(), 1, 6),
}
CONTROLLED = {  # by `adaptive`; those but the first two take the system without constraints and rotations
    "hht, adaptive": SMOOTH,
    "extrapolated, adaptive": hhtjax.extrapolated(),
    "rowda, adaptive": hhtjax.rowda(),
    "rodas5p, adaptive": hhtjax.rodas5p(),
    "dopri5, adaptive": hhtjax.dopri5(),
    "tsit5, adaptive": hhtjax.tsit5(),
    "dop853, adaptive": hhtjax.dop853(),
    "taylor, adaptive": hhtjax.taylor(),
}
TOLERANCES = tuple(10.0**-n for n in range(2, 14))
CALLS = 300
MOST_STEPS = 10_000, 100_000  # the default, and what a user takes where `check` says that this is used up
# which take the system without constraints and rotations
PLAIN = "rosenbrock", "rowda", "rowda, extrapolate=2", "rodas5p", "rk4", "tsit5"


def start(name, method):
    """The system that a method takes, and its start."""
    case = cases()[name]
    return case.ode if method in PLAIN else (case.scene.system, case.scene.q0, case.scene.v0)


def path(name, method, params, substeps):
    """Positions at the sample times, so many steps between them, and the number of factorised matrices: `simulate`."""
    case, (stepper, levels, solves) = cases()[name], METHODS[method]
    system, q0, v0 = start(name, method)
    steps = {"num_steps": SAMPLES * substeps, "save_every": substeps, "extrapolate": levels}
    run = hhtjax.simulate(system, stepper, q0, v0, params, dt=case.scene.duration / steps["num_steps"], **steps)
    counted = run.info.iterations if solves is None else None
    count = (solves or 1) * steps["num_steps"] * (2**levels - 1) if counted is None else jnp.sum(counted)
    return jax.vmap(flat)(run.q)[1:, : case.size], count


def entries(name, sizes, only=None):
    """Rows of all methods on a case; each number of steps is a program of its own."""
    case = cases()[name]
    params, rows = jax.tree.map(jnp.asarray, case.scene.params), []
    for method in METHODS if only is None else [m for m in METHODS if m in only]:

        @partial(jax.jit, static_argnums=1)
        def program(params, substeps, method=method):
            return path(name, method, params, substeps)

        def solve(substeps, program=program):
            return program(params, substeps)

        tried = partial(sweep, name, method, "ours", solve, sizes)
        rows += tried(lambda n: {"h_s": case.scene.duration / (SAMPLES * n)}, True)
    return rows


def calls(name):
    """Least times in s of calls of `simulate` for one step, eager and within `jax.jit`, and of an empty program."""
    case = cases()[name]
    params = jax.tree.map(jnp.asarray, case.scene.params)
    system, stepper = case.scene.system, hhtjax.hht()

    def one(params):
        run = hhtjax.simulate(system, stepper, case.scene.q0, case.scene.v0, params, dt=1e-3, num_steps=1, save_every=1)
        return run.q

    nothing = jax.jit(lambda params: jax.tree.leaves(params)[0] + 1)
    kinds = {"simulate": one, "jit(simulate)": jax.jit(one), "jit of nothing": nothing}
    return least_seconds({kind: partial(f, params) for kind, f in kinds.items()}, CALLS)


def controlled(name, method, most):
    """A function of the tolerance and the parameters: the `Solution` at the sample times."""
    case = cases()[name]
    as_given = CONTROLLED[method].solves_constraints
    system, q0, v0 = (case.scene.system, case.scene.q0, case.scene.v0) if as_given else case.ode

    def solve(tolerance, params):
        dt = hhtjax.adaptive(tolerance, 1e-2 * tolerance, max_steps=most)
        return hhtjax.simulate(system, CONTROLLED[method], q0, v0, params, dt=dt, times=case.times)

    return solve


def has_own_programs(method):
    """Whether each tolerance has a program of its own: the order of a Taylor series follows from it."""
    return method.startswith("taylor")


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
    params, of_each = jax.tree.map(jnp.asarray, case.scene.params), has_own_programs(method)
    numbers = {x: x if of_each else jnp.asarray(x) for x in tolerances}
    solution = controlled(name, method, most)

    def positions(tolerance, params):
        found = solution(tolerance, params)
        return jax.vmap(flat)(found.q)[1:, : case.size], found.steps.stop

    program = jax.jit(positions, static_argnums=0 if of_each else ())

    def solve(tolerance):
        return program(numbers[tolerance], params)

    def read(found):
        path, stop = found
        return None if stop else path, None

    return sweep(name, method, "ours", solve, tolerances, lambda x: {"tolerance": x}, of_each, read)


def controlled_entries(name, tolerances=TOLERANCES, only=tuple(CONTROLLED)):
    """Rows of the methods under error control; their tolerances are as those of the others."""
    return [row for m in only for row in while_needed(partial(controlled_rows, name, m), tolerances)]
