"""The scenes with events, and their motions by SciPy's DOP853, solved from one event to the next."""

from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from hhtjax.scenes import balls, bump_stop, double_pendulum, impact_oscillator, pendulum

TOLERANCES: dict = {"rtol": 2.3e-14, "atol": 1e-14, "max_step": 0.01}
SCENES = {
    "ball": balls.bouncing(),
    "bump stop": bump_stop.bump_stop(),
    "bump stop without damper": bump_stop.bump_stop(),
    "backlash": bump_stop.backlash(),
    "impact oscillator": impact_oscillator.driven(),
    "double pendulum": double_pendulum.stopped(),
    "pendulum": pendulum.walled(),
}


def motion_with_events(rate, guards, outcome, y0, times, mode=()):
    """y' = rate(t, y, mode); where one of guards(t, y, mode) falls through zero, y, mode = outcome(i, t, y, mode).

    Returns:
        y at the times, and the times of all events.
    """
    t, y, end = times[0], np.array(y0, float), times[-1]
    path, found, events = np.tile(y, (len(times), 1)), [], []
    for i in range(len(guards(t, y, mode))):
        event: Any = lambda t, y, mode, i=i: guards(t, y, mode)[i]  # noqa: E731
        event.terminal, event.direction = True, -1
        events.append(event)
    while t < end:
        leap: Any = solve_ivp(rate, (t, end), y, "DOP853", events=events, dense_output=True, args=(mode,), **TOLERANCES)
        here = (times >= t) & (times <= leap.t[-1])
        if here.any():
            path[here] = leap.sol(times[here]).T
        t, y = leap.t[-1], leap.y[:, -1]
        if leap.status == 1:
            found.append(t)
            (i,) = (i for i, x in enumerate(leap.t_events) if len(x))
            y, mode = outcome(i, t, y, mode)
    return path, found


def bounce(n, mobility, e, v):
    """Newton's law."""
    return v - (1 + e) * (n @ v) / (n @ mobility @ n) * (mobility @ n)


def of_ball(p):
    def rate(t, y, on):
        return [y[1], -p["g"] - p["c"] * abs(y[1]) * y[1]]

    return rate, lambda t, y, on: [y[0] - p["floor"]], lambda i, t, y, on: (np.array([p["floor"], -p["e"] * y[1]]), on)


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

    return rate, lambda t, y, on: [p["wall"] - y[0]], lambda i, t, y, on: (np.array([p["wall"], -p["e"] * y[1]]), on)


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
    "bump stop without damper": (of_stops, [0.0, 3.0]),
    "backlash": (of_stops, [0.0, 0.0]),
    "impact oscillator": (of_oscillator, [-0.5, 0.0]),
    "double pendulum": (of_double_pendulum, [0.0] * 4),
    "pendulum": (of_pendulum, [0.0, 2.505 / 0.5]),
}


def reference(name, times, **changed):
    """q and v at the times, and the times of events. changed: numbers in params."""
    scene, (build, y0) = SCENES[name], SOLVED[name]
    p = {key: np.asarray(x).tolist() for key, x in (scene.params | changed).items()}
    rate, guards, outcome = build(p)
    path, found = motion_with_events(rate, guards, outcome, y0, times, (0.0, 0.0))
    n = len(y0) // 2
    q, v = path[:, :n], path[:, n:]
    if name == "pendulum":
        q, rate = q[:, 0], v[:, :1]
        v = p["l"] * np.stack([np.cos(q), np.sin(q)], axis=1) * rate
        q = p["l"] * np.stack([np.sin(q), -np.cos(q)], axis=1)
    return q, v, found
