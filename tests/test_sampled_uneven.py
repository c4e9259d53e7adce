"""Samples at any times: against SciPy and the uniform ones, as data, and held inputs with uneven jumps."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from zoo import EVERY

import hhtjax
from hhtjax import sampled

RNG = np.random.default_rng(3)
KNOTS = -1.5 + np.cumsum(RNG.uniform(0.05, 0.6, 12))
VALUES = RNG.standard_normal((12, 2))
TIMES = np.concatenate([RNG.uniform(KNOTS[0] - 0.3, KNOTS[-1] + 0.3, 200), KNOTS, np.nextafter(KNOTS, -np.inf)])


@partial(jax.jit, static_argnames="order")
def evaluate(values, knots, t, order):
    return sampled(values, times=knots, order=order)(t)


def reference(values, t, order, knots=KNOTS):
    if order == 3:
        return CubicSpline(knots, values)(np.clip(t, knots[0], knots[-1]))
    if order == 1:
        return np.stack([np.interp(t, knots, x) for x in values.T], axis=-1)
    return values[np.clip(np.searchsorted(knots, t + 1e-12, side="right") - 1, 0, None)]


@pytest.mark.parametrize("order", [0, 1, 3])
def test_values_at_any_time(order):
    found = evaluate(VALUES, KNOTS, TIMES, order)
    np.testing.assert_allclose(found, reference(VALUES, TIMES, order), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("samples", [4, 5, 33])
def test_the_spline_of_few_and_of_many_samples(samples):
    """33: one more than a power of two, for the bisection."""
    knots = np.cumsum(RNG.uniform(0.01, 1.0, samples))
    values, t = RNG.standard_normal(samples), np.linspace(knots[0], knots[-1], 301)
    np.testing.assert_allclose(evaluate(values, knots, t, 3), CubicSpline(knots, values)(t), rtol=1e-9, atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("order", [0, 1, 3])
def test_equal_distances_are_the_uniform_case(order):
    uniform = sampled(VALUES, 0.25, 0.7, order)
    t = 0.7 + np.linspace(-0.5, 3.3, 97)
    np.testing.assert_allclose(
        evaluate(VALUES, 0.7 + 0.25 * np.arange(12), t, order), uniform(t), rtol=1e-11, atol=1e-12
    )


@pytest.mark.slow
def test_derivatives_in_values_times_and_t():
    """Forward = reverse = central differences; in t those of SciPy's spline."""

    @jax.jit
    def ways(x, along):
        def loss(values, knots, t):
            return jnp.sum(jnp.sin(sampled(values, times=knots)(t)))

        value, forward = jax.jvp(loss, x, along)
        return value, forward, jax.grad(loss, argnums=(0, 1, 2))(*x)

    arguments = jnp.asarray(VALUES[:6]), jnp.asarray(KNOTS[:6]), jnp.linspace(KNOTS[0] + 0.01, KNOTS[5] - 0.02, 5)
    none = jax.tree.map(jnp.zeros_like, arguments)
    for i, x in enumerate(arguments):
        along = [e.reshape(x.shape) for e in np.eye(x.size)]
        found = [ways(arguments, (*none[:i], e, *none[i + 1 :])) for e in along]
        _, forward, reverse = zip(*found, strict=True)
        np.testing.assert_allclose(np.reshape(forward, x.shape), reverse[0][i], rtol=1e-11, atol=1e-12)
        d = RNG.standard_normal(x.shape)
        plus, minus = (ways((*arguments[:i], x + h * d, *arguments[i + 1 :]), none)[0] for h in (1e-5, -1e-5))
        np.testing.assert_allclose((plus - minus) / 2e-5, np.sum(reverse[0][i] * d), rtol=1e-6)
    u = sampled(VALUES[:, 0], times=KNOTS)
    t = np.append(np.linspace(KNOTS[0] + 0.01, KNOTS[-1] - 0.01, 23), KNOTS)
    np.testing.assert_allclose(
        jax.jit(jax.vmap(jax.grad(u)))(t), CubicSpline(KNOTS, VALUES[:, 0])(t, 1), rtol=1e-9, atol=1e-9
    )


@pytest.mark.slow
def test_as_data():
    """New samples and times are no new program; batches; float32 stays."""
    traces = []

    @jax.jit
    def call(u, t):
        traces.append(None)
        return u(t)

    u, other = (sampled(x, times=knots) for x, knots in ((VALUES, KNOTS), (2 * VALUES, KNOTS + 1)))
    np.testing.assert_allclose(call(other, TIMES + 1), 2 * call(u, TIMES), rtol=1e-9, atol=1e-12)
    assert len(traces) == 1
    both = jax.tree.map(lambda *x: jnp.stack(x), u, other)
    np.testing.assert_allclose(jax.vmap(lambda u: u(0.3))(both)[1], other(0.3), rtol=1e-12)
    single = sampled(VALUES.astype(np.float32), times=KNOTS)
    assert {x.dtype.name for x in (*jax.tree.leaves(single), single(0.1))} == {"float32"}


JUMPS = np.array([0.0, 0.1, 0.6, 0.65, 1.2])
HELD = np.array([3.0, -4.0, 5.0, -2.0, 1.0])
SYSTEM = hhtjax.System(np.ones(1), lambda q, v, t, params: params["u"](t)[None] - 20 * q - q**3 - 0.3 * v)


STEPPERS = [hhtjax.hht(0.0), hhtjax.hht(-0.3), pytest.param(hhtjax.hht(-0.3, iterations=None), marks=EVERY)]


def end(stepper, steps):
    """q and v of a run whose steps end on the jumps, so many between any two: unequal ones."""
    params = {"u": sampled(HELD, times=JUMPS, order=0)}
    dts = jnp.full(1, 1.0 / steps)  # 0.05 s and 0.55 s apart: one step to eleven
    start = jnp.zeros(1), jnp.ones(1)
    run = hhtjax.sweep(SYSTEM, stepper, *start, params, dts=dts, times=jnp.array([0.1, 0.6, 0.65, 1.2, 1.5]))
    return np.concatenate([run.q[0, -1], run.v[0, -1]])


@pytest.mark.slow
@pytest.mark.parametrize("stepper", STEPPERS, ids=str)
def test_held_inputs_keep_the_order_between_uneven_jumps(stepper):
    exact = end(hhtjax.rk4(), 640)
    coarse, fine = (np.abs(end(stepper, k) - exact).max() for k in (80, 160))
    assert abs(np.log2(coarse / fine) - 2) < 0.15


def test_a_step_that_ends_on_a_jump_knows_the_value_held_until_then():
    u = sampled(HELD, times=JUMPS, order=0)
    found = [float(u.held_before(t, dt)) for t, dt in ((0.1, 0.05), (0.65, 0.5), (0.65, 0.02), (0.7, 0.02), (1.2, 9.0))]
    assert found == [3.0, 5.0, 5.0, -2.0, -2.0]
