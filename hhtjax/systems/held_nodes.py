"""Nodes of a system of elements that are held at their start, or move in a prescribed way.

The acceleration of a held coordinate is known, w = a(t), and this equation replaces its row. Elements and joints see
its prescribed position and velocity, so that errors of steps do not accumulate there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from hhtjax import rotation
from hhtjax.checks import require_function
from hhtjax.description import Array, PyTree, Real, known_now
from hhtjax.systems.kinematics import is_rotation
from hhtjax.xla import Programs

AGREES = 1e-6  # difference, relative to the size of a state, of a start from what is told


@dataclass(frozen=True)
class Still:
    """What is held at its start: True for the whole node, or booleans structured like it, as the repr of a pytree of
    tuples."""

    which: Any

    def __call__(self, *_):
        raise TypeError("a node that is held at its start is not a function of time")


@dataclass(frozen=True)
class Held:
    """Some nodes, how they are held (`Still`, or a function of t and params), and the `Held` of other nodes."""

    nodes: tuple
    alone: bool  # whether `nodes` was a number: leaves then have no axis for it
    how: Any
    rest: Any = None

    def __call__(self, *_):
        raise TypeError("a description of nodes is not a function")

    def all(self):
        """Iterates over the groups of nodes."""
        here = self
        while here is not None:
            yield here
            here = here.rest

    @property
    def moves(self) -> bool:
        """Whether some of them are moved."""
        return any(not isinstance(x.how, Still) for x in self.all())

    def told(self, v: PyTree, t: Real, params: PyTree):
        """Position, velocity and acceleration of these nodes, for the components that the function prescribes."""
        t = jnp.asarray(t, jnp.result_type(*jax.tree.leaves(v)))
        one = jnp.ones_like(t)

        def position(t: Real) -> PyTree:
            return jax.tree.map(lambda x: jnp.asarray(x, t.dtype), self.how(t, params))

        def velocity(t: Real) -> PyTree:
            q, rate = jax.jvp(position, (t,), (one,))
            return _paired(_rate, q, rate, self.here(v, q))

        v_told, w_told = jax.jvp(velocity, (t,), (one,))
        return position(t), v_told, w_told

    def here(self, tree: PyTree, part: PyTree = None) -> PyTree:
        """The leaves of these nodes; if a part is a dict, other sets of nodes need not have them."""
        places = self.nodes[0] if self.alone else np.array(self.nodes)
        if isinstance(tree, dict) and isinstance(part, dict):
            tree = {key: x for key, x in tree.items() if key in part or all(map(self._fit, jax.tree.leaves(x)))}
        for x in jax.tree.leaves(tree):
            if not self._fit(x):
                raise ValueError(
                    f"System.from_elements: `held` names node {max(self.nodes)}, but a leaf of the state has shape "
                    f"{jnp.shape(x)}: nodes are counted from 0."
                )
        return jax.tree.map(lambda x: x[places], tree)

    def _fit(self, x: Array) -> bool:
        """Whether a leaf has these nodes."""
        return bool(jnp.ndim(x)) and max(self.nodes) < x.shape[0]

    def put(self, tree: PyTree, part: PyTree) -> PyTree:
        """The pytree with this part at these nodes."""
        places = self.nodes[0] if self.alone else np.array(self.nodes)

        def placed(part: Array | None, x: Array) -> Array:
            if part is None:
                return x
            here = np.shape(places) + x.shape[1:]
            if jnp.shape(part) != here:
                raise ValueError(
                    f"System.from_elements: the result of `held` for {self.nodes} must have their shape {here}; "
                    f"received shape {jnp.shape(part)}."
                )
            return x.at[places].set(part)

        return _paired(placed, part, tree, whole=True)


def _rate(q: Array, qdot: Array, v: Array) -> Array:
    """The velocity of a leaf of nodes: its time derivative, or vee(R^T Rdot)."""
    if not is_rotation(q.shape, v.shape):
        return qdot
    vee = jnp.vectorize(lambda R, Rdot: rotation.vee(R.T @ Rdot), signature="(i,j),(i,j)->(i)")
    return vee(q, qdot)


def _paired(f: Callable, part: PyTree, *trees: PyTree, whole: bool = False) -> PyTree:
    """f on the leaves of a part and of pytrees. A dict as a part may omit keys; their leaves get None (whole), or are
    left out."""
    if not isinstance(trees[-1], dict):
        return jax.tree.map(f, part, *trees)
    if not isinstance(part, dict) or set(part) - set(trees[-1]):
        raise ValueError(
            f"System.from_elements: the result of `held` must be a dict with some of the keys {sorted(trees[-1])}; "
            f"received {part!r}."
        )
    found = {}
    for key in trees[-1]:
        if key in part:
            found[key] = jax.tree.map(f, part[key], *(tree[key] for tree in trees))
        elif whole:
            found[key] = jax.tree.map(lambda *x: f(None, *x), *(tree[key] for tree in trees))
    return found


def at(held: Held | None, q: PyTree, v: PyTree | None, t: Real, params: PyTree):
    """q and v (None if not needed) with prescribed values inserted, as elements see them. v may be any pytree of such
    shapes."""
    if held is None or not held.moves:
        return q, v
    like = v if v is not None else velocity_like(q)
    for some in held.all():
        if not isinstance(some.how, Still):
            position, velocity, _ = some.told(like, t, params)
            q = some.put(q, position)
            v = None if v is None else some.put(v, velocity)
    return q, v


def velocity_like(q: PyTree) -> PyTree:
    """Zeros structured like the velocity of a position: leaves (N, 3, 3) are rotations."""

    def zeros(x: Array) -> Array:
        shape = jnp.shape(x)
        return jnp.zeros(shape[:-1] if shape[1:] == (3, 3) else shape, jnp.result_type(x))

    return jax.tree.map(zeros, q)


class Known(NamedTuple):
    """The held coordinates, structured like v. here: which coordinates; moves: which of them are moved; a: their
    accelerations."""

    here: PyTree
    moves: PyTree
    a: PyTree


def accelerations(held: Held, v: PyTree, t: Real, params: PyTree) -> Known:
    """The held coordinates at a time."""
    known = moves = jax.tree.map(lambda x: jnp.zeros(jnp.shape(x), bool), v)
    a = jax.tree.map(jnp.zeros_like, v)
    for some in held.all():
        if isinstance(some.how, Still):
            which = some.how.which
            here = jax.tree.map(lambda x: np.zeros(np.shape(x), bool), some.here(v, which))
            if which is True:
                known = some.put(known, jax.tree.map(np.ones_like, here))
            else:
                known = some.put(known, _spread(which, here))
        else:
            _, _, told = some.told(v, t, params)
            all_of = jax.tree.map(lambda x: jnp.ones(x.shape, bool), told)
            known, moves, a = some.put(known, all_of), some.put(moves, all_of), some.put(a, told)
    return Known(known, moves, a)


def staying(held: Held | None, v: PyTree) -> np.ndarray | None:
    """(n,): which coordinates are held at their start; None if none is."""
    still = None
    for some in () if held is None else held.all():
        if isinstance(some.how, Still):
            still = Held(some.nodes, some.alone, some.how, still)
    if still is None:
        return None
    with jax.ensure_compile_time_eval():
        known = accelerations(still, jax.tree.map(lambda x: jnp.zeros(jnp.shape(x), x.dtype), v), 0.0, None).here
        return np.asarray(ravel_pytree(known)[0])


def _spread(which: PyTree, here: PyTree) -> PyTree:
    """Booleans of the shapes of a node, from one for each key, or for each component of it."""

    def spread(flag: np.ndarray, x: np.ndarray) -> np.ndarray:
        try:
            return np.broadcast_to(flag, np.shape(x))
        except ValueError:
            raise ValueError(
                f"System.from_elements: booleans of `held` must have the shape {np.shape(x)} of their nodes; received "
                f"shape {flag.shape}."
            ) from None

    return _paired(spread, _as_arrays(which), here)


def _as_arrays(which: PyTree) -> PyTree:
    if isinstance(which, dict):
        return {key: _as_arrays(x) for key, x in which.items()}
    return np.array(which, bool)


def checked(held: Any) -> Held | None:
    """The `Held` of a dict; raises an error for anything else."""
    if held is None or isinstance(held, Held):
        return held
    name = "System.from_elements"
    if not isinstance(held, dict):
        raise TypeError(f"{name}: `held` must be a dict, from nodes to how they are held; received {held!r}.")
    found = None
    for key, how in held.items():
        nodes = key if isinstance(key, tuple) else (key,)
        if not nodes or any(not isinstance(i, (int, np.integer)) or isinstance(i, bool) or i < 0 for i in nodes):
            raise ValueError(f"{name}: the keys of `held` must be nodes, or tuples of nodes; received {key!r}.")
        nodes = tuple(map(int, nodes))
        if callable(how):
            require_function(name, f"held[{key!r}]", how, "held(t, params)")
        else:
            how = Still(_checked_flags(name, key, how))
        found = Held(nodes, not isinstance(key, tuple), how, found)
    return found


def _checked_flags(name: str, key: Any, how: Any) -> Any:
    """True, or a hashable pytree of booleans."""
    if how is True:
        return True
    if isinstance(how, dict) and how:
        return _Flags({k: _checked_flags(name, key, x) for k, x in how.items()})
    array = np.asarray(how)
    if array.dtype == bool and array.ndim:
        return tuple(array.tolist()) if array.ndim == 1 else tuple(map(tuple, array.tolist()))
    raise TypeError(
        f"{name}: `held[{key!r}]` must be True, booleans structured like a node, or a function (t, params); received "
        f"{how!r}."
    )


class _Flags(dict):
    """A dict that is hashable."""

    def __hash__(self) -> int:  # type: ignore[override]
        return hash(tuple(sorted(self.items())))


def require_held_start(caller: str, system: Any, q0: PyTree, v0: PyTree, t0: Real, params: PyTree):
    """Raises an error if a concrete start differs from what `held` prescribes."""
    if getattr(getattr(system, "force", None), "held", None) is None:
        return
    found = known_now(_known_start, system, q0, v0, t0, params)
    if found is None:
        return
    q, v, stays = found
    rest = jax.tree.map(lambda x, still: np.where(still, 0, x), v, stays)
    for name, given, told in (("q0", q0, q), ("v0", v0, rest)):
        for (path, x), y in zip(jax.tree_util.tree_leaves_with_path(given), jax.tree.leaves(told), strict=True):
            x = np.asarray(x)
            agrees = max(AGREES, 100 * float(jnp.finfo(y.dtype).eps))
            apart = np.abs(x - y).reshape(len(x), -1).max(axis=1)
            if np.max(apart) > agrees * max(1.0, np.max(np.abs(y))):
                node = int(np.argmax(apart))
                raise ValueError(
                    f"{caller}: `{name}{jax.tree_util.keystr(path)}` of node {node} must be what `held` prescribes at "
                    f"the start, {y[node]}; received {x[node]}."
                )


@Programs
def _known_start(system: Any, q0: PyTree, v0: PyTree, t0: Real, params: PyTree):
    """q0 and v0 with prescribed values inserted, and which coordinates are held."""
    held = system.force.held
    known = accelerations(held, v0, t0, params)
    return *at(held, q0, v0, t0, params), jax.tree.map(lambda here, moves: here & ~moves, known.here, known.moves)
