"""Coordinates for fitting: what keeps a parameter positive, inside bounds, or fixed.

`fit` moves numbers x without limits, and a transform turns them into parameters p, entry by entry:

    none          p = scale x
    positive      p = exp(x)
    bounded       p = lower + (upper - lower)/(1 + exp(-x))
    fixed         p stays as it is in params0

A step of Levenberg-Marquardt changes the x of a positive or bounded parameter by at most 1: for more, the exponential
is no straight line.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.checks import require_number


class Transform:
    """Base of the transforms; frozen, hashable, and static in a pytree."""

    expectation = "be real"
    longest_step = 1.0  # in x
    lower, upper = -np.inf, np.inf  # of p

    def __init_subclass__(cls):
        jax.tree_util.register_static(cls)

    def contains(self, p):
        """Whether the values p can be reached."""
        return np.full(np.shape(p), True)

    def parameter(self, x, scale):
        """p of x; scale: typical size of p, used by the plain transform only."""
        raise NotImplementedError

    def coordinate(self, p, scale):
        """x of p."""
        raise NotImplementedError

    def bend(self, x):
        """p''/p' at x."""
        raise NotImplementedError

    def distance(self, p):
        """Of p from the nearer bound."""
        return jnp.minimum(p - self.lower, self.upper - p)


@dataclass(frozen=True)
class Scaled(Transform):
    """p = scale x, the default."""

    longest_step = np.inf

    def parameter(self, x, scale):
        """scale x."""
        return scale * x

    def coordinate(self, p, scale):
        """p/scale."""
        return p / scale

    def bend(self, x):
        """0."""
        return jnp.zeros_like(x)


@dataclass(frozen=True)
class Positive(Transform):
    """p = exp(x)."""

    expectation = "be positive, for its transform"
    lower = 0.0

    def contains(self, p):
        """p > 0."""
        return np.asarray(p) > 0

    def parameter(self, x, scale):
        """exp(x), which never underflows to 0."""
        p = jnp.exp(x)
        return jnp.maximum(p, jnp.finfo(p.dtype).tiny)

    def coordinate(self, p, scale):
        """log(p)."""
        return jnp.log(p)

    def bend(self, x):
        """1."""
        return jnp.ones_like(x)


@dataclass(frozen=True)
class Bounded(Transform):
    """p between lower and upper."""

    lower: float
    upper: float

    @property
    def expectation(self):
        """Words for an error."""
        return f"lie between {self.lower} and {self.upper}, for its transform"

    def contains(self, p):
        """lower < p < upper."""
        return (np.asarray(p) > self.lower) & (np.asarray(p) < self.upper)

    def parameter(self, x, scale):
        """lower + (upper - lower)/(1 + exp(-x))."""
        share = jax.nn.sigmoid(jnp.where(x > 0, -x, x))  # from the nearer bound on: so its derivative is never 0
        away = (self.upper - self.lower) * share
        p = jnp.where(x > 0, self.upper - away, self.lower + away)
        lower, upper = (np.asarray(bound, p.dtype) for bound in (self.lower, self.upper))
        tiny = jnp.finfo(p.dtype).tiny
        least, most = np.nextafter(lower, upper), np.nextafter(upper, lower)  # what rounds to a bound stays inside
        inside = jnp.clip(p, np.maximum(least, lower + tiny), np.minimum(most, upper - tiny))
        return p + lax.stop_gradient(inside - p)  # with the derivative of p

    def coordinate(self, p, scale):
        """log((p - lower)/(upper - p))."""
        return jnp.log((p - self.lower) / (self.upper - p))

    def bend(self, x):
        """-tanh(x/2)."""
        return -jnp.tanh(x / 2)


@dataclass(frozen=True)
class Fixed(Transform):
    """p as it is; not a coordinate at all."""


scaled = Scaled()
positive = Positive()
fixed = Fixed()


def bounded(lower: float, upper: float) -> Bounded:
    """A transform that keeps a parameter strictly between two numbers.

    Args:
        lower, upper: numbers.

    Returns:
        What `fit(transforms=...)` takes.

    Raises:
        TypeError, ValueError: a bound is no finite number, or lower >= upper.

    >>> import hhtjax
    >>> result = hhtjax.fit(lambda p: p - jax.numpy.array([2.0, 3.0]), 0.5, transforms=hhtjax.bounded(0, 1))
    >>> round(float(result.params), 3)                                          # 2.5 without the bound
    1.0
    """
    for name, value in (("lower", lower), ("upper", upper)):
        require_number("bounded", name, value, np.isfinite, "be finite")
    if lower >= upper:
        raise ValueError(f"bounded: `lower` must be less than upper; received {lower} and {upper}.")
    return Bounded(float(lower), float(upper))


def is_transform(x):
    """Whether it is one, or None for none."""
    return x is None or isinstance(x, Transform)


def per_leaf(prefix, tree):
    """The transform of each leaf of `tree`, given for leaves or whole branches; None stands for `scaled`."""
    repeated = jax.tree.map(
        lambda T, branch: [scaled if T is None else T] * len(jax.tree.leaves(branch)),
        prefix,
        tree,
        is_leaf=is_transform,
    )
    return tuple(jax.tree.leaves(repeated, is_leaf=is_transform))
