"""Initial values that satisfy the constraints, and the check that they do."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.checks import require_number, require_params
from hhtjax.description import all_concrete, known_now, thaw
from hhtjax.description.presentation import shown
from hhtjax.numerics.elimination import diagonal
from hhtjax.numerics.linear_solve import RANK_TOLERANCE
from hhtjax.systems import kinematics
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
from hhtjax.systems.initial_values import initial_values
from hhtjax.systems.nearest import nearest_position
from hhtjax.xla import Programs

CONSISTENT = 1e-6  # distance of initial values from consistent ones that passes, beside 1 + |q|, each coordinate
SMALL = 1e-3  # of a mechanism's size, if that is so small that the former does not tell
ROUNDINGS = 1000  # of q, which nobody asks about
CHECKED = ("q0", "Phi"), ("v0", "dPhi/dt")


@shown
class ConsistentInitial(NamedTuple):
    """Initial values on the constraints; made by `consistent_initial`.

    Attributes:
        q, v, acceleration: pytrees like q0 and v0.
        multipliers: L, (m,).
        converged: whether a point with Phi(q) = 0 was found.
        moved: how far q is from q0 in the coordinate that is farthest, in its unit, radians for rotations. Compare it
            with how well q0 was meant: a start far away may be of another assembly than that which was thought of.
    """

    q: Any
    v: Any
    acceleration: Any
    multipliers: Any
    converged: Any
    moved: Any = None


def consistent_initial(system, q0, v0, params=None, t0=0.0, redundant=None, z0=None) -> ConsistentInitial:
    """The values nearest to q0 and v0 that satisfy the constraints, with the acceleration and multipliers there.

        min |q - q0|_M with Phi(q, t0) = 0,     min |v - v0|_M with B v + Phi_t = 0,     |x|_M^2 = x^T M x

    M at q0 for the first, at q for the second. Then M w = Q + B^T L with the second time derivative of Phi zero.

    Args:
        system: a `System` with a constraint. q0, v0, params, t0: as in `simulate`.
        redundant: "least_squares" for constraints that may depend on each other, as in `hht`.
        z0: internal states, where the system has some; they enter the forces, and stay as they are.

    q is found by steps that fall towards the constraints and towards q0, not by Newton's alone, which from afar ends
    anywhere. Where the constraints bend on the way it is the nearest of up to 24 searches; nothing proves that there is
    no nearer one. `moved` tells the distance.
    Differentiable, forward and reverse. Under jit nothing raises, and `converged` tells.

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
def _consistent_initial(system, q0, v0, params, t0, z0, redundant):
    """The result, B at q0 and which rows are clear, and max|Phi| at the end."""
    params = thaw(params)
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


def correction(system, q, t, params, rows, factorize):
    """The x with B x = rows that is smallest in the norm of M."""
    return saddle_point(system, q, t, params, factorize)(jnp.zeros(system.size, q.dtype), rows)[0]


@Programs
def examine(system, q0, v0, t0, params, z0):
    """M and B, Phi and dPhi/dt, the sizes of the coordinates and of their rates, and which rows of B are clear."""
    params = thaw(params)
    flat, q, v = flatten("simulate", system, q0, v0, t0, params, z0)
    t = jnp.asarray(t0).astype(q.dtype)
    M, (B, clear) = flat.mass(q, t, params), gradient(flat, q, t, params)
    sizes = kinematics.sizes(flat.blocks, q), flat.located(jnp.abs(v))
    M = jnp.diag(M) if M.ndim == 1 else M
    return M, B[:, : flat.positions], violation(flat, q, v, t, params), sizes, clear


def distances(examined, redundant):
    """For Phi and dPhi/dt: what they violate, and how far q0 and v0 are from values that do not, in the coordinate that
    is farthest, in that which is farthest beside its own size, and in each; by NumPy, which has nothing to compile."""
    M, B, both, sizes, _ = jax.tree.map(np.asarray, examined)
    n, end = M.shape[-1], M.shape[-1] + B.shape[-2]
    A = np.zeros((*M.shape[:-2], end, end), M.dtype)
    A[..., :n, :n], A[..., n:, :n], A[..., :n, n:] = M, B, -np.swapaxes(B, -1, -2)
    for x, size in zip(both, sizes, strict=True):
        b = np.concatenate([np.zeros_like(size), x], axis=-1)
        away = np.abs(_solved(A, b, n, redundant)[..., :n])
        yield *(np.max(y, axis=-1) for y in (np.abs(x), away, away / (1 + size))), away


@np.errstate(all="ignore")
def _solved(A, b, n, redundant):
    """z with A z = b, smallest where constraints may be redundant; NaN where there is none. A batch goes first."""
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


def require_consistent(caller, system, q0, v0, t0, params, redundant=None, z0=None, checked=CHECKED):
    """An error if q0 or v0 is farther than rounding from the constraints, or these from independence; tracers pass.

    checked: what the caller names q0, and v0 if it is to be looked at, and what they violate.
    """
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
    """Whether a displacement of this size, or one in a unit of time, turns a constraint's gradient by more than SMALL:
    the size of a mechanism is in nothing but that. Asked of what is more than rounding."""
    found = known_now(_turns, *start)
    assert found is not None  # as what was examined
    turns, d = found
    return bool(np.any(turns * np.max(np.where(B == 0, 0, np.sqrt(d) * away), axis=1) > SMALL))


@Programs
def _turns(system, q0, v0, t0, params, z0):
    """By how much a displacement of size 1 turns the gradient of each constraint, in the norm of diag(M), and that."""
    params = thaw(params)
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
