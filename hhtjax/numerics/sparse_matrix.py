"""Sparse matrices with a static pattern and numbers that are data. Multiples and sums of them are sparse too."""

from __future__ import annotations

from functools import cached_property, lru_cache
from hashlib import blake2b
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.description import Array, PyTree, Real
from hhtjax.numerics.sparsity import dissected

PADDING = 2  # slots for each entry, up to which all entries have places in layers
WRITTEN_OUT = 32  # layers, up to which a product is one loop


class Pattern:
    """Where a matrix (n, n) has entries, rows and columns sorted by rows, and where their numbers are kept: in slots.

    The first width n slots are layers of one for each row, of which those without an entry hold 0: so a product is
    `width` gathers. What a few long rows have beyond is behind. Equal patterns are equal.
    """

    def __init__(self, n: int, rows: np.ndarray, columns: np.ndarray, free: int | None = None):
        """free: number of unknowns that elimination may take in any order; those behind are multipliers."""
        self.n, self.rows, self.columns = n, rows.astype(np.int32), columns.astype(np.int32)
        counts = np.bincount(rows, minlength=n)
        longest, nnz = int(counts.max(initial=1)), len(rows)
        self.width = longest if longest * n <= PADDING * max(nnz, n) else -(-nnz // n)
        rank = np.arange(nnz) - (np.cumsum(counts) - counts)[rows]  # of an entry within its row
        late = rank >= self.width
        self.slots = np.where(late, self.width * n + np.cumsum(late) - 1, rank * n + rows).astype(np.int32)
        self.tail = rows[late].astype(np.int32), columns[late].astype(np.int32)
        self.size = self.width * n + int(late.sum())
        self.free = n if free is None else free
        digest = blake2b(np.array([n, self.free]).tobytes(), digest_size=16)
        for x in (self.rows, self.columns):
            digest.update(x.tobytes())
        self.digest = digest.digest()

    def __eq__(self, other: Pattern) -> bool:
        return isinstance(other, Pattern) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)

    def __repr__(self):
        return f"<{len(self.rows)} entries of ({self.n}, {self.n})>"

    @cached_property
    def layers(self) -> np.ndarray:
        """(width, n): the columns of the first slots."""
        found = np.tile(np.arange(self.n, dtype=np.int32), self.width)
        early = self.slots < self.width * self.n
        found[self.slots[early]] = self.columns[early]
        return found.reshape(self.width, self.n)

    @cached_property
    def filled(self) -> np.ndarray:
        """Which slots hold an entry: what others hold is none, as after a step along a gradient."""
        found = np.zeros(self.size, bool)
        found[self.slots] = True
        return found

    @cached_property
    def elimination(self) -> Elimination:
        """The order in which it is eliminated, with little fill."""
        from scipy.sparse import csr_array

        entries = csr_array((np.ones(len(self.rows), bool), (self.rows, self.columns)), shape=(self.n, self.n))
        order = dissected(entries, self.free)
        place = np.empty(self.n, np.intc)
        place[order] = np.arange(self.n, dtype=np.intc)
        rows, columns = place[self.rows], place[self.columns]
        sort = np.lexsort((rows, columns))
        starts = np.concatenate([[0], np.cumsum(np.bincount(columns, minlength=self.n))]).astype(np.intc)
        return Elimination(order, self.slots[sort], rows[sort], columns[sort], starts)

    def spread(self, numbers: np.ndarray) -> np.ndarray:
        """Those of the entries, in their slots."""
        found = np.zeros(self.size, np.result_type(numbers))
        found[self.slots] = numbers
        return found


class Elimination(NamedTuple):
    """The columns of a matrix in an order, as SuperLU takes them. order: (n,), the unknowns; slots, rows, columns: of
    each entry; starts: of each column."""

    order: np.ndarray
    slots: np.ndarray
    rows: np.ndarray
    columns: np.ndarray
    starts: np.ndarray


@jax.tree_util.register_pytree_node_class
class Sparse:
    """A sparse matrix (n, n), whose multiples and sums are such; made by `sparse`. values: by the slots of pattern."""

    __array_ufunc__ = None  # a number of NumPy leaves products to us
    ndim = 2

    def __init__(self, values, pattern: Pattern):
        self.values, self.pattern = values, pattern

    def tree_flatten(self):
        """The numbers are data."""
        return (self.values,), self.pattern

    @classmethod
    def tree_unflatten(cls, pattern: Pattern, data: PyTree) -> Sparse:
        """Inverse of `tree_flatten`."""
        return cls(data[0], pattern)

    def __repr__(self):
        return f"sparse({self.pattern})"

    @property
    def shape(self):
        """(n, n)."""
        return self.pattern.n, self.pattern.n

    @property
    def dtype(self) -> np.dtype:
        """Of the numbers."""
        return self.values.dtype

    @property
    def nnz(self) -> int:
        """How many entries it has, as matrices of SciPy tell it."""
        return len(self.pattern.rows)

    def __len__(self) -> int:
        return self.pattern.n

    def tocoo(self):
        """The same in SciPy's format of coordinates."""
        from scipy.sparse import coo_array

        p = self.pattern
        return coo_array((np.asarray(self.values)[p.slots], (p.rows, p.columns)), shape=self.shape)

    def astype(self, dtype: np.dtype):
        """The same, with numbers of this dtype."""
        return Sparse(jnp.asarray(self.values).astype(dtype), self.pattern)

    def diagonal(self) -> Array:
        """(n,)."""
        p = self.pattern
        here = p.rows == p.columns
        found = np.full(p.n, p.size, np.int32)
        found[p.rows[here]] = p.slots[here]
        return gather(jnp.append(self.values, jnp.zeros_like(self.values[:1])), found)

    def __abs__(self):
        return Sparse(jnp.abs(self.values), self.pattern)

    def __neg__(self) -> Sparse:
        return Sparse(-self.values, self.pattern)

    def __mul__(self, factor: Real) -> Sparse:
        if jnp.ndim(factor):
            return NotImplemented
        return Sparse(self.values * factor, self.pattern)

    __rmul__ = __mul__

    def __truediv__(self, divisor: int) -> Sparse:
        return Sparse(self.values / divisor, self.pattern) if not jnp.ndim(divisor) else NotImplemented

    def __add__(self, other: Sparse) -> Sparse:
        if not isinstance(other, Sparse):
            return self if isinstance(other, int) and other == 0 else NotImplemented  # sum() begins with 0
        return combined((1, self), (1, other))

    __radd__ = __add__

    def __sub__(self, other: Sparse) -> Sparse:
        return self + -other if isinstance(other, Sparse) else NotImplemented

    def __matmul__(self, x: Array) -> Array:
        """A x, for x (n,)."""
        p = self.pattern
        values = jnp.where(p.filled, self.values, 0) if p.size > self.nnz else self.values
        layers = values[: p.width * p.n].reshape(p.width, p.n)
        if p.width <= WRITTEN_OUT:
            y = sum((a * gather(x, i) for a, i in zip(layers, p.layers, strict=True)), jnp.zeros_like(x))
        else:
            step = lambda y, layer: (y + layer[0] * gather(x, layer[1]), None)  # noqa: E731
            y, _ = lax.scan(step, jnp.zeros_like(layers[0]), (layers, jnp.asarray(p.layers)))
        rows, columns = p.tail
        return y.at[rows].add(values[p.width * p.n :] * gather(x, columns)) if len(rows) else y


def gather(x: Array, i: np.ndarray) -> Array:
    """x[i], for constant i within its bounds, of which XLA need not be convinced."""
    numbers = lax.GatherDimensionNumbers(offset_dims=(), collapsed_slice_dims=(0,), start_index_map=(0,))
    return lax.gather(x, jnp.asarray(i)[..., None], numbers, (1,), mode=lax.GatherScatterMode.PROMISE_IN_BOUNDS)


def of_scipy(matrix) -> Sparse:
    """The `Sparse` of a square matrix of scipy.sparse."""
    entries = matrix.tocsr()
    entries.sum_duplicates()
    n = entries.shape[0]
    pattern = Pattern(n, np.repeat(np.arange(n), np.diff(entries.indptr)), entries.indices)
    return Sparse(pattern.spread(entries.data), pattern)


def of_dense(A: Sparse) -> Sparse:
    """The same of a known full matrix; diagonals (n,) and what is `Sparse` stay so."""
    if isinstance(A, Sparse) or A.ndim == 1:
        return A
    A = np.asarray(A)
    rows, columns = np.nonzero(A)
    pattern = Pattern(len(A), rows, columns)
    return Sparse(pattern.spread(A[rows, columns]), pattern)


def combined(*terms):
    """The sum of factor times matrix, of pairs; matrices are `Sparse`, one at least, or diagonals (n,)."""
    n = next(len(A) for _, A in terms if isinstance(A, Sparse))
    terms = [(c, A if isinstance(A, Sparse) else Sparse(A, diagonal_pattern(n))) for c, A in terms]
    pattern, places = union(*(A.pattern for _, A in terms))
    return Sparse(
        sum(c * gather(jnp.append(A.values, jnp.zeros_like(A.values[:1])), i)
            for (c, A), i in zip(terms, places, strict=True)), pattern)  # fmt: skip


@lru_cache(maxsize=64)
def diagonal_pattern(n):
    """Of a diagonal matrix."""
    return Pattern(n, np.arange(n), np.arange(n))


@lru_cache(maxsize=64)
def union(*patterns: Pattern):
    """The pattern of a sum, and for each term the slot of every slot of the sum; its size, where it has none."""
    n = patterns[0].n
    keys = [p.rows.astype(np.int64) * n + p.columns for p in patterns]
    every = np.unique(np.concatenate(keys))
    pattern, places = Pattern(n, every // n, every % n), []
    for p, key in zip(patterns, keys, strict=True):
        place = np.full(pattern.size, p.size, np.int32)
        place[pattern.slots[np.searchsorted(every, key)]] = p.slots
        places.append(place)
    return pattern, places
