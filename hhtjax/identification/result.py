"""What `fit` returns."""

from __future__ import annotations

import json
import math
import statistics
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from hhtjax.checks import require_number
from hhtjax.description import Array, PyTree, Real, freeze, is_concrete, thaw
from hhtjax.description.presentation import CHARTS, shown
from hhtjax.identification import report
from hhtjax.identification import transforms as tf
from hhtjax.identification.least_squares import COST, GRADIENT, REASONS, STEP, History
from hhtjax.identification.sandwich import Uncertainty, correlation

FEW = 16  # degrees of freedom


@shown
class FitResult(NamedTuple):
    """Result of `fit`: an estimate, its standard errors, and the course of the fit.

    Attributes:
        params: the estimate, structured like params0.
        residual: residuals(params), as your function returns it.
        cost: 1/2 sum rho(weighted residual^2), plus the terms of the priors.
        history: `History`. If the fit was made inside jit, entries after the last iteration are NaN.
        iterations: number of iterations.
        code: why the fit stopped, a number. `reason` gives it in words.
        transforms: the transform of each leaf of params.
        uncertainty: `Uncertainty` of the fitted entries; None with covariance=False.
        segments: number of parts of the record from which the covariance was computed.
        starts: the fitted unknowns of each record, with a leading axis; None without `records`.
        weights: as given to `fit`.
        choices: for residuals that simulate under error control (`adaptive`): how often the steps were chosen anew
            until the estimates no longer changed; otherwise None.

    `covariance` is (p, p); its rows follow ravel_pytree(params). `standard_errors` are the square roots of its
    diagonal, structured like params. Both come from the scatter between segments of the record (a cluster-robust
    covariance: see `Uncertainty`). If there are no more segments than parameters, they come from the autocorrelation of
    the residuals. A fixed parameter has variance 0. A parameter that the residuals do not determine has variance inf
    and covariances 0.
    """

    params: PyTree
    residual: PyTree
    cost: Any
    history: History
    iterations: Array
    code: Array
    transforms: tuple
    uncertainty: Uncertainty | None
    segments: int
    starts: PyTree = None
    weights: PyTree = True
    choices: Array | None = None

    @property
    def converged(self) -> Any:
        """Whether the fit ended because a tolerance was met."""
        return (self.code == COST) | (self.code == STEP) | (self.code == GRADIENT)

    @property
    def reason(self) -> str:
        """Why the fit stopped, in words."""
        self._require_one()
        return REASONS[int(self.code)]

    @property
    def free(self) -> np.ndarray:
        """(p,) Booleans: which entries of ravel_pytree(params) were fitted."""
        self._require_one()
        leaves = zip(self.transforms, jax.tree.leaves(freeze(self.params)), strict=True)
        return np.concatenate([np.full(np.size(x), T is not tf.fixed) for T, x in leaves])

    def _require_one(self):
        if jnp.ndim(self.code):
            raise ValueError(
                f"FitResult: must hold one fit; received a batch of shape {jnp.shape(self.code)}. Select member i by "
                "jax.tree.map(lambda x: x[i], result)."
            )

    @property
    def covariance(self) -> Any:
        """Covariance of the estimates, (p, p); None with covariance=False."""
        return None if self.uncertainty is None else self.embed(self.uncertainty.covariance)

    @property
    def standard_errors(self) -> Any:
        """Standard errors, structured like params; None with covariance=False."""
        return None if self.uncertainty is None else self.errors(self.uncertainty.covariance)

    @property
    def correlation(self) -> Any:
        """Correlation matrix of the estimates, (p, p); None with covariance=False."""
        return None if self.uncertainty is None else correlation(self.covariance)

    def embed(self, covariance: PyTree) -> Array:
        """(p, p): a covariance of the fitted entries, with zero rows and columns added for the fixed ones."""
        at = np.flatnonzero(self.free)
        p = len(self.free)
        return jnp.zeros((p, p), covariance.dtype).at[np.ix_(at, at)].set(covariance)

    def errors(self, covariance: Array) -> PyTree:
        """Standard errors, structured like params, from a covariance of the fitted entries.

        `result.errors(result.uncertainty.naive)` are those for white noise.
        """
        _, unravel = ravel_pytree(freeze(self.params))
        return thaw(unravel(jnp.sqrt(jnp.diagonal(self.embed(covariance)))))

    def interval(self, level: float = 0.95) -> tuple[Any, Any]:
        """Lower and upper ends of each parameter's confidence interval, two pytrees like params.

        The half width is t sigma, with the standard error sigma and Student's t for the `degrees` of freedom of
        `Uncertainty`. The interval is symmetric in the coordinate that was fitted: for a `positive` parameter its ends
        are p exp(-+ t sigma/p), which stay positive. If a parameter is closer than t sigma to a bound, its ends are
        p -+ t sigma, cut off at the bound: the data do not distinguish it from the bound.

        Raises:
            TypeError, ValueError: level is not a number between 0 and 1; a fit without covariance.
        """
        require_number("interval", "level", level, lambda x: 0 < x < 1, "lie between 0 and 1")
        if self.uncertainty is None:
            raise ValueError("interval: the fit was made with covariance=False.")
        self._require_one()
        C, degrees = self.uncertainty.covariance, self.uncertainty.degrees
        t = jnp.asarray(student(level, degrees), C.dtype)
        leaves, structure = jax.tree.flatten(freeze(self.params))
        reach = jax.tree.leaves(freeze(self.errors(C * jnp.outer(t, t))))
        ends = [_ends(T, p, r) for T, p, r in zip(self.transforms, leaves, reach, strict=True)]
        lower, upper = (thaw(structure.unflatten(x)) for x in zip(*ends, strict=True))
        return lower, upper

    def summary(self) -> str:
        """Text: a table of estimates, standard errors and intervals, and remarks on their quality.

        The remarks give the number of observations, and the number of independent ones that would carry as much
        information (formula in `compare`); the rms of the residual, in its unit, and whether it is white (Ljung and Box
        1978); how the standard errors were computed; which parameters are not determined; and the largest correlations
        between estimates.

        >>> import jax.numpy as jnp, hhtjax
        >>> wave = jnp.sin(jnp.arange(400.0))
        >>> print(hhtjax.fit(lambda p: p["a"] * wave + p["b"] - 2 * wave - 0.1, {"a": 1.0, "b": 0.0}).summary())
        ... # doctest: +ELLIPSIS
        converged: ...
        parameter  estimate  standard error  95 % interval  error / naive
        a          2  ...
        """
        self._require_one()
        return report.summary(self)

    def _table(self):
        return report.table(self)

    def plot(self, sampling_rate: float = 1.0) -> Any:
        """Draws `hhtjax.plot.fit_overview` and returns its axes."""
        return CHARTS["FitResult"](self, sampling_rate)

    def to_json(self) -> str:
        """The whole result as JSON text, to be read by `FitResult.from_json`. inf and NaN as in Python."""
        return json.dumps(report.encode(self))

    @staticmethod
    def from_json(text: str) -> FitResult:
        """Reads a result from the text of `to_json`. params must consist of dicts, lists, tuples and arrays."""
        return report.read(text, FitResult, NAMED)


NAMED: dict[str, Any] = {c.__name__: c for c in (FitResult, History, Uncertainty)}


def _ends(T, p: Array, reach: Array):
    if T is tf.fixed:
        return p, p
    one = jnp.ones_like(p)
    x = T.coordinate(p, one)
    _, slope = jax.jvp(lambda x: T.parameter(x, one), (x,), (one,))
    by_x = T.parameter(x - reach / slope, one), T.parameter(x + reach / slope, one)
    lower, upper = T.ends(p.dtype)
    cut = jnp.maximum(p - reach, lower), jnp.minimum(p + reach, upper)
    near = T.distance(p) < reach
    return tuple(jnp.where(near, *ends) for ends in zip(cut, by_x, strict=True))


def student(level: Real, degrees: Array | None) -> Real:
    """Two-sided quantile of Student's t; degrees None: of the normal distribution.

    Computed by Cornish and Fisher's expansion about the normal quantile. For few degrees of freedom this expansion is
    too inaccurate: there integers are solved by bisection, and values between them by interpolation of log t over
    1/degrees, with an error of up to 4 % between 1 and 2.
    """
    z = statistics.NormalDist().inv_cdf((1 + level) / 2)
    if degrees is None:
        return z
    first = (z**3 + z) / 4
    second = (5 * z**5 + 16 * z**3 + 3 * z) / 96
    third = (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384
    xp = np if is_concrete(degrees) else jnp
    integers = np.arange(1, FEW + 2)
    few = np.log([_student_of_few(level, int(n)) for n in integers])
    many = z + first / degrees + second / degrees**2 + third / degrees**3
    return xp.where(degrees > FEW, many, xp.exp(xp.interp(-1 / degrees, -1 / integers, few)))


def _student_of_few(level: Real, degrees: int) -> float:
    """The t with P(|t'| < t) = level, a finite sum of powers of cos(angle) for t = sqrt(degrees) tan(angle)
    (Abramowitz and Stegun 1964, 26.7.3 and 26.7.4)."""
    odd, lower, upper = degrees % 2, 0.0, math.pi / 2
    for _ in range(60):
        angle = (lower + upper) / 2
        term, total = math.cos(angle) ** odd, 0.0
        for k in range(2 + odd, degrees + 1, 2):
            total += term
            term *= math.cos(angle) ** 2 * (k - 1) / k
        within = 2 / math.pi * (angle + math.sin(angle) * total) if odd else math.sin(angle) * total
        lower, upper = (angle, upper) if within < level else (lower, angle)
    return math.sqrt(degrees) * math.tan(lower)
