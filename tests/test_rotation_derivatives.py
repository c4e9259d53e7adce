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
def forward(f):
    """f and its derivatives up to the third, (3,) for each after the shape of f: one program has all orders."""

    def derived(lower):
        def f_and_lower(x):
            y, *rest = lower(x)
            return y, (y, *rest)

        def all_orders(x):
            highest, rest = jax.jacfwd(f_and_lower, has_aux=True)(x)
            return highest, *rest

        return all_orders

    found = derived(derived(derived(lambda x: (f(x),))))
    return batched(lambda x: found(x)[::-1])


def reverse(f, weights):
    """In reverse mode all through: the gradients of f . weights[0], of that . weights[1], and so on."""

    def derived(lower, w):
        def value_and_lower(x):
            y, *rest = lower(x)
            return jnp.sum(w * y), (y, *rest)

        def all_orders(x):
            highest, rest = jax.grad(value_and_lower, has_aux=True)(x)
            return highest, *rest

        return all_orders

    found = lambda x: (f(x),)  # noqa: E731
    for w in weights:
        found = derived(found, w)
    return batched(lambda x: found(x)[-2::-1])


def contract(derivative, weights):
    """What `reverse` gives, from all derivatives (points, ...)."""
    for w in weights:
        axes = range(1, 1 + w.ndim)
        derivative = np.tensordot(derivative, w, (axes, range(w.ndim)))
    return derivative


def random_weights(shape):
    rng = np.random.default_rng(1)
    return [rng.uniform(-1, 1, shape), *rng.uniform(-1, 1, (2, 3))]


@pytest.mark.slow
@pytest.mark.parametrize("f", [exp, *(pytest.param(f, marks=pytest.mark.slow) for f in (tangent, inverse_tangent))])
def test_derivatives(f):
    """Forward mode, reverse mode, and fourth-order central differences of the derivative before."""
    h, weights = 1e-3, random_weights((3, 3))
    found = forward(f)(VECTORS)

    def difference(step):
        return [x - y for x, y in zip(forward(f)(VECTORS + step), forward(f)(VECTORS - step), strict=True)]

    differences = [(difference(h * e), difference(2 * h * e)) for e in EYE]
    for order, by_reverse in enumerate(reverse(f, weights)(VECTORS), 1):
        columns = [(8 * one[order - 1] - two[order - 1]) / (12 * h) for one, two in differences]
        assert_close(found[order], np.stack(columns, axis=-1), 1e-11)
        assert_close(by_reverse, contract(found[order], weights[:order]), 1e-13)


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
    at_zero = forward(f)(VECTORS)[order][np.linalg.norm(VECTORS, axis=1) < 1e-100]
    assert_close(at_zero, np.broadcast_to(exact, at_zero.shape), 1e-15)


@pytest.mark.slow
def test_derivatives_of_log():
    """log(exp(psi)) = psi: the first derivative is I and the next ones are 0."""

    def identity(psi):
        return log(exp(psi))

    psi, weights = np.concatenate([VECTORS, NEAR_PI]), random_weights(3)
    found = forward(identity)(psi)
    for order, by_reverse in enumerate(reverse(identity, weights)(psi), 1):
        exact = np.broadcast_to(EYE if order == 1 else np.zeros((3,) * (order + 1)), found[order].shape)
        assert_close(found[order], exact, 1e-14 * 10 ** (order - 1))
        assert_close(by_reverse, contract(exact, weights[:order]), 1e-14 * 10 ** (order - 1))


@pytest.mark.slow
def test_derivative_of_log_is_the_inverse_tangent():
    """d log(R exp(eps)) = T^-1(psi) d eps at eps = 0; at pi too, where psi is what log returns."""
    R = batched(exp)(np.concatenate([VECTORS, NEAR_PI, pi * AXES]))
    derivative = batched(lambda R: jax.jacrev(lambda eps: log(R @ exp(eps)))(jnp.zeros(3)))
    assert_close(derivative(R), batched(inverse_tangent)(batched(log)(R)), 1e-14)


@pytest.mark.slow
def test_derivatives_of_coefficients():
    """Forward, with relative errors of the series and absolute ones beyond; and reverse, of a random combination."""
    weights = np.random.default_rng(1).uniform(-1, 1, 6)
    found = forward(lambda x: jnp.stack(six(x)))(X)
    by_reverse = reverse(lambda x: jnp.stack(six(x)), [weights, 1.0, 1.0])(X)
    for order in (1, 2, 3):
        exact = np.array([exact_coefficients(x, order) for x in X])
        error = np.abs(found[order] - exact)
        relative = 1e-13 * np.abs(exact)
        assert np.all(error < np.where(X[:, None] < 1, relative, 1e-14))
        assert np.all((error < relative)[X < 4, :5])
        assert_close(by_reverse[order - 1], exact @ weights, 1e-14)
