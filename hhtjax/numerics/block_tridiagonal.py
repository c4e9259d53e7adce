"""Elimination on the blocks of a block tridiagonal matrix, with an effort in proportion to the number of blocks.

    A x = b,    L_i x_{i-1} + D_i x_i + U_i x_{i+1} = b_i

    S_i = D_i - L_i W_{i-1},   W_i = S_i^-1 U_i              once for a matrix
    y_i = S_i^-1 (b_i - L_i y_{i-1}),   x_i = y_i - W_i x_{i+1}

Pivots are chosen within a block, and blocks are taken in their order. This is sufficient for positive definite
matrices. It is also sufficient for saddle points in which each constraint row comes after all unknowns in it, because
each eliminated part of the matrix then belongs to a smaller mechanism. Loops over the blocks can be part of a kernel.
"""

from __future__ import annotations

from functools import reduce
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax

from hhtjax.description import Array
from hhtjax.numerics.dense_lu import gauss_jordan


class BlockFactors(NamedTuple):
    """Of a matrix: L, S^-1 and W, (N, b, b) each."""

    lower: Array
    inverse: Array
    ahead: Array


def factorize_blocks(lower: Array, middle: Array, upper: Array) -> BlockFactors:
    """Of the matrix of these blocks (N, b, b); the first of `lower` and the last of `upper` meet zeros."""
    b = middle.shape[-1]

    def eliminate(before: Array, blocks: tuple):
        L, D, U = blocks
        S = invert_block(D - L @ before)
        W = S @ U
        return W, (S, W)

    none = jnp.zeros((b, b), middle.dtype)
    _, (inverse, ahead) = lax.scan(eliminate, none, (lower, middle, upper))
    return BlockFactors(lower, inverse, ahead)


def solve_blocks(factors: BlockFactors, b: Array, trans: int = 0) -> Array:
    """x with A x = b, or A^T x = b: (N, b)."""
    L, S, W = factors
    zero = jnp.zeros_like(b[0])

    def forward(y: Array, block: tuple):
        L, S, b = block
        y = S @ (b - L @ y)
        return y, y

    def backward(x: Array, block: tuple):
        W, y = block
        x = y - W @ x
        return x, x

    def forward_transposed(carry: Array, block: tuple):
        W, b = block
        z = b - carry
        return z @ W, z

    def backward_transposed(carry: Array, block: tuple):
        L, S, z = block
        x = (z - carry) @ S
        return x @ L, x

    if trans:
        _, z = lax.scan(forward_transposed, zero, (W, b))
        return lax.scan(backward_transposed, zero, (L, S, z), reverse=True)[1]
    _, y = lax.scan(forward, zero, (L, S, b))
    return lax.scan(backward, zero, (W, y), reverse=True)[1]


def invert_block(A: Array) -> Array:
    """A^-1, with pivots."""
    return _by_cofactors(A) if len(A) == 3 else gauss_jordan(A, jnp.eye(len(A), dtype=A.dtype))


def _by_cofactors(A: Array) -> Array:
    """The same of three unknowns, without a loop: a planar beam has one for each node. Rows are measured by their
    largest entries."""
    row = [1 / reduce(jnp.maximum, [jnp.abs(A[i, j]) for j in range(3)]) for i in range(3)]
    a = [[A[i, j] * row[i] for j in range(3)] for i in range(3)]

    def cofactor(i: int, j: int) -> Array:
        (p, q), (r, s) = ((k - 2, k - 1) for k in (i, j))  # the others, in a turn that has the sign in it
        return a[p][r] * a[q][s] - a[p][s] * a[q][r]

    adjugate = [[cofactor(j, i) for j in range(3)] for i in range(3)]
    unit = 1 / (a[0][0] * adjugate[0][0] + a[0][1] * adjugate[1][0] + a[0][2] * adjugate[2][0])
    return jnp.stack([jnp.stack([adjugate[i][j] * (unit * row[j]) for j in range(3)]) for i in range(3)])


def block_pivots(lower: Array, middle: Array, upper: Array, limit: float) -> Array:
    """(N, b): the pivots of an elimination without exchanges; what is divided by is not less than `limit`."""
    b = middle.shape[-1]
    i = jnp.arange(b)

    def eliminate(before: Array, blocks: tuple):
        L, D, U = blocks
        S = D - L @ before

        def column(k, carry: tuple):
            both, found = carry
            pivot = both[k, k]
            row = both[k] / jnp.maximum(pivot, limit)
            both = jnp.where((i == k)[:, None], row[None, :], both - both[:, k][:, None] * row[None, :])
            return both, jnp.where(i == k, pivot, found)

        both, found = lax.fori_loop(0, b, column, (jnp.concatenate([S, U], axis=1), jnp.zeros(b, S.dtype)))
        return both[:, b:], found

    none = jnp.zeros((b, b), middle.dtype)
    return lax.scan(eliminate, none, (lower, middle, upper))[1]
