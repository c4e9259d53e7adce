"""Events of systems with rotations, internal states, dry friction and held inputs; and their errors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from event_problems import bounce
from helpers import check_message

import hhtjax
from hhtjax import Event, FirstOrderSystem, System, hht, impact, rk4, rotation, simulate

LIGHT = hht(linearize="predictor")  # half the program of "auto"
FREE = System(jnp.ones(1), lambda q, v, t, p: 0 * q)


@pytest.mark.slow
def test_a_rotation_meets_a_stop():
    """A body that turns about z, up to an angle of 1 with e = .5."""
    body = System(jnp.array([1.0, 2.0, 3.0]), lambda q, v, t, p: 0 * v)  # about a principal axis there is no torque
    stop = Event(lambda R, v, t, p: 1.0 - jnp.arctan2(R[1, 0], R[0, 0]), impact(0.5))
    run = simulate(body, LIGHT, jnp.eye(3), jnp.array([0.0, 0.0, 2.0]), dt=0.11, num_steps=10, events=[stop])
    run.check()
    angle = 1.0 - (1.1 - 0.5)
    assert abs(run.events.t[0] - 0.5) < 1e-12
    assert abs(run.q[-1] - rotation.exp(jnp.array([0.0, 0.0, angle]))).max() < 1e-12
    assert abs(run.v[-1] - np.array([0.0, 0.0, -1.0])).max() < 1e-12


@pytest.mark.slow
def test_internal_states_go_on_through_an_impact():
    """An arm on a motor, against a stop; z, the current, is seen by the reset, and stays."""
    arm = System(
        jnp.full(1, 0.1),
        lambda q, v, z, t, p: 0.5 * z - 0.01 * v,
        internal=lambda q, v, z, t, p: 20 * (2.0 - z - 0.5 * v),
    )
    stop = Event(lambda q, v, z, t, p: 1.0 - q[0], lambda q, v, z, t, p: -(0.5 + 0.1 * z) * v)

    def rates(t, y):
        return [y[1], 10 * (0.5 * y[2] - 0.01 * y[1]), 20 * (2.0 - y[2] - 0.5 * y[1])]

    start = [0.0, 0.0, 0.0]
    end = bounce(rates, start, 0.75, lambda y: 1.0 - y[0], lambda y: [y[0], -(0.5 + 0.1 * y[2]) * y[1], y[2]])
    zero = np.zeros(1)
    error = []
    for k in (1, 2):  # one program: the run with long steps goes on
        run = simulate(arm, LIGHT, zero, zero, z0=zero, dt=0.006 / k, num_steps=250, save_every=125, events=[stop])
        run.check()
        error.append(np.abs(np.concatenate([run.q[k], run.v[k], run.z[k]]) - end).max())
    assert run.events.count >= 1
    assert run.events.z.shape == (100, 1)
    assert error[1] < 2e-4
    assert 1.7 < np.log2(error[0] / error[1]) < 2.3


@pytest.mark.slow
def test_dry_friction_and_an_impact():
    """A block slides with 1 m/s^2 of friction against a wall half a metre away, and back: v^2 loses 2 F s."""
    block = System(jnp.ones(1), lambda q, v, t, p: 0 * q, friction=lambda q, v, t, p: 1.0 + 0 * q)
    wall = Event(lambda q, v, t, p: 0.5 - q[0], impact(0.8))
    run = simulate(block, hht(), np.zeros(1), np.full(1, 2.0), dt=0.017, num_steps=150, events=[wall])
    run.check()
    hit = np.sqrt(4.0 - 1.0)
    assert abs(run.events.before[0, 0] - hit) < 1e-12
    assert abs(run.events.after[0, 0] + 0.8 * hit) < 1e-12
    assert abs(run.q[-1, 0] - (0.5 - (0.8 * hit) ** 2 / 2)) < 1e-4
    assert bool(run.sticking[-1, 0])


@pytest.mark.slow
def test_a_held_input_jumps_between_the_steps():
    """An impact with an input that is held over steps: free flight with 1, then -1, from sample to sample."""
    u = hhtjax.sampled(np.array([1.0, -1.0, 1.0, -1.0]), 0.25, order=0)
    system = System(jnp.ones(1), lambda q, v, t, p: 0 * q + p["u"](t))
    wall = Event(lambda q, v, t, p: 0.2 - q[0], impact(1.0))
    run = simulate(system, hht(0.0), np.zeros(1), np.full(1, 0.5), {"u": u}, dt=0.05, num_steps=20, events=[wall])
    run.check()

    q, v, t = 0.0, 0.5, 0.0
    for a in (1.0, -1.0, 1.0, -1.0):
        h = 0.25
        if 0.2 - (q + v * h + a * h * h / 2) < 0:
            tau = (-v + np.sqrt(v * v + 2 * a * (0.2 - q))) / a
            q, v, h, hit = 0.2, -(v + a * tau), h - tau, t + tau
        q, v, t = q + v * h + a * h * h / 2, v + a * h, t + 0.25
    assert run.events.count == 1
    assert abs(run.events.t[0] - hit) < 1e-12
    assert abs(run.q[-1, 0] - q) < 1e-12
    assert abs(run.v[-1, 0] - v) < 1e-12


@pytest.mark.slow
def test_a_held_input_jumps_as_the_modes_have_it():
    """An input that a switch has turned on at t = .11 jumps at .25, where a step begins that meets a wall at .27."""
    u = hhtjax.sampled(np.array([1.0, -1.0]), times=[0.0, 0.25], order=0)
    system = System(jnp.ones(1), lambda q, v, t, p: 0 * q + p["zone"] * p["u"](t))
    on = Event(
        lambda q, v, t, p: (0.11 - t) * (1 - p["zone"]) + p["zone"], switch=lambda p: p | {"zone": 1 + p["zone"]}
    )
    wall = Event(lambda q, v, t, p: 0.1474 - q[0], impact(1.0))
    start, params = (np.zeros(1), np.full(1, 0.5)), {"u": u, "zone": 0.0}
    run = simulate(system, hht(0.0), *start, params, dt=0.05, num_steps=20, events=[on, wall])
    run.check()
    np.testing.assert_allclose(run.events.t[:3], [0.11, 0.27, np.nan], rtol=1e-12)
    np.testing.assert_allclose(run.v[-1, 0], -0.62 - 0.73, rtol=1e-12)
    np.testing.assert_allclose(run.q[-1, 0], 0.1474 - 0.62 * 0.73 - 0.73**2 / 2, rtol=1e-12)


@pytest.mark.slow
def test_a_guard_sees_what_an_input_holds_until_the_end_of_the_step():
    """A level that rises at t = .1, just behind the time at which q meets it."""
    level = hhtjax.sampled(np.array([0.95, 5.0]), 0.1, order=0)
    turn = Event(
        lambda q, v, t, p: (p["level"](t) - q[0]) * (1 - p["met"]) + p["met"],
        lambda q, v, t, p: -v,
        switch=lambda p: p | {"met": 1 + p["met"]},
    )
    params = {"level": level, "met": 0.0}
    run = simulate(FREE, LIGHT, ZERO, 10 * ONE, params, dt=0.01, num_steps=20, events=[turn])
    run.check()
    np.testing.assert_allclose([run.events.t[0], run.q[-1, 0]], [0.095, -0.1], rtol=1e-12)


ONE, ZERO = np.ones(1), np.zeros(1)


def call(events, stepper=None, params=None, q0=ONE, v0=ZERO, system=FREE):
    return simulate(system, stepper or hht(), q0, v0, params, dt=0.1, num_steps=4, events=events)


HEIGHT = Event(lambda q, v, t, p: q[0])
ERRORS = {
    "no list": (TypeError, "simulate: `events` must be a list of Event(...); received Event", lambda: call(HEIGHT)),
    "no event": (TypeError, "`events[0]` must be an Event(...); received 3", lambda: call([3])),
    "a vector": (TypeError, "events[0]: `guard` must return a number; received shape (2,)",
                 lambda: call([Event(lambda q, v, t, p: jnp.ones(2) * q[0])])),
    "arguments": (TypeError, "events[0]: `guard` must be a function guard(q, v, t, params)",
                  lambda: call([Event(lambda t: t)])),
    "a stepper": (NotImplementedError, "KimHHT does not support events",
                  lambda: call([HEIGHT], stepper=hhtjax.kim_hht(0.0))),
    "beyond": (ValueError, "the start is beyond the guard of events[1]: it is -1, with the rate 0",
               lambda: call([HEIGHT, Event(lambda q, v, t, p: q[0] - 2.0, impact(0.5))])),
    "not rising": (ValueError, "the start is beyond the guard of events[0]: it is 0",
                   lambda: call([Event(lambda q, v, t, p: q[0] - 1.0, impact(0.5))])),
    "restitution": (ValueError, "impact: `restitution` must lie in [0, 1]; received -0.1.", lambda: impact(-0.1)),
    "in params": (ValueError, "events[0]: `restitution` must lie in [0, 1]; received 1.5.",
                  lambda: call([Event(HEIGHT.guard, impact("e"))], params={"e": 1.5})),
    "no name": (ValueError, "must be the name of one in params; received 'e'",
                lambda: call([Event(HEIGHT.guard, impact("e"))], params={"a": 0.5})),
    "on v": (ValueError, "events[0]: the `guard` of an impact must depend on q and t only, not on v",
             lambda: call([Event(lambda q, v, t, p: q[0] + v[0], impact(0.5))])),
    "reset": (ValueError, "events[0]: `reset` must return a pytree like v0",
              lambda: call([Event(HEIGHT.guard, lambda q, v, t, p: jnp.zeros(2))])),
    "structure": (TypeError, "events[0]: `switch` must return params like its own",
                  lambda: call([Event(HEIGHT.guard, switch=lambda p: {"b": 1.0})], params={"a": 1.0})),
    "dtype": (TypeError, "events[0]: `switch` must keep shapes and dtypes; params['a'] was",
              lambda: call([Event(HEIGHT.guard, switch=lambda p: {"a": p["a"] + 0.5})], params={"a": 1})),
    "terminal": (TypeError, "Event: `terminal` must be True or False; received 1.",
                 lambda: Event(HEIGHT.guard, terminal=1)),
    "max_events": (ValueError, "simulate: `max_events` must be a positive integer; received 0.",
                   lambda: simulate(FREE, hht(), ONE, ZERO, dt=0.1, num_steps=4, events=[HEIGHT], max_events=0)),
    "an impact of y": (TypeError, "an impact needs velocities",
                       lambda: call([Event(lambda y, t, p: y[0], impact(0.5))], v0=None,
                                    system=FirstOrderSystem(lambda y, t, p: -y))),
}  # fmt: skip


@pytest.mark.parametrize("case", ERRORS)
def test_what_does_not_fit_is_an_error_at_the_boundary(case):
    check_message(*ERRORS[case])


@pytest.mark.slow
def test_a_start_on_the_guard_that_rises():
    run = call([Event(lambda q, v, t, p: q[0] - 1.0, impact(0.5))], stepper=rk4(), v0=ONE)
    run.check()
    assert run.events.count == 0
    assert abs(run.q[-1, 0] - 1.4) < 1e-12


@pytest.mark.slow
def test_a_traced_start_beyond_the_guard_is_named():
    def end(q0):
        return call([Event(lambda q, v, t, p: q[0], impact(0.5))], q0=q0)

    run = jax.jit(end)(-ONE)
    check_message(
        hhtjax.SimulationError,
        "step 1 (to t = 0.1) failed: the guard stays negative, because nothing turned the motion back, at event 0",
        run.check,
    )


@pytest.mark.slow
def test_a_guard_that_its_switch_makes_negative_is_named():
    """A threshold that moves away by more than the motion, where it should have moved ahead of it."""
    passing = Event(lambda q, v, t, p: p["level"] - q[0], switch=lambda p: {"level": p["level"] - 1.0})
    run = call([passing], stepper=rk4(), v0=ONE, params={"level": 1.25})
    message = "step 3 (to t = 0.3) failed: after the switch and the reset of an event a guard is negative, "
    check_message(hhtjax.SimulationError, message + "that of event 0. Guards must be positive", run.check)
