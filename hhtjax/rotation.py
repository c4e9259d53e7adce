"""Finite rotations. Functions take one rotation; use jax.vmap for batches.

R (3, 3) maps material components to spatial ones; Rdot = R hat(Om), with Om the material angular velocity in rad/s. psi
(3,), in rad, is a rotation vector: a rotation by the angle |psi| about psi. With P = hat(psi), t = |psi| and x = t^2:

    exp  R    = I + c1 P + c2 P^2    c1 = sin t / t         c2 = (1 - cos t) / t^2
         T    = I - c2 P + c3 P^2    c3 = (t - sin t) / t^3
         T^-1 = I + P/2 + d P^2      d = (1 - (t/2) cot(t/2)) / t^2

c1, c2 and c3 are functions of Stumpff (rotation.py), analytic in x, so values and derivatives, forward and reverse, are
correct at psi = 0 too. Every function keeps the dtype (integers become floats). It raises TypeError unless it receives
an array of real numbers, and ValueError for a wrong shape.

Quaternions and Euler angles come from JAX, with the conventions of SciPy: quaternions are (x, y, z, w), and "ZYX" is a
yaw, then a pitch and a roll about the axes as they are turned. They work under jit, vmap and grad.

>>> from jax.scipy.spatial.transform import Rotation
>>> R = exp(jnp.array([0.0, 0.0, jnp.pi / 2]))
>>> print(Rotation.from_matrix(R).as_quat().round(4), Rotation.from_matrix(R).as_euler("ZYX", degrees=True).round(2))
[0.     0.     0.7071 0.7071] [90.  0.  0.]
>>> back = Rotation.from_quat(jnp.array([0.0, 0.0, 1.0, 1.0])).as_matrix()                   # scaled to length 1
>>> bool(jnp.allclose(back, R, atol=1e-6)), bool(jnp.allclose(Rotation.from_euler("Z", jnp.pi / 2).as_matrix(), R))
(True, True)

For rotation vectors use `exp` and `log`: derivatives of JAX's `from_rotvec`, `as_rotvec` and `magnitude` are NaN at the
identity. Euler angles have no derivative at gimbal lock, for "ZYX" a pitch of +-90 degrees, and `as_euler` does not
report it. A quaternion and its negative are one rotation. Along a motion `as_quat` may change from one to the other;
with `canonical=True` w is not negative.

Reference: Cardona, Geradin, Computers & Structures 33 (1989) 801-820, Sec. 3.
"""

from __future__ import annotations

from functools import partial, reduce
from math import factorial

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.checks import require_number
from hhtjax.description import Array, Real, is_array, is_real
from hhtjax.primitives import Bilinear, Family, structural

__all__ = [
    "cross",
    "exp",
    "hat",
    "inverse_tangent",
    "is_rotation",
    "log",
    "orthonormalize",
    "product",
    "tangent",
    "tangent_rate",
    "vee",
]


def __dir__():
    return __all__


GENERATORS = np.array(  # hat(x) = x_1 G_1 + x_2 G_2 + x_3 G_3
    [[[0, 0, 0], [0, 0, -1], [0, 1, 0]], [[0, 0, 1], [0, 0, 0], [-1, 0, 0]], [[0, -1, 0], [1, 0, 0], [0, 0, 0]]]
)
ARCTANGENT = tuple(1 / (2 * k + 1) for k in range(16))  # arctan(z) / z in powers of -z^2: to rounding for z < 1/4


def hat(x: Array) -> jax.Array:
    """The matrix (3, 3) of the cross product with x (3,): hat(x) y = x cross y.

    Args: x: (3,).
    Returns: (3, 3).
    Raises: TypeError, ValueError: not an array of real numbers, or of another shape.

    >>> print(hat(jnp.array([1.0, 2.0, 3.0])))
    [[ 0. -3.  2.]
     [ 3.  0. -1.]
     [-2.  1.  0.]]
    """
    x = _real("hat", "x", x, (3,))
    return jnp.sum(x[:, None, None] * structural(GENERATORS.astype(x.dtype)), axis=0)


def vee(X: Array) -> jax.Array:
    """The inverse of `hat`: x (3,) with hat(x) = X; if X (3, 3) is not skew, the result for (X - X^T)/2.

    Args: X: (3, 3).
    Returns: (3,).
    Raises: TypeError, ValueError: not an array of real numbers, or of another shape.

    >>> print(vee(hat(jnp.array([1.0, 2.0, 3.0]))))
    [1. 2. 3.]
    """
    X = _real("vee", "X", X, (3, 3))
    return jnp.sum(X[None, :, :] * structural(GENERATORS.astype(X.dtype)), axis=(1, 2)) / 2


def exp(psi: Real) -> jax.Array:
    """R (3, 3) = I + c1 P + c2 P^2, the rotation by psi (3,), in rad (Rodrigues); orthogonal to rounding.

    Args: psi: (3,), in rad.
    Returns: (3, 3).
    Raises: TypeError, ValueError: not an array of real numbers, or of another shape.

    >>> print((exp(jnp.array([0.0, 0.0, jnp.pi / 2])) @ jnp.array([1.0, 0.0, 0.0])).round(6) + 0.0)
    [0. 1. 0.]
    """
    psi = _real("exp", "psi", psi, (3,))
    c1, c2, *_ = coefficients(jnp.sum(psi**2))
    return _polynomial(psi, c1, c2)


def log(R: Array) -> jax.Array:
    """psi (3,), in rad, with exp(psi) = R and |psi| <= pi, for a rotation R (3, 3). Accurate to rounding at all angles.

    At |psi| = pi, where psi and -psi are the same rotation, the largest component of the result is positive if R is
    exactly symmetric; otherwise rounding in R decides. Derivatives are correct for changes of R that keep it a
    rotation: d log(R exp(eps)) = T^-1(psi) d eps at eps = 0. At pi they are one-sided: the derivatives of the returned
    branch, towards smaller angles.

    The result is computed from the quaternion q of R, from the largest column of 4 q q^T (Bar-Itzhack, J. Guidance 23
    (2000) 1085-1087).

    Args: R: a rotation, (3, 3).
    Returns: (3,), in rad.
    Raises: TypeError, ValueError: not an array of real numbers, or of another shape.

    >>> print(log(exp(jnp.array([0.0, 0.0, 3.0]))))
    [0. 0. 3.]
    """
    R = _real("log", "R", R, (3, 3))
    trace, v = R[0, 0] + R[1, 1] + R[2, 2], vee(R - R.T)
    block = R + R.T + (1 - trace) * structural(np.eye(3, dtype=R.dtype))
    products = jnp.block([[(1 + trace)[None, None], v[None, :]], [v[:, None], block]])  # 4 q q^T
    q = products[jnp.argmax(products.ravel()[:: len(products) + 1])]  # a multiple of the quaternion
    q = jnp.where(q[0] < 0, -q, q)
    q0, q = q[0], q[1:]
    y = jnp.sum(q**2)
    small = 16 * y < q0**2  # an angle below 0.49
    near = jnp.where(small, q0, 1)
    far = jnp.sqrt(jnp.where(small, 1, y))
    series = _power_series(ARCTANGENT, jnp.where(small, -y, 0) / near**2) / near
    return 2 * jnp.where(small, series, jnp.arctan2(far, q0) / far) * q


def tangent(psi: Array) -> jax.Array:
    """T (3, 3) = I - c2 P + c3 P^2 for psi (3,), in rad: Om = T psidot is the angular velocity of R0 exp(psi), for any
    constant R0.

    T^T maps moments in material components to the generalised forces conjugate to psi. det T = 2 c2, so T is singular
    at 2 pi.

    Args: psi: (3,), in rad.
    Returns: (3, 3).
    Raises: TypeError, ValueError: not an array of real numbers, or of another shape.

    >>> psi = jnp.array([0.0, 0.0, 2.0])
    >>> print(tangent(psi) @ psi)                              # about a fixed axis, Om = psidot
    [0. 0. 2.]
    """
    psi = _real("tangent", "psi", psi, (3,))
    _, c2, c3, *_ = coefficients(jnp.sum(psi**2))
    return _polynomial(psi, -c2, c3)


def inverse_tangent(psi: Array) -> jax.Array:
    """T^-1 (3, 3) = I + P/2 + d P^2 for psi (3,), in rad: psidot = T^-1 Om.

    It grows without bound towards |psi| = 2 pi, where T is singular; there the result is inf, NaN or meaningless.

    Args: psi: (3,), in rad.
    Returns: (3, 3).
    Raises: TypeError, ValueError: not an array of real numbers, or of another shape.

    >>> psi = jnp.array([0.3, -0.2, 0.1])
    >>> print((inverse_tangent(psi) @ tangent(psi)).round(6) + 0.0)
    [[1. 0. 0.]
     [0. 1. 0.]
     [0. 0. 1.]]
    """
    psi = _real("inverse_tangent", "psi", psi, (3,))
    return _polynomial(psi, 0.5, inverse_coefficient(jnp.sum(psi**2)))


def tangent_rate(psi: Array, psidot: Array) -> jax.Array:
    """Tdot psidot (3,), in rad/s^2, for psi (3,) with the rate psidot (3,), in rad/s: Omdot = T psiddot + Tdot psidot.

        Tdot psidot = xdot (-dc2/dx P + dc3/dx P^2) psidot + c3 psidot x (psi x psidot),    xdot = 2 psi.psidot

    Args: psi: (3,), in rad. psidot: (3,), in rad/s.
    Returns: (3,), in rad/s^2.
    Raises: TypeError, ValueError: not an array of real numbers, or of another shape.

    >>> print(tangent_rate(jnp.zeros(3), jnp.array([1.0, 2.0, 3.0])))
    [0. 0. 0.]
    """
    psi, psidot = _real("tangent_rate", "psi", psi, (3,)), _real("tangent_rate", "psidot", psidot, (3,))
    _, _, c3, c4, c5 = coefficients(jnp.sum(psi**2))
    first = cross(psi, psidot)
    stretch = (c3 - 2 * c4) * first + (3 * c5 - c4) * cross(psi, first)  # half of xdot has gone into the derivatives
    return jnp.sum(psi * psidot) * stretch + c3 * cross(psidot, first)


def orthonormalize(R: Array) -> jax.Array:
    """R (3, 3) closer to a rotation: one step R (3 I - R^T R)/2 of Newton and Schulz, which squares the distance.

    Use it for products of many rotations, whose rounding errors accumulate. At a rotation, its derivative projects dR
    onto the tangent space of the rotations.

    Args: R: nearly a rotation, (3, 3).
    Returns: (3, 3).
    Raises: TypeError, ValueError: not an array of real numbers, or of another shape.

    >>> round(float(orthonormalize(1.01 * jnp.eye(3))[0, 0]), 4)
    0.9998
    """
    R = _real("orthonormalize", "R", R, (3, 3))
    return R - product(R, product(R.T, R) - structural(np.eye(3, dtype=R.dtype))) / 2


def is_rotation(R, tolerance):
    """Whether all entries of R^T R - I are within the tolerance, and det R > 0, for R (3, 3); a boolean array,
    traceable.

    Args: R: (3, 3). tolerance: a number.
    Returns: A boolean, as an array.
    Raises: TypeError, ValueError: not an array of real numbers, or of another shape.

    >>> bool(is_rotation(exp(jnp.ones(3)), 1e-6)), bool(is_rotation(-jnp.eye(3), 1e-6))
    (True, False)
    """
    R = _real("is_rotation", "R", R, (3, 3))
    require_number("is_rotation", "tolerance", tolerance, lambda x: x >= 0, "not be negative")
    error = jnp.max(jnp.abs(product(R.T, R) - jnp.eye(3, dtype=R.dtype)))
    return (error <= tolerance) & (jnp.linalg.det(R) > 0)


def product(A: Array, B: Array) -> jax.Array:
    """The matrix product A B (3, 3), elementwise: XLA can fuse it, and float32 keeps full precision on every device.

    Args: A, B: (3, 3).
    Returns: (3, 3).
    Raises: TypeError, ValueError: not an array of real numbers, or of another shape.

    >>> print(product(hat(jnp.array([1.0, 0.0, 0.0])), jnp.eye(3))[2])
    [0. 1. 0.]
    """
    return _product(_real("product", "A", A, (3, 3)), _real("product", "B", B, (3, 3)))


@jax.jit  # and so traced once, however often it is called: rotations are most of what a step of theirs takes to trace
def _product(A: Array, B: Array) -> Array:
    return jnp.sum(A[:, :, None] * B[None], axis=1)


def cross(x: Array, y: Array) -> jax.Array:
    """x cross y, for (3,) each; written with scalars, which XLA fuses better than the gathers of jnp.cross.

    Args: x, y: (3,).
    Returns: (3,).
    Raises: TypeError, ValueError: not an array of real numbers, or of another shape.

    >>> print(cross(jnp.array([1.0, 0.0, 0.0]), jnp.array([0.0, 1.0, 0.0])))
    [0. 0. 1.]
    """
    return _cross(_real("cross", "x", x, (3,)), _real("cross", "y", y, (3,)))


def _of_scalars(x: Array, y: Array) -> Array:
    (a, b, c), (d, e, f) = ([z[..., i] for i in range(3)] for z in (x, y))
    return jnp.stack([b * f - c * e, c * d - a * f, a * e - b * d], axis=-1)


_cross = Bilinear(_of_scalars, lambda z, y: _cross(y, z), lambda x, z: _cross(z, x))


def inverse_coefficient(x: Array) -> Array:
    """d = (c3 - 2 c4)/(2 c2) = (2 c2 - c1)/(2 c2 x). The first form has no cancellation at 0, the second none at 2
    pi."""
    c1, c2, c3, c4, _ = coefficients(x)
    small = x < 1
    return jnp.where(small, c3 - 2 * c4, (2 * c2 - c1) / jnp.where(small, 1, x)) / (2 * c2)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _power_series(coefficients: tuple, x: Array) -> Array:
    """A power series whose derivatives are series too; differentiating its recursion would make each derivative three
    times as long as the one before."""
    return reduce(lambda value, c: value * x + c, coefficients[-2::-1], jnp.full_like(x, coefficients[-1]))


@_power_series.defjvp
def _(coefficients: tuple, primals: tuple, tangents: tuple):
    slope = tuple(k * c for k, c in enumerate(coefficients))[1:] or (0.0,)
    return _power_series(coefficients, *primals), _power_series(slope, *primals) * tangents[0]


@jax.jit
def _polynomial(psi: Array, f: Array, g: Array) -> Array:
    """I + f P + g P^2."""
    eye = structural(np.eye(3, dtype=psi.dtype))
    return eye + f * hat(psi) + g * (psi[:, None] * psi[None, :] - jnp.sum(psi**2) * eye)


def _real(caller: str, name: str, x: Array, shape: tuple) -> Array:
    """x as an array of floats; raises an error unless it is real and has this shape. Checked while tracing."""
    if not is_array(x) or not is_real(x):
        raise TypeError(f"{caller}: `{name}` must be an array of real numbers; received {x!r}.")
    if x.shape != shape:
        raise ValueError(f"{caller}: `{name}` must have shape {shape}; received {x.shape}.")
    return jnp.asarray(x, None if jnp.issubdtype(x.dtype, jnp.floating) else jnp.result_type(float))


# ----------------------------------------------------------------------------
# The functions of Stumpff, of which finite rotations are made: ck(x) = 1/k! - x/(k + 2)! + x^2/(k + 4)! - ...
#
#     c(k) = 1/k! - x c(k + 2),        dc(k)/dx = (k c(k + 2) - c(k + 1))/2
#
# With t = sqrt(x), c1 = sin t / t and c2 = (1 - cos t) / t^2. Analytic in x; values and derivatives of all orders are
# right at x = 0 too. A derivative takes c(n + 1) and c(n + 2) and nothing else: one pair of series, as the value does.


NEAR, TERMS = 4, 11  # x below which two neighbours are series, of so many terms; the recursion up cancels towards 0


def coefficients(x: Array):
    """c1, ..., c5 at a scalar x >= 0.

    >>> [round(1 / float(c)) for c in coefficients(jnp.array(0.0))]
    [1, 2, 6, 24, 120]
    """
    return stumpff(5, x)


def members(n: int, x: Array):
    """c1, ..., cn: for x < NEAR from power series and recursion downwards, else from definitions and recursion upwards.

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


def rule(stumpff, n: int, x: Array, dx: Array):
    """Values and tangents."""
    c1, *c = stumpff(n + 2, x)
    half = dx / 2
    return (c1, *c[: n - 1]), tuple((k * c[k] - c[k - 1]) * half for k in range(1, n + 1))


def series(k: int, y: Array) -> Array:
    """ck, to rounding for 0 <= y < NEAR.

    >>> float(series(1, jnp.array(0.0)))
    1.0
    """
    first, *rest = [(-1) ** j / factorial(2 * j + k) for j in reversed(range(TERMS))]
    return reduce(lambda value, c: value * y + c, rest, jnp.full_like(y, first))


stumpff = Family(members, rule)
