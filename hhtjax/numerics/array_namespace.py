"""Functions with which an algorithm runs on JAX arrays, which need compilation, or on NumPy arrays, which do not.

For a new program XLA needs some 10 ms for every few operations. If an algorithm has many small operations, is run a few
times, and is not traced, NumPy is faster. To support both, an algorithm uses the module that `namespace_of` returns,
and the functions below.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.description import Real


def namespace_of(x: Real) -> Any:
    """`numpy` of its arrays and numbers, else `jax.numpy`.

    >>> namespace_of(np.ones(2)).__name__, namespace_of(jnp.ones(2)).__name__
    ('numpy', 'jax.numpy')
    """
    return np if isinstance(x, (np.ndarray, np.generic)) else jnp


def select(condition: Real, x, y):
    """x where a condition, a single one, holds, else y: pytrees.

    >>> int(select(np.array(True), 1, 2)), int(select(jnp.array(False), 1, 2))
    (1, 2)
    """
    if namespace_of(condition) is np:
        return x if condition else y
    return jax.tree.map(partial(jnp.where, condition), x, y)


def with_entry(x, i, value):
    """x with another entry i.

    >>> with_entry(np.zeros(2), 1, 3.0)
    array([0., 3.])
    """
    if namespace_of(x) is jnp:
        return x.at[i].set(value)
    x = x.copy()
    x[i] = value
    return x


def svd(A: np.ndarray):
    """U, s and V^T of A = U diag(s) V^T, NaN where there are none, as of a matrix with NaN; NumPy would raise.

    >>> [x.shape for x in svd(np.full((2, 3), np.nan))]
    [(2, 2), (2,), (3, 3)]
    """
    m, n = A.shape[-2:]
    return _or_nan(namespace_of(A).linalg.svd, A, [(m, m), (min(m, n),), (n, n)])


def eigh(A: Real):
    """Eigenvalues and eigenvectors of symmetric matrices (..., n, n), NaN as in `svd`.

    >>> [x.shape for x in eigh(np.full((4, 2, 2), np.nan))]
    [(4, 2), (4, 2, 2)]
    """
    return _or_nan(namespace_of(A).linalg.eigh, A, [A.shape[-1:], A.shape[-2:]])


def _or_nan(f: Callable, A: np.ndarray, shapes: list):
    """f(A), or arrays of NaN, behind the leading axes of A, where NumPy raises."""
    try:
        return f(A)
    except np.linalg.LinAlgError:
        return [np.full((*A.shape[:-2], *shape), np.nan, A.dtype) for shape in shapes]


def solve_upper(T: np.ndarray, y):
    """x of T x = y, T (..., n, n) upper triangular with a diagonal that is not 0, y (..., n).

    >>> solve_upper(np.array([[1.0, 2.0], [0.0, 4.0]]), np.array([4.0, 4.0]))
    array([2., 1.])
    """
    solve = np.linalg.solve if namespace_of(T) is np else jax.scipy.linalg.solve_triangular
    return solve(T, y[..., None])[..., 0]


def solve_upper_transposed(T: np.ndarray, y: np.ndarray):
    """x of T^T x = y, T as in `solve_upper`.

    >>> solve_upper_transposed(np.array([[1.0, 2.0], [0.0, 4.0]]), np.array([1.0, 6.0]))
    array([1., 1.])
    """
    if namespace_of(T) is np:
        return np.linalg.solve(np.swapaxes(T, -1, -2), y[..., None])[..., 0]
    return jax.scipy.linalg.solve_triangular(T, y[..., None], trans="T")[..., 0]


def while_loop(unfinished: Callable, body: Callable, carry: tuple):
    """`lax.while_loop`; where `unfinished(carry)` is of NumPy, a loop of Python.

    >>> int(while_loop(lambda n: n < 100, lambda n: 3 * n, np.array(2)))
    162
    """
    if namespace_of(jax.tree.leaves(carry)[0]) is jnp:
        return lax.while_loop(unfinished, body, carry)
    while unfinished(carry):
        carry = body(carry)
    return carry
