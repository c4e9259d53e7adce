"""Rotations: values against SciPy and exact series, derivatives against each other, differences and identities."""

from math import pi
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from jax import lax
from rotations import (
    ALL,
    AXES,
    EPS,
    EYE,
    FUNCTIONS,
    LONG,
    NEAR_PI,
    VECTOR_FUNCTIONS,
    VECTORS,
    X,
    assert_close,
    batched,
    cross,
    exact_coefficients,
    six,
    transposed,
    turns,
)
from scipy.spatial.transform import Rotation

from hhtjax import rotation
from hhtjax.rotation import (
    exp,
    hat,
    inverse_tangent,
    is_rotation,
    log,
    orthonormalize,
    tangent,
    tangent_rate,
    vee,
)

OPTIMISED: Any = {"xla_backend_optimization_level": 3}  # for a million steps


def test_coefficients():
    """Relative errors: of c1 up to 2.4 rad, short of its root at pi, the others up to 6 rad."""
    exact = np.array([exact_coefficients(x, 0) for x in X]).T
    error = np.abs(np.array(batched(six)(X)) / exact - 1)
    assert np.all(error[0, X < 2.4**2] < 5e-15)
    assert np.all(error[1:] < 5e-15)


def test_hat_is_the_cross_product_and_vee_its_inverse():
    x, y = np.random.default_rng(0).standard_normal((2, 3))
    np.testing.assert_array_equal(hat(x), cross(x))
    assert_close(hat(x) @ y, np.cross(x, y), 2 * EPS)
    np.testing.assert_array_equal(vee(hat(x)), x)
    assert_close(vee(hat(x) + np.outer(y, y)), x, 4 * EPS)


@pytest.mark.slow
def test_exp_is_the_matrix_exponential():
    R = batched(exp)(ALL)
    assert_close(R, turns(ALL), 4e-15)
    assert_close(R, scipy.linalg.expm(np.array([cross(psi) for psi in ALL])), 1e-13)


@pytest.mark.parametrize(("longest", "roundings"), [(1.0, 4), (10.0, 16)])
def test_exp_is_orthogonal_to_rounding(longest, roundings):
    psi = np.random.default_rng(2).uniform(-1, 1, (20000, 3)) * longest / np.sqrt(3)
    R = np.asarray(batched(exp)(psi))
    eye = np.broadcast_to(EYE, R.shape)
    assert_close(transposed(R) @ R, eye, roundings * EPS)
    assert_close(R @ batched(exp)(-psi), eye, roundings * EPS)
    assert np.all(np.linalg.det(R) > 0)


def test_tangent_is_the_integral_of_exp():
    """T(psi) = integral over s from 0 to 1 of exp(-s psi), by Gauss' rule."""
    s, weights = np.polynomial.legendre.leggauss(40)
    integral = sum(w / 2 * turns(-(1 + s) / 2 * ALL) for s, w in zip(s, weights, strict=True))
    assert_close(batched(tangent)(ALL), integral, 4e-15)


def test_identities():
    """T psi = T^T psi = psi, R T = T^T, T T^-1 = I."""
    R, T, inverse = (np.asarray(batched(f)(ALL)) for f in (exp, tangent, inverse_tangent))
    assert_close(np.einsum("pij,pj->pi", T, ALL), ALL, 2e-14)
    assert_close(np.einsum("pji,pj->pi", T, ALL), ALL, 2e-14)
    assert_close(R @ T, transposed(T), 4e-15)
    assert_close(T @ inverse, np.broadcast_to(EYE, T.shape), 2e-14)


def test_inverse_tangent_has_a_pole_at_two_pi():
    for gap in (1e-2, 1e-4, 1e-6):
        half = pi - gap / 2
        norm = np.linalg.norm(inverse_tangent(jnp.array([0.0, 2 * half, 0.0])))
        assert norm == pytest.approx(np.sqrt(1 + 2 * (half / np.sin(gap / 2)) ** 2), rel=1e-8)
    at_pole = np.linalg.norm(inverse_tangent(jnp.array([0.0, 2 * pi, 0.0])))
    assert not at_pole < 1e14


def test_log_undoes_exp_with_relative_accuracy():
    psi = np.concatenate([VECTORS, NEAR_PI])
    error = np.linalg.norm(batched(log)(batched(exp)(psi)) - psi, axis=1)
    assert np.all(error <= 4 * EPS * np.linalg.norm(psi, axis=1))


def test_log_of_random_rotations():
    R = Rotation.random(20000, rng=3)
    assert_close(batched(log)(R.as_matrix()), R.as_rotvec(), 6e-15)


def test_log_at_pi():
    """Of the two vectors the one whose largest component is positive, where the matrix is exactly symmetric."""
    R = 2 * AXES[:, :, None] * AXES[:, None, :] - EYE
    largest = np.take_along_axis(AXES, np.argmax(np.abs(AXES), axis=1)[:, None], axis=1)
    assert_close(batched(log)(R), pi * AXES * np.sign(largest), 4e-15)
    rounded = batched(exp)(pi * AXES)
    assert_close(batched(exp)(batched(log)(rounded)), rounded, 4e-15)


@pytest.mark.slow
def test_rates_along_a_motion():
    """Rdot = R hat(T psidot), and T psiddot + Tdot psidot is the rate of Om = vee(R^T Rdot)."""

    def rate(f):
        return lambda t: jax.jvp(f, (t,), (1.0,))[1]

    def motion(psi, psidot, psiddot):
        def R(t):
            return exp(psi + t * psidot + t**2 / 2 * psiddot)

        return rate(R)(0.0), rate(lambda t: vee(R(t).T @ rate(R)(t)))(0.0)

    psidot, psiddot = np.random.default_rng(4).standard_normal((2, *VECTORS.shape))
    Rdot, Omdot = jax.jit(jax.vmap(motion))(VECTORS, psidot, psiddot)
    R, T = batched(exp)(VECTORS), np.asarray(batched(tangent)(VECTORS))
    assert_close(Rdot, R @ batched(hat)(np.einsum("pij,pj->pi", T, psidot)), 1e-14)
    assert_close(Omdot, np.einsum("pij,pj->pi", T, psiddot) + jax.vmap(tangent_rate)(VECTORS, psidot), 1e-13)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize(
    ("change", "corrected", "bound"), [(0.0, False, 1e6), (1.0, False, 1e4), (0.0, True, 4), (1.0, True, 4)]
)
def test_a_million_compositions(change, corrected, bound, dtype):
    """R^T R - I, in units of rounding: grows with n for a constant increment, else with n^(1/2); not if corrected."""
    psi = jnp.asarray([0.003, -0.005, 0.007], dtype)

    def turn(i, R):
        R = R @ exp(psi * (1 + dtype(change) * jnp.sin(i.astype(dtype))))
        return orthonormalize(R) if corrected else R

    program = jax.jit(lambda R: lax.fori_loop(0, 10**6, turn, R), compiler_options=OPTIMISED)
    R = np.asarray(program(jnp.eye(3, dtype=dtype)), float)
    assert_close(R.T @ R, EYE, bound * np.finfo(dtype).eps)


@pytest.mark.parametrize("size", [1e-3, 1e-5])
def test_orthonormalize_squares_the_distance(size):
    R = batched(exp)(LONG) + size * np.random.default_rng(5).uniform(-1, 1, (len(LONG), 3, 3))
    U, _, V = np.linalg.svd(R)
    assert_close(batched(orthonormalize)(R), U @ V, 6 * size**2)


def test_derivative_of_orthonormalize_is_the_tangent_part():
    R = exp(jnp.array([0.4, -2.0, 1.0]))
    dR = np.random.default_rng(6).standard_normal((3, 3))
    material = R.T @ dR
    assert_close(jax.jvp(orthonormalize, (R,), (dR,))[1], R @ (material - material.T) / 2, 1e-14)


@pytest.mark.parametrize("check", [is_rotation, jax.jit(is_rotation)])
def test_is_rotation(check):
    R = exp(jnp.array([0.4, -2.0, 1.0]))
    assert check(R, 1e-15)
    assert check(R + 1e-7, 1e-6)
    for wrong in (R + 1e-5, -R, R[:, jnp.array([1, 0, 2])], R * jnp.nan):
        assert not check(wrong, 1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("f", FUNCTIONS)
def test_dtype_is_kept(f):
    of_vector = f in VECTOR_FUNCTIONS
    for psi in (1e-3 * AXES[-1], LONG[-1]):
        x = psi if of_vector else turns(psi)
        single = x.astype(np.float32)
        for g in (f, jax.jacfwd(f), jax.jacrev(f)):
            assert jax.eval_shape(g, single).dtype == np.float32
        np.testing.assert_allclose(f(single), f(x), rtol=0, atol=1e-5)
    integers = np.eye(3, dtype=int)[0] if of_vector else np.eye(3, dtype=int)
    np.testing.assert_array_equal(f(integers), f(integers.astype(float)))


@pytest.mark.parametrize("f", FUNCTIONS)
def test_vmap_is_a_loop(f):
    x = VECTORS if f in VECTOR_FUNCTIONS else turns(VECTORS)
    assert_close(batched(f)(x), [jax.jit(f)(xi) for xi in x], 1e-15)


@pytest.mark.parametrize("f", [*FUNCTIONS, tangent_rate, is_rotation, rotation.cross, rotation.product])
def test_bad_input_is_named(f):
    shape = (3,) if f in VECTOR_FUNCTIONS or f in (tangent_rate, rotation.cross) else (3, 3)
    second = {tangent_rate: np.zeros(3), is_rotation: 1e-6, rotation.cross: np.zeros(3), rotation.product: EYE}
    others = (second[f],) if f in second else ()
    for wrong in ((4,), (1, 3), (), (3, 4), (2, 3, 3)):
        with pytest.raises(ValueError, match=rf"^{f.__name__}: `\w+` must have shape .*; received \("):
            jax.eval_shape(lambda x: f(x, *others), jnp.zeros(wrong))
    for wrong in ([0.0, 0.0, 0.0], None, "psi", np.zeros(shape, complex), np.zeros(shape, bool)):
        with pytest.raises(TypeError, match=rf"^{f.__name__}: `\w+` must be an array of real numbers; received "):
            f(wrong, *others)


def test_bad_rate_and_tolerance_are_named():
    with pytest.raises(ValueError, match=r"^tangent_rate: `psidot` must have shape \(3,\); received \(4,\)\.$"):
        tangent_rate(np.zeros(3), np.zeros(4))
    with pytest.raises(ValueError, match=r"^is_rotation: `tolerance` must not be negative; received -1"):
        is_rotation(EYE, -1.0)


@pytest.mark.slow
def test_products_inside_shard_map():
    """Where JAX watches which arrays differ among devices."""
    mesh = jax.make_mesh((1,), ("i",), axis_types=(jax.sharding.AxisType.Auto,))
    spread, shared = jax.sharding.PartitionSpec("i"), jax.sharding.PartitionSpec()
    x, y = jnp.arange(6.0).reshape(2, 3), jnp.array([1.0, -2.0, 0.5])

    def turned(x, y):
        return jax.vmap(lambda x: exp(x) @ rotation.cross(x, y))(x)

    def total(f):
        return jax.grad(lambda x, y: jnp.sum(f(x, y) ** 2), argnums=(0, 1))(x, y)

    inside = total(jax.shard_map(turned, mesh=mesh, in_specs=(spread, shared), out_specs=spread))
    for found, expected in zip(inside, total(turned), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-12)
