"""Events inside a step: order, exact derivatives, failures by name, and the same in sweeps."""

import event_problems
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from event_problems import G
from zoo import each

from hhtjax import Event, System, hht, impact, rowda, simulate, sweep

BALL = System(jnp.ones(1), lambda q, v, t, p: 0 * q - p["g"])
FLOOR = Event(lambda q, v, t, p: q[0] - p["floor"], impact("e"))


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


@pytest.mark.parametrize("case", each(CASES, quick=(), rest=("ball, hht", "double pendulum, hht", "bump stop, rowda")))
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

    def by_sweep(x):
        q0, v0, g, e, floor = x
        dts = 1.0 / np.array([2, 6, 30, 100])
        params = {"g": g, "e": e, "floor": floor}
        runs = sweep(BALL, hht(), q0[None], v0[None], params, dts=dts, duration=1.0, num_samples=1, events=[FLOOR])
        return jnp.stack([runs.q[:, -1, 0], runs.v[:, -1, 0], runs.events.t[:, 0]], axis=1)

    def by_run(x):
        q0, v0, g, e, floor = x
        params = {"g": g, "e": e, "floor": floor}
        run = simulate(BALL, hht(), q0[None], v0[None], params, dt=1 / 7, num_steps=7, events=[FLOOR])
        return jnp.stack([run.q[-1, 0], run.v[-1, 0], run.events.t[0]])

    exact = jax.jacfwd(bounced)(x)
    values, forward = jax.jvp(jax.vmap(by_sweep, out_axes=2), (jnp.tile(x, (5, 1)),), (jnp.eye(5),))
    assert abs(values - bounced(x)[None, :, None]).max() < 1e-13
    assert abs(forward - exact[None]).max() < 1e-12
    assert abs(jax.jacrev(by_run)(x) - exact).max() < 1e-12


@pytest.mark.slow
def test_an_impact_on_a_grid_point():
    """Free flight from .5 with -1 m/s: the wall is met at half a second, the end of a step, or a rounding behind it."""

    def end(x):
        params = {"g": 0.0, "e": x[3], "floor": x[2]}
        run = simulate(BALL, hht(), x[:1], x[1:2], params, dt=0.1, num_steps=10, events=[FLOOR])
        return jnp.stack([run.q[-1, 0], run.v[-1, 0]])

    x = jnp.array([0.5, -1.0, 0.0, 1.0])
    exact = np.array([[-1.0, -1.0, 2.0, 0.5], [0.0, -1.0, 0.0, 1.0]])
    assert abs(jax.jacfwd(end)(x) - exact).max() < 1e-12
    assert abs(jax.jacrev(end)(x) - exact).max() < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize(("num_steps", "derivative"), [(7, jax.jacfwd), (10, jax.jacrev)])
def test_two_balls_exchange_their_velocities(num_steps, derivative):
    """The case in which physics engines gave .75, .25, .91, .08; with 10 steps the impact is on a grid point."""
    balls = System(jnp.ones(2), lambda q, v, t, p: 0 * q)
    contact = Event(lambda q, v, t, p: q[1] - q[0] - 0.1, impact(1.0))

    def end(x):
        run = simulate(balls, hht(), x[:2], x[2:], dt=1 / num_steps, num_steps=num_steps, events=[contact])
        return run.q[-1, 1]

    found = derivative(end)(jnp.array([0.0, 0.6, 1.0, 0.0]))
    assert abs(found - np.array([1.0, 0.0, 1.0, 0.0])).max() < 1e-12


@pytest.mark.slow
def test_gradients_agree_with_each_other_and_with_differences():
    problem = event_problems.dragged_ball()

    @jax.jit
    def end(x):
        params = {"c": x[2], "e": x[3], "floor": x[4]}
        run = simulate(
            problem.system, hht(-0.3), x[:1], x[1:2], params, dt=1.5 / 30, num_steps=30, save_every=30,
            events=problem.events)  # fmt: skip
        return jnp.sin(run.q[-1, 0]) + run.events.after[1, 0]

    x = jnp.array([1.0, 0.0, 0.3, 0.8, 0.0])
    forward, reverse = jax.jacfwd(end)(x), jax.grad(end)(x)
    step = 1e-6
    central = [(end(x.at[i].add(step)) - end(x.at[i].add(-step))) / (2 * step) for i in range(x.size)]
    assert abs(forward - reverse).max() < 1e-13
    assert abs(forward - jnp.stack(central)).max() < 1e-7


@pytest.mark.slow
def test_a_terminal_event_ends_the_run():
    """A ball thrown up at v0 lands after 2 v0/g."""
    landing = Event(lambda q, v, t, p: q[0], terminal=True)

    def fly(v0):
        run = simulate(BALL, hht(), jnp.zeros(1), v0[None], {"g": G}, dt=0.1, num_steps=25, events=[landing])
        return run.events.t[0], run

    (t, run), rate = jax.value_and_grad(fly, has_aux=True)(jnp.array(10.0))
    run.check()
    assert abs(t - 20 / G) < 1e-13
    assert abs(rate - 2 / G) < 1e-12
    assert run.t[-1] == t
    assert abs(run.q[-1, 0]) < 1e-13
    assert abs(run.v[-1, 0] + 10) < 1e-12
    assert run.events.count == 1
