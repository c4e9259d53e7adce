"""Gradients of a path loss by two to four parameters: their error against the time of value and gradient.

The loss is the mean square of positions at the sample times; derivatives are by the logarithms of the parameters, so
that all count alike; the error is relative, in the Euclidean norm. The reference integrates the sensitivities along.
"""

import importlib.util
import time
from functools import cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from scipy.integrate import solve_ivp

import hhtjax
from experiments.work_precision import diffrax_peers, ours, scipy_peers
from experiments.work_precision.cases import SAMPLES, cases, flat
from experiments.work_precision.figures import draw_gradients
from experiments.work_precision.timing import enough, lines, seconds, show, times

STIFF = "hht, predictor", "hht, extrapolate=2", "rowda", "rk4"
SMOOTH = "hht, predictor", "hht, extrapolate=2", "rk4"
EXPLICIT = ("Tsit5", "forward"), ("Tsit5", "reverse")
IMPLICIT = ("Kvaerno3", "forward"), ("Kvaerno5", "forward")  # reverse takes longer, to compile and to run
PEERS = *EXPLICIT, *IMPLICIT, ("Kvaerno5", "reverse")
SIZES = tuple(2**i for i in range(11))  # steps between sample times
REVERSE_SIZES = 4, 16, 64  # each compiled anew
MOST_STEPS = 2**15
LONGEST_LINE = 10  # s behind its first point, after which nothing finer is tried
STEPPERS = {"hht": ours.SMOOTH, "rk4": hhtjax.rk4()}  # of runs by `simulate`


class Of(NamedTuple):
    """What is done on a scene. keys: of its parameters; forward: methods with constant steps; reverse: those of
    `simulate`; controlled: methods; peers: solvers of diffrax, and modes; seen: which positions are in the loss."""

    keys: tuple[str, ...] = ("k", "c")
    forward: tuple[str, ...] = STIFF
    reverse: tuple[str, ...] = ("hht",)
    controlled: tuple[str, ...] = ("rowda, adaptive",)
    peers: tuple = PEERS
    seen: tuple[int, ...] | None = None


DOPRI5 = ("dopri5, adaptive",)
SCENES = {
    "free double pendulum": Of(("m", "l"), SMOOTH, ("rk4",), DOPRI5),
    "stiff double pendulum": Of(),
    "stiff double pendulum, torques as printed": Of(peers=(EXPLICIT[0], *IMPLICIT)),
    "stiff chain of 8": Of(reverse=(), controlled=DOPRI5, peers=(*EXPLICIT, *IMPLICIT)),
    "forced Duffing": Of(("k", "c"), SMOOTH, ("hht", "rk4"), DOPRI5),
    "hardening spring": Of(("k", "k3"), SMOOTH, ("rk4",), DOPRI5, (*EXPLICIT, *IMPLICIT)),
    "squeezer": Of(("c0", "moment"), SMOOTH, (), DOPRI5, EXPLICIT),
    # all entries of a rotation have a constant sum of squares: the vertical one of the rod alone
    "top": Of(("g", "a"), SMOOTH, ("rk4",), DOPRI5, EXPLICIT, (7,)),
}


def scaled(name, s):
    """The parameters of a scene with each number of those in question times one of s."""
    params = cases()[name].scene.params
    values, unravel = ravel_pytree({key: params[key] for key in SCENES[name].keys})
    return {**params, **unravel(values * s)}


def start(name):
    """s of the parameters as they are."""
    params = cases()[name].scene.params
    return jnp.ones_like(ravel_pytree({key: params[key] for key in SCENES[name].keys})[0])


def seen(name, path):
    """Of positions (times, size) those that are in the loss."""
    return path[:, : cases()[name].size] if SCENES[name].seen is None else path[:, np.array(SCENES[name].seen)]


def nan_unless(fine):
    """A factor, so that derivatives are NaN too."""
    return jnp.where(fine, 1.0, jnp.nan)


@cache
def reference(name):
    """The gradient, by DOP853 at a tolerance of 1e-12 on the ODE with its sensitivities."""
    case = cases()[name]
    n, s = len(case.y0), start(name)

    @jax.jit
    def rate(t, Y):
        y, S = Y[:n], Y[n:].reshape(n, -1)

        def f(y, s):
            return case.rate(t, y, scaled(name, s))

        columns = [jax.jvp(f, (y, s), (S[:, i], jnp.zeros_like(s).at[i].set(1.0)))[1] for i in range(s.size)]
        return jnp.concatenate([f(y, s), jnp.stack(columns, axis=1).ravel()])

    Y0 = np.concatenate([case.y0, np.zeros(n * s.size)])
    span = 0.0, case.scene.duration
    run = solve_ivp(lambda t, Y: np.asarray(rate(t, Y)), span, Y0, "DOP853", case.times, rtol=1e-12, atol=1e-13)
    q = seen(name, run.y[:n].T)
    S = run.y[n:].reshape(n, s.size, -1)
    each = np.stack([seen(name, S[:, i].T) for i in range(s.size)], axis=-1)
    return 2 * np.mean(q[:, :, None] * each, axis=(0, 1))


def sweep(name, method, package, settings, gradient, always_compiles=False):
    """Rows: error and time of `gradient(setting)`, which is None where it failed."""
    rows, exact, begun = [], reference(name), None
    for i, setting in enumerate(settings):
        found, time_s = seconds(lambda setting=setting: gradient(setting), i == 0 or always_compiles)
        error = None
        if found is not None and np.all(np.isfinite(found)):
            error = float(np.linalg.norm(found - exact) / np.linalg.norm(exact))
        row = {"case": name, "method": method, "package": package, "setting": setting}
        rows.append(row | {"rms_error": error, "time_s": time_s})
        begun = begun or time.perf_counter()
        if enough(time_s, error) or time.perf_counter() - begun > LONGEST_LINE:
            break
    return rows


def forward_rows(name, method, sizes):
    """Forward mode through the compiled loops, as one kernel."""
    case, s = cases()[name], start(name)
    stepper, levels, _ = ours.METHODS[method]
    system, q0, v0 = case.ode if method in ours.PLAIN else (case.scene.system, case.scene.q0, case.scene.v0)

    def loss(s, substeps):
        params, duration = scaled(name, s), case.scene.duration
        path, _ = ours.run(system, stepper, levels, q0, v0, duration, case.size, params, substeps)
        return jnp.mean(seen(name, path) ** 2)

    return sweep(name, f"{method}, forward", "ours", sizes, partial(jax.jit(jax.jacfwd(loss)), s))


def reverse_rows(name, method, sizes):
    """Reverse mode through `simulate`."""
    case, s = cases()[name], start(name)
    system, q0, v0 = case.ode if method in ours.PLAIN else (case.scene.system, case.scene.q0, case.scene.v0)

    def loss(s, substeps):
        steps = {"num_steps": SAMPLES * substeps, "save_every": substeps}
        dt = case.scene.duration / steps["num_steps"]
        run = hhtjax.simulate(system, STEPPERS[method], q0, v0, scaled(name, s), dt=dt, **steps)
        return jnp.mean(seen(name, jax.vmap(flat)(run.q)[1:]) ** 2)

    program = jax.jit(jax.value_and_grad(loss), static_argnums=1)
    called = "hht, predictor" if method == "hht" else method
    return sweep(name, f"{called}, reverse", "ours", sizes, lambda n: program(s, n)[1], True)


def controlled_rows(name, tolerances, methods=("rowda, adaptive", "dopri5, adaptive")):
    """Both modes under error control, through the steps that were chosen."""
    s, rows = start(name), []
    for method in methods:
        for mode, derivative in (("forward", jax.jacfwd), ("reverse", jax.grad)):

            def rows_for(most, tolerances, method=method, mode=mode, derivative=derivative):
                solution = ours.controlled(name, method, partial(scaled, name), most)

                def loss(s, tolerance):
                    found = solution(tolerance, s)
                    value = jnp.mean(seen(name, jax.vmap(flat)(found.q)[1:]) ** 2)
                    return value * nan_unless(found.steps.stop == 0)

                return sweep(name, f"{method}, {mode}", "ours", tolerances, partial(jax.jit(derivative(loss)), s))

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


def entries(report, name, installed):
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
    if installed:
        rows += diffrax_rows(name, diffrax_peers.TOLERANCES, of.peers)
    report.progress(f"gradients, {name}: the others")
    return rows


def run(report, fast):
    """The gradients of all scenes."""
    names, rows, summary = ["forced Duffing"] if fast else list(SCENES), [], {}
    for name in names:
        if fast:
            mine = forward_rows(name, SMOOTH[0], (1, 4))
        else:
            mine = entries(report, name, importlib.util.find_spec("diffrax") is not None)
        rows += mine
        summary[name] = times(mine)
        print(f"{name}: ms to a relative error of the gradient of")
        show(report, summary[name])
    charts = lines(rows)
    if not fast:
        draw_gradients(report, charts, names)
    return {"gradient_times": summary, "gradient_lines": charts}
