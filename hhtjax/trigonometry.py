"""Sine and cosine by polynomials, for arrays outside of kernels, which XLA can then vectorise on the CPU.

XLA:CPU evaluates `jnp.sin` of float64 numbers one by one, at some 5 ns each. These functions are sums and products,
which take 2 ns for sine and cosine together. Inside a kernel `jnp.sin` and `jnp.cos` are such polynomials anyway
(`hhtjax.xla`). If a system is too large for a kernel, use these functions in its `mass` and `force`. A function that
takes its sine and cosine from a module can use this module instead of `jnp`
(`hhtjax.scenes.double_pendulum.stiff(trigonometry=hhtjax.trigonometry)`).

>>> import jax.numpy as jnp
>>> from hhtjax import trigonometry
>>> [round(float(x), 6) for x in trigonometry.sincos(jnp.pi / 6)]
[0.5, 0.866025]
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp

from hhtjax.description import Array
from hhtjax.primitives import staged
from hhtjax.xla import RANGE, polynomial_sines

__all__ = ["cos", "sin", "sincos"]


def __dir__():
    return __all__


@jax.custom_jvp
def sincos(x: Array) -> tuple[jax.Array, jax.Array]:
    """(sin x, cos x) for x in rad, elementwise.

        x = k pi/2 + r,  |r| <= pi/4,    sin r = r + r^3 S(r^2),    cos r = 1 - r^2/2 + r^4 C(r^2)

    with pi/2 in three parts (Cody, Waite 1980) and S, C of degree 5.

    In float64 the error is below 2 units in the last place of the result for |x| <= 1e5. Beyond that the result is NaN:
    wrap larger angles. In float32, which XLA vectorises itself, they are `jnp.sin` and `jnp.cos`. Integers become the
    default float type. Derivatives of any order consist of the same two values.

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
    return staged(partial(polynomial_sines, stage=staged))(jnp.where(jnp.abs(x) <= RANGE, x, jnp.nan))


@sincos.defjvp
def _sincos_jvp(primals: tuple, tangents: tuple):
    (sine, cosine), (dx,) = sincos(*primals), tangents
    return (sine, cosine), (cosine * dx, -sine * dx)


def sin(x: Array) -> jax.Array:
    """The sine of `sincos`.

    Args: x: rad, an array of any shape.
    Returns: Shaped like x.
    Raises: TypeError: x is not real.

    >>> round(float(sin(jnp.pi / 6)), 6)
    0.5
    """
    return sincos(x)[0]


def cos(x: Array) -> jax.Array:
    """The cosine of `sincos`.

    Args: x: rad, an array of any shape.
    Returns: Shaped like x.
    Raises: TypeError: x is not real.

    >>> round(float(cos(jnp.pi / 6)), 6)
    0.866025
    """
    return sincos(x)[1]
