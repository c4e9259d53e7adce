"""Sampled inputs: against SciPy and NumPy, at and beyond their ends, as data, and inside a simulation."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import hhtjax
from hhtjax import sampled

NAN, INF = float("nan"), float("inf")
RNG = np.random.default_rng(7)
VALUES = RNG.standard_normal(9)
DT, T0 = 0.25, -1.5
KNOTS = T0 + DT * np.arange(9)
# inside, at every knot and at both ends; DT and T0 are exact in binary, so that knots are hit exactly
TIMES = np.concatenate([np.linspace(KNOTS[0], KNOTS[-1], 101), KNOTS])


def reference(order, knots, values, times, derivative=0):
    """SciPy's spline with not-a-knot ends, or straight lines."""
    if order == 3:
        return CubicSpline(knots, values, bc_type="not-a-knot")(times, derivative)
    columns = values.reshape(len(values), -1).T
    lines = [np.interp(times.ravel(), knots, x) for x in columns]
    return np.stack(lines, axis=-1).reshape(times.shape + values.shape[1:])


@partial(jax.jit, static_argnames="order")
def evaluate(values, dt, t0, t, order=3):
    """Compiled, which is faster here than operation by operation."""
    return sampled(values, dt, t0, order)(t)


make = jax.jit(sampled, static_argnames="order")


@jax.jit
def slopes(u, times):
    """Derivatives in time: of signals of one channel by reverse mode, and by forward mode."""
    return jax.vmap(jax.grad(u))(times), jax.vmap(jax.jacfwd(u))(times)


@pytest.mark.parametrize(("order", "samples"), [(1, 2), (3, 4), (3, 5), (3, 200)])
def test_values_between_the_samples(order, samples):
    values = np.random.default_rng(samples).standard_normal(samples)
    knots = 0.7 + 0.01 * np.arange(samples)
    times = np.linspace(knots[0], knots[-1], 333)
    both = np.asarray(evaluate(values, 0.01, 0.7, np.concatenate([times, knots]), order))
    assert np.max(np.abs(both[:333] - reference(order, knots, values, times))) < 1e-12
    assert np.max(np.abs(both[333:] - values)) < 1e-12


def test_order_zero_holds_each_value_until_the_next():
    """At a sample the new value already, although no sampling time is a number of the computer."""
    values = RNG.standard_normal((2001, 2))
    steps = 0.1 * np.arange(2001)
    for shift, expected in ((0.0, values), (0.0999, values), (-1e-4, np.concatenate([values[:1], values[:-1]]))):
        np.testing.assert_array_equal(evaluate(values, 0.1, 0.7, 0.7 + steps + shift, 0), expected)
    np.testing.assert_array_equal(evaluate(values[:1], 0.1, 0.0, np.array([-1.0, 0.0, 5.0]), 0), values[[0, 0, 0]])


def test_cubic_is_the_default_and_reproduces_cubics():
    def cubic(t):
        return 1 - 2 * t + 3 * t**2 - 4 * t**3

    assert np.allclose(evaluate(cubic(KNOTS), DT, T0, TIMES), cubic(TIMES), rtol=1e-13)


@pytest.mark.parametrize(("channels", "shape"), [((), ()), ((1,), (4,)), ((2, 3), ()), ((3,), (5, 4))])
@pytest.mark.parametrize("order", [1, 3])
def test_channels_and_arrays_of_times(order, channels, shape):
    """The result has the axes of t first, then those of the channels."""
    values = RNG.standard_normal((9, *channels))
    times = np.asarray(RNG.uniform(KNOTS[0], KNOTS[-1], shape))
    found = np.asarray(evaluate(values, DT, T0, times, order))
    assert found.shape == (*times.shape, *channels)
    assert np.max(np.abs(found - reference(order, KNOTS, values, times))) < 1e-12


@pytest.mark.parametrize("order", [1, 3])
def test_the_nearest_end_value_is_held_outside(order):
    before, after = np.array([T0 - 1e-9, T0 - 100.0, -INF]), np.array([KNOTS[-1] + 1e-9, 1e6, INF])
    found = np.asarray(evaluate(VALUES, DT, T0, np.concatenate([before, after, [NAN]]), order))
    assert np.allclose(found[:3], VALUES[0], rtol=1e-14)
    assert np.allclose(found[3:6], VALUES[-1], rtol=1e-14)
    assert np.isnan(found[6])
    for derivative in slopes(make(VALUES, DT, T0, order=order), np.array([T0 - 1.0, KNOTS[-1] + 1.0])):
        assert np.all(derivative == 0)


@pytest.mark.parametrize(
    "number",
    [2, np.int32(2), np.float32(2.0), np.float64(2.0), jnp.array(2), np.array([2, 2])],
    ids=repr,
)
def test_times_of_any_kind_of_number(number):
    u = sampled(VALUES, 0.5)
    assert u(number).dtype == jnp.float64
    assert u(number).shape == np.shape(number)
    assert np.allclose(u(number), VALUES[4], rtol=1e-14)


# ---------------------------------------------------------------------------------------------- derivatives


@pytest.mark.parametrize("order", [1, 3])
def test_derivatives_in_time_are_those_of_the_reference(order):
    u = make(VALUES, DT, T0, order=order)
    times = np.linspace(T0 + 0.01, KNOTS[-1] - 0.013, 57)
    reverse, forward = slopes(u, times)
    if order == 3:
        expected = reference(3, KNOTS, VALUES, times, 1)
        second = jax.jit(jax.vmap(jax.grad(jax.grad(lambda t: u(t)))))(times)
        assert np.allclose(second, reference(3, KNOTS, VALUES, times, 2), rtol=1e-10, atol=1e-10)
    else:
        expected = (np.diff(VALUES) / DT)[((times - T0) / DT).astype(int)]
    assert np.allclose(forward, expected, rtol=1e-12, atol=1e-12)
    assert np.allclose(forward, reverse, rtol=1e-13)


def test_the_slope_at_the_ends_is_the_one_inside():
    """A simulation that starts with the signal needs its slope there, not half of it."""
    ends = KNOTS[[0, -1]]
    for order, expected in ((3, reference(3, KNOTS, VALUES, ends, 1)), (1, np.diff(VALUES)[[0, -1]] / DT)):
        for derivative in slopes(make(VALUES, DT, T0, order=order), ends):
            assert np.allclose(derivative, expected, rtol=1e-12)


def test_the_derivative_in_time_is_continuous_at_the_knots():
    u = make(VALUES, DT, T0)
    inner = KNOTS[1:-1]
    expected = reference(3, KNOTS, VALUES, inner, 1)
    for times in (inner, np.nextafter(inner, -INF)):
        for derivative in slopes(u, times):
            assert np.allclose(derivative, expected, rtol=1e-11)


def test_gradients_with_respect_to_values_period_start_and_time():
    """Forward = reverse = central differences."""

    @jax.jit
    def loss(values, dt, t0, t):
        return jnp.sum(jnp.sin(sampled(values, dt, t0)(t)))

    arguments = jnp.asarray(RNG.standard_normal((6, 2))), 0.25, -1.5, jnp.array([-1.45, -0.9, -0.31])
    forward = jax.jit(jax.jacfwd(loss, argnums=(0, 1, 2, 3)))(*arguments)
    reverse = jax.jit(jax.grad(loss, argnums=(0, 1, 2, 3)))(*arguments)
    h = 1e-5
    for i, x in enumerate(arguments):
        assert np.allclose(forward[i], reverse[i], rtol=1e-12, atol=1e-13)
        for index in np.ndindex(np.shape(x)):
            shift = np.zeros(np.shape(x))
            shift[index] = h
            plus, minus = ((*arguments[:i], x + sign * shift, *arguments[i + 1 :]) for sign in (1, -1))
            central = (loss(*plus) - loss(*minus)) / (2 * h)
            assert np.isclose(central, forward[i][index], rtol=1e-6, atol=1e-7), (i, index)


def test_the_result_is_linear_in_the_values():
    """Each column of the Jacobian is the spline through a unit sample."""
    times = TIMES[::7]
    J = jax.jit(jax.jacrev(lambda values: sampled(values, DT, T0)(times)))(VALUES)
    assert np.max(np.abs(J - reference(3, KNOTS, np.eye(9), times))) < 1e-12


# ---------------------------------------------------------------------------------------------- as data


def test_under_jit_as_argument_and_as_constant():
    u = sampled(VALUES, DT, T0)
    traces = []

    @jax.jit
    def call(u, t):
        traces.append(None)
        return u(t)

    assert np.allclose(call(u, TIMES), u(TIMES), rtol=1e-14)
    assert np.allclose(jax.jit(u)(TIMES), u(TIMES), rtol=1e-14)
    other = sampled(2 * VALUES, DT, T0)
    assert np.allclose(call(other, TIMES), 2 * u(TIMES), rtol=1e-14)
    assert len(traces) == 1  # new samples are new data, not a new program
    built_inside = jax.jit(lambda values, dt, t0: sampled(values, dt, t0)(TIMES))(VALUES, DT, T0)
    assert np.allclose(built_inside, u(TIMES), rtol=1e-12)


def test_under_vmap_over_signals_and_over_times():
    signals = RNG.standard_normal((3, 9))
    together = jax.jit(jax.vmap(lambda values: sampled(values, DT, T0)(TIMES)))(signals)
    batch = jax.jit(jax.vmap(lambda values: sampled(values, DT, T0)))(signals)
    one_by_one = np.stack([evaluate(x, DT, T0, TIMES) for x in signals])
    assert np.allclose(together, one_by_one, rtol=1e-12, atol=1e-14)
    assert np.allclose(jax.jit(jax.vmap(lambda u: u(TIMES)))(batch), one_by_one, rtol=1e-12, atol=1e-14)


def test_float32_is_kept():
    u = make(VALUES.astype(np.float32), DT, T0)
    assert {x.dtype.name for x in jax.tree.leaves(u)} == {"float32"}
    call = jax.jit(lambda u, t: u(t))
    for t in (0.1, np.float64(0.1), jnp.float32(0.1), TIMES):
        assert call(u, t).dtype == jnp.float32
    assert np.max(np.abs(np.asarray(call(u, TIMES)) - reference(3, KNOTS, VALUES, TIMES))) < 1e-5
    assert slopes(u, TIMES.astype(np.float32))[0].dtype == jnp.float32


def test_integer_samples_become_the_default_float_type():
    u = sampled([0, 1, 4, 9, 16, 25, 36, 49, 64], 1)
    assert {x.dtype.name for x in jax.tree.leaves(u)} == {"float64"}
    assert np.isclose(u(2.5), 6.25, rtol=1e-14)


# ---------------------------------------------------------------------------------------------- errors


# ---------------------------------------------------------------------------------------------- in a simulation


def driven(q, v, t, params):
    """An oscillator with one input."""
    return params["u"](t) - params["k"] * q - 0.3 * v


OSCILLATOR = hhtjax.System(np.ones(1), driven)
PREDICTOR = hhtjax.hht(alpha=-0.1, linearize="predictor")


def respond(values):
    """The path under an input with these samples, 0.1 apart."""
    params = {"u": sampled(values, 0.1), "k": 9.0}
    return hhtjax.simulate(OSCILLATOR, PREDICTOR, np.zeros(1), np.zeros(1), params, dt=0.02, num_steps=30)


@pytest.mark.slow
def test_a_simulation_with_a_sampled_input_is_that_with_the_function():
    """sin(2 t) sampled every 0.1 s: the spline is within 1e-4 of it at the ends, straight lines within 5e-3."""
    signal = np.sin(2 * 0.1 * np.arange(21))[:, None]
    smooth = hhtjax.System(np.ones(1), lambda q, v, t, params: jnp.sin(2 * t) - 9.0 * q - 0.3 * v)
    expected = hhtjax.simulate(smooth, PREDICTOR, np.zeros(1), np.zeros(1), dt=0.02, num_steps=30)
    solution = respond(signal)
    assert np.max(np.abs(np.asarray(solution.q) - np.asarray(expected.q))) < 1e-5
    assert np.max(np.abs(expected.q)) > 0.02


def test_a_sampled_input_starts_as_smoothly_as_the_function_it_samples():
    """The corrected start takes the slope of the force at t0: a0 - w0 = -(alpha_f) h dQ/dt with M = 1, q = v = 0."""
    ramp = {"u": sampled(np.arange(6.0)[:, None], 1.0), "k": 9.0}
    stepper = hhtjax.hht(alpha=-0.3, start="corrected")
    state = jax.jit(lambda u: stepper.init(OSCILLATOR, jnp.zeros(1), jnp.zeros(1), u, dt=0.1))(ramp)
    assert np.allclose(state.a - state.w, -0.3 * 0.1 * 1.0, rtol=1e-6)  # but for the fifth power of what h resolves


@pytest.mark.slow
def test_gradients_through_a_simulation_with_respect_to_the_samples():
    values = jnp.asarray(RNG.standard_normal((9, 1)))

    @jax.jit
    def loss(values):
        return jnp.sum(respond(values).q ** 2)

    forward, reverse = jax.jit(jax.jacfwd(loss))(values), jax.jit(jax.grad(loss))(values)
    assert np.allclose(forward, reverse, rtol=1e-11, atol=1e-16)
    assert np.count_nonzero(np.abs(forward) > 1e-8) >= 7  # the run ends at sample 6; the spline looks further
    for i in range(0, 9, 2):
        h = 1e-4
        change = loss(values.at[i].add(h)) - loss(values.at[i].add(-h))
        assert np.isclose(change / (2 * h), forward[i, 0], rtol=1e-6, atol=1e-10)


def test_new_samples_cost_no_compilation():
    traces = []

    def force(q, v, t, params):
        traces.append(None)
        return driven(q, v, t, params)

    system = hhtjax.System(np.ones(1), force)

    def end(values):
        params = {"u": sampled(values, 0.1), "k": 9.0}
        path = hhtjax.simulate(system, hhtjax.rk4(), np.zeros(1), np.zeros(1), params, dt=0.02, num_steps=4)
        return path.q[-1, 0]

    first = end(VALUES[:, None])
    count = len(traces)
    assert count > 0
    assert np.isclose(end(2 * VALUES[:, None]), 2 * first, rtol=1e-13)
    assert len(traces) == count
