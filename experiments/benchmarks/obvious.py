"""The method as one writes it down first, in plain JAX: jacfwd by q, v and w, jnp.linalg.solve, one scan."""

from typing import Any

import jax
import jax.numpy as jnp


def run(stepper, system, params, q0, v0, dt, num_steps):
    """q at the end, and after every step, by the non-iterative step linearised at the predictor."""
    c = stepper.coefficients
    f = 1 - c.alpha_f

    def mass(q):
        M: Any = system.mass(q, params) if callable(system.mass) else system.mass
        return jnp.diag(M) if M.ndim == 1 else M

    def r(q, v, w):
        return mass(q) @ w - system.force(q, v, 0.0, params)

    def step(state, _):
        q, v, w, a = state
        q = q + dt * v + dt**2 * ((0.5 - c.beta) * a + c.beta * w)
        v = v + dt * ((1 - c.gamma) * a + c.gamma * w)
        K, C, M = (jax.jacfwd(r, i)(q, v, w) for i in range(3))
        dw = -jnp.linalg.solve(M + f * (c.gamma * dt * C + c.beta * dt**2 * K), r(q, v, w))
        state = q + f * c.beta * dt**2 * dw, v + f * c.gamma * dt * dw, w + dw, w + f * dw
        return state, state[0]

    w = jnp.linalg.solve(mass(q0), system.force(q0, v0, 0.0, params))
    (q, *_), path = jax.lax.scan(step, (q0, v0, w, w), None, num_steps)
    return q, path
