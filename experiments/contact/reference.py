"""The motions of the ball, the table, the hopper and the disc by SciPy's DOP853, solved from one switch to the next.

Independent of hhtjax: modes are written out for each scene.
"""

from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from experiments.contact.scenes import GRAVITY

TOLERANCES: Any = {"rtol": 2.3e-14, "atol": 1e-14, "max_step": 0.02}
TINY = 1e-9  # s: the flight of the ball that does not begin


def pieces(y, mode, T, times, piece):
    """y at the times. piece(mode) -> rate(t, y), [(guard(t, y), direction)], change(i, t, y) -> y, mode."""
    t, path = 0.0, np.tile(np.asarray(y, float), (len(times), 1))
    while t < T:
        rate, guards, change = piece(mode)
        events = []
        for guard, direction in guards:
            events.append(lambda t, y, guard=guard: guard(t, y))
            events[-1].terminal, events[-1].direction = True, direction
        leap = solve_ivp(rate, (t, T), y, "DOP853", events=events, dense_output=True, **TOLERANCES)
        here = (times >= t) & (times <= leap.t[-1])
        if here.any():
            path[here] = leap.sol(times[here]).T
        t, y = leap.t[-1], leap.y[:, -1]
        if leap.status != 1:
            break
        first = next(i for i, x in enumerate(leap.t_events) if len(x))
        y, mode = change(first, t, y)
    return path


def ball(scene, times, **changed):
    """(x, y, vx, vy). Each flight is a formula but for its end; friction acts by the impulses, and then at rest."""
    p = {k: float(x) for k, x in (scene.params | changed).items()}
    c, e, mu = p["c"], p["e"], p["mu"]

    def flight(t, y):
        return [y[2], y[3], -c * y[2], -GRAVITY - c * y[3]]

    def rubbing(t, y):
        return [y[2], 0.0, -mu * GRAVITY * np.sign(y[2]) - c * y[2], 0.0]

    def hit(i, t, y):
        up, lost = -e * y[3], mu * (1 + e) * -y[3]
        v = np.sign(y[2]) * max(abs(y[2]) - lost, 0.0)
        rests = 2 * up / GRAVITY < TINY
        new = np.array([y[0], 0.0, v, 0.0 if rests else up])
        return new, ("rubs" if rests else "flies")

    def piece(mode):
        if mode == "flies":
            return flight, [(lambda t, y: y[1], -1)], hit
        if mode == "rubs":
            return rubbing, [(lambda t, y: y[2], 0)], lambda i, t, y: (np.array([y[0], 0, 0, 0]), "rests")
        return (lambda t, y: np.zeros(4)), [], None

    return pieces([0.0, 1.0, 2.0, 0.0], "flies", scene.T, times, piece)


def table(scene, times, amplitude=0.05, frequency=12.0, **changed):
    """(x, vx)."""
    mu, m, speed = float((scene.params | changed)["mu"]), 1.3, amplitude * frequency

    def load(t, x, v):
        return -2.0 * x - 0.3 * v

    def normal(t):
        return m * GRAVITY - 3 * np.sin(3 * t)

    def under(t):
        return speed * np.cos(frequency * t)

    def needed(t, y):  # friction that holds it
        return -m * speed * frequency * np.sin(frequency * t) - load(t, y[0], under(t))

    def piece(sig):
        if sig == 0:
            guards = [(lambda t, y, s=s: mu * normal(t) - s * needed(t, y), -1) for s in (1, -1)]
            return (
                (lambda t, y: [under(t), -speed * frequency * np.sin(frequency * t)]),
                guards,
                lambda i, t, y: (np.array([y[0], under(t)]), (-1, 1)[i]),
            )

        def stop(i, t, y):
            y = np.array([y[0], under(t)])
            push = needed(t, y)
            return y, (0 if abs(push) <= mu * normal(t) else -np.sign(push))

        rate = lambda t, y: [y[1], (load(t, y[0], y[1]) - sig * mu * normal(t)) / m]  # noqa: E731
        return rate, [(lambda t, y: y[1] - under(t), -sig)], stop

    return pieces([0.0, speed], 0, scene.T, times, piece)


def hopper(scene, times, **changed):
    """(q1, q2, v1, v2)."""
    p = {k: float(x) for k, x in (scene.params | changed).items()}
    m1, m2 = (float(x) for x in scene.mass)

    def push(t, y):
        return p["k"] * (1 - y[0] + y[1]) - 1.5 * (y[2] - y[3]) + p["A"] * np.sin(9.0 * t)

    def down(t, y):
        return [y[2], 0.0, push(t, y) / m1 - GRAVITY, 0.0]

    def up(t, y):
        return [y[2], y[3], push(t, y) / m1 - GRAVITY, -push(t, y) / m2 - GRAVITY]

    def piece(mode):
        if mode == "down":
            guard = lambda t, y: push(t, y) + GRAVITY * m2  # noqa: E731
            return down, [(guard, -1)], lambda i, t, y: (y, "up")
        return up, [(lambda t, y: y[1], -1)], lambda i, t, y: (np.array([y[0], 0.0, y[2], 0.0]), "down")

    return pieces([1 - GRAVITY / p["k"], 0.0, 0.0, 0.0], "down", scene.T, times, piece)


def motion(name, scene, times, **changed):
    """q and v at the times, of a run's columns; None for scenes that are not here."""
    if name == "ball":
        y = ball(scene, times, **changed)
        return y[:, :2], y[:, 2:]
    if name == "table":
        y, zero = table(scene, times, **changed), np.zeros(len(times))
        return np.stack([y[:, 0], zero], 1), np.stack([y[:, 1], zero], 1)
    if name == "hopper":
        y = hopper(scene, times, **changed)
        return y[:, :2], y[:, 2:]
    return None
