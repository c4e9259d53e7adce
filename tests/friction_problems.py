"""Systems with dry friction, of all kinds."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import hhtjax
from hhtjax.rotation import cross
from hhtjax.scenes import belt, dry_oscillator


class Case(NamedTuple):
    """A system with parameters, initial values and a duration; the same in fewer coordinates, where constrained."""

    system: Any
    params: Any
    q0: Any
    v0: Any
    duration: float
    z0: Any = None
    free: Any = None
    start: Any = None
    exact: Any = None


def free_vibration_exact(times, k=100.0, F=4.0, x0=0.5):
    """q and v in closed form: half cosines about F/k and -F/k in turn, until the spring cannot move the mass."""
    rate, shift = np.sqrt(k), F / k
    half = np.floor(times * rate / np.pi).astype(int)
    rest = int(np.ceil((x0 - shift) / (2 * shift)))
    n = np.minimum(half, rest)
    amplitude, sign = x0 - shift - 2 * shift * n, 1 - 2 * (n % 2)
    phase = np.where(half < rest, rate * times - np.pi * n, 0)
    return sign * (shift + amplitude * np.cos(phase)), -sign * amplitude * rate * np.sin(phase) * (half < rest)


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


def turning(q, v, t, params):
    """Angular velocity of a point mass about the origin, whose direction turns with it."""
    return ((q[0] * v[1] - q[1] * v[0]) / 0.25)[None]


def rod_force(q, v, t, params):
    """Weight and a torque on a point mass of 1 kg at 0.5 m."""
    return jnp.array([0.0, -9.81]) + params["A"] * jnp.sin(4 * t) / 0.25 * jnp.stack([-q[1], q[0]])


def rod_length(q, t, params):
    return (jnp.sum(q**2, keepdims=True) - 0.25) / 2


def rod_limit(q, v, L, t, params):
    """Of a bearing, which the tension loads: L is it, over 0.5 m."""
    return params["F"] * (0.5 + 0.1 * jnp.abs(L))


def angle_limit(q, v, t, params):
    return params["F"] * (0.5 + 0.1 * (v**2 + 9.81 * 2 * jnp.cos(q)))


def angle_force(q, v, t, params):
    return params["A"] * jnp.sin(4 * t) - 9.81 * 0.5 * jnp.sin(q)


def on_the_rod(a, rate):
    a, rate = a[:, :1], rate[:, :1]
    q, e = 0.5 * np.hstack([np.sin(a), -np.cos(a)]), np.hstack([np.cos(a), np.sin(a)])
    return q, 0.5 * rate * e


def rod():
    """A pendulum with a constraint, and a bearing whose friction grows with its load; stops and starts."""
    system = hhtjax.System(jnp.ones(2), rod_force, rod_length, friction=rod_limit, sliding=turning)
    free = hhtjax.System(jnp.array([0.25]), angle_force, friction=angle_limit)
    start = np.array([0.9]), np.array([0.0])
    q0, v0 = on_the_rod(*(x[None] for x in start))
    return Case(
        system, {"A": 2.5, "F": 0.4}, jnp.asarray(q0[0]), jnp.asarray(v0[0]), 3.0, None, free, start, on_the_rod
    )


def motor_force(q, v, z, t, params):
    return 2.0 * z - 30.0 * q


def motor_current(q, v, z, t, params):
    return (3.0 * jnp.sin(2.0 * t) - z - 0.5 * v) / 0.1


def motor_limit(q, v, z, t, params):
    return params["F"] * (1 + 0.3 * jnp.exp(-jnp.abs(v) / 0.05))


def motor():
    """A drive with a current that lags, on a spring, with stiction."""
    system = hhtjax.System(jnp.ones(1), motor_force, internal=motor_current, friction=motor_limit)
    return Case(system, {"F": 1.5}, jnp.zeros(1), jnp.zeros(1), 5.0, jnp.array([0.5]))


def body_torque(R, Om, t, params):
    """Gyroscopic, a weight, and a drive."""
    J = jnp.array([0.8, 0.5, 0.9])
    drive = jnp.array([0.6 * jnp.sin(5 * t), 0.0, 2.0 * jnp.sin(3 * t)])
    return cross(jnp.array([0.0, 0.0, 0.2]), -9.81 * R[2]) - cross(Om, J * Om) + drive


def body_sliding(R, Om, t, params):
    """About its own axis, and about the vertical."""
    return jnp.stack([Om[2], R[2] @ Om])


def body_limit(R, Om, t, params):
    return params["F"] * jnp.array([1.0, 0.5])


def body():
    """A top in two bearings that rub: one turns with it, one stays in space."""
    system = hhtjax.System(jnp.array([0.8, 0.5, 0.9]), body_torque, friction=body_limit, sliding=body_sliding)
    c, s = np.cos(0.8), np.sin(0.8)
    tilted = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    return Case(system, {"F": 1.5}, tilted, np.array([0.0, 0.5, 2.0]), 3.0)


def of_scene(scene):
    return Case(*scene)


CASES = {
    "stick-slip, Coulomb": of_scene(dry_oscillator.driven(0.0)),
    "stick-slip, Stribeck": of_scene(dry_oscillator.driven()),
    "two masses on a belt": of_scene(belt.two_masses()),
    "M(q), two joints": arm(),
    "an internal state": motor(),
    "a constraint, H(q), a load": rod(),
    "a rotation, H(q)": body(),
}
