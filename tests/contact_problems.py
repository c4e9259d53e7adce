"""Scenes in which bodies touch, for tests: systems, and where they start."""

from typing import Any, NamedTuple

import jax.numpy as jnp

import hhtjax
from experiments.contact import scenes

GRAVITY = 9.81


class Scene(NamedTuple):
    """What `hhtjax.simulate` takes; T: for so long, s."""

    system: Any
    q0: Any
    v0: Any
    params: dict
    T: float


def of_experiment(scene: scenes.Scene) -> Scene:
    """One of the experiment's, which start from their params."""
    q0, v0 = scene.start(scene.params)
    return Scene(scene.system, q0, v0, scene.params, scene.T)


def ball() -> Scene:
    """A ball with drag, and spin along the floor: it bounces to rest, and then its sliding ends, too."""
    return of_experiment(scenes.ball())


def table() -> Scene:
    """A mass on a table that moves to and fro, pulled by a spring, with a changing load: it sticks and slips."""
    return of_experiment(scenes.table())


def disc(inertia: float = 0.5) -> Scene:
    """A disc of radius 1 (or a sphere: inertia 2/5), that slides along a floor until it rolls."""
    return of_experiment(scenes.disc(inertia))


def stack(amplitude: float) -> Scene:
    """Three boxes on each other, without rotations, on a floor that moves to and fro."""
    return of_experiment(scenes.stack(amplitude))


def slope() -> Scene:
    """A block on a slope of 0.3 rad, at rest: it stays for mu > tan 0.3."""
    on = hhtjax.Contact(lambda q, t, params: q[1], lambda q, v, t, params: v[0], "mu")

    def force(q, v, t, params):
        return GRAVITY * jnp.array([jnp.sin(0.3), -jnp.cos(0.3)])

    return Scene(hhtjax.System(jnp.ones(2), force, contact=on), jnp.zeros(2), jnp.zeros(2), {"mu": 0.2}, 1.0)


def standing(points, inertia: float, q0: Any, v0: Any, params: dict, T: float, restitution: Any = 0.0) -> Scene:
    """A body of 1 kg, of which points (x, y) beside its centre can touch a floor; q = (x, y, angle)."""

    def places(q):
        s, c = jnp.sin(q[2]), jnp.cos(q[2])
        return [jnp.stack([c * x - s * y, s * x + c * y]) for x, y in points]

    def gap(q, t, params):
        return jnp.stack([q[1] + r[1] for r in places(q)])

    def sliding(q, v, t, params):
        return jnp.stack([v[0] - v[2] * r[1] for r in places(q)])

    def force(q, v, t, params):
        return jnp.array([0.0, -GRAVITY, 0.0], q.dtype)

    contact = hhtjax.Contact(gap, sliding, "mu", restitution)
    return Scene(hhtjax.System(jnp.array([1.0, 1.0, inertia]), force, contact=contact), q0, v0, params, T)


def block() -> Scene:
    """A block, 1 m wide and 2 m high, that stands tilted on a corner, falls, and rocks: two corners touch the floor."""
    b, h, tilt = 0.5, 1.0, 0.2
    height = jnp.sin(tilt) * b + jnp.cos(tilt) * h
    start = jnp.array([0.0, height, tilt]), jnp.zeros(3)
    return standing([(-b, -h), (b, -h)], (b**2 + h**2) / 3, *start, {"mu": 0.8}, 3.0)


def rod(angle: float = 1.0, mu: float = 0.4) -> Scene:
    """A rod of 1 m, one end of which stands on the floor: it slides, and falls down flat."""
    start = jnp.array([0.0, jnp.sin(angle) / 2, angle]), jnp.array([0.3, 0.0, 0.0])
    return standing([(-0.5, 0.0), (0.5, 0.0)], 1 / 12, *start, {"mu": mu}, 1.0)


def hopper() -> Scene:
    """Two masses above each other, and a driven spring between: the lower one leaves the floor, and lands."""
    upper, lower, k, c, length = 1.0, 0.5, 400.0, 4.0, 0.5

    def force(q, v, t, params):
        drive, rate = 0.06 * jnp.sin(14 * t), 0.06 * 14 * jnp.cos(14 * t)
        push = k * (length + drive - (q[0] - q[1])) - c * (v[0] - v[1] - rate)
        return jnp.stack([push - upper * GRAVITY, -push - lower * GRAVITY])

    floor = hhtjax.Contact(lambda q, t, params: q[1], restitution="e")
    system = hhtjax.System(jnp.array([upper, lower]), force, contact=floor)
    return Scene(system, jnp.array([length - upper * GRAVITY / k, 0.0]), jnp.zeros(2), {"e": 0.0}, 0.8)


def bowl() -> Scene:
    """A block that slides in a bowl y = x^2 - x^4/8, to and fro, until friction holds it beside the lowest point."""

    def gap(q, t, params):
        return q[1] - q[0] ** 2 + q[0] ** 4 / 8

    def sliding(q, v, t, params):
        slope = 2 * q[0] - q[0] ** 3 / 2
        return (v[0] + slope * v[1]) / jnp.sqrt(1 + slope**2)

    def force(q, v, t, params):
        return jnp.array([0.0, -GRAVITY])

    system = hhtjax.System(jnp.ones(2), force, contact=hhtjax.Contact(gap, sliding, "mu"))
    return Scene(system, jnp.array([0.9, 0.9**2 - 0.9**4 / 8]), jnp.zeros(2), {"mu": 0.35}, 2.0)
