"""Matrices that are hard to solve with, of every size that is unrolled."""

import jax
import numpy as np

from hhtjax.numerics.linear_solve import solve

SIZES = range(1, 13)


def random_matrix(n, seed=0):
    """A random matrix, and a right-hand side."""
    rng = np.random.default_rng([n, seed])
    return rng.standard_normal((n, n)), rng.standard_normal(n)


def zero_diagonal(n):
    """A random matrix with zeros where elimination without pivoting would divide."""
    A, b = random_matrix(n, 1)
    return (A if n == 1 else A - np.diag(np.diag(A))), b


def permuted(n):
    """A well conditioned triangular matrix with its rows in random order: every pivot must be looked for."""
    A, b = random_matrix(n, 2)
    order = np.random.default_rng(n).permutation(n)
    return (np.triu(A, 1) * 0.3 + np.diag(1.0 + np.arange(n)))[order], b


def cyclic(n):
    """A permutation that moves every row, scaled: exact in floating point."""
    return np.roll(np.diag(2.0 ** np.arange(n)), 1, axis=0), np.arange(1.0, n + 1)


def equal_pivots(n):
    """All candidates for the first pivot of equal size and of both signs."""
    A, b = random_matrix(n, 3)
    A[:, 0] = np.where(np.arange(n) % 2, -1.0, 1.0)
    return A, b


def bad_rows(n):
    """Rows whose sizes differ by up to 1e12, as of coordinates in different units."""
    A, b = random_matrix(n, 4)
    scale = 10.0 ** np.linspace(-6, 6, n)
    return A * scale[:, None], b * scale


def bad_columns(n):
    """Unknowns whose sizes differ by up to 1e12."""
    A, b = random_matrix(n, 5)
    return A * 10.0 ** np.linspace(6, -6, n), b


def spd(n):
    """Symmetric positive definite, as a mass matrix."""
    A, b = random_matrix(n, 6)
    return A @ A.T + np.eye(n), b


compiled = jax.jit(solve)
KINDS = [random_matrix, zero_diagonal, permuted, cyclic, equal_pivots, bad_rows, bad_columns, spd]


def backward_error(A, x, b):
    """Largest relative change of a row of A and b that makes x exact (Skeel)."""
    return np.max(np.abs(A @ x - b) / (np.abs(A) @ np.abs(x) + np.abs(b)))
