"""`Constant` and `Changing` of low_rank.py, for full and `Sparse` matrices; the latter report what a solve leaves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jax.numpy as jnp

from hhtjax.description import Array, PyTree
from hhtjax.numerics.linear_solve import Trusted
from hhtjax.numerics.low_rank import AtState, Changing, Constant, Known
from hhtjax.numerics.sparse_matrix import Sparse


class Factorized(Constant, Trusted):
    """`Constant` of a `Sparse` matrix."""

    def leaves(self, f: Callable, b: Array, x: Array) -> Array:
        """By the matrix itself, which has fewer entries than the three that it is the sum of."""
        return super().leaves(lambda x: self.A0 @ x, b, x)


@dataclass(frozen=True)
class KnownSparse(Known, Trusted):
    """`ChangingSparse` at a state."""


class ChangingSparse(Changing, AtState, Trusted):
    """`Changing` of a `Sparse` matrix, with few rows and columns that change."""

    def around(self, state, along: Callable) -> KnownSparse:
        """The `factorize` for the matrix at a state."""
        known = super().around(state, along)
        return KnownSparse(known.matrices, known.J)

    def of_map(self, f, like: PyTree):
        """The same where the map f is known instead of the state."""
        J = jnp.stack([self.columns @ (self.A0 @ e - f(e)) for e in self.columns], axis=1)
        return KnownSparse(self, J).of_map(f, like)


def kept(A) -> Constant | Factorized:
    """The `Constant` of a matrix."""
    return (Factorized if isinstance(A, Sparse) else Constant)(A)


def changing(
    A: Array | Sparse, slope: Callable, spread: Callable, size: int | None, inverse=None
) -> Changing | ChangingSparse:
    """The `Changing` of a matrix and a part."""
    return (ChangingSparse if isinstance(A, Sparse) else Changing)(A, slope, spread, size, inverse)
