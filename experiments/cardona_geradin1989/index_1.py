"""The rival: constrained motion as an ODE, with accelerations and multipliers from the index-1 system.

[ M  -B^T ] [ w ]   [   Q    ]
[ B    0  ] [ L ] = [ -gamma ],     gamma = (Phi_t + B v)_t, the second derivative of Phi without B w
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import hhtjax
from hhtjax.numerics.linear_solve import solve


def violation(system, q, v, t, params):
    """Phi and dPhi/dt = B v + Phi_t."""
    return jax.jvp(lambda q, t: system.constraint(q, t, params), (q, t), (v, jnp.ones_like(t)))


def accelerations(system, q, v, t, params):
    """(w, L), for vectors q and v."""
    M = system.mass(q, params)
    M = jnp.diag(M) if M.ndim == 1 else M

    gamma = jax.jvp(lambda q, t: violation(system, q, v, t, params)[1], (q, t), (v, jnp.ones_like(t)))[1]
    B = jax.jacfwd(lambda q: system.constraint(q, t, params))(q)
    K = jnp.block([[M, -B.T], [B, jnp.zeros((gamma.size, gamma.size), q.dtype)]])
    w, L = jnp.split(solve(K, jnp.concatenate([system.force(q, v, t, params), -gamma])), [q.size])
    return w, L


def unconstrained(system, n):
    """A `System` of n coordinates whose force is the acceleration: for steppers that know no constraints."""
    return hhtjax.System(jnp.ones(n), lambda q, v, t, params: accelerations(system, q, v, t, params)[0])


def compiled_rate(scene):
    """The ODE y' = f(t, y) of y = (q, v), and its Jacobian; compiled."""

    @jax.jit
    def rate(t, y):
        q, v = jnp.split(y, 2)
        return jnp.concatenate([v, accelerations(scene.system, q, v, t, scene.params)[0]])

    return rate, jax.jit(jax.jacfwd(rate, argnums=1))


def reference(scene, times):
    """q, v, w and L at the times, (times, n) and (times, m), by SciPy's DOP853 at a tolerance of 1e-12."""
    rate, _ = compiled_rate(scene)
    y0 = np.concatenate([scene.q0, scene.v0])
    span = 0.0, float(times[-1])
    run = solve_ivp(lambda t, y: np.asarray(rate(t, y)), span, y0, "DOP853", times, rtol=1e-12, atol=1e-13)
    q, v = np.split(run.y.T, 2, axis=1)
    w, L = jax.jit(jax.vmap(partial(accelerations, scene.system), (0, 0, 0, None)))(q, v, times, scene.params)
    return q, v, np.asarray(w), np.asarray(L)
