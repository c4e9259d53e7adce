"""Events at known times: loads that are switched on, against formulas; their derivatives; and what is refused."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import check_message

import hhtjax
from hhtjax import Event, FirstOrderSystem, System, adaptive, hht, impact, rk4, simulate, sweep

LIGHT = hht(linearize="predictor")  # half the program of "auto"
ZERO, ONE = np.zeros(1), np.ones(1)
BODY = System(jnp.ones(1), lambda q, v, t, p: p["F"] + 0 * q)
LOAD = Event(at=lambda p: p["T"], switch=lambda p: p | {"F": p["F"] + 1.0})  # one newton more at each time
MANY = {  # of seven times each
    "t0, twice in one step, two at one time, the end": [0.0, 0.05, 0.3, 0.31, 0.31, 0.32, 1.0],
    "all on the grid": [0.1, 0.2, 0.3, 0.6, 0.7, 0.8, 0.9],
    "a rounding beside the grid": [np.nextafter(0.1 * k, np.inf if k % 2 else 0.0) for k in range(1, 8)],
    "before the start and behind the end": [-1.0, -0.5, 0.5, 1.01, 2.0, 2.0, np.inf],
    "all at once": [0.37] * 7,
    "a rounding behind the end": [-1.0, -1.0, -1.0, -1.0, -1.0, -1.0, 1 + 2e-16],
}


def loaded(T, stepper=LIGHT, start=0.0, **steps):
    steps = steps or {"dt": 0.1, "num_steps": 10}
    params = {"F": 0.0, "T": T}
    return simulate(BODY, stepper, ZERO, ZERO, params, t0=start, events=[LOAD], max_events=7, **steps)


def pushed(T, t, start=0.0):
    """Where the body is by the formula."""
    since = np.maximum(np.subtract.outer(t, [x for x in T if x >= start]), 0)
    return np.sum(since**2 / 2, axis=-1)


@pytest.mark.slow
@pytest.mark.parametrize("case", MANY)
def test_loads_at_known_times(case):
    T = np.array(MANY[case])
    run = loaded(T)
    run.check()
    met = T[(T >= 0) & (T <= 1 + 1e-15)]
    assert int(run.events.count) == met.size
    np.testing.assert_allclose(run.events.t[: met.size], met, rtol=0, atol=1e-15)
    np.testing.assert_allclose(run.q[:, 0], pushed(T, run.t), rtol=0, atol=1e-14)


def test_times_at_a_start_that_is_not_zero():
    """.1 + .2 is a rounding more than .3, where the run starts: no load is lost."""
    for T, start in ((0.3, 0.1 + 0.2), (0.1 + 0.2, 0.3)):
        run = loaded(np.array([0.0, T, 0.5, 0.6, 0.7, 0.8, 0.9]), start=start, dt=0.1, num_steps=10)
        assert int(run.events.count) == 6


DIVIDING = np.array(MANY["t0, twice in one step, two at one time, the end"])


@pytest.mark.slow
def test_they_divide_steps_of_an_uneven_grid():
    run = loaded(DIVIDING, dt=np.diff(np.linspace(0, 1, 12) ** 1.5))
    run.check()
    np.testing.assert_allclose(run.q[:, 0], pushed(DIVIDING, run.t), rtol=0, atol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("dts", [np.full(6, 0.1), adaptive(1e-4, 1e-7)], ids=["fixed", "adaptive"])
def test_the_members_of_a_sweep_have_times_of_their_own(dts):
    T = np.array([0.1, 0.25, 0.5, 1.0, 2.0, 0.0])[:, None]
    axes = None, None, None, {"F": None, "T": 0}
    params = {"F": 0.0, "T": T}
    runs = sweep(BODY, LIGHT, ZERO, ZERO, params, dts=dts, duration=1.0, num_samples=2, in_axes=axes, events=[LOAD])
    runs.check()
    assert runs.events.count.tolist() == [1, 1, 1, 1, 0, 1]
    np.testing.assert_allclose(runs.q[:, -1, 0], [pushed(t, 1.0) for t in T], rtol=0, atol=1e-14)


OSCILLATOR = System(jnp.ones(1), lambda q, v, t, p: p["F"] - p["k"] * (3.0 * q + 0.2 * v))
STEPS = {
    "fixed": {"dt": 0.1, "num_steps": 10},
    "adaptive": {"dt": adaptive(1e-4, 1e-7), "times": np.array([0.31, 0.5, 1.0])},
}


def kicked(T, k, steps):
    """Seven times of two newtons more each, and one of a kick: the end and the first time; and the run."""
    load = Event(at=T[:7], switch=lambda p: p | {"F": p["F"] + 2.0})
    kick = Event(at=T[7], reset=lambda q, v, t, p: v + 1)
    params, events = {"F": 0.0, "k": k}, [load, kick]
    run = simulate(OSCILLATOR, LIGHT, ONE, ZERO, params, events=events, max_events=7, **STEPS[steps])
    return jnp.concatenate([run.q[-1], run.v[-1], run.events.t[:1]]), run


@partial(jax.jit, static_argnums=3)
def along(T, k, dT, steps):
    """The end, its derivative along dT, and the run."""
    return jax.jvp(lambda T: kicked(T, k, steps), (T,), (dT,), has_aux=True)


@partial(jax.jit, static_argnums=3)
def back(T, k, weights, steps):
    return jax.vjp(lambda T: kicked(T, k, steps)[0], T)[1](weights)[0]


LATE = 2.0  # behind the end


@pytest.mark.slow
def test_they_divide_steps_under_error_control():
    """Steps end there, and none is rejected."""
    T = DIVIDING
    _, _, run = along(np.append(T, LATE), 0.0, np.zeros(8), "adaptive")
    run.check()
    np.testing.assert_allclose(run.q[:, 0], 1 + 2 * pushed(T, run.t), rtol=0, atol=1e-14)
    assert int(run.steps.rejected) == 0
    assert np.isclose(np.cumsum(run.steps.dt)[:, None], T[None, 1:], rtol=1e-14).any(axis=0).all()


@pytest.mark.slow
@pytest.mark.parametrize("steps", STEPS)
def test_the_derivative_in_the_times(steps):
    """Of q and v at the end, and of the first time: forward, reverse, and differences of the run; of a free body, with
    times on the grid, which differences would cross, the formula. Of two loads and the kick; the others come late."""
    used = np.array([0, 1, 7])

    def at(first, second, kick):
        return np.array([first, second, *[LATE] * 5, kick])

    def by_column(T, k):
        return np.stack([along(T, k, dT, steps)[1] for dT in np.eye(8)[used]], axis=1)

    def by_row(T, k):
        rows = np.stack([back(T, k, weights, steps) for weights in np.eye(3)])
        assert not np.any(np.delete(rows, used, axis=1))
        return rows[:, used]

    T = at(0.23, 0.61, 0.74)
    assert abs(by_column(T, 1.0) - by_row(T, 1.0)).max() < 1e-13
    if steps == "fixed":  # chosen steps would change with the times
        ends = [[along(T + s * d, 1.0, d, steps)[0] for s in (1, -1)] for d in 1e-6 * np.eye(8)[used]]
        central = [(on - before) / 2e-6 for on, before in ends]
        assert abs(by_column(T, 1.0) - np.stack(central, axis=1)).max() < 1e-8
    T = at(0.2, 0.6, 0.6)
    exact = [[-1.6, -0.8, -1.0], [-2.0, -2.0, 0.0], [1.0, 0.0, 0.0]]
    for found in by_column(T, 0.0), by_row(T, 0.0):
        np.testing.assert_allclose(found, exact, rtol=0, atol=1e-12)


def test_beside_guards_and_each_other():
    """A wall met at .5, where a load begins too; a kick, times that are noted, and an end."""
    wall = Event(lambda q, v, t, p: 0.5 - q[0], impact(1.0))
    load, kick = Event(at=0.5, switch=lambda p: p | {"F": -1.0}), Event(at=[0.2, 0.8], reset=lambda q, v, t, p: 1.5 * v)
    noted, end = Event(at=[0.05, 0.06, 0.8]), Event(at=0.93, terminal=True)
    events = [wall, load, kick, noted, end]
    run = simulate(BODY, LIGHT, ZERO, np.full(1, 0.4 / 0.32), {"F": 0.0}, dt=0.1, num_steps=10, events=events)
    run.check()
    v0 = 0.4 / 0.32
    hit = 0.2 + (0.5 - 0.2 * v0) / (1.5 * v0)
    which, times = [3, 3, 2, 0, 1, 3, 2, 4], [0.05, 0.06, 0.2, hit, 0.5, 0.8, 0.8, 0.93]
    order = np.argsort(times, kind="stable")
    assert run.events.which[:9].tolist() == [*np.array(which)[order], -1]
    np.testing.assert_allclose(run.events.t[:8], np.array(times)[order], rtol=1e-13)
    v = -1.5 * v0
    q = 0.5 + v * (0.5 - hit) + v * 0.3 - 0.3**2 / 2
    v = 1.5 * (v - 0.3)
    np.testing.assert_allclose(run.q[-1, 0], q + v * 0.13 - 0.13**2 / 2, rtol=1e-12)
    assert run.t[-1] == run.events.t[7]


@pytest.mark.slow
def test_a_load_at_the_time_of_an_impact():
    """Both act, whatever their order: neither changes the rate of the other's guard."""
    wall, load = Event(lambda q, v, t, p: 0.5 - q[0], impact(1.0)), Event(at=0.5, switch=lambda p: p | {"F": -1.0})
    for events in ([wall, load], [load, wall]):
        run = simulate(BODY, LIGHT, ZERO, ONE, {"F": 0.0}, dt=0.15, num_steps=7, events=events)
        run.check()
        assert int(run.events.count) == 2
        np.testing.assert_allclose(run.q[-1, 0], 0.5 - 0.55 - 0.55**2 / 2, rtol=1e-12)


@pytest.mark.slow
def test_a_first_order_system():
    clock = FirstOrderSystem(lambda y, t, p: 1.0 + 0 * y)
    back = Event(at=[0.5, 1.5], reset=lambda y, t, p: y - 1.0)
    run = simulate(clock, rk4(), ZERO, dt=0.3, num_steps=7, events=[back])
    run.check()
    t = np.asarray(run.t)
    np.testing.assert_allclose(run.q[:, 0], t - (t > 0.5) - (t > 1.5 - 1e-9), atol=1e-14)


@pytest.mark.slow
def test_float32_keeps_its_dtype():
    one = np.ones(1, np.float32)
    params = {"F": np.float32(0), "T": np.array([0.1, 0.35], np.float32)}
    with pytest.warns(hhtjax.PrecisionWarning):
        run = simulate(BODY, rk4(), 0 * one, 0 * one, params, dt=0.1, num_steps=10, events=[LOAD])
    run.check()
    assert run.events.t.dtype == run.q.dtype == np.float32
    np.testing.assert_allclose(run.q[-1, 0], pushed([0.1, 0.35], 1.0), rtol=1e-6)


@pytest.mark.slow
def test_other_times_compile_nothing():
    traced = []

    def times(p):
        traced.append(1)
        return p["T"]

    load = Event(at=times, switch=lambda p: p | {"F": p["F"] + 1.0})

    def call(T):
        return simulate(BODY, rk4(), ZERO, ZERO, {"F": 0.0, "T": T}, dt=0.1, num_steps=5, events=[load])

    call(np.array([0.1, 0.2]))
    before = len(traced)
    call(np.array([0.3, 0.33]))
    assert len(traced) <= before + 2  # the values are looked at anew


@pytest.mark.slow
def test_times_that_do_not_increase_are_named_under_jit_too():
    def end(T):
        return loaded(T)

    unsorted = np.array([0.0, 0.5, 0.3, 0.6, 0.7, 0.8, 0.9])
    message = "step 1 (to t = 0.1) failed: q and v are finite, but the guard is NaN at event 0"
    check_message(hhtjax.SimulationError, message, jax.jit(end)(unsorted).check)
    check_message(ValueError, "simulate: events[0]: `at` must hold numbers in increasing order", lambda: end(unsorted))


ERRORS = {
    "neither": (TypeError, "Event: give either `guard` or `at`; received guard=None and at=None.", Event),
    "both": (TypeError, "Event: give either `guard` or `at`", lambda: Event(lambda q, v, t, p: q[0], at=1.0)),
    "text": (TypeError, "Event: `at` must be a time, (K,) times, or a function at(params); received 'T'.",
             lambda: Event(at="T")),
    "a matrix": (ValueError, "Event: `at` must be a number, or of shape (K,); received the shape (2, 2).",
                 lambda: Event(at=np.ones((2, 2)))),
    "none": (ValueError, "received the shape (0,).", lambda: Event(at=[])),
    "no order": (ValueError, "Event: `at` must hold numbers in increasing order; received [2. 1.].",
                 lambda: Event(at=[2.0, 1.0])),
    "no number": (ValueError, "Event: `at` must hold numbers in increasing order; received nan.",
                  lambda: Event(at=np.nan)),
    "an impact": (TypeError, "Event: an impact needs the direction of a `guard`; received `at` without one.",
                  lambda: Event(at=1.0, reset=impact(0.5))),
    "arguments": (TypeError, "Event: `at` is called as at(params); received a function of 2 positional",
                  lambda: Event(at=lambda p, q: 1.0)),
    "returned": (TypeError, "simulate: events[0]: `at` must return a time, or (K,) times; received shape (1, 7)",
                 lambda: loaded(np.ones((1, 7)))),
    "switch": (TypeError, "Event: `switch` is called as switch(params) or switch(q, v, t, params); received a "
               "function of 2 positional arguments (q, p).", lambda: Event(at=1.0, switch=lambda q, p: p)),
}  # fmt: skip


@pytest.mark.parametrize("case", ERRORS)
def test_what_is_no_time_is_an_error_at_the_boundary(case):
    check_message(*ERRORS[case])
