"""From the description of a mechanism to what its equations need: a tree of joints, and arrays of parameters.

What is part of the program, because it is known when that is written: which joint hangs on which, axes, places, which
motor drives what. What is data, in params: masses, springs, gears, gravity.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from hhtjax.bodies.description import WORLD, Body, Joint, tidy
from hhtjax.bodies.tree import Node, Tree, skew


class Place(NamedTuple):
    """A frame fixed to a node (-1: the world): rotation (9 numbers) and place (3) there. Of a body or a marker."""

    name: str
    node: int
    rotation: tuple
    point: tuple

    @property
    def R(self) -> np.ndarray:
        """(3, 3)."""
        return np.reshape(self.rotation, (3, 3))


class Drive(NamedTuple):
    """A motor: the slot of its joint, and what its formula has. Clipped are u and F, where a range is given."""

    slot: int
    kind: str
    ctrlrange: tuple | None
    forcerange: tuple | None


class Spring(NamedTuple):
    """Of a ball, or of both halves of a free joint: slots, rates, and the orientation and place of rest."""

    ball: int
    translation: int | None
    R: tuple
    x: tuple


class Stop(NamedTuple):
    """An end of the range of a joint: side -1 below, 1 above."""

    slot: int
    side: int
    at: float


class Row(NamedTuple):
    """A loop: kind, and numbers of frames (or slots) and constants."""

    kind: str
    first: Any
    second: Any
    constants: tuple


class Model(NamedTuple):
    """All that is part of the program."""

    tree: Tree
    bodies: tuple[Place, ...]  # those that carry mass, as in params
    places: tuple[Place, ...]  # of all bodies and markers
    drives: tuple[Drive, ...]
    springs: tuple[Spring, ...]
    stops: tuple[Stop, ...]
    loops: tuple[Row, ...]
    rows: tuple | None  # which rows of the loops are kept, None for all
    roots: tuple  # of each node: the slot of the translation that its tree begins with, or -1
    offsets: tuple | None  # the affine maps from positions of bodies to those of nodes and places, where they are free
    parents: tuple  # of each place: the number of the one that it hangs on, 0 the world, -1 for the world itself


class Structure(NamedTuple):
    """What is made of bodies: the model's tree, and how names and numbers belong together."""

    nodes: list[Node]
    node_of: dict[str, int]  # body -> node, -1
    frame_of: dict[str, tuple[np.ndarray, np.ndarray]]  # body -> its frame in that node
    joints: dict[str, tuple[Joint, tuple]]  # name -> joint, rates
    slots: dict[str, int]  # name of a joint of one rate -> slot


def structure(caller: str, bodies: list[Body]) -> Structure:
    """The nodes of bodies, in their order; errors for names that are taken twice, or not known yet."""
    counts = _counts(bodies)
    next_slot = {"scalar": 0, "ball": 0, "free": 0}
    node_of, frame_of = {WORLD: -1}, {WORLD: (np.eye(3), np.zeros(3))}
    nodes: list[Node] = []
    joints: dict[str, tuple[Joint, tuple]] = {}
    slots: dict[str, int] = {}

    def rates(kind: str, slot: int) -> tuple:
        first = {"ball": 3 * slot, "free": 3 * (counts["balls"] + slot), "scalar": counts["turning"] + slot}[kind]
        return tuple(range(first, first + (1 if kind == "scalar" else 3)))

    def add(kind: str, parent: int, E, offset, axis=(0.0, 0.0, 1.0)) -> int:
        sort = {"hinge": "scalar", "slide": "scalar", "translation": "free"}.get(kind, "ball")
        slot = next_slot[sort]
        next_slot[sort] += 1
        of_rates = rates(sort, slot) if sort != "ball" else rates("ball", slot)
        nodes.append(Node(parent, kind, _numbers(E), _numbers(offset), _numbers(axis), slot, of_rates))
        return len(nodes) - 1

    free_ball = counts["balls"] - counts["frees"]  # balls of free joints come behind the others
    for body in bodies:
        if body.name in node_of:
            raise ValueError(f"{caller}: two bodies are named {body.name!r}.")
        if body.parent not in node_of:
            raise ValueError(f"{caller}: {body.name!r} hangs on {body.parent!r}, which is no body before it.")
        node, (R, x) = node_of[body.parent], frame_of[body.parent]
        E, x = R @ np.reshape(body.rotation, (3, 3)), x + R @ np.asarray(body.position)
        last = np.zeros(3)  # what of the body's frame the last anchor is
        for number, joint in enumerate(body.joints):
            name = joint.name or (body.name if number == 0 else f"{body.name}_{number + 1}")
            if name in joints:
                raise ValueError(f"{caller}: two joints are named {name!r}.")
            if joint.kind == "free":
                node = add("translation", -1, np.eye(3), np.zeros(3))
                slot = free_ball
                free_ball += 1
                first = 3 * slot
                nodes.append(
                    Node(
                        node,
                        "ball",
                        _numbers(np.eye(3)),
                        (0.0, 0.0, 0.0),
                        (0.0, 0.0, 1.0),
                        slot,
                        tuple(range(first, first + 3)),
                    )
                )
                joints[name] = joint, (*nodes[-1].rates, *nodes[-2].rates)
                node, E, x = len(nodes) - 1, np.eye(3), np.zeros(3)
                continue
            anchor = np.asarray(joint.anchor)
            x = x + E @ (anchor - last)
            before = len(nodes)
            for kind, axis in _simple(joint):
                if kind != "ball" and joint.reference:
                    E, x = _before(kind, E, x, axis, joint.reference)
                node = add(kind, node, E, x, axis)
                E, x = np.eye(3), np.zeros(3)
            last = anchor
            own = nodes[before:]
            joints[name] = joint, tuple(i for one in own for i in one.rates)
            if len(own) == 1 and own[0].kind != "ball":
                slots[name] = own[0].slot
        node_of[body.name], frame_of[body.name] = node, (E, x - E @ last if body.joints else x)
    return Structure(nodes, node_of, frame_of, joints, slots)


def _counts(bodies: list[Body]) -> dict:
    """How many balls there are, those of free joints among them, and rates that do not belong to hinges and slides."""
    kinds = [joint.kind for body in bodies for joint in body.joints]
    frees = kinds.count("free")
    balls = kinds.count("ball") + frees
    return {"balls": balls, "frees": frees, "turning": 3 * (balls + frees)}


def _simple(joint: Joint):
    """The joints of one kind that it consists of."""
    axis = np.asarray(joint.axis)
    if joint.kind == "planar":
        first, second = in_plane(axis)
        return [("slide", first), ("slide", second), ("hinge", axis)]
    return [({"revolute": "hinge", "prismatic": "slide", "ball": "ball"}[joint.kind], axis)]


def in_plane(axis: np.ndarray):
    """The images of x and y under the shortest turn from z to a unit vector."""
    a, b, c = axis
    if c < -1 + 1e-12:
        return np.array([1.0, 0.0, 0.0]), np.array([0.0, -1.0, 0.0])
    k = 1 / (1 + c)
    return tidy(np.array([1 - k * a * a, -k * a * b, -a])), tidy(np.array([-k * a * b, 1 - k * b * b, -b]))


def _before(kind: str, E, x, axis, reference: float):
    """The frame of a joint whose coordinate is `reference` where it is drawn."""
    if kind == "slide":
        return E, x - reference * (E @ axis)
    K = skew(axis)
    return tidy(E @ (np.eye(3) - np.sin(reference) * K + (1 - np.cos(reference)) * K @ K)), x


def _numbers(x) -> Any:
    return tuple(tidy(np.asarray(x, float)).ravel().tolist())
