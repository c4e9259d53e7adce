"""A planar exact beam: two-node elements of Reissner's theory, strains in their middle, masses lumped at the nodes.

Nodes carry x, y (m) and theta (rad). Along an element of length l, theta is the mean of its nodes and r' = (r2 - r1)/l:

    (1 + stretch, shear) = R(theta)^T r',    curvature = (theta2 - theta1)/l

The spin-up is that of Simo, Vu-Quoc (1986), J. Appl. Mech. 53, 849-854: its beam, and a hub brought to 6 rad/s in 15 s.
"""

from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

import hhtjax

SPEED, SECONDS = 6.0, 15.0  # of the hub of the spin-up, rad/s and s
STRETCH = 5.1429e-4  # m, of the beam that turns at SPEED
LARGEST_LAG = -0.5739, 6.75  # m and s: of the tip across the hub's direction, with 64 elements


class Beam(NamedTuple):
    """A straight beam along x from the origin, at rest.

    Attributes:
        elements: their number.
        length: m.
        EA, GA, EI: stiffness in stretch, shear, N, and bending, N m^2.
        rhoA, rhoI: mass, kg/m, and rotary inertia, kg m, per length.
        gravity: along -y, m/s^2.
        hub: what the first node's angle is: None for a pin; 0 at all times, "clamped"; or that of the spin-up, "spun".
    """

    elements: int
    length: float = 10.0
    EA: float = 2.8e7
    GA: float = 1e7
    EI: float = 1.4e4
    rhoA: float = 1.2
    rhoI: float = 6e-4
    gravity: float = 0.0
    hub: str | None = "spun"

    @property
    def held(self) -> int:
        """How many of the first node's three unknowns are given."""
        return 2 if self.hub is None else 3

    @property
    def unknowns(self) -> int:
        return 3 * (self.elements + 1) - self.held


def pendulum(elements: int) -> Beam:
    """It falls from the horizontal about a pin."""
    return Beam(elements, gravity=9.81, hub=None)


def hub_angle(beam: Beam, t, numpy=jnp):
    """Angle of a hub that holds the first node, rad; numpy: the module that computes it."""
    if beam.hub != "spun":
        return 0.0 * t
    round_once = 2 * np.pi / SECONDS
    starting = SPEED / SECONDS * (t**2 / 2 + (numpy.cos(round_once * t) - 1) / round_once**2)
    return numpy.where(t < SECONDS, starting, SPEED * (t - SECONDS / 2))


def in_hub(beam: Beam, tip, times):
    """The tip's place in the turning frame of the hub: across, its lag, and along, less the length; m."""
    angle = hub_angle(beam, times, np)
    c, s, (x, y) = np.cos(angle), np.sin(angle), tip[:, :2].T
    return c * y - s * x, c * x + s * y - beam.length


def masses(beam: Beam):
    """Of the nodes, (nodes, 3)."""
    shares = np.ones(beam.elements + 1)
    shares[[0, -1]] = 0.5
    return beam.length / beam.elements * shares[:, None] * np.array([beam.rhoA, beam.rhoA, beam.rhoI])


def straight(beam: Beam):
    """Positions of the nodes at first, (nodes, 3)."""
    q = np.zeros((beam.elements + 1, 3))
    q[:, 0] = np.linspace(0.0, beam.length, beam.elements + 1)
    return q


def elastic_force(q, beam: Beam):
    """On the nodes, from their positions; both (nodes, 3)."""
    length = beam.length / beam.elements
    (dx, dy, turn), theta = jnp.diff(q, axis=0).T / length, (q[1:, 2] + q[:-1, 2]) / 2
    s, c = jnp.sin(theta), jnp.cos(theta)
    stretched, shear = c * dx + s * dy, c * dy - s * dx
    N, V = beam.EA * (stretched - 1), beam.GA * shear
    nx, ny, bend = c * N - s * V, s * N + c * V, beam.EI * turn
    moment = (N * shear - V * stretched) * length / 2
    first, second = jnp.stack([nx, ny, bend - moment], axis=1), jnp.stack([nx, ny, bend + moment], axis=1)
    return jnp.pad(first, ((0, 1), (0, 0))) - jnp.pad(second, ((1, 0), (0, 0)))


def force(q, v, t, params, beam: Beam):
    """On the unknowns, (unknowns,); params: what replaces properties of the beam."""
    beam = beam._replace(**params)
    given = jnp.zeros(3).at[2].set(hub_angle(beam, t))[: beam.held]
    nodes = jnp.concatenate([given, q]).reshape(-1, 3)
    weight = beam.gravity * masses(beam)[:, :2] * np.array([0.0, 1.0])
    Q = elastic_force(nodes, beam) - jnp.pad(weight, ((0, 0), (0, 1)))
    return Q.ravel()[beam.held :]


def scene(beam: Beam):
    """System, and positions and velocities of the unknowns at first."""
    mass = jnp.asarray(masses(beam).ravel()[beam.held :])
    q0 = jnp.asarray(straight(beam).ravel()[beam.held :])
    return hhtjax.System(mass, partial(force, beam=beam)), q0, jnp.zeros_like(q0)
