"""Coefficients of power series, order by order, for the operations of `series_program.py`.

The coefficient k of a product is a_k b_0 + a_0 b_k plus the sum of the terms between, sum_{0 < j < k} a_j b_{k-j}.
These sums need no coefficient of order k. So the sums of all products of a program are computed together, on vectors
with an entry for each product. Only a few operations on scalars remain. Programs of many operations use a loop over k,
in which the sums have the same number of terms for each k, some of them zero. Programs of few operations are unrolled.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.description import Array
from hhtjax.numerics.dense_lu import SCALAR, factorize, inverse, with_slope
from hhtjax.numerics.series_program import ON_KNOWN, Node, SeriesProgram, Solve, moves

WRITTEN_OUT = 2000  # operations on series, times the orders; of more, XLA makes no kernel, or takes long


class Series:
    """The coefficients of a program, those of the order that is being computed."""

    def __init__(self, program: SeriesProgram, arguments: Sequence, dtype: np.dtype):
        """arguments: scalars, the first coefficients of what moves, and what does not."""
        self.program, self.dtype = program, np.dtype(dtype)
        self.first: dict = dict(zip(program.arguments, arguments, strict=True))
        self.unit: dict = {}  # reciprocals that all orders need
        self.inverses: dict = {}  # of the matrices of solves
        for node in program.known:
            self.first[node] = _on_known(node.name, [self.constant(x) for x in node.at], node.more)
        self.now = dict.fromkeys(program.arguments)
        for node in program.nodes:
            self.first[node] = self.begin(node, self.first)

    def constant(self, x: Any) -> Any:
        """A number that does not move."""
        return self.first[x] if isinstance(x, Node) else x

    def number(self, x: Any) -> Array:
        """The same in the type of the series."""
        return lax.convert_element_type(self.constant(x), self.dtype)

    def results(self, values: dict) -> list:
        """Of the program."""
        return [self.value(x, values) for x in self.program.results]

    def value(self, x: Any, values: dict):
        """The coefficient of an operand, None for zero: of what does not move, the first alone."""
        if moves(x):
            return values[x]
        return self.number(x) if values is self.first else None

    # the first coefficients

    def begin(self, node: Node, values: dict):
        """That of a node, from those before it; values: those of all, or of a column of a matrix."""
        if node.zero:
            self.prepare(node)
            return None
        if node.kind == "solve":
            return self.begin_solve(node.more)
        if node.kind == "integral":
            return _on_known(node.name, [self.first[x] if moves(x) else self.number(x) for x in node.at], self.dtype)
        x, *y = (values[z] if moves(z) else self.number(z) for z in node.operands[: 1 if node.kind == "select" else 2])
        if node.kind == "root":
            found = lax.sqrt(x)
            self.unit[node] = 0.5 / found
            return found
        if node.kind == "product":
            return _times(x, y[0])
        self.prepare(node)
        if node.kind == "quotient":
            return _times(x, self.unit[node])
        return self.linear(node, values)

    def prepare(self, node: Node):
        """Reciprocals."""
        if node.kind in ("quotient", "divide") and node not in self.unit:
            y = node.operands[1]
            self.unit[node] = 1 / (self.first[y] if moves(y) else self.number(y))

    def linear(self, node: Node, values: dict):
        """The coefficient of an operation that is linear."""
        if node.kind == "select":
            which, *cases = node.operands
            cases = [self.value(x, values) for x in cases]
            zero = lax.full((), 0, self.dtype)
            return lax.select_n(self.constant(which), *(zero if x is None else x for x in cases))
        x, *y = (self.value(z, values) for z in node.operands[: 1 if node.kind in ("scale", "divide") else 2])
        if node.kind == "neg":
            return _minus(None, x)
        if node.kind == "scale":
            return _times(x, self.number(node.operands[1]))
        if node.kind == "divide":
            return _times(x, self.unit[node])
        return _plus(x, y[0]) if node.kind == "add" else _minus(x, y[0])

    def begin_solve(self, solve: Solve):
        """The first coefficients of unknowns, by the inverse of the first matrix."""
        if solve.key not in self.inverses:
            self.inverses[solve.key] = self.inverse(solve)
        self.settle(solve, [self.value(x, self.first) for x in solve.right], self.first)
        for node in solve.matrix:
            self.first[node] = self.begin(node, self.first)

    def inverse(self, solve: Solve):
        """That of the first matrix."""
        size, one = len(solve.unknowns), lax.full((), 1, self.dtype)
        columns = []
        for i in range(size):
            values = dict(self.first)
            values.update({x: one if i == j else None for j, x in enumerate(solve.unknowns)})
            for node in solve.matrix:
                values[node] = self.begin(node, values)
            columns.append([values[x] if moves(x) else None for x in solve.results])
        return _inverse(columns, self.dtype)

    def settle(self, solve: Solve, right: list, values: dict):
        """The unknowns of a right-hand side."""
        S = self.inverses[solve.key]
        if isinstance(S, list):
            found = [_sum([_times(a, x) for a, x in zip(row, right, strict=True)]) for row in S]
        else:
            x = S @ _stacked(right, self.dtype)
            found = [_element(x, i) for i in range(len(right))]
        values.update(zip(solve.unknowns, found, strict=True))

    # those of order k

    def advance(self, moving: Sequence, inner: Sequence, k: Any):
        """The coefficients k > 0 of all nodes from those of what moves; inner: the sums of `rows` over those before."""
        self.inner, self.k = inner, k
        self.now = dict(zip(self.program.arguments, moving, strict=False))
        for node in self.program.nodes:
            self.now[node] = self.follow(node)

    def follow(self, node: Node):
        """That of a node."""
        if node.kind == "product":
            return self.product(node, self.inner[node.row])
        if node.kind == "quotient":
            x, y = node.operands
            rest = _plus(self.inner[node.row], _times(self.now[y], self.first[node]))
            return _times(_minus(self.value(x, self.now), rest), self.unit[node])
        if node.kind == "root":
            rest = _minus(self.now[node.operands[0]], self.inner[node.row])
            return _times(rest, self.unit[node])
        if node.kind == "rate":
            return _times(self.now[node.operands[0]], self.k)
        if node.kind == "integral":
            g = self.value(node.operands[0], self.now)
            return None if g is None else g * (1 / self.k)
        if node.kind == "solve":
            return self.follow_solve(node.more)
        return self.linear(node, self.now)

    def product(self, node: Node, inner: Any):
        """That of x y."""
        x, y = node.operands
        if x is y:
            return _plus(inner, None if x.zero else _times(self.now[x], 2 * self.first[x]))
        found = _plus(inner, _times(self.now.get(x), self.first[y]))
        return found if x.zero else _plus(found, _times(self.first[x], self.now.get(y)))

    def follow_solve(self, solve: Solve):
        """Those of unknowns: what the matrix makes of the others is taken off the right-hand side."""
        self.now.update(dict.fromkeys(solve.unknowns))
        for node in solve.matrix:
            self.now[node] = self.follow(node)
        right = [
            _minus(self.value(b, self.now), self.value(r, self.now))
            for b, r in zip(solve.right, solve.results, strict=True)
        ]
        self.settle(solve, right, self.now)
        for node in solve.matrix:
            self.now[node] = self.follow(node)

    def rows(self, values: dict):
        """The factors of all products, two vectors."""
        return [_stacked([values[pair[i]] for pair in self.program.rows], self.dtype) for i in (0, 1)]


def _on_known(name: str, x: list, dtype: np.dtype):
    if name == "convert_element_type":
        return lax.convert_element_type(x[0], dtype)
    kinds = {jnp.result_type(y) for y in x}
    if name != "select_n" and len(kinds) > 1:  # numbers of the rules
        x = [lax.convert_element_type(y, dtype) for y in x]
    return getattr(lax, ON_KNOWN[name] or name)(*map(jnp.asarray, x))


def _times(x: Any, y: Any):
    return None if x is None or y is None else x * y


def _plus(x: Any, y: Any):
    return y if x is None else x if y is None else lax.add(x, y)


def _minus(x: Any, y: Any):
    return x if y is None else lax.neg(y) if x is None else lax.sub(x, y)


def _sum(terms: list):
    """By halves, so that one waits for few others."""
    terms = [x for x in terms if x is not None]
    while len(terms) > 1:
        terms = [lax.add(*terms[i : i + 2]) if i + 1 < len(terms) else terms[i] for i in range(0, len(terms), 2)]
    return terms[0] if terms else None


def _stacked(x: list, dtype: np.dtype) -> Array:
    if not x:
        return jnp.zeros(0, dtype)
    zero = lax.full((), 0, dtype)
    return lax.concatenate([lax.reshape(zero if y is None else y, (1,)) for y in x], 0)


def _row(x: Array, i: int) -> Array:
    return lax.squeeze(lax.slice(x, (i, 0), (i + 1, x.shape[1])), (0,))


def _element(x: Array, i: int) -> Array:
    return lax.squeeze(lax.slice(x, (i,), (i + 1,)), (0,))


def _inverse(columns: list, dtype: np.dtype):
    """Of a matrix, given by its columns, as rows of scalars, or as an array."""
    n = len(columns)
    A = jnp.stack([_stacked(x, dtype) for x in columns], axis=1)
    if n > SCALAR:
        return with_slope(inverse, A)
    S = with_slope(_by_columns, A)
    return [[S[i, j] for j in range(n)] for i in range(n)]


def _by_columns(A: Array) -> Array:
    """A^-1 of a small A, in scalars."""
    if len(A) == 1:
        return 1 / A
    solve = factorize(A)
    return jnp.stack([solve(x) for x in jnp.eye(len(A), dtype=A.dtype)], axis=1)


def rates(program: SeriesProgram, arguments: Sequence, dtype: np.dtype) -> Array:
    """f(q, v, t) of the same program: (N,)."""
    series = Series(program, arguments, dtype)
    return _stacked(series.results(series.first), dtype)


def coefficients(program: SeriesProgram, positions: int, arguments: Sequence, order: int, dtype: np.dtype) -> Array:
    """v_0 to v_order, (order + 1, N), of  q' = v,  v' = f(q, v, t):  k q_k = v_{k-1},  k v_k = w_{k-1}.

    program: of w = f. arguments: q (positions), v (N), t and what does not move, as scalars.
    """
    number = len(program.results)
    v = list(arguments[positions : positions + number])
    series = Series(program, arguments, dtype)
    w = series.results(series.first)
    way = written_out if len(program.nodes) * order <= WRITTEN_OUT else in_a_loop
    return way(series, positions, v, w, order)


def written_out(series: Series, positions: int, v: list, w: list, order: int) -> Array:
    """The same, with operations for each order."""
    factors, found = [series.rows(series.first)], [_stacked(v, series.dtype)]
    for k in range(1, order + 1):
        q = [_times(x, np.asarray(1 / k, series.dtype)) for x in v[:positions]]
        v = [_times(x, np.asarray(1 / k, series.dtype)) for x in w]
        found.append(_stacked(v, series.dtype))
        if k == order:
            break
        t = np.asarray(1, series.dtype) if k == 1 else None
        terms = [lax.mul(factors[j][0], factors[k - j][1]) for j in range(1, k)]
        total = _sum(terms)
        count = len(series.program.rows)
        inner = [None] * count if total is None else [_element(total, i) for i in range(count)]
        series.advance([*q, *v, t], inner, np.asarray(k, series.dtype))
        w = series.results(series.now)
        factors.append(series.rows(series.now))
    return jnp.stack(found)


def in_a_loop(series: Series, positions: int, v: list, w: list, order: int) -> Array:
    """The same, with the operations of one order in a loop."""
    dtype, count = series.dtype, len(series.program.rows)
    first = [jnp.zeros((order, count), dtype), jnp.zeros((2 * order, count), dtype)]

    def following(k: Array, v: Array, w: Array):
        unit = 1 / k.astype(dtype)
        return v[:positions] * unit, w * unit

    def body(k: Array, carry: tuple):
        A, B, v, w, found = carry
        q, v = following(k, v, w)
        found = lax.dynamic_update_slice(found, v[None], (k, 0))
        others = lax.dynamic_slice(B, (order - 1 - k, 0), (order, count))
        total = _sum([lax.mul(_row(A, j), _row(others, j)) for j in range(1, order - 1)])
        total = jnp.zeros(count, dtype) if total is None else total
        t = jnp.where(k == 1, 1, 0).astype(dtype)
        moving = [*(_element(q, i) for i in range(positions)), *(_element(v, i) for i in range(len(v))), t]
        series.advance(moving, [_element(total, i) for i in range(count)], k.astype(dtype))
        w = _stacked(series.results(series.now), dtype)
        a, b = series.rows(series.now)
        A = lax.dynamic_update_slice(A, a[None], (k, 0))
        B = lax.dynamic_update_slice(B, b[None], (order - 1 - k, 0))
        return A, B, v, w, found

    v0 = _stacked(v, dtype)
    found = jnp.zeros((order + 1, len(w)), dtype).at[0].set(v0)
    carry = *first, v0, _stacked(w, dtype), found
    *_, w, found = lax.fori_loop(1, order, body, carry)
    return lax.dynamic_update_slice(found, (jnp.asarray(w) / order)[None], (order, 0))
