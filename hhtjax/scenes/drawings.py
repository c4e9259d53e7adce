"""Shapes for drawings of scenes: `Scene.drawing` returns a list of them, and `hhtjax.plot.animation` draws them.

A shape is a polyline with the kind of part that it represents. Its points are in metres. Springs and blocks are
symbols: only their positions are to scale, not their sizes.

>>> import numpy as np
>>> from hhtjax.scenes import drawings
>>> [shape.kind for shape in drawings.on_a_spring(0.2, size=1.0)]
['body', 'spring', 'ground', 'ground']
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np

from hhtjax.description import Array, PyTree, Real

Points = Any  # anything that NumPy converts to an array


class Shape(NamedTuple):
    """A polyline to draw.

    Attributes:
        points: (k, 2) or (k, 3), m.
        kind: "bar", with a joint at each point; "body", "spring", "ground", "arrow", or "aim", a dashed line.
    """

    points: np.ndarray
    kind: str


@jax.tree_util.register_static
@dataclass(frozen=True)
class Drawing:
    """A decorator for a function drawing(q, t, params) that returns shapes. Its scene can then be passed to `jax.jit`.

    Attributes:
        shapes: the function; q and params contain NumPy arrays, t is in s.
    """

    shapes: Callable[[PyTree, Real, PyTree], list[Shape]]

    def __call__(self, q: PyTree, t: Real, params: PyTree) -> list[Shape]:
        q, params = jax.tree.map(lambda x: np.asarray(x) if isinstance(x, jax.Array) else x, (q, params))
        return self.shapes(q, t, params)


def bar(*points: Points) -> Shape:
    """A bar from point to point, with joints between them."""
    return Shape(np.stack([np.asarray(x, float) for x in points]), "bar")


def block(centre: Points, width: Real, height: Real, angle: Real = 0.0) -> Shape:
    """A rectangle in the plane, turned by an angle, rad."""
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) * np.array([width, height]) / 2
    c, s = np.cos(angle), np.sin(angle)
    return Shape(np.asarray(centre, float) + corners @ np.array([[c, s], [-s, c]]), "body")


def wheel(centre: Points, radius: Real, along: Points = (1, 0), up: Points = (0, 1), corners: int = 24) -> Shape:
    """A circle with one spoke in the direction `along`; in space it lies in the plane of two unit vectors."""
    centre, along, up = (np.asarray(x, float) for x in (centre, along, up))
    angle = np.linspace(0, 2 * np.pi, corners + 1)[:, None]
    rim = centre + radius * (np.cos(angle) * along + np.sin(angle) * up)
    return Shape(np.concatenate([centre[None], rim]), "body")


def spring(first: Points, second: Points, width: Real, coils: int = 5) -> Shape:
    """A zigzag of the given width between two points; in space it turns in the plane of x and z."""
    first, second = np.asarray(first, float), np.asarray(second, float)
    way = second - first
    share = np.array([0, 1, *np.linspace(1.25, coils + 0.75, 2 * coils), coils + 1, coils + 2]) / (coils + 2)
    side = np.array([0, 0, *np.tile([0.5, -0.5], coils), 0, 0])
    return Shape(first + share[:, None] * way + width * side[:, None] * _across(way), "spring")


def ground(first: Points, second: Points, depth: Real, hatches: int = 8, shift: Real = 0.5) -> Shape:
    """A hatched line in the plane. The hatches are on the right as seen from the first point to the second.

    shift: shift of the hatches along the line, as a fraction of their distance.
    """
    first, second = np.asarray(first, float), np.asarray(second, float)
    way = second - first
    into = -_across(way) * depth - way / np.linalg.norm(way) * depth
    points = [first]
    for share in (np.arange(hatches) + shift % 1.0) / hatches:
        foot = first + share * way
        points += [foot, foot + into, foot]
    return Shape(np.stack([*points, second]), "ground")


def arrow(start: Points, way: Points, size: Real) -> Shape:
    """An arrow from a point along a vector; size: the length of the longest arrow of its kind, m."""
    start, way = np.asarray(start, float), np.asarray(way, float)
    end, length = start + way, np.linalg.norm(way)
    head = 0.25 * min(length, size) * (way / length if length > 0 else way)
    side = np.array([-head[1], head[0]]) / 2
    return Shape(np.stack([start, end, end - head + side, end, end - head - side]), "arrow")


def aim(*points: Points) -> Shape:
    """A dashed line, for a desired position."""
    return Shape(np.stack([np.asarray(x, float) for x in points]), "aim")


def on_a_spring(
    place: Real, *, size: Real, force: Real | None = None, sprung: bool = True, floor: bool = True
) -> list[Shape]:
    """A block whose middle is at x = place, on a level floor, and a spring to a wall on its left.

    Args:
        place: position of the block, m; 0 where the spring is at rest.
        size: size of the block, m; the spring is three times as long.
        force: force of a drive, as a fraction of its amplitude, drawn as an arrow; None: no arrow.
        sprung: whether there is a spring. floor: whether there is a floor.
    """
    half, wall = size / 2, -3.5 * size
    shapes = [block((place, half), size, size)]
    if force is not None:
        shapes.append(arrow((place + half, half), (force * size, 0), size))
    if sprung:
        shapes += [spring((wall, half), (place - half, half), 0.5 * size), wall_at(wall, size, -1)]
    return shapes + ([ground((wall, 0.0), (3.5 * size, 0.0), 0.2 * size, 14)] if floor else [])


def wall_at(x: Real, size: Real, side: int) -> Shape:
    """A wall at x, of the height 1.5 `size`; side: -1 if it is on the left of the moving part, 1 on the right."""
    low, high = (x, 0.0), (x, 1.5 * size)
    return ground(low, high, 0.2 * size, 4) if side > 0 else ground(high, low, 0.2 * size, 4)


def of_mechanism(mechanism: Any) -> Drawing:
    """The bars of a `hhtjax.bodies.Mechanism`."""
    return Drawing(lambda q, t, params: [Shape(np.asarray(x, float), "bar") for x in mechanism.bars(params)(q)])


def _across(way: Array) -> np.ndarray:
    """A unit vector normal to `way`: on its left; in space in the plane of x and z."""
    across = np.array([-way[1], way[0]] if len(way) == 2 else [-way[2], 0.0, way[0]])
    return across / max(np.linalg.norm(across), 1e-300)
