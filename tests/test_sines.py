"""Sines and cosines inside a kernel: polynomials up to RANGE, XLA's own beyond; the same derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hhtjax.primitives import compat, one_kernel
from hhtjax.xla import RANGE
from hhtjax.xla.for_kernel import _each_sine_once
from hhtjax.xla.sines import NAME

pytestmark = pytest.mark.skipif(not compat.is_on(), reason="plain arrays with this version of JAX")


def both(x):
    return one_kernel(lambda x: (jnp.sin(x), jnp.cos(x)), x)


def later(x):
    """Sines of sines, several at once, one alone, in a loop and in a branch."""

    def step(_, x):
        y = jnp.sin(x) + 2 * jnp.cos(x - 1)
        return jnp.where(y > 0, jnp.sin(y) * x, jnp.cos(x))

    return one_kernel(lambda x: jax.lax.fori_loop(0, 3, step, x), x)


FORMS = later, jax.jacfwd(later), jax.jacfwd(jax.jacfwd(later))


def program(f, x):
    return jax.jit(f).lower(x).as_text()


@pytest.mark.skipif(np.finfo(np.longdouble).nmant < 63, reason="no extended precision to compare with")
def test_within_two_units_in_the_last_place():
    random = np.random.default_rng(0)
    turns = random.integers(-127_000, 127_000, 20_000) * (np.pi / 4)
    small = random.uniform(-1, 1, 5_000) * 10.0 ** random.uniform(-300, 0, 5_000)
    x = np.concatenate([random.uniform(-RANGE, RANGE, 50_000), turns, np.nextafter(turns, np.inf), small])
    assert NAME in program(both, x)
    for found, exact in zip(jax.jit(both)(x), (np.sin, np.cos), strict=True):
        value = exact(x.astype(np.longdouble))
        unit = np.spacing(np.abs(value.astype(float)))
        assert np.max(np.abs(np.asarray(found) - value) / unit) < 2
        assert np.any(np.asarray(found) != exact(x))  # it is not numpy's, nor XLA's


@pytest.mark.parametrize("x", [1.001e5, -1e22, np.inf, -np.inf, np.nan, 0.0, -0.0, 1e5, 5e-324])
def test_every_number_has_its_sine_alone_and_among_others(x):
    plain = jnp.sin(x), jnp.cos(x)
    batch = jnp.array([0.3, x, -2.0])
    for found, exact in zip(jax.jit(both)(x), plain, strict=True):
        np.testing.assert_allclose(found, exact, rtol=1e-15)
        assert np.signbit(found) == np.signbit(exact)
    for found, f in zip(jax.jit(both)(batch), (jnp.sin, jnp.cos), strict=True):
        np.testing.assert_allclose(found, f(batch), rtol=1e-15)
        np.testing.assert_array_equal(np.signbit(found), np.signbit(f(batch)))


@pytest.mark.slow
def test_values_and_derivatives_alone_and_in_batches():
    xs = np.linspace(-3, 3, 7)
    with compat.plain():
        expected = [jax.vmap(f)(xs) for f in FORMS]
    for f, exact in zip(FORMS, expected, strict=True):
        assert NAME in program(f, xs[0])
        np.testing.assert_allclose(jax.jit(jax.vmap(f))(xs), exact, rtol=1e-12)
        np.testing.assert_allclose(jax.jit(f)(xs[2]), exact[2], rtol=1e-12)


def test_a_large_batch_of_one_function():
    x = jnp.linspace(-5, 5, 100_000)
    found = jax.jit(lambda x: one_kernel(lambda x: 2 * jnp.sin(x), x))(x)
    np.testing.assert_allclose(found, 2 * np.sin(x), rtol=1e-15, atol=1e-16)


def test_what_can_be_together_is_one_call_and_others_are_as_they_were():
    def f(x, y):
        return one_kernel(lambda x, y: jnp.sin(x) * jnp.cos(x) + jnp.cos(x * y) + jnp.sin(jnp.sin(y)), x, y)

    text = jax.jit(f).lower(1.0, 2.0).as_text()
    assert text.count(f"private @{NAME}") == 3  # of x; of x y and y, which are known then; of the sine
    single = jax.jit(lambda x: one_kernel(jnp.sin, x)).lower(jnp.float32(1)).as_text()
    assert NAME not in single
    assert NAME not in jax.jit(jnp.sin).lower(1.0).as_text()


def test_what_comes_twice_is_computed_once():
    """Also where what it is a sine of is computed twice, as by a function that is called again."""

    def height(x, y):
        return jnp.sin(2 * x) * y

    def f(x, y):
        a = height(x, y) + jnp.sin(3 * y)
        return a * jnp.sin(a) + height(x, y + 1) * jax.jvp(lambda x: height(x, y), (x,), (a,))[1]

    eqns = jax.make_jaxpr(f)(1.0, 2.0).jaxpr.eqns
    kept, instead = _each_sine_once(eqns)
    sines = [sum(eqn.primitive.name in ("sin", "cos") for eqn in some) for some in (eqns, kept)]
    assert sines == [6, 4]  # sin 2x, sin 3y, sin a and cos 2x; twice more sin 2x
    assert len(instead) == 2
    assert abs(jax.jit(lambda x, y: one_kernel(f, x, y))(1.0, 2.0) - f(1.0, 2.0)) < 1e-13
