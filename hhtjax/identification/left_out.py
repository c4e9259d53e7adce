"""Fits with one segment of the residuals left out after the other, and their errors there."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from hhtjax.description import freeze, thaw
from hhtjax.description.presentation import overwrite
from hhtjax.identification.evidence import count, residuals_of
from hhtjax.identification.identify import fit
from hhtjax.identification.residuals import spread_weights
from hhtjax.identification.sandwich import in_time


def _segment(shape, folds, fold):
    """Which entries of a leaf of the residuals are in one of its `folds` segments."""
    order = in_time([shape])
    inside = np.zeros(order.size, bool)
    inside[order] = np.arange(order.size) // -(-order.size // folds) == fold
    return inside.reshape(shape)


def require_residuals_of(name, result, function):
    """An error unless the function gives a fit's residuals again, but for a small part of them, or for what a change
    of the parameters by some 1e-8 does."""
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
            f"received others, of {np.linalg.norm(again):.6g}."
        )


def leave_out(fits, functions, folds, always, options, progress):
    """For each fit, and each segment, what `_leave_out` says: two arrays."""
    left = [_leave_out(name, fits[name], functions[name], folds, always, options, progress) for name in fits]
    segments = sorted({len(errors) for errors, _ in left})
    if len(segments) > 1 or segments[0] < 2:
        raise ValueError(
            "compare: `folds` must leave two segments or more with residuals to judge by, as many in all fits; "
            f"received {folds}, which leaves {', '.join(map(str, segments))}."
        )
    errors, converged = zip(*left, strict=True)
    return np.array(errors), np.array(converged)


def _leave_out(name, result, function, folds, always, options, progress):
    """rms of each segment by the parameters fitted to the others, and whether these fits converged.

    A segment without a residual to judge by is none: few residuals make fewer segments than `folds`.
    """
    weights = spread_weights("compare", result.weights, result.residual)
    always = spread_weights("compare", False if always is None else always, result.residual, "always")
    structure = jax.tree.structure(freeze(result.params))
    structured, errors, converged = jax.tree.structure(result.residual), [], []
    judges = [np.asarray((w != 0) & (y == 0)) for w, y in zip(weights, always, strict=True)]
    cuts = [[_segment(x.shape, folds, fold) & x for x in judges] for fold in range(folds)]
    cuts = [out for out in cuts if any(map(np.any, out))]
    for number, out in enumerate(cuts, 1):
        if progress:
            overwrite(f"compare: {name}, segment {number} of {len(cuts)} left out", last=number == len(cuts))
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
