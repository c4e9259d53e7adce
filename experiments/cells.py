"""Runs of one scene with many step sizes, compared with a reference: what the experiments on robustness share."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from scipy.integrate import solve_ivp

import hhtjax

SAMPLES = 64  # times at which q is compared; the coarsest runs hit a part of them
ACCURATE = 0.05  # error of q below which a run is accurate
FARTHEST = 10.0  # distance from q0, in that of the reference, beyond which it is unbounded


class Reference(NamedTuple):
    """q: at the sample times, (SAMPLES, n); motion: its RMS about its mean; reach: its largest distance from q0."""

    q: np.ndarray
    motion: float
    reach: float


def position(state):
    """What `march` records and tracks by default: q, a vector."""
    return ravel_pytree(state.q)[0]


def march(stepper, start, scene, num_steps, record=position, track=position):
    """`record(state)` at the sample times, the largest distance of `track(state)` from the start, Newton's failures.

    A loop with a traced num_steps, not `hhtjax.simulate`, so that all step sizes share one compilation.
    """
    dt = scene.duration / num_steps
    steps_between = jnp.maximum(1, num_steps // SAMPLES)

    def step(i, carry):
        state, path, farthest, failures = carry
        state, info = stepper.step(scene.system, state, scene.params, dt)
        # the last one to write is the one on time
        path = jax.tree.map(lambda x, new: x.at[i // steps_between].set(new), path, record(state))
        farthest = jnp.maximum(farthest, jnp.max(jnp.abs(track(state) - track(start))))
        return state, path, farthest, failures + (0 if info.converged is None else jnp.where(info.converged, 0, 1))

    path = jax.tree.map(lambda x: jnp.zeros((SAMPLES, *x.shape)), record(start))
    return jax.lax.fori_loop(0, num_steps, step, (start, path, 0.0, 0))[1:]


def solve_reference(case) -> Reference:
    """The motion by scipy with tight tolerances."""
    system, params, q0, v0, duration = case.scene
    n = q0.size

    rhs = hhtjax.interop.scipy_rhs(system, q0, v0, params)
    jacobian: dict[str, Any] = {"jac": rhs.jac} if case.solver == "Radau" else {}
    times = np.linspace(0, duration, SAMPLES + 1)
    run = solve_ivp(rhs.fun, (0, duration), rhs.y0, case.solver, times, rtol=1e-10, atol=1e-12, **jacobian)
    q = run.y[:n].T
    return Reference(q[1:], rms(q - q.mean(axis=0), (0, 1)), np.abs(q - q0).max())


def rms(x, axis):
    """Root mean square; inf where x is too large to be squared."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.sqrt(np.mean(x**2, axis=axis))


def relative_error(path, num_steps, reference):
    """RMS error of q at the sample times that the run hits, over the RMS of the motion."""
    hit = min(num_steps, SAMPLES)
    every = SAMPLES // hit
    return rms(path[..., :hit, :] - reference.q[every - 1 :: every], (-2, -1)) / reference.motion


def geometric_mean(x):
    """NaN for nothing."""
    return float(np.exp(np.mean(np.log(x)))) if len(x) else float("nan")
