"""Constraints Phi(q, t) = 0: their rates, their reactions, and whether they depend on each other.

    M(q) w = Q(q, v, t) + B^T L,    B = dPhi/dq

A multiplier L_i is the reaction that constraint i exerts along its own gradient; if Phi has the unit of length, L_i has
the unit of force. (The IVP test set writes -B^T lambda: its multipliers have the opposite sign.)
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.description import Array, PyTree, Real
from hhtjax.jaxpr import linear_map
from hhtjax.numerics.dense_lu import UNROLLED, diagonal, matvec
from hhtjax.numerics.linear_solve import (
    RANK_TOLERANCE,
    factorize_least_squares,
    factorize_map,
    factorize_saddle_point,
    solver,
)
from hhtjax.primitives import staged
from hhtjax.systems import kinematics

if TYPE_CHECKING:
    from hhtjax.systems.flat_system import FlatSystem

GRADIENT = 64  # times what roundings of q change a constraint and its gradient, below which it has none
SWITCHED_OFF = (
    "A row that params switch off, on * Phi, leaves its multiplier without an equation. Let the row hold a coordinate "
    "s of "
    'its own instead, on * Phi + (1 - on) * s, as in hhtjax.scenes.shaken_table, or take redundant="least_squares"'
)
SHAKES = 3  # by a rounding


def violation(system: FlatSystem, q: Array, v: Array, t: Array, params: PyTree):
    """Phi, and dPhi/dt = B v + Phi_t: (m,) each."""
    return jax.jvp(lambda q, t: system.constraint(q, t, params), (q, t), (system.rate(q, v), jnp.ones_like(t)))


def curvature(system: FlatSystem, q: Array, v: Array, t: Array, params: PyTree) -> Array:
    """The part of the second time derivative of Phi that does not depend on w: (m,)."""

    def rate(q: Array, t: Array) -> Array:
        return violation(system, q, v, t, params)[1]

    return jax.jvp(rate, (q, t), (system.rate(q, v), jnp.ones_like(t)))[1]


def reaction(system: FlatSystem, q: Array, t: Array, params: PyTree, L: Array) -> Array:
    """B^T L: (n,)."""
    _, pull = jax.vjp(lambda q: system.constraint(q, t, params), q)
    return pull_back(system, q, pull(L)[0])


def violation_and_reaction(system: FlatSystem, q: Array, v: Array, t: Array, params: PyTree, L: Array):
    """Phi, dPhi/dt and B^T L, from one linearisation of the constraints."""
    Phi, tangent = jax.linearize(lambda q, t: system.constraint(q, t, params), q, t)
    gradient, _ = jax.linear_transpose(tangent, q, t)(L)
    return Phi, tangent(system.rate(q, v), jnp.ones_like(t)), pull_back(system, q, gradient)


def pull_back(system: FlatSystem, q: Array, gradient: Array) -> Array:
    """The force (n,) for a gradient with respect to q: equal to it for positions; the material moment for rotations."""
    zero = jnp.zeros(system.size, q.dtype)
    return jax.linear_transpose(lambda v: system.rate(q, v), zero)(gradient)[0]


def saddle_point(system: FlatSystem, q: Array, t: Array, params: PyTree, factorize: Callable | None = None):
    """The function (force, rows) -> (x, L) with M x - B^T L = force and B x = rows, factorised once: the index-1 system
    for accelerations, and all projections."""
    if system.sparse is not None and (factorize is None or factorize is system.sparse):
        return _sparse_saddle_point(system, q, t, params)
    M, B = system.full_mass(q, t, params), jacobian(system, q, t, params)
    A = jnp.block([[M, -B.T], [B, jnp.zeros((len(B), len(B)), B.dtype)]])
    inverse = solver(A, factorize or factorize_constrained(system.size, None))

    def x_and_multipliers(force: Real, rows: Array):
        z = inverse(jnp.concatenate([force, rows]))
        return z[: system.size], z[system.size :]

    return x_and_multipliers


def _sparse_saddle_point(system: FlatSystem, q: Array, t: Array, params: PyTree):
    """As above, without matrices."""
    n, (push, pull) = system.size, gradient_maps(system, q, t, params)

    def f(z: Array) -> Array:
        return jnp.concatenate([system.inertia(q, z[:n], t, params) - pull(z[n:]), push(z[:n])])

    assert system.sparse is not None
    inverse = factorize_map(f, jnp.zeros(n + system.num_constraints, q.dtype), system.sparse)

    def x_and_multipliers(force: Real, rows: Array):
        z = inverse(jnp.concatenate([force, rows]))
        return z[:n], z[n:]

    return x_and_multipliers


def gradient_maps(system: FlatSystem, q: Array, t: Array, params: PyTree):
    """The linear maps v -> B v and L -> B^T L."""
    _, tangent = jax.linearize(lambda q: system.constraint(q, t, params), q)

    def push(v: Array) -> Array:
        return tangent(system.rate(q, v))

    pull = jax.linear_transpose(push, jnp.zeros(system.size, q.dtype))
    return push, lambda L: pull(L)[0]


def answers(
    system: FlatSystem, q: Array, t: Array, params: PyTree, redundant=None, factorize: Callable | None = None
) -> Any:
    """The function (force, rows=0) -> (dw, dL), factorised once: the change of accelerations and multipliers for an
    additional force. dL is None without constraints. rows: B dw. redundant, factorize: how it is solved."""
    if not system.num_constraints:
        inverse = system.mass_solver(system.mass(q, t, params), *(() if factorize is None else (factorize,)))
        return lambda force, rows=None: (inverse(force), None)
    if factorize is None and (system.sparse is None or redundant is not None):
        factorize = factorize_constrained(system.size, redundant)
    x_and_multipliers, zero = saddle_point(system, q, t, params, factorize), jnp.zeros(system.num_constraints, q.dtype)
    return lambda force, rows=zero: x_and_multipliers(force, rows)


def acceleration_and_multipliers(
    system: FlatSystem, q: Array, v: Array, t: Array, params: PyTree, factorize: Callable | None = None
):
    """w and L at a state that satisfies Phi = 0 and dPhi/dt = 0."""
    Q = system.force(q, v, t, params)
    return saddle_point(system, q, t, params, factorize)(Q, -curvature(system, q, v, t, params))


def jacobian(system: FlatSystem, q: Array, t: Array, params: PyTree) -> Array:
    """B: (m, n)."""
    Phi = partial(system.constraint, t=t, params=params)
    _, tangent = staged(partial(jax.linearize, Phi), system.size)(q)
    return linear_map(lambda x: tangent(system.rate(q, x)), jnp.zeros(system.size, q.dtype))


def check_redundant(caller: str, redundant):
    """Raises an error for an unknown value of `redundant`."""
    if redundant not in (None, "least_squares"):
        raise ValueError(f'{caller}: `redundant` must be None or "least_squares"; received {redundant!r}.')


def factorize_constrained(n: int, redundant):
    """The factorisation for n coordinates and their multipliers."""
    return factorize_saddle_point(n) if redundant is None else factorize_least_squares(n)


def gradient(system: FlatSystem, q: Array, t: Array, params: PyTree):
    """B, and which of its rows, (m,), are more than rounding in any units. A row is rounding if a rounding of q changes
    it completely, or changes the constraint by as much as a change of q by its own size would."""
    k, sizes = np.arange(system.positions), kinematics.sizes(system.blocks, q)
    uneven = [np.where(k // 2**i % 2, -1, 1) * (0.75 + 0.618034 * (i + 1) * k % 0.5) for i in range(SHAKES)]
    shakes = float(jnp.finfo(q.dtype).eps) * jnp.asarray(np.stack([0 * k, *uneven]), q.dtype) * sizes[None, :]

    def at(x: Array):
        moved = system.move(q, x)
        return system.constraint(moved, t, params), jacobian(system, moved, t, params)

    Phi, B = jax.vmap(at)(shakes)
    size, turned = (jnp.sqrt(jnp.sum(x**2, axis=-1)) for x in (B[0], B[1:] - B[:1]))
    reach, changed = jnp.max(sizes) * size, jnp.max(jnp.abs(Phi[1:] - Phi[:1]), axis=0)
    clear = (size > GRADIENT * jnp.max(turned, axis=0)) & (reach >= GRADIENT * changed)
    return B[0], jnp.isfinite(size) & (size > 0) & clear


def require_independent(caller: str, B: np.ndarray, clear: np.ndarray):
    """Raises an error that names the rows of B that depend on each other, or are rounding (`gradient`)."""
    size = np.linalg.norm(B, axis=1)
    empty = np.flatnonzero(~np.asarray(clear)).tolist()
    if empty:
        raise ValueError(
            f"{caller}: `constraint` rows {empty} have no gradient in q at the start (only rounding), or one that is "
            f"not finite. {SWITCHED_OFF}."
        )
    left, values, _ = np.linalg.svd(B / size[:, None])
    values = np.pad(values, (0, len(B) - len(values)))  # of more rows than coordinates
    dependent = left[:, values < RANK_TOLERANCE]
    if dependent.size:
        rows = np.flatnonzero(np.abs(dependent).max(axis=1) > 1e-6).tolist()
        rank = len(values) - dependent.shape[1]
        raise ValueError(
            f"{caller}: `constraint` rows {rows} depend on each other at the start (rank {rank} of {len(values)}): "
            'drop the redundant ones, or keep them with redundant="least_squares".'
        )


def dependent_row(B: Array) -> Array:
    """Index of the first row of B (m, n) that depends on the rows above it, to a part in 1e6; -1 if none does.

    These are the pivots of an elimination on the cosines between the rows: sin^2 of the angle to the span of the rows
    above.
    """
    m, limit = B.shape[0], 1e4 * float(jnp.finfo(B.dtype).eps)
    size = jnp.sqrt(jnp.sum(B**2, axis=1, keepdims=True))
    B = B / jnp.where(size == 0, 1, size)
    G = jax.vmap(partial(matvec, B))(B)

    def eliminate(k: int, G: Array) -> Array:
        return G - jnp.where(jnp.arange(m) > k, G[:, k] / jnp.maximum(G[k, k], limit), 0)[:, None] * G[k][None, :]

    if m <= UNROLLED:
        for k in range(m - 1):
            G = eliminate(k, G)
    else:
        G = lax.fori_loop(0, m - 1, eliminate, G)
    dependent = diagonal(G) < limit
    first = jnp.min(jnp.where(dependent, jnp.arange(m), m))
    return jnp.where(first < m, first, -1)


def sparse_dependent_row(system: FlatSystem, q: Array, t: Array, params: PyTree) -> Array:
    """As `dependent_row`, for a system with a sparse solve; rows are taken in the order of that solve."""
    assert system.sparse is not None
    push, pull = gradient_maps(system, q, t, params)
    limit = 1e4 * float(jnp.finfo(q.dtype).eps)
    pivots = system.sparse.cosine_pivots(lambda L: push(pull(L)), jnp.zeros(system.num_constraints, q.dtype), limit)
    return jnp.where(jnp.any(pivots < limit), jnp.argmax(pivots < limit), -1)
