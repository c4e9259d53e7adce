"""What is compared is the number that is used; and constants are folded as XLA computes them."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import hhtjax
from hhtjax.jaxpr.scalars import by_scalars, join, split
from hhtjax.primitives import compat, consistent
from hhtjax.primitives.consistent import held

pytestmark = pytest.mark.skipif(not compat.is_on(), reason="plain arrays with this version of JAX")

CHOICES = {
    "max": jnp.max,
    "min": jnp.min,
    "largest size": lambda x: jnp.max(jnp.abs(x)),
    "norm": lambda x: jnp.linalg.norm(x, jnp.inf),
    "cummax": lax.cummax,
    "sort": jnp.sort,
    "median": jnp.median,
    "clip": lambda x: jnp.clip(x, x[0], 0.5),
    "argmax": lambda x: x[jnp.argmax(jnp.abs(x))],
    "equality": lambda x: jnp.where(jnp.abs(x) == jnp.max(jnp.abs(x)), x, 0.0),
    "in a branch": lambda x: lax.cond(x[0] > 0, lambda x: jnp.max(jnp.abs(x)), lambda x: jnp.min(x), x),
}


@pytest.mark.slow
@pytest.mark.compiled
def test_derivatives_behind_products_and_sums():
    """Forward and reverse, against the choice by NumPy, at points where roundings of a product and a sum differ."""

    def behind(f):
        return consistent(lambda a, b, c: f(a * b + c * a))

    def everything(a, b, c):
        found = {}
        for name, f in CHOICES.items():
            g = behind(f)
            value, along = jax.jvp(lambda a, g=g: g(a, b, c), (a,), (b,))
            back = jax.grad(lambda a, g=g: jnp.sum(g(a, b, c)))(a)
            found[name] = value, along, back
        return found

    points = np.random.default_rng(0).standard_normal((3, 20, 5))
    found = jax.jit(jax.vmap(everything))(*points)
    one = jax.jit(everything)(*points[:, 0])
    for name, (value, along, back) in found.items():
        assert all(np.isfinite(x).all() for x in (value, along, back)), name
        np.testing.assert_allclose(np.sum(along.reshape(20, -1), 1), np.sum(back * points[1], 1), rtol=1e-12)
        np.testing.assert_allclose(one[name][1], along[0], rtol=1e-12)
    for i, (a, b, c) in enumerate(points.transpose(1, 0, 2)):
        x, dx = a * b + c * a, b * b + c * b
        largest = np.argmax(np.abs(x))
        np.testing.assert_allclose(found["largest size"][1][i], np.sign(x[largest]) * dx[largest], rtol=1e-12)
        np.testing.assert_allclose(found["equality"][0][i][largest], x[largest], rtol=1e-12)


@pytest.mark.compiled
def test_an_element_is_the_largest_at_every_point():
    """In a program of its own, where XLA evaluates a b + c a twice: for a fifth of the points they would differ."""
    f = consistent(lambda a, b, c: jnp.max(jnp.abs(a * b + c * a)))
    along = jax.jit(lambda a, b, c: jax.jvp(lambda a: f(a, b, c), (a,), (b,))[1])
    back = jax.jit(jax.grad(f))
    for a, b, c in np.random.default_rng(0).standard_normal((40, 3, 3)):
        x = a * b + c * a
        i = np.argmax(np.abs(x))
        np.testing.assert_allclose(along(a, b, c), np.sign(x[i]) * (b + c)[i] * b[i], rtol=1e-12)
        np.testing.assert_allclose(back(a, b, c), np.where(np.arange(3) == i, np.sign(x[i]) * (b + c), 0), rtol=1e-12)


@pytest.mark.slow
@pytest.mark.compiled
def test_a_drag_of_the_largest_velocity_on_a_circle():
    def force(q, v, t, k):
        return -k * v * jnp.max(jnp.abs(v)) + jnp.array([0.0, -5.0])

    system = hhtjax.System(np.ones(2), force, constraint=lambda q, t, k: jnp.array([q @ q - 1.0]))
    for stepper in hhtjax.hht(), hhtjax.hht(iterations=None):
        run = hhtjax.simulate(
            system, stepper, jnp.array([0.6, 0.8]), jnp.array([-0.4, 0.3]), 3.0, dt=1e-2, num_steps=20
        )
        np.testing.assert_allclose(run.q[-1], [0.57010, 0.82157], atol=1e-5)


FOLDED = {
    "floor": (lambda: jnp.array([1, 2, 3]) // jnp.array([0, 1, 0]), [-2, 2, -2]),  # one below the quotient, -1
    "quotient": (lambda: lax.div(jnp.array([1, 2, 3]), jnp.array([0, 1, 0])), [-1, 2, -1]),
    "remainder": (lambda: lax.rem(jnp.array([1, -7, 3]), jnp.array([0, 2, 0])), [1, -1, 3]),
    "least": (lambda: lax.div(jnp.full(1, -(2**31), jnp.int32), jnp.full(1, -1, jnp.int32)), [-(2**31)]),
    "without sign": (lambda: lax.div(jnp.full(1, 7, jnp.uint8), jnp.zeros(1, jnp.uint8)), [255]),
    "too large": (lambda: jnp.asarray([3e9, 1.0, -np.inf]).astype(jnp.int32), [2**31 - 1, 1, -(2**31)]),
    "no number": (lambda: jnp.asarray([np.nan, np.inf]).astype(jnp.int32), [0, 2**31 - 1]),
    "bytes": (lambda: jnp.asarray([-3.0, 300.0, 7.9]).astype(jnp.uint8), [0, 255, 7]),
    "shifts": (lambda: lax.shift_left(jnp.array([1, 3], jnp.int32), jnp.array([40, 1], jnp.int32)), [0, 6]),
    "logical": (lambda: lax.shift_right_logical(jnp.full(1, -8, jnp.int32), jnp.full(1, 40, jnp.int32)), [0]),
    "signed": (lambda: lax.shift_right_arithmetic(jnp.full(1, -8, jnp.int32), jnp.full(1, 40, jnp.int32)), [-1]),
}


@pytest.mark.parametrize("name", FOLDED)
def test_constants_are_folded_as_xla_computes_them(name):
    f, expected = FOLDED[name]
    found = join(by_scalars(lambda x: f() + 0 * x.astype(f().dtype))(split(jnp.ones(len(expected)))))
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(f(), expected)


def test_a_product_of_booleans():
    def count(x):
        return x + (jnp.ones((3, 3), bool) @ (x > 0)).astype(x.dtype)

    x = jnp.array([0.3, -0.2, 0.1])
    np.testing.assert_allclose(join(by_scalars(count)(split(x))), x + 1.0)


def test_numbers_of_a_method_as_arrays_inside_jit():
    """alpha and dt are checked there too, by their values."""
    spring, alpha, dt = hhtjax.System(np.ones(1), lambda q, v, t, p: -q), jnp.array(-0.1), jnp.array(0.1)

    @jax.jit
    def run():
        return hhtjax.simulate(spring, hhtjax.hht(alpha), jnp.ones(1), jnp.zeros(1), dt=dt, num_steps=5).q

    expected = hhtjax.simulate(spring, hhtjax.hht(-0.1), jnp.ones(1), jnp.zeros(1), dt=0.1, num_steps=5).q
    np.testing.assert_allclose(run(), expected, rtol=1e-14)
    wrong = jnp.array(0.5)
    with pytest.raises(ValueError, match="alpha"):
        jax.jit(lambda: hhtjax.hht(wrong) and 0)()


@pytest.mark.parametrize("dtype", [bool, np.int32, np.uint8, np.float32, np.float64, complex])
def test_the_call_that_holds_a_number_computes_it(dtype):
    """XLA:CPU makes wrong programs of calls that return a parameter."""
    x = jnp.asarray([0, 1, 2, 0], dtype)
    program = jax.jit(held).lower(x).compile()
    assert "call(" in program.as_text()
    assert not re.findall(r"ROOT [^\n]* parameter\(", program.as_text())
    assert program(x).dtype == x.dtype
    np.testing.assert_array_equal(program(x), x)


def test_what_is_held_keeps_its_sign_and_is_not_a_number_where_it_was_not():
    x = np.array([np.nan, 0.0, -0.0, np.inf, -np.inf])
    found = jax.jit(held)(x)
    np.testing.assert_array_equal(found, x)
    np.testing.assert_array_equal(np.signbit(found)[1:], np.signbit(x)[1:])
