"""Converts a traced function into a list of operations on scalars. Arrays of any size are taken apart.

The rules of `scalar_rules.py` handle operations that move elements or compute with them. Calls, branches, loops, and
reads of an array at an unknown index are handled here. The list is final: no derivative is taken of it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial, reduce
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.description import PyTree
from hhtjax.jaxpr.listing import Block, Listing, Operation, Scalar, everywhere, pruned
from hhtjax.jaxpr.recorder import LARGE, Recorder, as_operand
from hhtjax.jaxpr.scalar_rules import (
    FOLDS,
    RULES,
    UNDERSTOOD,
    arranged,
    compute,
    each,
    is_known,
    is_structural,
    is_understood,
)
from hhtjax.primitives.batching import written
from hhtjax.primitives.interpreter import alone, evaluate, line_of, lowered

if TYPE_CHECKING:
    from jax.extend.core import ClosedJaxpr, JaxprEqn

UNKNOWN = "unknown"
MOST = 100_000  # operations: of more, a compiler takes minutes
WRITTEN_OUT = 1000  # operations more than those of a loop
INLINED = {  # a function called: the parameter that holds it
    **dict.fromkeys(("jit", "remat2", "hhtjax_family", "hhtjax_bilinear", "hhtjax_map"), "jaxpr"),
    **dict.fromkeys(("closed_call", "eval_jaxpr", "custom_jvp_call", "custom_vjp_call"), "call_jaxpr"),
}


class NotListed(Exception):
    """An operation that cannot be listed. name: its name. line: the user's source line that needs it, or None."""

    def __init__(self, name: str, line=None):
        super().__init__(name if line is None else f"{name} ({line})")
        self.name, self.line = name, line


def listed(f: Callable, *args: PyTree, whole: bool = False) -> Listing:
    """Lists f as operations on scalars, with a scalar for each number of its arguments.

    Args:
        f: a function of pytrees of arrays that returns a pytree of arrays.
        *args: its arguments. Only their shapes and types matter.
        whole: whether linear solves, and sines by polynomials, stay single operations.

    Returns:
        A `Listing`. Its results are the pytree that f returns, with object arrays of operands.

    Raises:
        NotListed: an operation is not supported. It has the name of the operation and its source line.

    >>> import jax.numpy as jnp
    >>> found = listed(lambda x: 2 * jnp.sin(x), jnp.ones(3))
    >>> len(found.arguments), found.count()
    (3, (6, 3))
    """
    trace, like = jax.make_jaxpr(f, return_shape=True)(*args)
    recorder = Recorder()
    trace = lowered(trace)
    listing = _Listing(recorder, whole)
    values = [_fresh(recorder, x.aval) for x in trace.jaxpr.invars]
    with np.errstate(all="ignore"):
        results = [each(as_operand, x) for x in listing.run(trace, values)]
    wanted = {x for value in results for x in value.flat if isinstance(x, Scalar)}
    operations = pruned(recorder.blocks[0].operations, wanted)
    for x in everywhere(operations):
        if x.name == UNKNOWN:
            raise NotListed(x.params["what"], x.params["line"])
    if sum(1 for _ in everywhere(operations)) > MOST:
        raise NotListed(f"more than {MOST} operations")
    return Listing([x for value in values for x in value.flat], operations, jax.tree.structure(like).unflatten(results))


def _fresh(recorder: Recorder, aval) -> np.ndarray:
    """A new scalar for each element."""
    count = int(np.prod(aval.shape, dtype=int))
    dtype = np.dtype(object if jnp.issubdtype(aval.dtype, jax.dtypes.extended) else aval.dtype)
    return arranged([Scalar(dtype, recorder) for _ in range(count)], aval.shape)


def known_pieces(x) -> np.ndarray:
    """An array of numbers, taken to pieces whatever its size."""
    if jnp.issubdtype(getattr(x, "dtype", float), jax.dtypes.extended):
        raise NotListed("random numbers")
    x = np.asarray(x)
    return arranged(list(x.reshape(-1)), x.shape)


class _Listing:
    """The evaluator of a jaxpr on object arrays."""

    def __init__(self, recorder: Recorder, whole: bool = False):
        self.recorder, self.lines, self.whole = recorder, [], whole

    def run(self, closed: ClosedJaxpr, values: list):
        """The values of the results of a closed jaxpr."""
        jaxpr, constants = getattr(closed, "jaxpr", closed), getattr(closed, "consts", ())
        return evaluate(jaxpr, [*map(known_pieces, constants), *values], self.apply, known_pieces)

    def apply(self, eqn: JaxprEqn, values: list):
        """The results of one operation; of one that is not known, results that nobody may need."""
        self.lines.append(line_of(eqn))
        self.recorder.line = self._line()
        results = self._results(eqn, eqn.primitive.name, values)
        line = self._line()
        self.lines.pop()
        if results is None:
            what = {"what": eqn.primitive.name, "line": line}
            results = [_fresh(self.recorder, x.aval) for x in eqn.outvars]
            self.recorder.append(Operation(UNKNOWN, _flat(values), _flat(results), what))
        if eqn.effects:
            raise NotListed(eqn.primitive.name, line)
        results = [x if isinstance(x, np.ndarray) else arranged([x], ()) for x in results]
        return [each(as_operand, x) for x in results]

    def _line(self):
        """The user's that is being listed; a cached trace has forgotten it."""
        return next(filter(None, reversed(self.lines)), None)

    def _results(self, eqn, name: str, values):
        if self.whole and _is_sincos(eqn):
            return [each(lambda x, f=f: self.recorder.record(f, x.dtype, x), values[-1]) for f in ("sin", "cos")]
        if name in INLINED:
            return self.run(eqn.params[INLINED[name]], values)
        if name in LOOPS:
            return LOOPS[name](self, eqn, *values)
        if name in ("hhtjax_held", "hhtjax_watch", "optimization_barrier", "device_put"):
            return values
        if name == "hhtjax_values":  # a function that autodiff keeps whole, such as a root
            shapes = [jax.ShapeDtypeStruct(x.aval.shape, x.aval.dtype) for x in eqn.invars]
            return self.run(lowered(jax.make_jaxpr(eqn.params["f"])(shapes)), values)
        if name == "hhtjax_row_written":
            shapes = [jax.ShapeDtypeStruct(x.aval.shape, x.aval.dtype) for x in eqn.invars]
            return self.run(jax.make_jaxpr(partial(written, **eqn.params))(*shapes), values)
        if name == "hhtjax_inside":  # functions come in two forms: outside of a kernel LAPACK's
            return [known_pieces(np.bool_(False))]
        known = all(is_known(x) for value in values for x in value.flat)
        if is_understood(eqn) and not known and (found := in_loops(self.recorder, eqn, values)) is not None:
            return found
        if (name not in UNDERSTOOD or is_understood(eqn)) and not (known and any(not x.size for x in values)):
            rule = FOLDS.get(name) or RULES.get(name)
            results = None if rule is None else rule(eqn, *values)
            if results is not None:
                return results
        if known and not eqn.effects and not jnp.issubdtype(eqn.outvars[0].aval.dtype, jax.dtypes.extended):
            arrays = [np.asarray(v.tolist(), x.aval.dtype) for v, x in zip(values, eqn.invars, strict=True)]
            arrays = [x.reshape(v.shape) for x, v in zip(arrays, values, strict=True)]
            with jax.ensure_compile_time_eval():
                return [known_pieces(x) for x in alone(eqn)(*map(jnp.asarray, arrays))]
        return ARRAYS[name](self.recorder, eqn, *values) if name in ARRAYS else None


def _flat(values: PyTree):
    return [x for value in values for x in value.flat]


def _back(elements, avals):
    """Elements as object arrays of such shapes."""
    elements = iter(elements)
    return [arranged([next(elements) for _ in range(int(np.prod(x.shape, dtype=int)))], x.shape) for x in avals]


def _cond(listing, eqn: JaxprEqn, which: np.ndarray, *values: np.ndarray):
    which, branches, recorder = which.item(), eqn.params["branches"], listing.recorder
    if is_known(which):
        return listing.run(branches[min(max(int(which), 0), len(branches) - 1)], values)
    blocks = [recorder.inside(lambda closed=closed: _flat(listing.run(closed, values))) for closed in branches]
    results = [Scalar(x.dtype, recorder) for x in _flat(_fresh(recorder, x.aval) for x in eqn.outvars)]
    recorder.append(Operation("cond", [which], results, blocks=blocks))
    return _back(results, [x.aval for x in eqn.outvars])


def _while(listing, eqn: JaxprEqn, *values: np.ndarray):
    params, recorder = eqn.params, listing.recorder
    if params["cond_jaxpr"].out_avals[0].shape:
        return None
    first = params["cond_nconsts"]
    second = first + params["body_nconsts"]
    carry = [_fresh(recorder, x.aval) for x in eqn.outvars]
    blocks = [
        recorder.inside(lambda: _flat(listing.run(params["cond_jaxpr"], [*values[:first], *carry]))),
        recorder.inside(lambda: _flat(listing.run(params["body_jaxpr"], [*values[first:second], *carry]))),
    ]
    start = [as_operand(x) for x in _flat(values[second:])]
    recorder.append(Operation("while", start, _flat(carry), blocks=blocks))
    return carry


def _scan(listing, eqn: JaxprEqn, *values: np.ndarray):
    """Written out, or a loop, where that is long and reads and makes no rows."""
    params = eqn.params
    first, carried = kept_and_carried(params)
    second = first + carried
    if second == len(values) and carried == len(eqn.outvars):
        loop = _counted(listing, params, values[:first], values[first:], [x.aval for x in eqn.outvars])
        if loop is not None:
            return loop
    carry, rows = list(values[first:second]), []
    steps = range(params["length"])
    for i in reversed(steps) if params["reverse"] else steps:
        inside = [arranged(list(x[i].flat) if x.ndim > 1 else [x[i]], x.shape[1:]) for x in values[second:]]
        found = listing.run(params["jaxpr"], [*values[:first], *carry, *inside])
        carry, row = found[: len(carry)], found[len(carry) :]
        rows.append(row)
    columns = zip(*(rows[::-1] if params["reverse"] else rows), strict=True)
    return [*carry, *_back(_flat(x for column in columns for x in column), [x.aval for x in eqn.outvars[len(carry) :]])]


def kept_and_carried(params: PyTree):
    """How many of the arguments of a scan stay, and how many go from step to step."""
    if "num_carry" in params:  # JAX <= 0.11
        return params["num_consts"], params["num_carry"]
    return tuple(map(len, params["ft_in"].unpack()[:2]))


def _counted(listing, params: PyTree, constants: tuple, start: tuple, avals: list):
    """Repeated equal steps as a `while` with a counter; None if that saves little."""
    recorder, carry = listing.recorder, [_fresh(listing.recorder, x) for x in avals]
    body = recorder.inside(lambda: _flat(listing.run(params["jaxpr"], [*constants, *carry])))
    if (params["length"] - 1) * sum(1 for _ in everywhere(body.operations)) <= WRITTEN_OUT:
        return None
    i, one = Scalar(np.dtype(np.int32), recorder), np.int32(1)
    unfinished = recorder.inside(lambda: [recorder.record("lt", bool, i, np.int32(params["length"]))])
    counted = recorder.inside(lambda: [recorder.record("add", np.int32, i, one)])
    body = Block(body.operations + counted.operations, body.results + counted.results)
    operands = [as_operand(x) for x in _flat(start)] + [np.int32(0)]
    recorder.append(Operation("while", operands, [*_flat(carry), i], blocks=[unfinished, body]))
    return carry


def _is_sincos(eqn: JaxprEqn) -> bool:
    """Whether an operation is `hhtjax.trigonometry.sincos`."""
    return eqn.primitive.name == "custom_jvp_call" and eqn.params["call_jaxpr"].jaxpr.debug_info.func_name == "sincos"


def _whole_solve(listing: _Listing, eqn: JaxprEqn, constants: list, b: list):
    """A linear solve as one operation."""
    recorder, x = listing.recorder, [_fresh(listing.recorder, y.aval) for y in eqn.outvars]
    block = recorder.inside(lambda: _flat(listing.run(eqn.params["jaxprs"].matvec, [*constants, *x])))
    recorder.append(Operation("solve", [as_operand(y) for y in _flat(b)], _flat(x), blocks=[block]))
    return x


def _custom_linear_solve(listing, eqn: JaxprEqn, *values: np.ndarray):
    lengths = eqn.params["const_lengths"]
    if listing.whole:
        return _whole_solve(listing, eqn, list(values[: lengths.matvec]), list(values[sum(lengths) :]))
    start = lengths.matvec + lengths.vecmat
    constants, b = values[start : start + lengths.solve], values[sum(lengths) :]
    return listing.run(eqn.params["jaxprs"].solve, [*constants, *b])


LOOPS = {"cond": _cond, "while": _while, "scan": _scan, "custom_linear_solve": _custom_linear_solve}


# ----------------------------------------------------------------------------
# Operations of the list on large arrays, as loops: sums and products, number by number, and products of matrices.
#
# Only where one of the arrays has a name already, or all numbers are known or the same: to gather scattered numbers
# takes as many operations as it saves. Where zeros are structural, numbers one by one are fewer.


MAPPED = {"add": "add", "add_any": "add", "div": "div", "mul": "mul", "neg": "neg", "sub": "sub"}


def in_loops(recorder, eqn, values):
    """The values of the results of an operation, or None where it is better written number by number."""
    name, out = eqn.primitive.name, eqn.outvars[0].aval
    if name in MAPPED and out.size >= LARGE and np.dtype(out.dtype).kind == "f":
        return _map(recorder, MAPPED[name], out, [np.broadcast_to(x, out.shape) for x in values])
    if name == "dot_general" and all(v.aval.dtype == out.dtype for v in eqn.invars):
        over, batch = eqn.params["dimension_numbers"]
        if not any(batch) and len(over[0]) == 1:
            a, b = values
            return _product(recorder, out, a, b, over[0][0], over[1][0])
    return None


def _map(recorder: Recorder, name: str, out, values: list):
    if any(is_structural(y) for x in values for y in x.flat):
        return None
    found = [_operand(recorder, x) for x in values]
    if None in found and not any(isinstance(x, Scalar) and x.size for x in found):
        return None
    operands = [recorder.array(x.flat, out.dtype) if y is None else y for x, y in zip(values, found, strict=True)]
    found = recorder.arrays("map", operands, [(out.dtype, out.size)], of=name)
    return [elements_of(recorder, found[0], out.shape)]


def _operand(recorder, x: np.ndarray):
    """The single number that an array holds, or its name; None if it has neither."""
    first = x.flat[0]
    if all(y.tobytes() == first.tobytes() if is_known(y) and is_known(first) else y is first for y in x.flat):
        return as_operand(first)
    return recorder.name_of(x.flat, known=True)


def _product(recorder: Recorder, out, a, b, i: int, j: int):
    """sum_l a_il b_lj, the axis i of a and j of b summed; the elements of each at strides of its rows and columns."""
    if a.ndim == 1 and b.ndim == 2:
        a, b, i, j = b, a, j, i
    count = a.shape[i]
    rows, columns = a.size // count, b.size // count
    if a.ndim != 2 or b.ndim > 2 or rows * count * columns < LARGE or any(map(is_structural, (*a.flat, *b.flat))):
        return None
    if all(map(is_known, a.flat)):  # in the order in which a loop reads it
        a, i = np.moveaxis(a, i, 0), 0
    left = recorder.name_of(a.flat, known=True)
    right = recorder.array(b.flat, out.dtype) if b.ndim == 1 else recorder.name_of(b.flat, known=True)
    if not isinstance(left, Scalar) or not isinstance(right, Scalar):
        return None
    strides = (1, rows) if i == 0 else (count, 1), (columns, 1) if j == 0 else (1, count)
    found = recorder.arrays(
        "product", [left, right], [(out.dtype, out.size)], count=count, rows=rows, columns=columns, strides=strides
    )
    return [elements_of(recorder, found[0], out.shape)]


# ----------------------------------------------------------------------------
# Operations of the list that need a whole array: indices that are not known, elimination, the largest element.


# Rules: (recorder, operation, object arrays) -> the values of the results, or None.


def _read(recorder, x, starts, offsets, strides):
    """The elements of x at sum((starts + offsets) strides), for starts that lie inside."""
    array = recorder.array(x.flat, x.flat[0].dtype)
    index = np.int32(sum(a * b for a, b in zip(offsets, strides, strict=True)))
    for start, stride in zip(starts, strides, strict=True):
        index = _plus(recorder, index, _times(recorder, start, stride))
    return x.flat[int(index)] if is_known(index) else recorder.element(array, index)


def _times(recorder: Recorder, start, stride: int):
    return np.int32(start * stride) if is_known(start) else recorder.record("mul", np.int32, start, np.int32(stride))


def _plus(recorder, x, y):
    return np.int32(x + y) if is_known(x) and is_known(y) else recorder.record("add", np.int32, x, y)


def _inside(recorder, start, largest):
    """A start as an int32, moved into [0, largest]."""
    if is_known(start):
        return np.int32(min(max(int(start), 0), largest))
    dtype = start.dtype
    low = recorder.record("max", dtype, start, dtype.type(0))
    return recorder.record("convert_element_type", np.int32, recorder.record("min", dtype, low, dtype.type(largest)))


def _strides(shape: tuple):
    return [int(np.prod(shape[i + 1 :], dtype=int)) for i in range(len(shape))]


def _dynamic_slice(recorder, eqn: JaxprEqn, x: np.ndarray, *starts):
    sizes = eqn.params["slice_sizes"]
    starts = [_inside(recorder, s.item(), n - k) for s, n, k in zip(starts, x.shape, sizes, strict=True)]
    strides = _strides(x.shape)
    return [arranged([_read(recorder, x, starts, i, strides) for i in np.ndindex(*sizes)], sizes)]


def _gather(recorder, eqn, x, indices: np.ndarray):
    numbers, sizes, out = eqn.params["dimension_numbers"], eqn.params["slice_sizes"], eqn.outvars[0].aval
    batched = dict(zip(numbers.operand_batching_dims, numbers.start_indices_batching_dims, strict=True))
    kept = [i for i in range(x.ndim) if i not in numbers.collapsed_slice_dims and i not in batched]
    fills = eqn.params["mode"] == lax.GatherScatterMode.FILL_OR_DROP
    strides, found = _strides(x.shape), []
    for place in np.ndindex(*out.shape):
        row = tuple(i for axis, i in enumerate(place) if axis not in numbers.offset_dims)
        offsets = [0] * x.ndim
        for axis, i in zip(kept, (place[axis] for axis in numbers.offset_dims), strict=True):
            offsets[axis] = i
        for axis, which in batched.items():
            offsets[axis] = row[which]
        starts, outside = [np.int32(0)] * x.ndim, []
        for axis, start in zip(numbers.start_index_map, indices[row], strict=True):
            starts[axis] = _inside(recorder, start, x.shape[axis] - sizes[axis])
            if fills:
                outside.append((start, x.shape[axis] - sizes[axis]))
        value = _read(recorder, x, starts, offsets, strides)
        found.append(_filled(recorder, eqn, out.dtype, outside, value))
    return [arranged(found, out.shape)]


def _filled(recorder, eqn, dtype, outside: list, value):
    """The value, or what stands for an element that is not there."""
    fill = eqn.params["fill_value"]
    if fill is None:
        fill = np.nan if dtype.kind == "f" else np.iinfo(dtype).min if dtype.kind == "i" else 0
    for start, largest in outside:
        if is_known(start):
            value = value if 0 <= start <= largest else dtype.type(fill)
            continue
        low = recorder.record("lt", bool, start, start.dtype.type(0))
        high = recorder.record("gt", bool, start, start.dtype.type(largest))
        away = recorder.record("or", bool, low, high)
        value = recorder.record("select_n", dtype, away, value, dtype.type(fill))
    return value


def _largest(comparison: str, recorder, eqn, x: np.ndarray):
    """The index of the first largest (smallest) number, or of the first that is none."""
    (axis,), dtype = eqn.params["axes"], np.dtype(eqn.params["index_dtype"])

    def better(a: tuple, b: tuple):
        (i, x), (j, y) = a, b
        take = recorder.record(comparison, bool, y, x)
        if y.dtype.kind == "f":
            ours = recorder.record("eq", bool, x, x)  # not so for what is no number
            theirs = recorder.record("ne", bool, y, y)
            take = recorder.record("and", bool, ours, recorder.record("or", bool, take, theirs))
        return tuple(recorder.record("select_n", kind, take, p, q) for kind, p, q in ((dtype, i, j), (y.dtype, x, y)))

    rows = np.moveaxis(x, axis, -1).reshape(-1, x.shape[axis])
    found = [reduce(better, [(dtype.type(i), y) for i, y in enumerate(row)])[0] for row in rows]
    return [arranged(found, eqn.outvars[0].aval.shape)]


def _cumulative(name, recorder, eqn, x):
    axis, out = eqn.params["axis"], np.empty(x.shape, object)
    steps = range(x.shape[axis])
    total = None
    for i in reversed(steps) if eqn.params["reverse"] else steps:
        place = (slice(None),) * axis + (slice(i, i + 1),)
        row = x[place]
        if total is not None:
            row = arranged([compute(name, *pair) for pair in zip(total.flat, row.flat, strict=True)], row.shape)
        out[place] = total = row
    return [out]


def _scatter_add(recorder, eqn, x, indices, updates):
    """For indices that are known: a sum of the updates that each element gets."""
    if not all(map(is_known, indices.flat)):
        return None
    at = np.asarray(indices.tolist(), eqn.invars[1].aval.dtype)
    number = x.flat[0].dtype
    with jax.ensure_compile_time_eval():
        add = partial(lambda y: alone(eqn)(np.zeros(x.shape, number), at, y)[0])
        units = np.eye(updates.size, dtype=number).reshape(-1, *updates.shape)
        weights = np.stack([np.asarray(add(unit)).reshape(-1) for unit in units])
    found = list(x.flat)
    for update, places in zip(updates.flat, weights, strict=True):
        for i in np.flatnonzero(places):
            found[i] = compute("add", found[i], update)
    return [arranged(found, x.shape)]


def elements_of(recorder, array, shape):
    """Those of an array, in this shape."""
    return arranged([recorder.element(array, np.int32(i)) for i in range(array.size)], shape)


def _lu(recorder, eqn, A: np.ndarray):
    n = A.shape[-1]
    if A.shape != (n, n):
        return None
    dtype = eqn.outvars[0].aval.dtype
    likes = (dtype, n * n), (np.int32, n), (np.int32, n)
    found = recorder.arrays("lu", [recorder.array(A.flat, dtype)], likes, n=n)
    recorder.orders[found[1]] = found[2]
    return [elements_of(recorder, x, v.aval.shape) for x, v in zip(found, eqn.outvars, strict=True)]


def _svd(recorder, eqn, A):
    n, dtype = A.shape[-1], eqn.outvars[0].aval.dtype
    if A.shape != (n, n) or np.dtype(dtype).kind != "f" or eqn.params["subset_by_index"] is not None:
        return None
    found = recorder.arrays("svd", [recorder.array(A.flat, dtype)], [(dtype, n), *[(dtype, n * n)] * 2], n=n)
    return [elements_of(recorder, x, v.aval.shape) for x, v in zip(found, eqn.outvars, strict=False)]


def _permutation(recorder, eqn, pivots):
    """The order of the rows, which the elimination has told."""
    place = recorder.places.get(pivots.flat[0])
    order = None if place is None else recorder.orders.get(recorder.array(pivots.flat, np.int32))
    return None if order is None else [elements_of(recorder, order, pivots.shape)]


def _moved(recorder: Recorder, eqn: JaxprEqn, *values: np.ndarray):
    """The rule of an operation that only moves elements. It is applied to the numbers of the elements."""
    sizes = np.cumsum([0, *(x.size for x in values)])
    numbers = [np.arange(i, i + x.size, dtype=np.int32).reshape(x.shape) for i, x in zip(sizes, values, strict=False)]
    elements = np.concatenate([x.ravel() for x in values])
    with jax.ensure_compile_time_eval():
        return [arranged(elements[np.ravel(x)], x.shape) for x in alone(eqn)(*numbers)]


def _triangular_solve(recorder, eqn, A: np.ndarray, b: np.ndarray):
    params, shape, dtype = eqn.params, b.shape, eqn.outvars[0].aval.dtype
    if A.ndim != 2 or b.ndim != 2 or params["conjugate_a"]:
        return None
    flips = not params["left_side"]  # x A = b is A^T x^T = b^T
    columns = b if flips else b.T
    flags = {name: bool(params[name]) for name in ("lower", "unit_diagonal")}
    flags["transpose"] = bool(params["transpose_a"]) != flips
    matrix, solved = recorder.array(A.flat, dtype), []
    for column in columns:
        right = recorder.array(column, dtype)
        (x,) = recorder.arrays("triangular_solve", [matrix, right], [(dtype, len(column))], n=len(A), **flags)
        solved.append(elements_of(recorder, x, (len(column),)))
    rows = np.stack(solved)
    return [(rows if flips else rows.T).reshape(shape)]


def _compared(recorder, eqn, x, y):
    """Comparison in the order in which NaN comes last."""
    pairs = zip(x.flat, y.flat, strict=True)
    return [arranged([recorder.record(eqn.primitive.name, bool, *pair) for pair in pairs], x.shape)]


ARRAYS = {
    "argmax": partial(_largest, "gt"),
    "argmin": partial(_largest, "lt"),
    "cumprod": partial(_cumulative, "mul"),
    "cumsum": partial(_cumulative, "add"),
    "dynamic_slice": _dynamic_slice,
    "gather": _gather,
    **{"le_to": _compared, "lt_to": _compared},
    "lu": _lu,
    "lu_pivots_to_permutation": _permutation,
    "scatter-add": _scatter_add,
    "svd": _svd,
    "tile": _moved,
    "triangular_solve": _triangular_solve,
    "unstack": _moved,
}
