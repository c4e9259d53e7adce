"""Scenes with events: against formulas and SciPy, of the order of the stepper, and their derivatives."""

import numpy as np
import pytest
from event_reference import motion_with_events

import hhtjax
from hhtjax.scenes import balls, bump_stop, double_pendulum, impact_oscillator, pendulum

SCENES = {
    "ball": balls.bouncing(),
    "bump stop": bump_stop.bump_stop(),
    "backlash": bump_stop.backlash(),
    "impact oscillator": impact_oscillator.driven(),
    "double pendulum": double_pendulum.stopped(),
    "pendulum": pendulum.walled(),
}
EVENTS = {  # in the whole time, and in its first half
    "ball": (2, 1), "bump stop": (6, 4), "backlash": (11, 5), "impact oscillator": (8, 4), "double pendulum": (3, 2),
    "pendulum": (1, 1),
}  # fmt: skip
STEPS = dict.fromkeys(SCENES, 400) | {"ball": 256, "pendulum": 200}


def bounce(n, mobility, e, v):
    """Newton's law."""
    return v - (1 + e) * (n @ v) / (n @ mobility @ n) * (mobility @ n)


def of_ball(p):
    def rate(t, y, on):
        return [y[1], -p["g"] - p["c"] * abs(y[1]) * y[1]]

    return rate, lambda t, y, on: [y[0]], lambda i, t, y, on: (np.array([0, -p["e"] * y[1]]), on)


def of_stops(p):
    def rate(t, y, on):
        pushes = [p["K"] * (y[0] - side * p["gap"]) + p["C"] * y[1] for side in (1, -1)]
        return [y[1], p["A"] * np.cos(p["W"] * t) - p["k"] * y[0] - on[0] * pushes[0] - on[1] * pushes[1]]

    def guards(t, y, on):
        both = [(p["gap"] - y[0]) * (1 - 2 * on[0]), (p["gap"] + y[0]) * (1 - 2 * on[1])]
        return both if "lower" in p else both[:1]

    return rate, guards, lambda i, t, y, on: (y, tuple(1 - x if i == j else x for j, x in enumerate(on)))


def of_oscillator(p):
    def rate(t, y, on):
        return [y[1], p["A"] * np.cos(p["W"] * t) - p["k"] * y[0] - p["c"] * y[1]]

    return rate, lambda t, y, on: [-y[0]], lambda i, t, y, on: (np.array([0, -p["e"] * y[1]]), on)


def of_double_pendulum(p):
    def mass(y):
        c = 1.5 * np.cos(y[0] - y[1])
        return np.array([[2, c], [c, 2.25]])

    def rate(t, y, on):
        s = 1.5 * np.sin(y[0] - y[1])
        weight = -p["g"] * np.cos(y[:2]) * np.array([2.0, 1.5])
        return np.append(y[2:], np.linalg.solve(mass(y), weight + s * np.array([-(y[3] ** 2), y[2] ** 2])))

    def outcome(i, t, y, on):
        n = np.array([1.0, -1.0])
        return np.append(y[:2], bounce(n, np.linalg.inv(mass(y)), p["e"], y[2:])), on

    return rate, lambda t, y, on: [p["stop"] - y[1] + y[0]], outcome


def of_pendulum(p):
    """In its angle, where the impulse along x turns the velocity back by -e."""

    def rate(t, y, on):
        return [y[1], -p["g"] / p["l"] * np.sin(y[0])]

    wall = np.arcsin(p["wall"] / p["l"])
    return rate, lambda t, y, on: [wall - y[0]], lambda i, t, y, on: (np.array([y[0], -p["e"] * y[1]]), on)


SOLVED = {
    "ball": (of_ball, [1.0, 0.0]),
    "bump stop": (of_stops, [0.0, 3.0]),
    "backlash": (of_stops, [0.0, 0.0]),
    "impact oscillator": (of_oscillator, [-0.5, 0.0]),
    "double pendulum": (of_double_pendulum, [0.0] * 4),
    "pendulum": (of_pendulum, [0.0, 2.505 / 0.5]),
}


def reference(name, times):
    """q and v at the times, and the times of events."""
    scene, (build, y0) = SCENES[name], SOLVED[name]
    p = {key: np.asarray(x).tolist() for key, x in scene.params.items()}
    rate, guards, outcome = build(p)
    path, found = motion_with_events(rate, guards, outcome, y0, times, (0.0, 0.0))
    n = len(y0) // 2
    q, v = path[:, :n], path[:, n:]
    if name == "pendulum":
        q, rate = q[:, 0], v[:, :1]
        v = p["l"] * np.stack([np.cos(q), np.sin(q)], axis=1) * rate
        q = p["l"] * np.stack([np.sin(q), -np.cos(q)], axis=1)
    return q, v, found


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


@pytest.mark.parametrize("name", SCENES)
def test_the_motion_of_a_scene(name):
    """Order 2 through all events, from one program: steps of h and h/2 over the first half of the time."""
    steps = STEPS[name]
    q, v, events = reference(name, np.linspace(0, SCENES[name].duration / 2, steps + 1))
    coarse, fine = (run(SCENES[name], hhtjax.hht(), steps, part) for part in (1.0, 0.5))
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
    found = run(scene, hhtjax.hht(), STEPS["ball"])
    period = np.sqrt(8 * scene.q0[0] / balls.GRAVITY)
    np.testing.assert_allclose(found.events.t[:2], period * np.array([0.5, 0.5 + 0.8]), rtol=1e-14)
    speed = np.sqrt(2 * balls.GRAVITY * scene.q0[0])
    np.testing.assert_allclose(found.events.before[:2, 0], [-speed, -0.8 * speed], rtol=1e-13)


def test_two_balls_change_their_velocities():
    scene = balls.two()
    found = run(scene, hhtjax.hht(), 7)
    np.testing.assert_allclose(found.events.t[0], 0.4, rtol=1e-14)
    np.testing.assert_allclose(found.v[-1], [0.0, 1.0], atol=1e-14)
    np.testing.assert_allclose(found.q[-1], [0.4, 1.1], rtol=1e-14)


def test_a_wall_has_to_be_within_reach():
    with pytest.raises(ValueError, match=r"walled: `wall` must be positive and less than the rod's 0.5; received 0.6"):
        pendulum.walled(wall=0.6)
