"""Normal modes of M w + K q = 0, and the reduction of linear systems to their lowest modes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from hhtjax.checks import require_integer
from hhtjax.description import Array, Description, PyTree, Real, is_concrete
from hhtjax.description.presentation import Table, frequency_cells, known, shown
from hhtjax.numerics.sparse_matrix import Sparse
from hhtjax.numerics.superlu import is_positive_definite
from hhtjax.systems.linear_system import LinearSystem
from hhtjax.systems.matrices import SYMMETRIC, constant_matrix, is_sparse, require_mass

DENSE = 1000  # rows up to which a sparse problem is solved as a dense one
UNCOUPLED = 1e-9  # size of what couples modes, relative to their damping, that is rounding, with all dtypes
ROUNDINGS = 100  # as many of the terms that a number is the sum of, too
SHIFTS = 0.0, 1e-12, 1e-9, 1e-6  # relative to the largest K_ii/M_ii: the first that is no eigenvalue


@shown
class NormalModes(NamedTuple):
    """Result of `modes`: natural frequencies and mode shapes of free vibration about rest. Prints as a table.

    Attributes:
        frequencies: (count,), rad/s where times are in s, lowest first, 0 for rigid motions.
        shapes: T, (n, count), with a mode in each column. T^T M T = 1, and the largest entry of a column is positive.
    """

    frequencies: np.ndarray
    shapes: np.ndarray

    def _table(self):
        """Mode by mode."""
        n, count = np.shape(self.shapes)
        return _frequency_table(f"NormalModes: {count} of a system of {n} coordinates", self.frequencies)


@shown
class ModalReduction(NamedTuple):
    """Result of `modal_reduction`: the reduced system, and the maps from and to the full coordinates.

    Prints as a table, as `modes`.

    Attributes:
        system: the `LinearSystem` of the modal coordinates x, (count,).
        frequencies: (count,), rad/s, where times are in s; lowest first.
        shapes: T, (n, count), q = T x.
        inverse: T^T M, (count, n), x = T^T M q.
    """

    system: LinearSystem
    frequencies: Any
    shapes: Any
    inverse: Array

    def _table(self):
        """Mode by mode."""
        n, count = np.shape(self.shapes)
        return _frequency_table(f"ModalReduction: {n} coordinates in {count} modes", self.frequencies)

    def expand(self, q: Array) -> Array:
        """Full coordinates (..., n) from modal ones (..., count): T q, for positions, velocities or accelerations."""
        return jnp.asarray(q) @ jnp.asarray(self.shapes).T

    def project(self, q: np.ndarray) -> Array:
        """Modal coordinates (..., count) from full ones (..., n): T^T M q; exact for motions that the modes span."""
        return jnp.asarray(q) @ jnp.asarray(self.inverse).T


def _frequency_table(title: str, frequencies: Any) -> Table:
    """Frequencies in rad/s and Hz, and periods; only a title where they are tracers."""
    w = known(frequencies)
    numbered = enumerate([] if w is None else w.tolist(), 1)
    return Table(title, [["mode", "rad/s", "Hz", "period"], *([str(i), *frequency_cells(x)] for i, x in numbered)])


def modes(M: Real, K: Real, count: int | None = None) -> NormalModes:
    """The lowest modes of free vibration: K T = M T diag(frequencies^2).

    Args:
        M, K: mass and stiffness, symmetric; M positive definite, K positive semidefinite. Arrays (n, n), or (n,) for
            diagonals, or matrices of scipy.sparse of any size. Sparse matrices with more than 1000 rows, unless all
            modes are asked for, are solved by Lanczos's iteration on the shifted inverse (`scipy.sparse.linalg.eigsh`),
            all others by NumPy.
        count: number of modes; None for all.

    Returns:
        `NormalModes`, with NumPy arrays.

    Raises:
        TypeError, ValueError: matrices of a wrong kind or shape, not symmetric, or indefinite; a count out of range.

    References:
        Meirovitch, Computational Methods in Structural Dynamics, 1980; Lehoucq, Sorensen, Yang, ARPACK, 1998.

    >>> import numpy as np, hhtjax
    >>> K = 100.0 * (2 * np.eye(3) - np.eye(3, k=1) - np.eye(3, k=-1))          # three masses between two walls
    >>> found = hhtjax.analysis.modes(np.ones(3), K, count=2)
    >>> found
    NormalModes: 2 of a system of 3 coordinates
        mode  rad/s  Hz    period
        1     7.654  1.22  0.821 s
        2     14.14  2.25  0.444 s
    >>> [round(float(w), 6) for w in found.frequencies], [round(20 * float(np.sin(j * np.pi / 8)), 6) for j in (1, 2)]
    ([7.653669, 14.142136], [7.653669, 14.142136])
    """
    M, K = map(_of_scipy, (M, K))
    n = _rows("M", M)
    if n != _rows("K", K):
        raise ValueError(f"modes: `K` must have the shape of M, {n} rows; received {_rows('K', K)}.")
    count = n if count is None else require_integer("modes", "count", count)
    if count > n:
        raise ValueError(f"modes: `count` must be at most {n}, the number of coordinates; received {count}.")
    by_lanczos = (is_sparse(M) or is_sparse(K)) and DENSE < n != count
    rounding = max(1e-9, ROUNDINGS * _eps(M, K))
    squares, T, scale = _by_lanczos(M, K, count, rounding) if by_lanczos else _by_numpy(M, K, count)
    if squares[0] < -rounding * scale:
        raise ValueError(f"modes: `K` must be positive semidefinite; received one with frequency^2 = {squares[0]:.4g}.")
    largest = np.take_along_axis(T, np.argmax(np.abs(T), axis=0)[None], axis=0)
    return NormalModes(np.sqrt(np.maximum(squares, 0)), np.where(largest < 0, -T, T))


def modal_reduction(system: LinearSystem, count, params: PyTree = None) -> ModalReduction:
    """Reduces a linear system to its lowest `count` modes, q = T x:

        x'' + T^T C T x' + diag(frequencies^2) x = T^T f(t) + T^T g(T x, T v, t)

    With proportional damping the modes stay uncoupled, and C becomes a diagonal. Other damping couples them. The
    response of the modes left out is missing, including their static deflection.

    Args:
        system: a `LinearSystem`, or (M, C, K), or (M, C, K, force), with arguments as for `LinearSystem`. C may be
            None. Matrices of scipy.sparse may have any size. Matrices that are functions of params remain functions,
            with a constant T from the given params. So parameters can be fitted through the reduced system. The q and v
            of the reduced system are vectors. A `nonlinear` force without `at` gets vectors too, as do `friction` and
            `sliding`.
        count: number of modes.
        params: params of the matrices that are functions.

    Returns:
        A `ModalReduction`. Pass its `system` to `simulate`, with `project(q0)` and `project(v0)` as start;
        `expand(run.q)` gives the full coordinates. `suggest_step_size(reduced.system, stepper, ...)` shows which modes
        a step resolves.

    Raises:
        TypeError, ValueError: as `modes`.

    >>> import jax.numpy as jnp, hhtjax
    >>> K = 100.0 * (2 * jnp.eye(50) - jnp.eye(50, k=1) - jnp.eye(50, k=-1))
    >>> chain = hhtjax.LinearSystem(jnp.ones(50), 1e-3 * K, K, lambda t, params: jnp.sin(t) * jnp.ones(50))
    >>> reduced = hhtjax.analysis.modal_reduction(chain, 6)
    >>> rest = jnp.zeros(6)
    >>> run = hhtjax.simulate(reduced.system, hhtjax.hht(), rest, rest, dt=0.05, num_steps=100)
    >>> reduced.expand(run.q).shape, reduced.system.C.shape
    ((101, 50), (6,))
    >>> print(hhtjax.analysis.suggest_step_size(reduced.system, hhtjax.hht(), rest, rest, highest=1.0).reason)
    resolves the mode at 0.6159 rad/s to 0.01
    """
    nonlinear, at, friction, sliding = None, None, None, _velocities
    if isinstance(system, LinearSystem):
        (M, C, K), load = map(_of_scipy, (system.M, system.C, system.K)), system.load
        nonlinear, at, friction = system.nonlinear, system.at, system.friction
        sliding = system.sliding or sliding
    elif isinstance(system, tuple) and len(system) in (3, 4):
        M, C, K, load = (*system, None)[:4]
    else:
        raise TypeError(
            f"modal_reduction: `system` must be a LinearSystem, (M, C, K) or (M, C, K, force); received {system!r}."
        )
    if K is None:
        raise ValueError("modal_reduction: `system` must have a stiffness K; received None.")
    mass, stiffness = (_of_scipy(A(params) if callable(A) else A) for A in (M, K))
    frequencies, T = modes(mass, stiffness, count)
    reduced = LinearSystem(
        _Projected(T, M) if callable(M) else np.ones(count),
        C if C is None else _Projected(T, C) if callable(C) else _uncoupled(T, C),
        _Projected(T, K) if callable(K) else frequencies**2,
        None if load is None else _ProjectedLoad(T, load),
        None if nonlinear is None else _ProjectedForce(T if at is None else T[list(at)], nonlinear),
        friction=None if friction is None else _Expanded(T, friction),
        sliding=None if friction is None else _Expanded(T, sliding),
    )
    return ModalReduction(reduced, frequencies, T, _times(mass, T).T)


@dataclass(frozen=True, eq=False)
class _Projected(Description):
    """T^T A(params) T."""

    T: Any
    matrix: Callable

    def __call__(self, params: PyTree) -> Array:
        A = self.matrix(params)
        if isinstance(A, Sparse):
            return self.T.T @ jax.vmap(lambda x: A @ x, 1, 1)(jnp.asarray(self.T))
        return _project(self.T, jnp.asarray(A))


@dataclass(frozen=True, eq=False)
class _ProjectedLoad(Description):
    """T^T f(t)."""

    T: Any
    load: Callable

    def __call__(self, t: Array, params: PyTree) -> Array:
        f, _ = ravel_pytree(self.load(t, params))
        return jnp.asarray(self.T, f.dtype).T @ f


@dataclass(frozen=True, eq=False)
class _Expanded(Description):
    """f(T x, T v, t) as a vector: for dry friction, whose entries belong to joints and are not projected."""

    T: Any
    function: Callable

    def __call__(self, q: Array, v: Array, t: Array, params: PyTree) -> Array:
        T = jnp.asarray(self.T, q.dtype)
        return ravel_pytree(self.function(T @ q, T @ v, t, params))[0]


@dataclass(frozen=True, eq=False)
class _ProjectedForce(_Expanded):
    """T^T g(T x, T v, t), with the rows of T where g acts."""

    def __call__(self, q: Array, v: Array, t: Array, params: PyTree) -> Array:
        return jnp.asarray(self.T, q.dtype).T @ super().__call__(q, v, t, params)


def _of_scipy(A):
    return A.tocoo() if isinstance(A, Sparse) and is_concrete(A.values) else A


def _velocities(q, v, t, params: PyTree):
    return v


def _times(A: Real, T: Real) -> Real:
    return A[:, None] * T if np.ndim(A) == 1 and not is_sparse(A) else A @ T


def _project(T: Real, A: Real) -> Real:
    return T.T @ _times(A, T)


def _uncoupled(T: np.ndarray, C) -> np.ndarray:
    """T^T C T, or its diagonal if the other entries are only rounding."""
    C = C if is_sparse(C) else np.asarray(C)
    D = _project(T, C)
    d = np.diagonal(D)
    rest = np.abs(D - np.diag(d))
    rounding = ROUNDINGS * _eps(T, C) * _project(abs(T), abs(C))
    return np.array(d) if np.all(rest <= np.maximum(UNCOUPLED * np.max(np.abs(d), initial=0), rounding)) else D


def _eps(*matrices: Real) -> float:
    """The largest machine epsilon of the matrices."""
    return max(float(np.finfo(np.result_type(getattr(A, "dtype", float), np.float32)).eps) for A in matrices)


def _rows(name: str, A: Real) -> int:
    """Number of rows of a matrix; raises an error unless it is known and square."""
    if not is_concrete(A):
        raise TypeError(f"modes: `{name}` must be known: call it outside jit, vmap and grad.")
    if not is_sparse(A):
        return len(constant_matrix("modes", name, A))
    if len(A.shape) != 2 or A.shape[0] != A.shape[1]:
        raise ValueError(f"modes: `{name}` must have shape (n, n), or (n,) for a diagonal; received shape {A.shape}.")
    return A.shape[0]


def _require_symmetric(K, difference: Real):
    if difference > SYMMETRIC * abs(K).max():
        raise ValueError("modes: `K` must be symmetric; received one that differs from its transpose.")


def _by_numpy(M, K: Real, count: int):
    """(squares of the frequencies, shapes, size of the largest square), by the Cholesky factor of M."""
    M, K = (np.asarray(constant_matrix("modes", name, A)) for name, A in (("M", M), ("K", K)))
    require_mass("modes", "M", M)
    K = np.diag(K) if K.ndim == 1 else K
    _require_symmetric(K, np.max(np.abs(K - K.T)))
    to_unit = np.diag(1 / np.sqrt(M)) if M.ndim == 1 else np.linalg.inv(np.linalg.cholesky(M)).T
    squares, Y = np.linalg.eigh(to_unit.T @ ((K + K.T) / 2) @ to_unit)
    return squares[:count], to_unit @ Y[:, :count], np.max(np.abs(squares))


def _by_lanczos(M, K, count, rounding):
    """As `_by_numpy`, by SciPy for sparse matrices. rounding: of the squares, relative to the largest."""
    from scipy import sparse
    from scipy.sparse.linalg import ArpackError, eigsh

    M, K = (sparse.csc_matrix(sparse.diags(np.asarray(A)) if np.ndim(A) == 1 and not is_sparse(A) else A, dtype=float)
            for A in (M, K))  # fmt: skip
    _require_symmetric(K, abs(K - K.T).max())
    diagonals: Any = [A.diagonal() for A in (K, M)]
    if not np.min(diagonals[1]) > 0:
        raise ValueError("modes: `M` must be positive definite; received one with a diagonal that is not positive.")
    scale = np.max(diagonals[0] / diagonals[1])
    if not is_positive_definite(K + rounding * scale * M):  # Lanczos finds no negative square far from the shift
        raise ValueError("modes: `K` must be positive semidefinite; received one that is not.")
    start = np.random.default_rng(0).standard_normal(len(diagonals[0]))
    for shift in SHIFTS:
        try:
            squares, T = eigsh(K, count, M, sigma=-shift * scale, v0=start)
        except (RuntimeError, ArpackError):  # a singular factor; no convergence
            continue
        order = np.argsort(squares)
        squares, T = squares[order], T[:, order]
        T = T / np.sqrt(np.sum(T * (M @ T), axis=0))
        left, terms = np.abs(K @ T - (M @ T) * squares), np.finfo(float).eps * (abs(K) @ np.abs(T))
        if np.all(left <= 1e-6 * np.abs(squares[-1]) * np.max(np.abs(M @ T), axis=0) + 1e3 * terms):
            return squares, T, scale
    raise ValueError(
        f"modes: {count} modes of the sparse `M` and `K` were not found: M may be singular, or K indefinite."
    )
