"""What is simulated: M(q) w = Q(q, v, t), described by plain functions of pytrees."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from hhtjax.boundary import require_function
from hhtjax.description import Description, is_array, is_concrete, is_real
from hhtjax.linear_solve import factorize, matvec, solve


@dataclass(frozen=True, eq=False)
class System(Description):
    """A second-order mechanical system  M(q) w = Q(q, v, t)  with acceleration w.

    Args:
        mass: M, the generalised mass matrix: `mass(q, params)`, or an array where M is constant.
            Shape (n, n), symmetric positive definite, or (n,) for a diagonal. Its rows follow
            `jax.flatten_util.ravel_pytree(v)`; for a dict that is the order of the *sorted* keys.
        force: Q, the generalised force: `force(q, v, t, params)`, a pytree structured like v.
        constraint: Phi with Phi(q, t) = 0, `constraint(q, t, params)` -> (m,). Accepted, not yet solved:
            `simulate` raises `NotImplementedError`.

    q and v are pytrees of the same structure and shapes; n is their number of entries. Any consistent
    units do. A System is frozen and hashable; constant arrays in it are leaves of a pytree.

    Raises:
        TypeError: `mass`, `force` or `constraint` is not callable (or an array, for `mass`).
        ValueError: a constant `mass` of a wrong shape, or not finite.

    Example: a pendulum of length 2 m, with q the angle from the downward vertical in rad.

    >>> import jax.numpy as jnp, hhtjax
    >>> pendulum = hhtjax.System(
    ...     mass=lambda q, params: jnp.array([params["m"] * params["l"] ** 2]),
    ...     force=lambda q, v, t, params: -params["m"] * 9.81 * params["l"] * jnp.sin(q),
    ... )
    >>> solution = hhtjax.simulate(
    ...     pendulum, hhtjax.hht(alpha=-0.05), jnp.array([0.5]), jnp.array([0.0]), {"m": 1.0, "l": 2.0},
    ...     dt=1e-2, num_steps=100)
    >>> solution.q.shape
    (101, 1)
    """

    mass: Any
    force: Callable
    constraint: Callable | None = None

    def __post_init__(self):
        require_function("System", "force", self.force, "force(q, v, t, params)")
        if self.constraint is not None:
            require_function("System", "constraint", self.constraint, "constraint(q, t, params)")
        if callable(self.mass):
            require_function("System", "mass", self.mass, "mass(q, params)")
        else:
            object.__setattr__(self, "mass", _constant_matrix("System", "mass", self.mass))

    @classmethod
    def from_lagrangian(cls, lagrangian, force=None):
        """The system of Lagrange's equations  d/dt (dL/dv) - dL/dq = F, with M and Q by autodiff.

            M = d2L/dv2,    Q = F + dL/dq - (d2L/dv dq) v - d2L/dv dt

        Args:
            lagrangian: L = T - V, `lagrangian(q, v, t, params)`, a scalar. T must be quadratic in v, with
                a mass matrix that depends on q and params only: M is evaluated at v = 0, t = 0.
            force: F, the forces that no potential holds (damping, inputs): `force(q, v, t, params)`.

        Example: a mass on a spring, L = m v^2/2 - k q^2/2.

        >>> import hhtjax
        >>> spring = hhtjax.System.from_lagrangian(lambda q, v, t, p: 0.5 * p["m"] * v**2 - 0.5 * p["k"] * q**2)
        >>> float(spring.force(0.1, 0.0, 0.0, {"m": 2.0, "k": 30.0}))
        -3.0
        """
        require_function("System.from_lagrangian", "lagrangian", lagrangian, "lagrangian(q, v, t, params)")
        if force is not None:
            require_function("System.from_lagrangian", "force", force, "force(q, v, t, params)")
        return cls(_LagrangianMass(lagrangian), _LagrangianForce(lagrangian, force))


@dataclass(frozen=True)
class _LagrangianMass:
    """M(q) = d2L/dv2. A class and not a closure, so that equal Lagrangians give equal systems."""

    lagrangian: Callable

    def __call__(self, q, params):
        zero, unravel = ravel_pytree(jax.tree.map(jnp.zeros_like, q))
        return jax.hessian(lambda v: self.lagrangian(q, unravel(v), 0.0, params))(zero)


@dataclass(frozen=True)
class _LagrangianForce:
    """Q(q, v, t) = F + dL/dq - d/ds (dL/dv)(q + s v, t + s)."""

    lagrangian: Callable
    force: Callable | None

    def __call__(self, q, v, t, params):
        q, v = (jax.tree.map(jnp.asarray, x) for x in (q, v))
        t = jnp.asarray(t, jnp.result_type(*jax.tree.leaves(q)))

        def momentum(q, t):
            return jax.grad(self.lagrangian, argnums=1)(q, v, t, params)

        _, convective = jax.jvp(momentum, (q, t), (v, jnp.ones_like(t)))
        Q = jax.tree.map(jnp.subtract, jax.grad(self.lagrangian)(q, v, t, params), convective)
        return Q if self.force is None else jax.tree.map(jnp.add, Q, self.force(q, v, t, params))


@dataclass(frozen=True, eq=False, init=False)
class LinearSystem(Description):
    """The linear system  M w + C v + K q = f(t), whose step matrix is factorised once for a whole run.

    Args:
        M, C, K: mass, damping and stiffness: arrays (n, n), or (n,) for a diagonal, or functions of
            params that return them. C and K may be None. Rows follow `jax.flatten_util.ravel_pytree(v)`.
        force: f, `force(t, params)`, a pytree structured like v; None for free vibration.

    Raises:
        TypeError, ValueError: an argument that is neither, or an array of a wrong shape or not finite.

    Example: a mass of 2 kg on a spring of 200 N/m, started from 0.1 m. One period is 0.628 s.

    >>> import jax.numpy as jnp, hhtjax
    >>> oscillator = hhtjax.LinearSystem(M=jnp.array([2.0]), C=None, K=lambda params: jnp.array([params["k"]]))
    >>> solution = hhtjax.simulate(
    ...     oscillator, hhtjax.hht(alpha=0.0), jnp.array([0.1]), jnp.array([0.0]), {"k": 200.0},
    ...     dt=6.2831853e-4, num_steps=1000)
    >>> round(float(solution.q[-1, 0]), 6)
    0.1
    """

    M: Any
    C: Any
    K: Any
    load: Callable | None

    def __init__(self, M, C=None, K=None, force=None):
        for name, matrix in (("M", M), ("C", C), ("K", K)):
            if matrix is None and name != "M":
                pass
            elif callable(matrix):
                require_function("LinearSystem", name, matrix, f"{name}(params)")
            else:
                matrix = _constant_matrix("LinearSystem", name, matrix)
            object.__setattr__(self, name, matrix)
        if force is not None:
            require_function("LinearSystem", "force", force, "force(t, params)")
        object.__setattr__(self, "load", force)

    constraint = None

    def mass(self, q, params):
        """M, whatever q."""
        return self.M(params) if callable(self.M) else self.M

    def force(self, q, v, t, params):
        """f(t) - C v - K q, a pytree structured like v."""
        v, unravel = ravel_pytree(v)
        q, _ = ravel_pytree(q)
        Q = jnp.zeros_like(v) if self.load is None else ravel_pytree(self.load(t, params))[0]
        for matrix, x in ((self.C, v), (self.K, q)):
            if matrix is not None:
                Q = Q - matvec(_as_matrix(matrix(params) if callable(matrix) else matrix, x.dtype), x)
        return unravel(Q)


class FlatSystem(NamedTuple):
    """A system on vectors q (n,) and v (n,), as the steppers see it; made by `flatten`."""

    mass: Callable  # q, params -> (n, n), or (n,) for a diagonal
    force: Callable  # q, v, t, params -> (n,)
    size: int  # n
    linear: bool  # the residual is affine in (q, v, w), with constant coefficients
    unravel: Callable  # (n,) -> pytree structured like q and v

    def inertia(self, q, w, params):
        """M(q) w."""
        return matvec(self.mass(q, params), w)

    def acceleration(self, q, v, t, params, factorize=factorize):
        """w = M(q)^-1 Q(q, v, t)."""
        M, Q = self.mass(q, params), self.force(q, v, t, params)
        return Q / M if M.ndim == 1 else solve(M, Q, factorize)


class PrecisionWarning(UserWarning):
    """The state is in single precision."""


def initial_values(caller, q0, v0):
    """q0 and v0 as arrays of one float dtype, checked."""
    if not sum(np.size(x) for x in jax.tree.leaves(q0)):
        raise ValueError(f"{caller}: `q0` must hold at least one number; received {q0!r}.")
    structure = jax.tree.structure(q0)
    if jax.tree.structure(v0) != structure:
        raise ValueError(
            f"{caller}: `v0` must be a pytree structured like q0, {structure}; received {jax.tree.structure(v0)}."
        )
    dtypes = set()
    for name, values in (("q0", q0), ("v0", v0)):
        for path, leaf in jax.tree_util.tree_leaves_with_path(values):
            where = f"{caller}: `{name}{jax.tree_util.keystr(path)}`"
            if not is_array(leaf) and (isinstance(leaf, bool) or not isinstance(leaf, (int, float, complex))):
                raise TypeError(f"{where} must be an array or a number; received {leaf!r}.")
            dtype = getattr(leaf, "dtype", None) or np.result_type(leaf)
            if not is_real(leaf) or dtype in (jnp.float16, jnp.bfloat16):
                raise TypeError(f"{where} must be float32 or float64; received {dtype}.")
            if is_concrete(leaf) and not np.all(np.isfinite(leaf)):
                raise ValueError(f"{where} must be finite; received {leaf!r}.")
            if is_array(leaf) and jnp.issubdtype(dtype, jnp.floating):
                dtypes.add(jnp.result_type(leaf))  # what JAX makes of it: float32 without x64
    if jax.tree.map(jnp.shape, q0) != jax.tree.map(jnp.shape, v0):
        raise ValueError(f"{caller}: `v0` must have the shapes of q0, {describe(q0)}; received {describe(v0)}.")
    if len(dtypes) > 1:
        raise TypeError(f"{caller}: `q0` and `v0` must share one dtype; received {describe(q0)} and {describe(v0)}.")
    dtype = dtypes.pop() if dtypes else jnp.result_type(float)
    if dtype == jnp.float32:
        warnings.warn(
            f"{caller}: in float32 expect about 4 correct digits at best, fewer on stiff systems and small steps: "
            "for float64 call jax.config.update('jax_enable_x64', True) before creating arrays.",
            PrecisionWarning,
            stacklevel=3,
        )
    return (jax.tree.map(lambda x: jnp.asarray(x).astype(dtype), values) for values in (q0, v0))


def flatten(caller, system, q0, v0, t0, params):
    """The system on vectors, and q0, v0 as vectors: the one place where pytrees are ravelled.

    Runs while tracing, so it checks shapes and structures and costs nothing at run time.
    """
    q, unravel = ravel_pytree(q0)
    v, _ = ravel_pytree(v0)
    n, dtype = q.size, q.dtype
    if system.constraint is not None:
        raise NotImplementedError(
            f"{caller}: `constraint` is not solved yet: there is no stepper for Phi(q, t) = 0 in this version; "
            "use minimal coordinates and constraint=None."
        )

    if isinstance(system, LinearSystem):
        for name in ("M", "C", "K"):
            matrix = getattr(system, name)
            if matrix is not None:
                _check_matrix(caller, name, matrix, n, dtype, params)
    else:
        _check_matrix(caller, "mass", system.mass, n, dtype, q0, params)
    if isinstance(system, LinearSystem) and system.load is not None:
        Q = _evaluate(caller, "force", system.load, t0, params)
    else:
        Q = _evaluate(caller, "force", system.force, q0, v0, t0, params)
    if jax.tree.structure(Q) != jax.tree.structure(v0) or jax.tree.map(jnp.shape, Q) != jax.tree.map(jnp.shape, v0):
        raise ValueError(f"{caller}: `force` must return a pytree like v0, {describe(v0)}; received {describe(Q)}.")
    _check_dtype(caller, "force", Q, dtype)

    def mass(q, params):
        M = system.mass(unravel(q), params) if callable(system.mass) else system.mass
        return _as_matrix(M, dtype)

    def force(q, v, t, params):
        return ravel_pytree(system.force(unravel(q), unravel(v), t, params))[0].astype(dtype)

    return FlatSystem(mass, force, n, isinstance(system, LinearSystem), unravel), q, v


def _as_matrix(value, dtype):
    """(n, n) or (n,), of the dtype of the state; a scalar is the matrix of one degree of freedom."""
    return jnp.atleast_1d(jnp.asarray(value)).astype(dtype)


def _check_matrix(caller, name, matrix, n, dtype, *args):
    """A constant matrix, or the result of a function, of a shape that fits n and a dtype that fits the state."""
    value = _evaluate(caller, name, matrix, *args) if callable(matrix) else matrix
    shapes = [(n, n), (n,)] + [()] * (n == 1)
    if not (hasattr(value, "shape") and value.shape in shapes):
        raise ValueError(
            f"{caller}: `{name}` must give an array of shape ({n}, {n}), or ({n},) for a diagonal; "
            f"received {describe(value)}."
        )
    if callable(matrix):
        _check_dtype(caller, name, value, dtype)


def _check_dtype(caller, name, value, dtype):
    for leaf in jax.tree.leaves(value):
        found = jnp.result_type(leaf)
        number = jnp.issubdtype(found, jnp.integer) or (leaf.weak_type and jnp.issubdtype(found, jnp.floating))
        if found != dtype and not number:
            raise TypeError(
                f"{caller}: `{name}` returned {found} for a state of {dtype}; give params, and arrays made "
                f"inside `{name}`, the dtype of q0, or q0 and v0 the dtype of params."
            )


def _evaluate(caller, name, function, *args):
    """Shape of function(*args); `name` is added to what the function raises."""
    try:
        return jax.eval_shape(function, *args)
    except Exception as error:
        error.add_note(f"{caller}: raised while tracing `{name}` with " + ", ".join(describe(x) for x in args) + ".")
        raise


def describe(x):
    """A pytree in words: path, shape and dtype of each leaf."""
    words = []
    for path, leaf in jax.tree_util.tree_leaves_with_path(x):
        known = hasattr(leaf, "shape") or isinstance(leaf, (int, float, complex))
        what = f"shape {jnp.shape(leaf)} {jnp.result_type(leaf)}" if known else repr(leaf)
        words.append(f"{jax.tree_util.keystr(path)}: {what}" if path else what)
    return ", ".join(words) or "nothing"


def _constant_matrix(caller, name, received):
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
