"""Runs with events: failures by name, sweeps, dense output, extrapolation, uneven steps; and what does not change."""

import event_problems
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from event_problems import G
from helpers import check_message

import hhtjax
from hhtjax import Event, FirstOrderSystem, LinearSystem, SimulationError, System, hht, impact, rowda, simulate, sweep

BALL = System(jnp.ones(1), lambda q, v, t, p: 0 * q - p["g"])
FLOOR = Event(lambda q, v, t, p: q[0] - p["floor"], impact("e"))
LIGHT = hht(linearize="predictor")  # half the program of "auto"


DRAGGED = event_problems.dragged_ball()


def dragged(stepper=LIGHT, dt=0.05, q0=DRAGGED.q0, events=DRAGGED.events, extrapolate=1, **params):
    """With a spare event or none, from one program each."""
    return simulate(
        DRAGGED.system, stepper, q0, DRAGGED.v0, DRAGGED.params | params, dt=dt, num_steps=30, save_every=5,
        events=events, extrapolate=extrapolate)  # fmt: skip


def come_to_rest(e, num_steps, floor=0.0):
    return simulate(
        BALL, LIGHT, jnp.ones(1), jnp.zeros(1), {"g": G, "floor": floor, "e": e}, dt=2.0 / num_steps,
        num_steps=num_steps, events=[FLOOR])  # fmt: skip


@pytest.mark.slow
def test_a_motion_to_rest_fails_by_name():
    """With e = .5 the bounces pile up at t = 3 sqrt(2/g): the run is right before that step, and NaN after."""
    run = come_to_rest(0.5, 200)
    check_message(SimulationError, "step 136 (to t = 1.36) failed: more than max_events events in one step", run.check)
    assert np.isnan(run.q[136:]).all()
    assert np.nanmin(run.q) > -1e-9
    fall, up = np.sqrt(2 / G), 0.5 * np.sqrt(2 * G)
    assert abs(run.q[60, 0] - (up * (0.6 - fall) - G / 2 * (0.6 - fall) ** 2)) < 1e-12


def test_resting_contact_fails_by_name():
    run = come_to_rest(0.0, 200)
    check_message(
        SimulationError,
        "step 46 (to t = 0.46) failed: the guard stays negative, because nothing turned the motion back, at event 0",
        run.check,
    )
    assert np.isnan(run.q[46:]).all()
    assert np.nanmin(run.q) > -1e-9


@pytest.mark.slow
def test_impacts_at_the_ends_of_steps_are_at_their_times():
    """Where rounding puts the zero of the guard before the end, or behind it."""
    times = 0.01 * np.arange(5, 100)
    found = np.array([come_to_rest(1.0, 200, 1 - G * t**2 / 2).events.t[0] for t in times])
    assert np.abs(found - times).max() < 1e-14


@pytest.mark.slow
def test_a_guard_that_is_no_number_fails_by_name():
    root = Event(lambda q, v, t, p: jnp.sqrt(q[0]), terminal=True)
    run = simulate(BALL, LIGHT, jnp.ones(1), jnp.zeros(1), {"g": G}, dt=0.01, num_steps=100, events=[root])
    message = "step 46 (to t = 0.46) failed: q and v are finite, but the guard is NaN at event 0"
    check_message(SimulationError, message, run.check)


@pytest.mark.slow
@pytest.mark.parametrize("noted_first", [True, False])
def test_a_log_of_impacts_has_them_all_and_changes_nothing(noted_first):
    """On the guard of the impact itself, before it in the list or behind; one that it throws back is not met."""
    log, turned = Event(DRAGGED.events[0].guard), Event(lambda q, v, t, p: -v[0])
    events = [log, *DRAGGED.events, turned] if noted_first else [*DRAGGED.events, log, turned]
    alone, run = dragged(), dragged(events=events)
    run.check()
    np.testing.assert_array_equal(run.q, alone.q)
    which = np.array([0, 1, 0, 1]) if noted_first else np.array([1, 0, 1, 0])  # the log sees v before the impact
    assert run.events.which[:5].tolist() == [*which, -1]
    np.testing.assert_array_equal(run.events.t[:4], np.repeat(alone.events.t[:2], 2))
    np.testing.assert_array_equal(run.events.after[:4:2], run.events.before[:4:2])
    np.testing.assert_array_equal(run.events.after[1:4:2], alone.events.after[:2])
    often = dragged(dt=1.2, events=events, c=0.0, e=1.0)  # the same program: two impacts in most steps, both noted
    often.check()
    assert often.events.count == 80
    np.testing.assert_allclose(often.events.t[:80:2], np.sqrt(2 / G) * np.arange(1, 80, 2), rtol=1e-12)


@pytest.mark.slow
def test_an_impact_that_nothing_can_follow_fails_by_name():
    clock = Event(lambda q, v, t, p: 0.25 - t + 0 * q[0], impact(0.5))
    run = simulate(BALL, LIGHT, jnp.ones(1), jnp.zeros(1), {"g": 0.0}, dt=0.1, num_steps=5, events=[clock])
    check_message(SimulationError, "step 3 (to t = 0.3) failed: no velocity changes the guard of event 0", run.check)


@pytest.mark.slow
def test_no_event_no_change():
    runs = [dragged(floor=-1e6, events=events) for events in (None, DRAGGED.events)]
    assert bool(jnp.all(runs[0].q == runs[1].q))
    assert runs[1].events.count == 0
    assert runs[0].events is None
    assert runs[0].failure.event is None


@pytest.mark.slow
def test_a_sweep_is_its_members():
    e, q0 = np.linspace(0.7, 0.9, 5), np.linspace(0.6, 1.4, 5)[:, None]
    dts = np.array([0.1, 0.02, 0.013, 0.05, 0.007])
    params = {**DRAGGED.params, "e": e}
    options = {"in_axes": (None, 0, None, {"c": None, "e": 0, "floor": None}), "events": DRAGGED.events}
    runs = sweep(DRAGGED.system, LIGHT, q0, DRAGGED.v0, params, dts=dts, duration=1.5, num_samples=3, **options)
    runs.check()
    assert runs.events.t.shape == (5, 100)
    for i, steps in ((0, 15), (3, 30)):  # one program: the run with long steps goes on
        run = dragged(dt=1.5 / steps, q0=q0[i], e=e[i])
        assert np.sum(np.asarray(run.events.t) < 1.5) == int(runs.events.count[i])
        assert abs(run.q[: steps + 1 : steps // 15][:4] - runs.q[i]).max() < 1e-12
        assert abs(run.events.t[0] - runs.events.t[i, 0]) < 1e-12
    at_times = sweep(DRAGGED.system, LIGHT, q0, DRAGGED.v0, params, dts=dts, times=[0.4, 0.45, 1.5], **options)
    at_times.check()
    assert abs(at_times.q[-1, -1] - runs.q[-1, -1]).max() < 1e-4


@pytest.mark.slow
def test_a_member_that_fails_leaves_the_others_alone():
    e = np.array([0.5, 1.0, 0.9])
    params = {"g": G, "floor": 0.0, "e": e}
    runs = sweep(
        BALL, LIGHT, np.ones(1), np.zeros(1), params, dts=np.full(3, 0.01), duration=1.6, num_samples=4,
        in_axes=(None, None, None, {"g": None, "floor": None, "e": 0}), events=[FLOOR])  # fmt: skip
    assert [int(x) > 0 for x in runs.failure.step] == [True, False, False]
    check_message(SimulationError, "member 0 (1 of 3 failed)", runs.check)
    assert bool(jnp.all(jnp.isfinite(runs.q[1:])))


@pytest.mark.slow
def test_the_same_numbers_on_plain_jax():
    def end():
        run = dragged()
        return np.concatenate([run.q[-1], run.v[-1], run.acceleration[-1], run.events.t[:2]])

    found = end()
    with hhtjax.plain():
        plain = end()
    assert abs(found - plain).max() < 1e-12


@pytest.mark.slow
def test_float32_stays_float32():
    params = {"g": np.float32(9.81), "floor": np.float32(0), "e": np.float32(0.8)}
    start, grid = (np.ones(1, np.float32), np.zeros(1, np.float32), params), {"dt": 0.01, "num_steps": 100}
    with pytest.warns(hhtjax.PrecisionWarning):
        run, late = (simulate(BALL, LIGHT, *start, **grid, t0=t0, events=[FLOOR]) for t0 in (0.0, 1e6))
    run.check()
    with pytest.raises(hhtjax.SimulationError, match=r"times are equal in float32, near t = 1e\+06"):
        late.check()
    assert {x.dtype for x in jax.tree.leaves((run.q, run.v, run.events.t, run.events.after))} == {np.dtype(np.float32)}
    assert abs(float(run.events.t[0]) - np.sqrt(2 / 9.81)) < 1e-7  # three roundings of t


@pytest.mark.slow
def test_float32_finds_the_part_of_a_step():
    """To a millionth of it, against the formula; late in a run the rounding of t + tau is larger than that."""
    heights = np.linspace(0.002, 0.009, 8, dtype=np.float32)
    numbers = {"g": np.float32(9.81), "floor": np.float32(0), "e": np.float32(0.8)}

    def tau(height):
        start = np.array([height]), -np.ones(1, np.float32)
        run = simulate(BALL, hhtjax.hht(0.0), *start, numbers, dt=0.01, num_steps=1, events=[FLOOR])
        return run.events.t[0]

    with pytest.warns(hhtjax.PrecisionWarning):
        found = np.array([tau(height) for height in heights])
    exact = (np.sqrt(1 + 2 * 9.81 * heights.astype(float)) - 1) / 9.81
    assert np.abs(found - exact).max() < 1e-6 * 0.01


@pytest.mark.slow
def test_a_second_call_compiles_nothing():
    traced = []

    def guard(q, v, t, p):
        traced.append(1)
        return q[0] - p["floor"]

    floor = Event(guard, impact("e"))

    def call(e):
        params = {"g": G, "floor": 0.0, "e": e}
        return simulate(BALL, LIGHT, jnp.ones(1), jnp.zeros(1), params, dt=0.1, num_steps=5, events=[floor])

    call(0.5)
    before = len(traced)
    call(0.6)
    assert len(traced) <= before + 1  # the shapes are looked at anew


@pytest.mark.slow
def test_what_is_between_the_saved_times():
    params = {"g": G, "floor": 0.0, "e": 0.8}
    run = simulate(BALL, LIGHT, jnp.ones(1), jnp.zeros(1), params, dt=0.1, num_steps=12, save_every=3, events=[FLOOR])
    fall = np.sqrt(2 / G)
    first, second = 0.8 * G * fall, 0.64 * G * fall
    times = np.linspace(0, 1.2, 60)
    again = fall + 2 * first / G
    since, up = np.select([times < fall, times < again], [times, times - fall], times - again), 0.0
    up = np.select([times < fall, times < again], [0.0, first], second)
    q = np.where(times < fall, 1.0, 0.0) + up * since - G / 2 * since**2
    found = hhtjax.interpolate(run, times)
    assert abs(found.q[:, 0] - q).max() < 1e-12
    assert abs(found.v[:, 0] - (up - G * since)).max() < 1e-12
    outside = jax.jit(lambda times: hhtjax.interpolate(run, times))(np.array([-0.1, 1.201, 1.3]))
    assert np.isnan(outside.q).all()
    assert np.isnan(outside.v).all()


@pytest.mark.slow
def test_extrapolation_across_impacts():
    """The part of dt^2 goes; what is left of order 3 depends on where in its step an event falls."""

    def error(levels):
        run = dragged(hht(0.0, linearize="predictor"), extrapolate=levels)
        run.check()
        return abs(run.q[-1, 0] - DRAGGED.end[0])

    assert error(2) < error(1) / 100


@pytest.mark.slow
def test_runs_that_meet_other_events_cannot_be_joined():
    """A guard that is below zero for so short a time that only the finer steps see it."""
    short = Event(lambda q, v, t, p: 1.0 - 2.0 * jnp.exp(-(((t - 0.2) / 0.02) ** 2)) + 0 * q[0])
    run = simulate(BALL, LIGHT, np.zeros(1), np.zeros(1), {"g": G}, dt=0.4, num_steps=4, extrapolate=2, events=[short])
    check_message(SimulationError, "the runs combined by extrapolate have different events", run.check)


@pytest.mark.slow
def test_uneven_steps_and_modes_of_a_linear_system():
    """A stop that is a spring, switched by a mode; a LinearSystem is factorised anew where its params change."""
    system = LinearSystem(M=jnp.ones(1), K=lambda p: 4.0 * jnp.ones(1) + 96.0 * p["on"] * jnp.ones(1))
    stop = Event(lambda q, v, t, p: q[0] * (2 * p["on"] - 1), switch=lambda p: p | {"on": 1.0 - p["on"]})
    times = 2.0 * np.linspace(0, 1, 401) ** 1.3
    run = simulate(system, hht(0.0), -np.ones(1), np.zeros(1), {"on": 0.0}, dt=np.diff(times), events=[stop])
    run.check()
    quarter = np.pi / 4  # with 2 rad/s up to 0, then half a swing with 10 rad/s, and so on
    assert abs(run.events.t[:2] - np.array([quarter, quarter + np.pi / 10])).max() < 1e-4
    assert abs(run.q[-1, 0] + np.sin(2 * (2.0 - quarter - np.pi / 10))) < 1e-3


@pytest.mark.slow
def test_events_of_a_first_order_system():
    """A clock that is set back at 1; and one that is only noted."""
    clock = FirstOrderSystem(lambda y, t, p: 1.0 + 0 * y)
    back = Event(lambda y, t, p: 1.0 - y[0], lambda y, t, p: 0 * y)
    run = simulate(clock, LIGHT, np.zeros(1), dt=0.3, num_steps=12, events=[back])
    run.check()
    assert abs(run.events.t[:3] - np.array([1.0, 2.0, 3.0])).max() < 1e-13
    assert run.events.count == 3
    assert abs(jnp.sin(np.pi * (run.q[:, 0] - run.t))).max() < 1e-12  # at 3 s it is 0 or 1


@pytest.mark.slow
def test_an_event_that_is_noted_changes_nothing_and_is_met_once():
    spring = System(jnp.ones(1), lambda q, v, t, p: -q)
    section = Event(lambda q, v, t, p: q[0])
    runs = [
        simulate(spring, rowda(), np.ones(1), np.zeros(1), dt=0.05, num_steps=400, **options)
        for options in ({}, {"events": [section]})
    ]
    runs[1].check()
    t = np.asarray(runs[1].events.t[:4])
    assert runs[1].events.count == 3
    assert abs(t[:3] - np.pi * np.array([0.5, 2.5, 4.5])).max() < 1e-3
    np.testing.assert_array_equal(runs[0].q, runs[1].q)


def test_every_member_of_a_sweep_is_looked_at():
    """A start beyond the floor, and a restitution above 1: named by the member."""
    params = {"g": G, "floor": 0.0, "e": np.array([0.5, 0.6, 0.7])}
    axes = {"g": None, "floor": None, "e": 0}

    def runs(q0, params):
        options = {"in_axes": (None, 0, None, axes), "events": [FLOOR]}
        return sweep(BALL, LIGHT, q0, np.zeros(1), params, dts=np.full(3, 0.1), duration=0.2, num_samples=1, **options)

    heights = np.array([[1.0], [1.0], [-1.0]])
    check_message(
        ValueError, "sweep: member 2: the start is beyond the guard of events[0]", lambda: runs(heights, params)
    )
    steep = {**params, "e": np.array([0.5, 1.5, 0.7])}
    check_message(
        ValueError, "sweep: member 1: events[0]: `restitution` must lie in [0, 1]", lambda: runs(abs(heights), steep)
    )
