"""Scenes with events: against formulas and SciPy, of the order of the stepper, and their derivatives."""

import numpy as np
import pytest

import hhtjax
from experiments.events.reference import SCENES, reference
from hhtjax.scenes import balls, pendulum

EVENTS = {  # in the whole time, and in its first half
    "ball": (2, 1), "bump stop": (6, 4), "backlash": (11, 4), "impact oscillator": (8, 4), "double pendulum": (3, 2),
    "pendulum": (1, 1),
}  # fmt: skip
LIGHT = hhtjax.hht(linearize="predictor")  # half the program of "auto"
STEPS = dict.fromkeys(EVENTS, 400) | {"ball": 256, "pendulum": 200}


def run(scene, stepper, steps, part=1.0):
    """A part of the scene's duration."""
    dt = part * scene.duration / steps
    found = hhtjax.simulate(
        scene.system, stepper, scene.q0, scene.v0, scene.params, dt=dt, num_steps=steps, events=scene.events
    )
    found.check()
    return found


def errors(found, q, v, events):
    """Of q and v at the times of a run, those next to an event left out, where v jumps."""
    t = np.asarray(found.t)
    h = t[1] - t[0]
    away = np.min(np.abs(t[:, None] - np.array(events)), axis=1) > h
    return np.array([np.max(np.abs(np.asarray(x) - y)[away]) for x, y in ((found.q, q), (found.v, v))])


@pytest.mark.parametrize("name", [pytest.param(x, marks=[pytest.mark.slow] * (x != "ball")) for x in EVENTS])
def test_the_motion_of_a_scene(name):
    """Order 2 through all events, from one program: steps of h and h/2 over the first half of the time."""
    steps = STEPS[name]
    q, v, events = reference(name, np.linspace(0, SCENES[name].duration / 2, steps + 1))
    coarse, fine = (run(SCENES[name], LIGHT, steps, part) for part in (1.0, 0.5))
    assert (int(coarse.events.count), int(fine.events.count)) == EVENTS[name]
    assert len(events) == EVENTS[name][1]
    half = slice(None, steps // 2 + 1)
    at_both = coarse._replace(t=coarse.t[half], q=coarse.q[half], v=coarse.v[half])
    found = np.stack([errors(x, q[::k], v[::k], events) for x, k in ((at_both, 2), (fine, 1))])
    orders = np.log2(found[0] / found[1])
    assert np.all(np.abs(orders - 2) < 0.15), orders


def test_a_ball_without_drag_keeps_to_its_formula():
    """The program of the one with drag."""
    scene = balls.bouncing(0.8, drag=0.0)
    found = run(scene, LIGHT, STEPS["ball"])
    period = np.sqrt(8 * scene.q0[0] / balls.GRAVITY)
    np.testing.assert_allclose(found.events.t[:2], period * np.array([0.5, 0.5 + 0.8]), rtol=1e-14)
    speed = np.sqrt(2 * balls.GRAVITY * scene.q0[0])
    np.testing.assert_allclose(found.events.before[:2, 0], [-speed, -0.8 * speed], rtol=1e-13)


@pytest.mark.slow
def test_two_balls_change_their_velocities():
    scene = balls.two()
    found = run(scene, LIGHT, 7)
    np.testing.assert_allclose(found.events.t[0], 0.4, rtol=1e-14)
    np.testing.assert_allclose(found.v[-1], [0.0, 1.0], atol=1e-14)
    np.testing.assert_allclose(found.q[-1], [0.4, 1.1], rtol=1e-14)


def test_a_wall_has_to_be_within_reach():
    with pytest.raises(ValueError, match=r"walled: `wall` must be positive and less than the rod's 0.5; received 0.6"):
        pendulum.walled(wall=0.6)
