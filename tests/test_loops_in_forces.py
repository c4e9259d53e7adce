"""Forces with what JAX differentiates in one direction, or not at all: forward runs need no more."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import hhtjax

STEPPERS = {
    "hht": hhtjax.hht,
    "hht converged": lambda: hhtjax.hht(iterations=None),
    "hht state": lambda: hhtjax.hht(linearize="state"),
    "rosenbrock": hhtjax.rosenbrock,
}


def end(force, name, k=3.0):
    start = jnp.ones(2), jnp.zeros(2), k
    return hhtjax.simulate(hhtjax.System(np.ones(2), force), STEPPERS[name](), *start, dt=0.02, num_steps=20).q[-1]


def iterated(q, v, t, k):
    """-k q sqrt(1 + q^2), the root by a loop until it is exact."""
    a = 1 + q * q
    return -k * q * lax.while_loop(lambda x: jnp.max(jnp.abs(x * x - a)) > 1e-13, lambda x: (x + a / x) / 2, a)


def called(q, v, t, k):
    """-k q + sin(t), the sine by NumPy."""
    return -k * q + jax.pure_callback(lambda t: np.sin(np.asarray(t)), jax.ShapeDtypeStruct((), t.dtype), t)


@pytest.mark.slow
@pytest.mark.parametrize("name", STEPPERS)
def test_a_loop_until_it_is_exact(name):
    expected = end(lambda q, v, t, k: -k * q * jnp.sqrt(1 + q * q), name)
    np.testing.assert_allclose(end(iterated, name), expected, rtol=1e-12)


@pytest.mark.slow
def test_forward_derivatives_through_a_loop():
    expected = jax.jit(jax.jacfwd(lambda k: end(lambda q, v, t, k: -k * q * jnp.sqrt(1 + q * q), "hht", k)))(3.0)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(lambda k: end(iterated, "hht", k)))(3.0), expected, rtol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hht", "hht converged", "hht state"])
def test_a_callback_of_the_time(name):
    np.testing.assert_allclose(end(called, name), end(lambda q, v, t, k: -k * q + jnp.sin(t), name), rtol=1e-12)


def called_of_q(q, v, t, k):
    return -k * jax.pure_callback(lambda q: np.sin(np.asarray(q)), q, q)


@pytest.mark.parametrize(
    ("force", "name"), [(called, "rosenbrock"), (called_of_q, "hht"), (called_of_q, "hht converged")]
)
def test_a_callback_without_a_needed_derivative_is_named(force, name):
    with pytest.raises(ValueError, match="this stepper needs the derivatives of the force"):
        end(force, name)


def damped(q, v, t, k):
    return called(q, v, t, k) - 0.5 * v


@pytest.mark.slow
def test_a_callback_of_the_time_beside_a_damper():
    """Of which the smooth start takes derivatives; the time stays as it is."""
    expected = end(lambda q, v, t, k: -k * q + jnp.sin(t) - 0.5 * v, "hht")
    np.testing.assert_allclose(end(damped, "hht"), expected, rtol=1e-12)


def on_circle(force):
    system = hhtjax.System(np.ones(2), force, constraint=lambda q, t, params: (q @ q - 1.0)[None])
    return hhtjax.simulate(system, hhtjax.hht(), jnp.array([1.0, 0.0]), jnp.zeros(2), 3.0, dt=0.02, num_steps=2)


def past_events(force):
    event = hhtjax.Event(lambda q, v, t, k: q[0] - 0.9, reset=hhtjax.impact(0.5))
    start = jnp.ones(2), jnp.zeros(2), 3.0
    return hhtjax.simulate(hhtjax.System(np.ones(2), force), hhtjax.hht(), *start, dt=0.02, num_steps=2, events=[event])


def test_a_callback_whose_rate_is_needed_is_named():
    if jax.__version_info__ < (0, 12):
        with pytest.raises(ValueError, match="this stepper needs the derivatives of the force"):
            past_events(damped)
    else:  # drops what no result is made of before it is differentiated, and needs no rate of the callback
        expected = past_events(lambda q, v, t, k: -k * q + jnp.sin(t) - 0.5 * v)
        np.testing.assert_allclose(past_events(damped).q, expected.q, rtol=1e-12)


@pytest.mark.slow
def test_a_callback_of_the_time_beside_a_constraint():
    """Of which the start takes a difference."""
    expected = on_circle(lambda q, v, t, k: -k * q + jnp.sin(t) - 0.5 * v).q
    np.testing.assert_allclose(on_circle(damped).q, expected, rtol=1e-12)


def test_reverse_derivatives_through_a_loop_are_refused_in_words():
    with pytest.raises(TypeError, match=r"lax.while_loop.* has forward derivatives only"):
        jax.grad(lambda k: end(iterated, "hht", k).sum())(3.0)
