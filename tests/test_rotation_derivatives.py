"""Derivatives of rotations, forward and reverse, of first to third order."""

from functools import cache
from itertools import permutations
from math import pi

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rotations import AXES, EYE, NEAR_PI, ORDERS, VECTORS, X, assert_close, batched, cross, exact_coefficients, six

from hhtjax.rotation import (
    exp,
    inverse_tangent,
    log,
    tangent,
)


@cache
def forward(f, order):
    """All derivatives of this order: f's shape, then (3,) for each."""
    for _ in range(order):
        f = jax.jacfwd(f)
    return batched(f)


def reverse(f, weights):
    """In reverse mode all through: the gradient of f . weights[0], of that . weights[1], and so on."""
    for w in weights:
        f = jax.grad(lambda x, f=f, w=w: jnp.sum(w * f(x)))
    return batched(f)


def contract(derivative, weights):
    """What `reverse` gives, from all derivatives (points, ...)."""
    for w in weights:
        axes = range(1, 1 + w.ndim)
        derivative = np.tensordot(derivative, w, (axes, range(w.ndim)))
    return derivative


def random_weights(shape, order):
    rng = np.random.default_rng(order)
    return [rng.uniform(-1, 1, shape), *rng.uniform(-1, 1, (order - 1, 3))]


@pytest.mark.parametrize("order", [1, *(pytest.param(order, marks=pytest.mark.slow) for order in (2, 3))])
@pytest.mark.parametrize("f", [exp, tangent, inverse_tangent])
def test_derivatives(f, order):
    """Forward mode, reverse mode, and fourth-order central differences of the derivative before."""
    h, weights = 1e-3, random_weights((3, 3), order)
    derivative, before = np.asarray(forward(f, order)(VECTORS)), forward(f, order - 1)

    def difference(step):
        return before(VECTORS + step) - before(VECTORS - step)

    differences = [(8 * difference(h * e) - difference(2 * h * e)) / (12 * h) for e in EYE]
    assert_close(derivative, np.stack(differences, axis=-1), 1e-11)
    assert_close(reverse(f, weights)(VECTORS), contract(derivative, weights), 1e-13)


@pytest.mark.parametrize("f", [exp, tangent, inverse_tangent])
def test_derivatives_of_long_vectors_are_finite(f):
    """The series, not taken there, would overflow."""
    psi = np.array([3000.0, -1000.0, 2000.0], np.float32)
    for derivative in (jax.jacfwd(f), jax.jacrev(f)):
        assert np.all(np.isfinite(jax.jit(derivative)(psi)))


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize(
    ("f", "factors"), [(exp, (1, 1, 1)), (tangent, (-1 / 2, 1 / 3, -1 / 4)), (inverse_tangent, (1 / 2, 1 / 6, 0))]
)
def test_derivatives_at_zero(f, factors, order):
    """Those of I + the sum over k of factors[k - 1] P^k / k!."""
    P = [cross(e) for e in EYE]
    exact = np.zeros((3, 3) + (3,) * order)
    for directions in np.ndindex((3,) * order):
        products = [np.linalg.multi_dot([EYE, *(P[i] for i in p), EYE]) for p in permutations(directions)]
        exact[:, :, *directions] = factors[order - 1] * np.mean(products, axis=0)
    at_zero = forward(f, order)(VECTORS)[np.linalg.norm(VECTORS, axis=1) < 1e-100]
    assert_close(at_zero, np.broadcast_to(exact, at_zero.shape), 1e-15)


@pytest.mark.parametrize("order", [1, *(pytest.param(order, marks=pytest.mark.slow) for order in (2, 3))])
def test_derivatives_of_log(order):
    """log(exp(psi)) = psi: the first derivative is I and the next ones are 0."""

    def identity(psi):
        return log(exp(psi))

    psi, weights = np.concatenate([VECTORS, NEAR_PI]), random_weights(3, order)
    exact = np.broadcast_to(EYE if order == 1 else np.zeros((3,) * (order + 1)), (len(psi),) + (3,) * (order + 1))
    assert_close(forward(identity, order)(psi), exact, 1e-14 * 10 ** (order - 1))
    assert_close(reverse(identity, weights)(psi), contract(exact, weights), 1e-14 * 10 ** (order - 1))


@pytest.mark.slow
def test_derivative_of_log_is_the_inverse_tangent():
    """d log(R exp(eps)) = T^-1(psi) d eps at eps = 0; at pi too, where psi is what log returns."""
    R = batched(exp)(np.concatenate([VECTORS, NEAR_PI, pi * AXES]))
    derivative = batched(lambda R: jax.jacrev(lambda eps: log(R @ exp(eps)))(jnp.zeros(3)))
    assert_close(derivative(R), batched(inverse_tangent)(batched(log)(R)), 1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("order", ORDERS)
def test_derivatives_of_coefficients(order):
    """Forward, with relative errors of the series and absolute ones beyond; and reverse, of a random combination."""
    weights = np.random.default_rng(order).uniform(-1, 1, 6)
    forward, backward = six, lambda x: sum(w * f for w, f in zip(weights, six(x), strict=True))
    for _ in range(order):
        forward, backward = jax.jacfwd(forward), jax.grad(backward)
    exact = np.array([exact_coefficients(x, order) for x in X]).T
    error = np.abs(np.array(batched(forward)(X)) - exact)
    assert np.all(error < np.where(X < 1, 1e-13 * np.abs(exact), 1e-14))
    assert_close(batched(backward)(X), weights @ exact, 1e-14)
