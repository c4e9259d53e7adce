"""What steps do to the gradient: its error and time against h and alpha, beside the converged step and diffrax.

Kim's stiff double pendulum (see stiff_joint), 8 s; the loss is the mean square of simulated less measured angles at
100 times, and its gradient is taken with respect to the logarithms of k and c, all of them 1.5 times too large.
"""

import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from hhtjax.scenes import double_pendulum

SCENE = double_pendulum.stiff()
DURATION, SAMPLES = 8.0, 100
TRUTH = jnp.log(jnp.array([400.0, 300.0, 15.0, 10000.0]))
AWAY = jnp.log(1.5)
STEPS_PER_SAMPLE = (1, 2, 4, 8, 16, 32)
METHODS = {
    "non-iterative, alpha = 0": (hhtjax.hht, {"linearize": "predictor"}, 0.0),
    "non-iterative, alpha = -0.05": (hhtjax.hht, {"linearize": "predictor"}, -0.05),
    "non-iterative, alpha = -0.3": (hhtjax.hht, {"linearize": "predictor"}, -0.3),
    "converged, alpha = 0": (hhtjax.hht, {"iterations": None}, 0.0),
    "converged, alpha = -0.3": (hhtjax.hht, {"iterations": None}, -0.3),
    "Kim's step, alpha = 0": (hhtjax.kim_hht, {}, 0.0),
}


def own(x):
    """params of the scene for the logarithms x of k1, k2, c1, c2."""
    k1, k2, c1, c2 = jnp.exp(x)
    return SCENE.params | {"k": (k1, k2), "c": (c1, c2)}


def angles(x, stepper, steps_per_sample):
    """(SAMPLES, 2)."""
    steps = SAMPLES * steps_per_sample
    run = hhtjax.simulate(
        SCENE.system, stepper, SCENE.q0, SCENE.v0, own(x), dt=DURATION / steps, num_steps=steps,
        save_every=steps_per_sample,
    )  # fmt: skip
    return run.q[1:]


@partial(jax.jit, static_argnames=("make", "steps_per_sample", "options"))
def gradient(x, measured, alpha, make, options, steps_per_sample):
    """Of the loss, by reverse mode."""
    stepper = make(alpha, **dict(options))
    return jax.grad(lambda x: jnp.mean((angles(x, stepper, steps_per_sample) - measured) ** 2))(x)


def diffrax_gradient(diffrax, tolerance):
    """The same by an adaptive, L-stable Runge-Kutta method of order 5 with diffrax's default adjoint."""

    def loss(x, measured):
        found = diffrax.diffeqsolve(
            hhtjax.interop.diffrax_term(SCENE.system), diffrax.Kvaerno5(), 0.0, DURATION, None,
            (jnp.zeros(2), jnp.zeros(2)), own(x),
            saveat=diffrax.SaveAt(ts=DURATION * jnp.arange(1, SAMPLES + 1) / SAMPLES),
            stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance), max_steps=16384,
        )  # fmt: skip
        return jnp.mean((found.ys[0] - measured) ** 2)

    return jax.jit(jax.grad(loss))


def timed(function, repeats):
    """The result, and the least time of a call after the first, which compiles."""
    result = np.asarray(function())
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        jax.block_until_ready(function())
        times.append(time.perf_counter() - begin)
    return result, min(times)


def run(report, fast):
    """Errors and times by method and step; None where diffrax is not installed."""
    try:
        import diffrax  # pyright: ignore[reportMissingImports]  # of an extra of its own
    except ImportError:
        diffrax = None
    counts, repeats = (STEPS_PER_SAMPLE[:1], 1) if fast else (STEPS_PER_SAMPLE, 5)
    finest = 2 if fast else 256
    exact = angles(TRUTH, hhtjax.hht(alpha=0.0, iterations=None), finest)
    measured = exact * (1 + 0.01 * jax.random.normal(jax.random.key(0), exact.shape))
    x = TRUTH + AWAY
    take = partial(gradient, x, measured)
    fine = [take(0.0, hhtjax.hht, (("iterations", None),), n) for n in (finest // 2, finest)]
    reference = np.asarray(fine[1] + (fine[1] - fine[0]) / 3)

    def row(method, setting, found, seconds):
        error = float(np.linalg.norm(found - reference) / np.linalg.norm(reference))
        return {"method": method, **setting, "relative_error": error, "seconds": seconds}

    rows = []
    for method, (make, options, alpha) in list(METHODS.items())[:: 2 if fast else 1]:
        for n in counts:
            call = partial(take, alpha, make, tuple(options.items()), n)
            rows.append(row(method, {"h_s": DURATION / SAMPLES / n}, *timed(call, repeats)))
        report.progress(f"gradients, {method}: relative error {rows[-1]['relative_error']:.2g} with the smallest step")
    if diffrax is not None and not fast:
        for tolerance in (1e-3, 1e-4, 1e-6, 1e-8, 1e-10):
            call = partial(diffrax_gradient(diffrax, tolerance), x, measured)
            rows.append(row("diffrax Kvaerno5", {"tolerance": tolerance}, *timed(call, repeats)))
    report.table(
        ["method", "h (s) or tolerance", "error of the gradient", "ms"],
        [[r["method"], r.get("h_s", r.get("tolerance")), r["relative_error"], 1e3 * r["seconds"]] for r in rows],
    )
    return {"diffrax": None if diffrax is None else diffrax.__version__, "rows": rows}
