"""Arithmetic on arrays that have been taken apart into scalars.

Moving elements costs nothing. Arithmetic follows the program exactly, in IEEE arithmetic with signed zeros, NaN and
infinities: only x * 1, x / 1, x - 0 and x + -0 are replaced by x. With structural zeros more operations can be left
    out.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import reduce
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.description import Array, PyTree, Real
from hhtjax.jaxpr.listing import Scalar
from hhtjax.primitives.consistent import held

if TYPE_CHECKING:
    from jax.extend.core import JaxprEqn

# ----------------------------------------------------------------------------
# Small arrays taken to pieces: NumPy arrays of objects, which are scalars, traced or known.
#
# One kind of known zero is more than a number: a structural one, of a unit vector, or of a tangent that cannot be
# another. Its products are structural zeros too, and sums do without it.


LARGEST = 64  # numbers in an array that is taken to pieces; larger ones stay whole


class _Zero64(np.float64):
    """A structural zero."""


class _Zero32(np.float32):
    """The same in single precision."""


ZEROS: dict[Any, Any] = {np.dtype(np.float64): _Zero64(0), np.dtype(np.float32): _Zero32(0)}


def is_small(aval) -> bool:
    """Whether arrays like this are taken to pieces; empty ones, which hold nothing to move, are not."""
    return 0 < math.prod(aval.shape) <= LARGEST and not jnp.issubdtype(aval.dtype, jax.dtypes.extended)


def is_in_pieces(value: np.ndarray) -> bool:
    """Or whole."""
    return isinstance(value, np.ndarray) and value.dtype == object


def is_known(x: Real):
    """Whether an element is a number, and no tracer."""
    return isinstance(x, np.generic)


def is_structural(x: Real) -> bool:
    """Whether an element is a structural zero."""
    return isinstance(x, (_Zero64, _Zero32))


def unmarked(x: Real) -> Real:
    """The same element, without the mark of a structural zero."""
    return x.dtype.type(x) if is_structural(x) else x


def arranged(elements, shape: tuple):
    """The pieces of an array of this shape."""
    found = np.empty(len(elements), object)
    for i, x in enumerate(elements):  # one by one: NumPy would ask a tracer for its array
        found[i] = x
    return found.reshape(shape)


def pieces(x: Real):
    """A small array taken to pieces; a large one as it is."""
    if isinstance(x, (np.ndarray, np.generic, int, float, complex)):
        x = np.asarray(x)
    if not is_small(x):
        return x
    return arranged([x[i] if x.shape else x[()] for i in np.ndindex(*x.shape)], x.shape)


def whole(value: Real, aval):
    """The array of a value."""
    if not is_in_pieces(value):
        return value
    elements = [as_scalar(x, aval.dtype) for x in value.flat]
    return jnp.stack(elements).reshape(aval.shape) if aval.shape else elements[0]


def as_scalar(x: Array, dtype: np.dtype) -> Array:
    """An element as an array without axes."""
    return jnp.asarray(unmarked(x), dtype)


def each(f: Callable, value: np.ndarray) -> np.ndarray:
    """f of every element."""
    return arranged([f(x) for x in value.flat], value.shape) if is_in_pieces(value) else f(value)


# ----------------------------------------------------------------------------
# Two kinds of scalars that are not known yet: JAX traces what is done with the one, and a list records the other.


LAX = {
    **{"add": lax.add, "mul": lax.mul, "max": lax.max, "min": lax.min, "neg": lax.neg},
    **{"and": lax.bitwise_and, "or": lax.bitwise_or},
}


def compute(name: str, *x: Array) -> Array:
    """One operation on scalars of one type, which are to be recorded, or traced, or known."""
    recorder = recorder_of(x)
    return LAX[name](*x) if recorder is None else recorder.record(name, x[0].dtype, *x)


def recorder_of(x: tuple):
    """The recorder of these scalars; None if they are JAX arrays, or known numbers."""
    return next((y.recorder for y in x if isinstance(y, Scalar)), None)


# ----------------------------------------------------------------------------
# Which parameters of an operation the rules of this folder understand: with any other, it runs on whole arrays.
#
# So a parameter, or a value of one, that a later JAX brings makes programs slower, and never wrong.


ELEMENTWISE = {
    *("abs", "acos", "acosh", "add", "add_any", "and", "asin", "asinh", "atan", "atan2", "atanh", "cbrt", "ceil"),
    *("bitcast_convert_type", "clamp", "convert_element_type", "copy", "cos", "cosh", "div", "eq", "erf", "exp"),
    *("exp2", "expm1", "floor", "ge", "gt", "integer_pow", "is_finite", "le", "log", "log1p", "logistic", "lt", "max"),
    *("min", "mul", "ne", "neg", "nextafter", "not", "or", "pow", "rem", "round", "rsqrt", "select_n", "sign"),
    *("sin", "sinh", "sqrt", "square", "stop_gradient", "sub", "tan", "tanh", "xor"),
}


def _any(value: PyTree) -> bool:
    return True


def _none(value) -> bool:
    return value is None


def _own(sharding) -> bool:
    """None, or what shard_map says of arrays that each device has to itself."""
    return sharding is None or (
        getattr(getattr(sharding, "mesh", None), "are_all_axes_manual", False) and not any(sharding.spec)
    )


def _empty(value: PyTree) -> bool:
    return not value


def _unspecified(values: tuple) -> bool:
    return all(type(x).__name__ == "UnspecifiedValue" for x in values)


def _no_layout(values: tuple) -> bool:
    return all(x is None for x in values)


def _usual_precision(value) -> bool:
    """What the CPU computes in any case: full precision."""
    values = value if isinstance(value, tuple) else (value,)
    return all(x is None or isinstance(x, lax.Precision) for x in values)


def _mode(value) -> bool:
    modes = lax.GatherScatterMode
    return value in (modes.CLIP, modes.FILL_OR_DROP, modes.PROMISE_IN_BOUNDS)


def replaces(jaxpr) -> bool:
    """Whether an update of a scatter takes the place of what was there; others compute with both."""
    if jaxpr is None:
        return True
    jaxpr = getattr(jaxpr, "jaxpr", jaxpr)
    return not jaxpr.eqns and list(jaxpr.outvars) == [jaxpr.invars[1]]


def _of_any(*names: str):
    return dict.fromkeys(names, _any)


_GATHERED = {**_of_any("dimension_numbers", "unique_indices", "indices_are_sorted"), "mode": _mode}
_SUM = {"axes": _any, "out_sharding": _none}
UNDERSTOOD = {
    **{name: {"accuracy": _none} for name in ELEMENTWISE},
    "bitcast_convert_type": _of_any("new_dtype"),
    "convert_element_type": {**_of_any("new_dtype", "weak_type"), "sharding": _none},
    "integer_pow": _of_any("y"),
    "mul": {"out_dtype": _none},
    "round": _of_any("rounding_method"),
    "broadcast_in_dim": {**_of_any("shape", "broadcast_dimensions"), "sharding": _own},
    "concatenate": _of_any("dimension"),
    "dot_general": {
        **{"dimension_numbers": _any, "precision": _usual_precision, "preferred_element_type": _any},
        "out_sharding": _none,
    },
    "dynamic_slice": _of_any("slice_sizes"),
    "dynamic_update_slice": {},
    "gather": {**_GATHERED, **_of_any("slice_sizes", "fill_value")},
    "iota": {**_of_any("dtype", "shape", "dimension"), "sharding": _own},
    "pad": _of_any("padding_config"),
    **{f"reduce_{kind}": _SUM for kind in ("sum", "prod", "max", "min", "and", "or")},
    "reshape": {**_of_any("new_sizes", "dimensions"), "sharding": _none},
    "rev": _of_any("dimensions"),
    "scatter": {**_GATHERED, "update_jaxpr": replaces, "update_consts": _empty},
    "slice": _of_any("start_indices", "limit_indices", "strides"),
    "split": _of_any("sizes", "axis"),
    "squeeze": _of_any("dimensions"),
    "stack": _of_any("axis"),
    "transpose": _of_any("permutation"),
    "unstack": _of_any("axis"),
    "cond": _of_any("branches"),
    "while": _of_any("cond_nconsts", "cond_jaxpr", "body_nconsts", "body_jaxpr"),
    "custom_linear_solve": _of_any("const_lengths", "jaxprs"),
    "custom_jvp_call": {**_of_any("call_jaxpr", "jvp_jaxpr_fun", "num_consts"), "symbolic_zeros": _empty},
    "jit": {
        **_of_any("jaxpr", "name", "donated_invars", "keep_unused", "inline"),
        **dict.fromkeys(("in_shardings", "out_shardings"), _unspecified),
        **dict.fromkeys(("in_layouts", "out_layouts"), _no_layout),
        **{"ctx_mesh": lambda mesh: mesh.empty, "compiler_options_kvs": _empty},
    },
    "hhtjax_in_turn": _of_any("closed", "at_once", "number"),
    "hhtjax_held": {},
    "hhtjax_structural": {},
    "hhtjax_family": _of_any("n", "family", "jaxpr"),
    "hhtjax_bilinear": _of_any("product", "jaxpr"),
    "hhtjax_map": _of_any("map", "jaxpr"),
    "hhtjax_largest_in_batch": _of_any("kept"),
}


def is_understood(eqn: JaxprEqn) -> bool:
    """Whether all parameters of an operation are known, with values for which its rules were written."""
    known = UNDERSTOOD.get(eqn.primitive.name)
    return known is not None and all(name in known and known[name](x) for name, x in eqn.params.items())


# ----------------------------------------------------------------------------

# Rules: (operation, values) -> the values of the results, or None for whole arrays.


def _elementwise(eqn, *values):
    out = eqn.outvars[0].aval
    columns = [np.broadcast_to(x, out.shape).flat for x in values]
    return [arranged([_scalar(eqn, out.dtype, *x) for x in zip(*columns, strict=True)], out.shape)]


def _scalar(eqn: JaxprEqn, dtype: np.dtype, *x: Real):
    """One operation on scalars, or what is known without it."""
    name = eqn.primitive.name
    found = _without(name, dtype, *x)
    if found is None and (recorder := recorder_of(x)) is not None:
        return recorder.record(name, dtype, *x, **{key: eqn.params[key] for key in RECORDED if key in eqn.params})
    if found is None:
        with eqn.ctx.manager:
            found = eqn.primitive.bind(*map(unmarked, x), **eqn.params)
    return found


def _without(name: str, dtype: np.dtype, *x: Real):
    """What is known of the result of an operation, or None."""
    found = SHORT[name](dtype, *x) if name in SHORT else None
    if found is None and name in NUMPY and all(map(is_known, x)):
        found = NUMPY[name](dtype, *x)
    return found


def _is(x: Real, number: float) -> Real:
    """Whether an element is this number, the sign of a zero included; integers have no such sign."""
    if isinstance(x, np.floating):
        return x == number and np.signbit(x) == np.signbit(number)
    return isinstance(x, np.integer) and x == number


def _product(dtype: np.dtype, x: Real, y: Array):
    if is_structural(x) or is_structural(y):
        return ZEROS[dtype]
    return y if _is(x, 1) else x if _is(y, 1) else None


def _sum(dtype: np.dtype, x: Real, y: Real):
    if is_structural(x) or is_structural(y):
        return y if is_structural(x) else x
    return y if _is(x, -0.0) else x if _is(y, -0.0) else None


def _difference(dtype: np.dtype, x: Real, y: Real):
    if is_structural(y) or _is(y, 0.0):
        return x
    return compute("neg", y) if _is(x, -0.0) and not is_known(y) else None


def _quotient(dtype: np.dtype, x: Real, y: Real):
    return ZEROS[dtype] if is_structural(x) else x if _is(y, 1) else None


def _negative(dtype: np.dtype, x: Real):
    return x if is_structural(x) else None


def _converted(dtype: np.dtype, x: Real):
    return ZEROS.get(dtype) if is_structural(x) else None


def _selected(dtype: np.dtype, which: Real, *cases: Real):
    if not is_known(which) or not 0 <= int(which) < len(cases):
        return None
    return cases[int(which)]


def _exactly(f: Callable):
    """A function of NumPy that gives what XLA does, bit for bit."""
    return lambda dtype, *x: dtype.type(f(*x))


def _converted_number(dtype: np.dtype, x: Real) -> Real:
    """A known number in another type, as XLA does it when a program runs: it saturates, and NaN becomes 0. Where XLA or
    MLIR folds constants it would be a cast of C, which is something else on every machine."""
    if any(jnp.issubdtype(d, jnp.complexfloating) for d in (dtype, x.dtype)):
        return None
    if jnp.issubdtype(dtype, jnp.integer) and jnp.issubdtype(x.dtype, jnp.floating):
        limits = jnp.iinfo(dtype)
        if np.isnan(x):
            return dtype.type(0)
        return dtype.type(limits.min if x <= limits.min else limits.max if x >= limits.max else int(x))
    return x.astype(dtype)


def _integers(f: Callable):
    """A function of integers of any size, and of the limits of their type; of other numbers nothing is known."""

    def rule(dtype: np.dtype, *x: Real):
        if not jnp.issubdtype(dtype, jnp.integer):
            return None
        limits = jnp.iinfo(dtype)
        return np.array(f(limits, *map(int, x)) % 2**limits.bits, np.uint64).astype(dtype)[()]

    return rule


def _divided(limits, x: int, y: int) -> int:
    """Towards zero; -1, in all its bits, where y is 0. Folding by XLA ends the process there."""
    return -1 if y == 0 else (abs(x) // abs(y)) * (1 if (x < 0) == (y < 0) else -1)


def _remainder(limits, x: int, y: int) -> int:
    return x if y == 0 else x - y * _divided(limits, x, y)


def _fold(name: str, dtype: np.dtype, x):
    """x[0] o x[1] o ..., o one of the operations of LAX."""

    def combine(x: Array, y: Array) -> Array:
        found = _without(name, dtype, x, y)
        return compute(name, x, y) if found is None else found

    return reduce(combine, x)


def _reduction(name: str):
    def rule(eqn, x: np.ndarray):
        axes, out = eqn.params["axes"], eqn.outvars[0].aval
        rows = _rows(x, [i for i in range(x.ndim) if i not in axes], axes)
        return [arranged([_fold(name, out.dtype, row) for row in rows], out.shape)]

    return rule


def _choice(name: str):
    """The largest or the smallest, with JAX's derivative: equal ones share it, and what is not a number stays so."""

    @jax.custom_jvp
    def chosen(*x: Array):
        return reduce(LAX[name], x)

    @chosen.defjvp
    def _(x, dx):
        x = tuple(map(held, x))
        found = chosen(*x)
        here = [lax.convert_element_type(lax.eq(y, found), found.dtype) for y in x]
        return found, lax.div(reduce(lax.add, map(lax.mul, dx, here)), reduce(lax.add, here))

    fold = _reduction(name)

    def rule(eqn, x: np.ndarray):
        out = eqn.outvars[0].aval
        if not jnp.issubdtype(out.dtype, jnp.floating):
            return fold(eqn, x)
        axes = eqn.params["axes"]
        rows = _rows(x, [i for i in range(x.ndim) if i not in axes], axes)
        return [arranged([row[0] if len(row) == 1 else chosen(*map(unmarked, row)) for row in rows], out.shape)]

    return rule


def _rows(x: np.ndarray, first: list, last) -> np.ndarray:
    """x as a matrix, the axes `first` along its columns, `last` along its rows."""
    lengths = [math.prod(x.shape[i] for i in axes) for axes in (first, last)]
    return x.transpose(*first, *last).reshape(lengths)


def _dot_general(eqn, x: np.ndarray, y: np.ndarray):
    out = eqn.outvars[0].aval
    if any(v.aval.dtype != out.dtype for v in eqn.invars) or out.dtype == bool:
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


def _reshape(eqn, x: np.ndarray):
    order = eqn.params["dimensions"]
    return [(x if order is None else x.transpose(order)).reshape(eqn.outvars[0].aval.shape)]


def _squeeze(eqn, x: np.ndarray):
    return [x.reshape(eqn.outvars[0].aval.shape)]


def _transpose(eqn: JaxprEqn, x: np.ndarray):
    return [x.transpose(eqn.params["permutation"])]


def _broadcast_in_dim(eqn: JaxprEqn, x: np.ndarray):
    shape = [1] * len(eqn.params["shape"])
    for axis, n in zip(eqn.params["broadcast_dimensions"], x.shape, strict=True):
        shape[axis] = n
    return [np.broadcast_to(x.reshape(shape), eqn.params["shape"])]


def _concatenate(eqn: JaxprEqn, *parts: np.ndarray):
    return [np.concatenate(parts, eqn.params["dimension"])]


def _stack(eqn: JaxprEqn, *parts: np.ndarray):
    return [np.stack(parts, eqn.params["axis"])]


def _split(eqn: JaxprEqn, x: np.ndarray):
    return np.split(x, np.cumsum(eqn.params["sizes"])[:-1], eqn.params["axis"])


def _unstack(eqn, x: np.ndarray):
    return [np.take(x, [i], eqn.params["axis"]).reshape(out.aval.shape) for i, out in enumerate(eqn.outvars)]


def _rev(eqn: JaxprEqn, x: np.ndarray):
    return [np.flip(x, eqn.params["dimensions"])]


def _slice(eqn: JaxprEqn, x: np.ndarray):
    start, stop, step = (eqn.params[key] for key in ("start_indices", "limit_indices", "strides"))
    return [x[tuple(map(slice, start, stop, step or [1] * x.ndim))]]


def _iota(eqn):
    out, axis = eqn.outvars[0].aval, eqn.params["dimension"]
    return [pieces(np.indices(out.shape)[axis].astype(out.dtype))]


def _structural(eqn, x: np.ndarray):
    dtype = eqn.outvars[0].aval.dtype
    return [each(lambda x: ZEROS.get(dtype, x) if is_known(x) and x == 0 else x, x)]


def _moved(*moves: int):
    """The rule of an operation that moves elements to known places. It is applied to the numbers of the elements.

    The numbers start at 1; what comes from outside an array is the fill value, 0.
    """

    def rule(eqn, *values: np.ndarray):
        if not all(is_known(x) for i, value in enumerate(values) if i not in moves for x in value.flat):
            return None
        elements = np.concatenate([arranged([_filling(eqn)], (1,)), *(values[i].ravel() for i in moves)])
        counts = np.cumsum([1, *(values[i].size for i in moves)])[:-1]
        numbers = iter(np.split(np.arange(elements.size, dtype=np.int32), counts)[1:])
        arrays = [
            next(numbers).reshape(value.shape) if i in moves else np.asarray(value.tolist(), x.aval.dtype)
            for i, (value, x) in enumerate(zip(values, eqn.invars, strict=True))
        ]
        params = {**eqn.params, "fill_value": 0} if "fill_value" in eqn.params else eqn.params
        with jax.ensure_compile_time_eval():
            taken = np.asarray(eqn.primitive.bind(*arrays, **params))
        return [elements[taken]]

    return rule


def _filling(eqn) -> Real:
    """What a gather puts in the place of elements that are not there."""
    dtype, value = eqn.invars[0].aval.dtype, eqn.params.get("fill_value")
    if value is not None:
        return dtype.type(value)
    if jnp.issubdtype(dtype, jnp.inexact):
        return dtype.type(np.nan)
    if jnp.issubdtype(dtype, jnp.bool_):
        return np.bool_(True)
    limits = jnp.iinfo(dtype)
    return dtype.type(limits.min if jnp.issubdtype(dtype, jnp.signedinteger) else limits.max)


RULES = {
    **dict.fromkeys(ELEMENTWISE, _elementwise),
    "bitcast_convert_type": lambda eqn, x: _elementwise(eqn, x) if eqn.outvars[0].aval.shape == x.shape else None,
    **{"broadcast_in_dim": _broadcast_in_dim, "concatenate": _concatenate, "dot_general": _dot_general, "iota": _iota},
    **{"reshape": _reshape, "squeeze": _squeeze, "rev": _rev, "slice": _slice, "hhtjax_structural": _structural},
    "hhtjax_held": lambda eqn, x: [each(lambda y: y if is_known(y) else held(y), x)],
    **{"split": _split, "stack": _stack, "transpose": _transpose, "unstack": _unstack},
    **{
        "gather": _moved(0),
        "dynamic_slice": _moved(0),
        "dynamic_update_slice": _moved(0, 1),
        "pad": _moved(0, 1),
        "scatter": _moved(0, 2),
    },
    **{f"reduce_{kind}": _reduction(kind) for kind in ("and", "or")},
    **{f"reduce_{kind}": _choice(kind) for kind in ("max", "min")},
    **{"reduce_sum": _reduction("add"), "reduce_prod": _reduction("mul")},
    # a list has no batch
    "hhtjax_largest_in_batch": lambda eqn, x: [x] if recorder_of(x.flat) is not None else _elementwise(eqn, x),
}
# of known numbers; without "max" and "min", which may choose between zeros of different signs
NUMPY = {
    **{"add": _exactly(np.add), "add_any": _exactly(np.add), "sub": _exactly(np.subtract)},
    **{"mul": _exactly(np.multiply), "neg": _exactly(np.negative), "abs": _exactly(np.abs)},
    **{"eq": _exactly(np.equal), "ne": _exactly(np.not_equal), "lt": _exactly(np.less)},
    **{"le": _exactly(np.less_equal), "gt": _exactly(np.greater), "ge": _exactly(np.greater_equal)},
    **{"and": _exactly(np.bitwise_and), "or": _exactly(np.bitwise_or), "copy": _exactly(lambda x: x)},
    **{"div": _integers(_divided), "rem": _integers(_remainder)},
    "convert_element_type": _converted_number,
}
FOLDS = {f"reduce_{kind}": _reduction(kind) for kind in ("max", "min")}  # where no derivative is taken
RECORDED = "y", "rounding_method"  # parameters, all others being shapes and types
SHORT = {
    **{"mul": _product, "add": _sum, "add_any": _sum, "sub": _difference, "div": _quotient, "neg": _negative},
    **{"select_n": _selected, "convert_element_type": _converted},
}
