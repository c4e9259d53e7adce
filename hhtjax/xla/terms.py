"""Derivatives that know what they depend on."""

from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.xla.kernels import structural

MOST_TERMS = 4  # beyond, a full array is no more work


@dataclass
class Terms:
    """dy/dx of an array y of this shape with respect to n unknowns x: the sum over (axis, offset) of

    dy[index]/dx[k] = along[axis, offset][index] where k = index[axis] + offset, and zero elsewhere;
    and dy[index]/dx[k] = full[k, index].
    """

    n: int
    shape: tuple
    along: dict = field(default_factory=dict)
    full: Any = None

    def map(self, f, shape, keys=lambda axis, offset: (axis, offset)):
        """The same of f(y), for a linear f that keeps indices along our axes apart, but may move them.

        keys: (axis, offset) before -> after, or None where f does not keep them apart.
        """
        moved = {key: keys(*key) for key in self.along}
        along = {new: f(self.along[key]) for key, new in moved.items() if new is not None}
        rest = Terms(self.n, self.shape, {key: self.along[key] for key, new in moved.items() if new is None}, self.full)
        return Terms(self.n, shape, along, jax.vmap(f)(rest.whole()) if rest.along or rest.full is not None else None)

    def __add__(self, other):
        keys = {**self.along, **other.along}
        along = {key: add_if_any(self.along.get(key), other.along.get(key)) for key in keys}
        both = Terms(self.n, self.shape, along, add_if_any(self.full, other.full))
        if both.full is None and len(along) <= MOST_TERMS:
            return both
        return Terms(self.n, self.shape, full=both.whole())  # to carry both would be twice the work

    def apart(self, axes):
        """The terms along these axes, and all the rest."""
        found = {key: y for key, y in self.along.items() if key[0] in axes}
        others = {key: y for key, y in self.along.items() if key not in found}
        return found, Terms(self.n, self.shape, others, self.full)

    def whole(self):
        """dy/dx as an array (n, *shape)."""
        shape, total = (self.n, *self.shape), self.full
        for (axis, offset), y in self.along.items():
            k, i = (lax.broadcasted_iota(jnp.int32, shape, j) for j in (0, axis + 1))
            y = lax.broadcast_in_dim(y, shape, range(1, len(shape)))
            there = lax.eq(k, lax.add(i, np.int32(offset)) if offset else i)
            total = add_if_any(total, lax.select(there, y, lax.broadcast(zero_like(y), shape)))
        return total


def zero_like(like):
    """Zero, where there is nothing to depend on."""
    return structural(np.zeros((), like.dtype))


def add_if_any(x, y):
    """x + y, where None is nothing."""
    return y if x is None else x if y is None else lax.add(x, y)
