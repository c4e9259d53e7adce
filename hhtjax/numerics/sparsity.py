"""Which unknowns meet in a matrix, and what follows: orders of elimination, blocks in a row, and colours of columns.

A pattern is a boolean matrix of scipy.sparse, True wherever an entry may differ from zero. All here happens once,
before a program is traced, with NumPy and SciPy.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from scipy.sparse import csr_array

SMALL = 48  # unknowns that nested dissection leaves undivided
MIDDLE = 0.35  # part of the unknowns that each side of a separator has at least
STARTS = 5  # searches for an end of a graph


class Blocks(NamedTuple):
    """Unknowns in blocks of which each meets its neighbours alone. order: (n,), the unknowns, block by block; starts:
    (N + 1,), where blocks begin in it; size: of the largest."""

    order: np.ndarray
    starts: np.ndarray
    size: int


def pattern_of(matrix) -> csr_array:
    """Where a matrix of scipy.sparse, or an array, is not zero."""
    from scipy.sparse import csr_array

    return csr_array(csr_array(matrix) != 0)


def union(*patterns: csr_array) -> csr_array:
    """True where one of them is."""
    from scipy.sparse import csr_array

    found = patterns[0].astype(np.int32)
    for pattern in patterns[1:]:
        found = found + pattern.astype(np.int32)
    return csr_array(found > 0)


def product(A: csr_array, B: csr_array) -> csr_array:
    """The pattern of the product of matrices with these."""
    from scipy.sparse import csr_array

    return csr_array((A.astype(np.int32) @ B.astype(np.int32)) > 0)


def symmetric(pattern: csr_array) -> csr_array:
    """The pattern, its transpose, and the diagonal."""
    from scipy.sparse import csr_array, eye_array

    return union(csr_array(pattern), csr_array(pattern.T), csr_array(eye_array(pattern.shape[0], dtype=bool)))


def colours(pattern: csr_array, order: np.ndarray | None = None) -> np.ndarray:
    """(n,): a number for each column, such that columns of one number meet in no row. Greedy, in the given order.

    So a Jacobian with this pattern is known from as many products as there are numbers (Curtis, Powell, Reid 1974).
    """
    from scipy.sparse import csr_array

    meet = product(csr_array(pattern.T), csr_array(pattern))
    found = np.full(pattern.shape[1], -1)
    for j in range(len(found)) if order is None else order:
        taken = found[meet.indices[meet.indptr[j] : meet.indptr[j + 1]]]
        taken = np.unique(taken[taken >= 0])
        gap = np.flatnonzero(taken != np.arange(len(taken)))
        found[j] = gap[0] if len(gap) else len(taken)
    return found


def groups(pattern: csr_array) -> np.ndarray:
    """(n,): a number for each unknown; those that meet the same unknowns, themselves included, have the same number.

    These are mostly the unknowns of a node. pattern: symmetric, with its diagonal.
    """
    pattern.sort_indices()
    rows = np.split(pattern.indices, pattern.indptr[1:-1])
    numbers: dict = {}
    return np.array([numbers.setdefault(row.tobytes(), len(numbers)) for row in rows], int)


def condensed(pattern: csr_array, group: np.ndarray) -> csr_array:
    """The pattern of groups."""
    from scipy.sparse import csr_array

    n = len(group)
    members = csr_array((np.ones(n, bool), (np.arange(n), group)), shape=(n, int(group.max(initial=-1)) + 1))
    return product(product(csr_array(members.T), pattern), members)


def levels(graph: csr_array, start: int) -> np.ndarray:
    """(N,): the number of steps from `start` to each node; -1 where none leads there."""
    from scipy.sparse.csgraph import breadth_first_order

    order, before = breadth_first_order(graph, start, directed=False)
    found = np.full(graph.shape[0], -1)
    found[start] = 0
    for i in order[1:].tolist():  # each behind the one that it was reached from
        found[i] = found[before[i]] + 1
    return found


def longest_levels(graph: csr_array) -> np.ndarray:
    """The levels from an end of a connected graph: a node from which the way to others is as long as can be."""
    found, depth = levels(graph, 0), -1
    degree = np.diff(graph.indptr)
    for _ in range(STARTS):
        if found.max() <= depth:
            break
        depth = found.max()
        last = np.flatnonzero(found == depth)
        found = levels(graph, int(last[np.argmin(degree[last])]))
    return found


def components(graph: csr_array) -> list[np.ndarray]:
    """The nodes of each connected part of a graph."""
    from scipy.sparse.csgraph import connected_components

    number, label = connected_components(graph, directed=False)
    order = np.argsort(label, kind="stable")
    return np.split(order, np.cumsum(np.bincount(label, minlength=number))[:-1])


def in_blocks(pattern: csr_array, free: int) -> Blocks:
    """The `Blocks` of a pattern, as small as the levels of its graph are.

    free: number of unknowns that come first and may stand anywhere; those behind them, the multipliers of constraints,
    stand in the last of the levels that they meet: no row of a constraint comes before an unknown that it holds.
    """
    pattern = symmetric(pattern)
    level = _levels_of(pattern, free)
    entries = pattern.tocoo()
    reach = max(1, int(np.max(np.abs(level[entries.row] - level[entries.col]), initial=0)))
    order = np.argsort(level, kind="stable")
    block = level // reach  # so many levels together, that each block meets its neighbours alone
    count = np.bincount(block[order])
    size = int(count.max())
    starts, filled = [0], 0
    for number in count.tolist():  # small ones together, as where parts do not meet
        if filled + number > size:
            starts.append(starts[-1] + filled)
            filled = 0
        filled += number
    starts.append(starts[-1] + filled)
    return Blocks(order, np.array(starts), size)


def _levels_of(pattern: csr_array, free: int) -> np.ndarray:
    """(n,): the level of each unknown."""
    group, last = groups(pattern[:free, :free]), -1
    graph = condensed(pattern[:free, :free], group)
    of_group = np.zeros(graph.shape[0], int)
    for nodes in components(graph):
        here = longest_levels(graph[nodes][:, nodes])
        of_group[nodes] = here + last + 1
        last += here.max() + 1
    # in that direction in which multipliers, which come last, make the smaller levels
    found = [
        _behind(pattern, free, np.append(x[group], np.zeros(pattern.shape[0] - free, int)))
        for x in (of_group, last - of_group)
    ]
    return min(found, key=lambda level: np.bincount(level).max())


def _behind(pattern: csr_array, free: int, place: np.ndarray) -> np.ndarray:
    """(n,): the places of the free unknowns, and for each other one the last place among those that it meets."""
    entries = pattern[free:, :free].tocoo()
    np.maximum.at(place, free + entries.row, place[entries.col])
    return place


def dissected(pattern: csr_array, free: int) -> np.ndarray:
    """(n,): an order of elimination with little fill, by nested dissection (George 1973) of the levels of the graph.

    free: as of `in_blocks`.
    """
    pattern = symmetric(pattern)
    group = groups(pattern[:free, :free])
    graph = condensed(pattern[:free, :free], group)
    weight = np.bincount(group)
    order = np.concatenate([_dissect(graph, weight, nodes) for nodes in components(graph)])
    place = np.zeros(pattern.shape[0], int)
    rank = np.empty(len(order), int)
    rank[order] = np.arange(len(order))
    place[:free] = rank[group]
    return np.argsort(_behind(pattern, free, place), kind="stable")


def _dissect(graph: csr_array, weight: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """The order of connected nodes: of both sides of a separator, and of this."""
    level = longest_levels(graph[nodes][:, nodes])
    if weight[nodes].sum() <= SMALL or level.max() < 2:
        return nodes[np.argsort(level, kind="stable")]
    count = np.bincount(level, weights=weight[nodes])
    before = np.cumsum(count) - count
    after = count.sum() - before - count
    fair = np.minimum(before, after) >= MIDDLE * count.sum()
    if not fair.any():
        fair[np.argmax(np.minimum(before, after))] = True
    cut = int(np.flatnonzero(fair)[np.argmin(count[fair])])
    sides = [nodes[side] for side in (level < cut, level > cut) if side.any()]
    parts = [side[part] for side in sides for part in components(graph[side][:, side])]
    return np.concatenate([*map(partial(_dissect, graph, weight), parts), nodes[level == cut]])


def stacked(patterns: list[list]) -> csr_array:
    """The pattern of a matrix of blocks; None where nothing is."""
    from scipy.sparse import block_array, csr_array

    return csr_array(block_array([[None if A is None else A.astype(np.int32) for A in row] for row in patterns]) > 0)
