"""The linear least-squares problem inside Levenberg-Marquardt, for residuals that may all depend on every unknown.

A problem evaluates a point x, and returns a trial with its cost. From the trial it finds the damped step

    min_dx |r + J dx|^2 + lam |D dx|^2,      D: the largest norms that the columns of J have had (More 1978).

This D keeps a parameter from running away when it loses its influence.

A transform maps a bound of a parameter to an infinite x. Towards it J^T J vanishes faster than the slope J^T r. The
second derivative of the transform then gives a good step: see `bent`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.description import Array, PyTree, Real
from hhtjax.identification.losses import Objective
from hhtjax.numerics.array_namespace import namespace_of, select, svd

PART = 512  # rows


def with_jacobian(f: Callable, x: Array):
    """f(x) (m,) and its forward-mode Jacobian."""
    if x.size == 1:  # without vmap, over one direction, there is less to trace and to compile
        r, dr = jax.jvp(f, (x,), (jnp.ones_like(x),))
        return r, dr[:, None]

    def twice(x: Array):
        r = f(x)
        return r, r

    J, r = jax.jacfwd(twice, has_aux=True)(x)
    return r, J


def triangle(A: np.ndarray) -> np.ndarray:
    """R of A = Q R. The rows of a tall matrix are reduced part by part, and the results again, until one part is left.

    This is faster than LAPACK's QR, which goes through the whole matrix for every column.

    >>> A = jnp.sin(jnp.arange(9000.0)).reshape(3000, 3)
    >>> R = triangle(A)
    >>> R.shape, bool(jnp.allclose(R.T @ R, A.T @ A))
    ((3, 3), True)
    """
    xp, (m, k) = namespace_of(A), A.shape
    rows = max(PART, 4 * k)
    while m > 2 * rows:
        parts = -(-m // rows)
        A = xp.pad(A, ((0, parts * rows - m), (0, 0))).reshape(parts, rows, k)
        A = xp.linalg.qr(A, mode="r").reshape(-1, k)
        m = A.shape[0]
    return xp.linalg.qr(A, mode="r")


def blank(problem, x: Array) -> DenseTrial:
    """Zeros in the form of a trial, without evaluating anything."""
    zeros = jax.tree.map(lambda y: jnp.zeros(y.shape, y.dtype), jax.eval_shape(problem.look, x, x))
    return zeros._replace(x=x, cost=jnp.asarray(jnp.inf, x.dtype))


def bent(bend: np.ndarray, slope: np.ndarray, square: np.ndarray) -> np.ndarray:
    """Square roots of the terms added to the diagonal of J^T J (`square`) for unknowns that move towards a bound.

    A transform p(x) adds `slope` p''/p' to the second derivative of the cost, with slope = J^T r. On the way to a bound
    this is positive. The diagonal of J^T J is raised to it, so that the step is 1/|bend| instead of J^T r/J^T J. At a
    minimum inside the bounds the term is 0 (Coleman, Li 1996: the same term, for bounds on p itself).
    """
    xp = namespace_of(bend)
    return xp.sqrt(xp.maximum(slope * bend - square, 0))


def deviation(trial: DenseTrial) -> Array:
    """Standard deviation of the residuals."""
    return trial.length / max(trial.r.size - trial.x.size, 1) ** 0.5


def or_one(x: Real) -> np.ndarray:
    """x with 1 instead of 0, to divide by."""
    return namespace_of(x).where(x == 0, 1, x)


def largest_cosine(slopes: np.ndarray, trial) -> Real:
    """|cosine| of the angle between the residual and a column of the Jacobian. slopes: (J/D)^T r."""
    largest = namespace_of(slopes).max(abs(slopes) * trial.D / or_one(trial.column))
    return largest / or_one(trial.length)


def bending(before, after, J, row):
    """J^T r'' with r'' the difference of J dx at the ends of a step, and the rows of J (.., m, p) times `row`."""
    bend = after - before if row is None else row * (after - before)
    return namespace_of(J).einsum("...mp,...m->...p", J, bend)


class Seen(NamedTuple):
    """Result of an evaluation at a point."""

    r: Array  # of the least-squares problem, (m,)
    J: Any  # (m, p)
    cost: Any
    bend: Any  # p''/p' of each unknown; None for 0
    read: Any  # more, to be kept


class DenseTrial(NamedTuple):
    """A point, and the least-squares problem there, with columns divided by D and reduced to p rows."""

    x: Any
    read: Any  # of a `Dense` problem: r, J
    cost: Any
    length: Any  # of the residual of the least-squares problem
    D: Any
    column: Any  # norms of the columns of J, at most D
    s: Any  # singular values of J/D, here and below with the rows of `bent`
    V: Any
    z: PyTree  # residual in the basis of the left singular vectors

    @property
    def r(self) -> Array:
        """Residuals."""
        return self.read[0]


def dense_trial(x, seen: Seen, D) -> DenseTrial:
    """The trial at x, with D from the trials before; its cost is inf where something is not finite."""
    xp, p = namespace_of(x), x.size
    both = xp.concatenate([seen.J, seen.r[:, None]], axis=1)
    finite = xp.all(xp.isfinite(both))
    R = triangle(select(finite, both, xp.zeros_like(both)))
    if seen.bend is not None:
        further = bent(seen.bend, R[:, :p].T @ R[:, p], xp.sum(R[:, :p] ** 2, axis=0))
        R = triangle(xp.concatenate([R, xp.pad(xp.diag(further), ((0, 0), (0, 1)))]))
    column = xp.linalg.norm(R[:, :p], axis=0)
    D = xp.maximum(D, column)
    U, s, Vt = svd(R[:p, :p] / or_one(D)[None, :])
    cost = xp.where(finite, seen.cost, xp.inf)
    return DenseTrial(x, seen.read, cost, xp.linalg.norm(R[:, p]), D, column, s, Vt.T, U.T @ R[:p, p])


class Dense(NamedTuple):
    """Residuals f(x) (m,) of which each may depend on every unknown; bend(x): p''/p' of each."""

    f: Callable
    objective: Objective
    bend: Callable | None

    def read(self, x: Array):
        """Residuals and their Jacobian."""
        return with_jacobian(self.f, x)

    def slopes(self, x: Array) -> Array:
        """The gradient of the cost: (1, p)."""
        J, pull, _ = self.objective.estimating(*self.read(x))
        return (pull @ J)[None, :]

    def see(self, x: Array) -> Seen:
        """The `Seen` of x, for `dense_trial`."""
        r, J = self.read(x)
        bend = None if self.bend is None else self.bend(x)
        return Seen(*self.objective.least_squares(r, J), self.objective.cost(r), bend, (r, J))

    def estimates(self, r: Array, J: Array):
        """`Objective.estimating` of the residuals."""
        return self.objective.estimating(r, J)

    def look(self, x: Array, D: Array) -> DenseTrial:
        """The trial at x, with D from the trials before; its cost is inf where something is not finite."""
        return dense_trial(x, self.see(x), D)

    def nothing(self, x: Array) -> DenseTrial:
        """A trial before the first evaluation."""
        return blank(self, x)

    def step(self, trial: DenseTrial, lam: Real):
        """The damped step, and the decrease of the cost that the linear problem predicts."""
        xp = namespace_of(trial.x)
        weight = trial.s / xp.maximum(trial.s**2 + lam, float(jnp.finfo(trial.s.dtype).tiny))
        dx = -(trial.V @ (weight * trial.z)) / or_one(trial.D)
        return dx, xp.sum(trial.z**2 * (1 - (1 - trial.s * weight) ** 2)) / 2

    def damped(self, trial: DenseTrial, lam: Real, slope: np.ndarray) -> np.ndarray:
        """(J^T J + lam D^2)^-1 slope."""
        xp, D = namespace_of(trial.x), or_one(trial.D)
        weight = xp.maximum(trial.s**2 + lam, float(jnp.finfo(trial.s.dtype).tiny))
        return trial.V @ (trial.V.T @ (slope / D) / weight) / D

    def bending(self, now, new, at, step):
        """J^T r'' at one of two trials, with r'' = (J_new - J_now) step, of the weighted residuals."""
        if now.read is None:  # before the first evaluation, in NumPy
            return 0 * step
        (J0, _), (J1, _), (J, row) = map(self.weighted, (now, new, at))
        return bending(J0 @ step, J1 @ step, J, row)

    def weighted(self, trial: DenseTrial):
        """w J, and the squares of the factors of its rows in the least-squares problem; None for 1."""
        r, J = trial.read
        return self.objective.scaled(J), self.objective.stretch(r)

    def offset(self, trial: DenseTrial) -> Real:
        """Length of the part of the residual that an undamped step removes, over that of the residual."""
        xp = namespace_of(trial.x)
        reached = trial.s > 100 * float(jnp.finfo(trial.s.dtype).eps) * trial.s[0]
        return xp.linalg.norm(xp.where(reached, trial.z, 0)) / or_one(trial.length)

    def length(self, trial: DenseTrial, dx: Array) -> Array:
        """Length of J dx."""
        return namespace_of(trial.x).linalg.norm(trial.s * (trial.V.T @ (trial.D * dx)))

    def cosine(self, trial) -> Real:
        """Largest |cosine| of the angle between the residual and a column of the Jacobian."""
        return largest_cosine(trial.V @ (trial.s * trial.z), trial)
