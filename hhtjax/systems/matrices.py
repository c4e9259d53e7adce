"""Constant matrices of a system, as arrays (n, n) or diagonals (n,): from arrays, lists and scipy.sparse, checked."""

import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.description import is_array, is_concrete, is_real

LARGEST_CHECKED = 256  # rows of a mass matrix that is looked at
LARGEST_DENSE = 5000  # rows of a sparse matrix that is made dense: 200 MB
SYMMETRIC = 1e-6  # relative size of M - M^T that passes


def as_matrix(value, dtype):
    """(n, n) or (n,), of the dtype of the state; a scalar is the matrix of one degree of freedom."""
    return jnp.atleast_1d(jnp.asarray(value)).astype(dtype)


def constant_matrix(caller, name, received):
    """The array (n, n) or (n,), or an error; of a matrix of scipy.sparse, a dense one, or the diagonal that it is."""
    if is_sparse(received):
        received = _dense(caller, name, received)
    try:
        value = received if is_array(received) else np.asarray(received)
    except ValueError:  # a ragged list
        value = np.asarray(None)
    if not is_real(value):
        if is_array(received) or (isinstance(received, (list, tuple)) and value.ndim):
            raise TypeError(f"{caller}: `{name}` must be real; received an array of {value.dtype}.")
        raise TypeError(f"{caller}: `{name}` must be a function or an array; received {received!r}.")
    if not is_array(received):
        value = value.astype(float)
    if value.ndim == 0:
        value = value.reshape(1)
    if value.ndim not in (1, 2) or value.shape[0] != value.shape[-1]:
        raise ValueError(
            f"{caller}: `{name}` must have shape (n, n), or (n,) for a diagonal; received shape {value.shape}."
        )
    if is_concrete(value) and not np.all(np.isfinite(value)):
        raise ValueError(f"{caller}: `{name}` must be finite; received {value!r}.")
    return value


def is_sparse(x):
    """A matrix, or array, of scipy.sparse, which is not imported for it."""
    return hasattr(x, "tocoo") and hasattr(x, "nnz")


def half_bandwidth(entries):
    """p with A[i, j] = 0 for |i - j| > p, of a matrix in scipy.sparse's format of coordinates."""
    return int(np.max(np.abs(entries.row.astype(int) - entries.col), initial=0))


def _dense(caller, name, matrix):
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


def require_mass(caller, name, M, massless=False):
    """An error for a constant M that is not symmetric, or not positive definite; with constraints it may be singular.

    In units in which its diagonal is 1. Tracers pass, and what is too large for a look at each run.
    """
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
        what = "singular" if smallest >= -rounding else "not"
        raise ValueError(f"{caller}: `{name}` must be positive definite; received one that is {what}.")


UNSYMMETRIC, INDEFINITE = 1, 2  # what mass_flaw finds


def mass_flaw(M, massless):
    """What `require_mass` would find wrong with a mass that is known when it runs, as a number; 0: nothing.

    NaN passes: the acceleration tells of it.
    """
    if len(M) > LARGEST_CHECKED:
        return jnp.zeros((), jnp.int32)
    M = lax.stop_gradient(M)
    symmetric, rounding = jnp.array(True), 0.0
    smallest = jnp.min(M if M.ndim == 1 else jnp.diagonal(M))
    if M.ndim == 2 and len(M) > 1:
        n, d, rounding = len(M), jnp.diagonal(M), float(jnp.finfo(M.dtype).eps)
        size = jnp.sqrt(jnp.where(d > 0, d, 1))
        scaled = M / jnp.outer(size, size)
        symmetric = ~(jnp.max(jnp.abs(scaled - scaled.T)) > SYMMETRIC + 16 * n * rounding)
        shift = 8 * n * rounding * massless * jnp.eye(n, dtype=M.dtype)
        pivots = jnp.diagonal(lax.linalg.cholesky(scaled + shift)) ** 2  # NaN where there is none
        smallest = jnp.where(smallest > 0, jnp.min(jnp.where(jnp.isnan(pivots), -1, pivots)), smallest)
    positive = (smallest >= -rounding) if massless else (smallest > rounding)
    flaw = jnp.where(symmetric, jnp.where(positive, 0, INDEFINITE), UNSYMMETRIC)
    return jnp.where(jnp.any(jnp.isnan(M)), 0, flaw).astype(jnp.int32)
