"""Linear solves with derivatives of their own, for maps and matrices, by elimination or by a user's solver."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
from jax import lax

from hhtjax.description import Array, PyTree
from hhtjax.jaxpr import linear_map
from hhtjax.numerics.dense_lu import diagonal, factorize, full_matrix, matvec
from hhtjax.numerics.low_rank import AtState
from hhtjax.primitives import forward_only, part, staged

if TYPE_CHECKING:
    from hhtjax.numerics.low_rank import Constant, Known
    from hhtjax.numerics.sparse_matrix import Sparse
    from hhtjax.numerics.structured_solve import Banded

FORWARD_ONLY = (
    "a force (or mass, or constraint) with a `lax.while_loop`, or a `lax.fori_loop` of unknown length, has forward "
    "derivatives only, jax.jvp and jax.jacfwd: for reverse ones write it with `lax.scan`, or a `lax.fori_loop` of "
    "known length, or give it derivatives by `jax.custom_jvp`, as of an implicit function."
)
RANK_TOLERANCE = 1e-9  # relative size of a singular value of dependent columns; in float32 100 roundings


def solve_map(f: Callable, b: Array, factorize) -> Array:
    """x with f(x) = b, for a linear map f of (n,) to (n,); `factorize` as below.

    The matrix of f is used only to find x. Derivatives use f itself, f(dx) = db - df(x). This needs one direction;
    differentiating the matrix would need n.
    """
    return factorize_map(f, b, factorize)(b)


def factorize_map(f: Callable, like: PyTree, factorize: Callable | Constant):
    """The function b -> x with f(x) = b, for vectors like `like`: `solve_map` for many b, factorised once."""
    inverse = invert(f, like, factorize)
    return lambda b: _solve(f, b, inverse)


def invert(f: Callable, like: PyTree, factorize: Callable | Constant):
    """The function (b, trans=0) -> A^-1 b, or A^-T b, of the matrix A of f; it may be constant to autodiff."""
    if isinstance(factorize, (Structured, AtState)):
        return factorize.of_map(f, like)
    return factorize(staged(partial(linear_map, f), like.size)(like))


def invert_and_bound(f: Callable, like: PyTree, factorize: Callable | Constant | Known):
    """`invert`, and the function x -> |A| |x|, what the rows of A x are sums of; where no A is formed, |A x|."""
    if isinstance(factorize, Structured):
        return factorize.of_map(f, like), lambda x: jnp.abs(f(x))
    if isinstance(factorize, AtState):
        return factorize.of_map(f, like), factorize.bound
    A = staged(partial(linear_map, f), like.size)(like)
    return factorize(A), lambda x: matvec(jnp.abs(A), jnp.abs(x))


def _solve(f: Callable, b: Array, inverse: Callable) -> Array:
    f = part(f, b.size)  # for its derivatives
    call = partial(lax.custom_linear_solve, f, b, solve=lambda _, y: inverse(y, trans=0))
    try:
        return call(transpose_solve=lambda _, y: inverse(y, trans=1))
    except (ValueError, NotImplementedError):
        # JAX transposes f at once, and a `while_loop` in a user's force has no transpose: only reverse mode needs one
        return forward_only(call(), FORWARD_ONLY)


class Trusted:
    """A `factorize` that cannot guarantee its results, and therefore reports the residual.

    tolerance: of the residual relative to the right-hand side, in the 2-norm; None: 1e-6, in float32 1e-3.
    """

    tolerance: Any = None

    def leaves(self, f: Callable, b: Array, x: Array) -> Array:
        """The residual of b = f(x), relative to b."""
        largest = jnp.max(jnp.abs(b))  # whose square may be 0 in float32
        unit = jnp.where(largest == 0, 1, largest)
        left, size = (jnp.sqrt(jnp.sum((y / unit) ** 2)) for y in (f(x) - b, b))
        return lax.stop_gradient(jnp.where(left == 0, 0, left / size))

    def accepts(self, left: Array):
        """Whether the residual is acceptable. NaN is accepted here, because other checks report it."""
        tolerance = self.tolerance
        return ~(left > (max(1e-6, 1e4 * float(jnp.finfo(left.dtype).eps)) if tolerance is None else tolerance))


@dataclass(frozen=True)
class Given(Trusted):
    """A `factorize` from a function that does its work."""

    function: Callable
    tolerance: Any = None

    def __call__(self, A: Array):
        """(b, trans=0) -> A^-1 b, or A^-T b."""
        return self.function(A)


class Structured(Trusted):
    """A `factorize` that is given the linear map f itself: `of_map(f, like)` is what `invert` promises."""

    def of_map(self, f, like: PyTree):
        """(b, trans=0) -> A^-1 b, or A^-T b."""
        raise NotImplementedError

    def __call__(self, A: Array | Sparse):
        """The same for a matrix."""
        return self.of_map(partial(matvec, A), jnp.zeros(len(A), A.dtype))


def factorize_with(solve: Callable | Banded):
    """A `factorize` from a function solve(A, b), which need not be differentiable."""
    if isinstance(solve, Structured):
        return solve

    def factorize(A):
        A = full_matrix(lax.stop_gradient(A))  # as the user's function expects it
        return lambda b, trans=0: solve(A.T if trans else A, b)

    return Given(factorize)


def reuse(factorize: Callable | Banded, inverse: Callable):
    """A `factorize` of the same kind for a matrix that has been factorised: `inverse` is what it gave."""

    def known(A: Array):
        return inverse

    return Given(known, factorize.tolerance) if isinstance(factorize, Trusted) else known


def factorize_saddle_point(n: int):
    """`factorize` for A = [[M, -B^T], [B, .]], with scaled rows and columns.

    The first n unknowns and equations are scaled by the diagonal of A, and the rows below accordingly. So the choice of
    pivots does not depend on the units of mass, length and time. Otherwise single precision could fail.
    """

    def factorize_rows(A: Array):
        A = lax.stop_gradient(A)
        d = jnp.abs(diagonal(A)[:n])
        first = 1 / jnp.sqrt(jnp.where(d == 0, 1, d))
        size = matvec(jnp.abs(A[n:, :n]), first)
        rows = jnp.concatenate([first, 1 / jnp.where(size == 0, 1, size)])
        inverse = factorize(rows[:, None] * A)
        return lambda b, trans=0: rows * inverse(b, trans=1) if trans else inverse(rows * b, trans=0)

    return factorize_rows


def factorize_least_squares(n: int):
    """The same where B may have lost rank: the least-squares solution of least norm.

    The first n unknowns and equations are measured as above, all others alike.
    """

    def factorize(A):
        A = lax.stop_gradient(A)
        tolerance = max(RANK_TOLERANCE, 100 * float(jnp.finfo(A.dtype).eps))
        d = jnp.abs(diagonal(A)[:n])
        first = 1 / jnp.sqrt(jnp.where(d == 0, 1, d))
        size = jnp.max(jnp.abs(first[:, None] * A[:n, n:]))
        rest = 1 / jnp.where(size == 0, 1, size)  # 0 where all constraints are switched off
        scale = jnp.concatenate([first, jnp.full(A.shape[0] - n, rest)])
        U, s, Vt = jnp.linalg.svd(scale[:, None] * A * scale[None, :])
        inverse = jnp.where(s > tolerance * s[0], 1 / s, 0)

        def apply(b: Array, trans: int = 0) -> Array:
            left, right = (Vt.T, U.T) if trans else (U, Vt)
            return scale * (right.T @ (inverse * (left.T @ (scale * b))))

        return apply

    return factorize


def solve(A: Array, b: Array, factorize: Callable = factorize):
    """x with A x = b, for A (n, n) and b (n,), differentiable in both.

    LU with partial pivoting: unrolled for n <= 8, a loop or LAPACK's above (dense_lu.py); Cramer's rule for n = 2.
    A singular A gives inf or NaN.

    >>> import jax.numpy as jnp
    >>> [round(float(x), 6) for x in solve(jnp.array([[0.0, 2.0], [4.0, 0.0]]), jnp.array([2.0, 8.0]))]
    [2.0, 1.0]
    """
    return solver(A, factorize)(b)


def solver(A: Array, factorize: Callable = factorize):
    """The function b -> x of it, for many b: factorised once."""
    inverse = factorize(A)
    return lambda b: _solve(partial(matvec, A), b, inverse)
