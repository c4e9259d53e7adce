"""The functions of Stumpff, of which finite rotations are made: ck(x) = 1/k! - x/(k + 2)! + x^2/(k + 4)! - ...

    c(k) = 1/k! - x c(k + 2),        dc(k)/dx = (k c(k + 2) - c(k + 1))/2

With t = sqrt(x), c1 = sin t / t and c2 = (1 - cos t) / t^2. Analytic in x; values and derivatives of all orders are
right at x = 0 too. A derivative takes c(n + 1) and c(n + 2) and nothing else: one pair of series, as the value does.
"""

from functools import reduce
from math import factorial

import jax.numpy as jnp

from hhtjax.xla import Family

NEAR, TERMS = 4, 11  # x below which two neighbours are series, of so many terms; the recursion up cancels towards 0


def coefficients(x):
    """c1, ..., c5 at a scalar x >= 0.

    >>> [round(1 / float(c)) for c in coefficients(jnp.array(0.0))]
    [1, 2, 6, 24, 120]
    """
    return stumpff(5, x)


def members(n, x):
    """c1, ..., cn: power series and recursion down for x < NEAR, definitions and recursion up beyond.

    >>> len(members(7, jnp.array(1.0)))
    7
    """
    small = x < NEAR
    y, x = jnp.where(small, x, 0), jnp.where(small, NEAR, x)  # no overflow in the branch not taken
    near = [series(n, y), series(n - 1, y)]
    for k in range(n - 2, 0, -1):
        near.append(1 / factorial(k) - y * near[-2])
    t = jnp.sqrt(x)
    s, c = jnp.sin(t / 2) / t, jnp.cos(t / 2)  # 1 - cos t would cancel towards 2 pi
    far, inverse = [2 * s * c, 2 * s**2], 1 / x
    for k in range(1, n - 1):
        far.append((1 / factorial(k) - far[-2]) * inverse)
    return tuple(jnp.where(small, a, b) for a, b in zip(reversed(near), far, strict=True))


def rule(stumpff, n, x, dx):
    """Values and tangents."""
    c1, *c = stumpff(n + 2, x)
    half = dx / 2
    return (c1, *c[: n - 1]), tuple((k * c[k] - c[k - 1]) * half for k in range(1, n + 1))


def series(k, y):
    """ck, to rounding for 0 <= y < NEAR.

    >>> float(series(1, jnp.array(0.0)))
    1.0
    """
    first, *rest = [(-1) ** j / factorial(2 * j + k) for j in reversed(range(TERMS))]
    return reduce(lambda value, c: value * y + c, rest, jnp.full_like(y, first))


stumpff = Family(members, rule)
