"""Scenes on which the points of linearisation differ: each is hard for at least one of them. SI units."""

from typing import NamedTuple

import jax.numpy as jnp

from hhtjax import System
from hhtjax.scenes import Scene, double_pendulum, duffing


class Case(NamedTuple):
    """name; scene; fewest: steps of the coarsest run; solver: scipy's, for the reference; fast: in the smoke run."""

    name: str
    scene: Scene
    fewest: int
    solver: str
    fast: bool = False


def unit_mass(force, params, q0, v0, duration) -> Scene:
    """A scene of unit masses."""
    return Scene(System(jnp.ones(len(q0)), force), params, jnp.array(q0), jnp.array(v0), duration)


def cubic_damper() -> Scene:
    """w + 10 v^3 + 100 q = 0 from 10 m/s: a damping rate of 30 v^2 = 3000 /s at first, a few /s in the end."""

    def force(q, v, t, params):
        return -params["c"] * v**3 - params["k"] * q

    return unit_mass(force, {"c": 10.0, "k": 100.0}, [1.0], [10.0], 2.0)


def quadratic_drag() -> Scene:
    """w + 10 |v| v + 100 q = 0 from 100 m/s: a damping rate of 20 |v| = 2000 /s at first."""

    def force(q, v, t, params):
        return -params["c"] * jnp.abs(v) * v - params["k"] * q

    return unit_mass(force, {"c": 10.0, "k": 100.0}, [0.0], [100.0], 2.0)


def friction() -> Scene:
    """w + 100 q + 20 tanh(v/0.001) = 40 cos(6 t): Coulomb friction, smoothed; the mass sticks and slips."""

    def force(q, v, t, params):
        return 40.0 * jnp.cos(6.0 * t) - 100.0 * q - params["limit"] * jnp.tanh(v / params["width"])

    return unit_mass(force, {"limit": 20.0, "width": 1e-3}, [0.5], [0.0], 4.0)


def van_der_pol() -> Scene:
    """w = mu (1 - q^2) v - q with mu = 1000: 807 s of creep between jumps whose fastest rate is 3000 /s.

    No uniform step of a practical size resolves the jumps, so all one can ask for is a bounded motion.
    """

    def force(q, v, t, params):
        return params["mu"] * (1 - q**2) * v - q

    return unit_mass(force, {"mu": 1e3}, [2.0], [0.0], 2000.0)


def spring_and_weight(q, v, t, params):
    """Q of 1 kg on a spring of rest length 1 m, hung up at the origin."""
    length = jnp.sqrt(jnp.sum(q**2))
    return -params["k"] * (length - 1.0) * q / length + jnp.array([0.0, -9.81])


def elastic_pendulum(k) -> Scene:
    """A pendulum on a stiff spring, Cartesian, let go at 45 degrees with the spring at its static stretch.

    So the spring does not vibrate, and the motion stays on its slow manifold.
    """
    stretched = 1.0 + 9.81 * 0.5**0.5 / k
    return unit_mass(spring_and_weight, {"k": k}, [stretched * 0.5**0.5, -stretched * 0.5**0.5], [0.0, 0.0], 4.0)


def hertz_contact() -> Scene:
    """A ball falls 0.2 m onto an elastic floor, 10^6 (-q)^1.5 where q < 0: four contacts of 11 ms."""

    def force(q, v, t, params):
        return params["k"] * jnp.maximum(-q, 0.0) ** 1.5 - 9.81

    return unit_mass(force, {"k": 1e6}, [0.2], [0.0], 1.6)


def hard_stop() -> Scene:
    """An oscillator, 10 q, with a stop at q = -0.5: a one-sided spring 10^4 times as stiff as its own."""

    def force(q, v, t, params):
        return -10.0 * q + params["k"] * jnp.maximum(-0.5 - q, 0.0)

    return unit_mass(force, {"k": 1e5}, [1.0], [0.0], 4.0)


def chain() -> Scene:
    """Four links of 1 m let go from the horizontal, 1 kg at the end of each, hinged to the wall.

    q: angles of the links from the horizontal. Joints between links: 10^4 N m/rad, 10 N m s/rad.
    """
    outboard = jnp.array([4.0, 3.0, 2.0, 1.0])  # mass that each joint carries
    common = jnp.minimum(outboard[:, None], outboard[None, :])

    def mass(q, params):
        return common * jnp.cos(q[:, None] - q[None, :])

    def force(q, v, t, params):
        joints = jnp.append(params["k"] * jnp.diff(q, prepend=0.0) + params["c"] * jnp.diff(v, prepend=0.0), 0.0)
        centrifugal = jnp.sum(common * jnp.sin(q[:, None] - q[None, :]) * v[None, :] ** 2, axis=1)
        return jnp.diff(joints) - centrifugal - 9.81 * outboard * jnp.cos(q)

    params = {"k": jnp.array([0.0, 1e4, 1e4, 1e4]), "c": jnp.array([0.0, 10.0, 10.0, 10.0])}
    return Scene(System(mass, force), params, jnp.zeros(4), jnp.zeros(4), 4.0)


def cases() -> list[Case]:
    """All of them: smooth, stiff, dissipative, with contact."""
    return [
        Case("Duffing, driven", duffing.driven(), 8, "DOP853", fast=True),
        Case("double pendulum, free", double_pendulum.free(), 16, "DOP853"),
        Case("double pendulum, stiff", double_pendulum.stiff(), 16, "Radau"),
        Case("double pendulum, as printed", double_pendulum.stiff(as_printed=True), 16, "Radau"),
        Case("chain of four links", chain(), 8, "DOP853"),
        Case("elastic pendulum, k = 1e4", elastic_pendulum(1e4), 16, "DOP853", fast=True),
        Case("elastic pendulum, k = 1e6", elastic_pendulum(1e6), 16, "DOP853", fast=True),
        Case("hardening spring", duffing.hardening_spring(), 16, "DOP853"),
        Case("cubic damper", cubic_damper(), 16, "Radau", fast=True),
        Case("quadratic drag", quadratic_drag(), 16, "Radau"),
        Case("tanh friction", friction(), 16, "Radau"),
        Case("van der Pol, mu = 1000", van_der_pol(), 256, "Radau"),
        Case("Hertz contact", hertz_contact(), 16, "DOP853"),
        Case("hard stop", hard_stop(), 16, "DOP853"),
    ]
