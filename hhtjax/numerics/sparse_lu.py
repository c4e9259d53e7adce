"""The solve of a step whose matrix is sparse: its entries by products with a few vectors, and an elimination by blocks.

The pattern says how few products tell all entries: one for each colour of its columns. Where the unknowns can be put in
a row of small blocks, as in chains, beams, cables and rings of them, the elimination is a loop over these that stays in
the kernel; else it is SuperLU's, in an order found once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial, reduce
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.description import Array, PyTree
from hhtjax.numerics.block_tridiagonal import block_pivots, factorize_blocks, solve_blocks
from hhtjax.numerics.dense_lu import factorize
from hhtjax.numerics.linear_solve import Structured
from hhtjax.numerics.sparse_matrix import Pattern, Sparse, gather
from hhtjax.numerics.sparsity import colours, in_blocks, symmetric
from hhtjax.numerics.superlu import pivots_on_host
from hhtjax.primitives import part

if TYPE_CHECKING:
    from scipy.sparse import csr_array

LARGEST_BLOCK = 24  # unknowns, up to which a row of blocks is eliminated in a loop


class Plan:
    """How a matrix (n, n) with a pattern is found and factorised. free: number of unknowns that are no multipliers."""

    def __init__(self, pattern: csr_array, free: int):
        self.n, self.free = pattern.shape[0], free
        self.pattern = pattern
        self.blocks = in_blocks(pattern, free)
        self.colour = colours(pattern, self.blocks.order)
        self.number = int(self.colour.max(initial=-1)) + 1
        entries = pattern.tocoo()
        self.rows, self.columns = entries.row.astype(np.int32), entries.col.astype(np.int32)
        self.places = self.colour[self.columns] * self.n + self.rows  # of the entries, among images by colours

    @cached_property
    def column_of(self) -> np.ndarray:
        """(number, n): the column that an image by a colour shows in a row; n where it shows none."""
        found = np.full(self.number * self.n, self.n, np.int32)
        found[self.places] = self.columns
        return found.reshape(self.number, self.n)

    @cached_property
    def in_blocks(self) -> np.ndarray:
        """(3, N, b, b): where the entries of blocks before, on and behind the diagonal are among images; behind these
        are a 0, for entries that are none, and a 1, for the diagonal of places that are left empty."""
        _, starts, b = self.blocks
        N, zero = len(starts) - 1, self.number * self.n
        block, place = self.block, self.place
        found = np.full((3, N, b, b), zero, np.int32)
        row, column = self.rows, self.columns
        found[1 + block[column] - block[row], block[row], place[row], place[column]] = self.places
        empty = np.arange(b)[None, :] >= np.diff(starts)[:, None]
        i, k = np.nonzero(empty)
        found[1, i, k, k] = zero + 1
        return found

    @cached_property
    def block(self) -> np.ndarray:
        """(n,): the block of each unknown."""
        return self._per_unknown(np.arange(len(self.blocks.starts) - 1))

    @cached_property
    def place(self) -> np.ndarray:
        """(n,): its place there."""
        return np.argsort(self.blocks.order) - self._per_unknown(self.blocks.starts[:-1])

    def _per_unknown(self, of_blocks: np.ndarray) -> np.ndarray:
        found = np.empty(self.n, int)
        found[self.blocks.order] = np.repeat(of_blocks, np.diff(self.blocks.starts))
        return found

    @cached_property
    def slots(self) -> tuple[Pattern, np.ndarray]:
        """The `Pattern` for SuperLU, and where its slots are among images."""
        sort = np.lexsort((self.columns, self.rows))
        pattern = Pattern(self.n, self.rows[sort], self.columns[sort], self.free)
        places = np.full(pattern.size, self.number * self.n, np.int32)
        places[pattern.slots] = self.places[sort]
        return pattern, places

    def images(self, f: Callable, like: PyTree) -> Array:
        """(number, n): what the matrix of f makes of a vector for each colour, ones in the columns that have it."""
        probes = jnp.asarray(self.colour)[None, :] == jnp.arange(self.number)[:, None]
        return lax.stop_gradient(jax.vmap(f)(probes.astype(like.dtype)))

    def row_scale(self, images: Array) -> Array:
        """(n,): equations are measured by the square roots of their diagonal, and constraints by those of their
        unknowns, so that no units choose the pivots; as of `factorize_saddle_point`."""
        n, free = self.n, self.free
        d = jnp.abs(self.diagonal(images)[:free])
        first = 1 / jnp.sqrt(jnp.where(d == 0, 1, d))
        if free == n:
            return first
        unit = gather(jnp.append(first, jnp.zeros_like(first[:1])), np.minimum(self.column_of[:, free:], free))
        size = reduce(jnp.add, jnp.abs(images[:, free:]) * unit)
        return jnp.concatenate([first, 1 / jnp.where(size == 0, 1, size)])

    def diagonal(self, images: Array) -> Array:
        """(n,)."""
        here = np.full(self.n, self.number * self.n, np.int32)
        on = self.rows == self.columns
        here[self.rows[on]] = self.places[on]
        return gather(_with_ends(images), here)

    def inverse(self, images: Array) -> Callable:
        """(b, trans=0) -> A^-1 b, or A^-T b."""
        scale = self.row_scale(images)
        images = images * scale[None, :]
        solve = self._by_blocks(images) if self.blocks.size <= LARGEST_BLOCK else self._by_superlu(images)
        return lambda b, trans=0: scale * solve(b, 1) if trans else solve(scale * b, 0)

    def pivots(self, images: Array, limit: float) -> Array:
        """(n,): of the elimination without exchanges of a symmetric matrix, whose diagonal is made 1, not below a limit
        but for the pivot itself."""
        unit = self.diagonal(images)
        size = jnp.sqrt(jnp.where(unit > 0, unit, 1))
        column = gather(jnp.append(size, jnp.ones_like(size[:1])), self.column_of)
        found = _with_ends(images / size[None, :] / column)
        if self.blocks.size > LARGEST_BLOCK:
            return pivots_on_host(self.slots[0], gather(found, self.slots[1]), limit)
        blocks = part(partial(block_pivots, limit=limit))(*gather(found, self.in_blocks))
        return gather(blocks.ravel(), (self.block * blocks.shape[1] + self.place).astype(np.int32))

    def _by_blocks(self, images: Array) -> Callable:
        found = gather(_with_ends(images), self.in_blocks)
        factors = part(factorize_blocks)(*found)
        N, b = found.shape[1:3]
        if N * b == self.n and np.array_equal(self.blocks.order, np.arange(self.n)):
            return lambda x, trans: part(partial(solve_blocks, trans=trans))(factors, x.reshape(N, b)).ravel()
        there = (self.block * b + self.place).astype(np.int32)
        here = np.full(N * b, self.n, np.int32)
        here[there] = np.arange(self.n, dtype=np.int32)

        def solve(x: Array, trans: int) -> Array:
            x = gather(jnp.append(x, jnp.zeros_like(x[:1])), here).reshape(N, b)
            return gather(part(partial(solve_blocks, trans=trans))(factors, x).ravel(), there)

        return solve

    def _by_superlu(self, images: Array) -> Callable:
        pattern, places = self.slots
        return factorize(Sparse(gather(_with_ends(images), places), pattern))


def _with_ends(images: Array) -> Array:
    """The images in a row, a 0 and a 1 behind them."""
    return jnp.concatenate([images.ravel(), jnp.array([0, 1], images.dtype)])


@lru_cache(maxsize=32)
def _plan(shape: int, free: int, indptr: bytes, indices: bytes) -> Plan:
    from scipy.sparse import csr_array

    where = np.frombuffer(indices, np.int32), np.frombuffer(indptr, np.int32)
    return Plan(csr_array((np.ones(len(where[0]), bool), *where), shape=(shape, shape)), free)


def plan(pattern: csr_array, free: int | None = None) -> Plan:
    """The `Plan` of a pattern, made once for equal ones."""
    pattern = symmetric(pattern)
    pattern.sort_indices()
    n = pattern.shape[0]
    numbers = (np.ascontiguousarray(x, np.int32).tobytes() for x in (pattern.indptr, pattern.indices))
    return _plan(n, n if free is None else free, *numbers)


@dataclass(frozen=True, eq=False)
class SparseLU(Structured):
    """A solve by the patterns of all matrices that a run asks for.

    sparsity: () -> what has `plan(size)`, the `Plan` for so many unknowns, and `of_rows()`, that of B B^T.
    """

    sparsity: Callable
    tolerance: Any = None

    def of_map(self, f: Callable, like: PyTree):
        """(b, trans=0) -> A^-1 b, or A^-T b."""
        made = self.sparsity().plan(like.size)
        return made.inverse(made.images(f, like))

    def cosine_pivots(self, f: Callable, like: Array, limit: float) -> Array:
        """The pivots (m,) of B B^T, the matrix of f, each row of B being of length 1: the squared sines of its angles
        to the rows that are eliminated before. limit: below which a pivot is taken for this."""
        made = self.sparsity().of_rows()
        return made.pivots(made.images(f, like), limit)
