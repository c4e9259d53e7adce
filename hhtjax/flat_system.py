"""A system on vectors, as the steppers see it, and the checks of what a user hands over."""

import warnings
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from hhtjax import kinematics
from hhtjax.description import is_array, is_concrete, is_real
from hhtjax.linear_solve import factorize, matvec, solve
from hhtjax.system import FirstOrderSystem, LinearSystem, as_matrix

ORTHOGONAL = 1e-6  # largest entry of R^T R - I that passes for a rotation; 100 roundings in float32


class FlatSystem(NamedTuple):
    """A system on vectors q and v (n,), as the steppers see it; made by `flatten`.

    q is (n,) too, but for rotations, of which it holds the matrices. A first-order system is one whose force
    depends on its velocity y alone. Its position is nobody's business, and stays zero.
    """

    mass: Callable  # q, params -> (n, n), or (n,) for a diagonal
    force: Callable  # q, v, t, params -> (n,)
    size: int  # n
    linear: bool  # the residual is affine in (q, v, w), with constant coefficients
    first_order: bool
    unravel: Callable  # vector -> pytree structured like q
    unravel_rates: Callable  # (n,) -> pytree structured like v
    constraint: Any = None  # q, t, params -> (m,); None without
    num_constraints: int = 0  # m
    blocks: tuple = ()  # where the rotations are; empty without
    product: Callable | None = None  # q, w, params -> M(q) w, where the system has its own

    def inertia(self, q, w, params):
        """M(q) w."""
        return matvec(self.mass(q, params), w) if self.product is None else self.product(q, w, params)

    def acceleration(self, q, v, t, params, factorize=factorize):
        """w = M(q)^-1 Q(q, v, t)."""
        M, Q = self.mass(q, params), self.force(q, v, t, params)
        return Q / M if M.ndim == 1 else solve(M, Q, factorize)

    def move(self, q, x):
        """q displaced by x (n,): q + x, and R exp(x) for rotations."""
        return kinematics.move(self.blocks, q, x)

    def rate(self, q, v):
        """qdot: v, and R hat(v) for rotations."""
        return kinematics.rate(self.blocks, q, v)

    def tidy(self, state):
        """The state at the end of a step, its rotations orthogonal to rounding."""
        return state._replace(q=kinematics.orthonormalize(self.blocks, state.q))


class PrecisionWarning(UserWarning):
    """The state is in single precision."""


def initial_values(caller, system, q0, v0):
    """q0 and v0 as arrays of one float dtype, checked; v0 is None for a first-order system."""
    first_order = isinstance(system, FirstOrderSystem)
    if first_order:
        if v0 is not None:
            raise ValueError(f"{caller}: `v0` must be left out for a FirstOrderSystem; received {v0!r}.")
        v0 = q0
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
    for (path, q), v in zip(jax.tree_util.tree_leaves_with_path(q0), jax.tree.leaves(v0), strict=True):
        if kinematics.is_rotation(jnp.shape(q), jnp.shape(v)):
            _require_rotations(f"{caller}: `q0{jax.tree_util.keystr(path)}`", q)
        elif jnp.shape(q) != jnp.shape(v):
            rotation = ", but (3,) for a rotation (3, 3)" if jnp.shape(q)[-2:] == (3, 3) else ""
            raise ValueError(
                f"{caller}: `v0` must have the shapes of q0, {describe(q0)}{rotation}; received {describe(v0)}."
            )
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
    q0, v0 = (jax.tree.map(lambda x: jnp.asarray(x).astype(dtype), values) for values in (q0, v0))
    return q0, None if first_order else v0


def _require_rotations(where, R):
    """An error for matrices that are not orthogonal, or are reflections; tracers pass."""
    if not is_concrete(R):
        return
    R = np.asarray(R)
    tolerance = max(ORTHOGONAL, 100 * np.finfo(R.dtype).eps) if R.dtype.kind == "f" else ORTHOGONAL
    error = np.max(np.abs(np.swapaxes(R, -1, -2) @ R - np.eye(3)))
    if error > tolerance:
        raise ValueError(
            f"{where} must be a rotation, because its velocity has 3 components; received a matrix R whose "
            f"R^T R differs from I by {error:.3g}: hhtjax.rotation.exp(psi) gives rotations."
        )
    if np.any(np.linalg.det(R) < 0):
        raise ValueError(f"{where} must be a rotation; received a reflection, det R = -1.")


def flatten(caller, system, q0, v0, t0, params):
    """The system on vectors, and q0, v0 as vectors: the one place where pytrees are ravelled.

    Runs while tracing, so it checks shapes and structures and costs nothing at run time.
    """
    q, unravel = ravel_pytree(q0)
    n, dtype = q.size, q.dtype
    if isinstance(system, FirstOrderSystem):
        _check_like(caller, "rate", _evaluate(caller, "rate", system.rate, q0, t0, params), "q0", q0, dtype)

        def rate(q, v, t, params):
            return ravel_pytree(system.rate(unravel(v), t, params))[0].astype(dtype)

        def mass(q, params):
            return jnp.ones(n, dtype)

        return FlatSystem(mass, rate, n, False, True, unravel, unravel), jnp.zeros_like(q), q

    v, unravel_rates = ravel_pytree(v0)
    n, blocks = v.size, kinematics.layout(q0, v0)
    if blocks and (isinstance(system, LinearSystem) or getattr(system.mass, "is_lagrangian", False)):
        raise NotImplementedError(
            f"{caller}: rotations in `q0` need a System(mass, force): they are no linear coordinates, and "
            "from_lagrangian knows no others."
        )
    constraint, m = None, 0
    if system.constraint is not None:
        m = _count_constraints(caller, system.constraint, n, dtype, q0, t0, params)
        constraint = partial(_flat_constraint, system.constraint, unravel, dtype)

    linear = isinstance(system, LinearSystem)
    if linear:
        for name in ("M", "C", "K"):
            matrix = getattr(system, name)
            if matrix is not None:
                _check_matrix(caller, name, matrix, n, dtype, params)
    else:
        _check_matrix(caller, "mass", system.mass, n, dtype, q0, params)
    if linear and system.load is not None:
        Q = _evaluate(caller, "force", system.load, t0, params)
    else:
        Q = _evaluate(caller, "force", system.force, q0, v0, t0, params)
    _check_like(caller, "force", Q, "v0", v0, dtype)

    def mass(q, params):
        M = system.mass(unravel(q), params) if callable(system.mass) else system.mass
        return as_matrix(M, dtype)

    def force(q, v, t, params):
        return ravel_pytree(system.force(unravel(q), unravel_rates(v), t, params))[0].astype(dtype)

    product = None
    if not linear and system.inertia is not None:
        _check_like(caller, "inertia", _evaluate(caller, "inertia", system.inertia, q0, v0, params), "v0", v0, dtype)
        product = partial(_flat_product, system.inertia, unravel, unravel_rates, dtype)
    return FlatSystem(mass, force, n, linear, False, unravel, unravel_rates, constraint, m, blocks, product), q, v


def _flat_constraint(constraint, unravel, dtype, q, t, params):
    return jnp.asarray(constraint(unravel(q), t, params)).astype(dtype)


def _flat_product(inertia, unravel, unravel_rates, dtype, q, w, params):
    return ravel_pytree(inertia(unravel(q), unravel_rates(w), params))[0].astype(dtype)


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


def _count_constraints(caller, constraint, n, dtype, *args):
    """m, for a constraint that returns (m,) with m <= n."""
    value = _evaluate(caller, "constraint", constraint, *args)
    if not hasattr(value, "shape") or len(value.shape) != 1 or not 1 <= value.shape[0] <= n:
        raise ValueError(
            f"{caller}: `constraint` must return an array (m,) with 1 <= m <= {n}, the number of coordinates; "
            f"received {describe(value)}."
        )
    _check_dtype(caller, "constraint", value, dtype)
    return value.shape[0]


def _check_like(caller, name, value, like, reference, dtype):
    """What a function returned, of the structure, the shapes and a dtype that fit the state."""
    if jax.tree.structure(value) != jax.tree.structure(reference) or (
        jax.tree.map(jnp.shape, value) != jax.tree.map(jnp.shape, reference)
    ):
        raise ValueError(
            f"{caller}: `{name}` must return a pytree like {like}, {describe(reference)}; received {describe(value)}."
        )
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
