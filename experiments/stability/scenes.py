"""More scenes, added after the default of `hht` was chosen on those of experiments/linearization. SI units."""

import jax.numpy as jnp

from experiments.linearization.scenes import Case, cases, elastic_pendulum, spring_and_weight, unit_mass
from hhtjax import System
from hhtjax.scenes import Scene


def ringing_pendulum() -> Scene:
    """The elastic pendulum of 10^4 N/m off its slow manifold: let go 5 % too long, the spring rings at 100 rad/s."""
    return unit_mass(spring_and_weight, {"k": 1e4}, [1.05 * 0.5**0.5, -1.05 * 0.5**0.5], [0.0, 0.0], 4.0)


def sudden_stiffness() -> Scene:
    """w + k q = 0 with k = 100 for a second, 10^4 afterwards."""

    def force(q, v, t, params):
        soft, hard = params["k"]
        return -jnp.where(t < 1.0, soft, hard) * q

    return unit_mass(force, {"k": (100.0, 1e4)}, [1.0], [0.0], 2.0)


def negative_damping() -> Scene:
    """w - 0.4 v + 100 q = 0: grows by e in five seconds, whatever a method would like to damp."""

    def force(q, v, t, params):
        return params["c"] * v - params["k"] * q

    return unit_mass(force, {"c": 0.4, "k": 100.0}, [1.0], [0.0], 5.0)


def stick_slip() -> Scene:
    """A mass on a belt of 1 m/s, held by a spring of 100 N/m: friction falls with sliding speed from 10 N to 5 N."""

    def force(q, v, t, params):
        sliding = 1.0 - v
        return (5.0 + 5.0 * jnp.exp(-(sliding**2))) * jnp.tanh(sliding / params["width"]) - params["k"] * q

    return unit_mass(force, {"k": 100.0, "width": 1e-2}, [0.0], [0.0], 4.0)


def dissipative_contact() -> Scene:
    """A ball falls 0.2 m onto a floor of Hunt and Crossley's, 10^6 (-q)^1.5 (1 - 0.2 v) where q < 0."""

    def force(q, v, t, params):
        return params["k"] * jnp.maximum(-q, 0.0) ** 1.5 * (1.0 - params["c"] * v) - 9.81

    return unit_mass(force, {"k": 1e6, "c": 0.2}, [0.2], [0.0], 1.2)


def hardening_chain() -> Scene:
    """Four masses on a wall, each on a spring 100 x + 10^4 x^3; the outer one is let go from 0.5 m."""

    def force(q, v, t, params):
        stretch = jnp.diff(q, prepend=0.0)
        return jnp.diff(params["k"] * stretch + params["k3"] * stretch**3, append=0.0)

    return unit_mass(force, {"k": 100.0, "k3": 1e4}, [0.0, 0.0, 0.0, 0.5], [0.0] * 4, 1.0)


def far_from_slow_manifold() -> Scene:
    """A node of a milligram that 1 N pushes from rest, against 50 q + 5 v: in a microsecond it is as fast as that."""

    def force(q, v, t, params):
        return 1.0 - params["k"] * q - params["c"] * v

    system = System(lambda q, params: jnp.reshape(params["m"], (1,)), force)
    return Scene(system, {"m": 1e-6, "k": 50.0, "c": 5.0}, jnp.zeros(1), jnp.zeros(1), 0.5)


def held_out() -> list[Case]:
    """Scenes on which nothing was tuned."""
    return [
        Case("elastic pendulum, k = 1e8", elastic_pendulum(1e8), 16, "DOP853"),
        Case("elastic pendulum, ringing", ringing_pendulum(), 16, "DOP853"),
        Case("sudden stiffness", sudden_stiffness(), 8, "DOP853"),
        Case("negative damping", negative_damping(), 8, "DOP853"),
        Case("stick-slip", stick_slip(), 16, "Radau"),
        Case("dissipative contact", dissipative_contact(), 16, "DOP853"),
        Case("hardening chain", hardening_chain(), 16, "DOP853"),
        Case("started far from its slow manifold", far_from_slow_manifold(), 16, "Radau"),
    ]


def all_cases() -> list[Case]:
    """Those of the linearization experiment, then the held-out ones."""
    return cases() + held_out()
