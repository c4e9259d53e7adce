"""A joint on a geared motor under a PI controller with velocity feedback; internal states: current and integral."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from hhtjax.description import Array, PyTree, Real
from hhtjax.scenes import drawings
from hhtjax.scenes.scene import InternalScene, array
from hhtjax.systems.system import System

GRAVITY = 9.80665


def mass(q: Array, params: PyTree) -> Array:
    """M = [inertia of the link, and of the rotor seen through the gear]."""
    return (params["link_inertia"] + params["gear"] ** 2 * params["rotor_inertia"]) * jnp.ones(1, q.dtype)


def force(q: Array, v: Array, z: dict, t: Real, params: PyTree) -> Array:
    """Q: torque of the motor, friction of the bearing, and weight; q = 0 hangs down."""
    torque = params["gear"] * params["torque_constant"] * z["current"]
    return torque - params["friction"] * v - params["weight"] * jnp.sin(q)


def internal(q: Array, v: Array, z: dict, t: Real, params: PyTree):
    """The rate of the current from L di/dt = U - R i - (back EMF), and that of the integral, the error of the angle."""
    error = params["amplitude"] * jnp.sin(params["frequency"] * t) - q
    voltage = params["kp"] * error + params["ki"] * z["integral"] - params["kd"] * v
    back_emf = params["gear"] * params["torque_constant"] * v
    current = (voltage - params["resistance"] * z["current"] - back_emf) / params["inductance"]
    return {"current": current, "integral": error}


@drawings.Drawing
def drawing(q, t, params: PyTree):
    """The link of 0.5 m, its motor, and the desired angle as a dashed line."""

    def end(angle):
        return 0.5 * np.array([np.sin(angle), -np.cos(angle)])

    pivot = np.zeros(2)
    return [
        drawings.bar(pivot, end(q[0])),
        drawings.wheel(pivot, 0.05),
        drawings.aim(pivot, end(params["amplitude"] * np.sin(params["frequency"] * t))),
        drawings.ground((0.15, 0.05), (-0.15, 0.05), 0.04, 6),
    ]


def tracking() -> InternalScene:
    """A link of 1 kg and 0.5 m follows a sine. The current is far faster than the motion: L/R = 1 ms (SI units)."""
    params = {
        "link_inertia": 1.0 * 0.5**2 / 3, "rotor_inertia": 2e-5, "gear": 50.0, "friction": 0.05,
        "weight": 1.0 * GRAVITY * 0.25, "torque_constant": 0.05, "resistance": 1.0, "inductance": 1e-3,
        "kp": 60.0, "ki": 40.0, "kd": 2.0, "amplitude": 1.0, "frequency": 3.0,
    }  # fmt: skip
    zero = array([0.0])
    system, z0 = System(mass, force, internal=internal), {"current": zero, "integral": zero}
    return InternalScene(system, params, zero, zero, 2.0, z0, drawing)
