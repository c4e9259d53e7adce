"""Arithmetic on small arrays taken to pieces: NumPy arrays of objects, which are scalars, traced or known.

What moves numbers about costs nothing, and neither does a product with a known zero or one.
"""

import math
from functools import reduce

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

LARGEST = 64  # numbers in an array that is taken to pieces; larger ones stay whole


def is_small(aval):
    """Whether arrays like this are taken to pieces."""
    return math.prod(aval.shape) <= LARGEST and not jnp.issubdtype(aval.dtype, jax.dtypes.extended)


def is_in_pieces(value):
    """Or whole."""
    return isinstance(value, np.ndarray) and value.dtype == object


def is_known(x):
    """Whether an element is a number, and no tracer."""
    return isinstance(x, np.generic)


def arranged(elements, shape):
    """The pieces of an array of this shape."""
    found = np.empty(len(elements), object)
    for i, x in enumerate(elements):  # one by one: NumPy would ask a tracer for its array
        found[i] = x
    return found.reshape(shape)


def pieces(x):
    """A small array taken to pieces; a large one as it is."""
    if isinstance(x, (np.ndarray, np.generic, int, float, complex)):
        x = np.asarray(x)
    if not is_small(x):
        return x
    return arranged([x[i] if x.shape else x[()] for i in np.ndindex(*x.shape)], x.shape)


def whole(value, aval):
    """The array of a value."""
    if not is_in_pieces(value):
        return value
    if not value.size:
        return jnp.zeros(aval.shape, aval.dtype)
    elements = [jnp.asarray(x, aval.dtype) for x in value.flat]
    return jnp.stack(elements).reshape(aval.shape) if aval.shape else elements[0]


def each(f, value):
    """f of every element."""
    return arranged([f(x) for x in value.flat], value.shape) if is_in_pieces(value) else f(value)


# Rules: (operation, values) -> the values of the results, or None for whole arrays.


def _elementwise(eqn, *values):
    out = eqn.outvars[0].aval
    columns = [np.broadcast_to(x, out.shape).flat for x in values]
    return [arranged([_scalar(eqn, out.dtype, *x) for x in zip(*columns, strict=True)], out.shape)]


def _scalar(eqn, dtype, *x):
    """One operation on scalars, or what is known without it."""
    name = eqn.primitive.name
    if name == "select_n" and is_known(x[0]):
        return x[1 + int(x[0])]
    found = _without(name, dtype, *x)
    return eqn.primitive.bind(*x, **eqn.params) if found is None else found


def _without(name, dtype, *x):
    """What is known of the result of an operation, or None."""
    if name in NUMPY and all(map(is_known, x)):
        return dtype.type(NUMPY[name](*x))
    return SHORT[name](dtype, *x) if name in SHORT and jnp.issubdtype(dtype, jnp.inexact) else None


def _is(x, number):
    return is_known(x) and x == number


def _product(dtype, x, y):
    if _is(x, 0) or _is(y, 0):
        return dtype.type(0)
    return y if _is(x, 1) else x if _is(y, 1) else None


def _sum(dtype, x, y):
    return y if _is(x, 0) else x if _is(y, 0) else None


def _difference(dtype, x, y):
    return x if _is(y, 0) else lax.neg(y) if _is(x, 0) else None


def _quotient(dtype, x, y):
    return dtype.type(0) if _is(x, 0) else x if _is(y, 1) else None


def _fold(name, dtype, x):
    """x[0] o x[1] o ..., o one of the operations of LAX."""

    def combine(x, y):
        found = _without(name, dtype, x, y)
        return LAX[name](x, y) if found is None else found

    return reduce(combine, x)


def _reduction(name):
    def rule(eqn, x):
        axes, out = eqn.params["axes"], eqn.outvars[0].aval
        rows = _rows(x, [i for i in range(x.ndim) if i not in axes], axes)
        return [arranged([_fold(name, out.dtype, row) for row in rows], out.shape)] if x.size else None

    return rule


def _rows(x, first, last):
    """x as a matrix, the axes `first` along its columns, `last` along its rows."""
    lengths = [math.prod(x.shape[i] for i in axes) for axes in (first, last)]
    return x.transpose(*first, *last).reshape(lengths)


def _dot_general(eqn, x, y):
    out = eqn.outvars[0].aval
    if not (x.size and y.size) or any(v.aval.dtype != out.dtype for v in eqn.invars):
        return None
    over, batch = eqn.params["dimension_numbers"]
    rows = []
    for value, summed, batched in zip((x, y), over, batch, strict=True):
        kept = [i for i in range(value.ndim) if i not in (*summed, *batched)]
        members = _rows(value, batched, [*kept, *summed])
        rows.append(members.reshape(len(members), -1, math.prod(value.shape[i] for i in summed)))

    def dot(a, b):
        return _fold("add", out.dtype, [_fold("mul", out.dtype, pair) for pair in zip(a, b, strict=True)])

    return [arranged([dot(a, b) for left, right in zip(*rows, strict=True) for a in left for b in right], out.shape)]


def _reshape(eqn, x):
    return [x.reshape(eqn.outvars[0].aval.shape)]


def _transpose(eqn, x):
    return [x.transpose(eqn.params["permutation"])]


def _broadcast_in_dim(eqn, x):
    shape = [1] * len(eqn.params["shape"])
    for axis, n in zip(eqn.params["broadcast_dimensions"], x.shape, strict=True):
        shape[axis] = n
    return [np.broadcast_to(x.reshape(shape), eqn.params["shape"])]


def _concatenate(eqn, *parts):
    return [np.concatenate(parts, eqn.params["dimension"])]


def _stack(eqn, *parts):
    return [np.stack(parts, eqn.params["axis"])]


def _split(eqn, x):
    return np.split(x, np.cumsum(eqn.params["sizes"])[:-1], eqn.params["axis"])


def _rev(eqn, x):
    return [np.flip(x, eqn.params["dimensions"])]


def _slice(eqn, x):
    start, stop, step = (eqn.params[key] for key in ("start_indices", "limit_indices", "strides"))
    return [x[tuple(map(slice, start, stop, step or [1] * x.ndim))]]


def _iota(eqn):
    out, axis = eqn.outvars[0].aval, eqn.params["dimension"]
    return [pieces(np.indices(out.shape)[axis].astype(out.dtype))]


def _moved(*moves):
    """Of what moves elements to places that are known: asked where it takes the numbers of the elements."""

    def rule(eqn, *values):
        if not all(is_known(x) for i, value in enumerate(values) if i not in moves for x in value.flat):
            return None
        dtype = eqn.invars[0].aval.dtype
        if not jnp.issubdtype(dtype, jnp.floating):
            return None
        elements = np.concatenate([values[i].ravel() for i in moves])
        numbers = iter(np.split(np.arange(elements.size, dtype=dtype), np.cumsum([values[i].size for i in moves])))
        arrays = [
            next(numbers).reshape(value.shape) if i in moves else np.asarray(value.tolist(), x.aval.dtype)
            for i, (value, x) in enumerate(zip(values, eqn.invars, strict=True))
        ]
        with jax.ensure_compile_time_eval():
            taken = np.asarray(eqn.primitive.bind(*arrays, **eqn.params))
        return [elements[taken.astype(int)]] if np.isfinite(taken).all() else None  # NaN: outside the array

    return rule


ELEMENTWISE = {
    *("abs", "acos", "acosh", "add", "add_any", "and", "asin", "asinh", "atan", "atan2", "atanh", "cbrt", "ceil"),
    *("clamp", "convert_element_type", "copy", "cos", "cosh", "div", "eq", "erf", "exp", "exp2", "expm1", "floor"),
    *("ge", "gt", "integer_pow", "is_finite", "le", "log", "log1p", "logistic", "lt", "max", "min", "mul", "ne"),
    *("neg", "nextafter", "not", "or", "pow", "rem", "round", "rsqrt", "select_n", "sign", "sin", "sinh", "sqrt"),
    *("square", "stop_gradient", "sub", "tan", "tanh", "xor"),
}
RULES = {
    **dict.fromkeys(ELEMENTWISE, _elementwise),
    **{"broadcast_in_dim": _broadcast_in_dim, "concatenate": _concatenate, "dot_general": _dot_general, "iota": _iota},
    **{"reshape": _reshape, "squeeze": _reshape, "rev": _rev, "slice": _slice},
    **{"split": _split, "stack": _stack, "transpose": _transpose},
    **{
        "gather": _moved(0),
        "dynamic_slice": _moved(0),
        "dynamic_update_slice": _moved(0, 1),
        "pad": _moved(0, 1),
        "scatter": _moved(0, 2),
    },
    **{f"reduce_{kind}": _reduction(kind) for kind in ("max", "min", "and", "or")},
    **{"reduce_sum": _reduction("add"), "reduce_prod": _reduction("mul")},
}
NUMPY = {
    **{"add": np.add, "add_any": np.add, "sub": np.subtract, "mul": np.multiply, "neg": np.negative},
    **{"eq": np.equal, "ne": np.not_equal, "lt": np.less, "le": np.less_equal, "gt": np.greater},
    **{"ge": np.greater_equal, "and": np.bitwise_and, "or": np.bitwise_or, "max": np.maximum, "min": np.minimum},
    "convert_element_type": lambda x: x,
}
SHORT = {"mul": _product, "add": _sum, "add_any": _sum, "sub": _difference, "div": _quotient}
LAX = {
    **{"add": lax.add, "mul": lax.mul, "max": lax.max, "min": lax.min},
    **{"and": lax.bitwise_and, "or": lax.bitwise_or},
}
