"""Operations on NumPy arrays: those that move elements of any type, and those on known numbers.

XLA would compile each of them. For most of these small arrays that takes longer than computing them with NumPy.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.description import PyTree
from hhtjax.primitives.interpreter import alone

if TYPE_CHECKING:
    from jax.extend.core import JaxprEqn

LARGEST = 10**7  # elements of a result that XLA is asked for
NOT_ASKED = ("callback", "hhtjax_host", "custom_", "random_", "rng_", "while", "scan")  # in names


def known_results(eqn: JaxprEqn, arrays: list[np.ndarray]) -> list[np.ndarray] | None:
    """The results of an operation on known numbers, or None where they are not worth the work."""
    name = eqn.primitive.name
    outs: list[Any] = [x.aval for x in eqn.outvars]
    rule = MOVES.get(name) or FUNCTIONS.get(name)
    if rule is not None:
        with np.errstate(all="ignore"):
            results = rule(eqn, *arrays)
        if results is not None:
            return [np.asarray(x, y.dtype) for x, y in zip(results, outs, strict=True)]
    if eqn.effects or any(x in name for x in NOT_ASKED) or any(_is_strange(x) for x in outs):
        return None
    with jax.ensure_compile_time_eval():
        return [np.asarray(x) for x in alone(eqn)(*map(jnp.asarray, arrays))]


def _is_strange(aval) -> bool:
    """Whether NumPy cannot hold it, or it is very large."""
    dtype = getattr(aval, "dtype", None)
    return dtype is None or jnp.issubdtype(dtype, jax.dtypes.extended) or aval.size > LARGEST


# ----------------------------------------------------------------------------
# Operations that move elements: (eqn, *arrays of anything) -> list of arrays.


def _out(eqn: JaxprEqn) -> tuple:
    aval: Any = eqn.outvars[0].aval
    return aval.shape


def _reshape(eqn, x: np.ndarray, *sizes: np.ndarray):
    order = eqn.params.get("dimensions") if eqn.primitive.name == "reshape" else None
    return [(x if order is None else np.transpose(x, order)).reshape(_out(eqn))]


def _broadcast_in_dim(eqn, x: np.ndarray, *sizes: np.ndarray):
    shape = [1] * len(_out(eqn))
    for axis, length in zip(eqn.params["broadcast_dimensions"], x.shape, strict=True):
        shape[axis] = length
    return [np.broadcast_to(x.reshape(shape), _out(eqn))]


def _transpose(eqn, x: np.ndarray):
    return [np.transpose(x, eqn.params["permutation"])]


def _rev(eqn, x: np.ndarray):
    return [np.flip(x, eqn.params["dimensions"])]


def _slice(eqn, x: np.ndarray):
    start, stop, step = (eqn.params[name] for name in ("start_indices", "limit_indices", "strides"))
    return [x[tuple(map(slice, start, stop, step or (1,) * len(start)))]]


def _pad(eqn, x: np.ndarray, filling: np.ndarray):
    out = np.full(_out(eqn), filling)
    to, origin = [], []
    for (low, _, between), before, after in zip(eqn.params["padding_config"], x.shape, out.shape, strict=True):
        place = low + np.arange(before) * (between + 1)
        inside = (place >= 0) & (place < after)
        to.append(place[inside])
        origin.append(np.flatnonzero(inside))
    out[np.ix_(*to)] = x[np.ix_(*origin)]
    return [out]


def _concatenate(eqn, *arrays: np.ndarray):
    return [np.concatenate(arrays, eqn.params["dimension"])]


def _stack(eqn, *arrays: np.ndarray):
    return [np.stack(arrays, eqn.params["axis"])]


def _split(eqn, x: np.ndarray):
    return np.split(x, np.cumsum(eqn.params["sizes"])[:-1], eqn.params["axis"])


def _unstack(eqn, x: np.ndarray):
    return list(np.moveaxis(x, eqn.params["axis"], 0))


def _tile(eqn, x: np.ndarray):
    return [np.tile(x, eqn.params["reps"])]


MOVES = {
    **dict.fromkeys(("reshape", "squeeze", "expand_dims"), _reshape),
    "broadcast_in_dim": _broadcast_in_dim,
    "transpose": _transpose,
    "rev": _rev,
    "slice": _slice,
    "pad": _pad,
    "concatenate": _concatenate,
    "stack": _stack,
    "split": _split,
    "unstack": _unstack,
    "tile": _tile,
}


# ----------------------------------------------------------------------------
# Functions of numbers: (eqn, *arrays) -> list of arrays, or None.


def _by(f):
    return lambda eqn, *arrays: [f(*arrays)]


def _iota(eqn, *sizes: np.ndarray):
    shape, axis = eqn.params["shape"], eqn.params["dimension"]
    along = np.arange(shape[axis]).reshape([-1 if i == axis else 1 for i in range(len(shape))])
    return [np.broadcast_to(along, shape)]


def _convert(eqn, x: np.ndarray):
    dtype = eqn.params["new_dtype"]
    return None if jnp.issubdtype(dtype, jax.dtypes.extended) else [x.astype(dtype)]


def _div(eqn, x: np.ndarray, y: np.ndarray):
    return [x / y] if jnp.issubdtype(x.dtype, np.inexact) else None


def _select_n(eqn, which: np.ndarray, *cases: np.ndarray):
    return [np.choose(which.astype(int), cases, mode="clip")] if len(cases) <= 32 else None


def _clamp(eqn, low: np.ndarray, x: np.ndarray, high: np.ndarray):
    return [np.minimum(np.maximum(x, low), high)]


def _integer_pow(eqn, x: np.ndarray):
    y = eqn.params["y"]
    return [x**y] if y >= 0 or jnp.issubdtype(x.dtype, np.inexact) else None


def _same(eqn, *arrays: np.ndarray) -> PyTree:
    return list(arrays)


FUNCTIONS = {
    **{name: _by(getattr(np, name)) for name in ("abs", "cos", "exp", "floor", "ceil", "sin", "sqrt", "sign")},
    **{"add": _by(np.add), "add_any": _by(np.add), "sub": _by(np.subtract), "mul": _by(np.multiply)},
    **{"neg": _by(np.negative), "square": _by(np.square), "div": _div},
    **{"max": _by(np.maximum), "min": _by(np.minimum)},
    **{"lt": _by(np.less), "le": _by(np.less_equal), "gt": _by(np.greater), "ge": _by(np.greater_equal)},
    **{"eq": _by(np.equal), "ne": _by(np.not_equal), "not": _by(np.invert), "and": _by(np.bitwise_and)},
    **{"or": _by(np.bitwise_or), "xor": _by(np.bitwise_xor), "iota": _iota, "convert_element_type": _convert},
    **{"select_n": _select_n, "clamp": _clamp, "integer_pow": _integer_pow},
    **dict.fromkeys(("copy", "copy_p", "stop_gradient", "optimization_barrier"), _same),
}
