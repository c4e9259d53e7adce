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
    """An estimate, how it was reached, and how far to trust it.

    Attributes:
        params: the estimate, structured like params0.
        residual: residuals(params), as the user's function gives it.
        cost: 1/2 sum rho(weighted residual^2), and of priors.
        history: `History`, NaN after the last iteration when made inside jit.
        iterations: how many.
        code: why it stopped, a number; `reason` says it in words.
        transforms: of each leaf.
        uncertainty: `Uncertainty` of the free entries; None if not asked for.
        segments: how many parts of the record the covariance rests on.
        starts: the unknowns of each record, with a leading axis; None where `fit` was given no records.
        weights: as given to `fit`.
        choices: of residuals with runs under error control (`adaptive`), how often their steps were chosen, and
            frozen, for estimates, until these stayed; None without.

    `covariance` (p, p), whose rows follow ravel_pytree(params), and `standard_errors`, the root of its diagonal,
    structured like params, come from how much segments of the record disagree (a cluster-robust covariance:
    `Uncertainty`), or from the autocorrelation of the residuals where parameters outnumber segments. A fixed parameter
    has variance 0; one that the residuals do not determine has inf, and covariances 0.
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
        """Whether a tolerance was met."""
        return (self.code == COST) | (self.code == STEP) | (self.code == GRADIENT)

    @property
    def reason(self) -> str:
        """Why it stopped, in words."""
        self._require_one()
        return REASONS[int(self.code)]

    @property
    def free(self) -> np.ndarray:
        """Whether each entry of ravel_pytree(params) was fitted, (p,)."""
        self._require_one()
        leaves = zip(self.transforms, jax.tree.leaves(freeze(self.params)), strict=True)
        return np.concatenate([np.full(np.size(x), T is not tf.fixed) for T, x in leaves])

    def _require_one(self):
        if jnp.ndim(self.code):
            raise ValueError(
                f"FitResult: must be of one fit; this is a batch, of shape {jnp.shape(self.code)}. Its member i is "
                "jax.tree.map(lambda x: x[i], result)."
            )

    @property
    def covariance(self) -> Any:
        """(p, p), or None."""
        return None if self.uncertainty is None else self.embed(self.uncertainty.covariance)

    @property
    def standard_errors(self) -> Any:
        """Structured like params, or None."""
        return None if self.uncertainty is None else self.errors(self.uncertainty.covariance)

    @property
    def correlation(self) -> Any:
        """Of the estimates, (p, p), or None."""
        return None if self.uncertainty is None else correlation(self.covariance)

    def embed(self, covariance: PyTree) -> Array:
        """A covariance of the free entries with rows of zeros for the fixed ones, (p, p)."""
        at = np.flatnonzero(self.free)
        p = len(self.free)
        return jnp.zeros((p, p), covariance.dtype).at[np.ix_(at, at)].set(covariance)

    def errors(self, covariance: Array) -> PyTree:
        """Standard errors from a covariance of the free entries, structured like params."""
        _, unravel = ravel_pytree(freeze(self.params))
        return thaw(unravel(jnp.sqrt(jnp.diagonal(self.embed(covariance)))))

    def interval(self, level: float = 0.95) -> tuple[Any, Any]:
        """Lower and upper ends of each parameter's confidence interval, two pytrees like params.

        Student's t with the `degrees` of freedom of `Uncertainty`, symmetric in the coordinate that was fitted: for a
        `positive` parameter p exp(-+ t sigma/p), which stays positive. A parameter closer than t sigma to a bound has
        p -+ t sigma, cut off there: it cannot be told from the bound.

        Raises:
            TypeError, ValueError: level is no number between 0 and 1; a fit without covariance.
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
        """A table of estimates, standard errors and intervals, and what limits them.

        Below it: how many observations there are, and how many independent ones they are worth (`compare` has the
        formula); the rms of the residual, in its unit, and whether it is white (Ljung and Box 1978); where the standard
        errors come from; what is not determined, and what is only together.

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
        """The figure of `hhtjax.plot.fit_overview`."""
        return CHARTS["FitResult"](self, sampling_rate)

    def to_json(self) -> str:
        """The whole result as JSON, for `FitResult.from_json`; inf and NaN as Python writes them."""
        return json.dumps(report.encode(self))

    @staticmethod
    def from_json(text: str) -> FitResult:
        """What `to_json` wrote. params of dicts, lists and tuples."""
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
    """Two-sided quantile of Student's t, by Cornish and Fisher's expansion about the normal one (None: normal); of few
    degrees of freedom, where the expansion is far off, by bisection, and between integers by interpolation of log t
    over 1/degrees: to 4 %, between 1 and 2."""
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
