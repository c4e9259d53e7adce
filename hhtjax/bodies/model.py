"""Converts the description of a mechanism to the data of its equations: a tree of joints, and arrays of parameters.

Part of the program, because it is known when the program is made: the tree of joints, axes, positions, and which motor
drives which joint. Data, in params: masses, springs, gears, gravity.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from hhtjax.bodies.description import WORLD, Body, Joint, tidy
from hhtjax.bodies.tree import Node, Tree, skew


class Place(NamedTuple):
    """The frame of a body or a marker, fixed to a node (-1: the world): rotation (9 numbers) and position (3) in the
    node."""

    name: str
    node: int
    rotation: tuple
    point: tuple

    @property
    def R(self) -> np.ndarray:
        """(3, 3)."""
        return np.reshape(self.rotation, (3, 3))


class Drive(NamedTuple):
    """A motor: the slot of its joint, and the data of its formula. u, F and z are clipped if they have a range."""

    slot: int
    kind: str
    ctrlrange: tuple | None
    forcerange: tuple | None
    activation: str | None
    actrange: tuple | None


class Spring(NamedTuple):
    """A spring of a ball, or of both halves of a free joint: slots, rates, and the relaxed orientation and position."""

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
    """A loop: its kind, indices of frames (or slots), and constants."""

    kind: str
    first: Any
    second: Any
    constants: tuple


class _Fields(NamedTuple):
    """The fields of a `Model`."""

    tree: Tree
    bodies: tuple[Place, ...]  # those that carry mass, as in params
    places: tuple[Place, ...]  # of all bodies and markers
    drives: tuple[Drive, ...]
    springs: tuple[Spring, ...]
    rubbing: tuple  # numbers of the rates with dry friction
    stops: tuple[Stop, ...]
    loops: tuple[Row, ...]
    rows: tuple | None  # which rows of the loops are kept, None for all
    roots: tuple  # of each node: the slot of the translation that its tree begins with, or -1
    offsets: tuple | None  # the affine maps from positions of bodies to those of nodes and places, where they are free
    parents: tuple  # of each place: the number of the one that it hangs on, 0 the world, -1 for the world itself


class Model(_Fields):
    """Everything about a mechanism that is part of the program."""

    def __hash__(self):
        return self._hash

    @cached_property
    def _hash(self) -> int:
        """The hash, computed once: a run needs it often, and it takes time proportional to the size of the model."""
        return tuple.__hash__(self)

    @property
    def activated(self) -> tuple[int, ...]:
        """Indices of the motors with an internal state."""
        return tuple(i for i, drive in enumerate(self.drives) if drive.activation)


class Made(NamedTuple):
    """A joint of a description, and the nodes made from it."""

    joint: Joint
    body: Body
    nodes: tuple[Node, ...]  # of a free joint: the ball, then the translation, as rates are ordered

    @property
    def rates(self) -> tuple:
        """Its indices in the vector of rates."""
        return tuple(i for node in self.nodes for i in node.rates)


class Structure(NamedTuple):
    """The tree made from bodies, and the maps between names and indices."""

    nodes: list[Node]
    node_of: dict[str, int]  # body -> node, -1
    frame_of: dict[str, tuple[np.ndarray, np.ndarray]]  # body -> its frame in that node
    joints: dict[str, Made]  # by name

    @property
    def slots(self) -> dict[str, int]:
        """Name of a joint of one rate -> slot."""
        return {name: made.nodes[0].slot for name, made in self.joints.items() if len(made.rates) == 1}


def structure(caller: str, bodies: list[Body]) -> Structure:
    """The nodes of bodies, in their order; raises errors for names that are used twice, or not known yet."""
    kinds = [joint.kind for body in bodies for joint in body.joints]
    plain_balls, frees = kinds.count("ball"), kinds.count("free")
    turning = 3 * (plain_balls + frees)  # rates of balls, those of free joints among them: they come first
    next_slot = {"scalar": 0, "ball": 0, "free ball": plain_balls, "translation": 0}
    first_rate = {"scalar": turning + 3 * frees, "ball": 0, "free ball": 0, "translation": turning}
    nodes: list[Node] = []

    def add(kind: str, parent: int, E, offset, axis=(0.0, 0.0, 1.0), free: bool = False) -> int:
        sort = "scalar" if kind in ("hinge", "slide") else "free ball" if kind == "ball" and free else kind
        slot, size = next_slot[sort], 1 if sort == "scalar" else 3
        next_slot[sort] += 1
        first = first_rate[sort] + size * slot
        rates = tuple(range(first, first + size))
        nodes.append(Node(parent, kind, _numbers(E), _numbers(offset), _numbers(axis), slot, rates))
        return len(nodes) - 1

    node_of, frame_of = {WORLD: -1}, {WORLD: (np.eye(3), np.zeros(3))}
    joints: dict[str, Made] = {}
    for body in bodies:
        if body.name in node_of:
            raise ValueError(f"{caller}: two bodies are named {body.name!r}.")
        if body.parent not in node_of:
            raise ValueError(
                f"{caller}: the parent of {body.name!r} must be a body before it; received {body.parent!r}."
            )
        node, (R, x) = node_of[body.parent], frame_of[body.parent]
        E, x = R @ np.reshape(body.rotation, (3, 3)), x + R @ np.asarray(body.position)
        last = np.zeros(3)  # what of the body's frame the last anchor is
        for number, joint in enumerate(body.joints):
            name = joint.name or _unnamed(body, number, list(joints))
            if name in joints:
                raise ValueError(f"{caller}: two joints are named {name!r}.")
            before = len(nodes)
            if joint.kind == "free":
                E, x = np.eye(3), np.zeros(3)
                node = add("ball", add("translation", -1, E, x), E, x, free=True)
            else:
                anchor = np.asarray(joint.anchor)
                x, last = x + E @ (anchor - last), anchor
                for kind, axis in _simple(joint):
                    if kind != "ball" and joint.reference:
                        E, x = _before(kind, E, x, axis, joint.reference)
                    node = add(kind, node, E, x, axis)
                    E, x = np.eye(3), np.zeros(3)
            own = nodes[before:]
            joints[name] = Made(joint, body, tuple(own[::-1] if joint.kind == "free" else own))
        node_of[body.name], frame_of[body.name] = node, (E, x - E @ last)
    return Structure(nodes, node_of, frame_of, joints)


def _unnamed(body: Body, number: int, before: list[str]) -> str:
    """A name for an unnamed joint; before: the names of the joints before it."""
    if number == 0:
        return body.name
    joint, last = body.joints[number], body.joints[number - 1]
    spring = joint.stiffness and (joint.kind, joint.axis, joint.anchor) == (last.kind, last.axis, last.anchor)
    return f"{before[-1]}_spring" if spring else f"{body.name}_{number + 1}"


def _simple(joint: Joint):
    """The joints with one kind of coordinate that it consists of."""
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
    """The frame of a joint whose coordinate is `reference` in the described position."""
    if kind == "slide":
        return E, x - reference * (E @ axis)
    K = skew(axis)
    return tidy(E @ (np.eye(3) - np.sin(reference) * K + (1 - np.cos(reference)) * K @ K)), x


def _numbers(x) -> Any:
    return tuple(tidy(np.asarray(x, float)).ravel().tolist())


def numpy_mass_matrix(model: Model, q: Any, params: dict) -> np.ndarray:
    """M (nv, nv) by NumPy, which compiles nothing; for a single evaluation.

    M = armature + sum over bodies of m u^T u + a^T I a, where u and a are the velocity of the centre of mass and the
    angular velocity for unit rates. q: as in the system, of NumPy arrays.
    """
    own = model.tree
    if own.balls:
        x, R_free, y_free = q.get("joint"), q.get("free", {}).get("R"), q.get("free", {}).get("x")
        balls = [*q.get("ball", []), *(R_free if R_free is not None else [])]
    else:
        x, balls, y_free = q, [], None
    R, y, turns, ways = [], [], np.zeros((own.rates, 3)), np.zeros((own.rates, 3))
    for node in own.nodes:
        E, d, axis = node.E, np.asarray(node.offset), np.asarray(node.axis)
        if node.kind == "hinge":
            EK, EKK = node.turns
            E = E + np.sin(x[node.slot]) * EK + (1 - np.cos(x[node.slot])) * EKK
        elif node.kind == "slide":
            d = d + x[node.slot] * (E @ axis)
        elif node.kind == "ball":
            E = E @ balls[node.slot]
        else:
            d = d + y_free[node.slot]
        above, origin = (np.eye(3), np.zeros(3)) if node.parent < 0 else (R[node.parent], y[node.parent])
        R.append(above @ E)
        y.append(origin + above @ d)
        rates = list(node.rates)
        if node.kind in ("hinge", "ball"):
            turns[rates] = R[-1] @ axis if node.kind == "hinge" else R[-1].T
            ways[rates] = np.cross(y[-1], turns[rates])
        else:
            ways[rates] = R[-1] @ axis if node.kind == "slide" else np.eye(3)
    m, c, inertia = (np.asarray(params[name], float) for name in ("mass", "com", "inertia"))
    M = np.diag(np.asarray(params["armature"], float))
    for i, body in enumerate(model.bodies):
        B = R[body.node] @ body.R
        centre = y[body.node] + R[body.node] @ np.asarray(body.point) + B @ c[i]
        moves = own.carries[body.node][:, None]
        a, u = turns * moves, (ways + np.cross(turns, centre)) * moves
        M = M + m[i] * u @ u.T + a @ (B @ inertia[i] @ B.T) @ a.T
    return M
