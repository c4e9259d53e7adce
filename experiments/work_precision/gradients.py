"""Gradients of a path loss by two to four parameters: their error against the time of value and gradient.

The loss is the mean square of positions at the sample times; derivatives are by the logarithms of the parameters, so
that all count alike; the error is relative, in the Euclidean norm. The reference integrates the sensitivities along.
"""

import importlib.util
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import hhtjax
from experiments.work_precision import compiled_gradients, diffrax_peers, ours, scipy_peers, timing
from experiments.work_precision.cases import SAMPLES, cases, flat
from experiments.work_precision.figures import draw_gradients
from experiments.work_precision.gradient_scenes import SCENES, SMOOTH, nan_unless, reference, scaled, seen, start, sweep
from experiments.work_precision.timing import lines, show, times

SIZES = tuple(4**i for i in range(6))  # steps between sample times, each compiled anew
LEVELS = timing.LEVELS[:-1]  # the reference knows no more
REVERSE_SIZES = 4, 16, 64  # each compiled anew
MOST_STEPS = 2**15
STEPPERS = {"hht": ours.SMOOTH, "rk4": hhtjax.rk4()}  # of runs by `simulate`


def forward_rows(name, method, sizes):
    """Forward mode through `simulate`."""
    s = start(name)

    def loss(s, substeps):
        return jnp.mean(seen(name, ours.path(name, method, scaled(name, s), substeps)[0]) ** 2)

    program = jax.jit(jax.jacfwd(loss), static_argnums=1)
    return sweep(name, f"{method}, forward", "ours", sizes, lambda n: program(s, n), True)


def reverse_rows(name, method, sizes):
    """Reverse mode through `simulate`."""
    case, s = cases()[name], start(name)
    system, q0, v0 = ours.start(name, method)

    def loss(s, substeps):
        steps = {"num_steps": SAMPLES * substeps, "save_every": substeps}
        dt = case.scene.duration / steps["num_steps"]
        run = hhtjax.simulate(system, STEPPERS[method], q0, v0, scaled(name, s), dt=dt, **steps)
        return jnp.mean(seen(name, jax.vmap(flat)(run.q)[1:]) ** 2)

    program = jax.jit(jax.value_and_grad(loss), static_argnums=1)
    called = "hht, predictor" if method == "hht" else method
    return sweep(name, f"{called}, reverse", "ours", sizes, lambda n: program(s, n)[1], True)


def controlled_rows(name, tolerances, methods=("rodas5p, adaptive", "tsit5, adaptive")):
    """Both modes under error control, through the steps that were chosen."""
    s, rows = start(name), []
    for method in methods:
        for mode, derivative in (("forward", jax.jacfwd), ("reverse", jax.grad)):

            def rows_for(most, tolerances, method=method, mode=mode, derivative=derivative):
                solution = ours.controlled(name, method, most)

                def loss(s, tolerance):
                    found = solution(tolerance, scaled(name, s))
                    value = jnp.mean(seen(name, jax.vmap(flat)(found.q)[1:]) ** 2)
                    return value * nan_unless(found.steps.stop == 0)

                own = ours.has_own_programs(method)
                program = jax.jit(derivative(loss), static_argnums=1 if own else ())
                return sweep(name, f"{method}, {mode}", "ours", tolerances, partial(program, s), own)

            rows += ours.while_needed(rows_for, tolerances)
    return rows


def diffrax_rows(name, tolerances, peers):
    """Both modes, with step-size control."""
    import diffrax  # pyright: ignore[reportMissingImports]  # of an extra of its own

    case, s, rows = cases()[name], start(name), []

    def loss(s, tolerance, solver, adjoint):
        found = diffrax.diffeqsolve(
            diffrax.ODETerm(case.rate),
            diffrax_peers.make_solver(solver, False),
            0.0,
            case.scene.duration,
            None,
            jnp.asarray(case.y0),
            scaled(name, s),
            saveat=diffrax.SaveAt(ts=jnp.asarray(case.times)),
            stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=1e-2 * tolerance),
            max_steps=MOST_STEPS,
            adjoint=adjoint,
            throw=False,
        )
        fine = found.result == diffrax.RESULTS.successful
        assert found.ys is not None
        return jnp.mean(seen(name, found.ys) ** 2) * nan_unless(fine)

    for solver, mode in peers:
        forward = mode == "forward"
        adjoint = diffrax.ForwardMode() if forward else diffrax.RecursiveCheckpointAdjoint()
        derivative = (jax.jacfwd if forward else jax.grad)(partial(loss, solver=solver, adjoint=adjoint))
        program = partial(jax.jit(derivative), s)
        rows += sweep(name, f"diffrax {solver}, {mode}", "diffrax", tolerances, program)
    return rows


def scipy_rows(name, tolerances, solver="LSODA"):
    """Central differences; the step suits the tolerance."""
    case, s = cases()[name], np.asarray(start(name))
    make = scipy_peers.by_c if "double pendulum" in name and scipy_peers.native.library() else scipy_peers.by_jax

    def loss(s, tolerance):
        changed = case._replace(scene=case.scene._replace(params=scaled(name, jnp.asarray(s))))
        span = 0.0, case.scene.duration
        run = solve_ivp(make(changed), span, case.y0, solver, case.times, rtol=tolerance, atol=1e-2 * tolerance)
        return np.mean(seen(name, run.y.T) ** 2) if run.success else np.nan

    def gradient(tolerance):
        step = tolerance ** (1 / 3)
        changes = step * np.eye(len(s))
        return np.array([(loss(s + d, tolerance) - loss(s - d, tolerance)) / (2 * step) for d in changes])

    return sweep(name, f"SciPy {solver}, differences", "SciPy", tolerances, gradient)


def entries(report, name, there):
    """Rows of all methods on a scene."""
    of, rows = SCENES[name], []
    reference(name)
    report.progress(f"gradients, {name}: reference")
    for method in of.forward:
        rows += forward_rows(name, method, SIZES)
    for method in of.reverse:
        rows += reverse_rows(name, method, REVERSE_SIZES)
    rows += controlled_rows(name, ours.TOLERANCES, of.controlled)
    report.progress(f"gradients, {name}: ours")
    rows += scipy_rows(name, scipy_peers.TOLERANCES[2::2])
    if "diffrax" in there:
        rows += diffrax_rows(name, diffrax_peers.TOLERANCES, of.peers)
    for module, rows_of in compiled_gradients.ROWS.items():
        rows += rows_of(name) if module in there else []
    report.progress(f"gradients, {name}: the others")
    return rows


def run(report, fast):
    """The gradients of all scenes."""
    names, rows, summary = ["forced Duffing"] if fast else list(SCENES), [], {}
    there = [module for module in ("diffrax", *compiled_gradients.ROWS) if importlib.util.find_spec(module)]
    for name in names:
        mine = forward_rows(name, SMOOTH[0], (1, 4)) if fast else entries(report, name, there)
        rows += mine
        summary[name] = times(mine, LEVELS)
        print(f"{name}: ms to a relative error of the gradient of")
        show(report, summary[name], LEVELS)
    charts = lines(rows)
    if not fast:
        draw_gradients(report, charts, names)
    return {"gradient_times": summary, "gradient_lines": charts}
