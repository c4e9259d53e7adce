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


def run_constrained(stepper, system, params, q0, v0, dt, num_steps):
    """The same with constraints Phi(q) = 0 of index 3, whose multipliers L are unknowns of every step."""
    c, n = stepper.coefficients, q0.size
    f = 1 - c.alpha_f

    def Phi(q):
        return system.constraint(q, 0.0, params)

    def r(q, v, w, L):
        force = system.mass(q, params) @ w - system.force(q, v, 0.0, params) - jax.vjp(Phi, q)[1](L)[0]
        return jnp.concatenate([force, Phi(q)])

    def step(state, _):
        q, v, w, a, L = state
        q = q + dt * v + dt**2 * ((0.5 - c.beta) * a + c.beta * w)
        v = v + dt * ((1 - c.gamma) * a + c.gamma * w)
        K, C, M, B = (jax.jacfwd(r, i)(q, v, w, L) for i in range(4))
        A = jnp.concatenate([M + f * (c.gamma * dt * C + c.beta * dt**2 * K), B], axis=1)
        dw, dL = jnp.split(-jnp.linalg.solve(A, r(q, v, w, L)), [n])
        state = q + f * c.beta * dt**2 * dw, v + f * c.gamma * dt * dw, w + dw, w + f * dw, L + dL
        return state, state[0]

    B = jax.jacfwd(Phi)(q0)
    A = jnp.block([[system.mass(q0, params), -B.T], [B, jnp.zeros((len(B), len(B)))]])
    curvature = jax.jvp(lambda q: jax.jvp(Phi, (q,), (v0,))[1], (q0,), (v0,))[1]
    w, L = jnp.split(jnp.linalg.solve(A, jnp.concatenate([system.force(q0, v0, 0.0, params), -curvature])), [n])
    (q, *_), path = jax.lax.scan(step, (q0, v0, w, w, L), None, num_steps)
    return q, path
