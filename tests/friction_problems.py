"""Systems with dry friction, of all kinds."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import hhtjax


class Case(NamedTuple):
    """A system with parameters, initial values and a duration."""

    system: Any
    params: Any
    q0: Any
    v0: Any
    duration: float


def coulomb(q, v, t, params):
    return params["F"] + 0 * v


def stribeck(q, v, t, params):
    """mu (1 + .3 exp(-|v|/.05)) times the normal load."""
    return params["F"] * (1 + 0.3 * jnp.exp(-jnp.abs(v) / 0.05))


def spring_force(q, v, t, params):
    return -params["k"] * q - params.get("c", 0.0) * v


def free_vibration():
    """Five reversals under full load, then it sticks."""
    system = hhtjax.System(jnp.ones(1), spring_force, friction=coulomb)
    return Case(system, {"k": 100.0, "F": 4.0}, jnp.array([0.5]), jnp.zeros(1), 2.2)


def free_vibration_exact(times, k=100.0, F=4.0, x0=0.5):
    """q and v in closed form: half cosines about F/k and -F/k in turn, until the spring cannot move the mass."""
    rate, shift = np.sqrt(k), F / k
    half = np.floor(times * rate / np.pi).astype(int)
    rest = int(np.ceil((x0 - shift) / (2 * shift)))
    n = np.minimum(half, rest)
    amplitude, sign = x0 - shift - 2 * shift * n, 1 - 2 * (n % 2)
    phase = np.where(half < rest, rate * times - np.pi * n, 0)
    return sign * (shift + amplitude * np.cos(phase)), -sign * amplitude * rate * np.sin(phase) * (half < rest)


def driven_force(q, v, t, params):
    return -params["k"] * q - params["c"] * v + params["A"] * jnp.sin(2.0 * t)


def stick_slip(limit=coulomb):
    """A mass on a spring, driven by a sine that often cannot move it."""
    system = hhtjax.System(jnp.ones(1), driven_force, friction=limit)
    return Case(system, {"k": 20.0, "c": 0.1, "A": 6.0, "F": 3.0}, jnp.zeros(1), jnp.zeros(1), 8.0)


def belt_force(q, v, t, params):
    return jnp.array([-30.0 * q[0] - 40.0 * (q[0] - q[1]), -50.0 * q[1] - 40.0 * (q[1] - q[0])]) - 0.05 * v


def belt_sliding(q, v, t, params):
    return v - params["u"]


def belt_limit(q, v, t, params):
    s = v - params["u"]
    return params["F"] * jnp.array([1.0, 0.8]) * (1 + 0.5 * jnp.exp(-jnp.abs(s) / 0.1))


def belt():
    """Two masses on a moving belt."""
    system = hhtjax.System(jnp.array([1.0, 0.7]), belt_force, friction=belt_limit, sliding=belt_sliding)
    params = {"F": 5.0, "u": 0.3}
    return Case(system, params, jnp.array([0.1, 0.0]), jnp.array([0.0, 0.0]), 5.0)


def arm_mass(q, params):
    c = 0.5 * jnp.cos(q[1])
    return jnp.array([[1.5 + 2 * c, 0.4 + c], [0.4 + c, 0.4]])


def arm_force(q, v, t, params):
    s = 0.5 * jnp.sin(q[1])
    coriolis = s * jnp.array([-(2 * v[0] + v[1]) * v[1], v[0] ** 2])
    weight = jnp.array([12.0 * jnp.sin(q[0]) + 4.0 * jnp.sin(q[0] + q[1]), 4.0 * jnp.sin(q[0] + q[1])])
    return -coriolis - weight + jnp.array([6.0 * jnp.sin(3.0 * t), 2.0 * jnp.cos(4.0 * t)])


def arm_limit(q, v, t, params):
    return params["F"] * jnp.array([1.0, 0.4])


def arm():
    """Two links, M(q), strongly coupled, both joints rubbing."""
    system = hhtjax.System(arm_mass, arm_force, friction=arm_limit)
    return Case(system, {"F": 2.5}, jnp.array([1.0, -0.5]), jnp.zeros(2), 4.0)
