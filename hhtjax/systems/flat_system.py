"""A system on vectors, as the steppers see it, and the checks of what its functions return."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from hhtjax.checks import describe
from hhtjax.description import freeze, thaw
from hhtjax.numerics.elimination import factorize, matvec
from hhtjax.numerics.linear_solve import solve
from hhtjax.systems import kinematics
from hhtjax.systems.matrices import as_matrix
from hhtjax.systems.system import FirstOrderSystem, LinearSystem


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
    local: Any = None  # the `Local` force beside a linear system

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


class Local(NamedTuple):
    """A nonlinear force beside a linear system."""

    linear: FlatSystem  # without it
    force: Callable  # q, v, t, params -> (k,), or (n,)
    spread: Callable  # (k,) -> (n,)
    size: int | None  # k; None where it acts on all coordinates


def flatten(caller, system, q0, v0, t0, params):
    """The system on vectors, and q0, v0 as vectors: the one place where pytrees are ravelled.

    Runs while tracing, so it checks shapes and structures and costs nothing at run time.
    """
    if isinstance(system, FirstOrderSystem):
        return _flatten_first_order(caller, system, q0, t0, params)
    q, unravel = ravel_pytree(q0)
    dtype = q.dtype
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
    _check_functions(caller, system, linear, n, dtype, q0, v0, t0, params)

    def mass(q, params):
        M = system.mass(unravel(q), params) if callable(system.mass) else system.mass
        return as_matrix(M, dtype)

    def force(q, v, t, params):
        return ravel_pytree(system.force(unravel(q), unravel_rates(v), t, params))[0].astype(dtype)

    product = None
    if not linear and system.inertia is not None:
        _check_like(caller, "inertia", _evaluate(caller, "inertia", system.inertia, q0, v0, params), "v0", v0, dtype)
        product = partial(_flat_product, system.inertia, unravel, unravel_rates, dtype)
    flat = FlatSystem(mass, force, n, linear, False, unravel, unravel_rates, constraint, m, blocks, product)
    return (_with_local(system, flat, dtype) if linear and system.nonlinear is not None else flat), q, v


def _with_local(system, flat, dtype):
    """The system with its nonlinear force kept apart, too."""

    def linear_force(q, v, t, params):
        Q = system.linear_force(flat.unravel(q), flat.unravel_rates(v), t, params)
        return ravel_pytree(Q)[0].astype(dtype)

    def local_force(q, v, t, params):
        return system.local_force(flat.unravel(q), flat.unravel_rates(v), t, params).astype(dtype)

    spread, size = partial(system.spread, n=flat.size), None if system.at is None else len(system.at)
    local = Local(flat._replace(force=linear_force), local_force, spread, size)
    return flat._replace(linear=False, local=local)


def _flatten_first_order(caller, system, y0, t0, params):
    """y' = rate is a system of unit mass whose velocity is y, and whose position is nothing."""
    y, unravel = ravel_pytree(y0)
    n, dtype = y.size, y.dtype
    _check_like(caller, "rate", _evaluate(caller, "rate", system.rate, y0, t0, params), "q0", y0, dtype)

    def rate(q, v, t, params):
        return ravel_pytree(system.rate(unravel(v), t, params))[0].astype(dtype)

    def mass(q, params):
        return jnp.ones(n, dtype)

    return FlatSystem(mass, rate, n, False, True, unravel, unravel), jnp.zeros_like(y), y


def _check_functions(caller, system, linear, n, dtype, q0, v0, t0, params):
    """Shapes of what the functions of a system return."""
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
        function = system.linear_force if linear else system.force
        Q = _evaluate(caller, "force", function, q0, v0, t0, params)
    _check_like(caller, "force", Q, "v0", v0, dtype)
    if linear and system.nonlinear is not None:
        _check_nonlinear(caller, system, n, dtype, q0, v0, t0, params)


def _check_nonlinear(caller, system, n, dtype, q0, v0, t0, params):
    """The force beside a linear system."""
    if system.at is None:
        like = "v0", v0
    elif max(system.at) >= n:
        raise ValueError(f"{caller}: `at` must hold numbers of coordinates below {n}; received {list(system.at)}.")
    else:
        some = jnp.zeros(len(system.at), dtype)
        q0, v0, like = some, some, ("v0[at]", some)
    _check_like(caller, "nonlinear", _evaluate(caller, "nonlinear", system.nonlinear, q0, v0, t0, params), *like, dtype)


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
        return jax.eval_shape(lambda *args: function(*thaw(args)), *freeze(args))
    except Exception as error:
        error.add_note(f"{caller}: raised while tracing `{name}` with " + ", ".join(describe(x) for x in args) + ".")
        raise
