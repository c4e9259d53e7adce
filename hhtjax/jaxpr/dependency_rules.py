"""Which elements of the results of an operation depend on which elements of its operands: a rule for each operation.

A rule is a function (operation, *values) -> values of its results. It may report a dependence that does not exist, but
must not miss one. For an operation without a rule, or with an option that its rule does not support, each result
depends on everything on which any operand depends (`all_on_all`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from jax import lax

from hhtjax.jaxpr.known_values import MOVES
from hhtjax.jaxpr.row_sets import (
    MOST,
    Value,
    either,
    full_mask,
    grouped,
    numbers,
    only,
    related,
    stacked,
    taken,
    united,
    where_nonzero,
)

if TYPE_CHECKING:
    from jax.extend.core import JaxprEqn


def out_shape(eqn: JaxprEqn) -> tuple:
    """That of the first result."""
    aval: Any = eqn.outvars[0].aval
    return tuple(aval.shape)


def all_on_all(eqn: JaxprEqn, *values: Value) -> list[Value]:
    """Every element of every result depends on all that any operand depends on."""
    total = united(*(grouped(x.rows, np.zeros(x.size, int), 1) for x in values))
    shapes = [tuple(getattr(x.aval, "shape", ())) for x in eqn.outvars]
    return [Value(shape, taken(total, np.zeros(math.prod(shape), int))) for shape in shapes]


# ----------------------------------------------------------------------------
# Functions of elements.


def _fit(x: Value, shape: tuple):
    """Its rows in this shape: what is no array is the same for all elements."""
    return x.rows if x.shape == shape else taken(x.rows, np.broadcast_to(numbers(x.shape), shape))


def _fit_mask(x: Value, shape: tuple):
    found = where_nonzero(x)
    return None if found is None else np.broadcast_to(found, shape)


def _both(join: Callable, *masks):
    """The masks joined; None if one of them is."""
    found = masks[0]
    for x in masks[1:]:
        found = None if found is None or x is None else join(found, x)
    return found


def _elementwise(eqn, *values: Value):
    shape = out_shape(eqn)
    return [Value(shape, united(*(_fit(x, shape) for x in values)))]


def _of_zero_zero(eqn, x: Value):
    """A function of each element that takes zero to zero."""
    return [Value(x.shape, x.rows, nonzero=where_nonzero(x))]


def _add(eqn, x: Value, y: Value):
    shape = out_shape(eqn)
    mask = _both(np.logical_or, _fit_mask(x, shape), _fit_mask(y, shape))
    return [Value(shape, united(_fit(x, shape), _fit(y, shape)), nonzero=mask)]


def _mul(eqn, x: Value, y: Value):
    """x y. It does not depend on x where y is zero."""
    shape = out_shape(eqn)
    masks = _fit_mask(x, shape), _fit_mask(y, shape)
    rows = united(only(_fit(x, shape), masks[1]), only(_fit(y, shape), masks[0]))
    there = [mask for mask in masks if mask is not None]
    mask = there[0] if len(there) == 1 else np.logical_and(*there) if there else None
    return [Value(shape, rows, nonzero=mask)]


def _div(eqn, x: Value, y: Value):
    shape = out_shape(eqn)
    mask = _fit_mask(x, shape)
    return [Value(shape, united(_fit(x, shape), only(_fit(y, shape), mask)), nonzero=mask)]


def _integer_pow(eqn, x: Value):
    return [Value(x.shape, x.rows, nonzero=where_nonzero(x) if eqn.params["y"] > 0 else None)]


def _select_n(eqn, which: Value, *cases: Value):
    """The case that is chosen where that is known, and any of them elsewhere."""
    shape = out_shape(eqn)
    if which.known is None:
        return [either(*cases)]
    chosen = [np.broadcast_to(which.known == i, shape) for i in range(len(cases))]
    rows = united(*(only(x.rows, mask) for x, mask in zip(cases, chosen, strict=True)))
    mask = np.choose(np.broadcast_to(which.known, shape).astype(int), [full_mask(x) for x in cases], mode="clip")
    return [Value(shape, rows, nonzero=mask)]


def _without_derivative(eqn, *values: Value):
    """Piecewise constant."""
    return [Value(tuple(x.aval.shape)) for x in eqn.outvars]


def _same(eqn, *values: Value):
    return list(values[: len(eqn.outvars)])


# ----------------------------------------------------------------------------
# Elements that move, along axes that are known.


def _moved(eqn, *values: Value):
    """Applies an operation that moves elements to the numbers of the elements, and to what is known of them."""
    move = MOVES[eqn.primitive.name]
    there = [x for x in values if x.rows is not None]
    rows: list = [None] * len(eqn.outvars)
    masks: list = list(rows)
    if there:
        starts = np.cumsum([0, *(x.size for x in there)])
        places = {id(x): numbers(x.shape) + start for x, start in zip(there, starts, strict=False)}
        found = move(eqn, *(places.get(id(x), np.full(x.shape, -1)) for x in values))
        together = stacked(there)
        rows = [taken(together, x) for x in found]
    if any(where_nonzero(x) is not None for x in values):
        masks = move(eqn, *map(full_mask, values))
    return [Value(tuple(x.aval.shape), r, nonzero=m) for x, r, m in zip(eqn.outvars, rows, masks, strict=True)]


def _without_axes(shape: Sequence, axes: Sequence) -> np.ndarray:
    """For each element of an array the number of that which it becomes part of, when these axes are reduced."""
    kept = [1 if i in axes else length for i, length in enumerate(shape)]
    return np.broadcast_to(numbers(kept), shape)


def _reduced(x: Value, axes: Sequence, shape: tuple, zero_stays: bool) -> Value:
    mask = where_nonzero(x) if zero_stays else None
    mask = None if mask is None else np.any(mask, tuple(axes)).reshape(shape)
    return Value(shape, grouped(x.rows, _without_axes(x.shape, axes), math.prod(shape)), nonzero=mask)


def _reduce(eqn, x: Value):
    zero_stays = x.size > 0 and eqn.primitive.name != "reduce_prod"
    return [_reduced(x, eqn.params["axes"], out_shape(eqn), zero_stays)]


def _reduce_by_function(eqn, *values: Value):
    """`lax.reduce`: of as many first values as arrays."""
    count, shape = len(eqn.outvars), out_shape(eqn)
    parts = [_reduced(x, eqn.params["dimensions"], shape, False).rows for x in values[:count]]
    parts += [_fit(x, shape) for x in values[count:]]
    return [Value(shape, united(*parts)) for _ in eqn.outvars]


def _cumulative(eqn, x: Value):
    axis, length = eqn.params["axis"], x.shape[eqn.params["axis"]]
    if x.rows is None or length * x.size > 2 * MOST:
        return all_on_all(eqn, x)
    later, earlier = np.tril_indices(length)
    if eqn.params["reverse"]:
        later, earlier = earlier, later
    places = np.moveaxis(numbers(x.shape), axis, 0).reshape(length, -1)
    rows = related(places[later].reshape(-1), places[earlier].reshape(-1), x.rows, x.size)
    return [Value(x.shape, rows)]


def _along(eqn, axis: int, *values: Value):
    """Each result depends on all elements of its operand along this axis, as in sorting."""
    found = []
    for x, out in zip(values, eqn.outvars, strict=False):
        shape = tuple(out.aval.shape)
        kept = tuple(1 if i == axis else length for i, length in enumerate(x.shape))
        row = grouped(x.rows, _without_axes(x.shape, [axis]), math.prod(kept))
        found.append(Value(shape, taken(row, np.broadcast_to(numbers(kept), shape))))
    return found


def _sort(eqn, *values: Value):
    return _along(eqn, eqn.params["dimension"], *values)


def _top_k(eqn, x: Value):
    last = len(x.shape) - 1
    if eqn.params.get("axis", last) not in (last, -1):
        return all_on_all(eqn, x)
    return [*_along(eqn, last, x), Value(tuple(eqn.outvars[1].aval.shape))]


# ----------------------------------------------------------------------------
# Products.


def _dot_general(eqn, x: Value, y: Value):
    """z[b, i, j] = sum_k x[b, i, k] y[b, j, k]: where y is zero, no term of x."""
    (over_x, over_y), (batch_x, batch_y) = eqn.params["dimension_numbers"]
    order = [_ordered(v, batch, over) for v, batch, over in ((x, batch_x, over_x), (y, batch_y, over_y))]
    places = [(numbers(v.shape).transpose(axes)).reshape(sizes) for v, (axes, sizes) in zip((x, y), order, strict=True)]
    masks = [
        None if (m := where_nonzero(v)) is None else m.transpose(axes).reshape(sizes)
        for v, (axes, sizes) in zip((x, y), order, strict=True)
    ]
    shape = out_shape(eqn)
    out: Any = numbers([*places[0].shape[:2], *places[1].shape[1:2]])
    rows = united(
        _terms(x.rows, places[0], masks[1], out),
        _terms(y.rows, places[1], masks[0], out.swapaxes(1, 2)),
    )
    return [Value(shape, rows, nonzero=_mask_of_product(masks, places, shape))]


def _ordered(x: Value, batch: Sequence, over: Sequence):
    """Its axes in the order batch, free, summed; and the sizes of these three groups."""
    free = [i for i in range(len(x.shape)) if i not in (*batch, *over)]
    sizes = [math.prod(x.shape[i] for i in axes) for axes in (batch, free, over)]
    return [*batch, *free, *over], sizes


def _terms(rows, places: np.ndarray, mask: np.ndarray | None, out: np.ndarray):
    """The rows of the product that come from one factor.

    places: (b, i, k), its elements' numbers; mask: (b, j, k), where the other factor is not zero, or None for
    everywhere; out: (b, i, j), numbers of elements of the product.
    """
    if rows is None or not out.size:
        return None
    if mask is not None and mask.sum() * out.shape[1] <= MOST // 4:
        b, j, k = np.nonzero(mask)
        return related(out[b, :, j].reshape(-1), places[b, :, k].reshape(-1), rows, out.size)
    count = out.shape[0] * out.shape[1]
    to = np.empty(places.size, int)
    to[places] = np.arange(count).reshape(*out.shape[:2], 1)
    summed = grouped(rows, to, count)
    which = np.empty(out.size, int)
    which[out] = np.arange(count).reshape(*out.shape[:2], 1)
    return taken(summed, which)


def _mask_of_product(masks: list, places: list, shape: tuple):
    x, y = (np.ones(p.shape, bool) if m is None else m for m, p in zip(masks, places, strict=True))
    if (masks[0] is None and masks[1] is None) or math.prod(shape) * places[0].shape[2] > 100 * MOST:
        return None
    return (np.matmul(x.astype(np.float32), y.swapaxes(1, 2).astype(np.float32)) > 0).reshape(shape)


def _dense_blocks(count: int, eqn, *values: Value):
    """The last axes of each array, so many, are one block: of each member of a batch all on all."""
    batch = values[0].shape[: len(values[0].shape) - count]
    size = math.prod(batch)
    if any(x.shape[: len(batch)] != batch for x in values):
        return all_on_all(eqn, *values)
    total = united(*(grouped(x.rows, np.repeat(np.arange(size), x.size // max(size, 1)), size) for x in values))
    shapes = [tuple(x.aval.shape) for x in eqn.outvars]
    if any(shape[: len(batch)] != batch for shape in shapes):
        return all_on_all(eqn, *values)
    repeats = [math.prod(shape[len(batch) :]) for shape in shapes]
    return [Value(s, taken(total, np.repeat(np.arange(size), r))) for s, r in zip(shapes, repeats, strict=True)]


def _triangular_solve(eqn, A: Value, b: Value):
    """Each column of the unknowns on all of the matrix, and on its own right side; rows for x A = b."""
    axis = len(b.shape) - (2 if eqn.params["left_side"] else 1)
    size = math.prod(A.shape[:-2])
    if A.shape[:-2] != b.shape[:-2] or not b.size:
        return all_on_all(eqn, A, b)
    matrix = grouped(A.rows, np.repeat(np.arange(size), A.size // size), size)
    everywhere = taken(matrix, np.repeat(np.arange(size), b.size // size))
    (column,) = _along(eqn, axis, b)
    return [Value(b.shape, united(everywhere, column.rows))]


# ----------------------------------------------------------------------------
# Elements read and written at places that may be known.
#
# A place is a list of coordinates, for each axis an array that can be broadcast to what is read or written, or None:
# anywhere along this axis.


def _flat(places: list, shape: Sequence, window: tuple, inside) -> np.ndarray:
    """Numbers of elements in an array of this shape; of what is not inside, -1."""
    flat = np.zeros((1,) * len(window), int)
    for place, length in zip(places, shape, strict=True):
        flat = flat * length + (0 if place is None else place)
    return np.where(inside, np.broadcast_to(flat, window), -1)


def _read(x: Value, places: list, window: tuple, inside: Any = True) -> Value:
    """The elements at these places."""
    anywhere = [i for i, place in enumerate(places) if place is None]
    kept = tuple(1 if place is None else length for place, length in zip(places, x.shape, strict=True))
    if anywhere:
        x = _reduced(x, anywhere, kept, True)
    flat = _flat(places, kept, window, inside)
    mask = where_nonzero(x)
    mask = None if mask is None else np.append(mask.reshape(-1), True)[flat]
    return Value(window, taken(x.rows, flat), nonzero=mask)


def _written(x: Value, new: Value, places: list, inside: Any = True, replaces=False, keeps_zeros=True) -> Value:
    """x with elements of `new` at these places: in place of what stood there, if it `replaces` that, or beside it."""
    kept = tuple(1 if place is None else length for place, length in zip(places, x.shape, strict=True))
    flat = _flat(places, kept, new.shape, inside).reshape(-1)
    spread = np.broadcast_to(numbers(kept), x.shape)
    added = taken(grouped(new.rows, flat, math.prod(kept)), spread)
    gone = np.zeros(x.size, bool)
    if replaces and all(place is not None for place in places):
        gone[flat[flat >= 0]] = True
    mask = where_nonzero(x) if keeps_zeros else None
    if mask is not None or (keeps_zeros and gone.all()):
        marked = np.zeros(math.prod(kept), bool)
        marked[flat[full_mask(new).reshape(-1) & (flat >= 0)]] = True
        mask = (full_mask(x) & ~gone.reshape(x.shape)) | marked[spread]
    return Value(x.shape, united(only(x.rows, ~gone), added), nonzero=mask)


def _starts(starts: Sequence[Value], sizes: Sequence, shape: Sequence) -> list:
    """Places of a block of these sizes, moved inside."""
    places = []
    for axis, (start, size, length) in enumerate(zip(starts, sizes, shape, strict=True)):
        along = np.arange(size).reshape([-1 if i == axis else 1 for i in range(len(shape))])
        if size == length:
            places.append(along)
        elif start.known is None:
            places.append(None)
        else:
            places.append(along + min(max(int(start.known), 0), length - size))
    return places


def _dynamic_slice(eqn, x: Value, *starts: Value):
    sizes = eqn.params["slice_sizes"]
    return [_read(x, _starts(starts, sizes, x.shape), tuple(sizes))]


def _dynamic_update_slice(eqn, x: Value, new: Value, *starts: Value):
    return [_written(x, new, _starts(starts, new.shape, x.shape), replaces=True)]


def _row_written(eqn, x: Value, new: Value, number: Value):
    """`hhtjax.primitives.row_written`, each member of a batch its own row, or all the same."""
    axis = eqn.params["members"] + eqn.params["axis"]
    places = _starts([Value((), known=np.array(0))] * len(x.shape), new.shape, x.shape)
    if new.shape[axis] != x.shape[axis]:
        places[axis] = None
        if number.known is not None:
            start = np.clip(number.known, 0, x.shape[axis] - new.shape[axis])
            start = start.reshape(*start.shape, *[1] * (len(x.shape) - start.ndim))
            along = np.arange(new.shape[axis]).reshape([-1 if i == axis else 1 for i in range(len(x.shape))])
            places[axis] = start + along
    return [_written(x, new, places, replaces=True)]


def _windows(indices: Value, shape: tuple, window: tuple, sizes: Sequence, layout: tuple, clips: bool):
    """Places of a gather's or a scatter's windows, and which of them are inside.

    shape: of the array that has the windows; window: of what is read or written; sizes: of a window along each axis of
    the array; layout: axes of `window` that lie inside windows, axes of the array that have none there, the axes that
    the indices count, and axes of members, of the array and of the indices.
    """
    offsets, dropped, counted, members, of_indices = layout
    outside = [axis for axis in range(len(window)) if axis not in offsets]

    def along(axis: int):
        return np.arange(window[axis]).reshape([-1 if i == axis else 1 for i in range(len(window))])

    kept = [axis for axis in range(len(shape)) if axis not in (*dropped, *members)]
    places: list = [np.zeros((1,) * len(window), int)] * len(shape)
    for axis, offset in zip(kept, offsets, strict=True):
        places[axis] = along(offset)
    for axis, member in zip(members, of_indices, strict=True):
        places[axis] = along(outside[member])
    inside, numbered = np.array(True), indices.known
    for k, axis in enumerate(counted):
        most = shape[axis] - sizes[axis]
        if numbered is None:
            places[axis] = None if most else places[axis]
            continue
        start = numbered[..., k].astype(int).reshape([1 if i in offsets else n for i, n in enumerate(window)])
        if not clips:
            inside = inside & (start >= 0) & (start <= most)
        places[axis] = places[axis] + np.clip(start, 0, most)
    return places, inside


def _gather(eqn, x: Value, indices: Value):
    d, sizes = eqn.params["dimension_numbers"], eqn.params["slice_sizes"]
    layout = (
        *(d.offset_dims, d.collapsed_slice_dims, d.start_index_map),
        *(d.operand_batching_dims, d.start_indices_batching_dims),
    )
    clips = eqn.params["mode"] in (lax.GatherScatterMode.CLIP, lax.GatherScatterMode.PROMISE_IN_BOUNDS)
    if not x.size:
        return all_on_all(eqn, x)
    window = out_shape(eqn)
    places, inside = _windows(indices, x.shape, window, sizes, layout, clips)
    return [_read(x, places, window, inside)]


def _scatter(eqn, x: Value, indices: Value, updates: Value):
    d = eqn.params["dimension_numbers"]
    layout = (
        *(d.update_window_dims, d.inserted_window_dims, d.scatter_dims_to_operand_dims),
        *(d.operand_batching_dims, d.scatter_indices_batching_dims),
    )
    sizes = [1] * len(x.shape)
    kept = [i for i in range(len(x.shape)) if i not in (*d.inserted_window_dims, *d.operand_batching_dims)]
    for axis, window in zip(kept, d.update_window_dims, strict=True):
        sizes[axis] = updates.shape[window]
    if not x.size or not updates.size:
        return [Value(x.shape, x.rows, nonzero=where_nonzero(x))]
    clips = eqn.params["mode"] == lax.GatherScatterMode.CLIP
    places, inside = _windows(indices, x.shape, updates.shape, sizes, layout, clips)
    function = eqn.params.get("update_jaxpr")
    function = getattr(function, "jaxpr", function)
    is_new = function is None or (not function.eqns and function.outvars[0] is function.invars[1])
    is_set = eqn.primitive.name == "scatter"
    replaces = is_set and is_new and indices.known is not None
    return [_written(x, updates, places, inside, replaces, keeps_zeros=is_new or not is_set)]


# ----------------------------------------------------------------------------


ZERO_TO_ZERO = (
    "abs neg sin sinh tan tanh asin asinh atan atanh sqrt cbrt expm1 log1p square erf erf_inv real imag conj copy "
    "copy_p convert_element_type reduce_precision"
)
ELEMENTWISE = (
    "acos acosh atan2 bessel_i0e bessel_i1e clamp complex cos cosh digamma erfc exp exp2 igamma igamma_grad_a igammac "
    "lgamma log logistic log1mexp nextafter polygamma pow regularized_incomplete_beta rem rsqrt zeta"
)
CONSTANT = (
    "ceil floor round sign eq ne lt le gt ge eq_to le_to lt_to is_finite not and or xor "
    "argmax argmin stop_gradient bitcast_convert_type"
)
IDENTITIES = (
    "optimization_barrier device_put sharding_constraint layout_constraint reshard pvary name "
    "hhtjax_held hhtjax_watch hhtjax_structural "
    "hhtjax_largest_in_batch hhtjax_told hhtjax_forward_only hhtjax_or_alone"
)
BLOCKS = "lu cholesky eigh eig svd qr householder_product schur hessenberg tridiagonal"
CUMULATIVE = "cumsum cumprod cummax cummin cumlogsumexp"
SCATTERS = "scatter scatter-add scatter-sub scatter-mul scatter-min scatter-max"
REDUCTIONS = "reduce_sum reduce_max reduce_min reduce_prod reduce_and reduce_or reduce_xor"
RULES = {
    **dict.fromkeys(ZERO_TO_ZERO.split(), _of_zero_zero),
    **dict.fromkeys(ELEMENTWISE.split(), _elementwise),
    **dict.fromkeys(CONSTANT.split(), _without_derivative),
    **dict.fromkeys(IDENTITIES.split(), _same),
    **dict.fromkeys(("add", "add_any", "sub", "max", "min"), _add),
    **{"mul": _mul, "div": _div, "integer_pow": _integer_pow, "select_n": _select_n},
    **dict.fromkeys(MOVES, _moved),
    **dict.fromkeys(REDUCTIONS.split(), _reduce),
    **dict.fromkeys(CUMULATIVE.split(), _cumulative),
    **{"reduce": _reduce_by_function, "sort": _sort, "top_k": _top_k},
    "dot_general": _dot_general,
    **dict.fromkeys(BLOCKS.split(), partial(_dense_blocks, 2)),
    **{"tridiagonal_solve": partial(_dense_blocks, 1), "triangular_solve": _triangular_solve},
    **{"dynamic_slice": _dynamic_slice, "dynamic_update_slice": _dynamic_update_slice, "gather": _gather},
    **dict.fromkeys(SCATTERS.split(), _scatter),
    "hhtjax_row_written": _row_written,
    "hhtjax_inside": lambda eqn, x: [Value((), known=np.array(False))],
}
