"""The paper's double pendulum, run by every method: RMS errors for step sizes and alphas as data."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

from experiments.report import side_by_side
from hhtjax import conventional_hht, hht, interop, kim_hht, kim_implicit_euler, rk4, simulate
from hhtjax.scenes import double_pendulum

SCENES = {
    "stiff": double_pendulum.stiff(as_printed=True),  # the paper's torques
    "stiff, complete": double_pendulum.stiff(),  # with the reaction of joint 2 on link 1
    "free": double_pendulum.free(),
}
METHODS = {  # alpha -> stepper
    "implicit Euler": lambda alpha: kim_implicit_euler(),
    "conventional HHT": conventional_hht,
    "non-iterative HHT": kim_hht,
    "converged": lambda alpha: hht(alpha, iterations=None),
    "predictor": lambda alpha: hht(alpha, linearize="predictor"),
    "refreshed": lambda alpha: hht(alpha, linearize="state"),
    "auto": lambda alpha: hht(alpha, linearize="auto"),
}
FINEST = 1e-4  # s, between the times of the reference
STEP_SIZES = (1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2, 2e-2, 5e-2, 1e-1, 2e-1)  # s
FAST_STEP_SIZES = (1e-3, 1e-2, 1e-1)  # s
ALPHAS = (0.0, -1e-3, -1e-2, -0.05, -0.1, -0.3)  # all of them run side by side, in one compilation


@cache
def reference(scene):
    """q at intervals of FINEST, by the fourth-order Runge-Kutta method with a quarter of that."""
    system, params, q0, v0, duration = SCENES[scene]
    num_steps = round(duration / FINEST)
    run = simulate(system, rk4(), q0, v0, params, dt=FINEST / 4, num_steps=4 * num_steps, save_every=4)
    run.check()
    return run.q


def check_reference(scene):
    """RMS difference of the reference, in rad, to SciPy's Radau or DOP853 over the first second."""
    system, params, q0, v0, _ = SCENES[scene]
    rhs = interop.scipy_rhs(system, q0, v0, params)
    times = np.arange(101) / 100
    method = "DOP853" if scene == "free" else "Radau"
    run = solve_ivp(rhs.fun, (0, 1), rhs.y0, method, times, rtol=1e-11, atol=1e-13)
    ours = np.asarray(reference(scene))[: round(1 / FINEST) + 1 : round(0.01 / FINEST)]
    return float(np.sqrt(np.mean((run.y[:2].T - ours) ** 2)))


@cache
def rms_errors(scene, method, dt):
    """RMS errors of q1 and q2 in rad over all steps, the start counted, (ALPHAS, 2); Newton iterations per step."""
    num_steps, stride = round(SCENES[scene].duration / dt), round(dt / FINEST)
    errors = _rms_errors(SCENES[scene], reference(scene), jnp.array(ALPHAS), dt, num_steps, stride, method=method)
    return tuple(np.asarray(x) for x in errors)


def compile_all(scenes, methods):
    """Compiles `rms_errors` for these, on all cores."""
    for scene in scenes:
        reference(scene)
    side_by_side([partial(rms_errors, scene, method, STEP_SIZES[-2]) for scene in scenes for method in methods])


@partial(jax.jit, static_argnames="method")
def _rms_errors(scene, reference, alphas, dt, num_steps, stride, *, method):
    """A loop with a traced num_steps, not `simulate`, so that all step sizes share one compilation."""

    def run(alpha):
        stepper = METHODS[method](alpha)

        def step(i, carry):
            state, squares, iterations = carry
            state, info = stepper.step(scene.system, state, scene.params, dt)
            squares = squares + (state.q - reference[stride * (i + 1)]) ** 2
            return state, squares, iterations + (1 if info.iterations is None else info.iterations)

        start = stepper.init(scene.system, scene.q0, scene.v0, scene.params, dt)
        _, squares, iterations = jax.lax.fori_loop(0, num_steps, step, (start, jnp.zeros(2), 0))
        return jnp.sqrt(squares / (num_steps + 1)), iterations / num_steps

    return jax.vmap(run)(alphas)
