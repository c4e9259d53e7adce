"""Systems assembled from many small parts: elements between nodes, joints between them, and nodes that are held.

Each part is a function of its own few nodes. Which nodes these are determines which unknowns are coupled, and so how a
step is solved: see `step_sparsity.py`, and `hhtjax.numerics.sparse_lu`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial, reduce
from hashlib import blake2b
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from hhtjax.checks import require_function, takes
from hhtjax.description import Array, PyTree, Real, is_array, is_concrete
from hhtjax.primitives import Linear

FEW = 4  # nodes of a part whose forces are added one by one
LARGEST_NODE = 2**31 - 1  # in 32-bit indices
MOST_SHARED = 16  # elements at a node, up to which their forces are gathered


class Fixed:
    """A pytree of arrays that is part of the program, and compared by its values."""

    def __init__(self, tree: PyTree):
        self.tree = jax.tree.map(np.asarray, tree)
        leaves, structure = jax.tree.flatten(self.tree)
        digest = blake2b(digest_size=16)
        for x in leaves:
            digest.update(repr((x.shape, x.dtype.str)).encode() + np.ascontiguousarray(x).tobytes())
        self._key = structure, digest.digest()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Fixed) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    def __repr__(self):
        return ", ".join(str(x.shape) for x in jax.tree.leaves(self.tree))


@dataclass(frozen=True, repr=False)
class _OnNodes:
    """Base class of elements and joints: a function of some nodes, evaluated for every row of `nodes`."""

    function: Callable
    nodes: Any  # given as an array, kept as `Fixed`
    each: Any = None

    signatures: ClassVar = ()

    def __post_init__(self):
        name = type(self).__name__
        signatures = [x + ", each" * (self.each is not None) for x in self.signatures]
        if not callable(self.function) or not any(takes(self.function, x.count(",") + 1) for x in signatures):
            require_function(name, "function", self.function, f"function({signatures[0]})")
        nodes = self.nodes if isinstance(self.nodes, Fixed) else _checked_nodes(name, self.nodes)
        object.__setattr__(self, "nodes", nodes)
        if self.each is not None and not isinstance(self.each, Fixed):
            each = self.each
            if callable(each):
                require_function(name, "each", each, "each(params)")
            else:
                each = Fixed(self._checked_each(each))
            object.__setattr__(self, "each", each)

    def __repr__(self):
        return f"{type(self).__name__}({getattr(self.function, '__name__', self.function)}, {self.count} of them)"

    @property
    def count(self) -> int:
        """E, the number of rows."""
        return len(jax.tree.leaves(self.nodes.tree)[0])

    def own(self, tree: PyTree) -> PyTree:
        """The leaves (E, k, ...) of a pytree whose first axis counts nodes."""
        nodes = self.nodes.tree
        if not isinstance(nodes, dict):
            return _taken(type(self).__name__, tree, nodes)
        if not isinstance(tree, dict):
            raise ValueError(
                f"{type(self).__name__}: `nodes` must be an array, because the position is not a dict; received the "
                f"keys {sorted(nodes)}."
            )
        unknown = [key for key in nodes if key not in tree]
        if unknown:
            raise ValueError(
                f"{type(self).__name__}: `nodes` has the keys {unknown}, which the position does not have."
            )
        return {key: _taken(type(self).__name__, tree[key], nodes[key]) for key in sorted(nodes)}

    def dofs(self, v: PyTree) -> np.ndarray:
        """(E, s): the indices of the unknowns of each row, in the order in which its leaves are ravelled."""
        return np.concatenate(self.dofs_of_leaves(v), axis=1)

    def dofs_of_leaves(self, v: PyTree) -> list[np.ndarray]:
        """The indices of the unknowns of each row, for each leaf."""
        return _numbers(self, v)

    def own_numbers(self, params: PyTree, dtype: np.dtype) -> tuple:
        """(each,) with leaves (E, ...), or (); and the axes for vmap in the same structure."""
        if self.each is None:
            return (), ()
        each = self._checked_each(self.each(params)) if callable(self.each) else self.each.tree
        each = jax.tree.map(
            lambda x: x if jnp.issubdtype(jnp.result_type(x), jnp.integer) else jnp.asarray(x, dtype), each
        )
        return (each,), (jax.tree.map(lambda x: 0 if jnp.ndim(x) else None, each),)

    def mapped(self, f: Callable, params: PyTree, *of_nodes: PyTree) -> PyTree:
        """f(own leaves of each argument, and of `each`) for all rows of `nodes`, in the dtype of the last argument."""
        own, axes = self.own_numbers(params, jnp.result_type(jax.tree.leaves(of_nodes[-1])[0]))
        return jax.vmap(f, (*(0 for _ in of_nodes), *axes))(*map(self.own, of_nodes), *own)

    def _checked_each(self, each: PyTree) -> PyTree:
        for path, x in jax.tree_util.tree_leaves_with_path(each):
            if jnp.ndim(x) and jnp.shape(x)[0] != self.count:
                raise ValueError(
                    f"{type(self).__name__}: `each{jax.tree_util.keystr(path)}` must be a number, or have one row for "
                    f"each of the {self.count} rows of `nodes`; received shape {jnp.shape(x)}."
                )
        return each


@dataclass(frozen=True, repr=False)
class Elements(_OnNodes):
    """Elements of one kind between nodes, for `System.from_elements`.

    Args:
        function: the generalised force on the nodes of ONE element, `function(q, v, t, params)`. q and v have leaves
            (k, ...) for its k nodes; the result is structured like v (a dict may omit keys without force). It is
            differentiated: an element without a derivative in its undeformed state, such as a cable of length 0, must
            be written so that it has one. As `mass`, it returns M w of one element, `function(q, w, params)`.
        nodes: (E, k) integers, the nodes of each element. If q is a dict of several sets of nodes, a dict of such
            arrays; the function then receives them by these keys.
        each: data that differ between elements: a pytree of arrays (E, ...), and of numbers that all share, or a
            function of params that returns one. The function then receives its own part as its last argument.

    Raises:
        TypeError, ValueError: an argument of a wrong kind or shape.

    >>> import jax.numpy as jnp, numpy as np, hhtjax
    >>> def spring(q, v, t, params, each):
    ...     pull = each["k"] * (q[1] - q[0])
    ...     return jnp.stack([pull, -pull])
    >>> hhtjax.Elements(spring, np.arange(4)[:, None] + [0, 1], each={"k": 3.0})
    Elements(spring, 4 of them)
    """

    signatures: ClassVar = ("q, v, t, params", "q, w, params")  # of a force, and of a mass

    def __call__(self, q: PyTree, v: PyTree, t: Real, params: PyTree) -> PyTree:
        """The force on all nodes, structured like v."""

        def force(q: PyTree, v: PyTree, *each) -> PyTree:
            return self.complete(v, self.function(q, v, t, params, *each))

        return self.added(v, self.mapped(force, params, q, v))

    def product(self, q: PyTree, w: PyTree, params: PyTree) -> PyTree:
        """M w of all nodes, if the function returns that of one element."""

        def product(q: PyTree, w: PyTree, *each) -> PyTree:
            return self.complete(w, self.function(q, w, params, *each))

        return self.added(w, self.mapped(product, params, q, w))

    def matrices(self, q: PyTree, v: PyTree, params: PyTree) -> Array:
        """(E, s, s): the masses of the elements."""

        def matrix(q: PyTree, v: PyTree, *each) -> Array:
            zero, unravel = ravel_pytree(jax.tree.map(jnp.zeros_like, v))

            def of(x: Array) -> Array:
                w = unravel(x)
                return ravel_pytree(self.complete(w, self.function(q, w, params, *each)))[0]

            return jax.jacfwd(of)(zero)

        return self.mapped(matrix, params, q, v)

    def added(self, v: PyTree, forces: PyTree) -> PyTree:
        """The sum of leaves (E, k, ...) of the elements at the nodes, structured like v."""
        nodes = self.nodes.tree
        if not isinstance(nodes, dict):
            return jax.tree.map(partial(_summed, nodes), v, forces)
        some = {key: jax.tree.map(partial(_summed, nodes[key]), v[key], forces[key]) for key in nodes}
        return {key: some[key] if key in some else jax.tree.map(jnp.zeros_like, v[key]) for key in v}

    def complete(self, v: PyTree, force: PyTree) -> PyTree:
        """A force of one element, with zeros for the keys that it omits."""
        if isinstance(v, dict) and isinstance(force, dict):
            unknown = sorted(set(force) - set(v))
            if unknown:
                raise ValueError(f"Elements: `function` returned the keys {unknown}, which the velocity does not have.")
            force = {key: force.get(key, jax.tree.map(jnp.zeros_like, v[key])) for key in v}
        shapes = [jax.tree.map(jnp.shape, x) for x in (force, v)]
        if shapes[0] != shapes[1]:
            raise ValueError(
                f"Elements: `function` must return a force structured like v of one element, of shapes {shapes[1]}; "
                f"received {shapes[0]}."
            )
        return force


@dataclass(frozen=True, repr=False)
class Joints(_OnNodes):
    """Joints of one kind between nodes, for `System.from_elements`: constraints of a few nodes each.

    Args:
        function: zero if ONE joint is closed, `function(q, t, params)` -> (m,), with independent rows.
        nodes, each: as in `Elements`.

    Raises:
        TypeError, ValueError: an argument of a wrong kind or shape.

    >>> import jax.numpy as jnp, hhtjax
    >>> def rod(q, t, params, each):
    ...     return jnp.sum((q[1] - q[0]) ** 2)[None] - each["length"] ** 2
    >>> hhtjax.Joints(rod, [[0, 1], [1, 2]], each={"length": jnp.array([1.0, 2.0])})
    Joints(rod, 2 of them)
    """

    signatures: ClassVar = ("q, t, params",)

    def __call__(self, q: PyTree, t: Real, params: PyTree) -> Array:
        """The rows of all joints, (J m,)."""
        rows = self.mapped(lambda q, *each: self.function(q, t, params, *each), params, q)
        if not is_array(rows) or jnp.ndim(rows) != 2:
            of_one = jax.tree.map(lambda x: jnp.shape(x)[1:], rows)
            raise ValueError(f"Joints: `function` must return the rows (m,) of one joint; received shape {of_one}.")
        return rows.ravel()


def _checked_nodes(name: str, nodes: PyTree) -> Fixed:
    """The nodes as arrays of integers; raises an error for anything else."""
    parts = nodes if isinstance(nodes, dict) else {"": nodes}
    found = {}
    for key, x in parts.items():
        where = f"nodes[{key!r}]" if key else "nodes"
        if not is_concrete(x):
            raise TypeError(f"{name}: `{where}` must be known while a program is traced; received a tracer.")
        try:
            x = np.asarray(x)
        except ValueError:
            x = np.empty(0)
        if x.ndim != 2 or not x.size or x.dtype.kind not in "iu" or x.min() < 0 or x.max() > LARGEST_NODE:
            raise ValueError(
                f"{name}: `{where}` must be an array (E, k) of integers, 0 or more, a row for each; received "
                f"{'an array of ' + str(x.dtype) if x.size else 'none'} of shape {x.shape}."
            )
        found[key] = x.astype(np.int32)
    if len({len(x) for x in found.values()}) > 1:
        raise ValueError(f"{name}: `nodes` must have as many rows for each key; received {nodes!r}.")
    return Fixed(found if isinstance(nodes, dict) else found[""])


def _taken(name: str, tree: PyTree, nodes: np.ndarray) -> PyTree:
    """The leaves (E, k, ...) of these nodes."""

    def take(x: Array) -> Array:
        if not jnp.ndim(x) or nodes.max() >= x.shape[0]:
            raise ValueError(
                f"{name}: `nodes` contains node {int(nodes.max())}, but a leaf of the state has shape {jnp.shape(x)}: "
                "the first axis of all leaves must count the nodes, from 0."
            )
        x = jnp.asarray(x)
        rows = _at_nodes(nodes.tobytes(), nodes.shape, x.shape[0])(x.reshape(x.shape[0], -1))
        return rows.reshape(*nodes.shape, *x.shape[1:])

    return jax.tree.map(take, tree)


def _numbers(part: _OnNodes, v: PyTree) -> list[np.ndarray]:
    """(E, s) for each leaf: the unknowns of each element."""
    start, numbers = 0, []
    leaves, structure = jax.tree.flatten(v)
    for x in leaves:
        size = int(np.prod(np.shape(x), dtype=int))
        numbers.append(np.arange(start, start + size, dtype=np.int32).reshape(np.shape(x)))
        start += size
    tree, nodes = structure.unflatten(numbers), part.nodes.tree
    if isinstance(nodes, dict):
        own = {key: jax.tree.map(lambda x, i=i: x[i], tree[key]) for key, i in sorted(nodes.items())}
    else:
        own = jax.tree.map(lambda x: x[nodes], tree)
    return [x.reshape(len(x), -1) for x in jax.tree.leaves(own)]


def _summed(nodes: np.ndarray, x: Array, forces: Array) -> Array:
    """(N, ...) like x: the sum of forces (E, k, ...) on these nodes."""
    number = np.shape(x)[0]
    forces = forces.reshape(*nodes.shape, -1)
    return _at_nodes(nodes.tobytes(), nodes.shape, number).transpose(forces).reshape(np.shape(x))


@lru_cache(maxsize=256)
def _at_nodes(nodes: bytes, shape: tuple, number: int) -> Linear:
    """The map from (..., number, r) to the rows (..., E, k, r) at nodes (E, k); its transpose sums rows.

    If each element starts one node after the previous one, as in chains, both use slices; otherwise gathers."""
    places = np.frombuffer(nodes, np.int32).reshape(shape)
    starts = places[0]
    if np.array_equal(places, starts + np.arange(shape[0])[:, None]):
        return _in_turn([int(x) for x in starts], shape[0], number)
    rows = places.ravel()
    table = table_of(rows, number) if len(rows) > FEW else None

    def take(x: Array) -> Array:
        return x.at[..., rows, :].get(mode="promise_in_bounds").reshape(*x.shape[:-2], *shape, x.shape[-1])

    def add(y: Array) -> Array:
        y = y.reshape(*y.shape[:-3], -1, y.shape[-1])
        if table is None:
            return jnp.zeros((*y.shape[:-2], number, y.shape[-1]), y.dtype).at[..., rows, :].add(y)
        y = jnp.concatenate([y, jnp.zeros_like(y[..., :1, :])], axis=-2)
        return reduce(jnp.add, [y.at[..., row, :].get(mode="promise_in_bounds") for row in table])

    return Linear(take, add)


def _in_turn(starts: list[int], count: int, number: int) -> Linear:
    """As above, for elements i with the nodes starts + i."""

    def take(x: Array) -> Array:
        return jnp.stack([x[..., s : s + count, :] for s in starts], axis=-2)

    def add(y: Array) -> Array:
        none = [(0, 0)] * (y.ndim - 3)
        ends = [(s, number - count - s) for s in starts]
        return reduce(jnp.add, [jnp.pad(y[..., i, :], [*none, x, (0, 0)]) for i, x in enumerate(ends)])

    return Linear(take, add)


def pairs_of(dofs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the matrices (E, s, s) of elements with the unknowns dofs (E, s), flattened."""
    s = dofs.shape[1]
    return np.repeat(dofs, s, axis=1).ravel(), np.tile(dofs, (1, s)).ravel()


def table_of(places: np.ndarray, number: int, most: int = MOST_SHARED) -> Any:
    """(d, number): the entries of a list that belong to each place, padded with the length of the list. None if there
    are more than `most`."""
    count = np.bincount(places, minlength=number)
    if count.max(initial=0) > most:
        return None
    order = np.argsort(places, kind="stable")
    rank = np.arange(len(places)) - (np.cumsum(count) - count)[places[order]]
    found = np.full((max(1, int(count.max(initial=1))), number), len(places), np.int32)
    found[rank, places[order]] = order
    return found


# ----------------------------------------------------------------------------
# Sums of parts. Classes of functions: equal parts give equal systems, and what a function reads is looked at.


@dataclass(frozen=True)
class Sum:
    """The sum of two forces, or of two products M w."""

    first: Any
    second: Any

    def __call__(self, q: PyTree, v: PyTree, t: Real, params: PyTree) -> PyTree:
        return jax.tree.map(jnp.add, self.first(q, v, t, params), self.second(q, v, t, params))


@dataclass(frozen=True)
class Rows:
    """The rows of two constraints, concatenated."""

    first: Any
    second: Any

    def __call__(self, q: PyTree, t: Real, params: PyTree) -> Array:
        return jnp.concatenate([self.first(q, t, params), self.second(q, t, params)])


def parts_of(x: Any) -> list:
    """The elements, or joints, of a sum."""
    if x is None:
        return []
    return parts_of(x.first) + parts_of(x.second) if isinstance(x, (Sum, Rows)) else [x]
