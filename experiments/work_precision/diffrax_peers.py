"""diffrax: Tsit5, Kvaerno3, Kvaerno5 and implicit Euler, with step-size control and with constant steps."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from experiments.work_precision.cases import SAMPLES, cases
from experiments.work_precision.timing import sweep

TOLERANCES = tuple(10.0**-n for n in range(3, 14))
SIZES = tuple(2**n for n in range(12))  # steps between sample times
MOST_STEPS = 200_000
CONTROLLED = "Tsit5", "Kvaerno3", "Kvaerno5"
CONSTANT = "Tsit5", "Kvaerno3", "ImplicitEuler"
STAGES = {"Tsit5": 6}  # evaluations of an explicit step, each with a solve with the mass matrix


def make_solver(name, fixed):
    """With constant steps, implicit solvers need tolerances of their own for Newton's iteration."""
    import diffrax  # pyright: ignore[reportMissingImports]  # of an extra of its own

    solver = getattr(diffrax, name)
    implicit = name not in STAGES
    return solver(root_finder=diffrax.VeryChord(rtol=1e-8, atol=1e-10)) if fixed and implicit else solver()


@partial(jax.jit, static_argnums=(0, 1, 2, 3))
def run(rate, unravel, name, fixed, y0, params, times, setting):
    """Positions and velocities at the times, number of steps, success; setting: tolerance, or step size."""
    import diffrax  # pyright: ignore[reportMissingImports]

    controller = diffrax.ConstantStepSize() if fixed else diffrax.PIDController(rtol=setting, atol=1e-2 * setting)
    found = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda t, y, vector: rate(t, y, unravel(vector))),
        make_solver(name, fixed),
        0.0,
        times[-1],
        setting if fixed else None,
        y0,
        params,
        saveat=diffrax.SaveAt(ts=times),
        stepsize_controller=controller,
        max_steps=MOST_STEPS,
        throw=False,
    )
    return found.ys, found.stats["num_steps"], found.result == diffrax.RESULTS.successful


def entries(name, everything, tolerances=TOLERANCES, sizes=SIZES):
    """Rows of all solvers on a case; everything: constant steps and implicit Euler too."""
    case = cases()[name]
    vector, unravel = ravel_pytree(case.scene.params)  # as to ours
    arguments = jnp.asarray(case.y0), vector, jnp.asarray(case.times)
    kinds = [(solver, False) for solver in CONTROLLED]
    if everything:
        kinds += [("ImplicitEuler", False)] + [(solver, True) for solver in CONSTANT]
    rows = []
    for solver, fixed in kinds:
        settings = sizes if fixed else tolerances
        numbers = {x: jnp.asarray(case.scene.duration / (SAMPLES * x) if fixed else x) for x in settings}

        def solve(setting, solver=solver, fixed=fixed, numbers=numbers):
            return run(case.rate, unravel, solver, fixed, *arguments, numbers[setting])

        def read(found, solver=solver):
            y, steps, fine = found
            if not fine:
                return None, None
            return np.asarray(y)[:, : case.size], STAGES[solver] * steps if solver in STAGES else None

        kind = "constant" if fixed else "PID"
        tried = partial(sweep, name, f"diffrax {solver}, {kind}", "diffrax", solve, settings)
        rows += tried(
            lambda x, fixed=fixed: {"h_s": case.scene.duration / (SAMPLES * x)} if fixed else {"tolerance": x},
            read=read,
        )
    return rows
