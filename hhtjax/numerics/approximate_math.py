"""Fast logarithm and exponential, accurate to four digits or more, for error control: XLA's own would take half a step.

Also rounding to few digits, so that programs that round differently get the same numbers.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.description import Array

LN2 = float(np.log(2))
DIGITS = 16  # binary: fewer than rounding, grown along a run, mostly reaches; a step need not be known better
# minimax: ln m on [1, 2], to 2e-7; and exp x on [-2.4, 0.9], to 1e-5 of it
LOG = (
    *(-2.24963549223, 4.94489123887, -5.1945355416, 4.0073884961),
    *(-2.06905906492, 0.677963696552, -0.127497239493, 0.010484098918),
)
EXP = (
    *(0.999996472606, 0.999950093636, 0.499990383339, 0.166877664253),
    *(0.0418572706014, 0.00822289493944, 0.00116928389039, 8.68776395134e-05),
)


def approximate_log(x: Array) -> Array:
    """ln x of positive normal numbers, to 2e-7, of float32 numbers to 7e-6.

    >>> x = np.float32([1e-9, 0.3, 1.0, 7.0, 1e9])
    >>> bool(jnp.all(abs(approximate_log(jnp.asarray(x)) - np.log(x)) < 1e-5))
    True
    """
    digits = jnp.finfo(x.dtype).nmant
    one, integers = np.ones((), x.dtype), np.dtype(f"i{x.dtype.itemsize}")
    bits, bits_of_one = lax.bitcast_convert_type(x, integers), one.view(integers)
    part = lax.bitcast_convert_type((bits & ((1 << digits) - 1)) | bits_of_one, x.dtype)  # in [1, 2)
    a, b, *others = LOG
    # (bits - those of 1) 2^-digits is the exponent, and part - 1
    rest = (bits - bits_of_one).astype(x.dtype) * (LN2 * 2.0**-digits)
    return _polynomial((a + LN2, b - LN2, *others), part) + rest


def approximate_exp(x: Array) -> Array:
    """exp(x), to a relative error of 1e-5 for x from -2.4 to 0.9.

    For smaller x the result is less than exp(-2.4), for larger x more than exp(0.9).

    >>> x = jnp.linspace(-2.4, 0.9, 99)
    >>> bool(jnp.all(abs(approximate_exp(x) / np.exp(x) - 1) < 2e-5))
    True
    """
    return _polynomial(EXP, x)


def without_rounding(x: Array, more: int = 0) -> Array:
    """A positive x rounded to the nearest number of 16 binary digits, plus `more` units in its last place.

    Two numbers that differ only by rounding usually give the same result.

    >>> bool(without_rounding(jnp.asarray(1.3)) == without_rounding(jnp.asarray(1.3) * (1 + jnp.finfo(float).eps)))
    True
    >>> print(without_rounding(jnp.array([1.0, 1.3])), without_rounding(jnp.ones(1), more=1) - 1 == 2.0**-DIGITS)
    [1.         1.30000305] [ True]
    """
    unit = 1 << (jnp.finfo(x.dtype).nmant - DIGITS)
    integers = np.dtype(f"i{x.dtype.itemsize}")
    bits = lax.bitcast_convert_type(x, integers) + np.array(unit // 2 + more * unit, integers)
    return lax.bitcast_convert_type(bits & np.array(-unit, integers), x.dtype)


def _polynomial(coefficients: tuple, x: Array) -> Array:
    """Estrin's scheme for eight of them, which waits less than Horner's."""
    a, b, c, d, e, f, g, h = coefficients
    z = x * x
    return (a + b * x) + z * (c + d * x) + z * z * ((e + f * x) + z * (g + h * x))
