"""The constrained scenes solved by no stepper of ours: in index-1 form, by SciPy.

[M -B^T; B 0] [w; L] = [Q; -gamma], where gamma is the second time derivative of Phi without B w. As an ODE that keeps
Phi = 0 to the accuracy of SciPy's integrator.
"""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from scipy.integrate import solve_ivp

from hhtjax.scenes import four_bars, pendulum, slider_crank, squeezer

SCENES = {
    "squeezer": squeezer.squeezer(),
    "pendulum": pendulum.cartesian(),
    "elastic pendulum": pendulum.elastic(1e4),
    "minimal pendulum": pendulum.minimal(),
    "free slider-crank": slider_crank.free(),
    "driven slider-crank": slider_crank.driven(),
    "one four-bar": four_bars.four_bars(loops=1),
    "four bars": four_bars.four_bars(),
    "five four-bars": four_bars.four_bars(loops=5),
}
UPRIGHT = 0.65  # s: the first singular position of the four bars comes after 0.71 s


def flat(scene):
    """M, Q and Phi as functions of vectors, M in full, and vectors q0 and v0."""
    system, _, q0, v0, _ = scene
    vector, unravel = ravel_pytree(q0)

    def mass(q, params):
        M = system.mass(unravel(q), params)
        return jnp.diag(M) if M.ndim == 1 else M

    def force(q, v, t, params):
        return ravel_pytree(system.force(unravel(q), unravel(v), t, params))[0]

    def constraint(q, t, params):
        return system.constraint(unravel(q), t, params) if system.constraint else jnp.zeros(0)

    return mass, force, constraint, vector, ravel_pytree(v0)[0]


def index_1(scene, params, q, v, t=0.0):
    """w and L."""
    mass, force, constraint, _, _ = flat(scene)

    def rate(q, t):
        return jax.jvp(partial(constraint, params=params), (q, t), (v, 1.0))[1]

    gamma = jax.jvp(rate, (q, t), (v, 1.0))[1]
    B = jax.jacfwd(constraint)(q, t, params)
    M, Q = mass(q, params), force(q, v, t, params)
    K = jnp.block([[M, -B.T], [B, jnp.zeros((gamma.size, gamma.size))]])
    wL = jnp.linalg.solve(K, jnp.concatenate([Q, -gamma]))
    return wL[: q.size], wL[q.size :]


@cache
def path(name, times):
    """q and v, (times, n)."""
    scene = SCENES[name]
    _, _, _, q0, v0 = flat(scene)

    @jax.jit
    def rate(t, y):
        q, v = jnp.split(y, 2)
        return jnp.concatenate([v, index_1(scene, scene.params, q, v, t)[0]])

    y0 = np.concatenate([q0, v0])
    run = solve_ivp(lambda t, y: np.asarray(rate(t, y)), (0, max(times)), y0, "DOP853", times, rtol=1e-11, atol=1e-12)
    q, v = np.split(run.y.T, 2, axis=1)
    return q, v


def times(name):
    return tuple(np.linspace(0, UPRIGHT if "four" in name else SCENES[name].duration, 25))
