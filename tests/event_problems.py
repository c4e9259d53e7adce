"""Motions with events, and the same by SciPy or by formulas."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

from hhtjax import Event, System, impact
from hhtjax.scenes import double_pendulum

G = 9.81
PRECISE: Any = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-13}


class Problem(NamedTuple):
    system: System
    events: list
    q0: Any
    v0: Any
    params: Any
    duration: float
    end: Any  # q and v there, by other means


def bounce(rates, y0, duration, guard, jump):
    """y at the end of y' = rates(t, y), where each fall of the guard to zero ends in y := jump(y)."""

    def event(t, y):
        return guard(y)

    event.terminal, event.direction = True, -1.0
    t, y = 0.0, np.asarray(y0, float)
    while t < duration:
        run = solve_ivp(rates, (t, duration), y, events=event, **PRECISE)
        t, y = run.t[-1], run.y[:, -1]
        if run.status == 1:
            y = np.asarray(jump(y), float)
    return y


def dragged_ball():
    """A ball with drag on a floor: two impacts with e = .8."""
    system = System(jnp.ones(1), lambda q, v, t, p: -G - p["c"] * v)
    floor = Event(lambda q, v, t, p: q[0] - p["floor"], impact("e"))
    params = {"c": 0.3, "e": 0.8, "floor": 0.0}
    end = bounce(lambda t, y: [y[1], -G - 0.3 * y[1]], [1.0, 0.0], 1.5, lambda y: y[0], lambda y: [0, -0.8 * y[1]])
    return Problem(system, [floor], np.ones(1), np.zeros(1), params, 1.5, end)


def stopped_double_pendulum():
    """The free double pendulum, its relative angle within a stop: an impulse through M(q), e = .7."""
    scene = double_pendulum.free()
    q0, v0 = np.array([1.2, 0.4]), np.zeros(2)
    stop = Event(lambda q, v, t, p: q[0] - q[1] + 0.6, impact(0.7))

    @jax.jit
    def rates(t, y):
        M, Q = scene.system.mass(y[:2], scene.params), scene.system.force(y[:2], y[2:], t, scene.params)
        return jnp.concatenate([y[2:], jnp.linalg.solve(M, Q)])

    def jump(y):
        M, n = np.asarray(scene.system.mass(jnp.asarray(y[:2]), scene.params)), np.array([1.0, -1.0])
        x = np.linalg.solve(M, n)
        return np.concatenate([y[:2], y[2:] - 1.7 * x * (n @ y[2:]) / (n @ x)])

    end = bounce(rates, [*q0, *v0], 1.5, lambda y: y[0] - y[1] + 0.6, jump)
    return Problem(scene.system, [stop], q0, v0, scene.params, 1.5, end)


def walled_pendulum():
    """A pendulum in two coordinates against a wall, e = .7; by its angle a pendulum that is thrown back."""
    system = System(
        jnp.ones(2),
        lambda q, v, t, p: jnp.array([0.0, -G]) - 0.1 * v,
        constraint=lambda q, t, p: 0.5 * jnp.sum(q**2, keepdims=True) - 0.5,
    )
    wall = Event(lambda q, v, t, p: q[0] + 0.3, impact(0.7))

    def rates(t, y):
        return [y[1], -G * np.sin(y[0]) - 0.1 * y[1]]

    a, w = bounce(rates, [np.pi / 2, 0.0], 1.5, lambda y: np.sin(y[0]) + 0.3, lambda y: [y[0], -0.7 * y[1]])
    end = np.array([np.sin(a), -np.cos(a), w * np.cos(a), w * np.sin(a)])
    return Problem(system, [wall], np.array([1.0, 0.0]), np.zeros(2), None, 1.5, end)


def pressed(on, q, v, t, p):
    """A spring, a load, and a bump stop with a damper."""
    return -p["k"] * q + p["load"] * jnp.cos(3 * t) - on * (p["stiff"] * (q - p["place"]) + p["c"] * v)


PRESSED = System(jnp.ones(1), lambda q, v, t, p: pressed(p["on"], q, v, t, p))
JUMPING = System(jnp.ones(1), lambda q, v, t, p: pressed(jnp.where(q > p["place"], 1.0, 0.0), q, v, t, p))
TOUCHING = Event(lambda q, v, t, p: (p["place"] - q[0]) * (1 - 2 * p["on"]), switch=lambda p: p | {"on": 1 - p["on"]})


def bump_stop(located=True):
    """A driven mass whose bump stop has a damper: a force that jumps, by a mode or by its place."""
    params = {"on": 0.0, "k": 20.0, "load": 10.0, "stiff": 400.0, "c": 5.0, "place": 0.3}
    t, y, on = 0.0, np.zeros(2), 0
    while t < 3.0:

        def rates(t, y, on=on):
            return [y[1], -20 * y[0] + 10 * np.cos(3 * t) - on * (400 * (y[0] - 0.3) + 5 * y[1])]

        def event(t, y, on=on):
            return (0.3 - y[0]) * (1 - 2 * on)

        event.terminal, event.direction = True, -1.0
        run = solve_ivp(rates, (t, 3.0), y, events=event, **PRECISE)
        t, y, on = run.t[-1], run.y[:, -1], 1 - on
    system, events = (PRESSED, [TOUCHING]) if located else (JUMPING, [])
    return Problem(system, events, np.zeros(1), np.zeros(1), params, 3.0, y)
