"""A manipulator arm: six rigid links on revolute joints, each with a spring and a damper. SI units.

q (N,): joint angles, rad; at q = 0 the frames of all links are parallel to that of the base. The params are those of
`hhtjax.bodies`: mass, com, inertia, damping, stiffness, springref, ...

There are two formulations of this model: `mechanism` uses `hhtjax.bodies`, and `lagrange` uses automatic
differentiation of L = T - V in the frames of the links.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.bodies import Body, Joint, Mechanism, tree
from hhtjax.checks import require_number
from hhtjax.description import Array, PyTree, Real
from hhtjax.rotation import cross, exp
from hhtjax.scenes import drawings
from hhtjax.scenes.scene import Scene
from hhtjax.systems.system import System

MASSES = 20.0, 12.0, 6.0, 4.0, 2.0, 1.5
RADII = (9, 9, 3), (1, 4, 4), (1, 2, 2), (0.3, 1.5, 1.5), (0.2, 0.3, 0.3), (0.2, 0.4, 0.4)  # of gyration^2, 0.01 m^2
AXES = "zyyxyx"  # base yaw, shoulder and elbow pitch, wrist roll, wrist pitch, tool roll
OFFSETS = (0, 0, 0), (0, 0, 0.4), (0.6, 0, 0), (0.2, 0, 0.05), (0.3, 0, 0), (0.1, 0, 0)  # from joint to joint
CENTRES = (0, 0, 0.2), (0.25, 0, 0), (0.08, 0, 0.02), (0.15, 0, 0), (0.05, 0, 0), (0.08, 0.02, 0.03)
STIFFNESS = 60.0, 150.0, 80.0, 200.0, 200.0, 30.0
DAMPING = 5.0, 8.0, 3.0, 20.0, 20.0, 3.0
REST = 0.0, -0.6, 0.9, 0.4, -0.5, 0.3
START = 0.8, -1.1, 1.5, 0.4, -0.5, 0.3


def mechanism(joints: int = 6) -> Mechanism:
    """The arm, or its first few joints, with its frames "link1", "link2", ..."""
    bodies = []
    for i in range(joints):
        joint = Joint(
            "revolute", np.eye(3)["xyz".index(AXES[i])],
            name=f"joint{i + 1}", stiffness=STIFFNESS[i], damping=DAMPING[i], rest=REST[i],
        )  # fmt: skip
        inertia = 0.01 * MASSES[i] * np.array(RADII[i])
        parent = f"link{i}" if i else "world"
        bodies.append(Body(f"link{i + 1}", parent, joint, MASSES[i], CENTRES[i], inertia, OFFSETS[i]))
    return tree(bodies)


@dataclass(frozen=True)
class Lagrangian:
    """L of a chain: the sum of m u.u/2 + Om.(I Om)/2 + m g.x over the links; x and u: position and velocity of the
    centre of mass.

    Attributes:
        axes: unit vectors of the joints, (N, 3), as nested tuples.
        offsets: position of joint i in the frame of joint i - 1, (N, 3), m, as nested tuples.
    """

    axes: tuple
    offsets: tuple

    def __call__(self, q: Array, v: Array, t: Real, params: PyTree) -> Array:
        def add_link(before: tuple, link: tuple):
            Om, u, g, gx, L = before  # in the frame of the link before; u and gx = g.x of its joint
            q, v, axis, offset, mass, com, inertia = link
            R = exp(q * axis).T
            u, gx, g = R @ (u + cross(Om, offset)), gx + g @ offset, R @ g
            Om = R @ Om + axis * v
            u_com = u + cross(Om, com)
            T = (mass * u_com @ u_com + Om @ inertia @ Om) / 2
            return (Om, u, g, gx, L + T + mass * (gx + g @ com)), None

        zero = jnp.zeros(3, q.dtype)
        base = zero, zero, params["gravity"], zero[0], zero[0]
        geometry = (np.asarray(x, q.dtype) for x in (self.axes, self.offsets))
        links = q, v, *geometry, params["mass"], params["com"], params["inertia"]
        return lax.scan(add_link, base, links)[0][-1]


def joint_torques(q: Array, v: Array, t: Real, params: PyTree) -> Array:
    """-k (q - rest) - c v. Angles are relative, so the reactions on the previous links need no terms."""
    return -params["stiffness"] * (q - params["springref"]) - params["damping"] * v


def lagrange(joints: int = 6) -> System:
    """The arm as a system made from its Lagrangian, with the same params."""
    axes = tuple(tuple(np.eye(3)["xyz".index(axis)].tolist()) for axis in AXES[:joints])
    return System.from_lagrangian(Lagrangian(axes, OFFSETS[:joints]), joint_torques)


def swing(joints: int = 6) -> Scene:
    """A six-axis arm of 45 kg and 1.2 m, let go from a bent pose; or only its first few joints.

    Base yaw, shoulder pitch and elbow pitch have soft springs. Wrist roll, wrist pitch and tool roll have stiff springs
    and strong dampers. The time scales range from 1 ms to 2 s.

    Args:
        joints: number of joints, 1 to 6.

    Raises:
        TypeError, ValueError: joints is not an integer from 1 to 6.
    """
    joints = int(require_number("swing", "joints", joints, lambda n: n in range(1, 7), "be 1, 2, ... 6"))
    arm = mechanism(joints)
    return Scene(arm.system, arm.params, arm.q0 + np.array(START[:joints]), arm.v0, 2.0, drawings.of_mechanism(arm))
