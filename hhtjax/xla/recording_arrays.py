"""Operations of the list that need a whole array: indices that are not known, elimination, the largest element."""

from functools import partial, reduce

import jax
import numpy as np
from jax import lax

from hhtjax.xla.arithmetic import compute
from hhtjax.xla.interpreter import alone
from hhtjax.xla.pieces import arranged, is_known

# Rules: (recorder, operation, object arrays) -> the values of the results, or None.


def _read(recorder, x, starts, offsets, strides):
    """The elements of x at sum((starts + offsets) strides), for starts that lie inside."""
    array = recorder.array(x.flat, x.flat[0].dtype)
    index = np.int32(sum(a * b for a, b in zip(offsets, strides, strict=True)))
    for start, stride in zip(starts, strides, strict=True):
        index = _plus(recorder, index, _times(recorder, start, stride))
    return x.flat[int(index)] if is_known(index) else recorder.element(array, index)


def _times(recorder, start, stride):
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


def _strides(shape):
    return [int(np.prod(shape[i + 1 :], dtype=int)) for i in range(len(shape))]


def _dynamic_slice(recorder, eqn, x, *starts):
    sizes = eqn.params["slice_sizes"]
    starts = [_inside(recorder, s.item(), n - k) for s, n, k in zip(starts, x.shape, sizes, strict=True)]
    strides = _strides(x.shape)
    return [arranged([_read(recorder, x, starts, i, strides) for i in np.ndindex(*sizes)], sizes)]


def _gather(recorder, eqn, x, indices):
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


def _filled(recorder, eqn, dtype, outside, value):
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


def _largest(comparison, recorder, eqn, x):
    """The index of the first largest (smallest) number, or of the first that is none."""
    (axis,), dtype = eqn.params["axes"], np.dtype(eqn.params["index_dtype"])

    def better(a, b):
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


def _lu(recorder, eqn, A):
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


def _moved(recorder, eqn, *values):
    """Of what moves elements, and does nothing else: asked where it takes their numbers."""
    sizes = np.cumsum([0, *(x.size for x in values)])
    numbers = [np.arange(i, i + x.size, dtype=np.int32).reshape(x.shape) for i, x in zip(sizes, values, strict=False)]
    elements = np.concatenate([x.ravel() for x in values])
    with jax.ensure_compile_time_eval():
        return [arranged(elements[np.ravel(x)], x.shape) for x in alone(eqn)(*numbers)]


def _triangular_solve(recorder, eqn, A, b):
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
    """In the order in which what is no number comes last."""
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
