"""The vector of coordinates that a fit moves, its residuals as functions of this vector, and their weights."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from hhtjax.description import Array, Kind, PyTree, Real, thaw
from hhtjax.identification import transforms as tf
from hhtjax.identification.residuals import check_residuals, require_own_samples, spread_weights

if TYPE_CHECKING:
    from hhtjax.description.current import Reading


class Data(NamedTuple):
    """The traced arguments of a fit besides params0: pytrees, or None where there is nothing."""

    scale: PyTree
    weights: PyTree
    prior: Any
    tolerance: Real
    records: Any
    starts: PyTree
    read: Any = None  # arrays that the residuals read, where these are a `Kind`

    def function(self, residuals: Callable | Reading) -> Callable | Reading:
        """The residuals, with the arrays that they read."""
        return residuals.of(self.read) if isinstance(residuals, Kind) else residuals


class Coordinates:
    """params as a function of the vector x that the optimiser moves."""

    def __init__(self, transforms: tuple, params0: PyTree, scale: PyTree):
        self.leaves, self.structure = jax.tree.flatten(params0)
        self.scales = jax.tree.leaves(scale)
        self.transforms = transforms
        self.free = [i for i, T in enumerate(transforms) if T is not tf.fixed]
        start = [transforms[i].coordinate(self.leaves[i], self.scales[i]) for i in self.free]
        x0, self.unravel = ravel_pytree(start)
        self.x0 = x0.astype(x0.dtype)  # as x is later: what is traced for a Python number is traced anew
        self.longest = longest_steps(transforms, self.leaves)

    def free_leaves(self, x: Array):
        """The fitted leaves."""
        return [
            self.transforms[i].parameter(y, self.scales[i]) for i, y in zip(self.free, self.unravel(x), strict=True)
        ]

    def params(self, x: Array) -> PyTree:
        """All leaves, as params0 has them."""
        changed = dict(zip(self.free, self.free_leaves(x), strict=True))
        return thaw(self.structure.unflatten([changed.get(i, leaf) for i, leaf in enumerate(self.leaves)]))

    def bend(self):
        """x -> p''/p' of the fitted entries; None where no bound makes it differ from 0."""

        def of(x: Array) -> Array:
            leaves = zip(self.free, self.unravel(x), strict=True)
            return ravel_pytree([self.transforms[i].bend(y) for i, y in leaves])[0]

        return None if np.all(np.isinf(self.longest)) else of

    def slope(self, x: Array) -> Array:
        """dp/dx of the fitted entries."""
        return jax.jvp(lambda x: ravel_pytree(self.free_leaves(x))[0], (x,), (jnp.ones_like(x),))[1]

    def of_prior(self, prior: dict):
        """Means and standard deviations for the fitted leaves."""
        pairs = [self.structure.flatten_up_to(prior)[i] for i in self.free]
        return [pair.mean for pair in pairs], [pair.deviation for pair in pairs]


def longest_steps(transforms: tuple, leaves: list, own: int = 0) -> np.ndarray:
    """The longest step of each entry of x over which a transform is nearly straight, (p + own,).

    own: number of unknowns of the records, which have no transform.
    """
    pairs = [(T, x) for T, x in zip(transforms, leaves, strict=True) if T is not tf.fixed]
    steps = [np.broadcast_to(T.longest_step, np.shape(x)).ravel() for T, x in pairs]
    return np.concatenate([*steps, np.full(own, np.inf)])


class DenseParts(NamedTuple):
    """A fit without records: residuals and priors f(x) (m + k,), and their weights w.

    unravel: turns the first m, the residuals, into a pytree.
    """

    f: Any
    w: PyTree
    unravel: Callable
    shapes: tuple  # of the leaves of the residuals

    @property
    def m(self) -> int:
        """Number of residuals, without priors."""
        return sum(map(math.prod, self.shapes))


def dense_parts(residuals: Callable | Reading, coordinates: Coordinates, data: PyTree) -> DenseParts:
    """One residual function of all parameters, with priors as further rows."""
    residuals = data.function(residuals)
    params0 = coordinates.params(coordinates.x0)
    shapes = check_residuals("fit", residuals, coordinates.x0.size, params0)
    require_own_samples("fit", residuals, shapes, params0)
    leaves = spread_weights("fit", data.weights, shapes)
    w, unravel = ravel_pytree(jax.tree.unflatten(jax.tree.structure(shapes), leaves))
    if data.prior is not None:
        means, deviations = coordinates.of_prior(data.prior)
        w = jnp.concatenate([w, 1 / ravel_pytree(deviations)[0]])

    def f(x: Array) -> Array:
        r, _ = ravel_pytree(residuals(coordinates.params(x)))
        if data.prior is None:
            return r
        away = [p - mean for p, mean in zip(coordinates.free_leaves(x), means, strict=True)]
        return jnp.concatenate([r, ravel_pytree(away)[0]])

    return DenseParts(f, w, unravel, tuple(leaf.shape for leaf in leaves))


class RecordParts(NamedTuple):
    """A fit of records: residuals f(x, own, record) (m,), weights w (records, m), and own unknowns own0 (records, k).

    unravel, unravel_start: turn residuals and own unknowns into pytrees.
    """

    f: Any
    w: PyTree
    own0: Array
    unravel: Callable
    unravel_start: Callable
    shapes: tuple  # of the leaves of the residuals, all records together


def record_parts(
    residuals: Callable, coordinates: Coordinates, data: PyTree, at_least: int | None = None
) -> RecordParts:
    """The `RecordParts` of a fit. at_least: least number of residuals, by default the number of unknowns."""
    _, unravel_start = ravel_pytree(first(data.starts))
    own0 = jax.vmap(lambda start: ravel_pytree(start)[0])(data.starts)

    def every(params: PyTree, starts: dict, records: Array) -> Array:
        return jax.vmap(partial(residuals, params))(starts, records)

    unknowns, params0 = coordinates.x0.size + own0.size, coordinates.params(coordinates.x0)
    at_least = unknowns if at_least is None else at_least
    shapes = check_residuals("fit", every, at_least, params0, data.starts, data.records)
    one = params0, first(data.starts), first(data.records)
    require_own_samples(
        "fit", residuals, jax.tree.map(lambda y: jax.ShapeDtypeStruct(y.shape[1:], y.dtype), shapes), *one
    )
    leaves = spread_weights("fit", data.weights, shapes)
    weights = jax.tree.unflatten(jax.tree.structure(shapes), leaves)
    w = jax.vmap(lambda x: ravel_pytree(x)[0])(weights)
    _, unravel = ravel_pytree(first(weights))

    def f(x: Array, own: Array, record: Array) -> Array:
        return ravel_pytree(residuals(coordinates.params(x), unravel_start(own), record))[0]

    return RecordParts(f, w, own0, jax.vmap(unravel), jax.vmap(unravel_start), tuple(x.shape for x in leaves))


def first(tree: PyTree) -> PyTree:
    """The first entry along the leading axis of each leaf."""
    return jax.tree.map(lambda x: x[0], tree)
