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
from hhtjax.runs.chosen import chosen_steps, run_over
from hhtjax.runs.freezing import with_steps_for

BALL = System(ONE, lambda q, v, t, p: 0 * q - G)
FLOOR = Event(lambda q, v, t, p: q[0], impact("e"))
CASES = {  # and how many events there are
    "ball, hht": (event_problems.dragged_ball, hht(-0.3), 2),
    "ball, rowda": (event_problems.dragged_ball, rowda(), 2),
    "double pendulum, hht": (event_problems.stopped_double_pendulum, hht(-0.05), 1),
    "pendulum at a wall, hht": (event_problems.walled_pendulum, hht(-0.1), 1),
    "bump stop, hht": (event_problems.bump_stop, hht(-0.05), 6),
    "bump stop, rowda": (event_problems.bump_stop, rowda(), 6),
}


def drop(e, times=(0.2, 2.0), rtol=1e-3, **options):
    dt = adaptive(rtol, 1e-3 * rtol, **options)
    return simulate(BALL, hht(), ONE, ZERO, {"e": e}, dt=dt, times=np.array(times), events=[FLOOR])


@pytest.mark.parametrize("case", each(CASES, quick=(), rest=("ball, rowda", "bump stop, hht")))
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
    stop = Event(lambda q, v, t, p: (0.5 - q[0]) * (1 - 2 * p["on"]), switch=lambda p: p | {"on": 1 - p["on"]})
    wagon = System(ONE, lambda q, v, t, p: -p["on"] * p["k"] * (q - 0.5))
    for rtol in (1e-3, 1e-5):
        run = simulate(
            wagon, rowda(), ZERO, ONE, {"on": 0.0, "k": 1e6}, dt=adaptive(rtol, 1e-3 * rtol), times=[0.4, 1.0],
            events=[stop])  # fmt: skip
        run.check()
        assert run.events.count == 2
        assert abs(run.events.after[1, 0] + 1) < 2 * rtol
        assert abs(run.q[-1, 0] - (np.pi / 1e3)) < 2 * rtol
        assert run.steps.rejected > 0


@pytest.mark.slow
def test_derivatives_are_those_of_the_accepted_steps():
    """Reverse, differences over the same steps, and forward along a direction."""
    problem = event_problems.dragged_ball()

    def found(x):
        params = {"c": x[2], "e": x[3], "floor": x[4]}
        run = simulate(
            problem.system, hht(-0.3), x[:1], x[1:2], params, dt=adaptive(1e-3, 1e-6, max_steps=500),
            times=np.array([0.3, 0.5, 1.5]), events=problem.events)  # fmt: skip
        return jnp.array([jnp.sum(jnp.sin(run.q)), run.v[2, 0] + run.v[-1, 0], run.events.t[1]])

    x, step, along = jnp.array([1.0, 0.0, 0.3, 0.8, 0.0]), 1e-6, jnp.array([0.6, -0.7, 1.1, 0.4, -0.9])
    forward, reverse = jax.jvp(found, (x,), (along,))[1], jax.grad(lambda x: jnp.sum(found(x)))(x)
    at = jax.jit(lambda y: with_steps_for(found, y, x))
    central = jnp.stack([(at(x + d) - at(x - d)) / (2 * step) for d in step * jnp.eye(5)], axis=1)
    assert abs(reverse - jnp.sum(central, axis=0)).max() < 1e-7
    assert abs(forward - central @ along).max() < 1e-7
    assert abs(jnp.sum(forward) - reverse @ along) < 1e-11


def test_failures_keep_their_names_and_one_program():
    """A motion to rest ends at 3 sqrt(2/g) with e = .5; all tolerances, and e, are data."""
    run = drop(0.5)
    check_message(SimulationError, "simulate: stopped at t = 1.35457: more than max_events in a step", run.check)
    compiled = chosen_steps._cache_size(), run_over._cache_size()
    check_message(SimulationError, "stopped at t = 1.35", drop(0.5, dt_min=1e-4).check)
    run = drop(0.0, rtol=1e-4)
    check_message(SimulationError, "stopped at t = 0.451524: the motion stays beyond the guard of event 0", run.check)
    assert (chosen_steps._cache_size(), run_over._cache_size()) == compiled
    assert np.isfinite(run.q[:, 0]).tolist() == [True, True, False]
    assert run.steps.rejected > 20
    with pytest.raises(SimulationError, match=r"choose_steps: stopped at t = 0\.451524: the motion stays beyond"):
        run.steps.check()


@pytest.mark.slow
def test_a_terminal_event_ends_the_run():
    landing = Event(lambda q, v, t, p: q[0], terminal=True)

    def fly(v0):
        control = adaptive(1e-3, 1e-6)
        return simulate(BALL, hht(), ZERO, v0[None], dt=control, times=np.array([0.1, 2.0, 2.5, 3.0]), events=[landing])

    def with_times(v0):
        run = fly(v0)
        return run.t, run

    _, rate, run = jax.jvp(with_times, (jnp.array(10.0),), (jnp.array(1.0),), has_aux=True)
    run.check()
    end = 20 / G
    assert abs(run.t - np.array([0, 0.1, 2.0, end, end])).max() < 1e-13
    assert abs(run.q[-2:, 0]).max() < 1e-12
    assert abs(run.v[-2:, 0] + 10).max() < 1e-12
    assert abs(rate - np.array([0, 0, 0, 2 / G, 2 / G])).max() < 1e-12
    assert run.steps.reached == run.t[-1]


@pytest.mark.slow
def test_a_sweep_is_its_members():
    problem = event_problems.dragged_ball()
    e, rtol, times = np.array([0.6, 0.9, 0.7]), np.array([1e-3, 1e-5, 1e-4]), np.linspace(0, 1.5, 10)[1:]
    options = {"times": times, "events": problem.events}
    runs = sweep(
        problem.system, hht(), problem.q0, problem.v0, {**problem.params, "e": e}, dts=adaptive(rtol, 1e-3 * rtol),
        in_axes=(None, None, None, {"c": None, "e": 0, "floor": None}), **options)  # fmt: skip
    runs.check()
    for i in range(3):
        one = {**problem.params, "e": e[i]}
        dt = adaptive(rtol[i], 1e-3 * rtol[i], verify=True)
        run = simulate(problem.system, hht(), problem.q0, problem.v0, one, dt=dt, **options)
        run.check()
        assert 0 < np.max(run.error) < 5 * rtol[i]
        for name in ("accepted", "rejected"):
            assert getattr(run.steps, name) == getattr(runs.steps, name)[i]
        for x, y in ((run.q, runs.q), (run.v, runs.v), (run.events.t[:2], runs.events.t[:, :2])):
            assert abs(x - y[i]).max() < 1e-12


@pytest.mark.slow
def test_no_event_no_change():
    spring = System(ONE, lambda q, v, t, p: -4 * q - 0.1 * v)
    far = Event(lambda q, v, t, p: q[0] + 1e6, impact(0.5))
    options = {"dt": adaptive(1e-3, 1e-6), "times": [0.7, 3.0]}
    runs = [simulate(spring, hht(), ONE, ZERO, **options, **events) for events in ({}, {"events": [far]})]
    np.testing.assert_array_equal(runs[0].dt, runs[1].dt)
    np.testing.assert_allclose(runs[0].q, runs[1].q, rtol=1e-14)
    steps = hhtjax.choose_steps(spring, hht(), ONE, ZERO, times=[3.0], rtol=1e-3, atol=1e-6, events=[far])
    np.testing.assert_array_equal(runs[0].dt, steps.dt)
