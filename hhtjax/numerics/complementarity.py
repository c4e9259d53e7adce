"""Linear complementarity: z >= 0 and y = M z + q >= 0, of each pair one is 0. For a few rows, as contacts have.

    z_0 d + M z + q = y,    z_0 from large to 0 by pivots, each of which keeps z, y >= 0

Lemke's method finds a solution, or that there is none, for all copositive-plus M (z^T M z >= 0 for z >= 0): those of
contacts with Coulomb friction among them. Rows of M may depend on each other. Ties are broken by the order of the
columns, so that no set of pivots comes twice.

References: C. Lemke, Bimatrix equilibrium points and mathematical programming, Manage. Sci. 11, 1965, 681-689;
R. Cottle, J.-S. Pang, R. Stone, The linear complementarity problem, 1992, Sec. 4.4 and 4.9.
"""

from __future__ import annotations

from typing import NamedTuple

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
    """The solution for M (n, n) and q (n,). Rows should be of the size of 1: what is small is taken for 0.

    Args:
        M, q: arrays of one dtype.

    Returns:
        A `Complement`.

    >>> M, q = jnp.array([[2.0, 1.0], [1.0, 2.0]]), jnp.array([-5.0, 6.0])
    >>> print(complement(M, q).z)                                                     # y = (0, 8.5)
    [2.5 0. ]
    """
    n = len(q)
    # columns: y, z, z_0, and the right side; a row for each basic variable
    tableau = jnp.concatenate([jnp.eye(n, dtype=q.dtype), -M, -jnp.ones((n, 1), q.dtype), q[:, None]], axis=1)
    basis = jnp.arange(n)
    first = _first_of(jnp.concatenate([q[:, None], tableau[:, :n]], axis=1), jnp.ones(n, bool))
    entered = *_pivot(tableau, basis, first, 2 * n), (basis[first] + n) % (2 * n)
    done = jnp.all(q >= 0)

    def unfinished(carry: tuple) -> Array:
        *_, ended, i = carry
        return ~ended & (i < MOST_PIVOTS * n)

    def exchange(carry: tuple):
        tableau, basis, column, _, i = carry
        rows = _allowed(tableau[:, column])
        ratios = jnp.concatenate([tableau[:, -1:], tableau[:, :n]], axis=1)
        ratios = ratios / jnp.where(rows, tableau[:, column], 1)[:, None]
        row = _first_of(ratios, rows)
        last = rows & (basis == 2 * n) & (ratios[:, 0] <= ratios[row, 0] + _rounding(ratios[row, 0]))
        row = jnp.where(jnp.any(last), jnp.argmax(last), row)
        leaves, ray = basis[row], ~jnp.any(rows)
        new, there = _pivot(tableau, basis, row, column)
        tableau, basis = jnp.where(ray, tableau, new), jnp.where(ray, basis, there)
        return tableau, basis, (leaves + n) % (2 * n), (leaves == 2 * n) | ray, i + 1

    tableau, basis, *_ = lax.while_loop(unfinished, exchange, (*entered, done, 0))
    left = jnp.sum(jnp.where(basis == 2 * n, tableau[:, -1], 0))  # z_0, which may stay at 0
    here = basis[None, :] == (n + jnp.arange(n))[:, None]
    basic = jnp.any(here, axis=1) & ~done
    z = jnp.where(basic, jnp.sum(jnp.where(here, tableau[:, -1], 0), axis=1), 0)
    return Complement(jnp.maximum(z, 0), basic, done | (left <= _small(q.dtype)))


def _pivot(tableau: Array, basis: Array, row: Array, column: Array | int):
    """The tableau and the basis with the variable of a column in that of a row."""
    here = jnp.arange(len(basis)) == row
    own = (tableau[row] / tableau[row, column])[None, :]
    tableau = jnp.where(here[:, None], own, tableau - tableau[:, column][:, None] * own)
    return tableau, jnp.where(here, column, basis)


def _allowed(column: Array) -> Array:
    """Rows whose basic variable falls as that of the column grows."""
    return column > _small(column.dtype) * jnp.max(jnp.abs(column))


def _small(dtype: np.dtype) -> float:
    return max(SMALL, 1e3 * float(jnp.finfo(dtype).eps))


def _first_of(ratios: Array, rows: Array) -> Array:
    """Of these rows that with the smallest ratios (n, k), in the order of a dictionary."""

    def narrowed(rows: Array, column: Array):
        x = jnp.where(rows, column, jnp.inf)
        least = jnp.min(x)
        return rows & (x <= least + _rounding(least)), None

    return jnp.argmax(lax.scan(narrowed, rows, ratios.T)[0])


def _rounding(x: Array) -> Array:
    return TIED * float(jnp.finfo(x.dtype).eps) * (1 + jnp.abs(x))
