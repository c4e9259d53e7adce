"""Rotation vectors of all lengths, and what the tests of rotations compare with."""

from decimal import Decimal, localcontext
from functools import cache
from itertools import accumulate
from math import comb, factorial, perm, pi

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hhtjax.rotation import (
    coefficients,
    exp,
    hat,
    inverse_coefficient,
    inverse_tangent,
    log,
    orthonormalize,
    tangent,
    vee,
)

EPS = np.finfo(float).eps
EYE = np.eye(3)
AXES = np.concatenate([EYE, -EYE, Rotation.random(6, rng=1).as_matrix()[:, 0]])
# rad; the branches meet inside
ANGLES = 0.0, 1e-160, 1e-12, 1e-8, 1e-5, 1e-3, 0.489, 0.491, 0.999, 1.001, 1.999, 2.0, 2.001, 3.0
VECTORS = np.concatenate([angle * AXES for angle in ANGLES])
NEAR_PI = np.concatenate([angle * AXES for angle in (pi - 1e-3, pi - 1e-6, pi - 1e-9, pi - 1e-12)])
LONG = np.concatenate([angle * AXES for angle in (pi, 4.0, 6.0, 7.0, 20.0)])
ALL = np.concatenate([VECTORS, NEAR_PI, LONG])
VECTOR_FUNCTIONS = hat, exp, tangent, inverse_tangent
FUNCTIONS = *VECTOR_FUNCTIONS, vee, log, orthonormalize
ORDERS = 1, 2, pytest.param(3, marks=pytest.mark.slow)  # of derivatives


@cache
def batched(f):
    return jax.jit(jax.vmap(f))


def cross(x):
    """NumPy's cross product as a matrix."""
    return np.cross(x, -EYE)


def turns(psi):
    return Rotation.from_rotvec(psi).as_matrix()


def transposed(A):
    return np.swapaxes(A, -1, -2)


def assert_close(x, y, tolerance):
    np.testing.assert_allclose(x, y, rtol=0, atol=tolerance)


def six(x):
    """c1, ..., c5, and d of T^-1."""
    return *coefficients(x), inverse_coefficient(x)


def exact_coefficients(x, derivative):
    """The six, or a derivative of them with respect to x, from power series in 100 digits: exact to rounding."""
    with localcontext(prec=100):
        terms = range(40)
        powers = list(accumulate(terms[1:], lambda power, _: power * Decimal(float(x)), initial=Decimal(1)))
        c = {n: [Decimal(1) / factorial(2 * k + n) for k in terms] for n in range(1, 6)}
        e = [y - 2 * z for y, z in zip(c[3], c[4], strict=True)]

        def value(series, n):
            return sum((-1) ** k * series[k] * perm(k, n) * powers[k - n] for k in terms[n:])

        d, c2 = [], [value(c[2], i) for i in range(derivative + 1)]
        for n in range(derivative + 1):  # Leibniz on 2 c2 d = e
            d.append((value(e, n) / 2 - sum(comb(n, i) * c2[i] * d[n - i] for i in range(1, n + 1))) / c2[0])
        return [float(f) for f in (*(value(c[n], derivative) for n in c), d[-1])]


BRANCHES = np.ravel([x + np.linspace(-1e-9, 1e-9, 5) for x in (1, 4)])
X = np.concatenate([[0.0], np.geomspace(1e-16, 0.9, 40), BRANCHES, np.linspace(1.1, 36.0, 40)])
