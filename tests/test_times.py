"""How long a run goes on and where it is seen: `simulate(times=)` with steps of one size, and `duration=`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import check_message

import hhtjax

SPRING = hhtjax.System(jnp.ones(1), lambda q, v, t, params: -params * q)
START = jnp.ones(1), jnp.zeros(1), 4.0
TIMES = np.array([0.013, 0.0133, 0.02, 0.5, 0.777, 1.0])


def run(stepper=None, **options):
    return hhtjax.simulate(SPRING, stepper or hhtjax.rk4(), *START, **options)


@pytest.mark.slow
@pytest.mark.parametrize("stepper", [hhtjax.hht(), hhtjax.dopri5(), hhtjax.houbolt()], ids=["hht", "dopri5", "houbolt"])
def test_equal_steps_are_read_off_between_their_ends(stepper):
    """Some of the times in one step, some at its end: the cubics of the run, and the term that dopri5 adds to them."""
    path = run(stepper, dt=0.01, num_steps=100)
    found = run(stepper, dt=0.01, times=TIMES)
    found.check()
    np.testing.assert_array_equal(found.t, [0.0, *TIMES])
    assert found.dt == 0.01
    dense = hhtjax.interpolate(path, TIMES)
    for x, y in ((found.q, dense.q), (found.v, dense.v), (found.acceleration, dense.acceleration)):
        np.testing.assert_allclose(x[1:], y, atol=1e-6 if stepper.dense_term else 1e-12)
    if stepper.dense_term:  # by more than the cubics
        exact = np.cos(2 * TIMES)
        assert 10 * np.max(np.abs(found.q[1:, 0] - exact)) < np.max(np.abs(dense.q[:, 0] - exact))
    at_ends = run(stepper, dt=0.01, times=path.t[1:])
    np.testing.assert_allclose(at_ends.q, path.q, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::hhtjax.PrecisionWarning")
def test_one_program_for_all_steps_and_times():
    """In jit and vmap; samples before the first end of a step, and far from t = 0 in float32."""
    traced = []

    @jax.jit
    def ends(dt, times):
        traced.append(0)
        return run(dt=dt, times=times).q[1:, 0]

    for dt in (0.01, 0.3, 2.0):
        path = run(dt=dt, num_steps=int(np.ceil(1 / dt)))
        np.testing.assert_allclose(ends(dt, TIMES), hhtjax.interpolate(path, TIMES).q[:, 0], rtol=1e-12)
    assert len(traced) == 1
    many = jax.vmap(ends, (0, None))(jnp.array([0.01, 0.3]), TIMES)
    np.testing.assert_allclose(many, [ends(0.01, TIMES), ends(0.3, TIMES)], rtol=1e-12)
    start = jnp.ones(1, "float32"), jnp.zeros(1, "float32"), jnp.float32(4.0)
    t0, steps = np.float32(1000), np.arange(1, 11)
    far = hhtjax.simulate(SPRING, hhtjax.rk4(), *start, dt=0.1, t0=t0, times=t0 + np.float32(0.1) * steps)
    assert far.q.dtype == jnp.float32
    np.testing.assert_allclose(far.q[1:, 0], np.cos(0.2 * steps), atol=5e-4)


@pytest.mark.slow
def test_events_between_samples():
    """A ball that bounces, and one that ends its run: samples on the right side, and at the end."""
    ball = hhtjax.System(jnp.ones(1), lambda q, v, t, p: 0 * q - 10.0)
    floor = hhtjax.Event(lambda q, v, t, p: q[0], hhtjax.impact(0.5))
    times = np.array([0.4, 0.99, 1.01, 1.5, 1.9])
    start = ball, hhtjax.rk4(), jnp.full(1, 5.0), jnp.zeros(1)  # it meets the floor at t = 1, and at t = 2
    found = hhtjax.simulate(*start, dt=0.3, times=times, events=[floor])
    found.check()
    late = times - 1
    np.testing.assert_allclose(found.q[1:, 0], np.where(times < 1, 5 - 5 * times**2, 5 * late - 5 * late**2), atol=1e-9)
    end = hhtjax.Event(lambda q, v, t, p: q[0], terminal=True)
    found = hhtjax.simulate(*start, dt=0.3, times=times, events=[end], output=lambda q, v, t: (q[0], v[0], t))
    found.check()
    np.testing.assert_allclose(found.t[-3:], 1.0, rtol=1e-12)
    np.testing.assert_allclose(found.output[0], [5.0, 5 - 5 * 0.4**2, 5 - 5 * 0.99**2, 0, 0, 0], atol=1e-9)
    np.testing.assert_allclose(found.output[1], [0, -4, -9.9, -10, -10, -10], atol=1e-9)
    np.testing.assert_allclose(found.output[2][-3:], 1.0, rtol=1e-12)


@pytest.mark.slow
def test_orders_with_extrapolation_and_a_linear_system():
    linear = hhtjax.LinearSystem(M=jnp.ones(1), K=jnp.full(1, 4.0))

    def error(dt, levels):
        found = hhtjax.simulate(linear, hhtjax.hht(), *START[:2], dt=dt, times=TIMES, extrapolate=levels)
        found.check()
        return np.max(np.abs(found.q[1:, 0] - np.cos(2 * TIMES)))

    for levels, order in ((1, 2), (2, 3)):
        assert np.log2(error(0.05, levels) / error(0.025, levels)) == pytest.approx(order, abs=0.25)


def test_a_duration_is_that_of_a_sweep():
    """Steps are made smaller to land on the samples: the same numbers as of a sweep of one."""
    grid = {"duration": 1.0, "num_samples": 5}
    found, sweep = run(dt=0.03, **grid), hhtjax.sweep(SPRING, hhtjax.rk4(), *START, dts=np.array([0.03]), **grid)
    assert found.dt == pytest.approx(0.2 / 7)
    np.testing.assert_allclose(found.t, sweep.t[0], rtol=1e-15)
    np.testing.assert_allclose(found.q, sweep.q[0], rtol=1e-13)
    every = run(dt=0.1, duration=1.0)  # not eleven steps, by a rounding
    assert every.t.shape == (11,)
    assert run(dt=0.3, duration=1.0).dt == 0.25


def test_a_duration_under_error_control():
    found = run(hhtjax.hht(), dt=hhtjax.adaptive(1e-3, 1e-6), duration=1.0, num_samples=4)
    found.check()
    np.testing.assert_allclose(found.t, [0, 0.25, 0.5, 0.75, 1.0])


@pytest.mark.slow
def test_a_failure_is_named_by_the_end_of_its_step():
    """Which is at none of the times."""
    broken = hhtjax.System(jnp.ones(1), lambda q, v, t, p: jnp.where(t > 0.55, jnp.nan, -q))
    found = hhtjax.simulate(broken, hhtjax.rk4(), *START[:2], dt=0.1, times=[0.25, 0.85, 1.0])
    check_message(hhtjax.SimulationError, "step 6 (to t = 0.6) failed", found.check)
    assert np.isnan(found.q[-1, 0])
    back = jax.jit(lambda times: run(dt=0.1, times=times))(jnp.array([0.5, 0.2]))
    check_message(hhtjax.SimulationError, "`times` must increase, and lie after t0", back.check)
    negative = jax.jit(lambda dt: run(dt=dt, times=TIMES))(-0.1)
    assert np.all(np.isnan(negative.q[1:]))
    check_message(hhtjax.SimulationError, "`dt` must be positive and finite; it was -0.1", negative.check)


T = {"dt": 0.1, "times": [0.5, 1.0]}
D = {"dt": 0.1, "duration": 1.0}
WRONG = {
    "number too": (T | {"num_steps": 4}, "simulate: with `times`, leave `num_steps` out; received 4."),
    "save too": (T | {"save_every": 4}, "simulate: with `times`, leave `save_every` out; received 4."),
    "bar": (T | {"progress": True}, "simulate: with `times` and a number for `dt`, leave `progress` out."),
    "dt": (T | {"dt": -0.1}, "simulate: `dt` must be positive and finite; received -0.1."),
    "tiny": (T | {"dt": 1e-12}, "simulate: `dt` must take fewer than 2^31 steps to times[-1]=1.0; received 1e-12."),
    "order": (T | {"times": [0.5, 0.4]}, "simulate: `times` must be strictly increasing"),
    "both": (D | {"times": [1.0]}, "simulate: with `duration`, leave `times` out; received [1.0]."),
    "and number": (D | {"num_steps": 10}, "simulate: with `duration`, leave `num_steps` out; received 10."),
    "and save": (D | {"save_every": 2}, "with `duration`, leave `save_every` out: give `num_samples`; received 2."),
    "samples": ({"dt": 0.1, "num_samples": 4}, "simulate: `num_samples` goes with `duration`; received 4 alone."),
    "none": (D | {"num_samples": 0}, "simulate: `num_samples` must be a positive integer; received 0."),
    "negative": (D | {"duration": -1.0}, "simulate: `duration` must be positive and finite; received -1.0."),
    "long": (D | {"dt": 0.3, "num_samples": 5}, "simulate: `dt` must be at most 0.2, the distance of the samples"),
    "uneven": (D | {"dt": np.full(9, 0.1)}, "simulate: with `duration`, `dt` must be a number or adaptive(...)"),
    "no samples": (D | {"dt": hhtjax.adaptive(1e-3, 1e-6)}, "simulate: with dt=adaptive(...), give `times`"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_bad_input_is_named(name):
    options, message = WRONG[name]
    check_message((ValueError, TypeError, NotImplementedError), message, lambda: run(hhtjax.hht(), **options))


def test_a_traced_duration_is_refused():
    with pytest.raises(TypeError, match="simulate: with `duration`, `dt` and `duration` must be known"):
        jax.jit(lambda dt: run(dt=dt, duration=1.0))(0.1)
