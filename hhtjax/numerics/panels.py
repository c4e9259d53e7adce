"""Factorisations in panels so narrow that LAPACK's threads stay out.

OpenBLAS factorises what has 20000 elements and more by threads that wait for each other by spinning: where other
processes want the cores, too, a matrix of 200 unknowns takes a tenth of a second instead of a fifth of a millisecond.
Panels below that are factorised by LAPACK, and the rest is updated by products, for which XLA has threads of its own.
"""

import jax.numpy as jnp
from jax import lax

ELEMENTS = 16_000  # of a panel
BLOCK = 32  # rows of a symmetric matrix that LAPACK factorises without threads
FEW = 16  # rows of a symmetric matrix for which LAPACK is not called
LARGEST = 512  # unknowns; beyond, a program of many sizes would take long to compile, and threads are worth waiting for


def lu(A):
    """L below the diagonal and U on and above it, and the order of the rows: A[order] = L U, by partial pivoting."""
    n = len(A)
    if n * n <= ELEMENTS or n > LARGEST:
        LU, _, order = lax.linalg.lu(A)
        return LU, order.astype(jnp.result_type(int))
    rest = max(int(ELEMENTS**0.5), n // 2)
    number = -(-(n - rest) // (ELEMENTS // n))
    width = -(-(n - rest) // number)
    done = number * width
    A, order = _first_columns(A, number, width)
    LU, again = lu(A[done:, done:])
    below = jnp.concatenate([A[done:, :done][again], LU], axis=1)
    return jnp.concatenate([A[:done], below]), jnp.concatenate([order[:done], order[done:][again]])


def _first_columns(A, number, width):
    """The same after so many panels of this width; the columns behind them updated."""
    n = len(A)
    row, column = jnp.arange(n)[:, None], jnp.arange(n)[None, :]

    def eliminate(i, carry):
        """Rows that are done wait below the others, which begin with that of the panel's diagonal."""
        A, order = carry
        done, behind = i * width, column >= (i + 1) * width
        known = lax.dynamic_slice_in_dim(A, done, width, axis=1)
        LU, _, exchanged = lax.linalg.lu(jnp.where(row < n - done, known, 0))
        A, order = A[exchanged], order[exchanged]  # no row that is done: theirs are zeros
        U = _substitute(LU[:width], jnp.where(behind, A[:width], 0))
        A = A - jnp.where(row < width, 0, LU) @ U
        A = A.at[:width].set(jnp.where(behind, U, A[:width]))
        A = lax.dynamic_update_slice_in_dim(A, jnp.where(row < n - done, LU, known), done, axis=1)
        return jnp.roll(A, -width, axis=0), jnp.roll(order, -width)

    A, order = lax.fori_loop(0, number, eliminate, (A, jnp.arange(n)))
    return jnp.roll(A, number * width, axis=0), jnp.roll(order, number * width)


def pivots(A):
    """Of the factorisation L D L^T of a symmetric A: the diagonal of D, NaN where one before is not positive."""
    n = len(A)
    if n <= FEW:
        return _pivots_of_few(A)
    if n * n <= ELEMENTS:
        return jnp.diagonal(lax.linalg.cholesky(A)) ** 2
    number = -(-n // BLOCK)
    size = number * BLOCK
    column = jnp.arange(size)

    def eliminate(i, carry):
        A, found = carry
        start = i * BLOCK
        rows = lax.dynamic_slice_in_dim(A, start, BLOCK)
        L = lax.linalg.cholesky(lax.dynamic_slice_in_dim(rows, start, BLOCK, axis=1))
        d = jnp.diagonal(L)
        rows = _substitute(L / d[None, :], jnp.where(column[None, :] >= start + BLOCK, rows, 0)) / d[:, None]
        return A - rows.T @ rows, lax.dynamic_update_slice_in_dim(found, d**2, start, axis=0)

    A = jnp.eye(size, dtype=A.dtype).at[:n, :n].set(A)
    return lax.fori_loop(0, number, eliminate, (A, jnp.zeros_like(A[0])))[1][:n]


def _pivots_of_few(A):
    """The same by elimination: the first call of LAPACK has JAX import SciPy, a tenth of a second."""
    i = jnp.arange(len(A))

    def eliminate(k, carry):
        A, found = carry
        d = A[k, k]
        return A - jnp.outer(A[:, k], A[k] / jnp.where(d > 0, d, jnp.nan)), jnp.where(i == k, d, found)

    carry = A, jnp.zeros_like(A[0])
    if len(A) > 2:  # else the only loop over small arrays in a run that is scalars
        return lax.fori_loop(0, len(A), eliminate, carry)[1]
    for k in range(len(A)):
        carry = eliminate(k, carry)
    return carry[1]


def _substitute(L, B):
    """X with L X = B, L with a unit diagonal, row by row: LAPACK would take threads for this, too."""
    L = jnp.tril(L, -1)
    return lax.fori_loop(1, len(L), lambda i, X: X.at[i].add(-(L[i] @ X)), B)
