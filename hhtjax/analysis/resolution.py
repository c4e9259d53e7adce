"""The step size that a motion needs, found by running it with steps that are halved."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from hhtjax.description import thaw
from hhtjax.steppers.stepper import begun

SAMPLES = 64  # times at which runs are compared; a power of two, so that the coarsest hit a part of them
FEWEST, ENOUGH, MOST = 8, 1024, 2**20  # steps of the first run, and at least and at most of the last


def step_size_by_runs(system, stepper, q0, v0, params, z0, t0, duration, tolerance):
    """The largest step from which on the error of q stays within the tolerance, and the steps of the finest run.

    The error is the RMS of q less that of the finest run, relative to the motion about its mean. Halving ends when two
    runs in a row keep to the tolerance, since one could agree by chance, and not before a run of ENOUGH steps: a few
    coarse ones agree where the method damps the same vibration out of all of them.

    Raises:
        ValueError: more than MOST steps would be needed.
    """
    run = partial(_samples, system, stepper, q0, v0, params, z0, t0, duration)
    counts, paths = [FEWEST], [np.asarray(run(FEWEST))]
    while counts[-1] < MOST:
        counts.append(2 * counts[-1])
        paths.append(np.asarray(run(counts[-1])))
        errors = _errors(counts, paths, stepper.order)
        good = np.append(errors <= tolerance, True)
        first = len(good) - int(np.argmin(good[::-1])) if not good.all() else 0
        if len(errors) - first >= 2 and counts[-1] >= ENOUGH:
            break
    else:
        raise ValueError(
            f"suggest_step_size: {MOST} steps do not bring the error of q within tolerance={tolerance:g} over "
            f"{duration:g} s."
        )
    dt = duration / counts[first]
    if first and np.isfinite(errors[first - 1]):  # up to twice as long: on a line in the logarithms
        dt *= 2 ** (np.log(tolerance / errors[first]) / np.log(errors[first - 1] / errors[first]))
    return float(dt), counts[-1]


def _errors(counts, paths, order):
    """Of all runs but the finest, which has an error of its own, by Richardson's extrapolation."""
    finest = paths[-1]
    with np.errstate(over="ignore", invalid="ignore"):
        motion = _rms(finest - finest.mean(axis=0)) if np.isfinite(finest).all() else np.nan
        errors = []
        for n, path in zip(counts[:-1], paths[:-1], strict=True):
            hit = min(n, SAMPLES)
            every = SAMPLES // hit
            error = _rms(path[:hit] - finest[every - 1 :: every]) / motion
            errors.append(error / (1 - (n / counts[-1]) ** order))
    return np.nan_to_num(np.array(errors), nan=np.inf)


def _rms(x):
    return np.sqrt(np.mean(x**2))


@jax.jit
def _samples(system, stepper, q0, v0, params, z0, t0, duration, num_steps):
    """q at SAMPLES times, or, of fewer steps, after each; compiled once for all numbers of steps."""
    params, dt = thaw(params), duration / num_steps
    between = jnp.maximum(1, num_steps // SAMPLES)

    def step(i, carry):
        state, path = carry
        state, _ = stepper.step(system, state, params, dt)
        return state, path.at[i // between].set(ravel_pytree(state.q)[0])  # the last to write is the one on time

    q, _ = ravel_pytree(q0)
    state = begun("suggest_step_size", system, stepper, q0, v0, z0, params, dt, t0)
    return jax.lax.fori_loop(0, num_steps, step, (state, jnp.zeros((SAMPLES, q.size), q.dtype)))[1]
