"""Sine and cosine by polynomials: for systems on the CPU, whose batches and loops XLA then vectorises.

XLA:CPU evaluates `jnp.sin` of float64 numbers one by one, at some 5 ns each. These are sums and products, 2 ns for sine
and cosine together. Put them in place of `jnp.sin` and `jnp.cos` in `mass` and `force`; the module as a whole can stand
where `jnp` does (`hhtjax.scenes.double_pendulum.stiff(trigonometry=hhtjax.trigonometry)`).

>>> import jax.numpy as jnp
>>> from hhtjax import trigonometry
>>> [round(float(x), 6) for x in trigonometry.sincos(jnp.pi / 6)]
[0.5, 0.866025]
"""

import jax
import jax.numpy as jnp

from hhtjax.xla import staged

__all__ = ["cos", "sin", "sincos"]


def __dir__():
    return __all__


RANGE = 1e5  # largest |x|, rad

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


@jax.custom_jvp
def sincos(x) -> tuple[jax.Array, jax.Array]:
    """(sin x, cos x) for x in rad, elementwise.

        x = k pi/2 + r,  |r| <= pi/4,    sin r = r + r^3 S(r^2),    cos r = 1 - r^2/2 + r^4 C(r^2)

    with pi/2 in three parts (Cody, Waite 1980) and S, C of degree 5.

    In float64 the error is below 2 units in the last place of the result for |x| <= 1e5, and the result NaN beyond:
    wrap angles that turn further. In float32, which XLA vectorises itself, they are `jnp.sin` and `jnp.cos`. Integers
    become the default float type. Derivatives, of any order, are made of the same two values.

    Args: x: rad, an array of any shape.
    Returns: (sin x, cos x), each shaped like x.
    Raises: TypeError: x is not real.

    >>> [round(float(x), 6) for x in sincos(jnp.pi / 6)]
    [0.5, 0.866025]
    """
    x = jnp.asarray(x)
    if not (jnp.issubdtype(x.dtype, jnp.floating) or jnp.issubdtype(x.dtype, jnp.integer)):
        raise TypeError(f"sincos: `x` must be real; received an array of {x.dtype}.")
    if x.dtype != jnp.float64:
        return jnp.sin(x), jnp.cos(x)
    return _in_stages(x)


@staged
def _reduced(x):
    """r and k; NaN and 0 beyond RANGE."""
    inside = jnp.abs(x) <= RANGE
    k = jnp.where(inside, jnp.round(x * (2 / jnp.pi)), 0)
    r = x
    for part in HALF_PI:
        r = r - k * part
    return jnp.where(inside, r, jnp.nan), k


@staged
def _near_zero(r):
    """sin r and cos r."""
    z = r * r
    return r + r * z * _polynomial(SINE, z), 1 - (z / 2 - z * z * _polynomial(COSINE, z))


@staged
def _in_stages(x):
    """sin x and cos x; what both need is computed once."""
    r, k = _reduced(x)
    sine, cosine = _near_zero(r)
    odd, second_half = _is_odd(k), _is_odd(jnp.floor(k / 2))
    sine, cosine = jnp.where(odd, cosine, sine), jnp.where(odd, sine, cosine)
    return jnp.where(second_half, -sine, sine), jnp.where(odd != second_half, -cosine, cosine)


def _is_odd(k):
    """Of whole numbers; in floating point, because conversion to integers takes longer than all the rest."""
    return jnp.floor(k / 2) != k / 2


@sincos.defjvp
def _sincos_jvp(primals, tangents):
    (sine, cosine), (dx,) = sincos(*primals), tangents
    return (sine, cosine), (cosine * dx, -sine * dx)


def _polynomial(coefficients, z):
    """Horner's scheme."""
    *lower, value = coefficients
    for c in reversed(lower):
        value = c + z * value
    return value


def sin(x) -> jax.Array:
    """The sine of `sincos`.

    Args: x: rad, an array of any shape.
    Returns: Shaped like x.
    Raises: TypeError: x is not real.

    >>> round(float(sin(jnp.pi / 6)), 6)
    0.5
    """
    return sincos(x)[0]


def cos(x) -> jax.Array:
    """The cosine of `sincos`.

    Args: x: rad, an array of any shape.
    Returns: Shaped like x.
    Raises: TypeError: x is not real.

    >>> round(float(cos(jnp.pi / 6)), 6)
    0.866025
    """
    return sincos(x)[1]
