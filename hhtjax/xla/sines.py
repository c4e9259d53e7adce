"""Sines and cosines in a kernel, by polynomials. XLA:CPU would call a function for each float64 number, one by one.

With polynomials sine and cosine together take 2 ns instead of 8, and batches are vectorised. They are valid for
|x| <= RANGE. If any number of a batch is larger, infinite or NaN, a branch uses XLA's own functions, so that the result
is right for every x.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, reduce
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
from jax import lax

from hhtjax.description import Array

if TYPE_CHECKING:
    from jax.extend.core import ClosedJaxpr

NAME = "hhtjax_sines"
RANGE = 1e5  # largest |x|, rad
ONES = 3 * 2.0**51  # beyond it the last bit of a number is one

# pi/2 in three parts. Whole numbers up to 2^17 times one of the first two, of 36 bits, are exact.
HALF_PI = float.fromhex("0x1.921fb5444p+0"), float.fromhex("0x1.68c234c4cp-39"), float.fromhex("0x1.98a2e03707345p-77")

# (sin r - r)/r^3 and (cos r - 1 + r^2/2)/r^4 as polynomials in r^2, through Chebyshev's nodes of r^2 < (1.01 pi/4)^2
SINE = (
    -0.16666666666666666,
    0.0083333333333307,
    -0.00019841269836385435,
    2.7557315910939e-06,
    -2.5051092308431315e-08,
    1.5915309183057748e-10,
)
COSINE = (
    0.041666666666666664,
    -0.0013888888888887241,
    2.480158729853226e-05,
    -2.7557317151858866e-07,
    2.0876121534608454e-09,
    -1.1380868171449786e-11,
)


def polynomial_sines(x: Array, stage: Callable = lambda f: f):
    """(sin x, cos x) for float64 numbers |x| <= RANGE, to 2 units in the last place. Beyond RANGE results are invalid.

        x = k pi/2 + r,  |r| <= pi/4,    sin r = r + r^3 S(r^2),    cos r = 1 - r^2/2 + r^4 C(r^2)

    with pi/2 in three parts (Cody, Waite 1980) and S, C of degree 5.

    Args:
        x: rad, an array.
        stage: a transformation of functions after which their results are computed only once, as `staged`.

    Returns:
        Two arrays like x.

    Raises:
        nothing.

    >>> [round(float(y), 6) for y in polynomial_sines(jnp.asarray(jnp.pi / 6))]
    [0.5, 0.866025]
    """
    k, sine, cosine = _of_quarter(x, stage)
    odd, second_half = _is_odd(k), _is_odd(lax.floor(k / 2))
    sine, cosine = lax.select(odd, cosine, sine), lax.select(odd, sine, cosine)
    sine, cosine = lax.select(second_half, -sine, sine), lax.select(odd != second_half, -cosine, cosine)
    return lax.select(x == 0, x, sine), cosine  # -0 has a sine of its own


def _sines_by_bits(x: Array, stage: Callable):
    """`polynomial_sines` by the bits of k, with half the operations after the polynomials.

    It cannot be used where operations are listed or evaluated on scalars, which have no bits.
    """
    k, sine, cosine = _of_quarter(x, stage)
    bits = _bits(k + ONES)
    odd = lax.ne(bits & 1, jnp.int64(0))
    sine, cosine = lax.select(odd, cosine, sine), lax.select(odd, sine, cosine)
    return lax.select(x == 0, x, _with_sign(sine, bits)), _with_sign(cosine, bits + 1)


def _of_quarter(x: Array, stage: Callable):
    """k, sin r and cos r."""
    r, k = stage(_reduced)(x)
    return k, *stage(_near_zero)(r)


def _reduced(x: Array):
    """r and k."""
    k = lax.round(x * (2 / jnp.pi), lax.RoundingMethod.TO_NEAREST_EVEN)
    return reduce(lambda r, part: r - k * part, HALF_PI, x), k


def _near_zero(r: Array):
    """sin r and cos r."""
    z = r * r
    return r + r * z * _polynomial(SINE, z), 1 + z * (z * _polynomial(COSINE, z) - 0.5)


def _is_odd(k: Array) -> Array:
    """Of whole numbers; in floating point, because conversion to integers takes longer than all the rest."""
    return lax.floor(k / 2) != k / 2


def _polynomial(coefficients: tuple, z: Array) -> Array:
    """Horner's scheme; of a single number, with nothing to do beside it, Estrin's, which waits less."""
    if z.ndim:
        return reduce(lambda value, c: c + z * value, reversed(coefficients))
    a, b, c, d, e, f = coefficients
    return (a + b * z) + z * z * ((c + d * z) + z * z * (e + f * z))


def _bits(x: Array) -> Array:
    return lax.bitcast_convert_type(x, jnp.int64)


def _with_sign(x: Array, bits: Array) -> Array:
    """-x where the second bit of `bits` is set, else x."""
    sign = lax.shift_left(bits & 2, jnp.full_like(bits, 62))
    return lax.bitcast_convert_type(_bits(x) ^ sign, jnp.float64)


@lru_cache(maxsize=256)
def sines(avals: tuple, wanted: tuple) -> ClosedJaxpr:
    """A jaxpr of arrays that gives what is wanted, [("sin" or "cos", number of its operand)]."""
    shape, functions = avals[0].shape, {"sin": lax.sin, "cos": lax.cos}

    def exact(*x: Array):
        return [functions[name](x[i]) for name, i in wanted]

    def fast(*x: Array):
        pairs = [dict(zip(functions, _sines_by_bits(y, lambda f: f), strict=True)) for y in x]
        return [pairs[i][name] for name, i in wanted]

    def both(*x: Array):
        inside = reduce(lax.bitwise_and, (lax.abs(y) <= RANGE for y in x))
        return lax.cond(lax.reduce_and(inside, range(len(shape))) if shape else inside, fast, exact, *x)

    both.__name__ = NAME
    return jax.make_jaxpr(jax.jit(both))(*avals)
