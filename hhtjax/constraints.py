"""Constraints Phi(q, t) = 0: their rates and reactions, and initial values that satisfy them.

    M(q) w = Q(q, v, t) + B^T L,    B = dPhi/dq

A multiplier L_i is the reaction that constraint i exerts along its own gradient: of the unit of force for a Phi in
units of length. (The IVP test set writes -B^T lambda: its multipliers are the negatives of these.)
"""

import jax
import jax.numpy as jnp

from hhtjax.linear_solve import factorize, solve_map


def violation(system, q, v, t, params):
    """Phi, and dPhi/dt = B v + Phi_t: (m,) each."""
    return jax.jvp(lambda q, t: system.constraint(q, t, params), (q, t), (v, jnp.ones_like(t)))


def curvature(system, q, v, t, params):
    """The part of the second time derivative of Phi that w does not enter: (m,)."""

    def rate(q, t):
        return violation(system, q, v, t, params)[1]

    return jax.jvp(rate, (q, t), (v, jnp.ones_like(t)))[1]


def reaction(system, q, t, params, L):
    """B^T L: (n,)."""
    return jax.vjp(lambda q: system.constraint(q, t, params), q)[1](L)[0]


def saddle_point(system, q, t, params, force, rows, factorize=factorize):
    """(x, L) with M x - B^T L = force and B x = rows: the index-1 system for accelerations, and all projections."""
    n = system.size
    _, B = jax.linearize(lambda q: system.constraint(q, t, params), q)

    def f(z):
        x, L = z[:n], z[n:]
        return jnp.concatenate([system.inertia(q, x, params) - reaction(system, q, t, params, L), B(x)])

    z = solve_map(f, jnp.concatenate([force, rows]), factorize)
    return z[:n], z[n:]


def acceleration_and_multipliers(system, q, v, t, params, factorize=factorize):
    """w and L at a state that satisfies Phi = 0 and dPhi/dt = 0."""
    Q = system.force(q, v, t, params)
    return saddle_point(system, q, t, params, Q, -curvature(system, q, v, t, params), factorize)
