"""The scenes with contacts. Each starts from its params alone, so that derivatives in all of them can be taken."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax

GRAVITY = 9.81
STEPPER = hhtjax.hht(linearize="predictor")


class Scene(NamedTuple):
    """mass: diagonal. start: params -> q0, v0. T: duration, s. potential(q, params): of what is free, else None."""

    mass: Any
    force: Callable
    contact: hhtjax.Contact
    start: Callable
    params: dict
    T: float
    potential: Callable | None = None

    @property
    def system(self):
        """For `hhtjax.simulate`."""
        return hhtjax.System(self.mass, self.force, contact=self.contact)


def simulate(scene, dt, num_steps, every=1, params=None, stepper=STEPPER):
    """A run of it."""
    params = scene.params if params is None else params
    return hhtjax.simulate(
        scene.system, stepper, *scene.start(params), params, dt=dt, num_steps=num_steps, save_every=every
    )


def run_of(scene, steps, every=1, stepper=STEPPER, **params):
    """Its whole duration in so many steps."""
    return simulate(scene, scene.T / steps, steps, every, scene.params | params, stepper)


def ball(drag=0.3) -> Scene:
    """A ball with drag, moving along the floor: it bounces to rest, infinitely often, and then its sliding ends."""
    floor = hhtjax.Contact(
        gap=lambda q, t, params: q[1], sliding=lambda q, v, t, params: v[0], friction="mu", restitution="e"
    )

    def force(q, v, t, params):
        return jnp.array([0.0, -GRAVITY], q.dtype) - params["c"] * v

    def start(params):
        return jnp.array([0.0, 1.0]), jnp.array([2.0, 0.0])

    params = {"e": 0.6, "mu": 0.1, "c": drag}
    return Scene(jnp.ones(2), force, floor, start, params, 3.0, lambda q, params: GRAVITY * q[1])


def table(amplitude=0.05, frequency=12.0) -> Scene:
    """A mass with a spring on a table that moves to and fro, and a load that changes: it sticks and slips."""
    speed = amplitude * frequency
    on = hhtjax.Contact(
        gap=lambda q, t, params: q[1],
        sliding=lambda q, v, t, params: v[0] - speed * jnp.cos(frequency * t),
        friction="mu",
    )

    def force(q, v, t, params):
        return jnp.stack([-2.0 * q[0] - 0.3 * v[0], -1.3 * GRAVITY + 3 * jnp.sin(3 * t)])

    def start(params):
        return jnp.zeros(2), jnp.array([speed, 0.0])

    return Scene(jnp.full(2, 1.3), force, on, start, {"mu": 0.4}, 2.0)


def disc(inertia=0.5) -> Scene:
    """A disc of radius 1 (or a sphere: inertia 2/5), that slides along a floor until it rolls."""
    floor = hhtjax.Contact(
        gap=lambda q, t, params: q[1] - 1, sliding=lambda q, v, t, params: v[0] + v[2], friction="mu"
    )

    def force(q, v, t, params):
        return jnp.array([0.0, -GRAVITY, 0.0])

    def start(params):
        return jnp.array([0.0, 1.0, 0.0]), jnp.stack([params["v0"], 0.0, 0.0])

    params = {"mu": 0.2, "v0": 2.0}
    mass = jnp.array([1.0, 1.0, inertia])
    return Scene(mass, force, floor, start, params, 1.0, lambda q, params: GRAVITY * q[1])


def slope(angle, v0) -> Scene:
    """A block on a slope that falls to the right, in space coordinates, which starts with the speed v0 down it."""
    s, c = float(np.sin(angle)), float(np.cos(angle))
    plane = hhtjax.Contact(
        gap=lambda q, t, params: s * q[0] + c * q[1],
        sliding=lambda q, v, t, params: c * v[0] - s * v[1],
        friction="mu",
    )

    def force(q, v, t, params):
        return jnp.array([0.0, -GRAVITY])

    def start(params):
        return jnp.zeros(2), v0 * jnp.array([c, -s])

    return Scene(jnp.ones(2), force, plane, start, {"mu": 0.4}, 1.0, lambda q, params: GRAVITY * q[1])


def turned(angle, x, y):
    """A point of a body in space, from its centre."""
    s, c = jnp.sin(angle), jnp.cos(angle)
    return jnp.stack([c * x - s * y, s * x + c * y])


def of_points(points):
    """Gaps to the floor and sliding of such points (x, y) of a body q = (x, y, angle)."""

    def gap(q, t, params):
        return jnp.stack([q[1] + turned(q[2], *point)[1] for point in points])

    def sliding(q, v, t, params):
        return jnp.stack([v[0] - v[2] * turned(q[2], *point)[1] for point in points])

    return gap, sliding


def rock() -> Scene:
    """A block, 0.5 m wide and 2 m high, that stands tilted on a corner, falls, and rocks."""
    b, h = 0.25, 1.0

    def force(q, v, t, params):
        return jnp.array([0.0, -GRAVITY, 0.0])

    def start(params):
        tilt = params["tilt"]
        return jnp.stack([0.0, jnp.sin(tilt) * b + jnp.cos(tilt) * h, tilt]), jnp.zeros(3)

    floor = hhtjax.Contact(*of_points([(-b, -h), (b, -h)]), friction="mu")
    mass = jnp.array([1.0, 1.0, (b**2 + h**2) / 3])
    return Scene(mass, force, floor, start, {"mu": 0.8, "tilt": 0.1}, 3.0, lambda q, params: GRAVITY * q[1])


def rod() -> Scene:
    """A thin rod, 2 m long, that leans on one foot and slides: the foot stops, the rod tips, and its head lands."""

    def force(q, v, t, params):
        return jnp.array([0.0, -GRAVITY, 0.0])

    def start(params):
        return jnp.stack([0.0, jnp.sin(1.0), 1.0]), jnp.stack([params["v0"], 0.0, 0.0])

    floor = hhtjax.Contact(*of_points([(-1.0, 0.0), (1.0, 0.0)]), friction="mu")
    mass = jnp.array([1.0, 1.0, 1 / 3])
    return Scene(mass, force, floor, start, {"mu": 0.5, "v0": 1.0}, 1.2, lambda q, params: GRAVITY * q[1])


def hopper() -> Scene:
    """Two masses on each other, with a spring that pushes by a sine: the lower one leaves the floor twice."""
    m = jnp.array([1.0, 0.5])

    def force(q, v, t, params):
        push = params["k"] * (1.0 - q[0] + q[1]) - 1.5 * (v[0] - v[1]) + params["A"] * jnp.sin(9.0 * t)
        return jnp.stack([push, -push]) - GRAVITY * m

    def start(params):
        return jnp.stack([1.0 - GRAVITY / params["k"], 0.0]), jnp.zeros(2)

    floor = hhtjax.Contact(gap=lambda q, t, params: q[1])
    return Scene(m, force, floor, start, {"k": 100.0, "A": 20.0}, 1.5)


def stack(amplitude, frequency=8.0) -> Scene:
    """Three boxes on each other, without rotations, on a floor that moves to and fro."""
    masses, heights = jnp.array([1.0, 0.7, 0.5]), jnp.array([0.0, 1.0, 2.0])
    speed = amplitude * frequency

    def gap(q, t, params):
        return jnp.diff(q[3:], prepend=0.0) - jnp.array([0.0, 1.0, 1.0])

    def sliding(q, v, t, params):
        return jnp.diff(v[:3], prepend=speed * jnp.cos(frequency * t))

    def force(q, v, t, params):
        return jnp.concatenate([jnp.zeros(3), -GRAVITY * masses])

    def start(params):
        return jnp.concatenate([jnp.zeros(3), heights]), jnp.concatenate([jnp.full(3, speed), jnp.zeros(3)])

    contact = hhtjax.Contact(gap, sliding, "mu")
    return Scene(jnp.tile(masses, 2), force, contact, start, {"mu": 0.5}, 2.0)


def shaken(part, frequency=8.0) -> Scene:
    """The stack on a floor whose largest acceleration is this part of mu g."""
    return stack(part * 0.5 * GRAVITY / frequency**2, frequency)


SCENES = {"ball": ball(), "rod": rod(), "rock": rock(), "table": table(), "hopper": hopper()}


def energy(scene, run):
    """At the saved times."""
    kinetic = 0.5 * jnp.sum(scene.mass * run.v**2, axis=-1)
    return kinetic + jax.vmap(lambda q: scene.potential(q, scene.params))(run.q)  # pyright: ignore[reportOptionalCall]
