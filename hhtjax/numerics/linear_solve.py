"""Small dense solves that XLA can fuse; LAPACK above a size.

A call to LAPACK costs a microsecond on the CPU, several times a whole step of a small mechanism, so
up to `UNROLLED` unknowns the elimination is written out as array operations, and up to `SCALAR` as scalar ones; up to
`LOOPED` it is a loop in a kernel, and LAPACK's elsewhere.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.linalg import lu_factor, lu_solve

from hhtjax.xla import choose, linear_map, staged, structural

UNROLLED = 8
LOOPED = 16
SCALAR = 4  # beyond, scalar operations are so many that compiling them takes long
RANK_TOLERANCE = (
    1e-9  # relative size of a singular value below which columns count as dependent; 100 roundings in float32
)


def solve_map(f, b, factorize):
    """x with f(x) = b, for a linear map f of (n,) to (n,); `factorize` as below.

    The matrix of f only serves to find x. Derivatives pass through f itself, f(dx) = db - df(x): one
    direction, where differentiating the matrix would take n.
    """
    return factorize_map(f, b, factorize)(b)


def factorize_map(f, like, factorize):
    """The function b -> x with f(x) = b, for vectors like `like`: `solve_map` for many b, factorised once."""
    inverse = invert(f, like, factorize)
    return lambda b: _solve(f, b, inverse)


def invert(f, like, factorize):
    """The function (b, trans=0) -> A^-1 b, or A^-T b, of the matrix A of f; it may be constant to autodiff."""
    if isinstance(factorize, Structured):
        return factorize.of_map(f, like)
    return factorize(staged(partial(linear_map, f), like.size)(like))


def invert_and_bound(f, like, factorize):
    """`invert`, and the function x -> |A| |x|, what the rows of A x are sums of; where no A is formed, |A x|."""
    if isinstance(factorize, Structured):
        return factorize.of_map(f, like), lambda x: jnp.abs(f(x))
    A = staged(partial(linear_map, f), like.size)(like)
    return factorize(A), lambda x: matvec(jnp.abs(A), jnp.abs(x))


def _solve(f, b, inverse):
    return lax.custom_linear_solve(
        f, b, solve=lambda _, y: inverse(y, trans=0), transpose_solve=lambda _, y: inverse(y, trans=1)
    )


def matvec(A, x):
    """A x for a full A (n, n), or a diagonal one (n,); elementwise for n <= 8, so that XLA can fuse it."""
    if A.ndim == 1:
        return A * x
    if A.shape[-1] > UNROLLED:
        return A @ x
    return sum(A[:, j] * x[j] for j in range(1, A.shape[-1])) + A[:, 0] * x[0]


def diagonal(A):
    """Of a full A (n, n), or of a diagonal one (n,), which is its own. jnp.diagonal would ask for the platform."""
    i = jnp.arange(len(A))
    return A if A.ndim == 1 else A[i, i]


def factorize(A):
    """The function (b, trans=0) -> A^-1 b, or A^-T b for trans=1, with A factorised once and constant to autodiff."""
    A = lax.stop_gradient(A)
    if A.shape[-1] == 2:
        return partial(_cramer, A)
    if A.shape[-1] <= SCALAR:
        return partial(_substitute_scalars, *_lu_scalars(A))
    if A.shape[-1] <= UNROLLED:
        return partial(_substitute, _lu(A))
    if A.shape[-1] <= LOOPED:
        factors = choose(_lu, _lu_of_lapack, A)
        ways = _substitute, _by_lapack
        return lambda b, trans=0: choose(*(partial(way, trans=trans) for way in ways), factors, b)
    return partial(lu_solve, lu_factor(A))


class Trusted:
    """A `factorize` whose results are taken on trust, and which therefore tells what it leaves unsolved.

    tolerance: of the residual relative to the right-hand side, in the 2-norm; None: 1e-6, in float32 1e-3.
    """

    tolerance: Any = None

    def leaves(self, f, b, x):
        """What x leaves of b = f(x), relative to b."""
        left, size = (jnp.sqrt(jnp.sum(y**2)) for y in (f(x) - b, b))
        return lax.stop_gradient(jnp.where(left == 0, 0, left / size))

    def accepts(self, left):
        """Whether so much may be left; what is not a number is for others to tell."""
        tolerance = self.tolerance
        return ~(left > (max(1e-6, 1e4 * float(jnp.finfo(left.dtype).eps)) if tolerance is None else tolerance))


@dataclass(frozen=True)
class Given(Trusted):
    """A `factorize` from a function that does its work."""

    function: Callable
    tolerance: Any = None

    def __call__(self, A):
        """(b, trans=0) -> A^-1 b, or A^-T b."""
        return self.function(A)


class Structured(Trusted):
    """A `factorize` that is given the linear map f itself: `of_map(f, like)` is what `invert` promises."""

    def of_map(self, f, like):
        """(b, trans=0) -> A^-1 b, or A^-T b."""
        raise NotImplementedError

    def __call__(self, A):
        """The same for a matrix."""
        return self.of_map(partial(matvec, A), A[0])


def factorize_with(solve):
    """The same from a function solve(A, b), which need not be differentiable."""
    if isinstance(solve, Structured):
        return solve

    def factorize(A):
        A = lax.stop_gradient(A)
        return lambda b, trans=0: solve(A.T if trans else A, b)

    return Given(factorize)


def reuse(factorize, inverse):
    """A `factorize` of the same kind for a matrix that has been factorised: `inverse` is what it gave."""

    def known(A):
        return inverse

    return Given(known, factorize.tolerance) if isinstance(factorize, Trusted) else known


def factorize_least_squares(n):
    """The same for A = [[M, -B^T], [B, 0]] whose B may have lost rank: the least-squares solution of least norm.

    The first n unknowns and equations are measured by the diagonal of A, all others alike.
    """

    def factorize(A):
        A = lax.stop_gradient(A)
        tolerance = max(RANK_TOLERANCE, 100 * float(jnp.finfo(A.dtype).eps))
        d = jnp.abs(jnp.diagonal(A)[:n])
        first = 1 / jnp.sqrt(jnp.where(d == 0, 1, d))
        rest = 1 / jnp.max(jnp.abs(first[:, None] * A[:n, n:]))
        scale = jnp.concatenate([first, jnp.full(A.shape[0] - n, rest)])
        U, s, Vt = jnp.linalg.svd(scale[:, None] * A * scale[None, :])
        inverse = jnp.where(s > tolerance * s[0], 1 / s, 0)

        def apply(b, trans=0):
            left, right = (Vt.T, U.T) if trans else (U, Vt)
            return scale * (right.T @ (inverse * (left.T @ (scale * b))))

        return apply

    return factorize


def solve(A, b, factorize=factorize):
    """x with A x = b, for A (n, n) and b (n,), differentiable in both.

    LU with partial pivoting: unrolled for n <= 8, a loop or LAPACK's above (module docstring); Cramer's rule for n = 2.
    A singular A gives inf or NaN.

    >>> import jax.numpy as jnp
    >>> [round(float(x), 6) for x in solve(jnp.array([[0.0, 2.0], [4.0, 0.0]]), jnp.array([2.0, 8.0]))]
    [2.0, 1.0]
    """
    return _solve(lambda x: matvec(A, x), b, factorize(A))


def _lu(A):
    """L below the diagonal and U on and above it, and the order of the rows: A[order] = L U."""
    n = A.shape[0]
    i = jnp.arange(n)
    row, column = i[:, None], i[None, :]
    nothing = structural(np.zeros((), A.dtype))
    loop, find_pivot = (lax.fori_loop, _pivot) if n > UNROLLED else (_written_out, _pivot_by_scalars)

    def eliminate(k, carry):
        A, order = carry
        pivot = find_pivot(A, k)
        exchange = jnp.where(i == k, pivot, jnp.where(i == pivot, k, i))
        A, order = A[exchange], order[exchange]
        factor = jnp.where(row > k, A[:, k][:, None] / A[k, k], nothing)
        changed = A - factor * A[k][None, :]
        return jnp.where(column > k, changed, jnp.where((column == k) & (row > k), factor, A)), order

    return loop(0, n - 1, eliminate, (A, i))


def _pivot(A, k):
    """Row of the largest element of column k on or below the diagonal."""
    return jnp.argmax(jnp.where(jnp.arange(len(A)) >= k, jnp.abs(A[:, k]), -1))


def _pivot_by_scalars(A, k):
    """The same without argmax: a reduction would end the fusion."""
    largest, pivot = jnp.abs(A[k, k]), jnp.asarray(k, jnp.result_type(int))
    for i in range(k + 1, len(A)):
        candidate = jnp.abs(A[i, k])
        larger = candidate > largest
        largest, pivot = jnp.where(larger, candidate, largest), jnp.where(larger, i, pivot)
    return pivot


def _substitute(factors, b, trans=0):
    """x with L U x = b[order]; for trans=1, x with x[order] = z and (L U)^T z = b."""
    LU, order = factors
    n = LU.shape[0]
    i = jnp.arange(n)
    loop = lax.fori_loop if n > UNROLLED else _written_out

    def forward(k, x):
        return x - jnp.where(i > k, LU[:, k] * x[k], 0)

    def backward(j, x):
        k = n - 1 - j
        pivot = x[k] / LU[k, k]
        return jnp.where(i == k, pivot, x - jnp.where(i < k, LU[:, k] * pivot, 0))

    def forward_transposed(k, x):
        pivot = x[k] / LU[k, k]
        return jnp.where(i == k, pivot, x - jnp.where(i > k, LU[k] * pivot, 0))

    def backward_transposed(j, x):
        k = n - 1 - j
        return x - jnp.where(i < k, LU[k] * x[k], 0)

    if not trans:
        return loop(0, n, backward, loop(0, n - 1, forward, b[order]))
    x = loop(0, n - 1, backward_transposed, loop(0, n, forward_transposed, b))
    return jnp.sum(jnp.where(order[:, None] == i[None, :], x[:, None], 0), axis=0)


def _written_out(start, stop, body, x):
    for k in range(start, stop):
        x = body(k, x)
    return x


def _lu_of_lapack(A):
    """The same as `_lu`."""
    LU, _, order = lax.linalg.lu(A)
    return LU, order.astype(jnp.result_type(int))


def _by_lapack(factors, b, trans=0):
    """The same as `_substitute`."""
    LU, order = factors
    substitute = partial(lax.linalg.triangular_solve, left_side=True, transpose_a=bool(trans))
    lower, upper = {"lower": True, "unit_diagonal": True}, {"lower": False}
    x = (b if trans else b[order])[:, None]
    for triangle in (upper, lower) if trans else (lower, upper):
        x = substitute(LU, x, **triangle)
    return x[jnp.argsort(order), 0] if trans else x[:, 0]


def _cramer(A, b, trans=0):
    """Cramer's rule for two unknowns: forward stable (Higham 2002, Sec. 1.10.1), with one division."""
    (p, q), (r, s) = [[A[i, j] for j in range(2)] for i in range(2)]
    if trans:
        q, r = r, q
    inverse = 1 / (p * s - q * r)
    return jnp.stack([(s * b[0] - q * b[1]) * inverse, (p * b[1] - r * b[0]) * inverse])


def _lu_scalars(A):
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


def _substitute_scalars(LU, exchanges, b, trans=0):
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


def _exchange(whether, a, b):
    return jnp.where(whether, b, a), jnp.where(whether, a, b)
