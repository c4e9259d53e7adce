"""Transforms, which keep a parameter positive, inside bounds, or fixed during a fit.

`fit` works with unbounded numbers x. A transform maps them to parameters p, entry by entry:

    none          p = scale x
    positive      p = exp(x)
    bounded       p = lower + (upper - lower)/(1 + exp(-x));  with one bound: lower + exp(x), or upper - exp(-x)
    fixed         p stays as it is in params0

A step of Levenberg-Marquardt changes the x of a positive or bounded parameter by at most 1. Over a longer step the
exponential is too far from a straight line.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.description import Array, PyTree, Real


class Transform:
    """Base of the transforms; frozen, hashable, and static in a pytree."""

    expectation = "be real"
    longest_step = 1.0  # in x

    def __init_subclass__(cls):
        jax.tree_util.register_static(cls)

    def contains(self, p: Real) -> np.ndarray:
        """Which of the values p the transform can reach."""
        return np.full(np.shape(p), True)

    def parameter(self, x, scale):
        """The parameter p for x. scale: typical size of p, used only by the transform without bounds."""
        raise NotImplementedError

    def coordinate(self, p, scale):
        """The number x for a parameter p."""
        raise NotImplementedError

    def bend(self, x):
        """p''/p' at x, the relative curvature of the transform."""
        raise NotImplementedError

    def ends(self, dtype: Any = float):
        """The bounds of p."""
        return np.asarray(-np.inf, dtype), np.asarray(np.inf, dtype)

    def fits(self, shape: tuple) -> bool:
        """Whether the transform can be used for parameters of this shape."""
        return True

    def distance(self, p: Array) -> Array:
        """Distance of p from the nearer bound."""
        lower, upper = self.ends(p.dtype)
        return jnp.minimum(p - lower, upper - p)


@dataclass(frozen=True)
class Scaled(Transform):
    """p = scale x, the default."""

    longest_step = np.inf

    def parameter(self, x: Array, scale: Array) -> Array:
        """scale x."""
        return scale * x

    def coordinate(self, p: Array, scale: Array) -> Array:
        """p/scale."""
        return p / scale

    def bend(self, x: Array) -> Array:
        """0."""
        return jnp.zeros_like(x)


@dataclass(frozen=True)
class Positive(Transform):
    """p = exp(x)."""

    expectation = "be positive, for its transform"

    def ends(self, dtype: Any = float):
        """The bounds 0 and inf."""
        return np.asarray(0.0, dtype), np.asarray(np.inf, dtype)

    def contains(self, p: Array) -> Real:
        """p > 0."""
        return np.asarray(p) > 0

    def parameter(self, x: Array, scale: Array) -> Array:
        """exp(x), which never underflows to 0."""
        p = jnp.exp(x)
        return jnp.maximum(p, jnp.finfo(p.dtype).tiny)

    def coordinate(self, p: Array, scale: Array) -> Array:
        """log(p)."""
        return jnp.log(p)

    def bend(self, x: Array) -> Array:
        """1."""
        return jnp.ones_like(x)


@dataclass(frozen=True)
class Bounded(Transform):
    """p between lower and upper. The bounds are numbers, or nested tuples (which are hashable); inf means no bound."""

    lower: Any
    upper: Any

    @property
    def expectation(self):
        """What an error message says about the values."""
        return f"lie between {self.lower} and {self.upper}, for its transform"

    def ends(self, dtype: Any = float):
        """The bounds as arrays."""
        return np.asarray(self.lower, dtype), np.asarray(self.upper, dtype)

    @property
    def longest_step(self) -> np.ndarray:
        """1 where there is a bound, otherwise inf."""
        lower, upper = self.ends()
        return np.where(np.isfinite(lower) | np.isfinite(upper), 1.0, np.inf)

    def fits(self, shape: tuple) -> bool:
        """Whether the bounds have the shape of a parameter, or are numbers."""
        return all(np.shape(bound) in ((), tuple(shape)) for bound in (self.lower, self.upper))

    def contains(self, p) -> Real:
        """lower < p < upper."""
        p = np.asarray(p)
        lower, upper = self.ends(np.result_type(p.dtype, np.float16))
        return (p > lower) & (p < upper)

    def parameter(self, x: Array, scale: Real) -> Array:
        """lower + (upper - lower)/(1 + exp(-x)); with one bound lower + exp(x) or upper - exp(-x); without, scale x."""
        lower, upper = self.ends(x.dtype)
        has_lower, has_upper = np.isfinite(lower), np.isfinite(upper)
        p = self._between(x, np.where(has_lower, lower, 0), np.where(has_upper, upper, 1))
        if not np.all(has_lower & has_upper):  # exp is not even traced where it is not needed
            p = jnp.where(has_lower & has_upper, p, scale * x)
            p = jnp.where(has_lower & ~has_upper, np.where(has_lower, lower, 0) + jnp.exp(x), p)
            p = jnp.where(~has_lower & has_upper, np.where(has_upper, upper, 0) - jnp.exp(-x), p)
        tiny = jnp.finfo(p.dtype).tiny
        least, most = np.nextafter(lower, upper), np.nextafter(upper, lower)  # what rounds to a bound stays inside
        inside = jnp.clip(p, np.maximum(least, lower + tiny), np.minimum(most, upper - tiny))
        return jnp.where(jnp.isfinite(p), p + lax.stop_gradient(inside - p), inside)  # with the derivative of p

    @staticmethod
    def _between(x: Array, lower: np.ndarray, upper: np.ndarray) -> Array:
        """Between two finite bounds."""
        share = jax.nn.sigmoid(jnp.where(x > 0, -x, x))  # from the nearer bound on: so its derivative is never 0
        away = (upper - lower) * share
        return jnp.where(x > 0, upper - away, lower + away)

    def coordinate(self, p: Array, scale: Real) -> Array:
        """The inverse of `parameter`."""
        lower, upper = self.ends(p.dtype)
        has_lower, has_upper = np.isfinite(lower), np.isfinite(upper)
        above = jnp.where(has_lower, p - np.where(has_lower, lower, 0), 1)
        below = jnp.where(has_upper, np.where(has_upper, upper, 0) - p, 1)
        return jnp.where(has_lower | has_upper, jnp.log(above / below), p / scale)

    def bend(self, x: Array) -> Array:
        """-tanh(x/2); with one bound 1 or -1; without bounds 0."""
        lower, upper = (np.isfinite(bound) for bound in self.ends())
        one_sided = lower.astype(float) - upper.astype(float)
        return jnp.where(lower & upper, -jnp.tanh(x / 2), one_sided.astype(x.dtype))


@dataclass(frozen=True)
class Fixed(Transform):
    """p is not fitted, and has no coordinate x."""


scaled = Scaled()
positive = Positive()
fixed = Fixed()


def bounded(lower: Real = None, upper: Real = None) -> Bounded:
    """A transform that keeps a parameter strictly between two bounds, or on one side of a single bound.

    Args:
        lower, upper: numbers, or arrays with the shape of the parameter; None, -inf or inf where there is no bound.

    Returns:
        A transform for `fit(transforms=...)`.

    Raises:
        TypeError, ValueError: a bound that is not real, or is NaN; lower >= upper; no bound at all.

    >>> import hhtjax
    >>> result = hhtjax.fit(lambda p: p - jax.numpy.array([2.0, 3.0]), 0.5, transforms=hhtjax.bounded(0, 1))
    >>> round(float(result.params), 3)                                          # 2.5 without the bound
    1.0
    >>> result = hhtjax.fit(lambda p: p - jax.numpy.array([2.0, 3.0]), 5.0, transforms=hhtjax.bounded(lower=4))
    >>> round(float(result.params), 3)
    4.0
    """
    ends = [_bound(name, y, none) for name, y, none in (("lower", lower, -np.inf), ("upper", upper, np.inf))]
    if not np.all(ends[0] < ends[1]):
        raise ValueError(f"bounded: `lower` must be less than upper; received {lower} and {upper}.")
    if np.all(np.isinf(ends[0])) and np.all(np.isinf(ends[1])):
        raise ValueError(f"bounded: a bound must be finite; received {lower} and {upper}.")
    return Bounded(*(_hashable(y.tolist()) for y in ends))


def _bound(name: str, given: PyTree, none: float) -> np.ndarray:
    """A bound as an array of floats."""
    if given is None:
        return np.asarray(none)
    try:
        bound = np.asarray(given, float) if np.asarray(given).dtype.kind in "iuf" else None
    except (TypeError, ValueError, jax.errors.TracerArrayConversionError):
        bound = None
    if bound is None:
        raise TypeError(f"bounded: `{name}` must be a real number, an array of them, or None; received {given!r}.")
    if np.any(np.isnan(bound)) or np.any(bound == -none):
        raise ValueError(f"bounded: `{name}` must be finite, or {none} for no bound; received {given}.")
    return bound


def _hashable(x: PyTree) -> PyTree:
    return tuple(map(_hashable, x)) if isinstance(x, list) else x


def is_transform(x: PyTree) -> bool:
    """Whether x is a transform, or None."""
    return x is None or isinstance(x, Transform)


def per_leaf(prefix: PyTree, tree: PyTree):
    """The transform of each leaf of `tree`, given for leaves or whole branches; None stands for `scaled`."""
    repeated = jax.tree.map(
        lambda T, branch: [scaled if T is None else T] * len(jax.tree.leaves(branch)),
        prefix,
        tree,
        is_leaf=is_transform,
    )
    return tuple(jax.tree.leaves(repeated, is_leaf=is_transform))
