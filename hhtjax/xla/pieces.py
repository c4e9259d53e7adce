"""Small arrays taken to pieces: NumPy arrays of objects, which are scalars, traced or known.

One kind of known zero is more than a number: a structural one, of a unit vector, or of a tangent that cannot be
another. Its products are structural zeros too, and sums do without it.
"""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

LARGEST = 64  # numbers in an array that is taken to pieces; larger ones stay whole


class _Zero64(np.float64):
    """A structural zero."""


class _Zero32(np.float32):
    """The same in single precision."""


ZEROS: dict[Any, Any] = {np.dtype(np.float64): _Zero64(0), np.dtype(np.float32): _Zero32(0)}


def is_small(aval):
    """Whether arrays like this are taken to pieces; empty ones, which hold nothing to move, are not."""
    return 0 < math.prod(aval.shape) <= LARGEST and not jnp.issubdtype(aval.dtype, jax.dtypes.extended)


def is_in_pieces(value):
    """Or whole."""
    return isinstance(value, np.ndarray) and value.dtype == object


def is_known(x):
    """Whether an element is a number, and no tracer."""
    return isinstance(x, np.generic)


def is_structural(x):
    """Whether an element is a structural zero."""
    return isinstance(x, (_Zero64, _Zero32))


def unmarked(x):
    """The same element, without the mark of a structural zero."""
    return x.dtype.type(x) if is_structural(x) else x


def arranged(elements, shape):
    """The pieces of an array of this shape."""
    found = np.empty(len(elements), object)
    for i, x in enumerate(elements):  # one by one: NumPy would ask a tracer for its array
        found[i] = x
    return found.reshape(shape)


def pieces(x):
    """A small array taken to pieces; a large one as it is."""
    if isinstance(x, (np.ndarray, np.generic, int, float, complex)):
        x = np.asarray(x)
    if not is_small(x):
        return x
    return arranged([x[i] if x.shape else x[()] for i in np.ndindex(*x.shape)], x.shape)


def whole(value, aval):
    """The array of a value."""
    if not is_in_pieces(value):
        return value
    elements = [as_scalar(x, aval.dtype) for x in value.flat]
    return jnp.stack(elements).reshape(aval.shape) if aval.shape else elements[0]


def as_scalar(x, dtype):
    """An element as an array without axes."""
    return jnp.asarray(unmarked(x), dtype)


def each(f, value):
    """f of every element."""
    return arranged([f(x) for x in value.flat], value.shape) if is_in_pieces(value) else f(value)
