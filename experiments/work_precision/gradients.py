"""Gradients of a path loss by stiffness and damping: their error against the time of value and gradient.

The loss is the mean square of the positions at the sample times; derivatives are by the logarithms of the parameters,
so that all count alike; the error is relative, in the Euclidean norm. The reference integrates the sensitivities along.
"""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from scipy.integrate import solve_ivp

import hhtjax
from experiments.work_precision import diffrax_peers, ours, scipy_peers
from experiments.work_precision.cases import SAMPLES, cases, flat
from experiments.work_precision.timing import enough, seconds

SCENES = "stiff double pendulum", "forced Duffing"
FORWARD = "hht, predictor", "hht, extrapolate=2", "rowda", "rk4"
MODES = ("Tsit5", "reverse"), ("Kvaerno5", "reverse"), ("Kvaerno3", "forward"), ("Kvaerno5", "forward")
REVERSE_SIZES = 1, 4, 16
MOST_STEPS = 2**15


def scaled(params, s):
    """The parameters with each number of k and c times one of s."""
    values, unravel = ravel_pytree({key: params[key] for key in "kc"})
    return {**params, **unravel(values * s)}


def start(name):
    """s of the parameters as they are."""
    params = cases()[name].scene.params
    return jnp.ones_like(ravel_pytree({key: params[key] for key in "kc"})[0])


@cache
def reference(name):
    """The gradient, by DOP853 at a tolerance of 1e-12 on the ODE with its sensitivities."""
    case = cases()[name]
    n, s = len(case.y0), start(name)

    @jax.jit
    def rate(t, Y):
        y, S = Y[:n], Y[n:].reshape(n, -1)

        def f(y, s):
            return case.rate(t, y, scaled(case.scene.params, s))

        columns = [jax.jvp(f, (y, s), (S[:, i], jnp.zeros_like(s).at[i].set(1.0)))[1] for i in range(s.size)]
        return jnp.concatenate([f(y, s), jnp.stack(columns, axis=1).ravel()])

    Y0 = np.concatenate([case.y0, np.zeros(n * s.size)])
    span = 0.0, case.scene.duration
    run = solve_ivp(lambda t, Y: np.asarray(rate(t, Y)), span, Y0, "DOP853", case.times, rtol=1e-12, atol=1e-13)
    q = run.y[: case.size].T
    S = run.y[n:].reshape(n, s.size, -1)[: case.size].transpose(2, 0, 1)
    return 2 * np.mean(q[:, :, None] * S, axis=(0, 1))


def sweep(name, method, package, settings, gradient, always_compiles=False):
    """Rows: error and time of `gradient(setting)`, which is None where it failed."""
    rows, exact = [], reference(name)
    for i, setting in enumerate(settings):
        found, time_s = seconds(lambda setting=setting: gradient(setting), i == 0 or always_compiles)
        error = None
        if found is not None and np.all(np.isfinite(found)):
            error = float(np.linalg.norm(found - exact) / np.linalg.norm(exact))
        rows.append(
            {
                "case": name,
                "method": method,
                "package": package,
                "setting": setting,
                "rms_error": error,
                "time_s": time_s,
            }
        )
        if enough(time_s, error):
            break
    return rows


def our_rows(name, sizes, reverse_sizes, only=FORWARD):
    """Forward mode through the compiled loops, reverse mode through `simulate`."""
    case, s, rows = cases()[name], start(name), []
    system, params, q0, v0, duration = case.scene
    for method in only:
        stepper, levels, _ = ours.METHODS[method]

        def loss(s, substeps, stepper=stepper, levels=levels):
            path, _ = ours.run(system, stepper, levels, q0, v0, duration, case.size, scaled(params, s), substeps)
            return jnp.mean(path**2)

        program = jax.jit(jax.jacfwd(loss))
        rows += sweep(name, f"{method}, forward", "ours", sizes, partial(program, s))

    def loss_by_simulate(s, substeps):
        run = hhtjax.simulate(
            system,
            ours.SMOOTH,
            q0,
            v0,
            scaled(params, s),
            dt=duration / (SAMPLES * substeps),
            num_steps=SAMPLES * substeps,
            save_every=substeps,
        )
        return jnp.mean(jax.vmap(flat)(run.q)[1:] ** 2)

    reverse = jax.jit(jax.value_and_grad(loss_by_simulate), static_argnums=1)
    if reverse_sizes:
        rows += sweep(name, "hht, predictor, reverse", "ours", reverse_sizes, lambda n: reverse(s, n)[1], True)
    return rows


def controlled_rows(name, tolerances, methods=("rowda, adaptive", "dopri5, adaptive")):
    """Both modes under error control, through the steps that were chosen."""
    s, rows = start(name), []
    for method in methods:
        solution = ours.controlled(name, method, lambda s: scaled(cases()[name].scene.params, s))

        def loss(s, tolerance, solution=solution):
            found = solution(tolerance, s)
            value = jnp.mean(jax.vmap(flat)(found.q)[1:, : cases()[name].size] ** 2)
            return jnp.where(found.steps.stop == 0, value, jnp.nan)

        for mode, derivative in (("forward", jax.jacfwd(loss)), ("reverse", jax.grad(loss))):
            rows += sweep(name, f"{method}, {mode}", "ours", tolerances, partial(jax.jit(derivative), s))
    return rows


def diffrax_rows(name, tolerances):
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
            scaled(case.scene.params, s),
            saveat=diffrax.SaveAt(ts=jnp.asarray(case.times)),
            stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=1e-2 * tolerance),
            max_steps=MOST_STEPS,
            adjoint=adjoint,
            throw=False,
        )
        fine = found.result == diffrax.RESULTS.successful
        assert found.ys is not None
        return jnp.where(fine, jnp.mean(found.ys[:, : case.size] ** 2), jnp.nan)

    for solver, mode in (
        ("Tsit5", "reverse"),
        ("Kvaerno5", "reverse"),
        ("Kvaerno3", "forward"),
        ("Kvaerno5", "forward"),
    ):
        forward = mode == "forward"
        adjoint = diffrax.ForwardMode() if forward else diffrax.RecursiveCheckpointAdjoint()
        derivative = (jax.jacfwd if forward else jax.grad)(partial(loss, solver=solver, adjoint=adjoint))
        program = partial(jax.jit(derivative), s)
        rows += sweep(name, f"diffrax {solver}, {mode}", "diffrax", tolerances, program)
    return rows


def scipy_rows(name, tolerances):
    """Central differences of LSODA; the step suits the tolerance."""
    case, s = cases()[name], np.asarray(start(name))
    make = scipy_peers.by_c if "double pendulum" in name and scipy_peers.native.library() else scipy_peers.by_jax

    def loss(s, tolerance):
        changed = case._replace(scene=case.scene._replace(params=scaled(case.scene.params, jnp.asarray(s))))
        span = 0.0, case.scene.duration
        run = solve_ivp(make(changed), span, case.y0, "LSODA", case.times, rtol=tolerance, atol=1e-2 * tolerance)
        return np.mean(run.y[: case.size] ** 2) if run.success else np.nan

    def gradient(tolerance):
        step = tolerance ** (1 / 3)
        changes = step * np.eye(len(s))
        return np.array([(loss(s + d, tolerance) - loss(s - d, tolerance)) / (2 * step) for d in changes])

    return sweep(name, "SciPy LSODA, differences", "SciPy", tolerances, gradient)


def entries(names, fast, installed):
    """Rows of all methods."""
    rows = []
    for name in names:
        if fast:
            rows += our_rows(name, (1, 4), (), FORWARD[:1])
            continue
        rows += our_rows(name, tuple(2**i for i in range(11)), REVERSE_SIZES)
        rows += controlled_rows(name, ours.TOLERANCES)
        rows += scipy_rows(name, scipy_peers.TOLERANCES[2::2])
        if "diffrax" in installed:
            rows += diffrax_rows(name, diffrax_peers.TOLERANCES[1:])
    return rows
