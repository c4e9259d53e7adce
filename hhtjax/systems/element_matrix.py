"""The matrix of a step of a system of elements, from the derivatives of each element in the unknowns of its own nodes.

    A = d(M w - Q)/dx = sum_e P_e^T (d r_e / d x_e) P_e

The unknowns x of a step change position, velocity and acceleration at its end; those of a node change that node only.
Without rotations these changes are three numbers, with rotations small matrices. So all elements of a kind together
need as many tangents as one of them has unknowns.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree

from hhtjax.description import Array, PyTree, thaw
from hhtjax.numerics.sparse_lu import Numbers
from hhtjax.primitives import staged
from hhtjax.systems import held_nodes
from hhtjax.systems.elements import Elements, parts_of, table_of

if TYPE_CHECKING:
    from hhtjax.numerics.sparse_lu import Plan
    from hhtjax.systems.assembly import ElementForce
    from hhtjax.systems.flat_system import FlatSystem


class Changes(NamedTuple):
    """The change of q, v and w by x. Without rotations: a number for each. With rotations: pytrees of leaves (d, N,
    ...) with the changes by each of the d numbers of a node, at all nodes."""

    q: Any
    v: Any
    w: Any


class StepMatrix:
    """The matrix of a step with these elements. v: shapes; plan: of the matrix."""

    def __init__(self, force: ElementForce, flat: FlatSystem, v: PyTree, plan: Plan):
        self.force, self.flat, self.held = force, flat, force.held
        self.parts, self.masses = parts_of(force.elements), force.mass.parts
        self.number, leaf = _within_nodes(v)
        dofs = [part.dofs(v) for part in (*self.parts, *self.masses)]
        self.dofs = dict(zip((*self.parts, *self.masses), dofs, strict=True))
        self.at_nodes = _same_node(self.number, leaf) if flat.blocks else (np.arange(flat.size),) * 2
        pairs = [self.at_nodes, *(_pairs(part, v) for part in self.dofs)]
        rows, columns = (np.concatenate(x) for x in zip(*pairs, strict=True))
        self.rows, self.columns = rows, columns
        self.table = _table_in(plan, rows, columns)

    def __call__(self, params: PyTree, state: Any, along: Callable) -> Numbers:
        """The `Numbers` at a state. along: the linear map from x to the change of state."""
        params, flat, mass = thaw(params), self.flat, self.force.mass
        state = lax.stop_gradient(state)
        t, q, v = state.t, flat.unravel(state.q), flat.unravel_rates(state.v)
        w, changes = flat.unravel_rates(state.w), self._changes(along, state.w)
        d = jnp.where(free := mass.free(v, params), mass.diagonal(v, params), 1)
        if self.held is not None:
            known = held_nodes.accelerations(self.held, v, t, params)
            w = jax.tree.map(jnp.where, known.here, known.a, w)
            q, v = held_nodes.at(self.held, q, v, t, params)

        def pull(part: Elements):
            return lambda q, v, *each: jax.tree.map(
                jnp.negative, part.complete(v, part.function(q, v, t, params, *each))
            )

        def product(part: Elements):
            return lambda q, w, *each: part.complete(w, part.function(q, w, params, *each))

        forces = [self._slopes(x, pull(x), (q, v), (changes.q, changes.v), params) for x in self.parts]
        masses = [self._slopes(x, product(x), (q, w), (changes.q, changes.w), params) for x in self.masses]
        values = [self._of_nodes(d, changes), *forces, *masses]
        if self.held is not None:
            inner = (free[self.rows] & free[self.columns])[values[0].size :]
            values = [values[0], jnp.where(inner, jnp.concatenate(values[1:]), 0)]  # what is held is 1 w = a
        return Numbers(lax.stop_gradient(jnp.concatenate(values)), self.table)

    def _changes(self, along: Callable, like: Array) -> Changes:
        if not self.flat.blocks:
            change = along(jnp.ones_like(like))
            return Changes(*(lax.stop_gradient(x[0]) for x in (change.q, change.v, change.w)))
        probes = jnp.asarray(self.number)[None, :] == jnp.arange(self.number.max() + 1)[:, None]
        change = lax.stop_gradient(jax.vmap(along)(probes.astype(like.dtype)))
        ways = self.flat.unravel, self.flat.unravel_rates, self.flat.unravel_rates
        return Changes(*(jax.vmap(f)(x) for f, x in zip(ways, (change.q, change.v, change.w), strict=True)))

    def _of_nodes(self, d: Array, changes: Changes) -> Array:
        """The contribution of masses d (n,) at nodes."""
        if not self.flat.blocks:
            return changes.w * d
        rows, columns = self.at_nodes
        w = jax.vmap(lambda x: ravel_pytree(x)[0])(changes.w)
        return d[rows] * w[self.number[columns], rows]

    def _slopes(self, part: Elements, f: Callable, at: tuple, changes: tuple, params: PyTree) -> Array:
        """(s E s,): the derivatives of f, of two arguments, at (q, v) or (q, w), in the order of `_pairs`."""
        own, axes = part.own_numbers(params, jnp.result_type(jax.tree.leaves(at[1])[0]))
        at = tuple(map(part.own, at))
        zero, unravel = ravel_pytree(jax.tree.map(lambda x: x[0], at[1]))
        units = jax.vmap(unravel)(jnp.eye(zero.size, dtype=zero.dtype))  # leaves (s, k, ...)
        if self.flat.blocks:
            number = self.number[self.dofs[part][0]]
            ways = tuple(_at_own_nodes(jax.vmap(part.own)(x), number, units) for x in changes)
        else:
            spread = lambda x, c: jnp.broadcast_to(c * x[:, None], (len(x), part.count, *x.shape[1:]))  # noqa: E731
            ways = tuple(jax.tree.map(partial(spread, c=c), units) for c in changes)
        every = jax.vmap(f, (0, 0, *axes))
        _, tangent = staged(lambda *at: jax.linearize(lambda *at: every(*at, *own), *at))(*at)
        slopes = jax.vmap(lambda way: tangent(*way))(ways)
        return jnp.concatenate([x.ravel() for x in jax.tree.leaves(slopes)])


def _within_nodes(v: PyTree) -> tuple[np.ndarray, np.ndarray]:
    """(n,) each: the index of an unknown within its node, and a number for each leaf and node."""
    numbers, nodes, first, place = [], [], 0, 0
    for x in jax.tree.leaves(v):
        N, r = np.shape(x)[0], int(np.prod(np.shape(x)[1:], dtype=int))
        numbers.append(np.tile(first + np.arange(r), N))
        nodes.append(place + np.repeat(np.arange(N), r))
        first, place = first + r, place + N
    return np.concatenate(numbers), np.concatenate(nodes)


def _same_node(number: np.ndarray, leaf: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of all pairs of unknowns of one leaf of one node."""
    count = np.bincount(leaf)
    start = np.cumsum(count) - count
    rows = np.repeat(np.arange(len(leaf)), count[leaf])
    within = np.arange(len(rows)) - np.repeat(np.cumsum(count[leaf]) - count[leaf], count[leaf])
    return rows, start[leaf[rows]] + within


def _pairs(part: Elements, v: PyTree) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the derivatives of leaves (s, E, k, ...) in each of the s unknowns of an element,
    flattened."""
    dofs = part.dofs(v)
    s, rows, columns = dofs.shape[1], [], []
    for own in part.dofs_of_leaves(v):  # (E, k ...)
        rows.append(np.tile(own.ravel(), s))
        columns.append(np.repeat(dofs.T.ravel(), own.shape[1]))
    return np.concatenate(rows), np.concatenate(columns)


def _table_in(plan: Plan, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """(d, entries): which numbers, at these rows and columns, are summed in each entry of a plan."""
    entries = plan.rows.astype(np.int64) * plan.n + plan.columns
    order = np.argsort(entries)
    places = order[np.searchsorted(entries[order], rows.astype(np.int64) * plan.n + columns)]
    return table_of(places.astype(np.int32), len(entries), most=len(places))


def _at_own_nodes(change: PyTree, number: np.ndarray, units: PyTree) -> PyTree:
    """Leaves (s, E, k, ...): changes by the unknowns of an element, from changes (d, E, k, ...) by the numbers of a
    node."""

    def at(change: Array, unit: Array) -> Array:
        there = np.asarray(jnp.any(unit.reshape(*unit.shape[:2], -1) != 0, axis=2))  # (s, k)
        there = there.reshape(there.shape[0], 1, there.shape[1], *(1,) * (change.ndim - 3))
        return jnp.where(there, change[number], 0)

    return jax.tree.map(at, change, units)
