"""Which unknowns each element of an array depends on: a sparse boolean matrix with a row for each element.

A `Value` represents an array of a program. Its rows show the unknowns on which its elements depend. It also has what is
known of its numbers: all of them, such as constant indices, or where they are zero, such as outside the band of a
matrix. Zeros matter because 0 y does not depend on y.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from operator import add
from typing import Any

import numpy as np

MOST = 10**8  # entries of a pattern: with more, memory ends before there is a result
LONG = 10**7  # terms of a product that takes long
DENSE_IS_FASTER = 100  # times, for the same number of terms
DIRECTLY = 8  # steps of a closure before its matrix is squared


class TooDense(Exception):
    """A pattern has so many entries that a dense Jacobian would not be larger."""


@dataclass
class Value:
    """An array in a program.

    shape: its. rows: csr_array (size, unknowns) of bool, or None where it depends on nothing. known: its numbers, or
    None. nonzero: where it may differ from zero, or None for everywhere; of known numbers see `where_nonzero`.
    """

    shape: tuple
    rows: Any = None
    known: np.ndarray | None = None
    nonzero: np.ndarray | None = None

    @property
    def size(self) -> int:
        return math.prod(self.shape)


def where_nonzero(x: Value) -> np.ndarray | None:
    """Where x may differ from zero; None: everywhere, as far as is known."""
    found = x.nonzero if x.known is None else x.known != 0
    return None if found is None or found.all() else found


def full_mask(x: Value) -> np.ndarray:
    """The same as an array in any case."""
    found = where_nonzero(x)
    return np.ones(x.shape, bool) if found is None else found


def numbers(shape: Sequence) -> np.ndarray:
    """0, 1, ... in this shape."""
    return np.arange(math.prod(shape)).reshape(shape)


def empty(size: int, n: int):
    """Rows of nothing."""
    from scipy import sparse

    return sparse.csr_array((size, n), dtype=bool)


def identity(size: int, n: int, offset: int = 0):
    """Rows of elements that are unknowns offset, offset + 1, ... themselves."""
    from scipy import sparse

    arrays = np.ones(size, bool), np.arange(offset, offset + size, dtype=np.int32), np.arange(size + 1, dtype=np.int32)
    return sparse.csr_array(arrays, shape=(size, n))


def taken(rows, which: np.ndarray):
    """The rows of these numbers, one after the other; of -1 an empty one."""
    from scipy import sparse

    which = which.reshape(-1)
    if rows is None or not which.size:
        return None
    counts = np.append(np.diff(rows.indptr), 0)
    total = int(counts[which].sum(dtype=np.int64))
    _require_few(total)
    if not total:
        return None
    size, n = rows.shape
    more = sparse.csr_array((rows.data, rows.indices, np.append(rows.indptr, rows.indptr[-1])), shape=(size + 1, n))
    return more[which]


def only(rows, mask: np.ndarray | None):
    """The rows that are marked, and empty ones."""
    if rows is None or mask is None:
        return rows
    mask = mask.reshape(-1)
    return rows if mask.all() else taken(rows, np.where(mask, np.arange(mask.size), -1))


def united(*parts):
    """The union of rows, of those that are there."""
    found = list({id(x): x for x in parts if x is not None}.values())
    return reduce(add, found) if found else None


def grouped(rows, to: np.ndarray, size: int):
    """`size` rows, each the union of the rows that are assigned to it. to: new number of each row, -1 for none."""
    if rows is None:
        return None
    to = to.reshape(-1)
    there = np.flatnonzero(to >= 0)
    return related(to[there], there, rows, size)


def related(to: np.ndarray, origin: np.ndarray, rows, size: int):
    """So many rows: number i the union of rows origin[k] for each to[k] = i. No pair may come twice."""
    from scipy import sparse

    if rows is None or not size or not len(to):
        return None
    _require_few(len(to))
    pairs = sparse.csr_array(
        (np.ones(len(to), bool), (to.astype(np.int32), origin.astype(np.int32))), shape=(size, rows.shape[0])
    )
    return product(pairs, rows)


def product(relation, rows):
    """The rows of the outputs, from a relation (outputs, elements) and the rows of the elements."""
    from scipy import sparse

    if rows is None or relation is None:
        return None
    (m, k), n = relation.shape, rows.shape[1]
    work = int(np.diff(rows.indptr)[relation.indices].sum(dtype=np.int64))
    _require_few(min(work, m * n))
    if work > LONG and DENSE_IS_FASTER * work > m * k * n and max(m * k, k * n, m * n) <= MOST:
        found = sparse.csr_array(relation.astype(np.float32).toarray() @ rows.astype(np.float32).toarray() > 0)
    else:
        found = relation @ rows
        found.sort_indices()
    return found if found.nnz else None


def closure(relation, rows):
    """The smallest rows with these in them, and relation @ rows too: what a loop may reach in any number of steps."""
    steps = 0
    while rows is not None and relation is not None:
        more = united(rows, product(relation, rows))
        if more.nnz == rows.nnz:
            break
        rows, steps = more, steps + 1
        if steps > DIRECTLY:
            relation = united(relation, product(relation, relation))
    return rows


def stacked(values: Sequence[Value]):
    """The rows of all elements of these, one below the other."""
    from scipy import sparse

    n = next((x.rows.shape[1] for x in values if x.rows is not None), None)
    if n is None:
        return None
    parts = [empty(x.size, n) if x.rows is None else x.rows for x in values]
    return parts[0] if len(parts) == 1 else sparse.vstack(parts, format="csr")


def divided(rows, shapes: Sequence) -> list[Value]:
    """The inverse of `stacked`."""
    ends = np.cumsum([math.prod(shape) for shape in shapes])
    pairs = zip(shapes, ends, strict=True)
    return [Value(shape, between(rows, end - math.prod(shape), end)) for shape, end in pairs]


def between(rows, start: int, stop: int):
    """The rows from start to stop."""
    if rows is None or start == stop:
        return None
    found = rows[start:stop]
    return found if found.nnz else None


def member(x: Value, i: int) -> Value:
    """x[i]."""
    size = math.prod(x.shape[1:])
    known, nonzero = (None if y is None else y[i] for y in (x.known, x.nonzero))
    return Value(x.shape[1:], between(x.rows, i * size, (i + 1) * size), known, nonzero)


def of_members(values: Sequence[Value]) -> Value:
    """The array of which these are the members; there is one at least."""
    shape = (len(values), *values[0].shape)
    if all(x.known is not None for x in values):
        return Value(shape, known=np.stack([np.asarray(x.known) for x in values]))
    masks = None if all(where_nonzero(x) is None for x in values) else np.stack([full_mask(x) for x in values])
    return Value(shape, stacked(values), nonzero=masks)


def either(*values: Value) -> Value:
    """A value that may be any one of these."""
    masks = [where_nonzero(x) for x in values]
    mask = None if any(x is None for x in masks) else np.any([x for x in masks if x is not None], axis=0)
    return Value(values[0].shape, united(*(x.rows for x in values)), nonzero=mask)


def _require_few(entries: int):
    if entries > MOST:
        raise TooDense(f"A pattern with up to {entries} entries; more than {MOST} are not listed.")
