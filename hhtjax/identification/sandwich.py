"""Covariance of a least-squares estimate, also for correlated residuals, which any error of the model causes.

With the Jacobian J and the residual r at the estimate, each covariance is a "sandwich"

    (J^T J)^-1 S (J^T J)^-1,      S = variance of J^T r:

    naive            S = s^2 J^T J,  s^2 = sum r^2/(m - p):  independent residuals of equal variance; p is reduced by
                     the share of information on the parameters that comes from priors
    autocorrelated   S = tau s^2 J^T J,  tau = 1 + 2 sum_k (1 - k/L) rho_k,  rho_k the autocorrelation of r (Bartlett)
    cluster          S = sum_g s_g s_g^T,  s_g = J_g^T (1 - H_g)^(-1/2) r_g,  over segments g of the residual that are
                     long compared with its correlation time; H_g = J_g (J^T J)^-1 J_g^T gives the part of r_g that the
                     fit has removed

(Liang and Zeger 1986, with the correction "CR2" of Bell and McCaffrey 2002: S has no bias for white residuals.) If a
single segment determines a combination of parameters, such as its initial state, no residual is left from which its
variance could be estimated. The autocorrelated S is used there instead. A prior adds its own precision to S.

With a loss rho the estimate is an M-estimate (Huber 1981, Ch. 7). Then psi(r), half the derivative of rho(r^2),
replaces r in S, and J^T diag(psi'(r)) J replaces J^T J outside S.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from hhtjax.description import Array, Real
from hhtjax.description.presentation import shown
from hhtjax.identification.gauss_newton import triangle
from hhtjax.numerics.array_namespace import eigh, namespace_of, svd

SEGMENTS = 32
LEAST = 8  # segments at least, to estimate a variance from their scatter
FLAT = 1e-6  # curvature of the cost beside that of the sum of squares, at which a loss counts as flat
ALONE = 0.75  # share of the information on a combination of parameters, above which its segment has taken it all


@shown
class Uncertainty(NamedTuple):
    """Covariances (p, p) of the fitted entries, in the order of `ravel_pytree(params)`, and measures of determinacy.

    Attributes:
        cluster: the covariance from the scatter between segments of the record, the "cluster sandwich" (formulas and
            sources: `hhtjax.identification.sandwich`); None if there are no more segments than parameters.
        naive: the textbook's covariance, which assumes that every residual is independent noise.
        autocorrelated: the textbook's covariance, corrected for the autocorrelation of the residuals.
        singular_values: (p,), singular values of the Jacobian with columns scaled to length one, largest first. A small
            one belongs to a combination of parameters that hardly affects the residuals.
        directions: (p, p), the combination for each singular value, as a row: changes of the parameters in their units.
        undetermined: (p,) Booleans: parameters in a combination that has no effect on the residuals. Their variance is
            inf, and their covariances are 0.
        inverse: inverse of the second derivative of the cost, J^T diag(psi') J.
        degrees: (p,), degrees of freedom of the cluster variances: one less than the number of segments if all segments
            carry the same information on a parameter, and less if a few segments carry most of it (Satterthwaite, for
            white residuals); None without `cluster`.
    """

    cluster: Array
    naive: Array
    autocorrelated: Array
    singular_values: Any
    directions: Array
    undetermined: Array
    inverse: Array | None = None
    degrees: Array | None = None

    @property
    def covariance(self) -> Array:
        """The cluster covariance, or the autocorrelated one if there is none."""
        return self.autocorrelated if self.cluster is None else self.cluster


def correlation(covariance: Array) -> Array:
    """C_ij/sqrt(C_ii C_jj); 0 beside an undetermined parameter."""
    sigma = jnp.sqrt(jnp.diagonal(covariance))
    safe = jnp.where(jnp.isfinite(sigma) & (sigma > 0), sigma, 1)
    eye = jnp.eye(sigma.size, dtype=sigma.dtype)
    return jnp.where(eye == 1, eye, covariance / jnp.outer(safe, safe))


def used_up(present: np.ndarray, entries: int) -> Real:
    """Number of residuals used up by fitting the starts of records.

    Each record uses as many as its start has entries, but no more than it has residuals. present: (records, m), whether
    a residual is present; a NumPy or JAX array.
    """
    return present.sum(axis=1).clip(max=entries).sum()


def _length(n: int, segments: int, block: int) -> int:
    """Length of a part if n rows are cut into at most `segments` equal parts of whole blocks of `block` rows."""
    return -(-n // (segments * block)) * block


def count_segments(sizes: list, segments: int, block: int = 1) -> int:
    """Number of segments, at most `segments`, into which leaves of these sizes are cut."""
    return max(-(-n // _length(n, segments, block)) for n in sizes if n)


def uncertainty(
    J: Real, r: Real, bend: Real, present: Real, sizes: list, segments: int, tau: Real, block: int = 1
) -> Uncertainty:
    """The `Uncertainty` of an estimate, by the formulas above.

    Args:
        J, r: (m + k, p), (m + k,), Jacobian in units of the parameters, and residual. The last k rows are priors.
            Missing rows are zero. With a loss, r is psi.
        bend: psi', (m + k,); None for 1.
        present: number of rows that are not missing, priors included.
        sizes: sizes of the raveled residual leaves, m in total. Each leaf is cut into equal parts. The i-th parts of
            all leaves belong to the same times and form one segment.
        segments: number of segments, from `count_segments`.
        tau: from `variance_inflation`.
        block: number of rows that stay together, such as those of a record.
    """
    xp, p, m = namespace_of(J), J.shape[1], sum(sizes)
    eps = float(jnp.finfo(J.dtype).eps)
    norms = xp.linalg.norm(J, axis=0)
    column = xp.where(norms == 0, 1, norms)
    _, s, Vt = svd(triangle(J / column[None, :]))
    seen = s > 10 * J.shape[0] * eps * s[0]
    T = Vt.T * xp.where(seen, 1 / xp.where(seen, s, 1), 0)[None, :]  # coordinates in which J^T J = 1
    J = J @ (T / column[:, None])
    inverse, flat = _inverse_curvature(J, bend, T, seen)
    undetermined = xp.any(~seen[:, None] & (xp.abs(Vt) > 1e-6), axis=0) | flat | (present == p)
    told = xp.sum(J[m:] ** 2, axis=1)  # share of the information on a parameter that comes from its prior
    prior = J[m:].T @ J[m:]
    J, r = J[:m], r[:m]
    spare = (present - p).astype(J.dtype) - xp.sum(xp.where(told > 0, 1 - told, 0))
    s2 = xp.sum(r**2) / xp.maximum(spare, 1)

    def in_units(C: Real) -> Real:
        C = T @ C @ T.T / xp.outer(column, column)
        both = undetermined[:, None] & undetermined[None, :]
        C = xp.where(undetermined[:, None] | undetermined[None, :], 0, C)
        return xp.where(both & xp.eye(p, dtype=bool), xp.inf, C)

    def covariance(S: Real) -> Real:
        return in_units(inverse @ (S + prior) @ inverse)

    white = s2 * J.T @ J
    cluster, degrees = None, None
    if segments > p:
        S, degrees = _clusters(J, r, (sizes, segments, block), tau * s2, inverse @ T.T, prior)
        cluster = covariance(S)
    directions, naive = Vt / column[None, :], covariance(white)
    return Uncertainty(cluster, naive, covariance(tau * white), s, directions, undetermined, in_units(inverse), degrees)


def _inverse_curvature(J: Real, bend: Real, T: Real, seen: Real):
    """(J^T diag(bend) J)^-1 for J^T J = 1, and which parameters are part of a direction without curvature."""
    xp, p = namespace_of(J), len(seen)
    if bend is None:
        return xp.eye(p, dtype=J.dtype), xp.zeros(p, bool)
    h, U = eigh(J.T @ (bend[:, None] * J) + xp.diag(xp.where(seen, 0, 1).astype(J.dtype)))
    flat = h <= FLAT
    share = xp.abs(T @ U) / xp.max(xp.abs(T), initial=1e-300)
    inverse = xp.where(flat, 0, 1 / xp.where(flat, 1, h))
    return (U * inverse[None, :]) @ U.T, xp.any(flat[None, :] & (share > 1e-6), axis=1)


def in_segments(x: Real, sizes: list, segments: int, block: int = 1):
    """Cuts each raveled leaf in the rows of x into equal parts: (segments, rows, ...), zeros at the end."""
    xp, parts = namespace_of(x), []
    for leaf in xp.split(x, np.cumsum(sizes)[:-1]):
        if n := len(leaf):
            length = _length(n, segments, block)
            filled = xp.pad(leaf, ((0, segments * length - n), *((0, 0),) * (leaf.ndim - 1)))
            parts.append(filled.reshape(segments, length, *leaf.shape[1:]))
    return parts


def _clusters(J: Real, r: Real, cut: tuple, variance: Real, x: Real, prior: Real):
    """sum_g s_g s_g^T for J^T J = 1, and the `_degrees` of its products with the columns of x.

    With A = J_g^T J_g, J_g^T (1 - J_g J_g^T)^(-1/2) = (1 - A)^(-1/2) J_g^T.
    """
    xp, A, score = namespace_of(J), 0.0, 0.0
    for rows, r_rows in zip(*(in_segments(y, *cut) for y in (J, r)), strict=True):
        A = A + xp.einsum("glp,glq->gpq", rows, rows)
        score = score + xp.einsum("glp,gl->gp", rows, r_rows)
    share, U = eigh(A)
    alone = share > ALONE
    score = xp.where(alone, 0, xp.einsum("gpk,gp->gk", U, score) / xp.sqrt(xp.where(alone, 1, 1 - share)))
    stand_in = xp.where(alone, share, 0)
    score = xp.einsum("gpk,gk->gp", U, score)
    S = score.T @ score + variance * xp.einsum("gpk,gk,gqk->pq", U, stand_in, U)
    known = xp.einsum("pj,pq,qj->j", x, prior + xp.einsum("gpk,gk,gqk->pq", U, stand_in, U), x)
    return S, _degrees(xp.where(alone, 0, share), U, x, known)


def _degrees(share: Real, U: Real, x: Real, known: Real) -> Real:
    """2 mean^2/variance of x^T S x, for each column x and white residuals of unit variance (Bell and McCaffrey 2002).

    x^T S x is e^T G e, with G_gh = x^T B_g A_g (delta_gh - A_h) B_h x and B = (1 - A)^(-1/2). known: the part of the
    mean that is not from S.
    """
    xp = namespace_of(x)
    y = xp.einsum("gpk,pj->gkj", U, x)
    own = xp.einsum("gk,gkj->gj", share / (1 - share), y**2)
    shared = xp.einsum("gpk,gk,gkj->gpj", U, share / xp.sqrt(1 - share), y)
    taken = xp.sum(shared**2, axis=1)
    mean = xp.sum(own - taken, axis=0) + known
    square = xp.sum(own**2 - 2 * own * taken, axis=0)
    square = square + xp.sum(xp.einsum("gpj,gqj->jpq", shared, shared) ** 2, axis=(1, 2))
    some = square > float(jnp.finfo(square.dtype).eps) * mean**2
    return xp.where(some, xp.maximum(mean**2 / xp.where(some, square, 1), 1), xp.inf)


def time_axis(shape: tuple, of_records: bool = False) -> int:
    """The axis of time: the longest one. With of_records, the first axis holds records and does not count."""
    first = int(of_records and len(shape) > 1)
    return first + int(np.argmax(shape[first:])) if shape else 0


def in_time(shapes: Sequence) -> np.ndarray:
    """An order of the entries of raveled leaves in which time varies slowest within each leaf.

    So a segment holds all outputs at consecutive times, and not one output after the other.
    """
    begin, orders = 0, [np.arange(0)]
    for shape in shapes:
        entries = begin + np.arange(math.prod(shape)).reshape(shape)
        orders.append(np.moveaxis(entries, time_axis(shape), 0).ravel() if shape else entries.ravel())
        begin += entries.size
    return np.concatenate(orders)


def variance_inflation(leaves: list, of_records: bool = False) -> Real:
    """tau >= 1 of weighted residual leaves, each along its `time_axis` of N entries, with L = sqrt(N).

    The sum over lags is sum_w (sum of r in w)^2/(L sum r^2) over all windows w of L entries, the ends padded with 0.
    """
    xp, energy, sums = namespace_of(leaves[0]), 0.0, 0.0
    for r in leaves:
        if r.size:
            r = xp.moveaxis(xp.atleast_1d(r), time_axis(r.shape, of_records), 0)
            L = math.isqrt(r.shape[0])
            sums_to = xp.cumsum(xp.pad(r, ((L, L - 1), *((0, 0),) * (r.ndim - 1))), axis=0)
            window = sums_to[L:] - sums_to[:-L]
            energy, sums = energy + xp.sum(r**2), sums + xp.sum(window**2) / L
    return xp.maximum(sums / xp.where(energy > 0, energy, 1), 1)  # a fit takes the slow part of white residuals away
