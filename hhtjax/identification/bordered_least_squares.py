"""The least-squares problem inside Levenberg-Marquardt, for many records that each have unknowns of their own."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.description import Array, PyTree, Real
from hhtjax.identification.gauss_newton import Seen, bending, bent, blank, largest_cosine, or_one, with_jacobian
from hhtjax.identification.losses import LEAST_BEND, Objective
from hhtjax.numerics.array_namespace import eigh, namespace_of, select, solve_upper, solve_upper_transposed


class ArrowTrial(NamedTuple):
    """A point, and each record's problem there, with columns divided by D and reduced to k + p + 1 rows."""

    x: Any
    read: Any  # of an `Arrow` problem: r (records, m), J by the shared unknowns, (records, m, p), and by their own
    cost: Any
    length: Any
    D: Any  # like x
    column: Any  # like x
    R: Any  # (records, k + p + 1, p)
    R_own: Any
    z: PyTree  # (records, k + p + 1)

    @property
    def r(self):
        """Residuals."""
        return self.read[0]


def split(x: Real, count: int, p: int):
    """The p shared unknowns, and those of the `count` records, (count, k)."""
    return x[:p], x[p:].reshape(count, -1)


def arrow_trial(x: np.ndarray, seen: Seen, D: np.ndarray, p: int) -> ArrowTrial:
    """The trial at x, with D from the trials before; its cost is inf where something is not finite.

    seen: residuals (records, m), and their derivatives by k own unknowns and then p shared ones.
    """
    xp, both, r = namespace_of(x), seen.J, seen.r
    count, k = len(both), both.shape[2] - p
    finite = xp.all(xp.isfinite(r)) & xp.all(xp.isfinite(both))
    both, r = select(finite, (both, r), (xp.zeros_like(both), xp.zeros_like(r)))
    if seen.bend is not None:
        slopes, squares = xp.einsum("bmp,bm->p", both[:, :, k:], r), xp.sum(both[:, :, k:] ** 2, axis=(0, 1))
        further = xp.diag(bent(seen.bend, slopes, squares) / count**0.5)  # a part in each record
        further = xp.broadcast_to(xp.pad(further, ((0, 0), (k, 0))), (count, p, k + p))
        both, r = xp.concatenate([both, further], axis=1), xp.pad(r, ((0, 0), (0, p)))
    norms = xp.linalg.norm(both[:, :, k:], axis=(0, 1)), xp.linalg.norm(both[:, :, :k], axis=1)
    column = xp.concatenate([norms[0], norms[1].ravel()])
    D = xp.maximum(D, column)
    shared, own = split(or_one(D), count, p)
    columns = xp.concatenate([own, xp.broadcast_to(shared, (count, p))], axis=1)
    R = xp.linalg.qr(xp.concatenate([both / columns[:, None, :], r[:, :, None]], axis=2), mode="r")
    cost, length = xp.where(finite, seen.cost, xp.inf), xp.linalg.norm(r)
    return ArrowTrial(x, seen.read, cost, length, D, column, R[:, :, k:-1], R[:, :, :k], R[:, :, -1])


def _eliminated(trial: ArrowTrial, lam: Real):
    """The damped problem with the own unknowns eliminated: with T (records, k, k) and S (p, p) upper triangular,

    T own + part (shared, 1) = 0,    S shared + seen = 0.
    """
    xp, z, (count, _, p), k = namespace_of(trial.x), trial.z, trial.R.shape, trial.R_own.shape[-1]
    root = xp.sqrt(xp.maximum(lam, float(jnp.finfo(z.dtype).eps) ** 2))
    damping = xp.broadcast_to(root * xp.eye(k, dtype=z.dtype), (count, k, k))
    Q, T = xp.linalg.qr(xp.concatenate([trial.R_own, damping], axis=1))
    b = xp.pad(xp.concatenate([trial.R, z[:, :, None]], axis=2), ((0, 0), (0, k), (0, 0)))
    part = xp.swapaxes(Q, 1, 2) @ b
    rest = (b - Q @ part).reshape(-1, p + 1)
    damped = xp.concatenate([rest, root * xp.eye(p, p + 1, dtype=z.dtype)])
    Q, S = xp.linalg.qr(damped[:, :p])
    return T, part, S, Q.T @ damped[:, p]


class Arrow(NamedTuple):
    """Residuals f(shared, own, record) (m,) of each record, with k unknowns of its own, which are eliminated.

    x holds the p shared unknowns, then those of the records. For given shared unknowns, the own unknowns of each record
    are a small problem. The rest of J is orthogonal to the columns of this problem (a Schur complement, computed by
    QR). The Jacobian has p + k columns, whatever the number of records.
    """

    f: Callable
    objective: Objective
    records: Any
    p: int
    bend: Callable | None  # of the shared unknowns

    def split(self, x: Array):
        """Shared unknowns (p,) and own ones (records, k)."""
        return split(x, jax.tree.leaves(self.records)[0].shape[0], self.p)

    def read(self, x: Array):
        """Residuals of each record, and their Jacobians by the shared and by their own unknowns."""
        shared, own = self.split(x)

        def one(own: Array, record: Array):
            r, J = with_jacobian(lambda y: self.f(y[: self.p], y[self.p :], record), jnp.concatenate([shared, own]))
            return r, J[:, : self.p], J[:, self.p :]

        return jax.vmap(one)(own, self.records)

    def slopes(self, x):
        """The gradient of each record's cost by the shared and by its own unknowns: (records, p + k)."""
        r, *J = self.read(x)
        J = jnp.concatenate(J, axis=2)
        wJ, pull, _ = self.objective.estimating(r.ravel(), J.reshape(r.size, -1))
        return jnp.einsum("bm,bmp->bp", pull.reshape(r.shape), wJ.reshape(J.shape))

    def see(self, x: Array) -> Seen:
        """The `Seen` of x, for `arrow_trial`."""
        return self.seen(x, *self.read(x))

    def seen(self, x: Array, r: Array, J: Array, J_own: Array) -> Seen:
        """The `Seen` of x, from the result of `read`."""
        both = jnp.concatenate([J_own, J], axis=2)
        r_hat, both_hat = self.objective.least_squares(r.ravel(), both.reshape(r.size, -1))
        bend = None if self.bend is None else self.bend(x[: self.p])
        read = r, J, J_own
        return Seen(r_hat.reshape(r.shape), both_hat.reshape(both.shape), self.objective.cost(r.ravel()), bend, read)

    def look(self, x, D) -> ArrowTrial:
        """The trial at x, with D from the trials before."""
        return arrow_trial(x, self.see(x), D, self.p)

    def nothing(self, x):
        """A trial before the first evaluation."""
        return blank(self, x)

    def step(self, trial: ArrowTrial, lam: Real):
        """The damped step, and the decrease of the cost that the linear problem predicts."""
        xp, z, p = namespace_of(trial.x), trial.z, trial.R.shape[-1]
        T, part, S, seen = _eliminated(trial, lam)
        shared = -solve_upper(S, seen)
        own = -solve_upper(T, part[:, :, p] + xp.einsum("bkp,p->bk", part[:, :, :p], shared))
        left = z + xp.einsum("bip,p->bi", trial.R, shared) + xp.einsum("bik,bk->bi", trial.R_own, own)
        predicted = (xp.sum(z**2) - xp.sum(left**2)) / 2
        return xp.concatenate([shared, own.ravel()]) / or_one(trial.D), predicted

    def damped(self, trial: ArrowTrial, lam: Real, slope: np.ndarray) -> np.ndarray:
        """(J^T J + lam D^2)^-1 slope."""
        xp, (count, _, p) = namespace_of(trial.x), trial.R.shape
        T, part, S = _eliminated(trial, lam)[:3]
        shared, own = split(slope / or_one(trial.D), count, p)
        ahead = solve_upper_transposed(T, own)
        shared = shared - xp.einsum("bkp,bk->p", part[:, :, :p], ahead)
        shared = solve_upper(S, solve_upper_transposed(S, shared))
        own = solve_upper(T, ahead - xp.einsum("bkp,p->bk", part[:, :, :p], shared))
        return xp.concatenate([shared, own.ravel()]) / or_one(trial.D)

    def bending(self, now: ArrowTrial, new: ArrowTrial, at: ArrowTrial, step: np.ndarray):
        """J^T r'' at one of two trials, with r'' = (J_new - J_now) step, of the weighted residuals."""
        if now.read is None:  # before the first evaluation, in NumPy
            return 0 * step
        (J0, _), (J1, _), (J, row) = map(self.weighted, (now, new, at))
        xp, (count, _, p) = namespace_of(step), now.R.shape
        shared, own = split(step, count, p)
        step = xp.concatenate([own, xp.broadcast_to(shared, (count, p))], axis=1)[:, :, None]
        slopes = bending((J0 @ step)[:, :, 0], (J1 @ step)[:, :, 0], J, row)
        k = own.shape[1]
        return xp.concatenate([xp.sum(slopes[:, k:], axis=0), slopes[:, :k].ravel()])

    def weighted(self, trial):
        """w J, with the columns of a record's own unknowns first, and the squared factors of its rows as in `Dense`."""
        r, J, J_own = trial.read
        both = jnp.concatenate([J_own, J], axis=2)
        row = self.objective.stretch(r.ravel())
        both = self.objective.scaled(both.reshape(r.size, -1)).reshape(both.shape)
        return both, None if row is None else row.reshape(r.shape)

    def offset(self, trial: ArrowTrial) -> Real:
        """Length of the part of the residual that an undamped step removes, over that of the residual."""
        xp = namespace_of(trial.x)
        _, predicted = self.step(trial, xp.zeros_like(trial.length))
        return xp.sqrt(xp.maximum(2 * predicted, 0)) / or_one(trial.length)

    def length(self, trial, dx):
        """Length of J dx."""
        xp = namespace_of(trial.x)
        shared, own = split(or_one(trial.D) * dx, len(trial.R), trial.R.shape[-1])
        Jdx = xp.einsum("bip,p->bi", trial.R, shared) + xp.einsum("bik,bk->bi", trial.R_own, own)
        return xp.linalg.norm(Jdx)

    def cosine(self, trial) -> Real:
        """Largest |cosine| of the angle between the residual and a column of the Jacobian."""
        xp = namespace_of(trial.x)
        shared = xp.einsum("bip,bi->p", trial.R, trial.z)
        own = xp.einsum("bik,bi->bk", trial.R_own, trial.z)
        return largest_cosine(xp.concatenate([shared, own.ravel()]), trial)

    def estimates(self, r, J, J_own):
        """`Objective.estimating` of the residuals."""
        return self.objective.estimating(r.ravel(), jnp.concatenate([J_own, J], axis=2).reshape(r.size, -1))


def free_of_own(both: np.ndarray, bend, count: int, p: int) -> np.ndarray:
    """The part of the shared columns of J that the own unknowns cannot reproduce. both: k own columns, p shared."""
    xp = namespace_of(both)
    both = both.reshape(count, -1, both.shape[-1])
    k = both.shape[-1] - p
    Q, J = xp.linalg.qr(both[:, :, :k])[0], both[:, :, k:]
    Qt = xp.swapaxes(Q, 1, 2)
    if bend is None:
        return (J - Q @ (Qt @ J)).reshape(-1, p)
    bend = bend.reshape(count, -1, 1)
    h, U = eigh(Qt @ (bend * Q))
    slopes = xp.swapaxes(U, 1, 2) @ (Qt @ (bend * J))
    return (J - Q @ (U @ (slopes / xp.maximum(h, LEAST_BEND)[:, :, None]))).reshape(-1, p)
