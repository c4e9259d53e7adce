"""The least-squares problem of many records, each with unknowns of its own, inside Levenberg-Marquardt."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from hhtjax.identification.gauss_newton import bent, blank, largest_cosine, or_one, with_jacobian
from hhtjax.identification.losses import LEAST_BEND, Objective


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
            further = jnp.diag(bent(self.bend(x[: self.p]), slopes, squares) / count**0.5)  # a part in each record
            further = jnp.broadcast_to(jnp.pad(further, ((0, 0), (k, 0))), (count, self.p, k + self.p))
            both, r_hat = jnp.concatenate([both, further], axis=1), jnp.pad(r_hat, ((0, 0), (0, self.p)))
        norms = jnp.linalg.norm(both[:, :, k:], axis=(0, 1)), jnp.linalg.norm(both[:, :, :k], axis=1)
        column = jnp.concatenate([norms[0], norms[1].ravel()])
        D = jnp.maximum(D, column)
        shared, own = self.split(or_one(D))
        columns = jnp.concatenate([own, jnp.broadcast_to(shared, (count, self.p))], axis=1)
        R = jnp.linalg.qr(jnp.concatenate([both / columns[:, None, :], r_hat[:, :, None]], axis=2), mode="r")
        cost = jnp.where(finite, self.objective.cost(r.ravel()), jnp.inf)
        length = jnp.linalg.norm(r_hat)
        return ArrowTrial(x, r, J, J_own, cost, length, D, column, R[:, :, k:-1], R[:, :, :k], R[:, :, -1])

    def nothing(self, x):
        """A trial before the first evaluation."""
        return blank(self, x)

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
        return jnp.concatenate([shared, own.ravel()]) / or_one(trial.D), predicted

    def length(self, trial, dx):
        """Of J dx."""
        shared, own = self.split(or_one(trial.D) * dx)
        Jdx = jnp.einsum("bip,p->bi", trial.R, shared) + jnp.einsum("bik,bk->bi", trial.R_own, own)
        return jnp.linalg.norm(Jdx)

    def cosine(self, trial):
        """Largest |cosine| of the angle between the residual and a column of the Jacobian."""
        shared = jnp.einsum("bip,bi->p", trial.R, trial.z)
        own = jnp.einsum("bik,bi->bk", trial.R_own, trial.z)
        return largest_cosine(jnp.concatenate([shared, own.ravel()]), trial)

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
