"""Solves with sparse matrices: SciPy's SuperLU, factorised once, called by the program where it runs.

A program carries the numbers of a matrix and a digest of them, and no factors. These are kept here, the last KEPT of
them, by digest; what is missing is factorised again. So a solve is a pure function, which JAX may call as often as it
likes, and may move, batch or leave out.

The order of elimination belongs to the pattern and is found once: SciPy's own would be found again for each matrix.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from functools import partial
from hashlib import blake2b
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.description import Array
from hhtjax.primitives import on_host

if TYPE_CHECKING:
    from hhtjax.numerics.sparse_matrix import Elimination, Pattern, Sparse


IN_ORDER = {"ColPerm": "NATURAL", "DiagPivotThresh": 0.001, "SymmetricMode": True}
NO_EXCHANGE = {"ColPerm": "NATURAL", "DiagPivotThresh": 0.0, "SymmetricMode": True}
PIVOTING = {"ColPerm": "COLAMD", "DiagPivotThresh": 1.0, "SymmetricMode": False}
KEPT = 4  # factors, of a batch those of all members twice
WORDS = 4  # of a digest
LEFT = 1e4  # roundings that a solve may leave with pivots on the diagonal, before they are chosen freely

_factors: OrderedDict = OrderedDict()
_lock = threading.Lock()


def factorize_sparse(A: Sparse):
    """The function (b, trans=0) -> A^-1 b, or A^-T b, with a `Sparse` A factorised once and constant to autodiff.

    A singular A gives NaN.
    """
    values = lax.stop_gradient(A.values)
    digest = on_host(partial(_factorize, A.pattern), jax.ShapeDtypeStruct((WORDS,), jnp.uint32), values)

    def apply(b: Array, trans: int = 0) -> Array:
        return on_host(partial(_solve, A.pattern, trans), jax.ShapeDtypeStruct(b.shape, b.dtype), digest, values, b)

    return apply


def _factorize(pattern: Pattern, values: np.ndarray) -> np.ndarray:
    """(..., WORDS): the digests of values (..., slots), whose factors are kept."""
    values = np.asarray(values)
    flat = values.reshape(-1, values.shape[-1])
    digests = [blake2b(x.tobytes(), digest_size=4 * WORDS).digest() for x in flat]
    _obtain(pattern, digests, flat)
    return np.frombuffer(b"".join(digests), np.uint32).reshape(*values.shape[:-1], WORDS)


def _solve(pattern: Pattern, trans: int, digests: np.ndarray, values: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(..., n): of a batch as `on_host` hands it over."""
    digests, values, b = map(np.asarray, (digests, values, b))
    number = digests.size // WORDS
    keys = [x.tobytes() for x in digests.reshape(number, WORDS)]
    matrices = np.broadcast_to(values, (*digests.shape[:-1], values.shape[-1])).reshape(number, -1)
    factors = _obtain(pattern, keys, matrices)
    shape = np.broadcast_shapes(digests.shape[:-1], b.shape[:-1])
    which = np.broadcast_to(np.arange(number).reshape(digests.shape[:-1]), shape).ravel()
    b = np.broadcast_to(b, (*shape, pattern.n)).reshape(-1, pattern.n)
    if number == 1:
        return _substitute(factors[0], b.T, trans).T.reshape(*shape, pattern.n)
    return np.stack([_substitute(factors[i], x, trans) for i, x in zip(which, b, strict=True)]).reshape(*shape, -1)


def _substitute(factors, b: np.ndarray, trans: int) -> np.ndarray:
    """NaN where there are no factors."""
    return np.full_like(b, np.nan) if factors is None else factors.solve(b, "T" if trans else "N")


def _obtain(pattern: Pattern, digests: list, values: np.ndarray):
    """The factors of these matrices, as those used last."""
    found = []
    for digest, x in zip(digests, values, strict=True):
        key = pattern.digest, x.dtype.char, digest
        with _lock:
            factors = _factors.pop(key, _MISSING)
        if factors is _MISSING:
            factors = superlu(pattern, x)
        with _lock:
            _factors[key] = factors
        found.append(factors)
    with _lock:
        while len(_factors) > max(KEPT, 2 * len(found)):
            _factors.popitem(last=False)
    return found


_MISSING = object()


def superlu(pattern: Pattern, values: np.ndarray) -> Ordered | None:
    """SuperLU's factors; None of a matrix that is singular, or not finite.

    In the order of the pattern and, as far as they are large enough, with pivots on the diagonal: half the fill of free
    pivoting. Where that loses digits pivots are free.
    """
    if not np.all(np.isfinite(values)):
        return None
    way = pattern.elimination
    numbers = values[way.slots]
    enough = LEFT * np.finfo(values.dtype).eps
    for options in (IN_ORDER, PIVOTING):
        try:
            factors = _gstrf(pattern.n, numbers, way, options)
        except RuntimeError:  # a pivot is zero
            continue
        x = factors.solve(np.ones(pattern.n, values.dtype))
        terms = numbers * x[way.columns]
        left, size = (np.bincount(way.rows, weights=y, minlength=pattern.n) for y in (terms, np.abs(terms)))
        if np.max(np.abs(left - 1)) <= enough * np.max(size):
            return Ordered(factors, way.order)
    return None


class Ordered(NamedTuple):
    """SuperLU's factors of a matrix whose rows and columns stand in another order."""

    factors: Any
    order: np.ndarray

    def solve(self, b: np.ndarray, trans: str) -> np.ndarray:
        """x with A x = b, or A^T x = b for "T": (n,) or (n, k)."""
        x = np.empty_like(b)
        x[self.order] = self.factors.solve(b[self.order], trans)
        return x


def _gstrf(n: int, numbers: np.ndarray, way: Elimination, options: dict) -> Any:
    """SciPy's SuperLU without the checks of `splu`, a millisecond for each matrix, where SciPy has it where it was."""
    from scipy.sparse import csc_array
    from scipy.sparse.linalg import splu

    try:
        from scipy.sparse.linalg._dsolve import _superlu
    except ImportError:
        A = csc_array((numbers, way.rows, way.starts), shape=(n, n))
        more = {"SymmetricMode": options["SymmetricMode"]}
        return splu(A, options["ColPerm"], options["DiagPivotThresh"], options=more)
    return _superlu.gstrf(
        n, len(numbers), numbers, way.rows, way.starts, csc_construct_func=csc_array, ilu=False, options=options
    )


def pivots_on_host(A: Sparse, limit: float) -> Array:
    """(n,): the pivots of a symmetric matrix, eliminated in the order of its pattern without exchanges. limit: far less
    than pivots that matter; a part of it is added to the diagonal."""
    like = jax.ShapeDtypeStruct((A.pattern.n,), A.dtype)
    return on_host(partial(_pivots, A.pattern, limit / 100), like, lax.stop_gradient(A.values))


def _pivots(pattern: Pattern, shift: float, values: np.ndarray) -> np.ndarray:
    """(..., n): of a batch as `on_host` hands it over."""
    way, flat = pattern.elimination, values.reshape(-1, values.shape[-1])
    found = np.zeros((len(flat), pattern.n), values.dtype)
    for x, row in zip(flat, found, strict=True):
        numbers = x[way.slots]
        numbers[way.rows == way.columns] += shift
        if np.all(np.isfinite(numbers)):
            row[way.order] = _gstrf(pattern.n, numbers, way, NO_EXCHANGE).U.diagonal()
    return found.reshape(*values.shape[:-1], pattern.n)


def is_positive_definite(A):
    """Whether a symmetric matrix of scipy.sparse is so, by the signs of its pivots."""
    from scipy.sparse.linalg import splu

    try:
        factors = splu(A, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    except RuntimeError:  # singular
        return False
    return np.array_equal(factors.perm_r, factors.perm_c) and np.min(factors.U.diagonal()) > 0
