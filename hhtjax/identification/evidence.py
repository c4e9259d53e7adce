"""Statistics of the residuals of a fit: their number, their whiteness, and their effective number.

All functions take a finished fit and use NumPy; nothing here is traced.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import betainc

from hhtjax.description import Real
from hhtjax.identification.residuals import spread_weights
from hhtjax.identification.sandwich import time_axis, used_up

if TYPE_CHECKING:
    from hhtjax.identification.result import FitResult
    from hhtjax.identification.sandwich import Uncertainty

LAGS = 20  # of the test for white residuals
LEAST = 5  # samples for each lag


class Residuals(NamedTuple):
    """Leaves of the residuals, each of shape (entries along its `time_axis`, others).

    plain: as returned. weighted: times the weights, 0 where missing. present: Booleans.
    """

    names: list
    plain: list
    weighted: list
    present: list


def weights_of(result: FitResult) -> list:
    """The weight of every residual, leaf by leaf."""
    return spread_weights("fit", result.weights, result.residual)


def residuals_of(result: FitResult) -> Residuals:
    """The `Residuals` of a finished fit."""
    weights = weights_of(result)
    names, plain, weighted, present = [], [], [], []
    for (path, leaf), weight in zip(jax.tree_util.tree_leaves_with_path(result.residual), weights, strict=True):
        r, w = np.asarray(leaf, float), np.asarray(weight, float)
        axis = time_axis(r.shape, result.starts is not None)
        r, w = (np.moveaxis(np.atleast_1d(x), axis, 0) for x in (r, w))
        r, w = (x.reshape(len(x), math.prod(x.shape[1:])) for x in (r, w))  # leaves may be empty
        names.append(jax.tree_util.keystr(path, simple=True, separator="."))
        plain.append(r)
        present.append(w != 0)
        weighted.append(np.where(w != 0, w * np.where(w != 0, r, 0), 0))
    return Residuals(names, plain, weighted, present)


def count(residuals: Residuals) -> int:
    """Number of residuals that are not missing."""
    return int(sum(np.sum(x) for x in residuals.present))


def used_by_starts(result: FitResult) -> int:
    """Number of residuals that are used up by fitting the starts of records; 0 without records."""
    if result.starts is None:
        return 0
    starts = jax.tree.leaves(result.starts)
    records = len(starts[0])
    present = np.concatenate([np.reshape(w, (records, -1)) != 0 for w in weights_of(result)], axis=1)
    return int(used_up(present, sum(map(np.size, starts)) // records))


def design_effect(uncertainty: Uncertainty) -> float:
    """tr(naive^-1 C)/p over the p determined parameters: mean factor by which correlated residuals enlarge variances.

    It is less than 1 if they reduce the variances (Rao and Scott, J. Am. Stat. Assoc. 76, 1981, 221-230).
    """
    known = ~np.asarray(uncertainty.undetermined)
    naive, C = (np.asarray(x)[np.ix_(known, known)] for x in (uncertainty.naive, uncertainty.covariance))
    size = np.sqrt(np.diagonal(naive))
    if not known.any() or not np.all(size > 0) or not np.all(np.isfinite(C)):
        return 1.0
    scale = np.outer(size, size)
    return float(np.trace(np.linalg.pinv(naive / scale, hermitian=True) @ (C / scale)) / len(size))


def effective_observations(observations: int, uncertainty) -> float:
    """Number of independent observations with as much information: n / max(design effect, 1)."""
    return observations / max(design_effect(uncertainty), 1.0)


def whiteness(residuals: Residuals):
    """(autocorrelation at lag 1, p value, lags) of Ljung and Box's test for white residuals; None if there are too few.

    Q = n (n + 2) sum_k rho_k^2/(n - k), k = 1 .. lags, is chi-squared with as many degrees of freedom as there are lags
    (Biometrika 65, 1978, 297-303). n - k is the number of pairs in which both samples are present. The Q of all columns
    are added. Leaves of fewer than 5 samples are not time series and are left out.
    """
    leaves = zip(residuals.weighted, residuals.present, strict=True)
    records = [(r, present) for r, present in leaves if len(r) >= LEAST]
    lags = min([LAGS, *(len(r) // LEAST for r, _ in records)])
    Q, degrees, products, energy = 0.0, 0, 0.0, 0.0
    for r, present in records:
        n = present.sum(axis=0)
        r = np.where(present, r - r.sum(axis=0) / np.maximum(n, 1), 0)
        square = np.sum(r**2, axis=0)
        lagged, pairs = (np.array([np.sum(x[k:] * x[:-k], axis=0) for k in range(1, lags + 1)]) for x in (r, present))
        rho = lagged / np.where(square > 0, square, 1)
        Q += float(np.sum(n * (n + 2) * rho**2 / np.maximum(pairs, 1)))
        degrees += np.sum(pairs > 0)
        products, energy = products + lagged[0].sum(), energy + square.sum()
    if not degrees:
        return None
    return float(products / energy) if energy else 0.0, chi_squared_tail(Q, degrees), lags


def fades(residuals: Residuals) -> bool:
    """Whether the residuals decay: the rms of the last third is less than a third of that of the first third."""
    first, last = 0.0, 0.0
    for r in residuals.weighted:
        third = len(r) // 3
        if len(r) >= LEAST * LEAST:
            first, last = first + np.sum(r[:third] ** 2), last + np.sum(r[-third:] ** 2)
    return bool(last < first / 9)


def chi_squared_tail(x: Real, degrees: Real) -> float:
    """Probability that chi-squared exceeds x, for an integer number of degrees of freedom (a finite sum)."""
    y, odd = float(x) / 2, degrees % 2
    if not 0 < y < math.inf:
        return math.nan if math.isnan(y) else float(y <= 0)
    terms = (math.exp(k * math.log(y) - y - math.lgamma(k + 1)) for k in np.arange(odd / 2, degrees / 2))
    return min((math.erfc(math.sqrt(y)) if odd else 0.0) + sum(terms), 1.0)


def f_tail(x: Real, numerator: int, denominator: Real) -> float:
    """Probability that Fisher's F exceeds x; NaN without degrees of freedom."""
    if denominator <= 0 or not math.isfinite(x):
        return math.nan
    at = denominator / (denominator + numerator * max(x, 0.0))
    return float(betainc(*(jnp.asarray(y) for y in (denominator / 2, numerator / 2, at))))


def rms(r: Any, present: Any) -> float:
    """Root mean square of the entries that are present."""
    return float(np.sqrt(np.sum(np.where(present, r, 0) ** 2) / max(np.sum(present), 1)))
