"""Checks of the arguments of element functions, made while tracing: the nodes, and the data of an element."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hhtjax.description import Array, PyTree, Real, is_array, is_real

KNOWN = {  # what an element of this room may hold, so that a misspelt name is no silent default
    "EA", "EI", "EIy", "EIz", "GA", "GAy", "GAz", "GJ", "J", "L", "a", "angle", "axis", "b", "c", "damping", "frame",
    "k", "m", "rest", "rhoA", "rhoI", "rhoIy", "rhoIz",
}  # fmt: skip


def require_nodes(caller: str, q: PyTree, **shapes: tuple):
    """Raises an error unless the dict q has these leaves in these shapes."""
    if not isinstance(q, dict) or not shapes.keys() <= q.keys():
        raise ValueError(f"{caller}: `q` must be a dict with the leaves {sorted(shapes)}; received {_keys(q)}.")
    for name, shape in shapes.items():
        if jnp.shape(q[name]) != shape:
            raise ValueError(f"{caller}: `q` must hold {name!r} in shape {shape}; received {jnp.shape(q[name])}.")


def shape_of(q: PyTree, name: str) -> tuple:
    """The shape of a leaf; (0, 0) if it is missing, which `require_nodes` then reports."""
    return (jnp.shape(q[name]) if isinstance(q, dict) and name in q else ()) or (0, 0)


def require_each(caller: str, each: PyTree, *needed: str):
    """Raises an error if `each` lacks a name, or has one that no element knows."""
    if not isinstance(each, dict) or not each.keys() >= set(needed):
        raise ValueError(f"{caller}: `each` must be a dict with {sorted(needed)}; received {_keys(each)}.")
    if unknown := each.keys() - KNOWN:
        raise ValueError(f"{caller}: `each` must hold names of {sorted(KNOWN)}; received {sorted(unknown)}.")


def number(caller: str, each: PyTree, name: str, like: Array, shape: tuple = ()) -> jax.Array:
    """An entry of `each`, in the dtype of an array."""
    value: Real = each[name]
    if not is_real(value) and not is_array(value):
        raise TypeError(f"{caller}: `each[{name!r}]` must be real; received {value!r}.")
    if jnp.shape(value) != shape:
        raise ValueError(f"{caller}: `each[{name!r}]` must have shape {shape}; received {jnp.shape(value)}.")
    return jnp.asarray(value, like.dtype)


def numbers(caller: str, each: PyTree, names: tuple, like: Array) -> jax.Array:
    """Several scalars in one vector."""
    return jnp.stack([number(caller, each, name, like) for name in names])


def _keys(tree: PyTree):
    return sorted(tree) if isinstance(tree, dict) else type(tree).__name__
