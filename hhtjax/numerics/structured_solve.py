"""Linear solvers for large systems, whose cost is proportional to the number of unknowns: `hht(solve=banded(1))`.

They use the linear map dw -> A dw of a step, not its matrix. A band is computed by applying the map to a few vectors of
ones and zeros. Conjugate gradients only apply the map.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.sparse.linalg import cg

from hhtjax.checks import require_integer, require_number
from hhtjax.description import Array, PyTree, Real
from hhtjax.numerics.block_tridiagonal import factorize_blocks, solve_blocks
from hhtjax.numerics.linear_solve import Structured
from hhtjax.numerics.sparsity import pattern_of


@dataclass(frozen=True)
class Banded(Structured):
    """A[i, j] = 0 for |i - j| > half_bandwidth, and elimination without pivoting, as for positive definite A."""

    half_bandwidth: int
    tolerance: Any = None

    def of_map(self, f: Callable, like: PyTree):
        """(b, trans=0) -> A^-1 b, or A^-T b."""
        p, n = self.half_bandwidth, like.size
        bands = lax.stop_gradient(find_bands(f, like, p))
        if p == 1:
            transposed = jnp.stack([jnp.roll(band, i - p) for i, band in enumerate(bands)])[::-1]
            return lambda b, trans=0: solve_tridiagonal(transposed if trans else bands, b)
        factors = factorize_blocks(*blocks_of(bands))

        def apply(b: Array, trans: int = 0) -> Array:
            rows = jnp.pad(b, (0, -n % p)).reshape(-1, p)
            return solve_blocks(factors, rows, trans).ravel()[:n]

        return apply


@dataclass(frozen=True)
class ConjugateGradients(Structured):
    """A symmetric and positive definite; `iterations` of them, however large the residual then is."""

    iterations: int
    tolerance: Any = None

    def of_map(self, f, like: PyTree):
        """(b, trans=0) -> A^-1 b, A being symmetric."""
        return lambda b, trans=0: cg(f, b, tol=0.0, atol=0.0, maxiter=self.iterations)[0]


def banded(half_bandwidth: int = 1, tolerance: Real = None) -> Banded:
    """A solver for matrices with a band, for the `solve` of a stepper: chains, frames, beams.

    The Jacobians of the force may couple unknowns that are up to `half_bandwidth` apart, in the order of the leaves of
    q. M must be diagonal (n,). A step costs 2 half_bandwidth + 1 tangents of the residual and an elimination. All of
    this is proportional to the number of unknowns.

    Args:
        half_bandwidth: a positive integer. If it is too small, the solve leaves a residual.
        tolerance: largest residual, relative to the right-hand side (2-norm); 1e-6 by default, 1e-3 in float32. A step
            with a larger residual is a failure that `solution.check()` reports. `solution.info.solve_residual` has the
            largest residual.

    Returns:
        A solver for `hht(solve=...)`.

    Raises:
        ValueError: half_bandwidth is not a positive integer, or tolerance is not positive.

    >>> import jax.numpy as jnp, hhtjax
    >>> def springs(q, v, t, params):
    ...     return jnp.diff(params["k"] * jnp.diff(q, prepend=0.0), append=0.0)
    >>> tower = hhtjax.System(jnp.ones(50), springs)
    >>> def end(solve):
    ...     stepper = hhtjax.hht(linearize="predictor", solve=solve)
    ...     start = jnp.linspace(0.0, 1.0, 50), jnp.zeros(50)
    ...     return hhtjax.simulate(tower, stepper, *start, {"k": 100.0}, dt=0.1, num_steps=20).q[-1]
    >>> bool(jnp.allclose(end(hhtjax.banded(1)), end(None), atol=1e-12))
    True
    """
    half_bandwidth = require_integer("banded", "half_bandwidth", half_bandwidth)
    return Banded(half_bandwidth, _tolerance("banded", tolerance))


def conjugate_gradients(iterations: int, tolerance: Real = None) -> ConjugateGradients:
    """A matrix-free solver by conjugate gradients, for the `solve` of a stepper.

    It makes a fixed number of iterations, so every step costs the same: one tangent of the residual for each iteration.
    The remaining residual is an error of the step. The number of iterations needed grows with the square root of the
    condition number of M + beta h^2 K, that is, with the number of elements that a wave crosses in a step. M must be
    diagonal (n,), stiffness and damping symmetric.

    Args:
        iterations: number of iterations, a positive integer.
        tolerance: as in `banded`. Use a larger one for intentionally inexact solves. With Newton's iteration 0.1 is
            enough for the motion; derivatives are only as exact as the solve.

    Returns:
        A solver for `hht(solve=...)`.

    Raises:
        ValueError: iterations is not a positive integer, or tolerance is not positive.

    >>> import jax.numpy as jnp, hhtjax
    >>> tower = hhtjax.System(jnp.ones(3), lambda q, v, t, params: -100.0 * q)
    >>> stepper = hhtjax.hht(linearize="predictor", solve=hhtjax.conjugate_gradients(2))
    >>> run = hhtjax.simulate(tower, stepper, jnp.ones(3), jnp.zeros(3), dt=0.01, num_steps=10)
    >>> run.check()
    >>> round(float(run.q[-1, 0]), 3)                                                                   # cos(1)
    0.541
    """
    iterations = require_integer("conjugate_gradients", "iterations", iterations)
    return ConjugateGradients(iterations, _tolerance("conjugate_gradients", tolerance))


@dataclass(frozen=True, eq=False)
class Detected(Structured):
    """A sparse matrix, whose pattern is given, or is detected from the functions of a system."""

    pattern: Any = None
    tolerance: Any = None


def sparse_lu(pattern: Any = "auto", tolerance: Real = None) -> Detected:
    """A sparse LU solver for any system, also with constraints, for the `solve` of a stepper.

    The entries of the matrix are computed by products with a few vectors, one for each colour of its columns (Curtis,
    Powell, Reid 1974). If the unknowns can be arranged in a row of small blocks, the blocks are eliminated in this
    order. Otherwise SuperLU is used. It is faster than the default from some 30 unknowns on. A `System.from_elements`
    does not need it: its own solver uses the elements.

    Args:
        pattern: (n, n), a matrix of scipy.sparse or an array. It must be nonzero wherever a force, or M, may depend on
            an unknown, in the order of the leaves of v. "auto": detected from the traced functions of the system.
        tolerance: as in `banded`.

    Returns:
        A solver for `hht(solve=...)`.

    Raises:
        TypeError, ValueError: not a pattern, or one that is not square; a tolerance that is not positive.

    >>> import jax.numpy as jnp, hhtjax
    >>> def links(q, t, params):                                                      # 40 pendulums, each on the next
    ...     return jnp.sum(jnp.diff(q, prepend=0.0, axis=0) ** 2, axis=1) - 1.0
    >>> chain = hhtjax.System(jnp.ones(80), lambda q, v, t, params: jnp.tile(jnp.array([0.0, -9.81]), (40, 1)), links)
    >>> start = jnp.stack([jnp.arange(1.0, 41.0), jnp.zeros(40)], axis=1)
    >>> def end(solve):
    ...     stepper = hhtjax.hht(linearize="predictor", solve=solve)
    ...     return hhtjax.simulate(chain, stepper, start, 0 * start, dt=0.01, num_steps=20).q[-1]
    >>> bool(jnp.allclose(end(hhtjax.sparse_lu()), end(None), atol=1e-9))
    True
    """
    tolerance = _tolerance("sparse_lu", tolerance)
    if isinstance(pattern, str):
        if pattern != "auto":
            raise ValueError(f'sparse_lu: `pattern` must be "auto", or a matrix (n, n); received {pattern!r}.')
        return Detected(None, tolerance)
    shape = np.shape(pattern) if not hasattr(pattern, "nnz") else pattern.shape
    if len(shape) != 2 or shape[0] != shape[1]:
        raise ValueError(f"sparse_lu: `pattern` must have shape (n, n); received shape {shape}.")
    return Detected(pattern_of(pattern), tolerance)


def _tolerance(caller: str, value):
    """As a number, which is part of the program."""
    return None if value is None else float(require_number(caller, "tolerance", value, lambda x: x > 0, "be positive"))


def find_bands(f: Callable, like: PyTree, p: int) -> Array:
    """bands[p + d, i] = A[i, i + d] for |d| <= p, 0 outside of A; from A times 2 p + 1 vectors."""
    n, width = like.size, 2 * p + 1
    i = jnp.arange(n)
    probes = (i[None, :] % width == jnp.arange(width)[:, None]).astype(like.dtype)
    images = jax.vmap(f)(probes)
    column = i[None, :] + jnp.arange(-p, p + 1)[:, None]
    bands = jnp.take_along_axis(images, column % width, axis=0)
    return jnp.where((column >= 0) & (column < n), bands, 0)


def solve_tridiagonal(bands: Array, b: Array) -> Array:
    """x with A x = b."""
    lower, diagonal, upper = bands
    return lax.linalg.tridiagonal_solve(lower, diagonal, upper, b[:, None])[:, 0]


def blocks_of(bands: Array) -> tuple[Array, Array, Array]:
    """(N, p, p) each: the blocks before, on and behind the diagonal, those at the end filled with the identity."""
    p, n = len(bands) // 2, bands.shape[1]
    num_blocks = -(-n // p)
    unit = np.zeros((2 * p + 1, num_blocks * p - n))
    unit[p] = 1
    bands = jnp.concatenate([bands, unit.astype(bands.dtype)], axis=1)
    row, column = np.arange(p)[:, None], np.arange(p)[None, :]
    rows = bands.reshape(2 * p + 1, num_blocks, p)

    def blocks(shift: int) -> Array:
        d = column - row + shift * p
        found = rows[np.clip(d + p, 0, 2 * p), :, row]
        return jnp.moveaxis(jnp.where((abs(d) <= p)[:, :, None], found, 0), -1, 0)

    return blocks(-1), blocks(0), blocks(1)
