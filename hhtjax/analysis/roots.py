"""Roots of nonlinear equations: the method of Levenberg and Marquardt, with derivatives by the implicit function."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax

from hhtjax.description import Array

MOST = 200  # iterations


def root(f: Callable, y: Array) -> Array:
    """A y (n,) with f(y) = 0, (n,), near the given one; where there is none, one with the least |f|.

    Derivatives, forward and reverse, are those of the implicit function, wherever df/dy is regular at the root.

    >>> import jax
    >>> float(jax.grad(lambda a: root(lambda y: y**2 - a, jnp.ones(1))[0])(4.0))                      # 1/(2 sqrt(a))
    0.25
    """
    return lax.custom_root(f, y, _nearest_root, _tangent)


def _nearest_root(f, y: Array) -> Array:
    """By steps of (J^T J + lam D^2) dy = -J^T f, D of the columns of J.

    f is written into the program once, with its derivative: it may be a whole run, which takes long to compile.
    """
    eps = float(jnp.finfo(y.dtype).eps)

    def of(y: Array):
        r = f(y)
        return r, r

    def unfinished(carry: tuple) -> Array:
        *_, moved, k = carry
        return moved & (k < MOST)

    def improve(carry: tuple):
        best, cost, r, J, dy, lam, _, k = carry
        new = best + dy
        J_new, r_new = jax.jacfwd(of, has_aux=True)(new)
        there = jnp.sum(r_new**2)
        better = there < cost  # NaN is not
        best, cost, r, J = (jnp.where(better, x, y) for x, y in ((new, best), (there, cost), (r_new, r), (J_new, J)))
        D = jnp.sqrt(jnp.sum(J**2, axis=0))
        D = jnp.where(D == 0, 1, D)
        little = jnp.max(jnp.abs(dy) * D) <= 4 * eps * jnp.max(jnp.abs(best) * D)
        lam = jnp.clip(jnp.where(better, lam / 10, lam * 10), 1e-16, 1e8)
        A = jnp.concatenate([J / D[None, :], jnp.sqrt(lam) * jnp.eye(y.size, dtype=y.dtype)])
        dy = jnp.linalg.lstsq(A, jnp.concatenate([-r, jnp.zeros_like(y)]))[0] / D
        moved = (cost > 0) & ((k == 0) | ~little) & (better | (lam < 1e8))
        return best, cost, r, J, dy, lam, moved, k + 1

    still = jnp.zeros_like(y)
    unknown = jnp.zeros((y.size, y.size), y.dtype)
    begin = (y, jnp.asarray(jnp.inf, y.dtype), still, unknown, still, jnp.asarray(1e-2, y.dtype))
    return lax.while_loop(unfinished, improve, (*begin, jnp.asarray(True), jnp.zeros((), jnp.int32)))[0]


def _tangent(g, b: Array) -> Array:
    """x with g(x) = b, g being linear."""
    return jnp.linalg.solve(jax.jacfwd(g)(jnp.zeros_like(b)), b)
