"""Solves with the sparse matrix of a step: computation of its entries, and elimination by blocks or by SuperLU.

A matrix is given as numbers, and a table of the numbers that add up to each entry. The numbers are those of elements,
or products of the matrix with a few vectors, one for each colour of its columns. If the unknowns can be arranged in a
row of small blocks, as in chains, beams, cables and rings of them, the elimination is a loop over the blocks inside a
kernel. Otherwise SuperLU is used, with an order of elimination that is found once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial, reduce
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.description import Array, PyTree
from hhtjax.numerics.block_tridiagonal import block_pivots, factorize_blocks, solve_blocks
from hhtjax.numerics.linear_solve import Structured
from hhtjax.numerics.low_rank import Completed
from hhtjax.numerics.sparse_matrix import Pattern, Sparse, gather
from hhtjax.numerics.sparsity import colours, in_blocks, symmetric
from hhtjax.numerics.superlu import factorize_sparse, pivots_on_host
from hhtjax.primitives import part, staged

if TYPE_CHECKING:
    from scipy.sparse import csr_array

LARGEST_BLOCK = 24  # unknowns, up to which a row of blocks is eliminated in a loop


class Numbers(NamedTuple):
    """A matrix by what its entries are sums of. values: (k,); table: (d, entries) of places there, k for nothing."""

    values: Array
    table: np.ndarray


class Blocks(NamedTuple):
    """A matrix as a row of blocks: those before, on and behind the diagonal, (N, b, b) each."""

    lower: Array
    middle: Array
    upper: Array


class Plan:
    """How a matrix (n, n) with a pattern is factorised. free: number of unknowns that are no multipliers.

    rows, columns: of its entries.
    """

    def __init__(self, pattern: csr_array, free: int):
        self.n, self.free, self.pattern = pattern.shape[0], free, pattern
        entries = pattern.tocoo()
        self.rows, self.columns = entries.row.astype(np.int32), entries.col.astype(np.int32)
        self.blocks = in_blocks(pattern, free)

    @property
    def is_in_blocks(self) -> bool:
        """Whether it is eliminated in a row of small blocks."""
        return self.blocks.size <= LARGEST_BLOCK

    @cached_property
    def colour(self) -> np.ndarray:
        """(n,): of each column."""
        return colours(self.pattern, self.blocks.order)

    def by_products(self, f: Callable, like: PyTree) -> Numbers | Blocks:
        """The matrix of a linear map f, by its products with a vector for each colour."""
        if self.is_full:
            return self._blocks_by_products(f, like)
        number = int(self.colour.max()) + 1
        probes = jnp.asarray(self.colour)[None, :] == jnp.arange(number)[:, None]
        images = lax.stop_gradient(jax.vmap(f)(probes.astype(like.dtype)))
        return Numbers(images.ravel(), (self.colour[self.columns] * self.n + self.rows)[None])

    def inverse(self, A: Numbers | Blocks) -> Callable:
        """(b, trans=0) -> A^-1 b, or A^-T b."""
        if isinstance(A, Blocks) or self.is_in_blocks:
            return self._by_blocks(A)
        return self._by_superlu(A)

    def pivots(self, A: Numbers | Blocks, limit: float) -> Array:
        """(n,): of the elimination without exchanges of a symmetric matrix, whose diagonal is made 1; what is divided
        by is not less than `limit`."""
        if not (isinstance(A, Blocks) or self.is_in_blocks):
            sparse = self._sparse(A)
            d = sparse.diagonal()
            return pivots_on_host(_scaled_on_both_sides(sparse, 1 / jnp.sqrt(jnp.where(d > 0, d, 1))), limit)
        lower, middle, upper = self._in_blocks(A)
        d = _diagonals(middle)
        unit = 1 / jnp.sqrt(jnp.where(d > 0, d, 1))
        before, behind = (jnp.roll(unit, shift, axis=0) for shift in (1, -1))
        blocks = [unit[:, :, None] * x * y[:, None, :] for x, y in ((lower, before), (middle, unit), (upper, behind))]
        return gather(part(partial(block_pivots, limit=limit))(*blocks).ravel(), self.there)

    # in blocks

    @cached_property
    def is_full(self) -> bool:
        """Whether all blocks have one size, and computing them takes no fewer colours than three for each place."""
        N, b = len(self.blocks.starts) - 1, self.blocks.size
        return self.is_in_blocks and N > 1 and N * b == self.n and self.colour.max() + 1 >= 3 * b

    def _blocks_by_products(self, f: Callable, like: PyTree) -> Blocks:
        """The blocks, by products with what is 1 at one place of every third block."""
        b = self.blocks.size
        colour = jnp.asarray(self.block % 3 * b + self.place)
        probes = colour[None, :] == jnp.arange(3 * b)[:, None]
        images = lax.stop_gradient(jax.vmap(f)(probes.astype(like.dtype)))
        images = jnp.moveaxis(self._rows_of(images).reshape(3, b, -1, b), 1, -1)  # (3, N, b, b)
        own = np.arange(images.shape[1]) % 3

        def at(shift: int) -> Array:
            third = (own + shift) % 3
            one, two = (jnp.asarray(third == i)[:, None, None] for i in (1, 2))
            return jnp.where(one, images[1], jnp.where(two, images[2], images[0]))

        return Blocks(at(-1), at(0), at(1))

    def _rows_of(self, x: Array) -> Array:
        """(..., N, b) of (..., n): unknowns as full blocks have them."""
        columns, N = self.unknowns.T, len(self.unknowns)
        if all(np.array_equal(i, i[0] + np.arange(N) * (i[1] - i[0])) and i[1] > i[0] for i in columns):
            return jnp.stack([x[..., i[0] : i[-1] + 1 : i[1] - i[0]] for i in columns], axis=-1)
        return jnp.stack([x.at[..., i].get(mode="promise_in_bounds") for i in columns], axis=-1)

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
    def there(self) -> np.ndarray:
        """(n,): where each unknown is in the blocks (N, b)."""
        return (self.block * self.blocks.size + self.place).astype(np.int32)

    @cached_property
    def unknowns(self) -> np.ndarray:
        """(N, b): which unknown is where in the blocks; n where a place is empty."""
        found = np.full((len(self.blocks.starts) - 1, self.blocks.size), self.n, np.int32)
        found.ravel()[self.there] = np.arange(self.n, dtype=np.int32)
        return found

    @cached_property
    def entry_in_blocks(self) -> np.ndarray:
        """(3, N, b, b): which entries the blocks before, on and behind the diagonal have. Behind the last entry are a
        0, for those that are none, and a 1, for the diagonal of places that are left empty."""
        _, starts, b = self.blocks
        row, column, block, place = self.rows, self.columns, self.block, self.place
        found = np.full((3, len(starts) - 1, b, b), len(row), np.int32)
        found[1 + block[column] - block[row], block[row], place[row], place[column]] = np.arange(len(row))
        i, k = np.nonzero(np.arange(b)[None, :] >= np.diff(starts)[:, None])
        found[1, i, k, k] = len(row) + 1
        return found

    def _in_blocks(self, A: Numbers | Blocks) -> Blocks:
        return A if isinstance(A, Blocks) else Blocks(*_added(A, self.entry_in_blocks))

    def _by_blocks(self, A: Numbers | Blocks) -> Callable:
        blocks = self._in_blocks(A)
        N, b = self.unknowns.shape
        free = (self.unknowns < self.free) | (self.unknowns == self.n)
        scale = _row_scale(blocks, free)
        factors = part(factorize_blocks)(*(x * scale[:, :, None] for x in blocks))
        here = self.unknowns.ravel()
        in_order = np.array_equal(here, np.arange(self.n))

        def solve(x: Array, trans: int = 0) -> Array:
            x = (x if in_order else gather(jnp.append(x, jnp.zeros_like(x[:1])), here)).reshape(N, b)
            x = part(partial(solve_blocks, trans=trans))(factors, x if trans else x * scale)
            x = (x * scale if trans else x).ravel()
            return x if in_order else gather(x, self.there)

        return solve

    # by SuperLU

    @cached_property
    def entry_in_slots(self) -> tuple[Pattern, np.ndarray]:
        """The `Pattern` for SuperLU, and the entry in each of its slots."""
        sort = np.lexsort((self.columns, self.rows))
        pattern = Pattern(self.n, self.rows[sort], self.columns[sort], self.free)
        found = np.full(pattern.size, len(self.rows), np.int32)
        found[pattern.slots] = sort
        return pattern, found

    def _sparse(self, A: Numbers) -> Sparse:
        pattern, entries = self.entry_in_slots
        return Sparse(_added(A, entries), pattern)

    def _by_superlu(self, A: Numbers) -> Callable:
        sparse = self._sparse(A)
        if self.free == self.n:
            return factorize_sparse(sparse)
        d = jnp.abs(sparse.diagonal())
        first = jnp.where(np.arange(self.n) < self.free, 1 / jnp.sqrt(jnp.where(d == 0, 1, d)), 0)
        size = abs(sparse) @ first
        scale = jnp.where(np.arange(self.n) < self.free, first, 1 / jnp.where(size == 0, 1, size))
        solve = factorize_sparse(_scaled(sparse, scale))
        return lambda b, trans=0: scale * solve(b, trans=1) if trans else solve(scale * b)


def _row_scale(blocks: Blocks, free: np.ndarray) -> Array:
    """(N, b): scales of the equations, as in `factorize_saddle_point`: square roots of their diagonal, and for
    constraints those of their unknowns, so that the choice of pivots does not depend on units."""
    d = jnp.abs(_diagonals(blocks.middle))
    first = jnp.where(free, 1 / jnp.sqrt(jnp.where(d == 0, 1, d)), 0)
    if free.all():
        return first
    around = (jnp.roll(first, 1, axis=0), first, jnp.roll(first, -1, axis=0))
    sizes = [jnp.abs(x) * y[:, None, :] for x, y in zip(blocks, around, strict=True)]
    total = reduce(jnp.add, sizes)
    size = reduce(jnp.add, [total[:, :, k] for k in range(total.shape[2])])
    return jnp.where(free, first, 1 / jnp.where(size == 0, 1, size))


def _diagonals(blocks: Array) -> Array:
    """(N, b). jnp.diagonal would ask for the platform."""
    N, b = blocks.shape[:2]
    return blocks.reshape(N, b * b)[:, :: b + 1]


def _added(A: Numbers, entries: np.ndarray) -> Array:
    """Entries of a matrix, the last two of which are 0 and 1, as they are asked for."""
    k = A.values.shape[0]
    ends = np.full((len(A.table), 2), k, np.int32)
    ends[0, 1] = k + 1
    table = np.concatenate([A.table, ends], axis=1)[:, entries]
    # all numbers once: gathers would have each of them computed again
    values = staged(lambda x: jnp.concatenate([x, jnp.array([0, 1], x.dtype)]))(A.values)
    return reduce(jnp.add, [gather(values, row) for row in table])


def _scaled(A: Sparse, scale: Array) -> Sparse:
    """The matrix with its rows times these."""
    rows = np.zeros(A.pattern.size, np.int32)
    rows[A.pattern.slots] = A.pattern.rows
    return Sparse(A.values * gather(scale, rows), A.pattern)


def _scaled_on_both_sides(A: Sparse, scale: Array) -> Sparse:
    columns = np.zeros(A.pattern.size, np.int32)
    columns[A.pattern.slots] = A.pattern.columns
    A = _scaled(A, scale)
    return Sparse(A.values * gather(scale, columns), A.pattern)


@lru_cache(maxsize=32)
def _plan(n: int, free: int, indptr: bytes, indices: bytes) -> Plan:
    from scipy.sparse import csr_array

    where = np.frombuffer(indices, np.int32), np.frombuffer(indptr, np.int32)
    return Plan(csr_array((np.ones(len(where[0]), bool), *where), shape=(n, n)), free)


def plan(pattern: csr_array, free: int | None = None) -> Plan:
    """The `Plan` of a pattern, made once for equal ones."""
    pattern = symmetric(pattern)
    pattern.sort_indices()
    n = pattern.shape[0]
    numbers = (np.ascontiguousarray(x, np.int32).tobytes() for x in (pattern.indptr, pattern.indices))
    return _plan(n, n if free is None else free, *numbers)


@dataclass(frozen=True, eq=False)
class SparseLU(Completed, Structured):
    """A solve by the patterns of all matrices that a run asks for.

    sparsity: () -> what has `plan(size)`, the `Plan` for so many unknowns, and `of_rows()`, that of B B^T. elements:
    state, change of acceleration -> change of state, both as of `around`, -> the `Numbers` of the matrix of a step;
    None where they are found by products.
    """

    sparsity: Callable
    tolerance: Any = None
    elements: Callable | None = None

    def of_map(self, f: Callable, like: PyTree):
        """(b, trans=0) -> A^-1 b, or A^-T b."""
        made = self.sparsity().plan(like.size)
        return made.inverse(made.by_products(f, like))

    def around(self, state, along: Callable) -> Structured:
        """The solve at a state."""
        return self if self.elements is None else SparseAt(self, partial(self.elements, state, along), self.tolerance)

    def cosine_pivots(self, f: Callable, like: Array, limit: float) -> Array:
        """The pivots (m,) of B B^T, the matrix of f, each row of B being of length 1: the squared sines of its angles
        to the rows that are eliminated before. limit: below which a pivot is taken for this."""
        made = self.sparsity().of_rows()
        return made.pivots(made.by_products(f, like), limit)


@dataclass(frozen=True, eq=False)
class SparseAt(Structured):
    """`SparseLU` at a state, where elements know the matrix."""

    solve: SparseLU
    numbers: Callable
    tolerance: Any = None

    def of_map(self, f: Callable, like: PyTree):
        """(b, trans=0) -> A^-1 b, or A^-T b."""
        made = self.solve.sparsity().plan(like.size)
        if made.is_in_blocks:  # there few products tell all entries, and are as many tangents
            return self.solve.of_map(f, like)
        return made.inverse(self.numbers())
