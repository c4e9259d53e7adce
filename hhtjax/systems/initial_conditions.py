"""Initial values: their checks, and values that satisfy the constraints."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from copy import copy
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.checks import describe, require_number, require_params
from hhtjax.description import Array, PyTree, Real, all_concrete, is_array, is_concrete, is_real, known_now
from hhtjax.description.presentation import shown
from hhtjax.numerics.dense_lu import diagonal, full_matrix
from hhtjax.numerics.differentiable_while import implicit_root
from hhtjax.numerics.linear_solve import RANK_TOLERANCE, solve_map
from hhtjax.systems import kinematics
from hhtjax.systems.assembly import ElementForce
from hhtjax.systems.constraints import (
    acceleration_and_multipliers,
    check_redundant,
    factorize_constrained,
    gradient,
    jacobian,
    require_independent,
    saddle_point,
    violation,
)
from hhtjax.systems.flat_system import flatten
from hhtjax.systems.friction import directions
from hhtjax.systems.start_of_elements import require_consistent_elements
from hhtjax.systems.system import AnySystem, FirstOrderSystem
from hhtjax.xla import Programs

if TYPE_CHECKING:
    from hhtjax.systems.flat_system import FlatSystem
    from hhtjax.systems.linear_system import LinearSystem
    from hhtjax.systems.system import System

CONSISTENT = 1e-6  # distance of initial values from consistent ones that passes, beside 1 + |q|, each coordinate
SMALL = 1e-3  # of a mechanism's size, if that is so small that the former does not tell
ROUNDINGS = 1000  # of q, which nobody asks about
CHECKED = ("q0", "Phi"), ("v0", "dPhi/dt")
SINGLE_OR_DOUBLE = frozenset([np.dtype(np.float32), np.dtype(np.float64)])


@shown
class ConsistentInitial(NamedTuple):
    """Initial values on the constraints; made by `consistent_initial`.

    Attributes:
        q, v, acceleration: pytrees like q0 and v0.
        multipliers: L, (m,).
        converged: whether a point with Phi(q) = 0 was found.
        moved: the distance of q from q0 in the coordinate that moved farthest, in its unit, radians for rotations. If
            it is larger than you expect, q may belong to another assembly of the mechanism.
    """

    q: PyTree
    v: PyTree
    acceleration: PyTree
    multipliers: Any
    converged: Array
    moved: Array | None = None


def consistent_initial(
    system: AnySystem,
    q0: PyTree,
    v0: PyTree,
    params: PyTree = None,
    t0: Real = 0.0,
    redundant: str | None = None,
    z0: PyTree = None,
) -> ConsistentInitial:
    """The values nearest to q0 and v0 that satisfy the constraints, with their acceleration and multipliers.

        min |q - q0|_M with Phi(q, t0) = 0,     min |v - v0|_M with B v + Phi_t = 0,     |x|_M^2 = x^T M x

    M is evaluated at q0 for the first problem, at q for the second. The acceleration solves M w = Q + B^T L with a
    second time derivative of Phi that is zero.

    Args:
        system: a `System` with a constraint. q0, v0, params, t0: as in `simulate`.
        redundant: "least_squares" for constraints that may depend on each other, as in `hht`.
        z0: internal states, if the system has any. They enter the forces and do not change.

    The search for q approaches both the constraints and q0. Newton's method alone would end at an arbitrary point when
    it starts far away. If the constraints are curved on the way, the result is the nearest of up to 24 searches. A
    nearer point may exist; `moved` is the distance. Differentiable, forward and reverse. Under jit no error is raised:
    check `converged`.

    Returns:
        A `ConsistentInitial`.

    Raises:
        TypeError, ValueError: an argument of a wrong kind or value; a system without a constraint; constraints that
            depend on each other (or on no coordinate) at q0; no q found.

    >>> import jax.numpy as jnp, hhtjax
    >>> pendulum = hhtjax.System(
    ...     mass=jnp.ones(2),
    ...     force=lambda q, v, t, params: jnp.array([0.0, -9.81]),
    ...     constraint=lambda q, t, params: jnp.array([jnp.sqrt(jnp.sum(q**2)) - 2.0]))
    >>> start = hhtjax.consistent_initial(pendulum, jnp.array([0.0, -2.1]), jnp.array([1.0, 0.3]))
    >>> [round(float(x), 6) for x in (*start.q, *start.v, *start.multipliers)]        # m v^2/l + m g in tension
    [0.0, -2.0, 1.0, 0.0, -10.31]
    """
    if getattr(system, "constraint", None) is None:
        raise ValueError("consistent_initial: `system` must have a constraint.")
    check_redundant("consistent_initial", redundant)
    params = require_params("consistent_initial", params)
    require_number("consistent_initial", "t0", t0, np.isfinite, "be finite")
    q0, v0, z0 = initial_values("consistent_initial", system, q0, v0, z0)
    start, rows, left = _consistent_initial(system, q0, v0, params, t0, z0, redundant)
    if all_concrete((start, rows)):
        if redundant is None:
            require_independent("consistent_initial", *map(np.asarray, rows))
        if not start.converged:
            raise ValueError(
                f"consistent_initial: no q with Phi(q, t) = 0 found near `q0`: {left:.3g} is left of it. Start nearer."
            )
    return start


@partial(Programs, static_argnames="redundant")
def _consistent_initial(system: System, q0: PyTree, v0: PyTree, params: PyTree, t0: Array, z0: PyTree, redundant):
    """The result; B at q0 and which of its rows are independent; and max|Phi| at the end."""
    flat, q, v = flatten("consistent_initial", system, q0, v0, t0, params, z0)
    factorize = factorize_constrained(flat.size, redundant)
    t = jnp.asarray(t0).astype(q.dtype)
    rows = gradient(flat, q, t, params)
    q, x, converged = nearest_position(flat, q, t, params, factorize)
    left = jnp.max(jnp.abs(flat.constraint(q, t, params)))
    v = v + correction(flat, q, t, params, -violation(flat, q, v, t, params)[1], factorize)
    w, L = acceleration_and_multipliers(flat, q, v, t, params, factorize)
    v, w = (flat.unravel_rates(flat.located(x)) for x in (v, w))
    moved = jnp.max(jnp.abs(flat.located(x)))
    return ConsistentInitial(flat.unravel(q), v, w, L, converged, moved), rows, left


def correction(system: FlatSystem, q: Array, t: Array, params: PyTree, rows: Array, factorize: Callable) -> Array:
    """The solution x of B x = rows with the smallest M-norm."""
    return saddle_point(system, q, t, params, factorize)(jnp.zeros(system.size, q.dtype), rows)[0]


@Programs
def examine(system: System, q0: PyTree, v0: PyTree, t0: Array, params: PyTree, z0: PyTree):
    """M and B, Phi and dPhi/dt, the sizes of coordinates and rates, and which rows of B are independent."""
    flat, q, v = flatten("simulate", system, q0, v0, t0, params, z0)
    t = jnp.asarray(t0).astype(q.dtype)
    M, (B, clear) = flat.mass(q, t, params), gradient(flat, q, t, params)
    sizes = kinematics.sizes(flat.blocks, q), flat.located(jnp.abs(v))
    M = full_matrix(M)
    return M, B[:, : flat.positions], violation(flat, q, v, t, params), sizes, clear


def distances(examined: tuple, redundant):
    """For Phi and for dPhi/dt: the violation, and the distance of q0 or v0 from consistent values, as the largest over
    coordinates, the largest relative to the coordinate's size, and for each coordinate. By NumPy, which compiles
    nothing."""
    M, B, both, sizes, _ = jax.tree.map(np.asarray, examined)
    n, end = M.shape[-1], M.shape[-1] + B.shape[-2]
    A = np.zeros((*M.shape[:-2], end, end), M.dtype)
    A[..., :n, :n], A[..., n:, :n], A[..., :n, n:] = M, B, -np.swapaxes(B, -1, -2)
    for x, size in zip(both, sizes, strict=True):
        b = np.concatenate([np.zeros_like(size), x], axis=-1)
        away = np.abs(_solved(A, b, n, redundant)[..., :n])
        yield *(np.max(y, axis=-1) for y in (np.abs(x), away, away / (1 + size))), away


@np.errstate(all="ignore")
def _solved(A: np.ndarray, b: np.ndarray, n: int, redundant) -> np.ndarray:
    """The solution z of A z = b, the smallest one if constraints may be redundant; NaN if there is none. Batch axes
    come first."""
    try:
        if redundant is None:
            return np.linalg.solve(A, b[..., None])[..., 0]
        d = np.abs(np.diagonal(A, axis1=-2, axis2=-1))[..., :n]
        first = 1 / np.sqrt(np.where(d == 0, 1, d))
        size = np.max(np.abs(first[..., None] * A[..., :n, n:]), axis=(-2, -1))[..., None]
        rest = 1 / np.where(size == 0, 1, size)
        scale = np.concatenate([first, np.broadcast_to(rest, (*rest.shape[:-1], A.shape[-1] - n))], axis=-1)
        tolerance = max(RANK_TOLERANCE, 100 * float(np.finfo(A.dtype).eps))
        inverse = np.linalg.pinv(scale[..., :, None] * A * scale[..., None, :], rcond=tolerance)
        return scale * (inverse @ (scale * b)[..., None])[..., 0]
    except np.linalg.LinAlgError:
        if b.ndim == 1:
            return np.full_like(b, np.nan)
        return np.stack([_solved(*one, n, redundant) for one in zip(A, b, strict=True)])


def require_consistent(
    caller: str,
    system,
    q0: PyTree,
    v0: PyTree,
    t0: Real,
    params: PyTree,
    redundant=None,
    z0: PyTree = None,
    checked: tuple = CHECKED,
):
    """Raises an error if q0 or v0 violates the constraints beyond rounding, or these are dependent; tracers pass.

    checked: the names of the caller's arguments for q0, and for v0 if it is to be checked, and what they violate.
    """
    if redundant is None and isinstance(getattr(system, "force", None), ElementForce):
        return require_consistent_elements(caller, (system, q0, v0, t0, params, z0), checked, CONSISTENT)
    examined = known_now(examine, system, q0, v0, t0, params, z0)
    if examined is None:
        return
    if redundant is None:
        require_independent(caller, examined[1], examined[4])
    found = distances(examined, redundant)
    floors = ROUNDINGS * np.finfo(examined[1].dtype).eps, SMALL  # that v0 is, is no error while it is small beside v0
    for (name, meaning), floor, sizes, values in zip(checked, floors, examined[3], found, strict=False):
        violated, distance, relative, away = values
        small = relative <= CONSISTENT
        beside = floor * np.max(sizes)
        if not small or (np.any(away > beside) and _is_far(examined[1], away, (system, q0, v0, t0, params, z0))):
            beside = ", which is much in so small a mechanism" if small else ""
            raise ValueError(
                f"{caller}: `{name}` violates the constraint: max|{meaning}| = {violated:.3g}, {distance:.3g} away "
                f"from consistent values{beside}; hhtjax.consistent_initial gives them."
            )


def _is_far(B, away, start):
    """Whether a displacement of this size, or one per unit of time, turns the gradient of a constraint by more than
    SMALL. Only this shows the size of a mechanism. Called for displacements above rounding."""
    found = known_now(_turns, *start)
    assert found is not None  # as what was examined
    turns, d = found
    return bool(np.any(turns * np.max(np.where(B == 0, 0, np.sqrt(d) * away), axis=1) > SMALL))


@Programs
def _turns(system, q0: PyTree, v0: PyTree, t0, params: PyTree, z0: PyTree):
    """How much a displacement of size 1 turns the gradient of each constraint, in the norm of diag(M); the norm."""
    flat, q, _ = flatten("simulate", system, q0, v0, t0, params, z0)
    t = jnp.asarray(t0).astype(q.dtype)
    d = diagonal(flat.mass(q, t, params))
    d = jnp.where(d == 0, 1, d)
    d = d / jnp.min(d)  # which may be too small to be squared
    unit = flat.with_ones(1 / jnp.sqrt(d))
    # one direction for all constraints, of no symmetry: along an axis many of them turn nothing
    uneven = np.where(np.arange(flat.size) % 2, -1, 1) * (0.75 + 0.618034 * np.arange(flat.size) % 0.5)
    along = flat.rate(q, unit * jnp.asarray(uneven, q.dtype))
    B, change = (x * unit[None, :] for x in jax.jvp(lambda q: jacobian(flat, q, t, params), (q,), (along,)))
    return jnp.linalg.norm(change, axis=1) / jnp.linalg.norm(B, axis=1), d


# ----------------------------------------------------------------------------
# Initial values: the checks of what a user hands over.


ORTHOGONAL = 1e-6  # largest entry of R^T R - I that passes for a rotation; 100 roundings in float32


class PrecisionWarning(UserWarning):
    """The state is in single precision."""


def initial_values(caller: str, system, q0: PyTree, v0: PyTree, z0: PyTree = None, level: int = 3):
    """q0, v0 and z0 as arrays of one float dtype, checked; those that the system does not have are None."""
    first_order = isinstance(system, FirstOrderSystem)
    if first_order:
        if v0 is not None:
            raise ValueError(f"{caller}: `v0` must be left out for a FirstOrderSystem; received {v0!r}.")
        v0 = q0
    _require_internal(caller, system, z0)
    (in_q, structure), (in_v, of_v), (in_z, of_z) = map(jax.tree_util.tree_flatten_with_path, (q0, v0, z0))
    if not any(np.size(x) for _, x in in_q):
        raise ValueError(f"{caller}: `q0` must hold at least one number; received {q0!r}.")
    if of_v != structure:
        raise ValueError(f"{caller}: `v0` must be a pytree structured like q0, {structure}; received {of_v}.")
    dtypes = set()
    for name, leaves in (("q0", in_q), ("v0", in_v), ("z0", in_z)):
        for path, leaf in leaves:
            dtype = _require_finite(caller, name, path, leaf)
            if is_array(leaf) and dtype.kind == "f":
                dtypes.add(jax.dtypes.canonicalize_dtype(dtype))  # what JAX makes of it: float32 without x64
    for (path, q), (_, v) in zip(in_q, in_v, strict=True):
        a, b = np.shape(q), np.shape(v)
        if kinematics.is_rotation(a, b):
            _require_rotations(f"{caller}: `q0{jax.tree_util.keystr(path)}`", q)
        elif a != b:
            turns = a[-2:] == (3, 3) or (a[-1:], b[-1:]) == ((4,), (3,))  # or is a quaternion
            rotation = ", but (3,) for a rotation, a matrix (3, 3)" if turns else ""
            column = " Is q0 short of an axis? For one coordinate write q0[:, None]." if a == b[:-1] else ""
            raise ValueError(
                f"{caller}: `v0` must have the shapes of q0, {describe(q0)}{rotation}; received {describe(v0)}.{column}"
            )
    dtype = _the_one(caller, dtypes, q0, v0, z0) if dtypes else jnp.result_type(float)
    if dtype == jnp.float32:
        warnings.warn(
            f"{caller}: in float32 expect about 4 correct digits at best, fewer on stiff systems and small steps: "
            "for float64 call jax.config.update('jax_enable_x64', True) before creating arrays.",
            PrecisionWarning,
            stacklevel=level,
        )
    q0, v0, z0 = (
        of.unflatten([_as_state(x, dtype) for _, x in leaves])
        for of, leaves in ((structure, in_q), (of_v, in_v), (of_z, in_z))
    )
    return q0, None if first_order else v0, z0


def _as_state(x: Real, dtype: np.dtype) -> Array:
    """An array of JAX with this dtype; the same array if it has it already, since a conversion takes 7 us."""
    return x if isinstance(x, jax.Array) and x.dtype == dtype and not x.weak_type else jnp.asarray(x, dtype)


def _the_one(caller: str, dtypes, q0: PyTree, v0: PyTree, z0: PyTree) -> np.dtype:
    """The dtype that all of them share; raises an error if they differ."""
    if len(dtypes) > 1:
        names = "`q0` and `v0`" if z0 is None else "`q0`, `v0` and `z0`"
        received = " and ".join(describe(x) for x in (q0, v0, z0) if x is not None)
        raise TypeError(f"{caller}: {names} must share one dtype; received {received}.")
    return dtypes.pop()


def _require_internal(caller: str, system: LinearSystem | System, z0: PyTree):
    """Raises an error for a z0 that is missing, or given to a system without internal states."""
    if system.internal is None:
        if z0 is not None:
            raise ValueError(f"{caller}: leave `z0` out: the system has no internal states; received {z0!r}.")
    elif z0 is None:
        raise ValueError(f"{caller}: `z0` must be given: the system has internal states.")
    elif not sum(np.size(x) for x in jax.tree.leaves(z0)):
        raise ValueError(f"{caller}: `z0` must hold at least one number; received {z0!r}.")


def _require_finite(caller: str, name: str, path: tuple, leaf: Real) -> np.dtype:
    """The dtype of a leaf; raises an error unless it holds finite numbers of single or double precision."""
    is_float = is_array(leaf) and leaf.dtype in SINGLE_OR_DOUBLE
    if is_float and (not is_concrete(leaf) or np.isfinite(np.asarray(leaf)).all()):
        return leaf.dtype
    where = f"{caller}: `{name}{jax.tree_util.keystr(path)}`"
    if not is_array(leaf) and (isinstance(leaf, bool) or not isinstance(leaf, (int, float, complex))):
        raise TypeError(f"{where} must be an array or a number; received {leaf!r}.")
    dtype = getattr(leaf, "dtype", None) or np.result_type(leaf)
    if not is_real(leaf) or dtype in (jnp.float16, jnp.bfloat16):
        raise TypeError(f"{where} must be float32 or float64; received {dtype}.")
    if is_concrete(leaf) and not np.all(np.isfinite(leaf)):
        raise ValueError(f"{where} must be finite; received {leaf!r}.")
    return dtype


def _require_rotations(where: str, R):
    """Raises an error for matrices that are not orthogonal, or are reflections; tracers pass."""
    if not is_concrete(R):
        return
    R = np.asarray(R)
    tolerance = max(ORTHOGONAL, 100 * np.finfo(R.dtype).eps) if R.dtype.kind == "f" else ORTHOGONAL
    error = np.max(np.abs(np.swapaxes(R, -1, -2) @ R - np.eye(3)), initial=0)
    if error > tolerance:
        raise ValueError(
            f"{where} must be a rotation, because its velocity has 3 components; received a matrix R whose "
            f"R^T R differs from I by {error:.3g}: hhtjax.rotation.exp(psi) gives rotations."
        )
    if np.any(np.linalg.det(R) < 0):
        raise ValueError(f"{where} must be a rotation; received a reflection, det R = -1.")


# ----------------------------------------------------------------------------
# Whether directions of friction depend on each other, or on constraints, at the start.


DEPENDENT = 1e-6  # relative size of what is left of a row, below which it is rounding


@jax.jit
def _rows(system: System, q0: PyTree, v0: PyTree, t0: Array, params: PyTree, z0: PyTree):
    """B and H at the start, and how much H changes elsewhere."""
    flat, q, _ = flatten("simulate", system, q0, v0, t0, params, z0)
    t = jnp.asarray(t0).astype(q.dtype)
    B = jacobian(flat, q, t, params) if flat.num_constraints else jnp.zeros((0, flat.size), q.dtype)
    H = directions(flat, q, t, params)
    if not (flat.linear or flat.local):
        return B, H, jnp.zeros_like(H)
    elsewhere = q + 1 + jnp.arange(q.size, dtype=q.dtype) / q.size
    return B, H, directions(flat, elsewhere, t, params) - H


def with_known_rows(
    caller: str, system, q0: PyTree, v0: PyTree, t0: Real, params: PyTree, z0: PyTree = None
) -> LinearSystem | System:
    """The system, marked if directions of friction depend on each other or on constraints. Raises an error for
    directions that are zero or not finite. Nothing is known of tracers."""
    rows = known_now(_rows, system, q0, v0, t0, params, z0)
    if rows is None:
        return system
    B, H, change = rows
    if not np.all(np.isfinite(H)):
        raise ValueError(f"{caller}: `sliding` has no finite derivative in v at the start.")
    if np.max(np.abs(change)) > DEPENDENT * np.max(np.abs(H)):
        raise ValueError(
            f"{caller}: `sliding` of a LinearSystem must have the same derivative in v for all q: else take a System."
        )
    for i in np.flatnonzero(~np.any(H, axis=1))[:1]:
        raise ValueError(f"{caller}: row {i} of `sliding` does not depend on v: friction there does nothing.")
    if not _depend(B, H):
        return system
    marked = copy(system)
    object.__setattr__(marked, "depending", True)
    return marked


def _depend(B: np.ndarray, H: np.ndarray) -> bool:
    """Whether a row of H depends on the rows before it, or on the rows of B."""
    basis = np.zeros((0, H.shape[1]))
    if B.size:
        _, sizes, basis = np.linalg.svd(B, full_matrices=False)
        basis = basis[sizes > DEPENDENT * sizes[0]]  # constraints may be redundant
    for row in H:
        left = row
        for _ in range(2):  # once more, for what rounding leaves
            left = left - basis.T @ (basis @ left)
        if np.linalg.norm(left) <= DEPENDENT * np.linalg.norm(row):
            return True
        basis = np.vstack([basis, left / np.linalg.norm(left)])
    return False


# ----------------------------------------------------------------------------
# The position nearest to a guess that satisfies the constraints: sequential quadratic programs, from several starts.
#
#     min |x|_M^2/2 with Phi(q0 (+) x) = 0
#
# A step solves with the Hessian of the Lagrangian where that is convex on the constraints, else with M, the one of
# Gauss and Newton. It is shortened until  |x|_M^2/2 + rho |Phi|_1  falls; rho exceeds the multipliers, so that the
# minimum of the sum is the one with constraints. A full step that fails only because the constraints are curved gets a
# correction (Fletcher 1982). Newton's iteration alone, from far away, ends at any stationary point, the farthest one
# among them.
#
# Where the constraints bend between the guess and what is found there may be a nearer one: others are sought, from
# starts inside the ball that ends there. Near a guess that fits, where the constraints are almost linear, the first one
# is it.
#
# J. Nocedal, S. Wright, Numerical Optimization, Ch. 18.


STARTS = 24
PARTS = 1.0, 0.5, 0.25  # of the distance found, in turn, at which other starts are
MAX_ITERATIONS = 60
HALVINGS = 12
DECREASE = 1e-4  # of what the slope promises, which a step has to bring (Armijo)
WEIGHT = 1e3  # of the constraints, beside the Hessian of which convexity on them is asked (Debreu 1952)
BENT = 0.1  # of Phi(q0), what either end's slope may miss of it where the first point found is taken for the nearest


class Problem(NamedTuple):
    """The values at the initial guess that the search uses."""

    conditions: Any  # z -> (M x - B^T mu, Phi)
    constraint: Any  # x -> Phi
    M: Array
    d: Array  # the diagonal of M, ones in the place of zeros
    unit: Array  # (m,), makes distances of Phi
    Phi: Array  # at the guess
    B: Any
    size: Array  # of the largest coordinate
    reach: Array  # of all of them, in the norm of M
    factorize: Any


def nearest_position(system: FlatSystem, q0: PyTree, t: Array, params: PyTree, factorize: Callable):
    """q on Phi = 0 whose displacement x from q0 has the smallest norm of M(q0); x, and whether the search converged.

    Derivatives follow from the conditions for a minimum.
    """
    n, eps = system.size, float(jnp.finfo(q0.dtype).eps)

    def constraint(x: Array) -> Array:
        return system.constraint(system.move(q0, x), t, params)

    def conditions(z: Array) -> Array:
        x, mu = z[:n], z[n:]
        Phi, pull = jax.vjp(constraint, x)
        return jnp.concatenate([system.inertia(q0, x, t, params) - pull(mu)[0], Phi])

    def search(z: Array):
        problem = lax.stop_gradient(_problem(system, q0, t, params))
        return _search(problem._replace(conditions=conditions, constraint=constraint, factorize=factorize), z)

    z0 = jnp.zeros(n + system.num_constraints, q0.dtype)
    z, found = implicit_root(conditions, z0, search, lambda g, y: solve_map(g, y, factorize))
    return system.move(q0, z[:n]), z[:n], found > math.sqrt(eps)


def _problem(system: FlatSystem, q0: PyTree, t: Array, params: PyTree) -> Problem:
    """Sizes and derivatives at the guess."""
    M, B = system.full_mass(q0, t, params), jacobian(system, q0, t, params)
    d = diagonal(M)
    d = jnp.where(d == 0, 1, d)
    row = jnp.sqrt(jnp.sum(B**2 / d[None, :], axis=1))
    sizes = system.with_internal(jnp.zeros_like(d), jnp.zeros_like(d))
    sizes = sizes.at[: system.positions].set(kinematics.sizes(system.blocks, q0))
    Phi = system.constraint(q0, t, params)
    return Problem(
        None, None, M, d, 1 / jnp.where(row == 0, 1, row), Phi, B, jnp.max(sizes), jnp.sqrt(jnp.sum(d * sizes**2)), None
    )


def _search(p: Problem, z0: PyTree):
    """The nearest of the points that were found, and 1 if one was found, else 0, as a float for autodiff."""
    n, eps = len(p.d), float(jnp.finfo(z0.dtype).eps)
    ways = np.random.default_rng(0).standard_normal((STARTS, n))
    ways *= np.resize(PARTS, (STARTS, 1)) / np.linalg.norm(ways, axis=1, keepdims=True)
    ways = jnp.asarray(ways, z0.dtype).at[0].set(0)  # the first is the guess itself
    apart = jnp.sum(p.unit * jnp.abs(p.Phi))

    def unfinished(carry: tuple) -> Array:
        _, _, found, certain, i = carry
        return ~(found & certain) & (i < STARTS)

    def again(carry: tuple):
        best, distance, found, _, i = carry
        radius = jnp.where(found, distance, jnp.maximum(apart, jnp.where(i > 0, jnp.sqrt(jnp.sum(p.d)), 0)))
        z, converged = _descend(p, z0.at[:n].set(radius * ways[i] / jnp.sqrt(p.d)))
        x = z[:n]
        away = jnp.sqrt(jnp.abs(x @ (p.M @ x)))
        better = converged & (away < distance)
        best = jnp.where(better | (i == 0), z, best)
        distance, found, x = jnp.where(better, away, distance), found | converged, best[:n]
        slopes = p.B, jax.jacfwd(p.constraint)(x)
        missed = jnp.stack([jnp.sum(p.unit * jnp.abs(p.Phi + B @ x)) for B in slopes])
        certain = (jnp.max(missed) <= BENT * apart) | (apart <= 1e3 * eps * p.reach)
        return best, distance, found, certain, i + 1

    far, no = jnp.asarray(jnp.inf, z0.dtype), jnp.array(False)
    best, _, found, *_ = lax.while_loop(unfinished, again, (z0, far, no, no, 0))
    return best, found.astype(z0.dtype)


def _descend(p: Problem, z0: PyTree):
    """The point where the steps from z0 end, and whether it lies on the constraints."""
    n, eps = len(p.d), float(jnp.finfo(z0.dtype).eps)

    def largest(z: Array) -> Array:
        return p.size + jnp.max(jnp.abs(z[:n]))

    def unfinished(carry: tuple) -> Array:
        z, _, change, last, i = carry
        ends = change <= 16 * eps * (largest(z) + jnp.where(change > last / 2, 1, 0))
        return ~ends & ~jnp.isnan(change) & (i < MAX_ITERATIONS)

    def improve(carry: tuple):
        z, rho, last, _, i = carry
        z, rho, change = _step(p, z, rho)
        return z, rho, change, last, i + 1

    far = jnp.asarray(jnp.inf, z0.dtype)
    z, _, change, *_ = lax.while_loop(unfinished, improve, (z0, jnp.zeros_like(far), far, far, 0))
    left, apart = (jnp.sum(p.unit * jnp.abs(Phi)) for Phi in (p.constraint(z[:n]), p.Phi))
    root = math.sqrt(eps)
    met = left <= root * (jnp.sqrt(jnp.min(p.d)) + p.reach + apart)  # not beside x: some searches run away
    return z, (change <= root * (1 + largest(z))) & met


def _step(p: Problem, z: Array, rho: Array):
    """One step from z: the new z, rho, and the largest change of a coordinate."""
    n, eps = len(p.d), float(jnp.finfo(z.dtype).eps)
    x, value, A = z[:n], p.conditions(z), jax.jacfwd(p.conditions)(z)
    inverse = p.factorize(A.at[:n, :n].set(jnp.where(_is_convex(p, A, n), A[:n, :n], p.M)))
    step = -inverse(value, trans=0)
    dx, mu = step[:n], z[n:] + step[n:]
    rho = jnp.maximum(rho, 1.5 * jnp.max(jnp.abs(mu) / p.unit))

    def merit(x: Array) -> Array:
        return x @ (p.M @ x) / 2 + rho * jnp.sum(p.unit * jnp.abs(p.constraint(x)))

    now = merit(x)
    slope = (p.M @ x) @ dx - rho * jnp.sum(p.unit * jnp.abs(value[n:]))
    rounding = 64 * eps * (now + rho * p.reach)

    def falls(part: Real, dx: Array) -> Array:
        return merit(x + dx) <= now + DECREASE * part * slope + rounding

    bend = -inverse(jnp.concatenate([jnp.zeros_like(x), p.constraint(x + dx)]), trans=0)[:n]
    bent = ~falls(1.0, dx) & falls(1.0, dx + bend)
    one = jnp.ones_like(rho)
    part = lax.while_loop(lambda a: ~falls(a, a * dx) & ~bent & (a > 2.0**-HALVINGS), lambda a: a / 2, one)
    taken = jnp.where(bent, dx + bend, part * dx)
    return jnp.concatenate([x + taken, z[n:] + part * step[n:]]), rho, jnp.max(jnp.abs(taken))


def _is_convex(p: Problem, A: Array, n: int) -> Array:
    """Whether the Hessian of the Lagrangian is positive definite along the constraints."""
    rows, unit = p.unit[:, None] * A[n:, :n], 1 / jnp.sqrt(p.d)
    H = (A[:n, :n] + A[:n, :n].T) / 2 + WEIGHT * rows.T @ rows
    return jnp.all(jnp.isfinite(jnp.linalg.cholesky(unit[:, None] * H * unit[None, :])))
