"""Structures at rest, found as a user would: a strongly damped run, in which the load grows and the motion dies away.

`hhtjax.implicit_euler(iterations=1)` takes out what vibrates. Masses set how fast it settles, and not where.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.flexible.models import Model, at_rest, chain_of
from hhtjax import elements

RAMP, SETTLED, DT = 1.0, 1.5, 0.01  # s
ELASTICA = (-0.5085373043260, -1.2072398545499)  # m: Euler's elastica that stretches, a boundary value problem;
# exudyn's Examples/ANCFcantileverTest.py has -.508537304326, -1.207239854550
PRINCETON = (-0.008837226265, 0.108987937)  # m: y and z of the tip; ANSYS, Obrezkov et al., Nonlinear Dyn. 109 (2022)


def grown(load: dict) -> Any:
    """The force of one node that grows to a load within RAMP."""

    def force(q: Any, v: Any, t: Any, params: Any) -> dict:
        return {name: jnp.asarray(x)[None] * jnp.minimum(t / RAMP, 1.0) for name, x in load.items()}

    return force


def settled(model: Model) -> tuple[dict, float]:
    """The position at the end, and the largest velocity that is left."""
    steps = round(SETTLED / DT)
    stepper = hhtjax.implicit_euler(iterations=1)
    run = hhtjax.simulate(
        model.system, stepper, model.q0, model.v0, model.params, dt=DT, num_steps=steps, save_every=steps
    )
    run.check()
    left = max(float(jnp.max(jnp.abs(x[-1]))) for x in jax.tree.leaves(run.v))
    return jax.tree.map(lambda x: np.asarray(x[-1]), run.q), left


def cantilever(number: int) -> Model:
    """A thin cantilever of ANCF elements, 2 m long and .1 m thick, under 3 EI/L^2 at its end."""
    EI, L = 2.07e11 * 0.1**4 / 12, 2.0 / number
    each, pairs = {"L": L, "EA": 2.07e9, "EI": EI}, chain_of(number + 1)
    mass = hhtjax.Elements(elements.ancf_mass, pairs, each={"L": L, "rhoA": 78.0})
    system = hhtjax.System.from_elements(
        hhtjax.Elements(elements.ancf_cable, pairs, each=each),
        hhtjax.Elements(grown({"r": np.array([0.0, -3 * EI / 4])}), [[number]]),
        mass=mass,
        held={0: {"r": True, "slope": np.array([False, True])}},
    )
    x = np.linspace(0.0, 2.0, number + 1)
    q0 = {"r": jnp.stack([x, 0 * x], axis=1), "slope": jnp.stack([0 * x + 1, 0 * x], axis=1)}
    return Model(system, q0, at_rest(q0), {}, 4 * number + 1)


def princeton(number: int) -> Model:
    """The Princeton beam (Dowell, Traybar 1975): aluminium, 508 by 12.3777 by 3.2024 mm, 8.896 N at 45 degrees."""
    h, w, E, nu, length = 12.3777e-3, 3.2024e-3, 71.7e9, 0.31, 0.508
    GA, pairs = E * h * w / (2 * (1 + nu)), chain_of(number + 1)
    each = {"EA": E * h * w, "GAy": GA, "GAz": GA, "GJ": 3.103, "EIy": E * h * w**3 / 12, "EIz": E * w * h**3 / 12}
    inertia = {"L": length / number, "rhoA": 0.11, "rhoIy": 1e-6, "rhoIz": 1e-6}
    system = hhtjax.System.from_elements(
        hhtjax.Elements(elements.spatial_beam, pairs, each=each | {"L": length / number}),
        hhtjax.Elements(grown({"r": 8.896 * np.array([0.0, -1.0, 1.0]) / np.sqrt(2)}), [[number]]),
        mass=elements.spatial_lumped_mass(jnp.asarray(pairs), inertia, number + 1),
        held={0: True},
    )
    r = jnp.zeros((number + 1, 3)).at[:, 0].set(jnp.linspace(0.0, length, number + 1))
    q0 = {"r": r, "R": jnp.tile(jnp.eye(3), (number + 1, 1, 1))}
    return Model(system, q0, {"r": 0 * r, "R": 0 * r}, {}, 6 * number)


def elastica(fast: bool) -> tuple[list[dict], dict]:
    """The tip's way, for several numbers of elements, and the last shape."""
    rows, q = [], {}
    for number in (8,) if fast else (32, 64, 128):
        q, left = settled(cantilever(number))
        tip = q["r"][-1] - [2.0, 0.0]
        error = float(np.max(np.abs(tip - ELASTICA)))
        rows.append({"elements": number, "unknowns": 4 * number + 1, "tip_m": tip.tolist(), "error_m": error})
        rows[-1]["speed_left_m_per_s"] = left
    return rows, q


def bent_in_space() -> list[dict]:
    """The tip's way of the Princeton beam, and its distance from that by ANSYS over this."""
    rows = []
    for number in (16, 32):
        q, left = settled(princeton(number))
        tip = q["r"][-1, 1:]
        error = np.linalg.norm(tip - PRINCETON) / np.linalg.norm(PRINCETON)
        rows.append({"elements": number, "unknowns": 6 * number, "tip_m": tip.tolist(), "relative_error": float(error)})
        rows[-1]["speed_left_m_per_s"] = left
    return rows
