"""Frozen descriptions: hashable under jit, and pytrees whose arrays are data."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

VERSION = "0.1.0"  # of the library


def is_array(x):
    """Arrays, NumPy scalars and tracers are data; Python numbers are part of the program."""
    return isinstance(x, (jax.Array, np.ndarray, np.generic))


def is_concrete(x):
    """False for a tracer, whose value is not known while a function is being traced."""
    return not isinstance(x, Tracer)


def is_real(x):
    """A real number, or an array of them; no booleans, text, objects or complex numbers."""
    if is_array(x):
        return jnp.issubdtype(x.dtype, jnp.floating) or jnp.issubdtype(x.dtype, jnp.integer)
    return isinstance(x, (int, float)) and not isinstance(x, bool)


def _fingerprint(x):
    if not is_array(x):
        return x
    x = np.asarray(x)
    return x.shape, x.dtype.str, x.tobytes()


class Description:
    """Base of systems and steppers, which say what to compute and hold no state.

    A subclass is a frozen dataclass with `eq=False`. Arrays among its fields (a constant mass
    matrix, an `alpha` that is being differentiated) are leaves of the pytree; functions, Python
    numbers and strings are static. Two descriptions are equal, and hash alike, when all fields are.
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
        return data, (structure, static)

    @classmethod
    def tree_unflatten(cls, aux, data):
        """Inverse of `tree_flatten`; validates nothing, because JAX also calls it with placeholders."""
        structure, static = aux
        data = iter(data)
        fields = jax.tree.unflatten(structure, [next(data) if x is None else x for x in static])
        self = object.__new__(cls)
        for name, value in (*fields.items(), ("_places", tuple(x is None for x in static))):
            object.__setattr__(self, name, value)
        return self

    def _flatten(self):
        return jax.tree.flatten({name: value for name, value in vars(self).items() if name != "_places"})

    def __eq__(self, other):
        return type(self) is type(other) and self._key() == other._key()

    def __hash__(self):
        return hash((type(self), self._key()))

    def _key(self):
        leaves, structure = self._flatten()
        return structure, tuple(_fingerprint(x) for x in leaves)
