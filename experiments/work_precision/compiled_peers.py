"""Packages that compile the right-hand side as we do: heyoka, numbalsoda, CasADi, scikit-sundae and diffsol.

Each has it from the scene's list of operations, in its own language (`expressions.py`), with the scene's numbers in it.
"""

import importlib
import os
import sys
import tempfile
from contextlib import contextmanager
from functools import cache, partial
from typing import Any

import numpy as np

from experiments.work_precision.cases import cases
from experiments.work_precision.expressions import diffsl, program, python_rate
from experiments.work_precision.timing import sweep

TOLERANCES = tuple(10.0**-n for n in range(3, 14))
MOST_STEPS = 10**6  # between two samples, or in a run
COMPACT = 20  # numbers beyond which heyoka's code is a loop: slower by 2 to 12, but it does not compile for minutes
DIFFSOL = "tsit45", "bdf", "esdirk34"


def named(package) -> Any:
    """A package that may be missing."""
    return importlib.import_module(package)


def with_start(times):
    """Sample times and the start."""
    return np.concatenate([[0.0], times])


@contextmanager
def silent():
    """Without what Fortran writes to stdout, here that a problem seems stiff."""
    sys.stdout.flush()
    kept = os.dup(1)
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)


@contextmanager
def elsewhere():
    """In a folder of its own, for what a compiler writes there as long as its functions live."""
    before = os.getcwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            yield
        finally:
            os.chdir(before)


def row_of(x):
    """What describes a run."""
    return {"tolerance": x}


# ----------------------------------------------------------------------------
# heyoka: Taylor series, of an order that the tolerance tells.


def heyoka_system(name, params=None):
    """[(variable, its rate)]; params: expressions, by default the scene's numbers."""
    heyoka = named("heyoka")
    found = program(name)
    y = heyoka.make_vars(*(f"y{i}" for i in range(found.size)))
    rates = found.on(heyoka.time, y, params, heyoka)
    return [(a, heyoka.expression(float(b)) if isinstance(b, float) else b) for a, b in zip(y, rates, strict=True)]


def is_finished(outcome, shortest, longest):
    """Whether heyoka's run reached its end in steps of finite size.

    From a start at which two neighbouring coefficients of the series vanish its steps become infinite, without a
    warning.
    """
    return outcome == named("heyoka").taylor_outcome.time_limit and 0 < shortest <= longest < np.inf


def heyoka_entries(name, tolerances=TOLERANCES):
    """Rows; each tolerance has a program of its own, because it has an order of its own."""
    heyoka = named("heyoka")
    case = cases()[name]
    system, grid, compact = heyoka_system(name), with_start(case.times), len(case.y0) > COMPACT

    @cache
    def integrator(tolerance):
        return heyoka.taylor_adaptive(system, case.y0, tol=tolerance, compact_mode=compact)

    def solve(tolerance):
        run = integrator(tolerance)
        run.time, run.state[:] = 0.0, case.y0
        outcome, shortest, longest, _, _, path = run.propagate_grid(grid)
        return path[1:, : case.size] if is_finished(outcome, shortest, longest) else None, None

    return sweep(name, "heyoka Taylor", "heyoka", solve, tolerances, row_of, True)


# ----------------------------------------------------------------------------
# numbalsoda: ODEPACK's LSODA in C, and Hairer's DOP853 in Fortran. numba compiles the right-hand side.


@cache
def jitted(name):
    """`rate(t, y, dy)` of a scene."""
    return named("numba").njit(python_rate(name), error_model="numpy")


@cache
def address(name):
    """Of the scene's right-hand side, as numbalsoda calls it."""
    signature, rate = named("numbalsoda").lsoda_sig, jitted(name)

    def function(t, y, dy, p):
        rate(t, y, dy)

    compiled = named("numba").cfunc(signature, error_model="numpy")(function)
    return compiled.address, compiled


def numbalsoda_entries(name, tolerances=TOLERANCES, solvers=("lsoda", "dop853")):
    """Rows of both."""
    case, (rate, _), rows = cases()[name], address(name), []
    y0, grid, nothing = np.array(case.y0, float), with_start(case.times), np.zeros(1)
    for solver in solvers:
        run = getattr(named("numbalsoda"), solver)

        def solve(tolerance, run=run):
            path, fine = run(rate, y0, grid, nothing, rtol=tolerance, atol=1e-2 * tolerance, mxstep=MOST_STEPS)
            return path[1:, : case.size] if fine else None, None

        with silent():
            solve(tolerances[0])  # compiles
            rows += sweep(name, f"numbalsoda {solver.upper()}", "numbalsoda", solve, tolerances, row_of)
    return rows


# ----------------------------------------------------------------------------
# scikit-sundae: CVODE and IDA of SUNDIALS, whose right-hand side is Python's, here a function of numba's.


def residual(name):
    """`residual(t, y, yp, res)` of a scene, y' less its rate."""
    rate = jitted(name)

    def function(t, y, yp, res):
        rate(t, y, res)
        for i in range(len(res)):
            res[i] = yp[i] - res[i]

    return named("numba").njit(function)


def sundae_entries(name, tolerances=TOLERANCES):
    """Rows of CVODE, by both of its families, and of IDA."""
    case, rows = cases()[name], []
    cvode, ida = named("sksundae.cvode"), named("sksundae.ida")
    grid, y0 = with_start(case.times), np.array(case.y0, float)
    start = np.zeros_like(y0)
    jitted(name)(0.0, y0, start)
    implicit, rate = residual(name), jitted(name)
    kinds = {
        "CVODE BDF": (partial(cvode.CVODE, rate), (grid, y0)),
        "CVODE Adams": (partial(cvode.CVODE, rate, method="Adams"), (grid, y0)),
        "IDA": (partial(ida.IDA, implicit), (grid, y0, start)),
    }
    for kind, (make, arguments) in kinds.items():

        @cache
        def solver(tolerance, make=make):
            return make(rtol=tolerance, atol=1e-2 * tolerance, max_num_steps=MOST_STEPS)

        def solve(tolerance, solver=solver, arguments=arguments):
            found = solver(tolerance).solve(*arguments)
            return np.asarray(found.y)[1:, : case.size] if found.success else None, None

        rows += sweep(name, f"sksundae {kind}", "sksundae", solve, tolerances, row_of)
    return rows


# ----------------------------------------------------------------------------
# CasADi: CVODES and IDAS of SUNDIALS, with right-hand side and Jacobian in C, made by itself.

FLAGS = {"flags": ["-O3", "-march=native"], "cleanup": False}  # of what lies in a folder that is left behind anyway
JIT = {"jit": True, "compiler": "shell", "jit_cleanup": False, "jit_options": FLAGS}


def casadi_system(name, params=None):
    """The ODE of a scene, for `casadi.integrator`, and its params; these: by default the scene's numbers."""
    casadi, found = named("casadi"), program(name)
    y, t = casadi.SX.sym("y", found.size), casadi.SX.sym("t")
    rates = found.on(t, casadi.vertsplit(y), params, casadi)
    return {"x": y, "t": t, "ode": casadi.vertcat(*rates)}


def casadi_integrator(system, kind, times, tolerance, **more):
    """A compiled one, of a run with positions at the times."""
    options = JIT | {"reltol": tolerance, "abstol": 1e-2 * tolerance, "max_num_steps": MOST_STEPS}
    return named("casadi").integrator("run", kind, system, 0.0, list(times), options | more)


def casadi_rows(name, kind, tolerances):
    """Rows of one integrator; each tolerance has a program of its own, because it is an option."""
    case, system, y0 = cases()[name], casadi_system(name), named("casadi").DM(np.asarray(cases()[name].y0))
    integrator = cache(partial(casadi_integrator, system, kind, case.times))

    def solve(tolerance):
        try:
            path = integrator(tolerance)(x0=y0)["xf"]
        except RuntimeError:
            return None, None
        return np.asarray(path).T[:, : case.size], None

    return sweep(name, f"CasADi {kind.upper()}", "CasADi", solve, tolerances, row_of, True)


def casadi_entries(name, tolerances=TOLERANCES, kinds=("cvodes", "idas")):
    """Rows of both."""
    with elsewhere():
        return [row for kind in kinds for row in casadi_rows(name, kind, tolerances)]


# ----------------------------------------------------------------------------
# diffsol: Rust, with a language of its own for the system, which LLVM compiles.


def diffsol_entries(name, tolerances=TOLERANCES, solvers=DIFFSOL):
    """Rows of its methods."""
    diffsol = named("pydiffsol")
    case, rows = cases()[name], []
    system = diffsol.Ode(diffsl(name), matrix_type=diffsol.nalgebra_dense, jit_backend=diffsol.llvm)
    nothing = np.zeros(0)
    for solver in solvers:
        system.ode_solver = getattr(diffsol, solver)

        def solve(tolerance):
            system.rtol, system.atol = tolerance, 1e-2 * tolerance
            try:
                path = system.solve_dense(nothing, case.times).ys
            except Exception:  # it has no class of its own: Newton's iteration failed too often
                return None, None
            return np.asarray(path).T, None

        rows += sweep(name, f"diffsol {solver}", "diffsol", solve, tolerances, row_of)
    return rows


ENTRIES = {  # module: rows of a case
    "heyoka": heyoka_entries,
    "numbalsoda": numbalsoda_entries,
    "casadi": casadi_entries,
    "sksundae": sundae_entries,
    "pydiffsol": diffsol_entries,
}
