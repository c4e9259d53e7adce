"""Gradients of packages that compile: heyoka's variational equations, and CasADi's forward sensitivities of CVODES.

Both have the scene's program with the factors s of its parameters as what they differentiate by.
"""

from functools import cache, partial

import numpy as np

from experiments.work_precision.cases import cases
from experiments.work_precision.compiled_peers import (
    COMPACT,
    casadi_integrator,
    casadi_system,
    elsewhere,
    heyoka_system,
    is_finished,
    named,
    with_start,
)
from experiments.work_precision.expressions import places, program
from experiments.work_precision.gradient_scenes import SCENES, seen, start, sweep

TOLERANCES = tuple(10.0**-n for n in range(3, 13, 2))  # each is compiled, large programs for half a minute


def scaled_numbers(name, factors):
    """The numbers of a scene, those in question times a factor."""
    numbers = [float(x) for x in program(name).numbers]
    for factor, place in zip(factors, places(name, SCENES[name].keys), strict=True):
        numbers[place] = numbers[place] * factor
    return numbers


def heyoka_rows(name, tolerances=TOLERANCES):
    """Rows, by the variational equations of the first order."""
    heyoka = named("heyoka")
    case, count = cases()[name], len(start(name))
    n, grid = len(case.y0), with_start(case.times)
    system = heyoka_system(name, scaled_numbers(name, [heyoka.par[i] for i in range(count)]))
    moved = heyoka.var_ode_sys(system, heyoka.var_args.params, order=1)
    first = np.concatenate([case.y0, np.zeros(n * count)])

    @cache
    def integrator(tolerance):
        many = n * (1 + count) > COMPACT
        return heyoka.taylor_adaptive(moved, case.y0, pars=np.ones(count), tol=tolerance, compact_mode=many)

    def gradient(tolerance):
        run = integrator(tolerance)
        run.time, run.state[:] = 0.0, first
        outcome, shortest, longest, _, _, path = run.propagate_grid(grid)
        if not is_finished(outcome, shortest, longest):
            return None
        S = path[1:, n:].reshape(len(case.times), n, count)
        return mean_gradient(name, path[1:, :n], S)

    return sweep(name, "heyoka Taylor, forward", "heyoka", tolerances, gradient, True)


def mean_gradient(name, y, S):
    """Of the mean square of the positions that are in the loss. S: (times, n, factors), the derivatives of y."""
    each = np.stack([seen(name, S[:, :, i]) for i in range(S.shape[2])], axis=-1)
    return 2 * np.mean(seen(name, y)[:, :, None] * each, axis=(0, 1))


def casadi_gradient(name, kind, tolerance):
    """The function s -> gradient of a scene."""
    casadi, case, count = named("casadi"), cases()[name], len(start(name))
    s = casadi.SX.sym("s", count)
    system = casadi_system(name, scaled_numbers(name, casadi.vertsplit(s))) | {"p": s}
    run = casadi_integrator(system, kind, case.times, tolerance)
    factors = casadi.MX.sym("factors", count)
    path = run(x0=casadi.DM(np.asarray(case.y0)), p=factors)["xf"]
    shown = list(SCENES[name].seen or range(case.size))
    q = casadi.vec(path[shown, :])
    slope = casadi.jtimes(q, factors, casadi.DM.eye(count))  # forward mode
    return casadi.Function("gradient", [factors], [2 / q.numel() * casadi.mtimes(q.T, slope)])


def casadi_rows(name, tolerances=TOLERANCES):
    """Rows of CVODES."""
    ones = np.ones(len(start(name)))
    with elsewhere():
        made = cache(partial(casadi_gradient, name, "cvodes"))

        def gradient(tolerance):
            try:
                return np.asarray(made(tolerance)(ones)).ravel()
            except RuntimeError:
                return None

        return sweep(name, "CasADi CVODES, forward", "CasADi", tolerances, gradient, True)


ROWS = {"heyoka": heyoka_rows, "casadi": casadi_rows}
