"""Elimination for a dense matrix that XLA can fuse, and LAPACK for large matrices.

On the CPU a call to LAPACK costs a microsecond, several times a whole step of a small mechanism. So for up to `SCALAR`
unknowns the elimination is written out as scalar operations, for up to `UNROLLED` as array operations. For up to
`LOOPED` unknowns it is a loop inside a kernel, and LAPACK's elsewhere. Hundreds of unknowns are eliminated by LAPACK in
panels.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.description import Array, PyTree, Real
from hhtjax.numerics.sparse_matrix import Sparse
from hhtjax.numerics.superlu import factorize_sparse
from hhtjax.primitives import Bilinear, choose, structural

UNROLLED = 8
LOOPED = 16
SCALAR = 4  # beyond, scalar operations are so many that compiling them takes long


def matvec(A, x) -> Any:
    """A x for a full or `Sparse` A, or a diagonal one (n,); elementwise for n <= 8, so that XLA can fuse it."""
    if A.ndim == 1:
        return A * x
    if A.shape[-1] > UNROLLED or isinstance(A, Sparse):
        return A @ x
    return _by_columns(A, x)


_by_columns = Bilinear(
    lambda A, x: sum(A[..., j] * x[..., None, j] for j in range(1, A.shape[-1])) + A[..., 0] * x[..., None, 0],
    lambda b, x: b[..., :, None] * x[..., None, :],
    lambda A, b: _by_columns(jnp.matrix_transpose(A), b),
)


def product(A: Array, x: Array) -> Array:
    """A x of a small full A by a sum over each row: a third of the operations of `matvec`, where there are many."""
    return jnp.sum(A * x[None, :], axis=1)


def diagonal(A: Array) -> Array:
    """The diagonal of a full A (n, n), or of a diagonal one (n,). jnp.diagonal would ask for the platform."""
    if isinstance(A, Sparse):
        return A.diagonal()
    return A if A.ndim == 1 else A.ravel()[:: len(A) + 1]


def full_matrix(A: Array | Sparse) -> Array:
    """(n, n), of a diagonal (n,), a `Sparse` or a full one."""
    if isinstance(A, Sparse):
        p = A.pattern
        return jnp.zeros(A.shape, A.dtype).at[p.rows, p.columns].set(A.values[p.slots])
    return jnp.diag(A) if A.ndim == 1 else A


def factorize(A):
    """The function (b, trans=0) -> A^-1 b, or A^-T b for trans=1, with A factorised once and constant to autodiff.

    A: (n, n), or (n,) for a diagonal, or `Sparse`.
    """
    if isinstance(A, Sparse):
        return factorize_sparse(A)
    A = lax.stop_gradient(A)
    if A.ndim == 1:  # a diagonal
        return lambda b, trans=0: b / A
    if A.shape[-1] == 2:
        return partial(_cramer, A)
    if A.shape[-1] <= SCALAR:
        return partial(_substitute_scalars, *_lu_scalars(A))
    if A.shape[-1] <= UNROLLED:
        return partial(_substitute, _lu(A))
    return by_factors(choose(_lu, lu, A) if A.shape[-1] <= LOOPED else lu(A))


def by_factors(factors: tuple):
    """The function of `factorize` for a full matrix of more than UNROLLED unknowns, from its factors."""
    if len(factors[0]) > LOOPED:
        return partial(_by_lapack, factors)
    ways = _substitute, _by_lapack
    return lambda b, trans=0: choose(*(partial(way, trans=trans) for way in ways), factors, b)


def inverse(A: Array) -> Array:
    """A^-1 (n, n), constant to autodiff, by Gauss and Jordan in a loop: little to compile, for what is done once.

    Rows are scaled by the square roots of the diagonal, and those without a diagonal by what is left of them, so that
    the choice of pivots does not depend on units.
    """
    A, n = lax.stop_gradient(A), len(A)
    if n == 2:
        return jnp.stack([_cramer(A, e) for e in jnp.eye(2, dtype=A.dtype)], axis=1)
    d = jnp.abs(diagonal(A))
    size = jnp.sqrt(jnp.where(d == 0, 1, d))
    rest = matvec(jnp.abs(A), 1 / size)
    rows = 1 / jnp.where(d == 0, jnp.where(rest == 0, 1, rest), size)
    return gauss_jordan(rows[:, None] * A, jnp.diag(rows))


def gauss_jordan(A: Array, B: Array) -> Array:
    """A^-1 B, both (n, n), rows exchanged for the largest pivot."""
    n = len(A)
    i = jnp.arange(n)

    def eliminate(k: Array, both: Array) -> Array:
        pivot = _pivot(both, k)
        both = both[jnp.where(i == k, pivot, jnp.where(i == pivot, k, i))]
        row = both[k] / both[k, k]
        return jnp.where((i == k)[:, None], row[None, :], both - both[:, k][:, None] * row[None, :])

    return lax.fori_loop(0, n, eliminate, jnp.concatenate([A, B], axis=1))[:, n:]


def differentiable_inverse(A: Array) -> Array:
    """A^-1 with derivatives."""
    return with_slope(inverse, A)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def with_slope(inverse: Callable, A: Array) -> Array:
    """inverse(A), the derivative of A^-1 being -A^-1 dA A^-1."""
    return inverse(A)


@with_slope.defjvp
def _(inverse: Callable, A: tuple, dA: tuple):
    S = with_slope(inverse, *A)
    return S, -S @ dA[0] @ S


def _lu(A: Array):
    """L below the diagonal and U on and above it, and the order of the rows: A[order] = L U."""
    n = A.shape[0]
    i = jnp.arange(n)
    row, column = i[:, None], i[None, :]
    nothing = structural(np.zeros((), A.dtype))
    loop, find_pivot = (lax.fori_loop, _pivot) if n > UNROLLED else (_written_out, _pivot_by_scalars)

    def eliminate(k: Real, carry: tuple):
        A, order = carry
        pivot = find_pivot(A, k)
        exchange = jnp.where(i == k, pivot, jnp.where(i == pivot, k, i))
        A, order = A[exchange], order[exchange]
        factor = jnp.where(row > k, A[:, k][:, None] / A[k, k], nothing)
        changed = A - factor * A[k][None, :]
        return jnp.where(column > k, changed, jnp.where((column == k) & (row > k), factor, A)), order

    return loop(0, n - 1, eliminate, (A, i))


def _pivot(A: Array, k: Array) -> Array:
    """Row of the largest element of column k on or below the diagonal."""
    return jnp.argmax(jnp.where(jnp.arange(len(A)) >= k, jnp.abs(A[:, k]), -1))


def _pivot_by_scalars(A: Array, k: int) -> Array:
    """The same without argmax: a reduction would end the fusion."""
    largest, pivot = jnp.abs(A[k, k]), jnp.asarray(k, jnp.result_type(int))
    for i in range(k + 1, len(A)):
        candidate = jnp.abs(A[i, k])
        larger = candidate > largest
        largest, pivot = jnp.where(larger, candidate, largest), jnp.where(larger, i, pivot)
    return pivot


def _substitute(factors: tuple, b: Array, trans: int = 0) -> Array:
    """x with L U x = b[order]; for trans=1, x with x[order] = z and (L U)^T z = b."""
    LU, order = factors
    n = LU.shape[0]
    i = jnp.arange(n)
    loop = lax.fori_loop if n > UNROLLED else _written_out

    def forward(k: Real, x: Array) -> Array:
        return x - jnp.where(i > k, LU[:, k] * x[k], 0)

    def backward(j: Real, x: Array) -> Array:
        k = n - 1 - j
        pivot = x[k] / LU[k, k]
        return jnp.where(i == k, pivot, x - jnp.where(i < k, LU[:, k] * pivot, 0))

    def forward_transposed(k: Real, x: Array) -> Array:
        pivot = x[k] / LU[k, k]
        return jnp.where(i == k, pivot, x - jnp.where(i > k, LU[k] * pivot, 0))

    def backward_transposed(j: Real, x: Array) -> Array:
        k = n - 1 - j
        return x - jnp.where(i < k, LU[k] * x[k], 0)

    if not trans:
        return loop(0, n, backward, loop(0, n - 1, forward, b[order]))
    x = loop(0, n - 1, backward_transposed, loop(0, n, forward_transposed, b))
    return jnp.sum(jnp.where(order[:, None] == i[None, :], x[:, None], 0), axis=0)


def _written_out(start: int, stop: int, body: Callable, x: PyTree) -> PyTree:
    for k in range(start, stop):
        x = body(k, x)
    return x


def _by_lapack(factors: tuple, b: Array, trans: int = 0) -> Array:
    """The same as `_substitute`."""
    LU, order = factors
    substitute = partial(lax.linalg.triangular_solve, left_side=True, transpose_a=bool(trans))
    lower, upper = {"lower": True, "unit_diagonal": True}, {"lower": False}
    x = (b if trans else b[order])[:, None]
    for triangle in (upper, lower) if trans else (lower, upper):
        x = substitute(LU, x, **triangle)
    return x[jnp.argsort(order), 0] if trans else x[:, 0]


def _cramer(A: Array, b: Array, trans: int = 0) -> Array:
    """Cramer's rule for two unknowns: forward stable (Higham 2002, Sec. 1.10.1), with one division.

    Products of two entries of small mechanisms, as inertias of 1e-20, are less than the least float32.
    """
    if A.dtype == jnp.float32:
        size = jnp.abs(A[0, 0]) + jnp.abs(A[0, 1]) + jnp.abs(A[1, 0]) + jnp.abs(A[1, 1])
        unit = 1 / size
        A, b = A * unit, b * unit
    (p, q), (r, s) = [[A[i, j] for j in range(2)] for i in range(2)]
    if trans:
        q, r = r, q
    inverse = 1 / (p * s - q * r)
    return jnp.stack([(s * b[0] - q * b[1]) * inverse, (p * b[1] - r * b[0]) * inverse])


def _lu_scalars(A: Array):
    """L and U in the place of A, the pivots as their reciprocals; the exchanges of rows before, [(k, i, whether)]."""
    n = A.shape[0]
    LU = [[A[i, j] for j in range(n)] for i in range(n)]
    exchanges = []
    for k in range(n):
        for i in range(k + 1, n):
            larger = jnp.abs(LU[i][k]) > jnp.abs(LU[k][k])
            exchanges.append((k, i, larger))
            for j in range(n):
                LU[k][j], LU[i][j] = _exchange(larger, LU[k][j], LU[i][j])
        LU[k][k] = 1 / LU[k][k]
        for i in range(k + 1, n):
            LU[i][k] = LU[i][k] * LU[k][k]
            for j in range(k + 1, n):
                LU[i][j] = LU[i][j] - LU[i][k] * LU[k][j]
    return LU, exchanges


def _substitute_scalars(LU: list, exchanges: list, b: Array, trans: int = 0) -> Array:
    """The same as `_substitute`."""
    n = len(LU)
    x = [b[i] for i in range(n)]
    if not trans:
        for k, i, whether in exchanges:
            x[k], x[i] = _exchange(whether, x[k], x[i])
        for k in range(n):
            for i in range(k + 1, n):
                x[i] = x[i] - LU[i][k] * x[k]
        for k in reversed(range(n)):
            x[k] = x[k] * LU[k][k]
            for i in range(k):
                x[i] = x[i] - LU[i][k] * x[k]
        return jnp.stack(x)
    for k in range(n):
        x[k] = x[k] * LU[k][k]
        for i in range(k + 1, n):
            x[i] = x[i] - LU[k][i] * x[k]
    for k in reversed(range(n)):
        for i in range(k):
            x[i] = x[i] - LU[k][i] * x[k]
    for k, i, whether in reversed(exchanges):
        x[k], x[i] = _exchange(whether, x[k], x[i])
    return jnp.stack(x)


def _exchange(whether: Array, a: Array, b: Array):
    return jnp.where(whether, b, a), jnp.where(whether, a, b)


# ----------------------------------------------------------------------------
# Factorisations in panels so narrow that LAPACK's threads stay out.
#
# OpenBLAS factorises what has 20000 elements and more by threads that wait for each other by spinning: where other
# processes want the cores, too, a matrix of 200 unknowns takes a tenth of a second instead of a fifth of a millisecond.
# Panels below that are factorised by LAPACK, and the rest is updated by products, for which XLA has threads of its own.


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


def _first_columns(A: Array, number: int, width: int):
    """The same after so many panels of this width; the columns behind them updated."""
    n = len(A)
    row, column = jnp.arange(n)[:, None], jnp.arange(n)[None, :]

    def eliminate(i: Array, carry: tuple):
        """Rows that are done wait below the others, which begin with that of the panel's diagonal."""
        A, order = carry
        done, behind = i * width, column >= (i + 1) * width
        known = lax.dynamic_slice_in_dim(A, done, width, axis=1)
        LU, _, exchanged = lax.linalg.lu(jnp.where(row < n - done, known, 0))
        A, order = A[exchanged], order[exchanged]  # no row that is done: theirs are zeros
        U = _substitute_panels(LU[:width], jnp.where(behind, A[:width], 0))
        A = A - jnp.where(row < width, 0, LU) @ U
        A = A.at[:width].set(jnp.where(behind, U, A[:width]))
        A = lax.dynamic_update_slice_in_dim(A, jnp.where(row < n - done, LU, known), done, axis=1)
        return jnp.roll(A, -width, axis=0), jnp.roll(order, -width)

    A, order = lax.fori_loop(0, number, eliminate, (A, jnp.arange(n)))
    return jnp.roll(A, number * width, axis=0), jnp.roll(order, number * width)


def pivots(A: Array) -> Array:
    """Of the factorisation L D L^T of a symmetric A: the diagonal of D, NaN where one before is not positive."""
    n = len(A)
    if n <= FEW:
        return _pivots_of_few(A)
    if n * n <= ELEMENTS:
        return jnp.diagonal(lax.linalg.cholesky(A)) ** 2
    number = -(-n // BLOCK)
    size = number * BLOCK
    column = jnp.arange(size)

    def eliminate(i: Array, carry: tuple):
        A, found = carry
        start = i * BLOCK
        rows = lax.dynamic_slice_in_dim(A, start, BLOCK)
        L = lax.linalg.cholesky(lax.dynamic_slice_in_dim(rows, start, BLOCK, axis=1))
        d = jnp.diagonal(L)
        rows = _substitute_panels(L / d[None, :], jnp.where(column[None, :] >= start + BLOCK, rows, 0)) / d[:, None]
        return A - rows.T @ rows, lax.dynamic_update_slice_in_dim(found, d**2, start, axis=0)

    A = jnp.eye(size, dtype=A.dtype).at[:n, :n].set(A)
    return lax.fori_loop(0, number, eliminate, (A, jnp.zeros_like(A[0])))[1][:n]


def _pivots_of_few(A: Array) -> Array:
    """The same by elimination: the first call of LAPACK has JAX import SciPy, a tenth of a second."""
    i = jnp.arange(len(A))

    def eliminate(k: Real, carry: tuple):
        A, found = carry
        d = A[k, k]
        return A - jnp.outer(A[:, k], A[k] / jnp.where(d > 0, d, jnp.nan)), jnp.where(i == k, d, found)

    carry = A, jnp.zeros_like(A[0])
    if len(A) > 2:  # else the only loop over small arrays in a run that is scalars
        return lax.fori_loop(0, len(A), eliminate, carry)[1]
    for k in range(len(A)):
        carry = eliminate(k, carry)
    return carry[1]


def _substitute_panels(L: Array, B: Array) -> Array:
    """X with L X = B, L with a unit diagonal, row by row: LAPACK would take threads for this, too."""
    L = jnp.tril(L, -1)
    return lax.fori_loop(1, len(L), lambda i, X: X.at[i].add(-(L[i] @ X)), B)
