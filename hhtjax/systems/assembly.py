"""From elements to a system: its mass, its force, its constraints, and which of its unknowns are coupled."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache, reduce
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from hhtjax.checks import require_function
from hhtjax.description import Array, PyTree, Real, is_concrete, is_real
from hhtjax.numerics.sparse_matrix import Pattern, Sparse, gather
from hhtjax.systems import held_nodes
from hhtjax.systems.elements import Elements, Fixed, Joints, Rows, Sum, pairs_of, parts_of, table_of
from hhtjax.systems.held_nodes import Held, accelerations, velocity_like

NAME = "System.from_elements"


@dataclass(frozen=True)
class ElementForce:
    """Q(q, v, t), the sum over all elements; for held coordinates their acceleration."""

    elements: Any
    held: Held | None
    mass: Any

    def __call__(self, q: PyTree, v: PyTree, t: Real, params: PyTree) -> PyTree:
        q, v = jax.tree.map(jnp.asarray, (q, v))
        if self.held is None:
            return _zero(v) if self.elements is None else self.elements(q, v, t, params)
        here, now = held_nodes.at(self.held, q, v, t, params)
        known, moves, a = accelerations(self.held, v, t, params)
        # no slope in a velocity that is 0: a start takes the symmetric part of drag, which would move what stays
        now = jax.tree.map(lambda v, here, told: jnp.where(here & ~told, 0, v), now, known, moves)
        Q = _zero(v) if self.elements is None else self.elements(here, now, t, params)
        if self.held.moves and self.mass.parts:
            pull = self.mass.product(here, a, params)
            Q = jax.tree.map(jnp.subtract, Q, pull)
        return jax.tree.map(jnp.where, known, a, Q)


@dataclass(frozen=True)
class ElementConstraint:
    """Phi(q, t) of all joints."""

    joints: Any
    held: Held | None

    def __call__(self, q: PyTree, t: Real, params: PyTree) -> Array:
        q = jax.tree.map(jnp.asarray, q)
        return self.joints(held_nodes.at(self.held, q, None, t, params)[0], t, params)


@dataclass(frozen=True)
class ElementMass:
    """M, (n,) or `Sparse`: the sum of the masses at nodes and of elements; 1 for held coordinates."""

    nodal: Any  # a function of params, `Fixed`, or None
    elements: Any  # a `Sum` of `Elements`, or None
    held: Held | None

    def __call__(self, q: PyTree, params: PyTree) -> Array | Sparse:
        v = velocity_like(q)
        d = self.diagonal(v, params)
        free = self.free(v, params)
        if self.elements is None:
            return jnp.where(free, d, 1)
        parts = self.parts
        pattern, table, rows, columns = _mass_pattern(tuple(_key(part.dofs(v)) for part in parts), d.size)
        numbers = jnp.concatenate([d, *(part.matrices(q, v, params).ravel() for part in parts)])
        values = _collected(numbers, table, pattern.size)
        inner = gather(jnp.append(free, True), rows) & gather(jnp.append(free, True), columns)
        on = jnp.asarray((rows == columns) & pattern.filled)
        return Sparse(jnp.where(inner, values, jnp.where(on, 1, 0)).astype(values.dtype), pattern)

    @property
    def parts(self) -> list:
        """The elements."""
        return parts_of(self.elements)

    def diagonal(self, v: PyTree, params: PyTree) -> Array:
        """(n,): the masses at the nodes."""
        flat, _ = ravel_pytree(v)
        if self.nodal is None:
            return jnp.zeros_like(flat)
        given = self.nodal.tree if isinstance(self.nodal, Fixed) else self.nodal(params)
        alone = jax.tree.structure(given) == jax.tree.structure(0)
        if alone and jnp.ndim(given) < 2 and jnp.size(given) in (1, flat.size):
            return jnp.broadcast_to(jnp.asarray(given, flat.dtype), flat.shape)
        if jax.tree.structure(given) == jax.tree.structure(v):
            given = jax.tree.map(_broadcast, given, v)
            return ravel_pytree(given)[0].astype(flat.dtype)
        raise ValueError(f"{NAME}: `mass` must be structured like v, or have shape ({flat.size},); received {given!r}.")

    def free(self, v: PyTree, params: PyTree) -> Array:
        """(n,): which coordinates are not held."""
        if self.held is None:
            return jnp.ones(ravel_pytree(v)[0].shape, bool)
        return ~ravel_pytree(accelerations(self.held, v, 0.0, params).here)[0]

    def product(self, q: PyTree, w: PyTree, params: PyTree) -> PyTree:
        """M w from the elements only."""
        return reduce(lambda x, y: jax.tree.map(jnp.add, x, y), [x.product(q, w, params) for x in self.parts])


@dataclass(frozen=True)
class ElementInertia:
    """M w, without forming M."""

    mass: ElementMass

    def __call__(self, q: PyTree, w: PyTree, params: PyTree) -> PyTree:
        q, w = jax.tree.map(jnp.asarray, (q, w))
        flat, unravel = ravel_pytree(w)
        free = self.mass.free(w, params)
        moving = unravel(jnp.where(free, flat, 0))
        product = ravel_pytree(self.mass.product(q, moving, params))[0] + self.mass.diagonal(w, params) * flat
        return unravel(jnp.where(free, product, flat))


def _broadcast(m: Real, x: Array) -> Array:
    """A mass for each number of a leaf, from one for all, one for each node, or one for each number."""
    m = jnp.asarray(m)
    if m.ndim > x.ndim or any(a not in (1, b) for a, b in zip(m.shape, x.shape, strict=False)):
        raise ValueError(
            f"{NAME}: a leaf of `mass` must be a number, or have one for each node or number of a leaf of v, of shape "
            f"{x.shape}; received shape {m.shape}."
        )
    return jnp.broadcast_to(m.reshape(m.shape + (1,) * (x.ndim - m.ndim)), x.shape)


def _zero(v: PyTree) -> PyTree:
    return jax.tree.map(jnp.zeros_like, v)


def _collected(numbers: Array, table: np.ndarray | tuple, size: int) -> Array:
    """(size,): the sum of the numbers at each place."""
    if isinstance(table, tuple):
        return jax.ops.segment_sum(numbers, table[0], size)
    numbers = jnp.append(numbers, jnp.zeros_like(numbers[:1]))
    return reduce(jnp.add, [gather(numbers, row) for row in table])


def _key(dofs: np.ndarray) -> tuple:
    return dofs.tobytes(), dofs.shape


@lru_cache(maxsize=64)
def _mass_pattern(keys: tuple, n: int):
    """The `Pattern` of a mass, which numbers are summed in each of its entries, and rows and columns of the entries (n:
    unused)."""
    i = np.arange(n)
    pairs: list = [(i, i)]
    for data, shape in keys:
        pairs.append(pairs_of(np.frombuffer(data, np.int32).reshape(shape)))
    rows, columns = (np.concatenate(x).astype(np.int64) for x in zip(*pairs, strict=True))
    key, inverse = np.unique(rows * n + columns, return_inverse=True)
    pattern = Pattern(n, key // n, key % n)
    places = pattern.slots[inverse].astype(np.int32)
    found = table_of(places, pattern.size)
    slot_rows, slot_columns = np.full(pattern.size, n, np.int32), np.full(pattern.size, n, np.int32)
    slot_rows[pattern.slots], slot_columns[pattern.slots] = pattern.rows, pattern.columns
    return pattern, (places,) if found is None else found, slot_rows, slot_columns


def put_together(parts: tuple, mass: Any, held: Any):
    """mass, force, constraint and inertia of a system; raises errors for wrong arguments."""
    if not parts or not all(isinstance(x, (Elements, Joints)) for x in parts):
        raise TypeError(f"{NAME}: give Elements and Joints; received {parts!r}.")
    elements = [x for x in parts if isinstance(x, Elements)]
    for x in elements:
        own = "" if x.each is None else ", each"
        require_function(NAME, repr(x), x.function, f"function(q, v, t, params{own})")
    joints = [x for x in parts if isinstance(x, Joints)]
    held = held_nodes.checked(held)
    of_mass = _checked_mass(mass, held)
    force = ElementForce(reduce(Sum, elements) if elements else None, held, of_mass)
    constraint = ElementConstraint(reduce(Rows, joints), held) if joints else None
    inertia = ElementInertia(of_mass) if of_mass.elements is not None else None
    return of_mass, force, constraint, inertia


def _checked_mass(mass: Any, held: Held | None) -> ElementMass:
    """The mass as it was given, checked."""
    given = list(mass) if isinstance(mass, (tuple, list)) and any(isinstance(x, Elements) for x in mass) else [mass]
    elements = [x for x in given if isinstance(x, Elements)]
    nodal = [x for x in given if not isinstance(x, Elements)]
    if len(nodal) > 1:
        raise TypeError(f"{NAME}: `mass` must hold one mass at the nodes, and Elements; received {mass!r}.")
    for x in elements:
        require_function(
            NAME, "mass", x.function, "mass(q, w, params)" if x.each is None else "mass(q, w, params, each)"
        )
    if not nodal:
        return ElementMass(None, reduce(Sum, elements), held)
    at_nodes = nodal[0]
    if callable(at_nodes):
        require_function(NAME, "mass", at_nodes, "mass(params)")
    else:
        leaves = jax.tree.leaves(at_nodes)
        if at_nodes is None or not leaves or not all(is_real(x) or isinstance(x, (list, tuple)) for x in leaves):
            raise TypeError(f"{NAME}: `mass` must be arrays, a function of params, or Elements; received {mass!r}.")
        if not all(map(is_concrete, leaves)):
            raise TypeError(f"{NAME}: a `mass` that is differentiated must be a function of params; received a tracer.")
        if any(np.min(np.asarray(x), initial=np.inf) < 0 or not np.all(np.isfinite(np.asarray(x))) for x in leaves):
            raise ValueError(f"{NAME}: `mass` must be finite, and nowhere negative; received {at_nodes!r}.")
        at_nodes = Fixed(at_nodes)
    return ElementMass(at_nodes, reduce(Sum, elements) if elements else None, held)
