"""Further analysis of a fit: missing terms, profile likelihoods, errors of predictions."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from hhtjax.checks import require_function, require_integer, require_number
from hhtjax.description import PyTree, Real, freeze, thaw
from hhtjax.description.presentation import shown
from hhtjax.identification import transforms as tf
from hhtjax.identification.evidence import count, residuals_of
from hhtjax.identification.gauss_newton import with_jacobian
from hhtjax.identification.identifiability import parameter_names
from hhtjax.identification.identify import fit
from hhtjax.identification.residuals import spread_weights
from hhtjax.identification.result import FitResult
from hhtjax.identification.sandwich import SEGMENTS, in_segments, in_time
from hhtjax.runs.progress import stages

if TYPE_CHECKING:
    from hhtjax.identification.sandwich import Uncertainty


@shown
class Score(NamedTuple):
    """Result of `score_test`: arrays (candidates,).

    Attributes:
        names: names of the candidates.
        statistic: about chi-squared with one degree of freedom if the term is absent in reality, so that 3.84 is the
            95 % and 10.8 the 99.9 % point.
        cost_drop: share of the cost that the term would remove.
        estimate: estimate of the candidate, by one Gauss-Newton step.

    All are 0 for a term whose effect the fitted parameters can reproduce, and if the residual is zero.
    """

    names: list
    statistic: np.ndarray
    cost_drop: np.ndarray
    estimate: np.ndarray


def score_test(
    residuals: Callable[[Any, Any], Any],
    params: PyTree,
    candidates: Any,
    segments: int = SEGMENTS,
    *,
    progress: bool = False,
) -> Score:
    """Tests which additional terms a model needs, from one Jacobian, without fitting the terms.

    Let x be a candidate's column of the Jacobian, minus its projection on the columns of the fitted parameters. Then

        statistic = (x^T r)^2 / sum_g (x_g^T r_g)^2,    cost_drop = (x^T r)^2/(|x|^2 |r|^2),    estimate = -x^T r/|x|^2

    The sum is over segments g of the residual, as in the cluster covariance. So it allows for correlated residuals.

    Args:
        residuals: (params, candidates) -> a pytree of arrays.
        params: parameters fitted without the candidates. candidates: the values at which the terms are absent, usually
            zeros.
        segments: number of segments.
        progress: shows in one line on stderr what is being computed.

    Returns:
        A `Score`.

    Raises:
        TypeError, ValueError: residuals is not a function of two arguments; params is a `FitResult`; segments is not an
            integer of 2 or more.

    References:
        Rao (1948); with sandwich variance, Boos, Am. Stat. 46 (1992).

    >>> import jax, jax.numpy as jnp, hhtjax
    >>> x = jnp.linspace(-1.0, 1.0, 400)
    >>> y = 2.0 * x + 0.5 * x**3 + 0.1 * jax.random.normal(jax.random.key(0), (400,))
    >>> model = lambda p, extra: p * x + extra["square"] * x**2 + extra["cube"] * x**3 - y
    >>> absent = {"square": 0.0, "cube": 0.0}
    >>> found = hhtjax.identification.score_test(model, hhtjax.fit(lambda p: model(p, absent), 1.0).params, absent)
    >>> dict(zip(found.names, (found.statistic > 10.8).tolist()))
    {'cube': True, 'square': False}
    """
    require_function("score_test", "residuals", residuals, "residuals(params, candidates)")
    if isinstance(params, FitResult):
        raise TypeError("score_test: `params` must be the parameters of a fit, result.params; received a FitResult.")
    segments = require_integer("score_test", "segments", segments, 2)
    params, candidates = (
        jax.tree.map(lambda x: jnp.asarray(x, jnp.result_type(float)), freeze(y)) for y in (params, candidates)
    )
    both, unravel = ravel_pytree((params, candidates))
    p = ravel_pytree(params)[0].size
    with stages("score_test", progress) as tell:
        tell(f"the residuals and their derivatives in {both.size} parameters and candidates")
        shapes = [x.shape for x in jax.tree.leaves(jax.eval_shape(lambda x: residuals(*thaw(unravel(x))), both))]
        r, J = jax.block_until_ready(with_jacobian(lambda x: ravel_pytree(residuals(*thaw(unravel(x))))[0], both))
    Q, _ = jnp.linalg.qr(J[:, :p])
    X = J[:, p:] - Q @ (Q.T @ J[:, p:])
    rounding = 10 * len(r) * float(jnp.finfo(r.dtype).eps) * jnp.linalg.norm(J[:, p:], axis=0)
    X = jnp.where(jnp.linalg.norm(X, axis=0) > rounding, X, 0)  # else the fitted parameters do all that it does
    by_time = (X * r[:, None])[in_time(shapes)]
    scores: Any = sum(part.sum(axis=1) for part in in_segments(by_time, [math.prod(x) for x in shapes], segments))
    total, square = scores.sum(axis=0), jnp.sum(X**2, axis=0)
    variance, left = jnp.sum(scores**2, axis=0), jnp.sum(r**2)
    return Score(
        parameter_names(candidates),
        np.asarray(total**2 / jnp.where(variance == 0, 1, variance)),
        np.asarray(total**2 / jnp.where(square * left == 0, 1, square * left)),
        np.asarray(-total / jnp.where(square == 0, 1, square)),
    )


@shown
class Profile(NamedTuple):
    """Result of `profile`.

    Attributes:
        values: values of the parameter, (values,).
        cost: the lowest cost with the parameter held at each value, (values,).
        deviance: 2 (cost - cost of the fit)/variance, (values,). The variance is chosen so that near the estimate this
            is the parabola of the standard error; 3.84 bounds the 95 % interval. NaN if the standard error is infinite.
    """

    values: PyTree
    cost: np.ndarray
    deviance: np.ndarray


def profile(residuals: Callable[..., Any], result: FitResult, name: str, values: Real, **options: Any) -> Profile:
    """The profile likelihood of one parameter: it is held at each value, and all others are fitted again.

    Args:
        residuals, options: as they were given to `fit`, except the transforms.
        result: the `FitResult`, with its covariance.
        name: name of a scalar parameter, as in `result.summary()`. values: values at which it is held.

    Returns:
        A `Profile`.

    Raises:
        TypeError, ValueError: result is not a `FitResult`, or has no covariance; no parameter has that name, or it is
            not a scalar leaf, or it was fixed.

    >>> import jax.numpy as jnp, hhtjax
    >>> x = jnp.linspace(0.0, 1.0, 200)
    >>> def residuals(p):
    ...     return p["a"] * x + p["b"] - 2.0 * x - 0.1 * jnp.sin(99.0 * x)
    >>> result = hhtjax.fit(residuals, {"a": 1.0, "b": 0.0})
    >>> found = hhtjax.identification.profile(residuals, result, "a", jnp.array([1.9, float(result.params["a"]), 2.1]))
    >>> [bool(x > 3.84) for x in found.deviance]                                      # outside of the 95 % interval
    [True, False, True]
    """
    believed = _uncertainty("profile", result)
    leaves, structure = jax.tree.flatten(freeze(result.params))
    names = [parameter_names(jax.tree.unflatten(structure, [x if i == k else None for k, x in enumerate(leaves)]))
             for i in range(len(leaves))]  # fmt: skip
    if [name] not in names or result.transforms[names.index([name])] is tf.fixed:
        scalars = [n for (n, *rest), T in zip(names, result.transforms, strict=True) if not rest and T is not tf.fixed]
        raise ValueError(f"profile: `name` must be one of {', '.join(scalars)}; received {name!r}.")
    at = names.index([name])
    transforms = [tf.fixed if i == at else T for i, T in enumerate(result.transforms)]
    costs = []
    params = leaves
    values = np.atleast_1d(np.asarray(values))
    for value in values:
        params = [jnp.asarray(value, x.dtype) if i == at else x for i, x in enumerate(params)]
        held = fit(
            residuals,
            structure.unflatten(params),
            transforms=structure.unflatten(transforms),
            covariance=False,
            **options,
        )
        costs.append(float(held.cost))
        params = jax.tree.leaves(freeze(held.params))
    row = int(np.flatnonzero(_flags(leaves, at))[0])
    variance = float(result.covariance[row, row] / result.embed(believed.inverse)[row, row])
    return Profile(values, np.asarray(costs), 2 * (np.asarray(costs) - float(result.cost)) / variance)


def _uncertainty(caller: str, result: PyTree) -> Uncertainty:
    if not isinstance(result, FitResult):
        raise TypeError(f"{caller}: `result` must be a FitResult; received {type(result).__name__}.")
    if result.uncertainty is None:
        raise ValueError(f"{caller}: `result` must have a covariance; received a fit made with covariance=False.")
    return result.uncertainty


def _flags(leaves: list, at: int) -> np.ndarray:
    return np.concatenate([np.full(np.size(x), i == at) for i, x in enumerate(leaves)])


def prediction_errors(predict: Callable[[Any], Any], result: FitResult, noise: float = 0.0) -> Any:
    """Standard errors of `predict(params)`: sqrt(diag(J C J^T) + noise^2), with J the Jacobian of predict.

    Args:
        predict: params -> any pytree of real arrays, such as the output for another input.
        result: a `FitResult` with its covariance C.
        noise: standard deviation of the noise of a new measurement.

    Returns:
        A pytree like the one that predict returns; inf where it depends on a parameter that the fit did not determine.

    Raises:
        TypeError, ValueError: predict is not a function; result is not a `FitResult`, or has no covariance; a negative
            noise.

    >>> import jax.numpy as jnp, hhtjax
    >>> t = jnp.arange(100.0)
    >>> result = hhtjax.fit(lambda p: p * jnp.ones(100) - jnp.sin(t), 0.0)
    >>> bool(hhtjax.identification.prediction_errors(lambda p: 3 * p, result) == 3 * result.standard_errors)
    True
    """
    require_function("prediction_errors", "predict", predict, "predict(params)")
    require_number("prediction_errors", "noise", noise, lambda x: x >= 0, "be 0 or more")
    _uncertainty("prediction_errors", result)
    x, unravel = ravel_pytree(freeze(result.params))
    shapes = jax.eval_shape(lambda x: predict(thaw(unravel(x))), x)
    _, unravel_output = ravel_pytree(jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes))
    J = jax.jacfwd(lambda x: ravel_pytree(predict(thaw(unravel(x))))[0])(x)
    unknown = jnp.isinf(jnp.diagonal(result.covariance))
    known = jnp.einsum("ip,pq,iq->i", J, jnp.where(unknown, 0, result.covariance), J)
    variance = jnp.where(jnp.any(unknown[None, :] & (J != 0), axis=1), jnp.inf, known)
    return unravel_output(jnp.sqrt(variance + noise**2))


# ----------------------------------------------------------------------------
# Cross-validation: fits without one segment of the residuals, and their errors on that segment.


def _segment(shape: tuple, folds: int, fold: int) -> np.ndarray:
    """Which entries of a leaf of the residuals are in one of its `folds` segments, as Booleans."""
    order = in_time([shape])
    inside = np.zeros(order.size, bool)
    inside[order] = np.arange(order.size) // -(-order.size // folds) == fold
    return inside.reshape(shape)


def require_residuals_of(name: str, result: FitResult, function: Callable):
    """Raises an error unless the function reproduces the residuals of a fit.

    A difference of a tenth of their norm is allowed, plus the change that relative changes of the parameters by some
    1e-8 make.
    """
    x, unravel = ravel_pytree(freeze(result.params))
    near = x * (1 + result.free * float(jnp.finfo(x.dtype).eps) ** 0.5)
    again, moved = (function(thaw(unravel(y))) for y in (x, near))
    given, received = (jax.tree.map(jnp.shape, r) for r in (result.residual, again))
    if received != given:
        raise ValueError(f"compare: `residuals` of {name!r} must be those fitted, {given}; received {received}.")
    every = (residuals_of(result._replace(residual=r)).weighted for r in (result.residual, again, moved))
    own, again, moved = (np.concatenate([np.ravel(r) for r in rs]) for rs in every)
    size, reach = np.linalg.norm(own), np.linalg.norm(moved - again)
    if not np.linalg.norm(again - own) <= size / 10 + reach:
        raise ValueError(
            f"compare: `residuals` of {name!r} must be those fitted, whose norm is {size:.6g} at the estimate; "
            f"received others, with norm {np.linalg.norm(again):.6g}."
        )


def leave_out(fits: dict, functions: dict, folds: int, always: np.ndarray, options: dict, progress: bool):
    """The two results of `_leave_out` for each fit and each segment, as arrays."""
    left = [_leave_out(name, fits[name], functions[name], folds, always, options, progress) for name in fits]
    segments = sorted({len(errors) for errors, _ in left})
    if len(segments) > 1 or segments[0] < 2:
        raise ValueError(
            "compare: `folds` must give two or more segments with residuals to evaluate, the same number in all fits; "
            f"received {folds}, which gives {', '.join(map(str, segments))}."
        )
    errors, converged = zip(*left, strict=True)
    return np.array(errors), np.array(converged)


def _leave_out(name: str, result: FitResult, function: Callable, folds: int, always, options: dict, progress: bool):
    """rms of each segment with the parameters fitted to the others, and whether these fits converged.

    A segment without a residual to evaluate does not count. So few residuals give fewer segments than `folds`.
    """
    weights = spread_weights("compare", result.weights, result.residual)
    always = spread_weights("compare", False if always is None else always, result.residual, "always")
    structure = jax.tree.structure(freeze(result.params))
    structured, errors, converged = jax.tree.structure(result.residual), [], []
    judges = [np.asarray((w != 0) & (y == 0)) for w, y in zip(weights, always, strict=True)]
    cuts = [[_segment(x.shape, folds, fold) & x for x in judges] for fold in range(folds)]
    cuts = [out for out in cuts if any(map(np.any, out))]
    with stages("compare", progress, len(cuts)) as tell:
        for number, out in enumerate(cuts, 1):
            tell(f"{name}, segment {number} of {len(cuts)} left out")
            kept = [np.where(x, 0, w) for x, w in zip(out, weights, strict=True)]
            again = fit(
                function,
                thaw(result.params),
                transforms=structure.unflatten(result.transforms),
                weights=structured.unflatten(kept),
                covariance=False,
                **options,
            )
            left = [np.where(x, w, 0) for x, w in zip(out, weights, strict=True)]
            judged = residuals_of(again._replace(weights=structured.unflatten(left)))
            square = sum(np.sum(r**2) for r in judged.weighted)
            errors.append(math.sqrt(square / count(judged)))
            converged.append(bool(again.converged))
    return errors, converged
