"""The sparsity pattern of a Jacobian, from the program: which outputs may depend on which inputs.

For each element of every array, the set of inputs on which it may depend is a row of a sparse boolean matrix.
`dependency_rules.py` gives the rows of the results of an operation from those of its operands. Functions, branches and
loops are handled here. The sets hold for all values of the inputs. So both branches of `where` count, and an index that
is computed from an input may have any value.

A loop is a relation between its carry before and after a step. The set on which the carry may depend after any number
of steps is the smallest solution of an equation for sets. To find it, the body is evaluated once, with a row for each
element of the carry.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray, Tracer
from jax.extend.core import ClosedJaxpr, Literal, jaxpr_as_fun

from hhtjax.description import PyTree
from hhtjax.jaxpr.dependency_rules import RULES, all_on_all
from hhtjax.jaxpr.known_values import known_results
from hhtjax.jaxpr.recording import INLINED, kept_and_carried
from hhtjax.jaxpr.row_sets import (
    TooDense,
    Value,
    between,
    closure,
    divided,
    either,
    empty,
    grouped,
    identity,
    member,
    numbers,
    of_members,
    product,
    stacked,
    taken,
    united,
)
from hhtjax.primitives import plain, two_mode_derivative
from hhtjax.primitives.interpreter import alone, lowered, needed

if TYPE_CHECKING:
    from jax.extend.core import JaxprEqn

WRITTEN_OUT = 64  # steps of a scan that are evaluated one by one, with the numbers that are known in each
OPERATIONS = 20_000  # the same of longer ones, where integers are known: it takes two seconds
INSIDE = {  # parameter of an operation that holds a function of all its operands
    **{name: param for name, param in INLINED.items() if not name.startswith("custom_")},
    **{"hhtjax_kernel": "closed", "composite": "jaxpr", "custom_vmap_call": "call"},
}


def dependencies(f: Callable, x, *others: PyTree):
    """Which outputs of f may depend on which inputs: a superset of the nonzeros of its Jacobian, for all values.

    Entry (i, j) is False only if df_i/dx_j = 0 for every x. The pattern is exact for functions made of elementwise
    operations, operations that move elements, sums, products with constant matrices, and reading and writing at
    constant indices. It is also exact for `vmap` and loops of such functions, and for functions with derivatives of
    their own. Cancelling terms are not detected: x - x gives an entry. For an unknown operation each result counts as
    dependent on all operands. Zeros that f closes over count as zero for ever: pass arrays that may change as `others`.

    Args:
        f: a function (n,), *others -> (m,), as JAX can trace it.
        x: a floating vector (n,), or its `jax.ShapeDtypeStruct`; its values do not matter.
        *others: pytrees of arrays, or of their shapes; their values do not matter either.

    Returns:
        A `scipy.sparse.csr_array` of Booleans, (m, n), with sorted indices. It takes about as long as tracing f, plus
        0.1 ms for each operation and 1e4 entries.

    Raises:
        TypeError: x is not a floating vector, or f does not return a vector.
        TooDense: an intermediate pattern has more than 1e8 entries.
        NotImplementedError: f writes into references (`jax.new_ref`).

    >>> import jax.numpy as jnp
    >>> springs = lambda x: jnp.diff(jnp.diff(x, prepend=0.0) ** 3, append=0.0)
    >>> print(dependencies(springs, jnp.zeros(4)).toarray().astype(int))
    [[1 1 0 0]
     [1 1 1 0]
     [0 1 1 1]
     [0 0 1 1]]
    """
    shape, dtype = jnp.shape(x), jnp.result_type(x)
    if len(shape) != 1 or not jnp.issubdtype(dtype, jnp.inexact):
        raise TypeError(f"dependencies: x must be a floating vector (n,); received {dtype} of shape {shape}.")
    with plain():
        like = jax.ShapeDtypeStruct(shape, dtype)
        trace, out = jax.make_jaxpr(f, return_shape=True)(like, *others)
        if not hasattr(out, "shape") or len(out.shape) != 1:
            raise TypeError(f"dependencies: f must return one vector (m,); received {out}.")
        values = [Value(tuple(y.shape)) for y in trace.in_avals]
        values[0].rows = identity(shape[0], shape[0]) if shape[0] else None
        (found,) = run(lowered(trace), values)
    rows = found.rows if _has_derivative(trace.out_avals[0]) else None
    return empty(found.size, shape[0]) if rows is None else rows


def run(closed: ClosedJaxpr, values: Sequence[Value]) -> list[Value]:
    """The values of the results of a jaxpr. Intermediate values are deleted after their last use."""
    jaxpr, constants = getattr(closed, "jaxpr", closed), getattr(closed, "consts", ())
    found = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*map(_constant, constants), *values], strict=True))
    equations = needed(jaxpr)
    uses = [*(eqn.invars for eqn in equations), jaxpr.outvars]
    last = {x: i for i, used in enumerate(uses) for x in used if not isinstance(x, Literal)}

    def read(atom):
        return _constant(atom.val) if isinstance(atom, Literal) else found[atom]

    for i, eqn in enumerate(equations):
        found.update(zip(eqn.outvars, _apply(eqn, [read(x) for x in eqn.invars]), strict=True))
        for x in {x for x in (*eqn.invars, *eqn.outvars) if not isinstance(x, Literal)}:
            if last.get(x, i) == i:
                found.pop(x, None)
    return [read(x) for x in jaxpr.outvars]


def _constant(x) -> Value:
    shape = tuple(jnp.shape(x))
    if isinstance(x, Tracer) or jnp.issubdtype(jax.typeof(x).dtype, jax.dtypes.extended):
        return Value(shape)
    return Value(shape, known=np.asarray(x))


def _has_derivative(aval) -> bool:
    return jnp.issubdtype(getattr(aval, "dtype", bool), np.inexact)


def _apply(eqn: JaxprEqn, values: list[Value]) -> list[Value]:
    """The results of one operation."""
    name = eqn.primitive.name
    if not all(isinstance(x.aval, ShapedArray) for x in eqn.invars):
        raise NotImplementedError(f"dependencies: {name} reads or writes a reference, whose elements are not followed.")
    if name in INSIDE:
        results = run(eqn.params[INSIDE[name]], values)
    elif (known := _known(eqn, values)) is not None:
        return known
    elif name in FUNCTIONS and any(x.rows is not None for x in values):
        results = FUNCTIONS[name](eqn, *values)
    else:
        results = RULES.get(name, all_on_all)(eqn, *values)
    return [
        x if x.rows is None or _has_derivative(out.aval) else Value(x.shape, None, x.known, x.nonzero)
        for x, out in zip(results, eqn.outvars, strict=True)
    ]


def _known(eqn: JaxprEqn, values: list[Value]) -> list[Value] | None:
    """The results of an operation on known numbers; None where these are not known, or the results are not."""
    arrays = [x.known for x in values]
    there = [x for x in arrays if x is not None]
    found = known_results(eqn, there) if len(there) == len(arrays) else None
    return None if found is None else [Value(x.shape, known=x) for x in found]


# ----------------------------------------------------------------------------
# Functions with derivatives of their own: the pattern is that of the derivative, which is linear.


def _like(variables: Sequence) -> list[jax.ShapeDtypeStruct]:
    return [jax.ShapeDtypeStruct(x.aval.shape, x.aval.dtype) for x in variables]


def _of_moving(f: Callable, moves: Sequence[bool], args: Sequence):
    """f as a function of those arguments that move, to a list of the results that have derivatives; and these."""

    def g(*moved):
        given = iter(moved)
        results = f(*(next(given) if m else x for m, x in zip(moves, args, strict=True)))
        return [y for y in results if _has_derivative(y)]

    return g, [x for m, x in zip(moves, args, strict=True) if m]


def _spread_over(eqn, found: Sequence[Value]) -> list[Value]:
    """These for the results that have derivatives, and nothing for others."""
    given = iter(found)
    return [Value(x.aval.shape, next(given).rows if _has_derivative(x.aval) else None) for x in eqn.outvars]


def _custom_jvp(eqn, *values: Value):
    """By the rule of forward mode: the tangents of the results depend on those of the operands, with known numbers."""
    moves, f = [x.rows is not None for x in values], alone(eqn)

    def tangents(args: list, dots: list):
        args = [y if x.known is None else x.known for x, y in zip(values, args, strict=True)]
        return jax.jvp(*_of_moving(f, moves, args), dots)[1]

    args = _like(eqn.invars)
    trace = lowered(jax.make_jaxpr(tangents)(args, [x for m, x in zip(moves, args, strict=True) if m]))
    dots = [Value(x.shape, x.rows) for x in values if x.rows is not None]
    return _spread_over(eqn, run(trace, [*(Value(x.shape) for x in args), *dots]))


def _custom_vjp(eqn, *values: Value):
    """By the rule of reverse mode, which gives the transpose."""
    moves, f = [x.rows is not None for x in values], alone(eqn)

    def cotangents(args: list, given: list):
        g, moved = _of_moving(f, moves, args)
        return jax.vjp(g, *moved)[1](given)

    args, outs = _like(eqn.invars), _like([x for x in eqn.outvars if _has_derivative(x.aval)])
    trace = lowered(jax.make_jaxpr(cotangents)(args, outs))
    given = _independent([Value(x.shape) for x in outs], [True] * len(outs))
    back = stacked(run(trace, [*(Value(x.shape) for x in args), *given]))
    relation = None if back is None else back.T.tocsr()
    rows = product(relation, stacked([x for x in values if x.rows is not None]))
    return _spread_over(eqn, divided(rows, [x.shape for x in outs]))


def _by_tracing(function: Callable, eqn, *values: Value):
    """An operation of our own that is a function of arrays, with the same parameters."""
    return run(lowered(jax.make_jaxpr(partial(function, **eqn.params))(*_like(eqn.invars))), values)


def _two_ways(function: Callable, eqn, *values: Value):
    """Values and tangents of a function that brings its derivatives: of tangents alone, by that rule."""
    if any(x.rows is not None for x in values[: eqn.params["count"]]):
        return all_on_all(eqn, *values)
    return _by_tracing(function, eqn, *values)


def _custom_linear_solve(eqn, *values: Value):
    """x of A x = b: dx = A^-1 (db - dA x), where the second term is that of x -> A x with its constants moving."""
    lengths, jaxprs = eqn.params["const_lengths"], eqn.params["jaxprs"]
    matrix, b = values[: lengths.matvec], values[sum(lengths) :]
    change = run(jaxprs.matvec, [*matrix, *(Value(x.shape) for x in b)])
    right = [Value(x.shape, united(x.rows, y.rows)) for x, y in zip(b, change, strict=True)]
    if jaxprs.solve is None:
        return all_on_all(eqn, *right)
    start = lengths.matvec + lengths.vecmat
    constants = values[start : start + lengths.solve]
    return run(jaxprs.solve, [*(Value(x.shape, None, x.known, x.nonzero) for x in constants), *right])


def _in_turn(eqn, asked: Value, *values: Value):
    return run(eqn.params["at_once"], values)


# ----------------------------------------------------------------------------
# Branches and loops.


def _cond(eqn, which: Value, *values: Value):
    branches = eqn.params["branches"]
    if which.known is not None:
        return run(branches[min(max(int(which.known), 0), len(branches) - 1)], values)
    return [either(*found) for found in zip(*(run(x, values) for x in branches), strict=True)]


def _independent(values: Sequence[Value], moves: Sequence[bool]) -> list[Value]:
    """The same values, with the elements of those that depend on the inputs as new unknowns, in their order."""
    n, start, found = sum(x.size for x, m in zip(values, moves, strict=True) if m), 0, []
    for x, move in zip(values, moves, strict=True):
        found.append(Value(x.shape, identity(x.size, n, start) if x.size else None) if move else x)
        start += x.size if move else 0
    return found


def _relation(closed: ClosedJaxpr, parts: Sequence[Sequence[Value]], moves: Sequence[Sequence[bool]], results: list):
    """Of a function of so many groups of arguments, on elements of which its results depend.

    results: numbers of results in each group of these. Returned are matrices [group of results][group of arguments],
    each (elements, elements that move), or None.
    """
    values = [x for part in parts for x in part]
    found = run(closed, _independent(values, [m for part in moves for m in part]))
    sizes = [sum(x.size for x, m in zip(p, q, strict=True) if m) for p, q in zip(parts, moves, strict=True)]
    ends, rows, start = np.cumsum([0, *sizes]), [], 0
    for count in results:
        group: Any = stacked(found[start : start + count])
        rows.append([None if group is None else group[:, a:b] for a, b in pairwise(ends)])
        start += count
    return rows


def _floating(variables: Sequence) -> list[bool]:
    return [_has_derivative(x.aval) for x in variables]


def _only(values: Sequence[Value], moves: Sequence[bool]):
    """The rows of those that move."""
    return stacked([x for x, m in zip(values, moves, strict=True) if m])


def _expanded(rows, avals: Sequence, moves: Sequence[bool]) -> list[Value]:
    """Rows of those that move as values of all."""
    found = iter(divided(rows, [x.shape for x, m in zip(avals, moves, strict=True) if m]))
    return [next(found) if m else Value(x.shape) for x, m in zip(avals, moves, strict=True)]


def _kept(relation, moves: Sequence[bool], sizes: Sequence[int]):
    """The rows of the relation that belong to results that move."""
    if relation is None:
        return None
    return relation[np.repeat(np.asarray(moves, bool), sizes)]


def _before(jaxpr, carry: Sequence[Value], offset: int) -> list[Value]:
    """The carry at the start of any step: known is what no step changes."""
    same = [out is jaxpr.invars[offset + i] for i, out in enumerate(jaxpr.outvars[: len(carry)])]
    return [x if keeps else Value(x.shape) for x, keeps in zip(carry, same, strict=True)]


def _while(eqn, *values: Value):
    body, first = eqn.params["body_jaxpr"], eqn.params["cond_nconsts"]
    second = first + eqn.params["body_nconsts"]
    constants, carry = values[first:second], values[second:]
    moves = [[x.rows is not None for x in constants], _floating(eqn.outvars)]
    before = _before(body.jaxpr, carry, len(constants))
    ((by_constants, by_carry),) = _relation(body, [constants, before], moves, [len(carry)])
    sizes, avals = [x.size for x in carry], [x.aval for x in eqn.outvars]
    by_constants, by_carry = (_kept(x, moves[1], sizes) for x in (by_constants, by_carry))
    start = united(_only(carry, moves[1]), product(by_constants, _only(constants, moves[0])))
    return _expanded(closure(by_carry, start), avals, moves[1])


def _scan(eqn, *values: Value):
    first, carried = kept_and_carried(eqn.params)
    constants, carry, rows = values[:first], values[first : first + carried], values[first + carried :]
    length = eqn.params["length"]
    if not carried and length:
        return _map(eqn, constants, rows)
    work = length * len(eqn.params["jaxpr"].jaxpr.eqns)
    is_told = work <= OPERATIONS and any(x.known is not None and x.known.dtype.kind in "iu" for x in (*carry, *rows))
    if length <= WRITTEN_OUT or is_told:
        return _written_out(eqn, constants, carry, rows)
    return _by_relation(eqn, constants, carry, rows)


def _map(eqn, constants: Sequence[Value], rows: Sequence[Value]):
    """Without a carry: all steps at once."""
    axes = [None] * len(constants) + [0] * len(rows)
    closed = eqn.params["jaxpr"]
    f = jax.vmap(jaxpr_as_fun(closed), axes, axis_size=eqn.params["length"])
    return run(lowered(jax.make_jaxpr(f)(*_like(eqn.invars))), [*constants, *rows])


def _written_out(eqn, constants: Sequence[Value], carry: Sequence[Value], rows: Sequence[Value]):
    """A loop evaluated step by step, using the known numbers of each step."""
    found, count = {}, len(carry)
    steps = range(eqn.params["length"])
    for i in reversed(steps) if eqn.params["reverse"] else steps:
        results = run(eqn.params["jaxpr"], [*constants, *carry, *(member(x, i) for x in rows)])
        carry, found[i] = results[:count], results[count:]
    columns = zip(*(found[i] for i in sorted(found)), strict=True)
    outs = [of_members(column) for column in columns] or [Value(x.aval.shape) for x in eqn.outvars[count:]]
    return [*carry, *outs]


def _by_relation(eqn, constants: Sequence[Value], carry: Sequence[Value], rows: Sequence[Value]):
    """A loop evaluated for all steps at once, from the relation of one step."""
    closed, count, length = eqn.params["jaxpr"], len(carry), eqn.params["length"]
    given = closed.jaxpr.invars[len(constants) :]
    moves = [[x.rows is not None for x in constants], _floating(given[:count]), [x.rows is not None for x in rows]]
    parts = [constants, _before(closed.jaxpr, carry, len(constants)), [Value(x.aval.shape) for x in given[count:]]]
    after, made = _relation(closed, parts, moves, [count, len(eqn.outvars) - count])
    after = [_kept(x, moves[1], [y.size for y in carry]) for x in after]
    order = np.arange(length)[::-1] if eqn.params["reverse"] else np.arange(length)
    fixed, by_step = _only(constants, moves[0]), _by_step(rows, moves[2], order)

    def brought(relation: list):
        return united(_in_every_step(length, relation[2], by_step), _repeated(length, product(relation[0], fixed)))

    start, size = _only(carry, moves[1]), sum(x.size for x, m in zip(carry, moves[1], strict=True) if m)
    try:
        states = _states(length, size, after[1], start, brought(after))
        last, before = between(states, length * size, (length + 1) * size), between(states, 0, length * size)
    except TooDense:  # steps that are not told apart: each has all that the carry may depend on in any
        each_step = grouped(_in_every_step(length, after[2], by_step), np.tile(np.arange(size), length), size)
        last = closure(after[1], united(start, product(after[0], fixed), each_step))
        before = None if made[1] is None else _repeated(length, last)
    outs, avals = united(_in_every_step(length, made[1], before), brought(made)), [x.aval for x in eqn.outvars]
    return [*_expanded(last, avals[:count], moves[1]), *_by_array(outs, order, [x.shape for x in avals[count:]])]


def _states(length: int, size: int, relation, start, brought):
    """The carry before each step and after the last, one below the other.

    That after step t depends on what was brought j steps before by the power j of the relation. Powers are taken by
    squaring: each turn doubles the number of steps that are seen.
    """
    rows = stacked([Value((size,), start), Value((length * size,), brought)])
    reach = 1
    while reach <= length and relation is not None and rows is not None:
        others = length + 1 - reach
        more = _in_every_step(others, relation, between(rows, 0, others * size))
        rows = united(rows, stacked([Value((reach * size,)), Value((others * size,), more)]))
        relation, reach = product(relation, relation), 2 * reach
    return rows


def _by_step(values: Sequence[Value], moves: Sequence[bool], order: np.ndarray):
    """The rows of those that move, first all of the first step."""
    there = [x for x, m in zip(values, moves, strict=True) if m]
    starts = np.cumsum([0, *(x.size for x in there)])
    places = [numbers((x.shape[0], x.size // x.shape[0]))[order] + i for x, i in zip(there, starts, strict=False)]
    return taken(stacked(there), np.concatenate(places, 1)) if there else None


def _by_array(rows, order: np.ndarray, shapes: Sequence) -> list[Value]:
    """The inverse, for arrays of these shapes."""
    ends = np.cumsum([0, *(math.prod(shape[1:]) for shape in shapes)])
    places = numbers((len(order), ends[-1]))[order]
    return [Value(shape, taken(rows, places[:, a:b])) for shape, (a, b) in zip(shapes, pairwise(ends), strict=True)]


def _in_every_step(length: int, relation, rows):
    """The relation of each step on rows of each step."""
    from scipy import sparse

    if relation is None or rows is None:
        return None
    return product(sparse.kron(sparse.eye_array(length, dtype=bool), relation, format="csr"), rows)


def _repeated(length: int, rows):
    return None if rows is None else taken(rows, np.tile(np.arange(rows.shape[0]), length))


FUNCTIONS = {
    "custom_jvp_call": _custom_jvp,
    "custom_vjp_call": _custom_vjp,
    "custom_linear_solve": _custom_linear_solve,
    "hhtjax_values": partial(_by_tracing, lambda *x, f: f(list(x))),
    "hhtjax_both": partial(_two_ways, two_mode_derivative.both),
    "hhtjax_linear": partial(_two_ways, two_mode_derivative.linear),
    "hhtjax_in_turn": _in_turn,
    "cond": _cond,
    "while": _while,
    "scan": _scan,
}
