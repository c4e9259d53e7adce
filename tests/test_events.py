"""Events inside a step: order, exact derivatives, failures by name, and the same in sweeps."""

import event_problems
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from zoo import each

from hhtjax import Event, System, hht, impact, rowda, simulate, sweep

NAMES = "q0", "q1", "v0", "v1", "g", "c", "e", "gap", "r", "ground"  # what the run of two balls depends on
BALLS = System(jnp.ones(2), lambda q, v, t, p: -p["g"] - p["c"] * v)
CONTACT = Event(
    lambda q, v, t, p: q[1] - p["r"] * q[0] - p["gap"], impact("e")
)  # of both, or of the second and a floor
LANDING = Event(lambda q, v, t, p: q[1] - p["ground"], terminal=True)
STEPPER, STEPS = hht(-0.3, linearize="predictor"), 30  # half the program of "auto"


def end(x, dt):
    """q and v at the end, when the first event was, and v behind the second; and the run."""
    params = dict(zip(NAMES[4:], x[4:], strict=True))
    run = simulate(BALLS, STEPPER, x[:2], x[2:4], params, dt=dt, num_steps=STEPS, events=[CONTACT, LANDING])
    return jnp.concatenate([run.q[-1], run.v[-1], run.events.t[:1], run.events.after[1, 1:]]), run


@jax.jit
def forward(x, dt, along):
    return jax.jvp(lambda x: end(x, dt), (x,), (along,), has_aux=True)


@jax.jit
def reverse(x, dt, weights):
    return jax.vjp(lambda x: end(x, dt), x, has_aux=True)[1](weights)[0]


def at(**values):
    """Without a force, and with an event only where it is given."""
    return np.array([({"gap": -1e3, "ground": -1e3, "e": 1.0} | values).get(name, 0.0) for name in NAMES])


def jacobians(x, dt, rows, names):
    """Of these entries of the end, by one direction after the other: forward, and in reverse."""
    rows, columns = list(rows), [NAMES.index(name) for name in names]
    by_column = np.stack([forward(x, dt, e)[1] for e in np.eye(len(NAMES))[columns]], axis=1)
    by_row = np.stack([reverse(x, dt, e) for e in np.eye(6)[rows]])
    return by_column[rows], by_row[:, columns]


def errors(problem, stepper, numbers):
    """Of q and v at the end, for these numbers of steps, in one program."""
    duration = problem.duration
    runs = sweep(
        problem.system, stepper, problem.q0, problem.v0, problem.params,
        dts=duration / np.array(numbers), duration=duration, num_samples=1, events=problem.events or None,
    )  # fmt: skip
    runs.check()
    ends = np.concatenate([runs.q[:, -1], runs.v[:, -1]], axis=1)
    return np.max(np.abs(ends - problem.end), axis=1)


def slope(error, numbers):
    return -np.polyfit(np.log(numbers), np.log(error), 1)[0]


NUMBERS = 83, 120, 177, 251, 367, 523, 823
CASES = {
    "ball, hht": (event_problems.dragged_ball, hht(-0.3), 2),
    "ball, rowda": (event_problems.dragged_ball, rowda(), 3),
    "double pendulum, hht": (event_problems.stopped_double_pendulum, hht(-0.05), 2),
    "double pendulum, rowda": (event_problems.stopped_double_pendulum, rowda(), 3),
    "pendulum at a wall, hht": (event_problems.walled_pendulum, hht(-0.1), 2),
    "bump stop, hht": (event_problems.bump_stop, hht(-0.05), 2),
    "bump stop, rowda": (event_problems.bump_stop, rowda(), 3),
}
REST = [case for case in CASES if case not in ("ball, rowda", "bump stop, hht")]  # see tests/test_impact_scenes.py


@pytest.mark.parametrize("case", each(CASES, quick=(), rest=REST))
def test_events_keep_the_order(case):
    make, stepper, order = CASES[case]
    found = slope(errors(make(), stepper, NUMBERS), NUMBERS)
    assert found > order - (0.15 if order == 2 else 0.2), found


@pytest.mark.slow
def test_a_force_that_jumps_without_a_mode_loses_it():
    assert slope(errors(event_problems.bump_stop(located=False), hht(-0.05), NUMBERS), NUMBERS) < 1.7


def bounced(x):
    """Where and how fast a ball is after a second, with one bounce, and when that was: by formulas."""
    q0, v0, g, e, floor = x
    fall = (v0 + jnp.sqrt(v0**2 + 2 * g * (q0 - floor))) / g
    up, rest = e * (g * fall - v0), 1.0 - fall
    return jnp.stack([floor + up * rest - g * rest**2 / 2, up - g * rest, fall])


@pytest.mark.slow
def test_derivatives_of_an_impact_are_those_of_the_formula_at_any_dt():
    x = jnp.array([1.0, 0.3, 9.81, 0.9, 0.1])
    ball = System(jnp.ones(1), lambda q, v, t, p: 0 * q - p["g"])
    floor = Event(lambda q, v, t, p: q[0] - p["floor"], impact("e"))

    def by_sweep(x):
        dts = 1.0 / np.array([2, 6, 30, 100])
        params = {"g": x[2], "e": x[3], "floor": x[4]}
        runs = sweep(ball, STEPPER, x[:1], x[1:2], params, dts=dts, duration=1.0, num_samples=1, events=[floor])
        return jnp.stack([runs.q[:, -1, 0], runs.v[:, -1, 0], runs.events.t[:, 0]], axis=1)

    exact = jax.jacfwd(bounced)(x)
    along = jax.jit(lambda dx: jax.jvp(by_sweep, (x,), (dx,)))
    for i, e in enumerate(np.eye(5)):
        values, rates = map(np.asarray, along(e))
        assert abs(values - np.asarray(bounced(x))).max() < 1e-13
        assert abs(rates - np.asarray(exact[:, i])).max() < 1e-12
    names = "q1", "v1", "g", "e", "gap"
    for found in jacobians(at(**dict(zip(names, x, strict=True))), 1 / STEPS, (1, 3, 4), names):
        assert abs(found - exact).max() < 1e-12


@pytest.mark.slow
def test_an_impact_on_a_grid_point():
    """Free flight from .5 with -1 m/s: the wall is met at half a second, the end of a step, or a rounding behind it."""
    exact = np.array([[-1.0, -1.5, 2.0, 1.0], [0.0, -1.0, 0.0, 1.0]])
    for found in jacobians(at(q1=0.5, v1=-1.0, gap=0.0, e=1.0), 0.05, (1, 3), ("q1", "v1", "gap", "e")):
        assert abs(found - exact).max() < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("dt", [1 / 21, 1 / 30])
def test_two_balls_exchange_their_velocities(dt):
    """The case in which physics engines gave .75, .25, .91, .08 after a second; once the impact is on a grid point."""
    x = at(q1=0.6, v0=1.0, r=1.0, gap=0.1)
    for found in jacobians(x, dt, (1,), ("q0", "q1", "v0", "v1")):
        assert abs(found - np.array([1.0, 0.0, STEPS * dt, 0.0])).max() < 1e-12


@pytest.mark.slow
def test_gradients_agree_with_each_other_and_with_differences():
    """With drag, through two impacts."""
    names, dt = ("q1", "v1", "c", "e", "gap"), 0.05
    x, step = at(q1=1.0, g=9.81, c=0.3, e=0.8, gap=0.0), 1e-6
    directions = np.eye(len(NAMES))[[NAMES.index(name) for name in names]]
    by_column, by_row = jacobians(x, dt, (1, 3, 5), names)
    central = [(forward(x + d, dt, d)[0] - forward(x - d, dt, d)[0]) / (2 * step) for d in step * directions]
    assert abs(by_column - by_row).max() < 1e-13
    assert abs(by_column - np.stack(central, axis=1)[[1, 3, 5]]).max() < 1e-7


@pytest.mark.slow
def test_a_terminal_event_ends_the_run():
    """A ball thrown up at v0 lands after 2 v0/g."""
    x, g = at(v1=10.0, g=event_problems.G, ground=0.0), event_problems.G
    (_, rates, run), back = forward(x, 0.1, np.eye(len(NAMES))[3]), reverse(x, 0.1, np.eye(6)[4])
    run.check()
    assert abs(run.events.t[0] - 20 / g) < 1e-13
    assert abs(np.array([rates[4], back[3]]) - 2 / g).max() < 1e-12
    assert run.t[-1] == run.events.t[0]
    assert abs(run.q[-1, 1]) < 1e-13
    assert abs(run.v[-1, 1] + 10) < 1e-12
    assert run.events.count == 1
