"""Comparison of several models of one record: information criteria, F tests, and errors on segments left out."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from hhtjax.checks import require_function, require_integer, require_number
from hhtjax.description import Array, PyTree, Real, is_concrete
from hhtjax.description.presentation import Table, as_text, shown
from hhtjax.identification.evidence import (
    count,
    effective_observations,
    f_tail,
    residuals_of,
    used_by_starts,
    weights_of,
)
from hhtjax.identification.identifiability import parameter_names, parameter_values
from hhtjax.identification.inference import leave_out, require_residuals_of
from hhtjax.identification.result import FitResult


@shown
class NestedTest(NamedTuple):
    """F tests of two nested models: does the record support the additional parameters of the larger one?

    Attributes:
        smaller, larger: names of the models. extra: q, the number of additional parameters of the larger one.
        statistic, p_value: from the covariance of the fit, which allows for correlated residuals.
        naive_statistic, naive_p_value: the textbook F test, which assumes that every residual is independent noise.
    """

    smaller: str
    larger: str
    extra: int
    statistic: float
    p_value: float
    naive_statistic: float
    naive_p_value: float


def _told(test: NestedTest) -> str:
    """A test in words. If the two p values contradict each other, it names a possible reason: a wrong `absent`."""
    doubt = ", if `absent` is right" if 1e3 * test.p_value < test.naive_p_value > 0.05 else ""
    return f"{test.p_value:.2g} ({test.naive_p_value:.2g}) against {test.smaller}{doubt}"


@shown
class Comparison(NamedTuple):
    """Result of `compare`. Arrays have an entry for each of the M models.

    Attributes:
        names: names of the models.
        parameters: (M,), number of fitted parameters, including the starts of records.
        observations: n, the number of residuals that are not missing.
        effective: n_e, the number of independent observations that would carry as much information.
        rms: (M,), root mean square of the (weighted) residual.
        aic, bic: (M,); only differences between models matter.
        tests: a `NestedTest` for each pair of nested models with no third model between them.
        held_out: (M, folds), rms of the residual on each segment, with the parameters fitted to the other segments;
            None without `residuals`.
        converged: (M, folds), whether these fits converged; None without `residuals`.
    """

    names: tuple
    parameters: np.ndarray
    observations: int
    effective: float
    rms: np.ndarray
    aic: np.ndarray
    bic: Array
    tests: tuple
    held_out: Array | None = None
    converged: Array | None = None

    @property
    def cross_validated(self) -> Any:
        """(M,), root mean square of `held_out` over the segments; None without `held_out`."""
        return None if self.held_out is None else np.sqrt(np.mean(self.held_out**2, axis=1))

    @property
    def behind(self) -> Any:
        """(M, 2): difference of the held-out mean square from that of the best model, and its standard error.

        With the difference d_g of each of G segments they are mean(d) and sd(d)/sqrt(G). None without cross-validation.
        """
        if self.held_out is None:
            return None
        square = self.held_out**2
        away = square - square[np.argmin(square.mean(axis=1))]
        return np.stack([away.mean(axis=1), away.std(axis=1, ddof=1) / math.sqrt(away.shape[1])], axis=1)

    @property
    def chosen(self) -> str:
        """Name of the recommended model.

        With cross-validation: the model with the fewest parameters among those whose difference from the best model is
        at most its standard error (Breiman, Friedman, Olshen, Stone 1984, Sec. 3.4.3). Without: that with the lowest
        BIC.
        """
        if self.held_out is None:
            return self.names[int(np.argmin(self.bic))]
        close = self.behind[:, 0] <= self.behind[:, 1]
        return self.names[int(np.argmin(np.where(close, self.parameters, np.inf)))]

    def summary(self) -> str:
        """The table as text. Each p value names the smaller model; the textbook p value is in brackets."""
        return as_text(self._table())

    def _table(self) -> Table:
        rows = [["model", "parameters", "rms", "AIC - least", "BIC - least"]]
        for i, name in enumerate(self.names):
            criteria = (f"{x[i] - np.min(x):.4g}" for x in (self.aic, self.bic))
            rows.append([name, str(self.parameters[i]), f"{self.rms[i]:.5g}", *criteria])
        if self.tests:
            rows[0].append("F test: p (naive p)")
            for i, name in enumerate(self.names):
                found = [test for test in self.tests if test.larger == name]
                rows[i + 1].append("; ".join(map(_told, found)))
        if self.held_out is not None:
            rows[0] += ["held-out rms", "behind the best"]
            for i, (away, error) in enumerate(self.behind):
                words = f"{away / error:.1f} standard errors" if away else "best"
                rows[i + 1] += [f"{self.cross_validated[i]:.5g}", words]
        worth = f"{self.observations} observations, as informative as {self.effective:.0f} independent ones"
        return Table(f"Comparison: {worth}; chosen: {self.chosen!r}", rows)


def compare(
    fits: dict[str, FitResult],
    residuals: Callable[..., Any] | dict[str, Callable[..., Any]] | None = None,
    *,
    folds: int = 8,
    absent: float | dict[str, float] = 0.0,
    always: PyTree = None,
    progress: bool = False,
    **options: Any,
) -> Comparison:
    """Compares models of the same measurements: AIC and BIC, F tests of nested models, errors on segments left out.

    Residuals of a fit are correlated, because no model is quite right. Then n residuals carry less information than n
    independent ones, and textbook criteria accept too many terms. The covariance C of a fit, from the scatter between
    segments of the record, measures this loss. With the weighted sum of squares S_m of model m, its number of
    parameters k_m, and n_e = n/d, where d = tr(naive^-1 C)/p >= 1 is the design effect of the model with most
    parameters,

        AIC = n_e log(S_m/n) + 2 k_m,        BIC = n_e log(S_m/n) + k_m log n_e.

    The F test is for the q additional parameters x of a nested model. They have no effect at x0, and their variances
    have at least f `degrees` of freedom (Hotelling's T^2):

        (f - q + 1)/f (x - x0)^T C_xx^-1 (x - x0)/q ~ F(q, f - q + 1).

    The textbook test is given too: ((S_0 - S_1)/q)/(S_1/(n - k_1)) ~ F(q, n - k_1). A model is nested in another if the
    names of its fitted parameters are among those of the other.

    With `residuals` each model is cross-validated: it is fitted again, starting from its estimate, with one of `folds`
    segments left out, and evaluated on that segment. This needs no formula and no assumption of white noise. Segments
    are contiguous, so that the segment left out is hardly correlated with the rest.

    Args:
        fits: {name: `FitResult`, with covariance}, all of the same measurements with the same weights.
        residuals: the function that was fitted, or {name: function}, for the errors on segments left out. None: no
            cross-validation.
        folds: number of segments, cut like those of the covariance. Each must be long compared with the correlation
            time. Segments without any residual to evaluate do not count.
        absent: the value at which an additional parameter has no effect, or {parameter: value} with the names in
            `FitResult.summary()`; 0 for the others. It is needed if the smaller model has a constant in its function
            instead of the parameter. If the smaller model has the parameter as a fixed one, that value is used. The
            summary warns that `absent` may be wrong if `p_value` is tiny and `naive_p_value` is not.
        always: Booleans, as `weights` of `fit`: True for residuals that are in every fit and are never evaluated, such
            as the first samples if they alone determine the initial state.
        progress: show in one line on stderr which fit is running.
        options: loss, prior, scale, max_iterations, tolerance, as they were given to `fit`.

    Returns:
        A `Comparison`; `chosen` names one model.

    Raises:
        TypeError, ValueError: an argument of a wrong kind; fewer than two fits; fits without covariance, made inside
            jit, or with different numbers of observations; residuals that are not those of the fits; fewer than two
            segments to evaluate. NotImplementedError: cross-validation of fits with records.

    References:
        Akaike, IEEE Trans. Autom. Control 19 (1974); Schwarz, Ann. Stat. 6 (1978); Rao, Scott, J. Am. Stat. Assoc. 76
        (1981), the design effect; Pustejovsky, Tipton, J. Bus. Econ. Stat. 36 (2018), tests by cluster covariances;
        Burman, Chow, Nolan, Biometrika 81 (1994), cross-validation by blocks.

    >>> import jax, jax.numpy as jnp, hhtjax
    >>> x = jnp.linspace(-1.0, 1.0, 400)
    >>> y = 2.0 * x + 0.5 * x**3 + 0.1 * jax.random.normal(jax.random.key(0), (400,))
    >>> def residuals(p):
    ...     return p["a"] * x + p.get("cube", 0.0) * x**3 + p.get("square", 0.0) * x**2 - y
    >>> starts = {"line": {"a": 1.0}, "cubic": {"a": 1.0, "cube": 0.0}, "full": {"a": 1.0, "cube": 0.0, "square": 0.0}}
    >>> found = hhtjax.compare({name: hhtjax.fit(residuals, start) for name, start in starts.items()}, residuals)
    >>> found.chosen, found.names[found.bic.argmin()], [test.p_value < 0.05 for test in found.tests]
    ('cubic', 'cubic', [True, False])
    """
    _check_fits(fits)
    names, results = tuple(fits), list(fits.values())
    all_residuals = list(map(residuals_of, results))
    observations = {name: count(r) for name, r in zip(names, all_residuals, strict=True)}
    if len(set(observations.values())) > 1:
        told = ", ".join(f"{n} of {name!r}" for name, n in observations.items())
        raise ValueError(f"compare: `fits` must be of the same measurements; received {told} observations.")
    _require_equal_weights(names, results)
    _require_known(absent, results)
    n = observations[names[0]]
    k = np.array([int(np.sum(x.free)) + used_by_starts(x) for x in results])
    square = np.array([sum(np.sum(r**2) for r in x.weighted) for x in all_residuals])
    effective = effective_observations(n, results[int(np.argmax(k))].uncertainty)
    likelihood = effective * np.log(np.maximum(square / n, np.finfo(float).tiny))  # of exact fits, k decides
    tests = tuple(_nested_tests(fits, dict(zip(names, zip(k, square, strict=True), strict=True)), n, absent))
    found = Comparison(
        names, k, n, effective, np.sqrt(square / n), likelihood + 2 * k, likelihood + k * np.log(effective), tests
    )
    if residuals is None:
        return found
    functions = _check_functions(residuals, fits)
    folds = require_integer("compare", "folds", folds, 2)
    held_out, converged = leave_out(fits, functions, folds, always, options, progress)
    return found._replace(held_out=held_out, converged=converged)


def _check_fits(fits: dict):
    if not isinstance(fits, dict) or len(fits) < 2 or not all(isinstance(x, FitResult) for x in fits.values()):
        raise TypeError(f"compare: `fits` must be a dict of two or more FitResult; received {type(fits).__name__}.")
    for name, result in fits.items():
        if not is_concrete(result.code) or np.ndim(result.code):
            raise ValueError(
                f"compare: `fits[{name!r}]` must be one finished fit; received a batch, or one inside jit."
            )
        if result.uncertainty is None:
            raise ValueError(f"compare: `fits[{name!r}]` must have a covariance; it was made with covariance=False.")


def _check_functions(residuals: PyTree, fits: dict):
    """{name: residual function} of all models."""
    functions = residuals if isinstance(residuals, dict) else dict.fromkeys(fits, residuals)
    if functions.keys() != fits.keys():
        raise ValueError(f"compare: `residuals` must have the keys {', '.join(fits)}; received {', '.join(functions)}.")
    for name, function in functions.items():
        if fits[name].starts is not None:
            raise NotImplementedError(f"compare: `fits[{name!r}]` has records, of which no segments can be left out.")
        require_function("compare", "residuals", function, "residuals(params)")
        require_residuals_of(name, fits[name], function)
    return functions


def _require_known(absent: PyTree, results: list):
    """Raises an error for a name in `absent` that no model has."""
    known = {name for result in results for name in parameter_names(result.params)}
    if isinstance(absent, dict) and (unknown := [name for name in absent if name not in known]):
        names = ", ".join(sorted(known))
        raise ValueError(f"compare: `absent` must have keys among {names}; received {unknown[0]!r}.")


def _require_equal_weights(names: tuple, results: list):
    """Raises an error if the fits have different weights; the weights of each model are compared sorted."""
    weights = [np.sort(np.concatenate([np.ravel(w) for w in weights_of(x)])) for x in results]
    for name, w in zip(names, weights, strict=True):
        if w.shape != weights[0].shape or not np.allclose(w, weights[0]):
            raise ValueError(f"compare: `fits` must have the same weights; those of {names[0]!r} and {name!r} differ.")


def _nested_tests(fits: dict, costs: dict, n: int, absent):
    """A `NestedTest` of each pair of nested models with no third model between them."""
    own = {name: set(np.asarray(parameter_names(x.params))[x.free]) for name, x in fits.items()}
    pairs = [(a, b) for a in fits for b in fits if own[a] < own[b] and _same_constants(fits[a], fits[b], own[b])]
    for smaller, larger in pairs:
        if any((smaller, c) in pairs and (c, larger) in pairs for c in fits):
            continue
        result, (_, S0), (k1, S1) = fits[larger], costs[smaller], costs[larger]
        extra, free = own[larger] - own[smaller], np.flatnonzero(result.free)
        names, q = np.asarray(parameter_names(result.params))[free], len(extra)
        at = [i for i, name in enumerate(names) if name in extra]
        held = dict(zip(parameter_names(fits[smaller].params), parameter_values(fits[smaller].params), strict=True))
        x0 = np.array([held.get(names[i], _absent(absent, names[i])) for i in at])
        away = parameter_values(result.params)[free[at]] - x0
        C = np.asarray(result.uncertainty.covariance)[np.ix_(at, at)]
        known, degrees = bool(np.all(np.isfinite(C)) and np.all(np.diagonal(C) > 0)), result.uncertainty.degrees
        wald = float(away @ np.linalg.solve(C, away)) / q if known else math.nan
        if degrees is None:  # more parameters than segments
            degrees = effective_observations(n, result.uncertainty) - k1
        else:
            least = min(float(np.min(np.asarray(degrees)[at])), n - k1)
            degrees = least - q + 1
            wald *= degrees / least
        naive = float((S0 - S1) / q / (S1 / (n - k1))) if S1 > 0 and n > k1 else math.nan
        p = f_tail(wald, q, degrees), f_tail(naive, q, n - k1)
        yield NestedTest(smaller, larger, q, wald, p[0], naive, p[1])


def _same_constants(smaller: FitResult, larger: FitResult, fitted) -> bool:
    """Whether parameters that both models have, and neither fits, are the same."""
    a, b = (dict(zip(parameter_names(x.params), parameter_values(x.params), strict=True)) for x in (smaller, larger))
    return all(a[name] == b[name] for name in a.keys() & b.keys() - fitted)


def _absent(absent: float, name: Real) -> float:
    value = absent.get(name, 0.0) if isinstance(absent, dict) else absent
    return float(require_number("compare", "absent", value, math.isfinite, "be finite"))
