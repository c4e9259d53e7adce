"""Systems with internal states, mild and stiff, and what SciPy makes of them."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from scipy.integrate import solve_ivp

import hhtjax
from hhtjax.rotation import cross, hat
from hhtjax.scenes import double_pendulum, top

LAG = 6e-7  # of a stiff internal state, a thousandth of the smallest step


class Case(NamedTuple):
    """A system with parameters, its initial values and a duration; the same in fewer coordinates, where constrained.

    exact: (position, velocity, z) of `free` -> q, v, z and multipliers.
    """

    system: Any
    params: Any
    q0: Any
    v0: Any
    z0: Any
    duration: float
    free: Any = None
    start: Any = None
    exact: Any = None


def arm_force(q, v, z, t, params):
    """A double pendulum with cubic dampers; a motor at the first joint, a nonlinear Maxwell branch at the second."""
    torque = jnp.stack([2.0 * z["current"] + jnp.sin(3 * t), -z["branch"][0] - 0.1 * z["branch"][0] ** 3])
    return double_pendulum.force(q, v, t, params["arm"]) - 0.3 * v**3 + torque


def dashpot(q, v):
    return (0.6 + 0.3 * jnp.cos(q[:1])) * v[1:]


def arm_internal(q, v, z, t, params):
    current = jnp.cos(5 * t) - z["current"] - 0.5 * v[0]
    return {"current": current / 0.05, "branch": (dashpot(q, v) - z["branch"]) / params["lag"]}


def arm_mass(q, params):
    return double_pendulum.mass(q, params["arm"])


def arm(lag):
    params = {"arm": {**double_pendulum.free().params, "k": (20.0, 10.0), "c": (0.5, 0.3)}, "lag": lag}
    q0, v0 = jnp.array([0.3, -0.2]), jnp.array([0.5, -1.0])
    z0 = {"current": 0.2, "branch": dashpot(q0, v0)}
    w0 = jnp.linalg.solve(arm_mass(q0, params), arm_force(q0, v0, z0, 0.0, params))
    z0["branch"] = (
        z0["branch"] - lag * jax.jvp(dashpot, (q0, v0), (v0, w0))[1]
    )  # what it lags behind, where that is stiff
    system = hhtjax.System(arm_mass, arm_force, internal=arm_internal)
    return Case(system, params, q0, v0, z0, 1.0)


def turning(q, v):
    """Angular velocity of a point mass about the origin."""
    return (q[0] * v[1] - q[1] * v[0]) / 0.25


def rod_force(q, v, z, t, params):
    """Weight, and the torque of a lagging actuator and of a Maxwell damper, on a point mass of 1 kg at 0.5 m."""
    return jnp.array([0.0, -9.81]) + (z[0] - z[1]) / 0.25 * jnp.stack([-q[1], q[0]])


def rod_internal(q, v, z, t, params):
    return jnp.stack([(jnp.sin(4 * t) - z[0]) / params["lag"], 3.0 * turning(q, v) - z[1] / 0.1])


def rod_length(q, t, params):
    return (jnp.sum(q**2, keepdims=True) - 0.25) / 2


def angle_force(q, v, z, t, params):
    return z[:1] - z[1:] - 9.81 * 0.5 * jnp.sin(q)


def angle_internal(q, v, z, t, params):
    return jnp.stack([(jnp.sin(4 * t) - z[0]) / params["lag"], 3.0 * v[0] - z[1] / 0.1])


def on_the_rod(a, rate, z):
    q, e = 0.5 * np.array([np.sin(a[0]), -np.cos(a[0])]), np.array([np.cos(a[0]), np.sin(a[0])])
    v = 0.5 * rate[0] * e
    return q, v, z, (-v @ v + 9.81 * q[1:]) / 0.25


def rod(lag):
    system = hhtjax.System(jnp.ones(2), rod_force, rod_length, internal=rod_internal)
    free = hhtjax.System(jnp.array([0.25]), angle_force, internal=angle_internal)
    start = jnp.array([0.4]), jnp.array([1.5])
    q0, v0, _, _ = on_the_rod(*map(np.asarray, start), None)
    z0 = jnp.array([-4 * lag, 0.2])
    return Case(system, {"lag": lag}, jnp.asarray(q0), jnp.asarray(v0), z0, 1.0, free, start, on_the_rod)


def top_force(R, Om, z, t, params):
    """A heavy top whose spin is braked through two stages of a filter, z (2, 3): as many rates as R has entries."""
    J = jnp.array([0.8, 0.5, 0.9])
    return cross(jnp.array([0.0, 0.5, 0.0]), -9.81 * R[2]) - cross(Om, J * Om) - z[1]


def top_internal(R, Om, z, t, params):
    return jnp.stack([(0.3 * Om * (1 + jnp.sin(t)) - z[0]) / params["lag"], (z[0] - z[1]) / 0.1])


def filtered_top(lag):
    scene = top.minimal(spin=4.0, inclination=0.3)
    system = hhtjax.System(jnp.array([0.8, 0.5, 0.9]), top_force, internal=top_internal)
    return Case(system, {"lag": lag}, scene.q0, scene.v0, jnp.stack([0.3 * scene.v0, jnp.zeros(3)]), 1.0)


CASES = {"M(q), cubic damping, explicit time": arm, "a constraint": rod, "a rotation": filtered_top}


@partial(jax.jit, static_argnums=(0, 1))
def _rate(system, unravel, t, y, params):
    q, v, z = unravel(y)
    M = system.mass(q, params) if callable(system.mass) else jnp.asarray(system.mass)
    Q = system.force(q, v, z, t, params)
    w = Q / M if M.ndim == 1 else jnp.linalg.solve(M, Q)
    qdot = q @ hat(v) if q.shape == (3, 3) else v
    return ravel_pytree((qdot, w, system.internal(q, v, z, t, params)))[0]


def reference(case):
    """q, v, z and multipliers at the end, as vectors; the stiff ones by Radau's method."""
    system, (q0, v0) = case.free or case.system, case.start or (case.q0, case.v0)
    y0, unravel = ravel_pytree((q0, v0, case.z0))

    def rate(t, y):
        return np.asarray(_rate(system, unravel, t, y, case.params))

    method = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-12}
    if case.params["lag"] == LAG:
        slopes = jax.jit(jax.jacfwd(lambda t, y: _rate(system, unravel, t, y, case.params), argnums=1))
        method = {"method": "Radau", "rtol": 1e-9, "atol": 1e-10, "jac": lambda t, y: np.asarray(slopes(t, y))}
    run = solve_ivp(rate, (0, case.duration), y0, **method)
    end = [np.asarray(ravel_pytree(x)[0]) for x in unravel(run.y[:, -1])]
    return case.exact(*end) if case.exact else (*end, None)
