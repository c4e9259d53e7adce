"""Products of a matrix and a vector, and solutions where a matrix lost rank."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matrices import (
    random_matrix,
)

from hhtjax.numerics.dense_lu import UNROLLED, matvec
from hhtjax.numerics.linear_solve import factorize_least_squares


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
