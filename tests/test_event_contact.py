"""Rest at a guard, contact that begins and ends by events, guards of multipliers, and switches that see the state."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import check_message
from scipy.optimize import brentq

import hhtjax
from hhtjax import Event, SimulationError, System, adaptive, hht, impact, rk4, simulate, sweep
from hhtjax.scenes import shaken_table

LIGHT = hht(linearize="predictor")  # half the program of "auto"
ZERO, ONE = np.zeros(1), np.ones(1)
PULLED = System(jnp.ones(1), lambda q, v, t, p: p["F"] + 0 * q)
STOP = Event(lambda q, v, t, p: q[0] - p["stop"], impact(0.5))


def pulled(force, rate, stop=0.0, **steps):
    """A body at its stop."""
    steps = steps or {"dt": 0.1, "num_steps": 10}
    return simulate(PULLED, rk4(), ZERO + stop, ZERO + rate, {"F": force, "stop": stop}, events=[STOP], **steps)


@pytest.mark.slow
@pytest.mark.parametrize("rate", [0.0, -0.0, -1e-17, 1e-17])
@pytest.mark.parametrize("stop", [0.0, -3.7])
def test_a_body_at_rest_at_its_stop_that_is_pulled_off(rate, stop):
    run = pulled(2.0, rate, stop)
    run.check()
    assert run.events.count == 0
    np.testing.assert_allclose(run.q[:, 0] - stop, run.t**2, atol=1e-14)


@pytest.mark.parametrize("force", [0.0, -2.0])
@pytest.mark.parametrize("rate", [0.0, -1e-17, 1e-17])
def test_one_that_is_not_is_refused(force, rate):
    if force == 0 and rate > 0:
        return  # it leaves
    message = (
        f"the start is beyond the guard of events[0]: it is 0, with the rate {rate:.6g} and the second derivative "
    )
    check_message(ValueError, message + f"{force:.6g}; it must be positive", lambda: pulled(force, rate))


def test_a_rate_that_is_no_rounding_is_refused():
    """At -1e-9 it is beyond its stop for a nanosecond, a hundred millionth of a step; at -1e-12 a rounding of that."""
    pulled(2.0, -1e-12).check()
    check_message(ValueError, "it is 0, with the rate -1e-09 and the second derivative 2", lambda: pulled(2.0, -1e-9))


def test_traced_starts_are_judged_by_their_steps():
    """Of rounding it is rest; at once an impact where the rate is more, though the body would come back by itself."""

    @jax.jit
    def end(force, rate):
        return pulled(force, rate)

    for rate in (0.0, -1e-17, 1e-17):
        run = end(2.0, rate)
        run.check()
        assert run.events.count == 0
    run = end(2.0, -0.1)
    run.check()
    np.testing.assert_allclose(run.q[:, 0], 0.05 * run.t + run.t**2, atol=1e-14)
    assert (int(run.events.count), float(run.events.t[0])) == (1, 0.0)
    check_message(SimulationError, "step 1 (to t = 0.1) failed: the guard stays negative", end(-2.0, 0.0).check)


@pytest.mark.slow
def test_such_starts_under_error_control_and_in_a_sweep():
    control = {"dt": adaptive(1e-4, 1e-7), "times": [1.0]}
    run = simulate(PULLED, LIGHT, ZERO, ZERO - 1e-17, {"F": 2.0, "stop": 0.0}, events=[STOP], **control)
    run.check()
    np.testing.assert_allclose(run.q[-1], 1.0, rtol=1e-12)
    F = np.array([2.0, 1.0, -1.0])

    def members(F):
        axes = None, None, None, {"F": 0, "stop": None}
        options = {"dts": np.full(F.size, 0.1), "duration": 1.0, "num_samples": 1, "in_axes": axes, "events": [STOP]}
        return sweep(PULLED, LIGHT, ZERO, ZERO - 1e-17, {"F": F, "stop": 0.0}, **options)

    np.testing.assert_allclose(members(F[:2]).q[:, -1, 0], F[:2] / 2, rtol=1e-12)
    check_message(ValueError, "sweep: member 2: the start is beyond the guard of events[0]", lambda: members(F))


@pytest.mark.slow
def test_a_guard_of_the_velocity_is_judged_by_the_jerk():
    """At rest at the top of its path, thrown up by a force that grows."""
    turns = Event(lambda q, v, t, p: v[0], switch=lambda p: p | {"n": p["n"] + 1})
    system = System(jnp.ones(1), lambda q, v, t, p: p["jerk"] * t + 0 * q)

    def call(jerk):
        return simulate(system, rk4(), ZERO, ZERO, {"jerk": jerk, "n": 0.0}, dt=0.1, num_steps=3, events=[turns])

    assert call(1.0).events.count == 0
    check_message(ValueError, "it is 0, with the rate 0 and the second derivative -1", lambda: call(-1.0))


@pytest.mark.slow
def test_a_switch_that_sees_the_state():
    """Where, how fast and when an oscillator passes zero, and where it is at a known time: noted in params, and told by
    what a last event makes of the velocity."""
    names = "place", "speed", "time", "level"
    system = System(jnp.ones(1), lambda q, v, t, p: -q)
    passage = Event(
        lambda q, v, t, p: q[0] + 10 * p["time"],
        switch=lambda q, v, t, p: p | {"place": 1 + q[0], "speed": v[0], "time": t},
    )
    log = Event(at=1.9, switch=lambda q, v, t, p: p | {"level": q[0]})
    tell = Event(
        at=2.0, reset=lambda q, v, t, p: jnp.stack([p["place"] + 10 * p["speed"] + 100 * p["time"] + p["level"]])
    )
    options = {"dt": 0.01, "num_steps": 200, "events": [passage, log, tell]}
    run = simulate(system, hhtjax.rowda(), ONE, ZERO, dict.fromkeys(names, 0.0), **options)
    run.check()
    np.testing.assert_allclose(run.events.after[2, 0], 1 - 10 + 50 * np.pi + np.cos(1.9), atol=1e-4)


# contact on the shaken table


def flights(strength, count=2, W=10.0, g=shaken_table.GRAVITY):
    """When the body leaves the table and lands on it again, from a closed form and the zero of a parabola."""
    A, t = strength * g / W**2, np.arcsin(1 / strength) / W

    def height(t, start):
        s = t - start
        return A * np.sin(W * start) + A * W * np.cos(W * start) * s - g / 2 * s**2 - A * np.sin(W * t)

    starts = t + 2 * np.pi / W * np.arange(count)
    return np.array([x for t in starts for x in (t, brentq(height, t + 0.2, t + 0.6, args=(t,), xtol=1e-15))])


SCENE = shaken_table.shaken_table()


def shaken(**steps):
    return simulate(SCENE.system, LIGHT, SCENE.q0, SCENE.v0, SCENE.params, events=SCENE.events, **steps)


@cache
def shaken_by(h):
    """The scene for 520 steps: one program."""
    return shaken(dt=h, num_steps=520)


@pytest.mark.slow
def test_contact_ends_and_begins_in_one_run():
    """Times of order 2, from one program; the height on the table; no slack; no multiplier in flight."""
    exact, A, errors = flights(2.0, 9), float(SCENE.params["A"]), []
    for h in (0.01, 0.0025):
        run = shaken_by(h)
        run.check()
        number = int(run.events.count)
        assert run.events.which[:number].tolist() == ([1, 0] * 9)[:number]
        errors.append(np.abs(run.events.t[:4] - exact[:4]))
        t = np.asarray(run.t)
        riding = np.searchsorted(exact[:number], t) % 2 == 0
        table, away = A * np.sin(10 * t), np.min(np.abs(t[:, None] - exact), axis=1) > h
        L = SCENE.params["m"] * (shaken_table.GRAVITY - 100 * table)
        assert np.abs(run.q[:, 0] - table)[riding & away].max() < 1e-14
        assert np.abs(run.multipliers[:, 0] - L)[riding & away].max() < 200 * h**2
        assert (run.multipliers[~riding & away] == 0).all()
        assert (np.asarray(run.q[:, 0]) > table - 1e-6).all()
        assert np.abs(run.q[:, 1]).max() == 0
    assert errors[0].max() < 1e-4
    assert errors[1].sum() < errors[0].sum() / 8


@pytest.mark.slow
def test_contact_under_error_control():
    run = shaken(dt=adaptive(1e-4, 1e-7), times=[0.3, 1.3])
    run.check()
    assert run.events.which[:5].tolist() == [1, 0, 1, 0, -1]
    assert np.abs(run.events.t[:4] - flights(2.0)).max() < 1e-5


@pytest.mark.slow
def test_contact_in_a_sweep():
    A = np.array([0.05, 0.1962, 0.25])
    axes = None, None, 0, {name: 0 if name == "A" else None for name in SCENE.params}
    runs = sweep(
        SCENE.system, LIGHT, SCENE.q0, np.stack([10 * A, 0 * A], axis=1), SCENE.params | {"A": A}, in_axes=axes,
        dts=np.full(3, 0.01), duration=1.3, num_samples=1, events=SCENE.events)  # fmt: skip
    runs.check()
    assert runs.events.count.tolist() == [0, 4, 5]
    np.testing.assert_allclose(runs.events.t[1, :4], shaken_by(0.01).events.t[:4], rtol=1e-12)


def lifted(h0, floor, rate, begin, T, A=0.0, riding=0.0, dt=0.05):
    """Dropped on a floor, where it rests; pulled off by a force that grows, or by a load at a known time. Or it rides
    on the floor from the start, which shakes by A sin(10 t)."""
    params = {"on": riding, "F": 0.0, "rate": rate, "begin": begin, "floor": floor, "T": T, "A": A}
    start = jnp.array([h0, 0.0]), jnp.array([riding * 10 * A, 0.0])
    return simulate(CRANE, LIGHT, *start, params, dt=dt, num_steps=40, events=[LAND, LIFT, PULL])


def over(q, t, p):
    return q[0] - p["floor"] - p["A"] * jnp.sin(10 * t)


CRANE = System(
    jnp.ones(2),
    lambda q, v, t, p: jnp.array([p["F"] - 10.0 + p["rate"] * jnp.maximum(t - p["begin"], 0), 0.0]),
    lambda q, t, p: (p["on"] * over(q, t, p) + (1 - p["on"]) * q[1])[None],
)
LAND = Event(
    lambda q, v, t, p: jnp.where(p["on"] == 1, 1.0, over(q, t, p)),
    reset=impact(0.0),
    switch=lambda p: p | {"on": 1.0 + 0 * p["on"]},
)
LIFT = Event(
    lambda q, v, t, p, multipliers: jnp.where(p["on"] == 1, multipliers[0], 1.0),
    switch=lambda p: p | {"on": 0 * p["on"]},
)
PULL = Event(at=lambda p: p["T"], switch=lambda p: p | {"F": 25.0 + 0 * p["F"]})
LIFTED = {  # h0, floor, rate, begin, T; landing, what happens next, and the height at 2 s
    "rests": ((0.2, 0.0, 0.0, 9.0, 9.0), 0.2, [], 0.0),
    "by a load": ((0.2, 0.0, 0.0, 9.0, 1.013), 0.2, [1.013, 1.013], 7.5 * 0.987**2),
    "by a load on the grid": ((1.2, 1.0, 0.0, 9.0, 0.7), 0.2, [0.7, 0.7], 1.0 + 7.5 * 1.3**2),
    "slowly": ((1.25, 1.05, 10.0, 0.517, 9.0), 0.2, [1.517], 1.05 + 10 / 6 * 0.483**3),
    "slowly, just before the grid": ((0.2, 0.0, 20.0, 0.5 - 2.393934453088344e-09, 9.0), 0.2, [1 - 2.39e-9], 20 / 6),
    "slowly, on the grid": ((0.2, 0.0, 20.0, 0.5, 9.0), 0.2, [1.0], 20 / 6),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", LIFTED)
def test_a_body_that_rests_is_pulled_off(case):
    """Slowly: the force that holds it, and with it its acceleration, is zero where it leaves."""
    arguments, landing, times, height = LIFTED[case]
    run = lifted(*arguments)
    run.check()
    assert run.events.which[: len(times) + 2].tolist() == [0, *([1] if len(times) == 1 else [2, 1])[: len(times)], -1]
    np.testing.assert_allclose(run.events.t[: len(times) + 1], [landing, *times], rtol=0, atol=1e-11)
    np.testing.assert_allclose(run.q[-1, 0], height, rtol=0, atol=5e-3 if len(times) == 1 else 1e-12)


def told(x, riding, dt):
    """The times of the first three events, and the height at the end."""
    run = lifted(*x, riding, dt)
    return jnp.concatenate([run.events.t[:3], run.q[-1, :1]])


LIFTS = np.array([[1.25, 1.05, 10.0, 0.517, 1.013, 0.0], [0.2, 0.0, 20.0, 0.53, 9.0, 0.0]])
RIDE = np.array([0.0, 0.0, 0.0, 9.0, 9.0, 0.2])
along = jax.jit(lambda x, dx, *how: jax.jvp(lambda x: told(x, *how), (x,), (dx,)))
back = jax.jit(lambda x, weights, *how: jax.vjp(lambda x: told(x, *how), x)[1](weights)[0])


def columns(x, *how):
    """All derivatives, forward, and those by differences."""
    central = [(along(x + d, d, *how)[0] - along(x - d, d, *how)[0]) / 2e-6 for d in 1e-6 * np.eye(6)]
    return np.stack([along(x, d, *how)[1] for d in np.eye(6)], axis=1), np.stack(central, axis=1)


@pytest.mark.slow
def test_the_derivatives_of_lifting():
    for x in LIFTS:
        forward, central = columns(x, 0.0, 0.05)
        assert abs(forward - central)[3, :5].max() < 1e-7  # with the amplitude second derivatives jump at 0
    exact = [0.0, 1.0, 0.0, 0.0, -15 * (2 - 1.013)]
    by_load = np.array([1.25, 1.05, 0.0, 9.0, 1.013, 0.0])
    np.testing.assert_allclose(columns(by_load, 0.0, 0.05)[0][3, :5], exact, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_the_derivatives_of_contact():
    """In the amplitude of the table: of the times, and of a height in flight, and the formula of the first time,
    sin(W t) = g/(A W^2), which is met to the first order of dt: the error of the time, of dt^2, changes with its place
    in a step."""
    for dt in (0.0225, 0.0025):  # the second ends in the first flight
        forward, central = columns(RIDE, 1.0, dt)
        known = np.isfinite(central[:, 5])
        assert known.sum() == (4 if dt > 0.01 else 2)
        assert abs(forward - central)[known, 5].max() < 1e-6
    np.testing.assert_allclose(forward[0, 5], -np.tan(10 * flights(2.0)[0]) / (10 * 0.2), rtol=4 * 0.0025)


@pytest.mark.slow
def test_the_derivatives_of_contact_in_reverse():
    def rows(x, *how):
        return np.stack([back(x, weights, *how) for weights in np.eye(4)])

    for x in LIFTS:
        forward, _ = columns(x, 0.0, 0.05)
        assert abs(forward - rows(x, 0.0, 0.05))[3].max() < 1e-13
    assert abs(columns(RIDE, 1.0, 0.0225)[0] - rows(RIDE, 1.0, 0.0225))[:, 5].max() < 1e-12


BEAD = System(
    jnp.ones(3),
    lambda q, v, t, p: jnp.array([0.0, -10.0, 0.0]),
    lambda q, t, p: (p["on"] * outside(q) + (1 - p["on"]) * q[2])[None],
)


def outside(q):
    """Of a circle of radius 1."""
    return (q[0] ** 2 + q[1] ** 2 - 1) / 2


@pytest.mark.slow
def test_a_bead_that_slides_off_a_ball_leaves_it_wherever_in_a_step():
    """At cos(angle) = 2/3 of that where it rested; a hair behind the start of a step, too, as with the third dt."""
    meets = Event(lambda q, v, t, p: jnp.where(p["on"] == 1, 1.0, outside(q)), impact(0.0), LAND.switch)
    q0 = np.array([np.sin(0.3), np.cos(0.3), 0.0])

    @jax.jit
    def run(dt):
        return simulate(BEAD, LIGHT, q0, np.zeros(3), {"on": 1.0}, dt=dt, num_steps=200, events=[meets, LIFT])

    height = 2 / 3 * np.cos(0.3)
    for dt in np.append([0.0035, 0.005, 0.006805084745762712], np.linspace(0.004, 0.01, 20)):  # one program
        found = run(dt)
        found.check()
        assert found.events.which[:2].tolist() == [1, -1]
        assert abs(found.events.q[0, 1] - height) < 2 * dt**2


# constraints that params switch off

BARE = System(
    lambda q, p: p["m"] * jnp.ones(1),
    lambda q, v, t, p: -p["m"] * p["g"] + 0 * q,
    lambda q, t, p: (p["on"] * shaken_table.over_table(q, t, p))[None],
)
OFF = r"A row that params switch off, on \* Phi, leaves its multiplier without an equation\. Let the row hold a coord"


def bare(stepper, params, q0=0.0, events=SCENE.events):
    return simulate(BARE, stepper, SCENE.q0[:1] + q0, SCENE.v0[:1], params, events=events, dt=0.01, num_steps=130)


@pytest.mark.slow
def test_a_constraint_that_params_switch_off_gets_a_word():
    """At the boundary, and where an event switches it off."""
    with pytest.raises(ValueError, match=rf"simulate: `constraint` rows \[0\] have no gradient in q .*{OFF}"):
        bare(LIGHT, SCENE.params | {"on": 0.0}, q0=1.0, events=None)
    off = Event(at=0.02, switch=shaken_table.leave)
    run = simulate(BARE, LIGHT, SCENE.q0[:1], SCENE.v0[:1], SCENE.params, dt=0.01, num_steps=5, events=[off])
    message = r"step 2 \(to t = 0.02\) failed: the constraint determines no acceleration after event 0\..*"
    with pytest.raises(SimulationError, match=message + OFF):
        run.check()


@pytest.mark.slow
def test_least_squares_take_it_as_it_is():
    run = bare(hht(linearize="predictor", redundant="least_squares"), SCENE.params)
    run.check()
    np.testing.assert_allclose(run.events.t[:4], shaken_by(0.01).events.t[:4], rtol=0, atol=1e-12)


def seen(of, *more):
    return [Event(lambda q, v, t, p, multipliers: of(multipliers), *more)]


def first(L):
    return L[0]


ERRORS = {
    "no constraint": (ValueError, "events[0]: the `guard` has an argument `multipliers`, but the system has no",
                      lambda: simulate(PULLED, rk4(), ONE, ONE, {"F": 1.0}, dt=0.1, num_steps=1, events=seen(first))),
    "index 3": (NotImplementedError, 'events[0]: the `guard` has an argument `multipliers`, and with formulation',
                lambda: bare(hht(formulation="index3"), SCENE.params, events=seen(first))),
    "an impact": (ValueError, "the `guard` of an impact must depend on q and t only, not on multipliers",
                  lambda: bare(LIGHT, SCENE.params, events=seen(first, impact(0.0)))),
    "shapes": (TypeError, "events[0]: `guard` must return a number; received shape (2,) float64",
               lambda: bare(LIGHT, SCENE.params, events=seen(lambda L: jnp.stack([L[0], L[0]])))),
    "tension": (ValueError, "the start is beyond the guard of events[0]: it is -4.905",
                lambda: bare(LIGHT, SCENE.params, events=seen(lambda L: -L[0], lambda q, v, t, p: v))),
}  # fmt: skip


@pytest.mark.parametrize("case", ERRORS)
def test_what_does_not_fit_is_an_error_at_the_boundary(case):
    check_message(*ERRORS[case])
