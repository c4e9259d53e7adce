"""Work and precision on the squeezer at t = 0.03 s: with and without iterations, and the rivals.

A "solve" is one factorised matrix with the mechanism's constraints in it: Newton's of a step, the index-1 system of one
evaluation of an ODE, or those of scipy-dae. Our steps and RK4 run in compiled loops; SciPy's methods call back into
Python for each evaluation, of a compiled function. Times are CPU times, which other processes hardly lengthen.
"""

import importlib.util
import time
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

from experiments.cardona_geradin1989.index_1 import (
    accelerations,
    compiled_rate,
    reference,
    unconstrained,
    violation,
)
from experiments.cardona_geradin1989.runs import constrained_hht, end, least_seconds
from experiments.report import MARKERS, side_by_side
from hhtjax import rk4
from hhtjax.plot import subplots, work_precision
from hhtjax.scenes import squeezer

ALPHA = -0.1
BARS = {2e-4: 6e-2, 1e-4: 1.2e-2, 5e-5: 2.6e-3, 1e-5: 1e-4}  # h, s: largest error of q, rad, that NI-GGL may have
NUM_STEPS = (150, 300, 600, 1200, 3000, 6000, 12000)  # the bars' h among them
FAST_STEPS = (150, 300)
STEPPERS: dict[str, Any] = {
    "non-iterative, GGL": constrained_hht(ALPHA, "ggl"),
    "non-iterative, index 3": constrained_hht(ALPHA, "index3"),
    "converged, GGL": constrained_hht(ALPHA, "ggl", None),
    "converged, index 3": constrained_hht(ALPHA, "index3", None),
}
FAST_STEPPER = "non-iterative, index 3"
RK4 = "index 1, RK4"
STOPS = 1e-10, 1e-6, 1e-3  # N m: Newton's tolerance, for the comparison of times
STOP_STEPS = 600
SCIPY = {"index 1, DOP853": "DOP853", "index 1, LSODA": "LSODA", "index 1, Radau": "Radau"}
DAE = {"scipy-dae, Radau": "Radau", "scipy-dae, BDF": "BDF"}
TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9)
UNITS = {"q": "rad", "v": "rad_s", "multiplier": "N"}


def entry(method, how_fine, found, exact, seconds, solves):
    """Numbers of one run; found, exact: q, v, L."""
    errors = {
        f"{x}_error_{u}": float(np.abs(a - b).max()) for (x, u), a, b in zip(UNITS.items(), found, exact, strict=True)
    }
    return {"method": method, **how_fine, **errors, "cpu_time_s": seconds, "solves": int(solves)}


def our_entries(scene, exact, names, sizes, repeats):
    """Of the compiled loops: ours, and RK4 on the index-1 system."""
    cases: dict[str, Any] = {name: (scene, STEPPERS[name]) for name in names}
    if len(names) > 1:
        cases[RK4] = scene._replace(system=unconstrained(scene.system, scene.q0.size)), rk4()
    side_by_side([partial(end, *case, 2) for case in cases.values()])
    multipliers = jax.jit(partial(accelerations, scene.system))
    entries = []
    for n in sizes:
        seconds = least_seconds([partial(end, *case, n) for case in cases.values()], repeats)
        for (name, case), time_s in zip(cases.items(), seconds, strict=True):
            state, solves = end(*case, n)
            L = multipliers(state.q, state.v, state.t, scene.params)[1] if name == RK4 else state.L
            solves = 4 * n if name == RK4 else solves
            entries.append(entry(name, {"h_s": scene.duration / n}, (state.q, state.v, L), exact, time_s, solves))
    return entries


def timed(function):
    """What it returns, and the least CPU time of two calls."""
    times = []
    for _ in range(2):
        start = time.process_time()
        result = function()
        times.append(time.process_time() - start)
    return result, min(times)


def scipy_entries(scene, exact, names, tolerances):
    """Of SciPy's methods on the index-1 ODE."""
    rate, jacobian = (lambda t, y, f=f: np.asarray(f(t, y)) for f in compiled_rate(scene))
    multipliers = jax.jit(partial(accelerations, scene.system))
    y0 = np.concatenate([scene.q0, scene.v0])
    for function in rate, jacobian:
        function(0.0, y0)  # to compile
    entries = []
    for name in names:
        options = {"jac": jacobian} if SCIPY[name] == "Radau" else {}
        for tolerance in tolerances:
            solve = partial(solve_ivp, rate, (0, scene.duration), y0, SCIPY[name], rtol=tolerance, atol=tolerance)
            run, seconds = timed(partial(solve, **options))
            q, v = np.split(run.y[:, -1], 2)
            found = q, v, multipliers(q, v, scene.duration, scene.params)[1]
            entries.append(entry(name, {"tolerance": tolerance}, found, exact, seconds, run.nfev + run.njev))
    return entries


def dae_entries(scene, exact, names, tolerances):
    """Of scipy-dae on the GGL system, q' = v + B^T mu; L and mu are the rates of the last unknowns."""
    from scipy_dae.integrate import solve_dae  # pyright: ignore[reportMissingImports]  # of an extra of its own

    system, params, q0, v0, duration = scene
    w0, L0 = accelerations(system, q0, v0, jnp.zeros(()), params)
    n, m = q0.size, L0.size

    @jax.jit
    def residual(t, y, rate):
        (q, v, _), (q1, w, L, mu) = jnp.split(y, [n, 2 * n]), jnp.split(rate, [n, 2 * n, 2 * n + m])
        B = jax.jacfwd(lambda q: system.constraint(q, t, params))(q)
        forces = system.mass(q, params) @ w - system.force(q, v, t, params) - B.T @ L
        return jnp.concatenate([q1 - v - B.T @ mu, forces, *violation(system, q, v, t, params)])

    jacobian = jax.jit(jax.jacfwd(residual, (1, 2)))
    begin = np.concatenate([q0, v0, np.zeros(2 * m)]), np.concatenate([v0, w0, L0, np.zeros(m)])

    def compiled(t, y, rate):
        return np.asarray(residual(t, y, rate))

    def derivatives(t, y, rate):
        return tuple(np.asarray(x) for x in jacobian(t, y, rate))

    derivatives(0.0, *begin)
    entries = []
    for name in names:
        for tolerance in tolerances:
            options = {"method": DAE[name], "rtol": tolerance, "atol": tolerance, "jac": derivatives}
            run, seconds = timed(partial(solve_dae, compiled, (0.0, duration), *begin, **options))
            y, rate = run.y[:, -1], run.yp[:, -1]
            found = y[:n], y[n : 2 * n], rate[2 * n : 2 * n + m]
            entries.append(entry(name, {"tolerance": tolerance}, found, exact, seconds, run.nlu))
    return entries


def stops(scene, exact, repeats):
    """Time per step of the converged forms over the non-iterative ones, by Newton's tolerance, at one step size."""
    forms = "ggl", "index3"
    cases: list[Any] = [("non-iterative", form, None, constrained_hht(ALPHA, form)) for form in forms]
    for form in forms:
        cases += [("converged", form, stop, constrained_hht(ALPHA, form, None, stop)) for stop in STOPS]
    seconds = least_seconds([partial(end, scene, stepper, STOP_STEPS) for *_, stepper in cases], repeats)
    rows = []
    for (name, form, stop, stepper), time_s in zip(cases, seconds, strict=True):
        state, solves = end(scene, stepper, STOP_STEPS)
        rows.append(
            {
                "method": name,
                "formulation": form,
                "newton_tolerance_N_m": stop,
                "cpu_time_per_step_us": 1e6 * time_s / STOP_STEPS,
                "time_over_non_iterative": time_s / seconds[forms.index(form)],
                "solves_per_step": float(solves / STOP_STEPS),
                "q_error_rad": float(np.abs(state.q - exact[0]).max()),
            }
        )
    return rows


def orders(entries, method):
    """Observed orders of q, v and multipliers between the two finest steps."""
    coarse, fine = sorted((e for e in entries if e["method"] == method), key=lambda e: -e["h_s"])[-2:]
    ratio = np.log(coarse["h_s"] / fine["h_s"])
    return {x: float(np.log(coarse[f"{x}_error_{u}"] / fine[f"{x}_error_{u}"]) / ratio) for x, u in UNITS.items()}


def run(report, fast):
    """All methods and rivals."""
    scene = squeezer.squeezer()
    q, v, _, L = reference(scene, np.array([scene.duration]))
    exact = q[0], v[0], L[0]
    names = [FAST_STEPPER] if fast else list(STEPPERS)
    entries = our_entries(scene, exact, names, FAST_STEPS if fast else NUM_STEPS, 1 if fast else 15)
    found_orders = {name: orders(entries, name) for name in names}
    report.progress("squeezer: compiled loops")
    tolerances = TOLERANCES[:1] if fast else TOLERANCES
    entries += scipy_entries(scene, exact, list(SCIPY)[:1] if fast else SCIPY, tolerances)
    report.progress("squeezer: SciPy")
    installed = importlib.util.find_spec("scipy_dae") is not None
    if not installed:
        print("scipy-dae is not installed: its Radau and BDF are left out (pip install scipy-dae).\n")
    elif not fast:
        entries += dae_entries(scene, exact, DAE, tolerances)
        report.progress("squeezer: scipy-dae")
    by_stop = [] if fast else stops(scene, exact, 30)
    show(report, entries, by_stop)
    if not fast:
        report.figure("cardona_geradin1989_error_by_time", figure(entries, "cpu_time_s", "CPU time (s)"))
        report.figure("cardona_geradin1989_error_by_solves", figure(entries, "solves", "number of solves"))
    return {
        "alpha": ALPHA,
        "duration_s": scene.duration,
        "scipy_dae": installed,
        "orders": found_orders,
        "entries": entries,
        "newton_tolerances": by_stop,
    }


def show(report, entries, by_stop):
    """Errors, times and solves."""
    print("Squeezer at t = 0.03 s, alpha = -0.1\n")
    keys = [*(f"{x}_error_{u}" for x, u in UNITS.items()), "cpu_time_s", "solves"]
    rows = [[e["method"], f"{e.get('h_s', e.get('tolerance')):.0e}", *(e[key] for key in keys)] for e in entries]
    report.table(["method", "h (s), tolerance", "q (rad)", "v (rad/s)", "L (N)", "CPU time (s)", "solves"], rows)
    if by_stop:
        keys = "cpu_time_per_step_us", "time_over_non_iterative", "solves_per_step", "q_error_rad"
        rows = [
            [f"{e['method']}, {e['formulation']}", f"{e['newton_tolerance_N_m']}", *(e[k] for k in keys)]
            for e in by_stop
        ]
        report.table(
            ["method", "Newton's tolerance", "us per step", "over non-iterative", "solves per step", "q (rad)"], rows
        )


def figure(entries, work, label):
    """Errors against time or solves."""
    methods = list(dict.fromkeys(e["method"] for e in entries))
    drawn, panels = subplots(1, len(UNITS), width=175, height=95)
    names = {method: f"HHT, {method}" if i < 4 else method for i, method in enumerate(methods)}
    markers = (*MARKERS, "<", "h")
    lines = {
        name: {"marker": markers[i], "mfc": "none" if i % 2 else None} | ({"lw": 1.2} if i < 4 else {})
        for i, name in enumerate(names.values())
    }
    for axes, (x, unit) in zip(panels, UNITS.items(), strict=True):
        curves = {}
        for method, name in names.items():
            mine = [e for e in entries if e["method"] == method]
            curves[name] = [e[work] for e in mine], [e[f"{x}_error_{unit}"] for e in mine]
        words = {"xlabel": label, "ylabel": f"error of {x} ({unit.replace('_', '/')})"}
        work_precision(curves, ours=list(curves)[:4], lines=lines, **words, key=False, ax=axes)
    drawn.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return drawn
