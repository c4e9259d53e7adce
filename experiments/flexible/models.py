"""Scenes of many elements, for a size: the system, and where it starts. SI units.

The beam is that of `beam.py`, by `hhtjax.elements`. Links are rigid rods of 1 m and 1 kg, one pinned to the next.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.flexible import beam as plain
from hhtjax import elements
from hhtjax.description import PyTree

GRAVITY = 9.81


class Model(NamedTuple):
    """A system, where it starts, its parameters, and the number of unknowns that are free."""

    system: Any
    q0: PyTree
    v0: PyTree
    params: dict
    unknowns: int


def chain_of(nodes: int) -> np.ndarray:
    """Pairs of neighbours, (nodes - 1, 2)."""
    return np.arange(nodes - 1)[:, None] + [0, 1]


def at_rest(q0: PyTree) -> PyTree:
    """Zeros, for positions that are no rotations."""
    return jax.tree.map(jnp.zeros_like, q0)


def beam(described: plain.Beam, damping: bool = False, consistent: bool = False) -> Model:
    """The planar beam. Of its stiffness, and the damping of its material if asked for, params tell."""
    E, m, places = described.elements, plain.masses(described), plain.straight(described)
    length = described.length / E

    def section(params: PyTree) -> dict:
        known = {name: params[name] for name in ("EA", "GA", "EI", *["damping"] * damping)}
        return {"L": length} | known

    parts = [hhtjax.Elements(elements.planar_beam, chain_of(E + 1), each=section)]
    if described.gravity:
        each = {"m": m[:, 0]}
        parts.append(hhtjax.Elements(elements.gravity, np.arange(E + 1)[:, None], each=each))
    mass: Any = {"r": m[:, :2], "theta": m[:, 2]}
    if consistent:
        each = {"L": length, "rhoA": described.rhoA, "rhoI": described.rhoI}
        mass = hhtjax.Elements(elements.planar_mass, chain_of(E + 1), each=each)
    system = hhtjax.System.from_elements(*parts, mass=mass, held={0: hold(described)})
    q0 = {"r": jnp.asarray(places[:, :2]), "theta": jnp.asarray(places[:, 2])}
    params = {"EA": described.EA, "GA": described.GA, "EI": described.EI} | ({"damping": 0.0} if damping else {})
    if described.gravity:
        params |= {"gravity": jnp.array([0.0, -described.gravity])}
    return Model(system, q0, at_rest(q0), params, described.unknowns)


def hold(described: plain.Beam) -> Any:
    """What the first node does."""
    if described.hub is None:
        return {"r": True}
    if described.hub == "clamped":
        return True
    return lambda t, params: {"r": jnp.zeros(2), "theta": plain.hub_angle(described, t)}


def hardening(q: PyTree, v: PyTree, t: Any, params: PyTree) -> PyTree:
    """A spring between two nodes on a line: k (x + x^3)."""
    x = q[1] - q[0]
    pull = params["k"] * (x + x**3)
    return jnp.stack([pull, -pull])


def spring_chain(n: int) -> Model:
    """n masses in line, hardening springs between them, the first one held; one unknown each."""
    system = hhtjax.System.from_elements(
        hhtjax.Elements(hardening, chain_of(n + 1)), mass=jnp.ones(n + 1), held={0: True}
    )
    q0 = 0.5 * jnp.sin(jnp.linspace(0.0, 20.0, n + 1))
    return Model(system, q0, at_rest(q0), {"k": 100.0}, n)


def plain_chain(n: int) -> Model:
    """The same as one function of all masses."""

    def force(q: Any, v: Any, t: Any, params: PyTree) -> Any:
        x = jnp.diff(q, prepend=0.0)
        pull = params["k"] * (x + x**3)
        return jnp.append(pull[1:], 0.0) - pull

    q0 = 0.5 * jnp.sin(jnp.linspace(0.0, 20.0, n + 1))[1:]
    return Model(hhtjax.System(jnp.ones(n), force), q0, 0 * q0, {"k": 100.0}, n)


def grid_pairs(side: int) -> np.ndarray:
    """Neighbours in a square of side x side nodes: along both sides, and along both diagonals."""
    number = np.arange(side * side).reshape(side, side)
    pairs = [
        (number[:-1], number[1:]),
        (number[:, :-1], number[:, 1:]),
        (number[:-1, :-1], number[1:, 1:]),
        (number[1:, :-1], number[:-1, 1:]),
    ]
    return np.concatenate([np.stack([a.ravel(), b.ravel()], axis=1) for a, b in pairs])


def lattice(side: int, struck: float = 20.0) -> Model:
    """A free square of nodes, 1 kg each and 1 m apart, held together by springs; a corner starts at a speed, m/s."""
    pairs = grid_pairs(side)
    y, x = np.divmod(np.arange(side * side), side)
    r = np.stack([x, y], axis=1).astype(float)
    each = {"L": np.linalg.norm(r[pairs[:, 1]] - r[pairs[:, 0]], axis=1)}
    springs = hhtjax.Elements(elements.spring_damper, pairs, each=lambda params: {**each, "k": params["k"]})
    system = hhtjax.System.from_elements(springs, mass={"r": 1.0})
    v0 = jnp.zeros((side * side, 2)).at[0].set(struck / np.sqrt(2))
    return Model(system, {"r": jnp.asarray(r)}, {"r": v0}, {"k": 1e4}, 2 * side * side)


def links(number: int) -> Model:
    """Rods in the plane, in a chain that hangs from the ground and starts stretched out: 3 unknowns and 2 rows each."""
    i = np.arange(number)[:, None]
    ends = {"a": np.array([0.5, 0.0]), "b": np.array([-0.5, 0.0])}
    pins = each_pin(ends, number, np.zeros(2))
    system = hhtjax.System.from_elements(
        hhtjax.Elements(elements.gravity, i, each={"m": 1.0}), *pins, mass={"r": 1.0, "theta": 1 / 12}
    )
    q0 = {"r": jnp.asarray(np.stack([np.arange(number) + 0.5, np.zeros(number)], axis=1)), "theta": jnp.zeros(number)}
    params = {"gravity": jnp.array([0.0, -GRAVITY])}
    return Model(system, q0, at_rest(q0), params, 3 * number)


def rods_in_space(number: int) -> Model:
    """Rods in space in a chain of ball joints, each turning about itself: 6 unknowns and 3 rows each."""
    i, J = np.arange(number)[:, None], np.array([0.01, 1 / 12, 1 / 12])
    ends = {"a": np.array([0.5, 0.0, 0.0]), "b": np.array([-0.5, 0.0, 0.0])}
    system = hhtjax.System.from_elements(
        hhtjax.Elements(elements.gravity, i, each={"m": 1.0}),
        hhtjax.Elements(elements.gyroscopic, i, each={"J": np.tile(J, (number, 1))}),
        *each_pin(ends, number, np.zeros(3)),
        mass={"r": 1.0, "R": np.tile(J, (number, 1))},
    )
    r = jnp.zeros((number, 3)).at[:, 0].set(np.arange(number) + 0.5)
    v0 = {"r": jnp.zeros((number, 3)), "R": jnp.zeros((number, 3)).at[:, 0].set(1.0)}
    params = {"gravity": jnp.array([0.0, 0.0, -GRAVITY])}
    return Model(system, {"r": r, "R": jnp.tile(jnp.eye(3), (number, 1, 1))}, v0, params, 6 * number)


def each_pin(ends: dict, number: int, origin: np.ndarray) -> list:
    """The pin of the first rod on the ground, and those between rods."""
    held = {"a": ends["b"][None], "b": origin[None]}
    found = [hhtjax.Joints(elements.pin, [[0]], each=held)]
    if number > 1:
        between = {name: np.tile(x, (number - 1, 1)) for name, x in ends.items()}
        found.append(hhtjax.Joints(elements.pin, chain_of(number), each=between))
    return found


def cable(described: plain.Beam) -> Model:
    """A thin cable of ANCF elements with consistent masses, which starts straight from a pin: 4 unknowns a node."""
    E = described.elements
    pairs, L = chain_of(E + 1), described.length / E
    section = {"L": L, "EA": described.EA, "EI": described.EI}
    each = {"L": L, "rhoA": described.rhoA}
    parts = [
        hhtjax.Elements(elements.ancf_cable, pairs, each=section),
        hhtjax.Elements(elements.gravity, pairs, each={"L": L, "m": L * described.rhoA}),
    ]
    mass = hhtjax.Elements(elements.ancf_mass, pairs, each=each)
    system = hhtjax.System.from_elements(*parts, mass=mass, held={0: {"r": True}})
    x = np.linspace(0.0, described.length, E + 1)
    q0 = {"r": jnp.stack([x, 0 * x], axis=1), "slope": jnp.stack([0 * x + 1, 0 * x], axis=1)}
    return Model(system, q0, at_rest(q0), {"gravity": jnp.array([0.0, -described.gravity])}, 4 * (E + 1) - 2)
