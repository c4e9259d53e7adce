"""Whole runs of the zoo: with the machinery and on plain JAX, with forward derivatives and vmap; and step by step."""

from functools import partial

import event_problems
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import whole_runs
import zoo
from program_writer import usual_promotion

import hhtjax
from hhtjax.primitives import compat

pytestmark = [pytest.mark.slow, pytest.mark.skipif(not compat.is_on(), reason="plain arrays with this version of JAX")]
STEPS = 8


def step_by_step(problem, stepper, q0):
    """Positions, by the two functions of a stepper."""
    dt = problem.duration / 100
    state = stepper.init(problem.system, q0, problem.v0, problem.params, dt)

    def advance(state, _):
        state, _ = stepper.step(problem.system, state, params=problem.params, dt=dt)
        return state, state.q

    return jnp.concatenate([q0[None], jax.lax.scan(advance, state, None, length=STEPS)[1]])


def simulated(problem, stepper, q0):
    dt = problem.duration / 100
    system, params = problem.system, problem.params
    return hhtjax.simulate(system, stepper, q0, problem.v0, params, dt=dt, num_steps=STEPS).q


@partial(jax.jit, static_argnums=(0, 1))
def everything(way, name, stepper):
    """Positions, and their derivatives in q0, of a batch of two; step by step, positions of the first alone.

    Steppers of one family are compiled once.
    """
    problem = (zoo.PROBLEMS | zoo.DRY)[name]
    if way is step_by_step:
        return way(problem, stepper, problem.q0)
    q0 = jnp.stack([problem.q0, 0.7 * problem.q0])
    return jax.vmap(lambda q0: jax.jvp(partial(way, problem, stepper), (q0,), (jnp.cos(q0),)))(q0)


COUPLED = "hht auto", "hht converged"  # the others go through the same solves
SMOOTH = [
    pytest.param(stepper, name, marks=zoo.EVERY if name == "forced double pendulum" and stepper not in COUPLED else ())
    for name in ("forced Duffing", "forced double pendulum")
    for stepper in zoo.STEPPERS
]
RUBBING = [("hht predictor", name) for name in zoo.DRY]


@pytest.mark.parametrize(("stepper", "name"), [*SMOOTH, *RUBBING])
def test_same_three_ways(name, stepper):
    stepper = zoo.as_data(zoo.STEPPERS[stepper])
    fast = everything(simulated, name, stepper)
    with hhtjax.plain():
        plain = everything(simulated, name, stepper)
    by_steps = everything(step_by_step, name, stepper)
    for x, y in zip(fast, plain, strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(by_steps, plain[0][0], rtol=1e-10, atol=1e-12)


EVENTS = {
    "impact": (event_problems.dragged_ball, hhtjax.hht(-0.3, linearize="predictor")),
    "switch": (event_problems.bump_stop, hhtjax.rk4()),
}


@pytest.mark.parametrize("name", EVENTS)
def test_events_the_same_on_plain_jax(name):
    """Values and forward derivatives of a batch, of which one member meets its events elsewhere."""
    make, stepper = EVENTS[name]
    problem = make()

    def run(q0):
        found = hhtjax.simulate(
            problem.system, stepper, q0, problem.v0, problem.params, dt=0.05, num_steps=24, events=problem.events,
            max_events=1, keep_events=2,
        )  # fmt: skip
        return found.q, found.v, found.events.t[:2], found.events.count

    def everything(q0):
        return jax.vmap(lambda q0: jax.jvp(run, (q0,), (jnp.cos(q0),)))(q0)

    q0 = jnp.stack([problem.q0, problem.q0 - 0.1])
    fast = jax.jit(everything)(q0)
    with hhtjax.plain():
        plain = jax.jit(everything)(q0)
    assert np.all(np.asarray(fast[0][-1]) > 0)
    for x, y in zip(jax.tree.leaves(fast), jax.tree.leaves(plain), strict=True):
        if x.dtype != jax.dtypes.float0:
            np.testing.assert_allclose(x, y, rtol=1e-10, atol=1e-12)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("seed", "mode"), [(1, "both"), (2, "both"), (5, "both"), (830017, "vmap")])
def test_random_systems(seed, mode):
    """programs.py --whole-runs makes more of them. The last was wrong by 2e-5 while a call returned its parameter."""
    with usual_promotion():
        _, *run = whole_runs.random_run(seed)
        assert not list(whole_runs.compare(*run, modes=(mode,)))
