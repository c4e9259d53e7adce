"""The method as one writes it down first, in plain JAX: jacfwd by q, v and w, jnp.linalg.solve, one scan."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from hhtjax import rotation


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


def turned(R, psi):
    """R exp(psi), of one rotation, or of several."""
    return R @ rotation.exp(psi) if psi.ndim == 1 else jax.vmap(turned)(R, psi)


def run_bodies(stepper, system, params, q0, v0, dt, num_steps):
    """The same with rotations, in their Lie form, and constraints Phi(q) = 0 of index 3, whose multipliers L are
    unknowns of every step; either may be missing. Of positions and velocities that are trees."""
    c = stepper.coefficients
    f = 1 - c.alpha_f
    v0, tree = ravel_pytree(v0)
    n = v0.size

    def move(q, x):
        return jax.tree.map(lambda q, x: q + x if q.ndim == x.ndim else turned(q, x), q, tree(x))

    def Phi(q, x):
        return jnp.zeros(0) if system.constraint is None else system.constraint(move(q, x), 0.0, params)

    def mass(q):
        M = system.mass(q, params)
        return jnp.diag(M) if M.ndim == 1 else M

    def force(q, v):
        return ravel_pytree(system.force(q, tree(v), 0.0, params))[0]

    def r(q, x, v, w, L):
        q = move(q, x)
        reaction = jax.vjp(partial(Phi, q), jnp.zeros(n))[1](L)[0]
        return jnp.concatenate([mass(q) @ w - force(q, v) - reaction, Phi(q, jnp.zeros(n))])

    def step(state, _):
        q, v, w, a, L = state
        x = dt * v + dt**2 * ((0.5 - c.beta) * a + c.beta * w)
        v = v + dt * ((1 - c.gamma) * a + c.gamma * w)
        K, C, M, B = (jax.jacfwd(partial(r, q), i)(x, v, w, L) for i in range(4))
        A = jnp.concatenate([M + f * (c.gamma * dt * C + c.beta * dt**2 * K), B], axis=1)
        dw, dL = jnp.split(-jnp.linalg.solve(A, r(q, x, v, w, L)), [n])
        q = move(q, x + f * c.beta * dt**2 * dw)
        return (q, v + f * c.gamma * dt * dw, w + dw, w + f * dw, L + dL), q

    B = jax.jacfwd(partial(Phi, q0))(jnp.zeros(n))
    A = jnp.block([[mass(q0), -B.T], [B, jnp.zeros((len(B), len(B)))]])
    curvature = jax.jvp(lambda x: jax.jvp(partial(Phi, q0), (x,), (v0,))[1], (jnp.zeros(n),), (v0,))[1]
    w, L = jnp.split(jnp.linalg.solve(A, jnp.concatenate([force(q0, v0), -curvature])), [n])
    (q, *_), path = jax.lax.scan(step, (q0, v0, w, w, L), None, num_steps)
    return q, path
