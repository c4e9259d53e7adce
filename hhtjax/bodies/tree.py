"""A tree of joints, as the part of a mechanism that belongs to the program: parents, positions, axes, links."""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np

Vector = tuple[float, float, float]


class Node(NamedTuple):
    """A joint of one kind, and the frame after it, whose origin is on the axis. Relative to the frame before it, the
    rotation and the origin of this frame are

        hinge: E exp(q hat(axis)), offset     slide: E, offset + q E axis     ball: E R, offset

    For a "translation", the first half of a free joint, E = 1 and offset = 0.

    Attributes:
        parent: number of the parent node, -1 for the world.
        kind: "hinge", "slide", "ball", or "translation", whose rates are along the axes of the world.
        rotation: E, 9 numbers. offset: (3,). axis: (3,), a unit vector in its own frame.
        slot: index among the coordinates of its kind: hinges and slides together, balls, translations.
        rates: its indices in the vector of rates.
    """

    parent: int
    kind: str
    rotation: tuple
    offset: Vector
    axis: Vector
    slot: int
    rates: tuple

    @property
    def E(self) -> np.ndarray:
        """(3, 3)."""
        return np.reshape(self.rotation, (3, 3))

    @property
    def turns(self) -> tuple[np.ndarray, np.ndarray]:
        """E K and E K^2 with K = hat(axis): E exp(q K) = E + sin q E K + (1 - cos q) E K^2."""
        K = skew(self.axis)
        return self.E @ K, self.E @ K @ K


def skew(a) -> np.ndarray:
    """hat(a), (3, 3)."""
    return np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])


class Tree:
    """Joints, each after its parent, and which of their frames carry mass. Hashable; trees with equal contents are
    equal.

    Attributes:
        nodes: each a `Node`, after its parent. K is their number.
        links: indices of the nodes that carry mass, (L,).
        scalars, balls, frees, rates: the number of hinges and slides; of balls, including those of free joints; of free
            joints; of all rates, nv.
    """

    def __init__(self, nodes: tuple[Node, ...], links: tuple[int, ...]):
        self.nodes, self.links = tuple(nodes), tuple(links)
        kinds = [node.kind for node in nodes]
        self.scalars = kinds.count("hinge") + kinds.count("slide")
        self.balls, self.frees = kinds.count("ball"), kinds.count("translation")
        self.rates = self.scalars + 3 * (self.balls + self.frees)
        self._key = self.nodes, self.links
        self._hash = hash(self._key)

    def __eq__(self, other):
        return type(other) is Tree and self._key == other._key

    def __hash__(self):
        return self._hash

    def __repr__(self):
        return f"Tree({len(self.nodes)} joints, {self.rates} rates, {len(self.links)} links)"

    @cached_property
    def _at(self) -> np.ndarray:
        """Whether node j is at or above node i, (K, K)."""
        at = np.eye(len(self.nodes), dtype=bool)
        for k, node in enumerate(self.nodes):
            if node.parent >= 0:
                at[k] |= at[node.parent]
        return at

    @cached_property
    def node_of_rate(self) -> np.ndarray:
        """The node of each rate, (nv,)."""
        found = np.zeros(self.rates, int)
        for k, node in enumerate(self.nodes):
            found[list(node.rates)] = k
        return found

    @cached_property
    def at_or_above(self) -> np.ndarray:
        """Whether the joint of rate j is the joint of rate i, or lies between it and the root: (nv, nv)."""
        return self._at[np.ix_(self.node_of_rate, self.node_of_rate)]

    @cached_property
    def beside(self) -> np.ndarray:
        """Whether both are rates of one joint: (nv, nv)."""
        return self.node_of_rate[:, None] == self.node_of_rate[None, :]

    @cached_property
    def above(self) -> np.ndarray:
        """Whether the joint of rate j lies between the joint of rate i and the root: (nv, nv)."""
        return self.at_or_above & ~self.beside

    @cached_property
    def carried(self) -> np.ndarray:
        """Whether the joint of rate i carries link l: (nv, L)."""
        return self._at[np.ix_(np.asarray(self.links, int), self.node_of_rate)].T

    @cached_property
    def carries(self) -> np.ndarray:
        """Whether the joint of rate i carries node k, or is it: (K, nv)."""
        return self._at[:, self.node_of_rate]
