"""Products of a matrix and a vector, and solutions where a matrix lost rank."""

from contextlib import nullcontext

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matrices import (
    random_matrix,
)

import hhtjax
from hhtjax.numerics.dense_lu import UNROLLED, matvec
from hhtjax.numerics.linear_solve import factorize_least_squares
from hhtjax.primitives import Linear


@jax.jit
def products(A, x):
    """A x; its diagonal version; two of them by vmap; and its derivatives with respect to x and A."""
    return (
        matvec(A, x),
        matvec(jnp.diagonal(A), x),
        jax.vmap(matvec)(jnp.stack([A, 2 * A]), jnp.stack([x, x])),
        jax.jacfwd(matvec, argnums=1)(A, x),
        jax.grad(lambda A: jnp.sum(matvec(A, x)))(A),
    )


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("n", [1, UNROLLED, UNROLLED + 1])
def test_products(n, dtype):
    A, x = (y.astype(dtype) for y in random_matrix(n))
    expected = A @ x, np.diag(A) * x, np.stack([A @ x, 2 * A @ x]), A, np.broadcast_to(x, (n, n))
    for y, z in zip(jax.device_get(products(A, x)), expected, strict=True):
        assert y.dtype == dtype
        assert y.shape == z.shape
        assert np.max(np.abs(y - z)) < 100 * np.finfo(dtype).eps


@pytest.mark.parametrize("trans", [0, 1])
def test_least_squares_solves_what_lost_rank(trans):
    """A row of B twice: A x = b and A^T x = b for b in range, and the two multipliers alike."""
    M, B = np.array([[4.0, 1.0], [1.0, 3.0]]), np.array([[1.0, 2.0], [1.0, 2.0]])
    A = np.block([[M, -B.T], [B, np.zeros((2, 2))]])
    b = (A.T if trans else A) @ np.array([1.0, -2.0, 3.0, 5.0])
    x = factorize_least_squares(2)(jnp.asarray(A))(jnp.asarray(b), trans=trans)
    np.testing.assert_allclose(x, [1.0, -2.0, 4.0, 4.0], rtol=1e-12)


ROWS = np.array([4, 0, 4, 2])
taken = Linear(lambda x: x[..., ROWS], lambda y: jnp.zeros((*y.shape[:-1], 5), y.dtype).at[..., ROWS].add(y))
S = np.eye(5)[ROWS]


def uses_of_a_map(x, y):
    """Value, slopes, what jvp, vjp, vmap and their compositions make of it, and its transpose."""
    g = jax.grad(lambda x: jnp.sum(taken(x) ** 3))
    return (
        taken(x),
        jax.jacfwd(taken)(x),
        jax.jacrev(taken)(x),
        jax.linear_transpose(taken, x)(y)[0],
        taken.transpose(y),
        jax.vmap(taken, in_axes=1, out_axes=1)(jnp.stack([x, 2 * x], axis=1)),
        jax.vmap(jax.vmap(taken.transpose))(jnp.stack([y, 2 * y])[None]),
        jax.hessian(lambda x: jnp.sum(taken(x) ** 3))(x),
        jax.jvp(lambda x: jax.vjp(g, x)[1](x)[0], (x,), (x,))[1],
        jax.lax.scan(lambda c, _: (taken.transpose(taken(c)), None), x, None, 2)[0],
    )


@pytest.mark.parametrize("is_plain", [False, True])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_linear_map_and_its_transpose(dtype, is_plain):
    x, y = np.linspace(1, 2, 5).astype(dtype), np.linspace(-1, 1, 4).astype(dtype)
    both = S.T @ y
    H = 6 * S.T @ np.diag(S @ x) @ S
    third = 12 * S.T @ (S @ x) ** 2
    expected = S @ x, S, S, both, both, np.stack([S @ x, 2 * S @ x], 1), np.stack([both, 2 * both])[None], H, third
    with hhtjax.plain() if is_plain else nullcontext():
        found = jax.jit(lambda *at: uses_of_a_map(*at))(x, y)
    for a, b in zip(found, (*expected, np.linalg.matrix_power(S.T @ S, 2) @ x), strict=True):
        assert a.dtype == dtype
        np.testing.assert_allclose(a, b, rtol=100 * np.finfo(dtype).eps, atol=1e-6 if dtype == np.float32 else 1e-14)


def test_the_transpose_of_a_transpose_is_the_map():
    assert taken.transpose.transpose is taken
    assert "scatter" not in str(jax.make_jaxpr(taken)(jnp.ones(5)).jaxpr.eqns[0].primitive)
