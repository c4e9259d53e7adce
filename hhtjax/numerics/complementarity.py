"""Linear complementarity: z >= 0 and y = M z + q >= 0, with one number of each pair 0. For few rows, as of contacts.

    z_0 d + M z + q = y,    z_0 from large to 0 by pivots, each of which keeps z, y >= 0

For copositive-plus M (z^T M z >= 0 for z >= 0) Lemke's method finds a solution, or that there is none. The matrices of
contacts with Coulomb friction are among these. Rows of M may be dependent. Ties are broken by an arbitrarily small
perturbation of q, so that no set of pivots occurs twice.

References: C. Lemke, Bimatrix equilibrium points and mathematical programming, Manage. Sci. 11, 1965, 681-689;
R. Cottle, J.-S. Pang, R. Stone, The linear complementarity problem, 1992, Sec. 4.4 and 4.9.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.description import Array

MOST_PIVOTS = 8  # for each row; random contacts take 2 to 3
TIED = 1e3  # roundings within which two ratios are one
SMALL = 1e-10  # what is taken for 0 beside 1; 1000 roundings in float32


class Complement(NamedTuple):
    """A solution. z: (n,); basic: (n,), whether y_i = 0 by the choice of z_i; found: whether it is one."""

    z: Array
    basic: Array
    found: Array


def complement(M: Array, q: Array) -> Complement:
    """The solution for M (n, n) and q (n,). Scale the rows to a size of about 1, because small numbers are taken as 0.

    Args:
        M, q: arrays of one dtype.

    Returns:
        A `Complement`.

    >>> M, q = jnp.array([[2.0, 1.0], [1.0, 2.0]]), jnp.array([-5.0, 6.0])
    >>> print(complement(M, q).z)                                                     # y = (0, 8.5)
    [2.5 0. ]
    """
    n = len(q)
    i, two_n = jnp.arange(n), 2 * n
    # what is not basic, by columns: z, z_0; then the right side, and its perturbation. y_i is called i, and z_i n + i
    perturbed = jnp.asarray(1 + np.arange(n) * 0.618034 % 1, q.dtype)
    T = jnp.concatenate([-M, -jnp.ones((n, 1), q.dtype), q[:, None], perturbed[:, None]], axis=1)
    names = i, jnp.concatenate([i + n, jnp.full(1, two_n)])  # of the rows, which are basic, and of the columns
    done = jnp.all(q >= 0)

    def exchanged(T: Array, names: tuple, row: Array, column: Array):
        """The tableau with the variables of a row and a column exchanged, and the column that is to follow."""
        rows, columns = names
        leaves, enters = rows[row], columns[column]
        there = jnp.arange(T.shape[1]) == column
        pivot, across = T[row, column], T[:, column]
        own = jnp.where(there, 1, T[row]) / pivot
        T = jnp.where(
            (i == row)[:, None], own[None, :], jnp.where(there[None, :], 0, T) - across[:, None] * own[None, :]
        )
        rows, columns = jnp.where(i == row, enters, rows), jnp.where(there[: n + 1], leaves, columns)
        return T, (rows, columns), jnp.argmax(columns == (leaves + n) % two_n), leaves == two_n

    def unfinished(carry: tuple) -> Array:
        *_, ended, k = carry
        return ~ended & (k < MOST_PIVOTS * n)

    def exchange(carry: tuple):
        T, names, column, _, k = carry
        falls = T[:, column] > _small(q.dtype) * jnp.max(jnp.abs(T[:, column]))  # as that of the column grows
        ratios = T[:, n + 1 :] / jnp.where(falls, T[:, column], 1)[:, None]
        row = _first_of(ratios, falls)
        last = falls & (names[0] == two_n) & (ratios[:, 0] <= ratios[row, 0] + _rounding(ratios[row, 0]))
        row, ray = jnp.where(jnp.any(last), jnp.argmax(last), row), ~jnp.any(falls)
        new = exchanged(T, names, row, column)
        T, names, column, ended = jax.tree.map(partial(jnp.where, ray), (T, names, column, True), new)
        return T, names, column, ended, k + 1

    row = _first_of(T[:, n + 1 :], jnp.ones(n, bool))
    T, names, column, _ = exchanged(T, names, row, jnp.asarray(n))
    T, (rows, _), *_ = lax.while_loop(unfinished, exchange, (T, names, column, done, 0))
    left = jnp.sum(jnp.where(rows == two_n, T[:, n + 1], 0))  # z_0, which may stay at 0
    here = rows[None, :] == (n + i)[:, None]
    basic = jnp.any(here, axis=1) & ~done
    z = jnp.where(basic, jnp.sum(jnp.where(here, T[:, n + 1], 0), axis=1), 0)
    return Complement(jnp.maximum(z, 0), basic, done | (left <= _small(q.dtype)))


def _small(dtype: np.dtype) -> float:
    return max(SMALL, 1e3 * float(jnp.finfo(dtype).eps))


def _first_of(ratios: Array, rows: Array) -> Array:
    """Of these rows that with the smallest of ratios (n, 2), the second where the first are tied."""
    first = jnp.where(rows, ratios[:, 0], jnp.inf)
    least = jnp.min(first)
    tied = rows & (first <= least + _rounding(least))
    return jnp.argmin(jnp.where(tied, ratios[:, 1], jnp.inf))


def _rounding(x: Array) -> Array:
    return TIED * float(jnp.finfo(x.dtype).eps) * (1 + jnp.abs(x))
