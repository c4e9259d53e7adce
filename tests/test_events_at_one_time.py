"""Events at one time: impacts that change each other or not, and guards that another event makes jump."""

import jax.numpy as jnp
import numpy as np
import pytest
from event_problems import G
from helpers import check_message

from hhtjax import Event, SimulationError, System, hht, impact, simulate

LIGHT = hht(linearize="predictor")  # half the program of "auto"
WALLS = [Event(lambda q, v, t, p, i=i: q[i], impact(0.5)) for i in range(2)]
OBLIQUE = Event(lambda q, v, t, p: q[0] + q[1], impact(0.5))


def into_the_corner(events):
    """From .35 with -1 m/s, to both walls at once, at a rounding from a grid point."""
    free = System(jnp.ones(2), lambda q, v, t, p: 0 * q)
    options = {"dt": 0.05, "num_steps": 20, "events": events}
    return simulate(free, LIGHT, jnp.full(2, 0.35), jnp.full(2, -1.0), **options)


@pytest.mark.slow
def test_impacts_at_one_time_that_do_not_change_each_other_both_act():
    """And one that is noted beside them sees the motion as it comes."""
    run = into_the_corner([*WALLS, Event(OBLIQUE.guard)])
    run.check()
    assert run.events.which[:4].tolist() == [2, 0, 1, -1]
    np.testing.assert_allclose(run.events.t[:3], 0.35, rtol=1e-12)
    np.testing.assert_allclose(run.events.after[:3], [[-1, -1], [0.5, -1], [0.5, 0.5]], rtol=1e-12)
    np.testing.assert_allclose(run.q[-1], 0.65 / 2, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("events", [[WALLS[0], OBLIQUE], [OBLIQUE, WALLS[0]]], ids=["oblique last", "oblique first"])
def test_a_corner_fails_by_name(events):
    run = into_the_corner(events)
    with pytest.raises(SimulationError, match=r"step \d .* failed: another event happens at the same time as event"):
        run.check()
    assert np.isnan(run.q[8:]).all()


@pytest.mark.slow
def test_a_guard_that_an_impact_throws_back_fails_by_name():
    """That of a rebound, though the ball is falling again at the end of the step."""
    ball = System(jnp.ones(1), lambda q, v, t, p: 0 * q - p["g"])
    floor, rebound = Event(lambda q, v, t, p: q[0], impact("e")), Event(lambda q, v, t, p: -v[0], terminal=True)
    params, events = {"g": G, "e": 0.8}, [floor, rebound]
    run = simulate(ball, LIGHT, jnp.ones(1), -jnp.ones(1), params, dt=0.9, num_steps=1, events=events)
    message = "step 1 (to t = 0.9) failed: another event made a guard negative at once"
    check_message(SimulationError, message, run.check)
