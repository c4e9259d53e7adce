"""A four-bar of three flexible links: aluminium strips 20 mm wide and 3 mm thick, pinned to each other; SI units.

The crank's first node is told how to turn: to a speed within a second, then on. The rocker's last node stays in its
place. Between the links pins are constraints (GGL, on positions and velocities).
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.flexible.models import Model, at_rest
from hhtjax import elements

CRANK, COUPLER, ROCKER, GROUND = 0.25, 1.0, 0.75, 1.0  # m
SPEED, STARTING, DURATION = 15.0, 1.0, 2.0  # rad/s, s, s
WIDE, THICK, E, RHO = 0.02, 0.003, 70e9, 2700.0
SECTION = {
    "EA": E * WIDE * THICK,
    "GA": 5 / 6 * E / 2.66 * WIDE * THICK,
    "EI": E * WIDE * THICK**3 / 12,
    "rhoA": RHO * WIDE * THICK,
    "rhoI": RHO * WIDE * THICK**3 / 12,
}
STIFF = {name: SECTION[name] for name in ("EA", "GA", "EI")}


def crank_angle(t: Any, params: Any) -> Any:
    """From rest to params["speed"] within STARTING."""
    turn = 2 * np.pi / STARTING
    starting = params["speed"] / STARTING * (t**2 / 2 + (jnp.cos(turn * t) - 1) / turn**2)
    return jnp.where(t < STARTING, starting, params["speed"] * (t - STARTING / 2))


def corners() -> np.ndarray:
    """The four pins at first, with the crank along x, (4, 2)."""
    a, d = np.array([CRANK, 0.0]), np.array([GROUND, 0.0])
    along = (COUPLER**2 - ROCKER**2 + (GROUND - CRANK) ** 2) / (2 * (GROUND - CRANK))
    return np.array([[0.0, 0.0], a, a + np.array([along, np.sqrt(COUPLER**2 - along**2)]), d])


def four_bar(number: int) -> Model:
    """With so many elements in each link. Nodes: those of the crank, of the coupler, of the rocker."""
    pins, nodes = corners(), number + 1
    pairs = np.concatenate([k * nodes + np.arange(number)[:, None] + [0, 1] for k in range(3)])
    lengths = np.repeat([CRANK, COUPLER, ROCKER], number) / number

    def section(params: Any) -> dict:
        return {"L": lengths, "damping": params["damping"]} | STIFF

    mass = elements.planar_lumped_mass(
        jnp.asarray(pairs), {"L": lengths, "rhoA": SECTION["rhoA"], "rhoI": SECTION["rhoI"]}, 3 * nodes
    )
    system = hhtjax.System.from_elements(
        hhtjax.Elements(elements.planar_beam, pairs, each=section),
        hhtjax.Joints(elements.pin, [[number, nodes], [nodes + number, 2 * nodes]]),
        mass=mass,
        held={
            0: lambda t, params: {"r": jnp.zeros(2), "theta": crank_angle(t, params)},
            3 * nodes - 1: {"r": True},
        },
    )
    s = np.linspace(0.0, 1.0, nodes)[:, None]
    ways = np.diff(pins, axis=0)
    r = np.concatenate([a + s * way for a, way in zip(pins[:-1], ways, strict=True)])
    theta = np.repeat(np.arctan2(ways[:, 1], ways[:, 0]), nodes)
    q0 = {"r": jnp.asarray(r), "theta": jnp.asarray(theta)}
    return Model(system, q0, at_rest(q0), {"speed": SPEED, "damping": 1e-3}, 9 * nodes - 5)


def deflection(r: np.ndarray, link: int, number: int) -> np.ndarray:
    """How far the middle of a link is from the line through its ends, m; r: (..., nodes, 2)."""
    first, nodes = link * (number + 1), number + 1
    a, b, middle = r[..., first, :], r[..., first + nodes - 1, :], r[..., first + number // 2, :]
    along = b - a
    across = np.stack([-along[..., 1], along[..., 0]], axis=-1) / np.linalg.norm(along, axis=-1, keepdims=True)
    return np.sum((middle - a) * across, axis=-1)


def run(number: int, dt: float, duration: float = DURATION, sample: float = 0.01, **options: Any) -> Any:
    """A run, sampled."""
    model, every = four_bar(number), round(sample / dt)
    stepper = hhtjax.hht(linearize="predictor", **options)
    steps = round(duration / dt)
    found = hhtjax.simulate(
        model.system, stepper, model.q0, model.v0, model.params, dt=dt, num_steps=steps, save_every=every
    )
    found.check()
    return found
