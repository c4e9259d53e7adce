"""Events under error control: errors follow the tolerance, samples lie on the motion, failures keep their names."""

import event_problems
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from event_problems import G
from helpers import ONE, ZERO, check_message
from zoo import each

import hhtjax
from hhtjax import Event, SimulationError, System, adaptive, hht, impact, rowda, simulate, sweep
from hhtjax.runs.controlled_run import chosen_steps, run_over
from hhtjax.runs.frozen_steps import with_steps_for

BALL = System(ONE, lambda q, v, t, p: -p["g"] - p["k"] * q - p["c"] * v)  # with a spring and a damper
STEPPER = hht(linearize="predictor")  # half the program of "auto"
EVENTS = [
    Event(lambda q, v, t, p: q[0] - p["floor"], impact("e")),
    Event(lambda q, v, t, p: q[0] - p["end"], terminal=True),
]
FREE = {"g": 0.0, "k": 0.0, "c": 0.0, "e": 0.0, "floor": -1e6, "end": -1e6}
CASES = {  # and how many events there are
    "ball, hht": (event_problems.dragged_ball, hht(-0.3), 2),
    "ball, rowda": (event_problems.dragged_ball, rowda(), 2),
    "double pendulum, hht": (event_problems.stopped_double_pendulum, hht(-0.05), 1),
    "pendulum at a wall, hht": (event_problems.walled_pendulum, hht(-0.1, linearize="predictor"), 1),
    "bump stop, hht": (event_problems.bump_stop, hht(-0.05), 6),
    "bump stop, rowda": (event_problems.bump_stop, rowda(), 6),
}
REST = [case for case in CASES if case not in ("pendulum at a wall, hht", "bump stop, rowda")]  # a sweep has a ball


def throw(times, q0=ONE, v0=ZERO, rtol=1e-3, events=EVENTS, dt_min=0.0, verify=False, **params):
    """One program for all that is chosen, and one for each number of times."""
    dt = adaptive(rtol, 1e-3 * rtol, dt_min=dt_min, verify=verify)
    return simulate(BALL, STEPPER, q0, v0, FREE | params, dt=dt, times=np.array(times), events=events)


def drop(e, times=(0.2, 0.3, 0.4, 2.0), **options):
    return throw(times, g=G, e=e, floor=0.0, **options)


@pytest.mark.parametrize("case", each(CASES, quick=(), rest=REST))
def test_the_error_follows_the_tolerance(case):
    make, stepper, count = CASES[case]
    problem = make()
    n, times = len(problem.q0), problem.duration * np.array([0.5, 1.0])
    for rtol in (1e-3, 1e-4, 1e-6):
        run = simulate(
            problem.system, stepper, problem.q0, problem.v0, problem.params,
            dt=adaptive(rtol, 1e-3 * rtol, max_steps=20_000), times=times, events=problem.events)  # fmt: skip
        run.check()
        assert run.events.count == count
        errors = np.concatenate([run.q[-1] - problem.end[:n], run.v[-1] - problem.end[n:]])
        sizes = np.concatenate([abs(run.q).max(axis=0), abs(run.v).max(axis=0)])
        assert 0.02 < np.max(abs(errors) / sizes) / rtol < 10


def bounced(times, e):
    """Where and how fast a ball is, which falls from 1."""
    fall = np.sqrt(2 / G)
    ends = np.cumsum([fall, *(2 * fall * e ** np.arange(1, 20))])
    number = np.searchsorted(ends, times, side="right")
    since = times - np.concatenate([[0.0], ends])[number]
    up = np.where(number == 0, 0.0, G * fall * e**number)
    return np.where(number == 0, 1.0, 0.0) + up * since - G / 2 * since**2, up - G * since


@pytest.mark.slow
def test_samples_lie_on_the_motion():
    """Steps have no error, and grow until one holds several samples and events; one sample is an impact."""
    times = np.sort(np.append(np.linspace(0.0, 1.8, 61)[1:], np.sqrt(2 / G)))
    run = drop(0.8, times)
    run.check()
    q, v = bounced(times, 0.8)
    met = np.searchsorted(times, np.sqrt(2 / G))
    smooth = np.arange(times.size) != met  # there v is that before, or behind
    assert run.events.count == 3
    assert run.steps.accepted < 20
    assert abs(run.q[1:, 0] - q).max() < 1e-12
    assert abs(run.v[1:, 0] - v)[smooth].max() < 1e-12
    assert abs(run.acceleration + G).max() < 1e-9


@pytest.mark.slow
def test_what_is_behind_an_event_has_an_error_of_its_own():
    """Free flight lets steps grow, and ends in a hard spring: a half period of it, and back."""
    params = {"on": 0.0, "k": 0.0, "load": 0.0, "stiff": 1e6, "c": 0.0, "place": 0.5}
    system, events = event_problems.PRESSED, [event_problems.TOUCHING]  # the program of the bump stop
    for rtol in (1e-3, 1e-5):
        run = simulate(
            system, rowda(), ZERO, ONE, params, dt=adaptive(rtol, 1e-3 * rtol, max_steps=20_000), times=[0.4, 1.0],
            events=events)  # fmt: skip
        run.check()
        assert run.events.count == 2
        assert abs(run.events.after[1, 0] + 1) < 2 * rtol
        assert abs(run.q[-1, 0] - (np.pi / 1e3)) < 2 * rtol
        assert run.steps.rejected > 0


@pytest.mark.slow
def test_derivatives_are_those_of_the_accepted_steps():
    """In reverse, through two impacts, and by differences over the same steps; forward below. A guard closes over x."""
    problem = event_problems.dragged_ball()

    def found(x):
        params, floor = {"c": x[2], "e": x[3]}, Event(lambda q, v, t, p: q[0] - x[4], impact("e"))
        run = simulate(
            problem.system, hht(-0.3, linearize="predictor"), x[:1], x[1:2], params,
            dt=adaptive(1e-3, 1e-6, max_steps=500), times=np.array([0.3, 0.5, 1.5]), events=[floor])  # fmt: skip
        return jnp.array([jnp.sum(jnp.sin(run.q)), run.v[2, 0] + run.v[-1, 0], run.events.t[1]])

    x, step = np.array([1.0, 0.0, 0.3, 0.8, 0.0]), 1e-6
    over_steps_of_x = jax.jit(lambda y: jnp.sum(with_steps_for(found, y, x)))
    value, reverse = jax.jit(jax.value_and_grad(lambda x: jnp.sum(found(x))))(x)
    assert abs(value - over_steps_of_x(x)) < 1e-12
    central = [(over_steps_of_x(x + d) - over_steps_of_x(x - d)) / (2 * step) for d in step * np.eye(5)]
    assert abs(reverse - np.stack(central)).max() < 1e-7


@pytest.mark.slow
def test_failures_keep_their_names_and_one_program():
    """A motion to rest ends at 3 sqrt(2/g) with e = .5; all tolerances, and e, are data."""
    run = drop(0.5)
    check_message(
        SimulationError, "simulate: stopped at t = 1.35457: more than max_events events in one step", run.check
    )
    compiled = chosen_steps.number(), run_over.number()
    check_message(SimulationError, "stopped at t = 1.35", drop(0.5, dt_min=1e-4).check)
    run = drop(0.0, rtol=1e-4)
    check_message(
        SimulationError,
        "stopped at t = 0.451524: the guard stays negative, because nothing turned the motion back, at event 0",
        run.check,
    )
    assert (chosen_steps.number(), run_over.number()) == compiled
    assert np.isfinite(run.q[:, 0]).tolist() == [True, True, True, True, False]
    assert run.steps.rejected > 20
    with pytest.raises(SimulationError, match=r"choose_steps: stopped at t = 0\.451524: the guard stays negative"):
        run.steps.check()


@pytest.mark.slow
def test_a_terminal_event_ends_the_run():
    def fly(v0):
        run = throw([0.1, 2.0, 2.5, 3.0], ZERO, v0[None], g=G, end=0.0)
        return (run.t, run.q[:, 0], run.v[:, 0]), run

    _, rates, run = jax.jvp(fly, (jnp.array(10.0),), (jnp.array(1.0),), has_aux=True)
    run.check()
    end = 20 / G
    assert abs(run.t - np.array([0, 0.1, 2.0, end, end])).max() < 1e-13
    assert abs(run.q[-2:, 0]).max() < 1e-12
    assert abs(run.v[-2:, 0] + 10).max() < 1e-12
    exact = [0, 0, 0, 2 / G, 2 / G], [0, 0.1, 2, 0, 0], [1, 1, 1, -1, -1]
    assert abs(np.stack(rates) - np.array(exact)).max() < 1e-12
    assert run.steps.reached == run.t[-1]


@pytest.mark.slow
def test_a_sweep_is_its_members():
    e, rtol, times = np.array([0.6, 0.9, 0.7]), np.array([1e-3, 1e-5, 1e-4]), [0.3, 0.5, 0.8, 1.5]
    dragged = {"g": G, "c": 0.3, "floor": 0.0}
    runs = sweep(
        BALL, STEPPER, ONE, ZERO, {**FREE, **dragged, "e": e}, dts=adaptive(rtol, 1e-3 * rtol), times=times,
        in_axes=(None, None, None, {name: 0 if name == "e" else None for name in FREE}), events=EVENTS)  # fmt: skip
    runs.check()
    for i in range(3):
        run = throw(times, rtol=rtol[i], verify=True, e=e[i], **dragged)
        run.check()
        assert 0 < np.max(run.error) < 5 * rtol[i]
        for name in ("accepted", "rejected"):
            assert getattr(run.steps, name) == getattr(runs.steps, name)[i]
        for x, y in ((run.q, runs.q), (run.v, runs.v), (run.events.t[:2], runs.events.t[:, :2])):
            assert abs(x - y[i]).max() < 1e-12


@pytest.mark.slow
def test_no_event_no_change():
    spring, times = {"k": 4.0, "c": 0.1}, [0.7, 1.2, 2.0, 3.0]
    runs = [throw(times, events=events, **spring) for events in (None, EVENTS)]
    np.testing.assert_array_equal(runs[0].dt, runs[1].dt)
    np.testing.assert_allclose(runs[0].q, runs[1].q, rtol=1e-14)
    steps = hhtjax.choose_steps(
        BALL, STEPPER, ONE, ZERO, FREE | spring, times=[3.0], rtol=1e-3, atol=1e-6, events=EVENTS
    )
    np.testing.assert_array_equal(runs[0].dt, steps.dt)
