"""Batches: 10,000 double pendulums, each with parameters of its own, in one call.

Errors are those of the first members, root mean squares over these, the sample times and both angles, against SciPy's
LSODA at a tolerance of 1e-11.
"""

import importlib.util
import os
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from scipy.integrate import solve_ivp

import hhtjax
from experiments.work_precision import ours
from experiments.work_precision.cases import SAMPLES, cases, flat
from experiments.work_precision.compiled_peers import (
    MOST_STEPS,
    heyoka_system,
    is_finished,
    named,
    silent,
    with_start,
)
from experiments.work_precision.expressions import Evaluation, compiled_source, places, program, python_source
from experiments.work_precision.gradient_scenes import SCENES
from experiments.work_precision.timing import seconds, show, times

MEMBERS, SEEN = 10_000, 30
SPREAD = 0.1  # factors of the parameters, uniform from 1 - SPREAD to 1 + SPREAD
NAMES = "stiff double pendulum", "free double pendulum"
LEVELS = 1e-3, 1e-6
FINEST, LONGEST = 3e-7, 20.0  # error and s, behind which nothing finer is tried
SIZES = tuple(2**n for n in range(9))  # steps between sample times
TOLERANCES = tuple(10.0**-n for n in range(3, 11))
ALONE = {"stiff double pendulum": ("hht", "rodas5p"), "free double pendulum": ("hht", "tsit5")}  # by `hhtjax.sweep`
TOGETHER = {"stiff double pendulum": ("hht", "hht, extrapolate=2"), "free double pendulum": ("rk4",)}  # by `jax.vmap`
ADAPTIVE = {"stiff double pendulum": "rodas5p, adaptive", "free double pendulum": "tsit5, adaptive"}


@cache
def vectors(name, members):
    """The parameters of each, (members, numbers)."""
    found = np.tile(program(name).numbers, (members, 1))
    varied = places(name, SCENES[name].keys)
    found[:, varied] *= np.random.default_rng(0).uniform(1 - SPREAD, 1 + SPREAD, (members, len(varied)))
    return found


def unravel(name):
    """Of such a vector, the params."""
    return ravel_pytree(cases()[name].scene.params)[1]


@cache
def reference(name, members):
    """Positions of the first members, (SEEN, SAMPLES, size)."""
    case, params, found = cases()[name], unravel(name), []
    rate = jax.jit(lambda t, y, vector: case.rate(t, y, params(vector)))
    for vector in vectors(name, members)[:SEEN]:
        run = solve_ivp(
            lambda t, y, vector=vector: np.asarray(rate(t, y, vector)),
            (0.0, case.scene.duration),
            case.y0,
            "LSODA",
            case.times,
            rtol=1e-11,
            atol=1e-13,
        )
        found.append(run.y[: case.size].T)
    return np.array(found)


def rows_of(name, members, method, package, settings, run):
    """Rows from coarse to fine. run: setting -> positions, (members, SAMPLES, size), or None."""
    rows, exact = [], reference(name, members)
    for setting in settings:
        found, time_s = seconds(lambda setting=setting: run(setting), compiles=True)
        error = None
        if found is not None:
            error = float(np.sqrt(np.mean((np.asarray(found[: len(exact)]) - exact) ** 2)))
            error = error if np.isfinite(error) else None
        row = {"case": name, "method": method, "package": package, "setting": setting}
        rows.append(row | {"rms_error": error, "time_s": time_s})
        if time_s > LONGEST or (error is not None and error < FINEST):
            break
    return rows


# ----------------------------------------------------------------------------
# Ours.


def by_vmap(name, method, members, sizes=SIZES):
    """Rows of `jax.vmap` of `simulate`."""
    params = unravel(name)

    @partial(jax.jit, static_argnums=1)
    def every(vectors, n):
        return jax.vmap(lambda vector: ours.path(name, method, params(vector), n)[0])(vectors)

    given = jnp.asarray(vectors(name, members))
    return rows_of(name, members, f"{method}, vmap", "ours", sizes, lambda n: every(given, n))


def swept(name, method, stepper, members, settings, dts):
    """Rows of `hhtjax.sweep`. dts: setting -> its argument of that name."""
    case, (system, q0, v0) = cases()[name], ours.start(name, method)
    params = jax.vmap(unravel(name))(jnp.asarray(vectors(name, members)))
    grid = {"duration": case.scene.duration, "num_samples": SAMPLES, "in_axes": (None, None, None, 0)}

    @jax.jit
    def every(params, setting):
        return jax.vmap(jax.vmap(flat))(hhtjax.sweep(system, stepper, q0, v0, params, dts=dts(setting), **grid).q)

    kind = f"{method}, sweep"
    run = lambda x: every(params, jnp.asarray(x, float))[:, 1:, : case.size]  # noqa: E731
    return rows_of(name, members, kind, "ours", settings, run)


def our_rows(name, members):
    """All of ours."""
    duration, rows = cases()[name].scene.duration, []
    for method in ALONE[name]:
        stepper = ours.METHODS[method][0]
        rows += swept(name, method, stepper, members, SIZES, lambda n: jnp.full(members, duration / SAMPLES) / n)
    for method in TOGETHER[name]:
        rows += by_vmap(name, method, members)
    method = ADAPTIVE[name]
    rows += swept(
        name,
        method,
        ours.CONTROLLED[method],
        members,
        ours.TOLERANCES[:8],
        lambda x: hhtjax.adaptive(jnp.full(members, x), jnp.full(members, 1e-2 * x), max_steps=2000),
    )
    return rows


# ----------------------------------------------------------------------------
# The others: what follows from the parameters alone is computed ahead.


@cache
def constants(name, members):
    """The list without what depends on parameters alone, and that, (members, constants)."""
    ahead, rest = program(name).split()
    found = Evaluation(ahead, list(vectors(name, members).T), np).results()
    return rest, np.ascontiguousarray(np.stack([np.broadcast_to(x, members) for x in found], axis=1))


def numbalsoda_rows(name, members):
    """Both of its solvers in a parallel loop of numba's."""
    numba, package = named("numba"), named("numbalsoda")
    case, (rest, data) = cases()[name], constants(name, members)
    names = ["t", *(f"y[{i}]" for i in range(len(case.y0))), *(f"p[{i}]" for i in range(data.shape[1]))]
    rate = compiled_source(python_source(rest, "rate", ("t", "y", "dy", "p"), names), "rate")
    compiled = numba.cfunc(package.lsoda_sig, error_model="numpy")(rate)
    y0, grid, address, rows = np.array(case.y0, float), with_start(case.times), compiled.address, []
    for solver in ("lsoda", "dop853") if name.startswith("free") else ("lsoda",):
        one = getattr(package, solver)

        @numba.njit(parallel=True)
        def every(address, data, y0, grid, tolerance, size, one=one):
            found = np.empty((len(data), len(grid) - 1, size))
            for i in numba.prange(len(data)):
                path, _ = one(address, y0, grid, data[i], tolerance, 1e-2 * tolerance, MOST_STEPS)
                found[i] = path[1:, :size]
            return found

        def run(tolerance, every=every):
            return every(address, data, y0, grid, tolerance, case.size)

        with silent():
            rows += rows_of(name, members, f"numbalsoda {solver.upper()}, prange", "numbalsoda", TOLERANCES, run)
    return rows


def heyoka_rows(name, members):
    """Batches of as many as a register holds, by as many threads as there are cores."""
    heyoka, case = named("heyoka"), cases()[name]
    rest, data = constants(name, members)
    lanes, hands = heyoka.recommended_simd_size(), os.cpu_count() or 1
    y = [x for x, _ in heyoka_system(name)]
    found = Evaluation(rest, [heyoka.time, *y, *(heyoka.par[i] for i in range(data.shape[1]))], heyoka).results()
    system = [(a, heyoka.expression(float(b)) if isinstance(b, float) else b) for a, b in zip(y, found, strict=True)]
    start = np.repeat(np.asarray(case.y0)[:, None], lanes, axis=1)
    grid = np.repeat(with_start(case.times)[:, None], lanes, axis=1)
    groups = np.minimum(np.arange(-(-members // lanes) * lanes), members - 1).reshape(-1, lanes)

    @cache
    def integrators(tolerance):
        make = partial(heyoka.taylor_adaptive_batch, system, start, pars=np.ones((data.shape[1], lanes)))
        return [make(tol=tolerance) for _ in range(hands)]

    def some(integrator, groups, path):
        for members in groups:
            integrator.set_time(0.0)
            integrator.state[:], integrator.pars[:] = start, data[members].T
            _, found = integrator.propagate_grid(grid)
            if not all(is_finished(*x[:3]) for x in integrator.propagate_res):
                return False
            path[members] = np.moveaxis(found[1:, : case.size], 2, 0)
        return True

    def run(tolerance):
        path = np.empty((members, SAMPLES, case.size))
        with ThreadPoolExecutor(hands) as pool:
            parts = [groups[i::hands] for i in range(hands)]
            fine = list(pool.map(some, integrators(tolerance), parts, [path] * hands))
        return path if all(fine) else None

    return rows_of(name, members, f"heyoka Taylor, batches of {lanes}", "heyoka", TOLERANCES, run)


PEERS = {"numbalsoda": numbalsoda_rows, "heyoka": heyoka_rows}


def run(report, fast):
    """All batches."""
    names, members = (NAMES[1:], 4) if fast else (NAMES, MEMBERS)
    there = [] if fast else [module for module in PEERS if importlib.util.find_spec(module)]
    rows, summary = [], {}
    for name in names:
        reference(name, members)
        if fast:
            rows += by_vmap(name, "hht", members, SIZES[:1])
            continue
        mine = our_rows(name, members)
        report.progress(f"batches, {name}: ours")
        for module in there:
            mine += PEERS[module](name, members)
        report.progress(f"batches, {name}: the others")
        rows += mine
        summary[name] = times(mine, LEVELS)
        print(f"{members} members, {name}: ms to an RMS error of")
        show(report, summary[name], LEVELS)
    missing = [module for module in PEERS if module not in there]
    return {
        "batches": {
            "members": members,
            "spread": SPREAD,
            "cores": os.cpu_count(),
            "not_installed": missing,
            "times": summary,
            "rows": rows,
        }
    }
