"""Directions of friction that may depend on each other or on constraints, and the forces of joints at rest there.

In a closed loop more joints may have friction than there are freedoms: K = H A^-1 H^T is singular. The motion is then
unique, but the forces are not. Joints at rest, with the accelerations `load` without friction, solve
unique, and the motion is: of joints at rest, with the accelerations `load` without friction,

    min tau' K tau/2 - load' tau,    |tau_i| <= F_i,    ds/dt = load - K tau

Every minimiser gives the same ds/dt. The one with the least sum of K_ii tau_i^2 is taken. If the motion of a joint is
prescribed, as in a mechanism with a driven crank, K_ii = 0: its friction changes no motion, only the multipliers.

D. Bertsekas, SIAM J. Control Optim. 20, 1982; J. Moreau, Unilateral contact and dry friction in finite freedom
dynamics, 1988.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.description import Array, PyTree, Real
from hhtjax.numerics.batched_cond import tree_where
from hhtjax.numerics.dense_lu import diagonal, matvec
from hhtjax.numerics.linear_solve import solver
from hhtjax.systems.constraints import jacobian, violation
from hhtjax.systems.friction import at_rest, block_of, directions, responses, solver_of_some

if TYPE_CHECKING:
    from hhtjax.systems.flat_system import FlatSystem

LIMIT = 1e-10  # relative size, squared, of what is left of a direction, below which it is rounding
SLIGHT = 1e-9  # relative size of an acceleration, or of a time in a step, below which it is 0
PROXIMAL = 1e-6  # relative weight of the proximal term
ROUNDS = 200  # Newton steps in a box problem: a handful is enough, but a NaN ends nowhere
HALVINGS = 16  # of a Newton step


class Independent(NamedTuple):
    """Independent rows: every choice of them is solved directly."""

    K: Array

    def solve(self, A: Array, some: Array, b: Array):
        """y with A y = b on these rows and columns, 0 elsewhere."""
        return solver_of_some(A, some)(b)

    def at_rest(self, rests: Array, load: Array, f: Array, size: Array | None = None):
        """sig and tau of joints at rest."""
        return at_rest(self.K, rests, load, f)

    def are_dependent(self) -> Array:
        """Whether they turn out to depend on each other."""
        left, least, m = lax.stop_gradient(self.K), _rounding(self.K), len(self.K)
        found = jnp.zeros((), bool)
        for i in range(m - 1):  # what is left of a diagonal, without those before it
            left = left - left[:, i, None] * left[None, i, :] / left[i, i]
            found = found | (jnp.abs(left[i + 1, i + 1]) < least[i + 1])
        return found

    def carriers(self, some: Array) -> Array:
        """The rows, unchanged."""
        return some


class Dependent(NamedTuple):
    """Rows that may depend on each other, expressed by the rows of a basis: s_j = sum C_ij s_i.

    K_ij: the acceleration in direction i for a unit of force in direction j. For dependent rows it is computed from the
    basis, so that it has the correct rank. least: what counts as rounding in its diagonal.
    """

    K: Array
    C: Array
    basis: Array
    least: Array

    def spanning(self, some: Array, first: bool = False) -> Array:
        """A largest set of independent rows among these; rows of `first` are preferred."""
        return independent(self.K, self.least, some, first)

    def solve(self, A: Array, some: Array, b: Array):
        """y with A y = b on a largest independent set of these rows and columns, 0 elsewhere."""
        return solver_of_positive(A, self.spanning(some))(b)

    def at_rest(self, rests: Array, load: Array, f: Array, size: Real = 0.0):
        """sig and tau of joints at rest, from their loads; `size` is the size of the terms in these."""
        return at_rest_in_box(self, rests, load, f, size)

    def are_dependent(self) -> bool:
        """True: their dependence is already known."""
        return False

    def carriers(self, some: Array) -> Array:
        """The rows of the basis in terms of which these rows are expressed."""
        return self.basis & jnp.any(some[None, :] & (self.C != 0), axis=1)

    def shared(self, sticks: Array, tau: Array, f: Array) -> Array:
        """tau, with the forces of sticking joints replaced by equivalent ones within the limits."""
        held = jnp.where(sticks, tau, 0)
        _, shared = self.at_rest(sticks, matvec(self.K, held), f, matvec(jnp.abs(self.K), jnp.abs(held)))
        return jnp.where(sticks, shared, tau)


def depends(system, redundant) -> bool:
    """Whether directions may depend on each other, which the system or the option `redundant` of the stepper says."""
    return system.friction.dependent or redundant is not None


def rows_of(
    system: FlatSystem,
    q: Array,
    t: Array,
    params: PyTree,
    H: Array,
    G: Array,
    pulls: Array | None,
    first: Real,
    dependent: bool,
):
    """The rows of H, with G = A^-1 H^T and the multipliers for it. first: rows with which a basis begins.

    dependent: whether they may depend on each other; independent rows cost nothing extra.
    """
    K = jnp.stack([matvec(H, g) for g in G], axis=1)
    if not dependent:
        return Independent(K)
    least = _rounding(K)
    if system.num_constraints:
        least = least / _left_by_constraints(H, pulls, jacobian(system, q, t, params)) ** 2
    least = lax.stop_gradient(least)
    basis = independent(K, least, jnp.ones(len(K), bool), first)
    inverse, moved = solver_of_positive(K, basis), diagonal(K) > least
    C = jnp.stack([inverse(jnp.where(moved[j], K[:, j], 0)) for j in range(len(K))], axis=1)
    C = jnp.where(basis[:, None] & basis[None, :], jnp.eye(len(K), dtype=K.dtype), C)
    return Dependent(_through(C, basis, K), C, basis, least)


def _rounding(K: Array) -> Array:
    """What counts as rounding in the diagonal of K; more in single precision."""
    return max(LIMIT, 1e3 * float(jnp.finfo(K.dtype).eps)) * jnp.abs(diagonal(K))


def slight(dtype: np.dtype) -> float:
    """SLIGHT, but not less than rounding in this dtype."""
    return max(SLIGHT, 1e3 * float(jnp.finfo(dtype).eps))


def _through(C: Array, basis: Array, K: Array) -> Array:
    """C^T K C, of the basis alone."""
    inner = jnp.where(basis[:, None] & basis[None, :], K, 0)
    return C.T @ (inner @ C)


def _left_by_constraints(H: Array, pulls, B: Array) -> Array:
    """The part of the mobility of each row that constraints leave: at most 1, and more than 0."""
    left, taken = jnp.abs(H + pulls @ B), jnp.abs(H) + jnp.abs(pulls) @ jnp.abs(B)
    unit = jnp.maximum(jnp.max(jnp.abs(H), axis=0), jnp.max(jnp.abs(B), axis=0))  # of each coordinate
    left, taken = (jnp.max(x / jnp.where(unit == 0, 1, unit)[None, :], axis=1) for x in (left, taken))
    return jnp.clip(left / jnp.where(taken == 0, 1, taken), float(jnp.finfo(H.dtype).eps), 1)


def solver_of_positive(A: Array, some: Array):
    """b -> y with A y = b on these rows and columns, 0 elsewhere, for an A that is positive there."""

    def factorize(A):
        inverse = _inverse(lax.stop_gradient(A))
        return lambda b, trans=0: (inverse.T if trans else inverse) @ b

    solve = solver(block_of(A, some), factorize)
    return lambda b: solve(jnp.where(some, b, 0))


def _inverse(A: Array) -> Array:
    """The solution for a positive A, which needs no pivoting, by a program that is as short as possible."""
    i = jnp.arange(len(A))

    def exchange(k: Array, X: Array) -> Array:
        row, column, pivot = X[k], X[:, k] / X[k, k], X[k, k]
        there, down = (i == k)[:, None], (i == k)[None, :]
        rest = jnp.where(down, -column[:, None], X - column[:, None] * row[None, :])
        return jnp.where(there, jnp.where(down, 1 / pivot, (row / pivot)[None, :]), rest)

    return lax.fori_loop(0, len(A), exchange, A)


def independent(K: Array, least: Array, some: Array, first: Real = False) -> Array:
    """A largest independent set of `some` of the rows of a semi-definite K.

    By elimination with diagonal pivots, the largest next; rows of `first` come before others.
    """
    K, m = lax.stop_gradient(K), len(K)
    before = jnp.where(jnp.broadcast_to(first, (m,)), 1 / float(jnp.finfo(K.dtype).eps), 1).astype(K.dtype)

    def take(_, carry: tuple):
        chosen, left = carry
        d = diagonal(left)
        fits = some & ~chosen & (d > least)
        ratio = jnp.where(fits, d / jnp.where(least > 0, least, 1) * before, -1)
        i = jnp.argmax(ratio)
        here = (jnp.arange(m) == i) & fits
        row = jnp.sum(jnp.where(here[:, None], left, 0), axis=0)
        column = jnp.sum(jnp.where(here[None, :], left, 0), axis=1)
        pivot = jnp.sum(jnp.where(here, d, 0))
        return chosen | here, left - (column / jnp.where(pivot == 0, 1, pivot))[:, None] * row[None, :]

    return lax.fori_loop(0, m, take, (jnp.zeros(m, bool), K))[0]


def is_prescribed(system, rows, pulls: Array, states: tuple, params: PyTree) -> Array:
    """Whether a sliding velocity has a part that the basis does not determine, at one of two states: (m,).

    This part is r = own - C^T own + (L - C^T L) dPhi/dt in s_j = sum C_ij s_i + r_j, where H^T - H^T C = -B^T L.
    """
    zero, C = jnp.zeros(system.size, pulls.dtype), rows.C.T
    found = jnp.zeros(len(C), bool)
    for x in states:
        own = system.friction.sliding(x.q, zero, x.t, params)
        r, size = own - matvec(C, own), jnp.abs(own) + matvec(jnp.abs(C), jnp.abs(own))
        if system.num_constraints:
            rate = violation(system, x.q, zero, x.t, params)[1]
            r = r + (pulls - C @ pulls) @ rate
            size = size + (jnp.abs(pulls) + jnp.abs(C) @ jnp.abs(pulls)) @ jnp.abs(rate)
        found = found | (jnp.abs(r) > 1e4 * float(jnp.finfo(r.dtype).eps) * size)
    return found & ~rows.basis


def at_rest_in_box(rows: Dependent, rests: Array, load: Array, f: Array, size: Real = 0.0):
    """sig and tau of joints at rest: they are held within their limits; those that are still accelerated slide.

    Derivatives are those of the smallest forces tau that hold the sticking joints, given the forces at their limits.
    """
    K = rows.K
    sig, found = slides_in_box(K, rows.least, rests, load, f, size)
    sticks = rests & (sig == 0)
    inside = sticks & (jnp.abs(found) < f * (1 - 64 * float(jnp.finfo(f.dtype).eps))) & (diagonal(K) > rows.least)
    limited = jnp.where(inside | ~rests, 0, jnp.where(sticks, jnp.sign(found), sig) * f)
    here = rows.spanning(inside)
    B = jnp.where(here[:, None] & inside[None, :], K, 0)
    unit = 1 / jnp.where(inside, diagonal(K), 1)
    solve = solver_of_positive(B @ (unit[:, None] * B.T), here)
    held = unit * (B.T @ solve(load - matvec(K, limited)))
    within = jnp.all(~inside | (jnp.abs(held) <= f))  # else its joints would hold more than they can
    found = jnp.where(inside, jnp.where(within, lax.stop_gradient(held), found), lax.stop_gradient(limited))
    exact = found + unit * (B.T @ solve(load - matvec(K, found)))
    return sig, limited + jnp.where(inside, held + lax.stop_gradient(exact - held), 0)


def slides_in_box(K: Array, least: Array, rests: Array, load: Array, f: Array, size: Real = 0.0):
    """The directions in which joints at rest that cannot be held start to slide, and the forces; both without
    derivatives."""
    K, load, f, size = lax.stop_gradient((K, load, f, jnp.asarray(size, K.dtype)))
    rests = jnp.broadcast_to(rests, f.shape)
    moved = rests & (diagonal(K) > least)
    tau = smallest_in_box(K, jnp.where(moved, load, 0), jnp.where(moved, f, 0), moved)
    rate = load - matvec(K, tau)
    nothing = slight(K.dtype) * (jnp.abs(load) + matvec(jnp.abs(K), jnp.abs(tau)) + size)
    d = jnp.sign(rate)
    at_limit = ~moved | (d * tau >= f * (1 - 64 * float(jnp.finfo(f.dtype).eps)))
    return jnp.where(rests & at_limit & (jnp.abs(rate) > nothing), d, 0), tau


def leaves_box(K: Array, least: Array, rests: Array, loads: list, f: Array, size: Real = 0.0):
    """The time at which loads that change linearly from one value to another, within a unit of time, permanently exceed
    what joints at rest can hold; and which joints slide then, in which directions. Infinity and none if this does not
    happen.

    The loads that can be held are a convex set, {K tau, |tau| <= F}. If the load at x is outside, with the forces tau
    and the acceleration r = load - K tau = K u of the box problem, a plane separates it from the set: u.load <= r.tau
    holds in the set. The line crosses this plane nearer to the set. This is Newton's iteration on a convex distance,
    from the outside. u is not differentiated, because the plane that is crossed first determines the time.
    """
    known = lax.stop_gradient((K, loads, f))
    moved = rests & (diagonal(known[0]) > least)
    inverse = solver_of_positive(known[0], independent(known[0], least, moved))

    def plane_at(x: Array):
        K, (first, last), f = known
        load = first + x * (last - first)
        slides, tau = slides_in_box(K, least, moved, load, f, size)
        return slides, tau, inverse(jnp.where(slides != 0, load - matvec(K, tau), 0))

    def crossing(plane: tuple, K: Array, loads: list, f: Array) -> Array:
        slides, tau, u = plane
        most = jnp.where(slides != 0, slides * f, tau)
        first, last = (jnp.sum(u * x) for x in loads)
        rise = last - first
        return jnp.where(rise > 0, (jnp.sum(most * matvec(K, u)) - first) / jnp.where(rise > 0, rise, 1), 0)

    def unfinished(carry: tuple) -> Array:
        x, _, change, i = carry
        return (x > 0) & (change > slight(K.dtype)) & (i < ROUNDS)

    def improve(carry: tuple):
        x, old, _, i = carry
        plane = plane_at(x)
        beyond = jnp.any(plane[0] != 0)
        new = jnp.where(beyond, jnp.clip(crossing(plane, *known), 0, x), x)
        return new, tree_where(beyond, plane, old), x - new, i + 1

    one, none = jnp.ones((), K.dtype), jnp.zeros_like(f)
    _, plane, *_ = lax.while_loop(unfinished, improve, (one, (none, none, none), one, 0))
    leaves = jnp.any(plane[0] != 0)
    return jnp.where(leaves, crossing(plane, K, loads, f), jnp.inf), plane[0]


def smallest_in_box(K: Array, load: Array, f: Array, moved: Array) -> Array:
    """tau with min tau' K tau/2 - load' tau, |tau| <= f, for a semi-definite K: projected Newton iteration on the
    variables that are not at a bound (Bertsekas 1982), with a proximal term. It starts from 0, so it finds the smallest
    of all minimisers.

    Units are such that the diagonal of K is 1.
    """
    m, alone = len(f), diagonal(K)
    unit = jnp.sqrt(jnp.where(moved, alone, 1))
    R = jnp.where(moved[:, None] & moved[None, :], (K + K.T) / 2 / unit[:, None] / unit[None, :], 0)
    b, top = load / unit, f * unit
    eye = jnp.eye(m, dtype=K.dtype)
    A, eps = R + PROXIMAL * eye, float(jnp.finfo(K.dtype).eps)
    shorter = 0.5 ** jnp.arange(HALVINGS, dtype=K.dtype)

    def away(u: Array, g: Array) -> Array:
        return jnp.max(jnp.abs(jnp.clip(u - g, -top, top) - u))

    def enough(u: Array) -> Array:
        return 64 * eps * (jnp.max(jnp.abs(b)) + jnp.max(jnp.abs(R) @ jnp.abs(u)))

    def unfinished(carry: tuple) -> Array:
        _, _, done, i = carry
        return ~done & (i < ROUNDS)

    def improve(carry: tuple):
        u, old, _, i = carry
        pull = b + PROXIMAL * old
        g = A @ u - pull
        pinned = ((u >= top) & (g < 0)) | ((u <= -top) & (g > 0)) | ~moved
        step = -(_inverse(block_of(A, ~pinned)) @ jnp.where(pinned, 0, g))
        tried = jnp.concatenate([shorter[:, None] * step[None, :], -shorter[:, None] * g[None, :]])
        path = jnp.clip(u[None, :] + tried, -top[None, :], top[None, :])
        costs = jnp.sum(path * (path @ A / 2 - pull[None, :]), axis=1)
        cost, size = jnp.sum(u * (A @ u / 2 - pull)), jnp.sum(jnp.abs(u * pull))
        lower = jnp.any(costs < cost - 16 * eps * size)
        better = jnp.where(lower, path[jnp.argmin(costs)], path[0])
        calmer = away(better, A @ better - pull) < away(u, g)  # where costs are rounding
        at_minimum = (away(u, g) <= enough(u)) | ~(lower | calmer)
        new = jnp.where(at_minimum, u, better)
        settled = jnp.max(jnp.abs(u - old)) <= eps * jnp.max(jnp.abs(u))
        done = at_minimum & (settled | (away(u, R @ u - b) <= 8 * enough(u)))
        return new, jnp.where(at_minimum, u, old), done, i + 1

    begin = jnp.zeros_like(b)
    u, *_ = lax.while_loop(unfinished, improve, (begin, begin, jnp.all(b == 0), 0))
    return u / unit


def held_back(system, s, L, old, new, dw: Array, answer, dependent: bool):
    """A jump dw of the accelerations at a state, when params jump and multipliers become L, with the reaction of
    friction: of joints at rest, and of sliding joints, whose limits may jump too. Also returns the multipliers. answer:
    of `answers` there; dependent: whether directions may depend on each other."""
    H, (sig, tau) = directions(system, s.q, s.t, new), s.friction
    rests = sig == 0
    G, pulls = responses(answer, H)
    rows = rows_of(system, s.q, s.t, new, H, G, pulls, rests, dependent)
    K = rows.K
    f0, f = (system.friction.limit(s.q, s.v, x, s.t, params) for x, params in ((s.L, old), (L, new)))
    sliding = sig * (f - f0)
    load = matvec(H, dw) + matvec(K, jnp.where(rests, tau, -sliding))
    slides, held = rows.at_rest(rests, load, f, matvec(jnp.abs(H), jnp.abs(s.w)))
    change = jnp.where(rests, held - tau, sliding)
    friction = s.friction._replace(sig=jnp.where(rests, slides, sig), tau=tau + change)
    if dependent and system.num_constraints:
        L = L - matvec(pulls.T, change)
    return dw - matvec(G.T, change), friction, L
