"""Scenes in which bodies touch, for tests: systems, and where they start."""

from typing import Any, NamedTuple

import jax.numpy as jnp

import hhtjax

GRAVITY = 9.81


class Scene(NamedTuple):
    """What `hhtjax.simulate` takes; T: for so long, s."""

    system: Any
    q0: Any
    v0: Any
    params: dict
    T: float


def ball() -> Scene:
    """A ball with drag, and spin along the floor: it bounces to rest, and then its sliding ends, too."""
    floor = hhtjax.Contact(
        gap=lambda q, t, params: q[1], sliding=lambda q, v, t, params: v[0], friction="mu", restitution="e"
    )

    def force(q, v, t, params):
        return jnp.array([0.0, -GRAVITY]) - params["c"] * v

    system = hhtjax.System(jnp.ones(2), force, contact=floor)
    return Scene(system, jnp.array([0.0, 1.0]), jnp.array([2.0, 0.0]), {"e": 0.6, "c": 0.3, "mu": 0.1}, 3.0)


def table(amplitude: float = 0.05, frequency: float = 12.0) -> Scene:
    """A mass on a table that moves to and fro below it, pulled by a spring, with a changing load: it sticks and slips."""
    speed = amplitude * frequency
    on = hhtjax.Contact(
        gap=lambda q, t, params: q[1],
        sliding=lambda q, v, t, params: v[0] - speed * jnp.cos(frequency * t),
        friction="mu",
    )

    def force(q, v, t, params):
        return jnp.stack([-2.0 * q[0] - 0.3 * v[0], -1.3 * GRAVITY + 3 * jnp.sin(3 * t)])

    system = hhtjax.System(jnp.full(2, 1.3), force, contact=on)
    return Scene(system, jnp.zeros(2), jnp.array([speed, 0.0]), {"mu": 0.4}, 2.0)


def disc(inertia: float = 0.5) -> Scene:
    """A disc of radius 1 (or a sphere: inertia 2/5), that slides along a floor until it rolls."""
    floor = hhtjax.Contact(
        gap=lambda q, t, params: q[1] - 1, sliding=lambda q, v, t, params: v[0] + v[2], friction="mu"
    )
    system = hhtjax.System(
        jnp.array([1.0, 1.0, inertia]), lambda q, v, t, params: jnp.array([0.0, -GRAVITY, 0.0]), contact=floor
    )
    return Scene(system, jnp.array([0.0, 1.0, 0.0]), jnp.array([2.0, 0.0, 0.0]), {"mu": 0.2}, 1.0)


def stack(amplitude: float, frequency: float = 8.0) -> Scene:
    """Three boxes on each other, without rotations, on a floor that moves to and fro."""
    masses, start = jnp.array([1.0, 0.7, 0.5]), jnp.array([0.0, 1.0, 2.0])
    speed = amplitude * frequency

    def gap(q, t, params):
        return jnp.diff(q[3:], prepend=0.0) - jnp.array([0.0, 1.0, 1.0])

    def sliding(q, v, t, params):
        return jnp.diff(v[:3], prepend=speed * jnp.cos(frequency * t))

    def force(q, v, t, params):
        return jnp.concatenate([jnp.zeros(3), -GRAVITY * masses])

    system = hhtjax.System(jnp.tile(masses, 2), force, contact=hhtjax.Contact(gap, sliding, "mu"))
    q0, v0 = jnp.concatenate([jnp.zeros(3), start]), jnp.concatenate([jnp.full(3, speed), jnp.zeros(3)])
    return Scene(system, q0, v0, {"mu": 0.5}, 2.0)


def block() -> Scene:
    """A block, 1 m wide and 2 m high, that stands tilted on a corner, falls, and rocks: two corners touch the floor."""
    b, h = 0.5, 1.0

    def corner(q, side):
        s, c = jnp.sin(q[2]), jnp.cos(q[2])
        return jnp.stack([c * side * b + s * h, s * side * b - c * h])  # from the centre, in space

    def gap(q, t, params):
        return jnp.stack([q[1] + corner(q, side)[1] for side in (-1, 1)])

    def sliding(q, v, t, params):
        return jnp.stack([v[0] - v[2] * corner(q, side)[1] for side in (-1, 1)])

    def force(q, v, t, params):
        return jnp.array([0.0, -GRAVITY, 0.0])

    tilt = 0.2
    on_corner = hhtjax.Contact(gap, sliding, "mu")
    system = hhtjax.System(jnp.array([1.0, 1.0, (b**2 + h**2) / 3]), force, contact=on_corner)
    height = jnp.sin(tilt) * b + jnp.cos(tilt) * h
    return Scene(system, jnp.array([0.0, height, tilt]), jnp.zeros(3), {"mu": 0.8}, 3.0)
