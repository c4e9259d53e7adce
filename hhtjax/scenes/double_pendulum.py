"""The double pendulum of Kim et al. (2019), Sec. 4, with joint springs and dampers.

q = (q1, q2): angles of the two links from the horizontal, rad. Massless links of lengths l (m), point
masses m (kg) at their ends, joint stiffness k (N m/rad) and damping c (N m s/rad), gravity g (m/s^2).
trigonometry: a module with `sin` and `cos`, jax.numpy or hhtjax.trigonometry.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial

import jax.numpy as jnp
import numpy as np

from hhtjax.description import Array, PyTree, Real
from hhtjax.scenes import drawings
from hhtjax.scenes.scene import EventScene, Scene, array
from hhtjax.systems.events import Event, impact
from hhtjax.systems.system import System

GRAVITY = 9.80665


def mass(q: Array, params: PyTree, trigonometry=jnp) -> Array:
    """M = [[l1^2 (m1 + m2), l1 l2 m2 cos(q1 - q2)], [., l2^2 m2]]."""
    (m1, m2), (l1, l2) = params["m"], params["l"]
    coupling = l1 * l2 * m2 * trigonometry.cos(q[0] - q[1])
    return jnp.array([[l1**2 * (m1 + m2), coupling], [coupling, l2**2 * m2]])


def weight_and_inertia(q: Array, v: Array, params: PyTree, trigonometry=jnp) -> Array:
    """Q without the joint torques."""
    (m1, m2), (l1, l2), g = params["m"], params["l"], params["g"]
    coupling = l1 * l2 * m2 * trigonometry.sin(q[0] - q[1])
    return jnp.array(
        [
            -l1 * (m1 + m2) * g * trigonometry.cos(q[0]) - coupling * v[1] ** 2,
            -l2 * m2 * g * trigonometry.cos(q[1]) + coupling * v[0] ** 2,
        ]
    )


def joint_torques(q: Array, v: Array, params: PyTree):
    """Torque of each joint's spring and damper, both at rest at q = 0."""
    (k1, k2), (c1, c2) = params["k"], params["c"]
    return -k1 * q[0] - c1 * v[0], -k2 * (q[1] - q[0]) - c2 * (v[1] - v[0])


def force_as_printed(q: Array, v: Array, t: Real, params: PyTree, trigonometry=jnp) -> Array:
    """Q as Kim et al. computed it: joint 2 acts on link 2 without a reaction on link 1."""
    return weight_and_inertia(q, v, params, trigonometry) + jnp.array(joint_torques(q, v, params))


def force(q: Array, v: Array, t: Real, params: PyTree, trigonometry=jnp) -> Array:
    """Q with the reaction of joint 2 on link 1."""
    first, second = joint_torques(q, v, params)
    return weight_and_inertia(q, v, params, trigonometry) + jnp.array([first - second, second])


@drawings.Drawing
def drawing(q, t, params: PyTree):
    """Both links."""
    links = [length * np.array([np.cos(angle), np.sin(angle)]) for length, angle in zip(params["l"], q, strict=True)]
    return [drawings.bar(np.zeros(2), links[0], links[0] + links[1])]


@cache  # the same system at each call, so that it is compiled once
def _using(trigonometry, function: Callable):
    return function if trigonometry is jnp else partial(function, trigonometry=trigonometry)


def free(trigonometry=jnp) -> Scene:
    """No springs and no dampers: a chaotic motion that conserves energy.

    Args:
        trigonometry: the module whose sin and cos it uses, such as `hhtjax.trigonometry`.
    """
    params = {"m": (1.0, 1.0), "l": (1.0, 1.5), "k": (0.0, 0.0), "c": (0.0, 0.0), "g": GRAVITY}
    system = System(_using(trigonometry, mass), _using(trigonometry, force))
    return Scene(system, params, array([0.0, 0.0]), array([0.0, 0.0]), 10.0, drawing)


def stiff(as_printed: bool = False, trigonometry=jnp) -> Scene:
    """Stiff joints. The second one has a damper of 10000 N m s/rad.

    Args:
        as_printed: True: the joint torques as the paper prints them, see `force_as_printed`.
        trigonometry: the module whose sin and cos it uses, such as `hhtjax.trigonometry`.
    """
    params = {"m": (10.0, 1.0), "l": (1.0, 1.5), "k": (400.0, 300.0), "c": (15.0, 10000.0), "g": GRAVITY}
    torques = force_as_printed if as_printed else force
    system = System(_using(trigonometry, mass), _using(trigonometry, torques))
    return Scene(system, params, array([0.0, 0.0]), array([0.0, 0.0]), 8.0, drawing)


def left_of_stop(q, v, t, params: PyTree):
    """The remaining angle of joint 2 before its stop, rad."""
    return params["stop"] - (q[1] - q[0])


def stopped(restitution: Real = 0.7) -> EventScene:
    """As `free`, with a stop at joint 2 like that of an elbow. The links hit it three times.

    Args:
        restitution: e of the stop, in [0, 1].

    >>> len(stopped(restitution=0.5).events)
    1
    """
    scene = free()
    params = scene.params | {"stop": 0.2, "e": restitution}
    events = (Event(left_of_stop, reset=impact("e")),)
    return EventScene(scene.system, params, scene.q0, scene.v0, 3.0, events, drawing)
