"""Factorisations in panels, against LAPACK's of the whole."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from matrices import spd

from hhtjax.numerics import dense_lu
from hhtjax.numerics.dense_lu import factorize


@pytest.mark.slow
def test_factorisations_in_panels():
    """As LAPACK does it, the order of the rows included; a last panel narrower than its block, too."""
    rng = np.random.default_rng(3)
    n = 300  # three panels, one, and what is left
    assert n * n > dense_lu.ELEMENTS
    assert n % dense_lu.BLOCK
    A = rng.normal(size=(2, n, n))
    A[1] = A[1, :, :7] @ rng.normal(size=(7, n))  # rank 7: pivots of rounding, and none is skipped
    S = np.stack([A[0] @ A[0].T + np.eye(n), np.diag(np.where(np.arange(n) == n - 2, -1.0, 1.0))])
    (LU, order), pivots = jax.jit(jax.vmap(lambda A, S: (dense_lu.lu(A), dense_lu.pivots(S))))(A, S)
    expected, _, same = lax.linalg.lu(jnp.array(A[0]))
    assert np.array_equal(order[0], same)
    assert np.allclose(LU[0], expected, rtol=0, atol=1e-11)
    for a, both, rows in zip(A, LU, order, strict=True):
        assert sorted(rows) == list(range(n))
        L, U = np.tril(both, -1) + np.eye(n), np.triu(both)
        assert np.abs(L).max() == 1
        assert np.allclose(L @ U, a[rows], rtol=0, atol=1e-12 * np.abs(a).max())
    assert np.allclose(pivots[0], np.diagonal(np.linalg.cholesky(S[0])) ** 2, rtol=1e-12)
    assert np.all(pivots[1, : n - n % dense_lu.BLOCK] == 1)
    assert np.all(np.isnan(pivots[1, n - n % dense_lu.BLOCK :]))


@pytest.mark.parametrize("n", [2, dense_lu.FEW])
def test_pivots_of_few(n):
    """Those of Cholesky's factor, without LAPACK; none behind one that is not positive."""
    S = np.stack([spd(n)[0], np.diag(np.where(np.arange(n) == n - 2, -1.0, 1.0))])
    program = jax.jit(jax.vmap(dense_lu.pivots)).lower(S)
    assert "lapack" not in program.as_text()
    first, second = program.compile()(S)
    assert np.allclose(first, np.diagonal(np.linalg.cholesky(S[0])) ** 2, rtol=1e-12)
    assert np.array_equal(second, [*(n - 2) * [1.0], -1.0, np.nan], equal_nan=True)


def test_solves_of_hundreds_of_unknowns():
    """By the same factors, transposed too."""
    A, b = spd(200)
    A[3] *= 50
    x, y = jax.jit(lambda A, b: (f := factorize(A), (f(b), f(b, trans=1)))[1])(A, b)
    assert np.allclose(x, np.linalg.solve(A, b), rtol=1e-11)
    assert np.allclose(y, np.linalg.solve(A.T, b), rtol=1e-11)
