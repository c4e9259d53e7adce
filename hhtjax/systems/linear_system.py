"""Linear systems, optionally with an additional nonlinear force: M w + C v + K q = f(t) + g(q, v, t)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from hhtjax.checks import evaluate, require_function, require_integer
from hhtjax.description import Array, Description, PyTree, is_array, thaw
from hhtjax.numerics.dense_lu import matvec
from hhtjax.numerics.sparse_matrix import Sparse, of_dense
from hhtjax.systems.friction import require_friction
from hhtjax.systems.matrices import UNDAMPED, as_matrix, constant_matrix, massless_inverse, require_mass

if TYPE_CHECKING:
    from hhtjax.systems.flat_system import FlatSystem
    from hhtjax.systems.system import FirstOrderSystem, System


@dataclass(frozen=True, eq=False, init=False)
class LinearSystem(Description):
    """The linear system  M w + C v + K q = f(t), whose step matrix is factorised once for a whole run.

    With an additional nonlinear force g(q, v, t),  M w + C v + K q = f(t) + g.  The `hht` family then evaluates only
    the Jacobian of g. If g acts on a few coordinates, named by `at`, it updates the inverse of the constant matrix
    (Woodbury), and still factorises once per run. Otherwise it factorises once per step.

    Args:
        M, C, K: mass, damping and stiffness: arrays (n, n), or (n,) for a diagonal; or matrices of scipy.sparse, such
            as from `scipy.io.mmread`; or functions of params that return arrays or results of `hhtjax.sparse`. C and K
            may be None. Rows follow `jax.flatten_util.ravel_pytree(v)`. Sparse matrices with more than 300 rows stay
            sparse: SciPy's SuperLU factorises them, and the `hht` family and Rosenbrock methods solve with the factors
            in each step, with the same derivatives. Smaller ones become dense, or diagonals.

            M may be singular if M and C are arrays, and C damps all coordinates without mass, such as the node between
            a spring and a damper. This needs the `hht` family, whose smooth start never divides by M, and fixed steps,
            without events, held inputs and friction. q then has order 2, and so has v except for alpha = 0, where v of
            a weakly damped coordinate oscillates. Accelerations of such coordinates are 0 at the start, and tend to the
            correct ones like powers of the spectral radius at infinity. A coordinate without mass that only has springs
            follows the others, K22 q2 = f2 - K21 q1: eliminate it, or give it a damper, such as 1e-6 h K22.
        force: f, `force(t, params)`, a pytree structured like v; None for free vibration.
        nonlinear: g, `nonlinear(q, v, t, params)`, a pytree structured like v. With `at` it takes the coordinates q[at]
            and v[at], (k,) each, and returns the forces (k,) on these.
        at: k different indices of coordinates, in the order of `ravel_pytree(v)`.
        friction, sliding: dry friction, as for `System`: `friction(q, v, t, params)`, `sliding(q, v, t, params)`. The
            derivative of `sliding` in v must be the same for all q. Derivatives of the limits update the inverse, too.

    Raises:
        TypeError, ValueError: a matrix that is neither an array nor a function, or of a wrong shape, or not finite;
            `at` with indices that do not exist, or without `nonlinear`; `sliding` without `friction`.

    Example: a mass of 2 kg on a spring of 200 N/m, started from 0.1 m. One period is 0.628 s.

    >>> import jax.numpy as jnp, hhtjax
    >>> oscillator = hhtjax.LinearSystem(M=jnp.array([2.0]), C=None, K=lambda params: jnp.array([params["k"]]))
    >>> solution = hhtjax.simulate(
    ...     oscillator, hhtjax.hht(alpha=0.0), jnp.array([0.1]), jnp.array([0.0]), {"k": 200.0},
    ...     dt=6.2831853e-4, num_steps=1000)
    >>> round(float(solution.q[-1, 0]), 6)
    0.1

    A chain of 40 masses whose last mass hits a stop:

    >>> K = 2 * jnp.eye(40) - jnp.eye(40, k=1) - jnp.eye(40, k=-1)
    >>> def stop(q, v, t, params):
    ...     return -params["k"] * jnp.maximum(q - params["gap"], 0.0)
    >>> chain = hhtjax.LinearSystem(jnp.ones(40), 0.01 * K, K, nonlinear=stop, at=[39])
    >>> run = hhtjax.simulate(
    ...     chain, hhtjax.hht(), jnp.zeros(40), jnp.ones(40), {"k": 100.0, "gap": 0.5}, dt=0.02, num_steps=200)
    >>> bool(0.5 < run.q[:, -1].max() < 0.7)
    True
    """

    M: Any
    C: Any
    K: Any
    load: Callable | None
    nonlinear: Callable | None
    at: tuple[int, ...] | None
    friction: Callable | None
    sliding: Callable | None
    massless: Any  # G with M G M = M of a singular M, else None

    def __init__(
        self,
        M: PyTree,
        C: PyTree = None,
        K: PyTree = None,
        force=None,
        nonlinear=None,
        at: list | None = None,
        friction: Callable | None = None,
        sliding: Callable | None = None,
    ):
        for name, matrix in (("M", M), ("C", C), ("K", K)):
            if matrix is None and name != "M":
                pass
            elif callable(matrix):
                require_function("LinearSystem", name, matrix, f"{name}(params)")
            else:
                matrix = constant_matrix("LinearSystem", name, matrix, keep=True)
            object.__setattr__(self, name, matrix)
        known = [name for name in "MCK" if is_array(getattr(self, name)) or isinstance(getattr(self, name), Sparse)]
        for name in known[1:]:
            n, shape = len(getattr(self, known[0])), getattr(self, name).shape
            if shape[0] != n:
                raise ValueError(
                    f"LinearSystem: `{name}` must have shape ({n}, {n}), or ({n},) for a diagonal, to fit "
                    f"`{known[0]}`; received shape {shape}."
                )
        if any(isinstance(getattr(self, name), Sparse) for name in known):
            for name in known:
                object.__setattr__(self, name, of_dense(getattr(self, name)))
        massless = massless_inverse(self.M, self.C) if "M" in known else None
        object.__setattr__(self, "massless", massless)
        if "M" in known and massless is None:
            require_mass("LinearSystem", "M", self.M, way=UNDAMPED)
        if massless is not None and friction is not None:
            raise NotImplementedError("LinearSystem: with a singular `M`, leave `friction` out.")
        if force is not None:
            require_function("LinearSystem", "force", force, "force(t, params)")
        if nonlinear is not None:
            require_function("LinearSystem", "nonlinear", nonlinear, "nonlinear(q, v, t, params)")
        require_friction("LinearSystem", friction, sliding)
        object.__setattr__(self, "friction", friction)
        object.__setattr__(self, "sliding", sliding)
        object.__setattr__(self, "load", force)
        object.__setattr__(self, "nonlinear", nonlinear)
        size = len(getattr(self, known[0])) if known else None
        object.__setattr__(self, "at", None if at is None else _numbers_of_coordinates(at, nonlinear, size))

    constraint = None
    internal = None
    contact = None
    depending = False  # whether rows of `sliding` are known to depend on each other, or on constraints

    def mass(self, q: Array, params: PyTree):
        """M, for any q."""
        return self.M(params) if callable(self.M) else self.M

    def force(self, q: Array, v: Array, t: Array, params: PyTree) -> Array:
        """f(t) - C v - K q + g(q, v, t), a pytree structured like v."""
        Q = self.linear_force(q, v, t, params)
        if self.nonlinear is None:
            return Q
        Q, unravel = ravel_pytree(Q)
        return unravel(Q + self.spread(self.local_force(q, v, t, params), Q.size))

    def with_matrices(self, M, C, K) -> LinearSystem:
        """The system with these matrices instead of functions."""
        new = object.__new__(LinearSystem)
        for name, value in {**vars(self), "M": M, "C": C, "K": K}.items():
            object.__setattr__(new, name, value)
        return new

    def alone(self):
        """The matrices without any force."""
        new = object.__new__(LinearSystem)
        for name in vars(self):
            object.__setattr__(new, name, getattr(self, name) if name in "MCK" else None)
        return new

    def linear_force(self, q: Array, v: Array, t: Array, params: PyTree) -> Array:
        """f(t) - C v - K q, a pytree structured like v."""
        v, unravel = ravel_pytree(v)
        q, _ = ravel_pytree(q)
        Q = jnp.zeros_like(v) if self.load is None else ravel_pytree(self.load(t, params))[0]
        for matrix, x in ((self.C, v), (self.K, q)):
            if matrix is not None:
                Q = Q - matvec(as_matrix(matrix(params) if callable(matrix) else matrix, x.dtype), x)
        return unravel(Q)

    def local_force(self, q: Array, v: Array, t: Array, params: PyTree) -> Array:
        """g, (k,) on the coordinates `at`, or (n,)."""
        if self.at is not None:
            q, v = (ravel_pytree(x)[0][jnp.array(self.at)] for x in (q, v))
        assert self.nonlinear is not None
        return ravel_pytree(self.nonlinear(q, v, t, params))[0]

    def spread(self, x: Array, n: int) -> Array:
        """Values (k,) at the coordinates `at`, as a vector (n,)."""
        if self.at is None:
            return x
        place = np.full(n, len(self.at))
        place[list(self.at)] = np.arange(len(self.at))
        return jnp.append(x, jnp.zeros_like(x[:1]))[jnp.array(place)]  # no scatter, which would keep XLA from fusing


def _numbers_of_coordinates(at: list, nonlinear, size: int | None):
    """`at` as a tuple of integers; raises an error for anything else."""
    if nonlinear is None:
        raise ValueError(f"LinearSystem: `at` must go with a `nonlinear` force; received {at!r} alone.")
    try:
        found = tuple(require_integer("LinearSystem", "at", i, 0) for i in at)
    except TypeError:  # not a list
        found = ()
    if not found or len(set(found)) < len(found) or (size is not None and max(found) >= size):
        below = "" if size is None else f" below {size}"
        raise ValueError(
            f"LinearSystem: `at` must be a list of different numbers of coordinates{below}; received {at!r}."
        )
    return found


# ----------------------------------------------------------------------------
# Linear systems whose matrices stay sparse, or diagonal: what that asks for, and where there is none.


def shapes_of_matrices(caller: str, system: LinearSystem, params: PyTree):
    """The matrices that a linear system has, by name: their values, or the results of their functions."""
    given = {name: A for name in "MCK" if (A := getattr(system, name)) is not None}
    return {name: evaluate(caller, name, A, params) if callable(A) else A for name, A in given.items()}


def sparse_matrices(caller: str, system: LinearSystem | System | FirstOrderSystem, params: PyTree) -> dict:
    """The sparse matrices of a linear system, by name; empty for other systems."""
    found = shapes_of_matrices(caller, system, params) if isinstance(system, LinearSystem) else {}
    return {name: A for name, A in found.items() if isinstance(A, Sparse)}


def require_dense(caller: str, system: LinearSystem | System | FirstOrderSystem, params: PyTree):
    """Raises an error for a linear system with sparse matrices."""
    for name, A in sparse_matrices(caller, system, params).items():
        raise NotImplementedError(
            f"{caller}: `{name}` must be an array; received a sparse matrix of {len(A)} rows: "
            "hhtjax.analysis.modal_reduction reduces a system to its lowest modes, K.toarray() makes an array."
        )


def with_known_matrices(
    caller: str, system: LinearSystem, flat: FlatSystem, on_vectors: Callable, dtype: np.dtype, params: PyTree
) -> FlatSystem:
    """The flat system with its matrices kept sparse or diagonal, if they are.

    on_vectors: makes the flat system of a `LinearSystem`.
    """
    shapes = shapes_of_matrices(caller, system, params)

    def matrices(params: PyTree):
        given = {name: getattr(system, name) for name in shapes}
        found = {name: as_matrix(A(thaw(params)) if callable(A) else A, dtype) for name, A in given.items()}
        return [found.get(name) for name in "MCK"]

    if not any(isinstance(A, Sparse) for A in shapes.values()):
        are_diagonal = all(len(A.shape) == 1 for A in shapes.values())
        return _knowing(flat, diagonals=matrices) if are_diagonal else flat
    _require_sparse(caller, system, shapes)

    def settle(params: PyTree) -> FlatSystem:
        known = matrices(params)
        return _knowing(on_vectors(system.with_matrices(*known)), matrices=lambda params: known)

    return _knowing(flat, matrices=matrices)._replace(settle=settle)


def _require_sparse(caller: str, system: LinearSystem, shapes: dict):
    """Raises an error for what is not supported with sparse matrices."""
    for name, A in shapes.items():
        if not isinstance(A, Sparse) and len(A.shape) > 1:
            raise ValueError(
                f"{caller}: `{name}` must be sparse, too, or a diagonal (n,), beside a sparse matrix: "
                f"hhtjax.sparse makes one; received shape {A.shape}."
            )
    if system.friction is not None:
        raise NotImplementedError(f"{caller}: leave out `friction` beside sparse matrices, or hand over dense ones.")
    if system.nonlinear is not None and system.at is None:
        raise NotImplementedError(f"{caller}: name the coordinates of `nonlinear` by `at`: the matrices are sparse.")


def _knowing(flat: FlatSystem, **matrices: Callable) -> FlatSystem:
    """The system, and its linear part, with this function applied to its matrices."""
    local = None if flat.local is None else flat.local._replace(linear=flat.local.linear._replace(**matrices))
    return flat._replace(**matrices, local=local)
