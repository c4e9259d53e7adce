"""The linear least-squares problems inside Levenberg-Marquardt: dense, and with unknowns that belong to one record.

A problem evaluates a point x into a trial with its cost, and finds from it the damped step

    min_dx |r + J dx|^2 + lam |D dx|^2,      D: the largest norms that the columns of J have had (More 1978)

so that a parameter which loses its influence on the way does not run away.

Towards a bound of a parameter, which a transform has put at an infinite x, J^T J vanishes faster than the slope J^T r.
What makes a good step there is the second derivative of the transform itself: see `_bent`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from hhtjax.identification.losses import LEAST_BEND, Objective
from hhtjax.numerics.either import namespace_of

PART = 512  # rows


def with_jacobian(f, x):
    """f(x) and its forward-mode Jacobian."""

    def twice(x):
        r = f(x)
        return r, r

    J, r = jax.jacfwd(twice, has_aux=True)(x)
    return r, J


def triangle(A):
    """R of A = Q R. Of a tall matrix by QR of parts of its rows, then of what is left of them, and so on: LAPACK's goes
    through the whole of it for every column.

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


class Seen(NamedTuple):
    """What an evaluation at a point tells."""

    r: Any  # of the least-squares problem, (m,)
    J: Any  # (m, p)
    cost: Any
    bend: Any  # p''/p' of each unknown; None for 0
    read: Any  # more, to be kept


class DenseTrial(NamedTuple):
    """A point, and the least-squares problem there, its columns over D and reduced to p rows."""

    x: Any
    read: Any  # of a `Dense` problem: r, J
    cost: Any
    length: Any  # of the residual of the least-squares problem
    D: Any
    column: Any  # norms of the columns of J, at most D
    s: Any  # singular values of J/D, here and below with the rows of `_bent`
    V: Any
    z: Any  # residual in the basis of the left singular vectors

    @property
    def r(self):
        """Residuals."""
        return self.read[0]


def dense_trial(x, seen, D) -> DenseTrial:
    """The trial at x, with D from the trials before; its cost is inf where something is not finite."""
    xp, p = namespace_of(x), x.size
    finite = xp.all(xp.isfinite(seen.r)) & xp.all(xp.isfinite(seen.J))
    r, J = (xp.where(finite, y, 0) for y in (seen.r, seen.J))
    if seen.bend is not None:
        further = _bent(seen.bend, J.T @ r, xp.sum(J**2, axis=0))
        J, r = xp.concatenate([J, xp.diag(further)]), xp.pad(r, (0, p))
    column = xp.linalg.norm(J, axis=0)
    D = xp.maximum(D, column)
    R = triangle(xp.concatenate([J / _or_one(D)[None, :], r[:, None]], axis=1))
    U, s, Vt = xp.linalg.svd(R[:p, :p])
    cost = xp.where(finite, seen.cost, xp.inf)
    return DenseTrial(x, seen.read, cost, xp.linalg.norm(R[:, p]), D, column, s, Vt.T, U.T @ R[:p, p])


class Dense(NamedTuple):
    """Residuals f(x) (m,) of which each may depend on every unknown; bend(x): p''/p' of each."""

    f: Callable
    objective: Objective
    bend: Callable | None

    def read(self, x):
        """Residuals and their Jacobian."""
        return with_jacobian(self.f, x)

    def slopes(self, x):
        """The gradient of the cost, of all that there is: (1, p)."""
        J, pull, _ = self.objective.estimating(*self.read(x))
        return (pull @ J)[None, :]

    def see(self, x) -> Seen:
        """What `dense_trial` has to know of x."""
        r, J = self.read(x)
        bend = None if self.bend is None else self.bend(x)
        return Seen(*self.objective.least_squares(r, J), self.objective.cost(r), bend, (r, J))

    def look(self, x, D) -> DenseTrial:
        """The trial at x, with D from the trials before; its cost is inf where something is not finite."""
        return dense_trial(x, self.see(x), D)

    def nothing(self, x):
        """A trial before the first evaluation."""
        return _blank(self, x)

    def step(self, trial, lam):
        """The damped step, and the decrease of the cost that the linear problem predicts."""
        xp = namespace_of(trial.x)
        weight = trial.s / xp.maximum(trial.s**2 + lam, float(jnp.finfo(trial.s.dtype).tiny))
        dx = -(trial.V @ (weight * trial.z)) / _or_one(trial.D)
        return dx, xp.sum(trial.z**2 * (1 - (1 - trial.s * weight) ** 2)) / 2

    def length(self, trial, dx):
        """Of J dx."""
        return namespace_of(trial.x).linalg.norm(trial.s * (trial.V.T @ (trial.D * dx)))

    def cosine(self, trial):
        """Largest |cosine| of the angle between the residual and a column of the Jacobian."""
        return _cosine(trial.V @ (trial.s * trial.z), trial)


class ArrowTrial(NamedTuple):
    """A point, and each record's problem, columns over D and reduced to k + p + 1 rows."""

    x: Any
    r: Any  # (records, m)
    J: Any  # of the shared unknowns, (records, m, p)
    J_own: Any  # (records, m, k)
    cost: Any
    length: Any
    D: Any  # like x
    column: Any  # like x
    R: Any  # (records, k + p + 1, p)
    R_own: Any
    z: Any  # (records, k + p + 1)

    @property
    def read(self):
        """Of the problem, there."""
        return self.r, self.J, self.J_own


class Arrow(NamedTuple):
    """Residuals f(shared, own, record) (m,) of each record, with k unknowns of its own, which are eliminated.

    x holds the p shared unknowns, then those of the records. For given shared ones the own unknowns are a small
    problem in each record; what is left of J is orthogonal to it (a Schur complement, taken by QR). The Jacobian has
    p + k columns, whatever the number of records.
    """

    f: Callable
    objective: Objective
    records: Any
    p: int
    bend: Callable | None  # of the shared unknowns

    def split(self, x):
        """Shared unknowns (p,) and own ones (records, k)."""
        count = jax.tree.leaves(self.records)[0].shape[0]
        return x[: self.p], x[self.p :].reshape(count, -1)

    def read(self, x):
        """Residuals of each record, and their Jacobians by the shared and by their own unknowns."""
        shared, own = self.split(x)

        def one(own, record):
            r, J = with_jacobian(lambda y: self.f(y[: self.p], y[self.p :], record), jnp.concatenate([shared, own]))
            return r, J[:, : self.p], J[:, self.p :]

        return jax.vmap(one)(own, self.records)

    def slopes(self, x):
        """The gradient of each record's cost by the shared and by its own unknowns: (records, p + k)."""
        r, *J = self.read(x)
        J = jnp.concatenate(J, axis=2)
        wJ, pull, _ = self.objective.estimating(r.ravel(), J.reshape(r.size, -1))
        return jnp.einsum("bm,bmp->bp", pull.reshape(r.shape), wJ.reshape(J.shape))

    def look(self, x, D) -> ArrowTrial:
        """The trial at x, with D from the trials before; its cost is inf where something is not finite."""
        r, J, J_own = self.read(x)
        count, m, k = J_own.shape
        both = jnp.concatenate([J_own, J], axis=2).reshape(count * m, -1)
        r_hat, both = self.objective.least_squares(r.ravel(), both)
        finite = jnp.all(jnp.isfinite(r_hat)) & jnp.all(jnp.isfinite(both))
        r_hat, both = (jnp.where(finite, y, 0) for y in (r_hat, both))
        both, r_hat = both.reshape(count, m, -1), r_hat.reshape(count, m)
        if self.bend is not None:
            slopes, squares = jnp.einsum("bmp,bm->p", both[:, :, k:], r_hat), jnp.sum(both[:, :, k:] ** 2, axis=(0, 1))
            further = jnp.diag(_bent(self.bend(x[: self.p]), slopes, squares) / count**0.5)  # a part in each record
            further = jnp.broadcast_to(jnp.pad(further, ((0, 0), (k, 0))), (count, self.p, k + self.p))
            both, r_hat = jnp.concatenate([both, further], axis=1), jnp.pad(r_hat, ((0, 0), (0, self.p)))
        norms = jnp.linalg.norm(both[:, :, k:], axis=(0, 1)), jnp.linalg.norm(both[:, :, :k], axis=1)
        column = jnp.concatenate([norms[0], norms[1].ravel()])
        D = jnp.maximum(D, column)
        shared, own = self.split(_or_one(D))
        columns = jnp.concatenate([own, jnp.broadcast_to(shared, (count, self.p))], axis=1)
        R = jnp.linalg.qr(jnp.concatenate([both / columns[:, None, :], r_hat[:, :, None]], axis=2), mode="r")
        cost = jnp.where(finite, self.objective.cost(r.ravel()), jnp.inf)
        length = jnp.linalg.norm(r_hat)
        return ArrowTrial(x, r, J, J_own, cost, length, D, column, R[:, :, k:-1], R[:, :, :k], R[:, :, -1])

    def nothing(self, x):
        """A trial before the first evaluation."""
        return _blank(self, x)

    def step(self, trial, lam):
        """The damped step, and the decrease of the cost that the linear problem predicts."""
        k, p = trial.R_own.shape[-1], self.p
        root = jnp.sqrt(jnp.maximum(lam, float(jnp.finfo(lam.dtype).eps) ** 2))

        def eliminate(R_own, R, z):
            Q, T = jnp.linalg.qr(jnp.concatenate([R_own, root * jnp.eye(k, dtype=z.dtype)]))
            b = jnp.pad(jnp.concatenate([R, z[:, None]], axis=1), ((0, k), (0, 0)))
            part = Q.T @ b
            return T, part, b - Q @ part

        T, part, rest = jax.vmap(eliminate)(trial.R_own, trial.R, trial.z)
        rest = rest.reshape(-1, p + 1)
        damped = jnp.concatenate([rest, root * jnp.eye(p, p + 1, dtype=root.dtype)])
        Q, S = jnp.linalg.qr(damped[:, :p])
        shared = -jax.scipy.linalg.solve_triangular(S, Q.T @ damped[:, p])
        unmet = part[:, :, p] + jnp.einsum("bkp,p->bk", part[:, :, :p], shared)
        own = -jax.vmap(jax.scipy.linalg.solve_triangular)(T, unmet)
        left = trial.z + jnp.einsum("bip,p->bi", trial.R, shared) + jnp.einsum("bik,bk->bi", trial.R_own, own)
        predicted = (jnp.sum(trial.z**2) - jnp.sum(left**2)) / 2
        return jnp.concatenate([shared, own.ravel()]) / _or_one(trial.D), predicted

    def length(self, trial, dx):
        """Of J dx."""
        shared, own = self.split(_or_one(trial.D) * dx)
        Jdx = jnp.einsum("bip,p->bi", trial.R, shared) + jnp.einsum("bik,bk->bi", trial.R_own, own)
        return jnp.linalg.norm(Jdx)

    def cosine(self, trial):
        """Largest |cosine| of the angle between the residual and a column of the Jacobian."""
        shared = jnp.einsum("bip,bi->p", trial.R, trial.z)
        own = jnp.einsum("bik,bi->bk", trial.R_own, trial.z)
        return _cosine(jnp.concatenate([shared, own.ravel()]), trial)

    def free_of_own(self, r, J, J_own):
        """What `Objective.estimating` says of the residuals, with the part of J that no own unknown can make up for."""
        count, m, k = J_own.shape
        both = jnp.concatenate([J_own, J], axis=2).reshape(count * m, -1)
        both, pull, bend = self.objective.estimating(r.ravel(), both)

        def project(both, bend):
            Q, J = jnp.linalg.qr(both[:, :k])[0], both[:, k:]
            if bend is None:
                return J - Q @ (Q.T @ J)
            h, U = jnp.linalg.eigh(Q.T @ (bend[:, None] * Q))
            slopes = U.T @ Q.T @ (bend[:, None] * J)
            return J - Q @ (U @ (slopes / jnp.maximum(h, LEAST_BEND)[:, None]))

        bends = None if bend is None else bend.reshape(count, m)
        rest = jax.vmap(project, in_axes=(0, None if bend is None else 0))(both.reshape(count, m, -1), bends)
        return rest.reshape(count * m, -1), pull, bend


def _blank(problem, x):
    """Zeros in the form of a trial, without evaluating anything."""
    zeros = jax.tree.map(lambda y: jnp.zeros(y.shape, y.dtype), jax.eval_shape(problem.look, x, x))
    return zeros._replace(x=x, cost=jnp.asarray(jnp.inf, x.dtype))


def _bent(bend, slope, square):
    """Roots of what is added to the diagonal of J^T J (`square`) for transformed unknowns whose bound is ahead.

    A transform p(x) gives the second derivative of the cost a part of its own, `slope` p''/p' with slope = J^T r, which
    is positive on the way to a bound: J^T J is made as large, so that the step there is 1/|bend|, not J^T r/J^T J. At
    a minimum inside the bounds it is 0 (Coleman, Li 1996: the same term, for bounds on p itself).
    """
    xp = namespace_of(bend)
    return xp.sqrt(xp.maximum(slope * bend - square, 0))


def deviation(trial):
    """Standard deviation of the residuals."""
    return trial.length / max(trial.r.size - trial.x.size, 1) ** 0.5


def _or_one(x):
    return namespace_of(x).where(x == 0, 1, x)


def _cosine(slopes, trial):
    """slopes: (J/D)^T r."""
    largest = namespace_of(slopes).max(abs(slopes) * trial.D / _or_one(trial.column))
    return largest / _or_one(trial.length)
