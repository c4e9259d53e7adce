"""Checks of constant matrices: arrays, lists and scipy.sparse become arrays (n, n) or diagonals (n,)."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.description import Array, PyTree, Real, is_array, is_concrete, is_real
from hhtjax.numerics.dense_lu import diagonal, pivots
from hhtjax.numerics.sparse_matrix import Sparse, of_scipy

LARGEST_CHECKED = 256  # rows of a mass matrix that is looked at
LARGEST_DENSE = 5000  # rows of a sparse matrix that is made dense: 200 MB
SMALL = 300  # rows of a sparse matrix up to which a dense one is solved as quickly
SYMMETRIC = 1e-6  # relative size of M - M^T that passes
MASSLESS = (
    "A coordinate without mass has no acceleration of its own: write its equilibrium as a `constraint`; or, if it is "
    "damped, make it an internal state, whose rate follows from the balance of its forces"
)


def as_matrix(value, dtype: np.dtype):
    """(n, n) or (n,), of the dtype of the state; a scalar is the matrix of one degree of freedom."""
    if isinstance(value, Sparse):
        return value.astype(dtype)
    return jnp.atleast_1d(jnp.asarray(value)).astype(dtype)


def sparse(matrix: Any) -> Sparse:
    """A sparse matrix whose values are data, for functions of params in a `LinearSystem`.

    Its multiples, sums and differences are sparse, too: `lambda params: params["k"] * K + params["shift"] * M`.
    Constant matrices of a `LinearSystem` do not need it.

    Args:
        matrix: of scipy.sparse, (n, n).

    Returns:
        A `Sparse`. Its `values` are data for jit, vmap and derivatives; its pattern is part of the program.

    Raises:
        TypeError, ValueError: not a matrix of scipy.sparse, not square, or not finite.

    >>> import jax.numpy as jnp, numpy as np, hhtjax, scipy.sparse
    >>> n = 20_000
    >>> ones = np.ones(n)
    >>> K = hhtjax.sparse(scipy.sparse.diags([-ones[1:], 2 * ones, -ones[1:]], [-1, 0, 1]))     # springs in a row
    >>> chain = hhtjax.LinearSystem(ones, K=lambda params: params["k"] * K)
    >>> start = jnp.sin(jnp.pi * jnp.arange(1.0, n + 1) / (n + 1)), jnp.zeros(n)
    >>> run = hhtjax.simulate(chain, hhtjax.hht(), *start, {"k": 4e8}, dt=0.01, num_steps=100, save_every=100)
    >>> run.check()
    >>> round(float(run.q[-1, n // 2]), 3), round(float(jnp.cos(jnp.pi * 2e4 / (n + 1))), 3)
    (-1.0, -1.0)
    """
    if isinstance(matrix, Sparse):
        return matrix
    if not is_sparse(matrix):
        raise TypeError(f"sparse: `matrix` must be a matrix of scipy.sparse; received {matrix!r}.")
    return _sparse("sparse", "matrix", matrix)


def _sparse(caller: str, name: str, matrix) -> Sparse:
    """The `Sparse` of a matrix of scipy.sparse; raises an error for others."""
    if len(matrix.shape) != 2 or matrix.shape[0] != matrix.shape[1]:
        raise ValueError(
            f"{caller}: `{name}` must have shape (n, n), or (n,) for a diagonal; received shape {matrix.shape}."
        )
    if not is_real(np.zeros(1, matrix.dtype)):
        raise TypeError(f"{caller}: `{name}` must be real; received a sparse matrix of {matrix.dtype}.")
    found = of_scipy(matrix if matrix.dtype.kind == "f" else matrix.astype(float))
    if not np.all(np.isfinite(found.values)):
        raise ValueError(f"{caller}: `{name}` must be finite; received {matrix!r}.")
    return found


def constant_matrix(caller: str, name: str, received: PyTree, keep: bool = False) -> Real:
    """The array (n, n) or (n,); raises an error for anything else. A matrix of scipy.sparse becomes a diagonal if it is
    one, else dense.

    keep: matrices with more than SMALL rows stay sparse, and so does a `Sparse`.
    """
    if is_sparse(received):
        if keep and (isinstance(received, Sparse) or _stays_sparse(received)):
            return received if isinstance(received, Sparse) else _sparse(caller, name, received)
        received = _dense(caller, name, received)
    try:
        value = received if is_array(received) else np.asarray(received)
    except ValueError:  # a ragged list
        value = np.asarray(None)
    if not is_real(value):
        if is_array(received) or (isinstance(received, (list, tuple)) and value.ndim):
            raise TypeError(f"{caller}: `{name}` must be real; received an array of {value.dtype}.")
        order = " Its rows and columns follow the sorted keys of q." if isinstance(received, dict) else ""
        raise TypeError(f"{caller}: `{name}` must be a function or an array; received {received!r}.{order}")
    if not is_array(received):
        value = value.astype(float)
    if value.ndim == 0:
        value = value.reshape(1)
    if value.ndim not in (1, 2) or value.shape[0] != value.shape[-1] or not value.size:
        raise ValueError(
            f"{caller}: `{name}` must have shape (n, n), or (n,) for a diagonal; received shape {value.shape}."
        )
    if is_concrete(value) and not np.all(np.isfinite(value)):
        raise ValueError(f"{caller}: `{name}` must be finite; received {value!r}.")
    return value


def is_sparse(x: PyTree) -> bool:
    """Whether it is a matrix or array of scipy.sparse; does not import scipy."""
    return hasattr(x, "tocoo") and hasattr(x, "nnz")


def _stays_sparse(matrix):
    return len(matrix.shape) == 2 and matrix.shape[0] > SMALL and half_bandwidth(matrix.tocoo()) > 0


def half_bandwidth(entries):
    """The half bandwidth p, with A[i, j] = 0 for |i - j| > p, of a matrix in scipy.sparse's COO format."""
    return int(np.max(np.abs(entries.row.astype(int) - entries.col), initial=0))


def _dense(caller: str, name, matrix):
    entries = matrix.tocoo()
    p, rows = half_bandwidth(entries), matrix.shape[0]
    if p == 0 and matrix.shape == (rows, rows):
        return matrix.diagonal()
    if rows > LARGEST_DENSE:
        raise ValueError(
            f"{caller}: `{name}` must have at most {LARGEST_DENSE} rows to be held dense; received a sparse one of "
            f"{rows}, which takes {8 * rows**2 / 2**30:.1f} GiB. hhtjax.analysis.modal_reduction((M, C, K), count) "
            f"reduces sparse matrices to modes; where M is diagonal, System(M, force) with hht(solve=banded({p})) "
            "takes force functions and no matrices."
        )
    return entries.toarray()


UNDAMPED = (
    "In a LinearSystem a coordinate without mass must be damped, however weakly, by a constant array `C`. One that "
    "only has springs follows the others, K22 q2 = f2 - K21 q1: eliminate it, or give it a damper, such as 1e-6 h K22"
)


def massless_inverse(M, C):
    """G with M G M = M, for a singular M if C damps all coordinates without mass; None for others, and for tracers."""
    if isinstance(M, Sparse) or not is_array(C) or not (is_concrete(M) and is_concrete(C)) or len(M) > LARGEST_CHECKED:
        return None
    M, C = (np.diag(x) if x.ndim == 1 else np.asarray(x) for x in (M, C))
    d = np.diagonal(M)
    rounding = 4 * len(M) * float(np.finfo(np.result_type(M, np.float32)).eps)
    if np.min(d) < 0 or np.max(d) == 0 or np.max(np.abs(M - M.T)) > SYMMETRIC * np.max(d):
        return None
    unit = 1 / np.sqrt(np.where(d == 0, 1, d))
    values, vectors = np.linalg.eigh(unit[:, None] * M * unit)
    rest = values <= rounding
    if not np.any(rest) or values[0] < -rounding:
        return None
    N = unit[:, None] * vectors[:, rest]
    damped = N.T @ (C + C.T) @ N
    size = np.diagonal(damped)
    if np.min(size) <= 0 or np.linalg.eigvalsh(damped / np.sqrt(np.outer(size, size)))[0] <= rounding:
        return None
    W = unit[:, None] * vectors[:, ~rest]
    return W / values[~rest] @ W.T


def require_mass(caller: str, name: str, M, massless: bool = False, way: str = MASSLESS):
    """Raises an error for a constant M that is not symmetric, or not positive definite; with constraints it may be
    singular.

    The check uses units in which the diagonal of M is 1. Tracers pass, and so do matrices too large to be checked in
    each run. way: what to do about a singular M.
    """
    if isinstance(M, Sparse):
        return _require_sparse_mass(caller, name, M)
    if not is_concrete(M) or len(M) > LARGEST_CHECKED:
        return
    M = np.asarray(M)
    d = M if M.ndim == 1 else np.diagonal(M)
    smallest, rounding = np.min(d), 0.0
    if M.ndim == 2 and smallest > 0:
        scaled = M / np.sqrt(np.outer(d, d))
        if np.max(np.abs(scaled - scaled.T)) > SYMMETRIC:
            raise ValueError(f"{caller}: `{name}` must be symmetric; received one that differs from its transpose.")
        smallest = np.linalg.eigvalsh(scaled)[0]
        rounding = 4 * len(M) * float(np.finfo(np.result_type(M, np.float32)).eps)
    if smallest < -rounding or (not massless and smallest <= rounding):
        if smallest < -rounding:
            raise ValueError(f"{caller}: `{name}` must be positive definite; received one that is not.")
        raise ValueError(f"{caller}: `{name}` must be positive definite; received one that is singular. {way}.")


def _require_sparse_mass(caller: str, name: str, M: Sparse):
    """Checks that need no factorisation."""
    if not is_concrete(M.values):
        return
    A = M.tocoo()
    if np.min(A.diagonal()) <= 0:
        raise ValueError(f"{caller}: `{name}` must be positive definite; received one that is not.")
    if abs(A - A.T).max() > SYMMETRIC * abs(A).max():
        raise ValueError(f"{caller}: `{name}` must be symmetric; received one that differs from its transpose.")


UNSYMMETRIC, INDEFINITE, OF_VELOCITY, RUBBED = 1, 2, 3, 4  # what may be wrong with a mass


def mass_flaw(M: Array | Sparse, massless: bool) -> Array:
    """A number for what `require_mass` would report, for a mass that is known only at run time; 0: nothing.

    NaN passes, because the acceleration shows it.
    """
    if len(M) > LARGEST_CHECKED or isinstance(M, Sparse):
        return jnp.zeros((), jnp.int32)
    M = lax.stop_gradient(M)
    symmetric, rounding = jnp.array(True), 0.0
    smallest = jnp.min(diagonal(M))
    if M.ndim == 2 and len(M) > 1:
        n, d, rounding = len(M), diagonal(M), float(jnp.finfo(M.dtype).eps)
        size = jnp.sqrt(jnp.where(d > 0, d, 1))
        scaled = M / jnp.outer(size, size)
        symmetric = ~(jnp.max(jnp.abs(scaled - scaled.T)) > SYMMETRIC + 16 * n * rounding)
        shift = 8 * n * rounding * massless * jnp.eye(n, dtype=M.dtype)
        found = pivots(scaled + shift)
        smallest = jnp.where(smallest > 0, jnp.min(jnp.where(jnp.isnan(found), -1, found)), smallest)
    positive = (smallest >= -rounding) if massless else (smallest > rounding)
    flaw = jnp.where(symmetric, jnp.where(positive, 0, INDEFINITE), UNSYMMETRIC)
    return jnp.where(jnp.any(jnp.isnan(M)), 0, flaw).astype(jnp.int32)
