"""Frozen descriptions: hashable under jit, and pytrees whose arrays are data."""

from contextlib import nullcontext
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from hhtjax.description.current import Kind, current, programs, with_data  # noqa: F401

VERSION = "0.1.0"  # of the library

# words of signatures
Array = jax.Array  # of JAX, a tracer too
Real = Any  # a number, or an array of numbers of JAX or NumPy, on which arithmetic is not checked
PyTree = Any  # whatever structure of arrays a user has


PLAIN = frozenset([bool, int, float, complex, str, type(None)])


def is_array(x):
    """Whether it is an array, a NumPy scalar or a tracer, all of which are data; Python numbers are part of the
    program."""
    return type(x) not in PLAIN and isinstance(x, (jax.Array, np.ndarray, np.generic))  # which takes longer to say no


def is_concrete(x):
    """False for a tracer, whose value is unknown while a function is being traced."""
    return not isinstance(x, Tracer)


def all_concrete(tree):
    """Whether no leaf of a pytree is a tracer."""
    return all(map(is_concrete, jax.tree.leaves(tree)))


def is_tracing():
    """Whether a function is being traced, as inside a jit."""
    return not is_concrete(jnp.zeros(()))


def known_now(f, *args):
    """f(*args) as arrays of NumPy, also while something is being traced; None if it contains tracers, in args or closed
    over."""
    if not all_concrete(args):
        return None
    with jax.ensure_compile_time_eval() if is_tracing() else nullcontext():
        found = f(*args)
    return jax.tree.map(np.asarray, found) if all_concrete(found) else None


def as_float(x):
    """An array of floats; other numbers are converted to the default precision."""
    x = jnp.asarray(x)
    return x if jnp.issubdtype(x.dtype, jnp.floating) else x.astype(jnp.result_type(float))


def is_real(x):
    """Whether it is a real number, or an array of them; booleans, text, objects and complex numbers are not."""
    if is_array(x):
        return jnp.issubdtype(x.dtype, jnp.floating) or jnp.issubdtype(x.dtype, jnp.integer)
    return isinstance(x, (int, float)) and not isinstance(x, bool)


@jax.tree_util.register_pytree_node_class
class Fixed:
    """A function inside data, as a pytree without leaves, which makes it part of the program."""

    def __init__(self, function):
        self.function = function

    def __repr__(self):
        return repr(self.function)

    def tree_flatten(self):
        """No leaves."""
        return (), current(self.function)

    @classmethod
    def tree_unflatten(cls, function, _):
        """Inverse of `tree_flatten`."""
        return cls(function)


def freeze(tree):
    """The pytree with its leaves that are functions hidden, so that only data are left. Without functions it is
    returned unchanged.

    Modules of neural networks have such leaves: their activations. Callable arrays and tracers are not hidden.
    """
    leaves, structure = jax.tree.flatten(tree)
    hidden = [callable(x) and not is_array(x) and is_concrete(x) for x in leaves]
    if not any(hidden):
        return tree
    return structure.unflatten([Fixed(x) if hide else x for x, hide in zip(leaves, hidden, strict=True)])


def thaw(tree):
    """The inverse of `freeze`. A pytree without hidden functions is returned unchanged."""
    leaves, structure = jax.tree.flatten(tree, is_leaf=_is_fixed)
    if not any(map(_is_fixed, leaves)):
        return tree
    return structure.unflatten([x.function if _is_fixed(x) else x for x in leaves])


def _is_fixed(x):
    return isinstance(x, Fixed)


def _fingerprint(x):
    if not is_array(x):
        return x
    x = np.asarray(x)
    return x.shape, x.dtype.str, x.tobytes()


class Description:
    """Base class of systems and steppers, which describe a computation and hold no state.

    A subclass is a frozen dataclass with `eq=False`. Arrays among its fields (a constant mass matrix, an `alpha` that
    is being differentiated) are leaves of the pytree. Functions, in their `current` form, Python numbers and strings
    are static. Two descriptions are equal, and have the same hash, if all their fields are equal.
    """

    def __init_subclass__(cls):
        jax.tree_util.register_pytree_node_class(cls)

    def tree_flatten(self):
        """Arrays as leaves, everything else as static data."""
        leaves, structure = self._flatten()
        places = vars(self).get("_places")  # of the arrays, where JAX has put something else in
        if places is None or len(places) != len(leaves):
            places = tuple(map(is_array, leaves))
        data = [x for x, here in zip(leaves, places, strict=True) if here]
        static = tuple(None if here else x for x, here in zip(leaves, places, strict=True))
        return data, (structure, places, static)

    @classmethod
    def tree_unflatten(cls, aux, data):
        """Inverse of `tree_flatten`; validates nothing, because JAX also calls it with placeholders."""
        structure, places, static = aux
        data = iter(data)
        fields = jax.tree.unflatten(
            structure, [next(data) if here else x for x, here in zip(static, places, strict=True)]
        )
        self = object.__new__(cls)
        for name, value in (*fields.items(), ("_places", places)):
            object.__setattr__(self, name, value)
        return self

    def _flatten(self):
        fields = {
            name: current(value) if callable(value) and not isinstance(value, Description) else value
            for name, value in vars(self).items()
            if name != "_places"
        }
        return jax.tree.flatten(fields, is_leaf=lambda x: x is None)  # others put None in the place of an array

    def __eq__(self, other):
        return type(self) is type(other) and self._key() == other._key()

    def __hash__(self):
        return hash((type(self), self._key()))

    def _key(self):
        leaves, structure = self._flatten()
        return structure, tuple(_fingerprint(x) for x in leaves)
