"""What moves numbers from places to places, with NumPy, element by element where need be: for tests on small arrays."""

import numpy as np


def clipped(start, shape, sizes):
    return [int(np.clip(i, 0, n - size)) for i, n, size in zip(start, shape, sizes, strict=True)]


def _is_inside(start, shape, sizes):
    return all(0 <= i <= n - size for i, n, size in zip(start, shape, sizes, strict=True))


def _window(start, sizes):
    return tuple(slice(i, i + size) for i, size in zip(start, sizes, strict=True))


def _starts(operand, indices, to, batched, batch):
    """For each place in the batch: the place itself, and where in the operand its window starts."""
    for place in np.ndindex(*indices.shape[:-1]):
        start = [0] * operand.ndim
        for axis, i in zip(to, indices[place], strict=True):
            start[axis] = int(i)
        for axis, i in zip(batched, batch, strict=True):
            start[axis] = place[i]
        yield place, start


def _filling(fill, dtype):
    if fill is not None:
        return fill
    if np.issubdtype(dtype, np.inexact):
        return np.nan
    return (
        True
        if dtype.kind == "b"
        else np.iinfo(dtype).min
        if np.issubdtype(dtype, np.signedinteger)
        else np.iinfo(dtype).max
    )


def gather(eqn, x, indices):
    params, out = eqn.params, eqn.outvars[0].aval
    dims, sizes, mode = params["dimension_numbers"], params["slice_sizes"], str(params["mode"])
    result = np.empty(out.shape, out.dtype)
    gone = (*dims.collapsed_slice_dims, *dims.operand_batching_dims)
    kept = [n for i, n in enumerate(sizes) if i not in gone]
    to = dims.start_index_map
    for place, start in _starts(x, indices, to, dims.operand_batching_dims, dims.start_indices_batching_dims):
        if "FILL" in mode and not _is_inside(start, x.shape, sizes):
            window = _filling(params["fill_value"], out.dtype)
        else:
            window = x[_window(clipped(start, x.shape, sizes), sizes)].reshape(kept)
        rest = iter(place)
        result[tuple(slice(None) if i in dims.offset_dims else next(rest) for i in range(result.ndim))] = window
    return [result]


COMBINED = {
    **{"scatter": lambda old, new: new, "scatter-add": np.add, "scatter_add": np.add, "scatter-sub": np.subtract},
    **{"scatter-mul": np.multiply, "scatter_mul": np.multiply, "scatter_sub": np.subtract},
    **{"scatter-min": np.minimum, "scatter_min": np.minimum, "scatter-max": np.maximum, "scatter_max": np.maximum},
}


def scatter(eqn, x, indices, updates):
    params = eqn.params
    dims, mode, combine = params["dimension_numbers"], str(params["mode"]), COMBINED[eqn.primitive.name]
    result = np.array(x)
    inserted = (*dims.inserted_window_dims, *dims.operand_batching_dims)
    lengths = iter(updates.shape[i] for i in dims.update_window_dims)
    sizes = [1 if i in inserted else next(lengths) for i in range(x.ndim)]
    to = dims.scatter_dims_to_operand_dims
    for place, start in _starts(x, indices, to, dims.operand_batching_dims, dims.scatter_indices_batching_dims):
        if "CLIP" in mode:
            start = clipped(start, x.shape, sizes)
        elif not _is_inside(start, x.shape, sizes):
            continue
        rest = iter(place)
        part = updates[
            tuple(slice(None) if i in dims.update_window_dims else next(rest) for i in range(updates.ndim))
        ].reshape(sizes)
        window = _window(start, sizes)
        result[window] = combine(result[window], part)
    return [result]


def pad(eqn, x, filling):
    for axis, (low, high, interior) in enumerate(eqn.params["padding_config"]):
        n = x.shape[axis]
        if interior and n:
            shape = list(x.shape)
            shape[axis] = n + (n - 1) * interior
            wide = np.full(shape, filling, x.dtype)
            wide[(slice(None),) * axis + (slice(None, None, interior + 1),)] = x
            x = wide
        added = [(0, 0)] * x.ndim
        added[axis] = max(low, 0), max(high, 0)
        x = np.pad(x, added, constant_values=filling)
        stop = x.shape[axis] + min(high, 0)
        x = x[(slice(None),) * axis + (slice(-min(low, 0), stop),)]
    return [x]


def dynamic_slice(eqn, x, *start):
    sizes = eqn.params["slice_sizes"]
    return [x[_window(clipped([int(i) for i in start], x.shape, sizes), sizes)]]


def dynamic_update_slice(eqn, x, part, *start):
    result = np.array(x)
    result[_window(clipped([int(i) for i in start], x.shape, part.shape), part.shape)] = part
    return [result]


def sort(eqn, *values):
    axis, first = eqn.params["dimension"], values[0]
    if eqn.params["num_keys"] != 1:
        return None
    order = np.argsort(first + 0 if np.issubdtype(first.dtype, np.floating) else first, axis, kind="stable")
    return [np.take_along_axis(x, order, axis) for x in values]


def cumulated(f):
    def rule(eqn, x):
        axis = eqn.params["axis"]
        x = np.flip(x, axis) if eqn.params["reverse"] else x
        found = f.accumulate(x, axis)
        return [np.flip(found, axis) if eqn.params["reverse"] else found]

    return rule


def index_of(f):
    return lambda eqn, x: [f(x, eqn.params["axes"][0]).astype(eqn.params["index_dtype"])]


PLACES = {
    **{"gather": gather, "pad": pad, "dynamic_slice": dynamic_slice, "dynamic_update_slice": dynamic_update_slice},
    **dict.fromkeys(COMBINED, scatter),
    **{"sort": sort, "argmax": index_of(np.argmax), "argmin": index_of(np.argmin)},
    **{"cumsum": cumulated(np.add), "cumprod": cumulated(np.multiply), "cummax": cumulated(np.maximum)},
    **{"cummin": cumulated(np.minimum), "cumlogsumexp": cumulated(np.logaddexp)},
}
