"""A traced program, evaluated operation by operation with NumPy: no compilation, and rounding can be disturbed.

What NumPy does otherwise than XLA (integer division, gather, scatter, LAPACK) is left to JAX, which compiles each
operation once. A witness independent of hhtjax: nothing of it is imported here.
"""

import math
from functools import reduce

import jax
import numpy as np
from jax import lax
from jax.extend.core import Literal
from numpy_places import PLACES
from scipy import special


class Numbers:
    """How operations are evaluated.

    noise: a generator by which each result of arithmetic, and each term of a sum, is disturbed by a few roundings.
    """

    def __init__(self, noise=None):
        self.noise = noise

    def __call__(self, closed, *args):
        """Values of the results of a closed jaxpr."""
        jaxpr, consts = closed.jaxpr, closed.consts
        known = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*map(np.asarray, consts), *args], strict=True))

        def read(atom):
            return np.asarray(atom.val, atom.aval.dtype) if isinstance(atom, Literal) else known[atom]

        for eqn in jaxpr.eqns:
            results = self.apply(eqn, [read(x) for x in eqn.invars])
            for variable, y in zip(eqn.outvars, results, strict=True):
                known[variable] = _as(y, variable.aval.dtype)
        return [read(x) for x in jaxpr.outvars]

    def apply(self, eqn, values):
        """The results of one operation."""
        name = eqn.primitive.name
        if name in CALLS:
            return CALLS[name](self, eqn.params, *values)
        inexact = np.issubdtype(eqn.outvars[0].aval.dtype, np.inexact)
        if self.noise is not None and name in SUMS:
            values = [self.disturbed(x) for x in values]
        if name in ARITHMETIC and (inexact or name not in INEXACT):
            results = [ARITHMETIC[name](eqn.params, *values)]
        elif name in MOVES:
            return MOVES[name](eqn, *values)
        elif name in PLACES and eqn.params.get("update_jaxpr") is None:
            results = PLACES[name](eqn, *values) or by_jax(eqn, values)
        elif name == "dot_general" and all(x.dtype == eqn.outvars[0].aval.dtype for x in values):
            results = [_dot_general(eqn, *values)]
        else:
            results = by_jax(eqn, values)
        return [self.disturbed(y) for y in results] if self.noise is not None and name not in QUIET else results

    def disturbed(self, x):
        if not np.issubdtype(x.dtype, np.inexact):
            return x
        return (x * (1 + np.finfo(x.dtype).eps * self.noise.uniform(-2, 2, x.shape))).astype(x.dtype)


def _dot_general(eqn, x, y):
    (over, batch), letters = eqn.params["dimension_numbers"], iter("abcdefghijklmnopqrstuvwxyz")
    names = [[""] * x.ndim, [""] * y.ndim]
    for pairs in (batch, over):
        for i, j in zip(*pairs, strict=True):
            names[0][i] = names[1][j] = next(letters)
    result = [names[0][i] for i in batch[0]]
    for side in names:
        for i, letter in enumerate(side):
            if not letter:
                side[i] = next(letters)
                result.append(side[i])
    every = result + [names[0][i] for i in over[0]]
    aligned = []
    for z, side in zip((x, y), names, strict=True):
        order = sorted(range(z.ndim), key=lambda i: every.index(side[i]))  # noqa: B023
        lengths = [z.shape[side.index(a)] if a in side else 1 for a in every]
        aligned.append(z.transpose(order).reshape(lengths))
    return _sum({"axes": range(len(result), len(every))}, aligned[0] * aligned[1])


def by_jax(eqn, values):
    """One operation, as JAX does it."""
    results = eqn.primitive.bind(*values, **eqn.primitive.get_bind_params(eqn.params))
    return [np.asarray(y) for y in (results if eqn.primitive.multiple_results else [results])]


def _as(y, dtype):
    return y if not isinstance(dtype, np.dtype) else np.asarray(y, dtype)


# Calls of functions.


def _cond(self, params, which, *values):
    return self(params["branches"][int(np.clip(which, 0, len(params["branches"]) - 1))], *values)


def _while(self, params, *values):
    first, second = params["cond_nconsts"], params["cond_nconsts"] + params["body_nconsts"]
    of_cond, of_body, carry = values[:first], values[first:second], list(values[second:])
    for _ in range(1000):
        goes_on = self(params["cond_jaxpr"], *of_cond, *carry)[0]
        if not goes_on.any():
            return carry
        after = self(params["body_jaxpr"], *of_body, *carry)
        if goes_on.ndim:  # a batch of loops
            after = [
                np.where(goes_on.reshape(goes_on.shape + (1,) * (y.ndim - goes_on.ndim)), y, x)
                for x, y in zip(carry, after, strict=True)
            ]
        carry = after
    raise ValueError("a loop without end")


def _scan(self, params, *values):
    first, second = params["num_consts"], params["num_consts"] + params["num_carry"]
    consts, carry, xs = values[:first], list(values[first:second]), values[second:]
    rows = [None] * params["length"]
    for i in reversed(range(params["length"])) if params["reverse"] else range(params["length"]):
        results = self(params["jaxpr"], *consts, *carry, *(x[i] for x in xs))
        carry, rows[i] = results[: second - first], results[second - first :]
    if not rows:
        return [*carry, *(np.zeros(v.shape, v.dtype) for v in params["jaxpr"].out_avals[second - first :])]
    return [*carry, *map(np.stack, zip(*rows, strict=True))]


def _solve(self, params, *values):
    lengths, closed = params["const_lengths"], params["jaxprs"]
    start = lengths.matvec + lengths.vecmat
    b = values[start + lengths.solve + lengths.transpose_solve :]
    return self(closed.solve, *values[start : start + lengths.solve], *b)


def _called(key):
    return lambda self, params, *values: self(_closed(params[key]), *values)


def _closed(jaxpr):
    return jaxpr if hasattr(jaxpr, "consts") else jax.extend.core.ClosedJaxpr(jaxpr, ())


CALLS = {
    **{"cond": _cond, "while": _while, "scan": _scan, "custom_linear_solve": _solve},
    **{"jit": _called("jaxpr"), "closed_call": _called("call_jaxpr"), "checkpoint": _called("jaxpr")},
    **{"custom_jvp_call": _called("call_jaxpr"), "custom_vjp_call": _called("call_jaxpr")},
}


# Arithmetic.


def _select(_, which, *cases):
    shape = cases[0].shape
    return np.choose(np.broadcast_to(which, shape).astype(int), cases) if shape else cases[int(which)]


def _power(params, x):
    """As XLA: by repeated squares."""
    n, result = abs(params["y"]), None
    while n:
        result = (x if result is None else result * x) if n % 2 else result
        x, n = x * x, n // 2
    result = np.ones_like(x) if result is None else result
    return 1 / result if params["y"] < 0 else result


def _away(x):
    """To whole numbers, halves away from zero."""
    down = np.trunc(x)
    return np.where(np.abs(x - down) >= 0.5, down + np.copysign(1, x), down)


def _sum(params, x):
    """From 0, so that a sum of -0 is 0; but one term alone is the sum."""
    axes = tuple(params["axes"])
    if math.prod(x.shape[i] for i in axes) == 1:
        return x.reshape([n for i, n in enumerate(x.shape) if i not in axes])
    return np.add.reduce(x, axes, initial=x.dtype.type(0))


def _larger(x, y):
    """0 is larger than -0."""
    return np.where((x == 0) & (y == 0), x + y, np.maximum(x, y)) if x.dtype.kind == "f" else np.maximum(x, y)


def _smaller(x, y):
    return -_larger(-x, -y) if x.dtype.kind == "f" else np.minimum(x, y)


def _greatest(x, axes):
    largest = np.maximum.reduce(x, axes, initial=_extreme(x.dtype)[0])
    if x.dtype.kind != "f":
        return largest
    is_positive = ((x == 0) & ~np.signbit(x)).any(axes)
    return np.where(largest == 0, np.where(is_positive, 0.0, -0.0), largest)


def _extreme(dtype):
    if np.issubdtype(dtype, np.floating):
        return -np.inf, np.inf
    return (False, True) if dtype == bool else (np.iinfo(dtype).min, np.iinfo(dtype).max)


def _plain(f):
    return lambda params, *values: f(*values)


def _over_axes(f):
    return lambda params, x: f(x, axis=tuple(params["axes"]))


ARITHMETIC = {
    **{"add": _plain(np.add), "add_any": _plain(np.add), "sub": _plain(np.subtract), "mul": _plain(np.multiply)},
    **{"div": _plain(np.divide), "neg": _plain(np.negative), "sin": _plain(np.sin), "cos": _plain(np.cos)},
    **{"tan": _plain(np.tan), "tanh": _plain(np.tanh), "exp": _plain(np.exp), "log": _plain(np.log)},
    **{"sqrt": _plain(np.sqrt), "abs": _plain(np.abs), "floor": _plain(np.floor), "ceil": _plain(np.ceil)},
    **{"sinh": _plain(np.sinh), "cosh": _plain(np.cosh), "asin": _plain(np.arcsin), "acos": _plain(np.arccos)},
    **{"atan": _plain(np.arctan), "asinh": _plain(np.arcsinh), "acosh": _plain(np.arccosh)},
    **{"atanh": _plain(np.arctanh), "exp2": _plain(np.exp2), "expm1": _plain(np.expm1), "log1p": _plain(np.log1p)},
    **{"cbrt": _plain(np.cbrt), "erf": _plain(special.erf), "rsqrt": _plain(lambda x: 1 / np.sqrt(x))},
    **{"square": _plain(np.square), "logistic": _plain(lambda x: 1 / (1 + np.exp(-x))), "integer_pow": _power},
    **{"atan2": _plain(np.arctan2), "nextafter": _plain(np.nextafter), "sign": _plain(lambda x: np.where(x == 0, x, np.sign(x)))},
    **{"select_n": _select, "eq": _plain(np.equal), "ne": _plain(np.not_equal), "lt": _plain(np.less)},
    **{"le": _plain(np.less_equal), "gt": _plain(np.greater), "ge": _plain(np.greater_equal)},
    **{"is_finite": _plain(np.isfinite), "and": _plain(np.bitwise_and), "or": _plain(np.bitwise_or)},
    **{"xor": _plain(np.bitwise_xor), "max": _plain(_larger), "min": _plain(_smaller)},
    **{"pow": _plain(np.power), "rem": _plain(np.fmod), "clamp": _plain(lambda a, x, b: _smaller(_larger(x, a), b))},
    "round": lambda params, x: np.rint(x) if params["rounding_method"] == lax.RoundingMethod.TO_NEAREST_EVEN else _away(x),
    "reduce_sum": lambda params, x: _sum(params, x),
    **{"copy": _plain(np.copy), "stop_gradient": _plain(np.copy)},
    "reduce_prod": lambda params, x: np.multiply.reduce(x, tuple(params["axes"]), initial=x.dtype.type(1)),
    "reduce_max": lambda params, x: _greatest(x, tuple(params["axes"])),
    "reduce_min": lambda params, x: -_greatest(-x, tuple(params["axes"])) if x.dtype.kind == "f" else np.minimum.reduce(
        x, tuple(params["axes"]), initial=_extreme(x.dtype)[1]
    ),
    **{"reduce_or": _over_axes(np.bitwise_or.reduce), "reduce_and": _over_axes(np.bitwise_and.reduce)},
}
SUMS = ("reduce_sum", "dot_general", "cumsum", "reduce_prod", "cumprod", "cumlogsumexp", "reduce_window_sum")
INEXACT = ("div", "rem", "pow", "integer_pow", "round")  # NumPy does otherwise with integers
QUIET = {
    *("select_n", "copy", "stop_gradient", "neg", "abs", "sign", "floor", "ceil", "gather", "dynamic_slice", "round"),
    *("dynamic_update_slice", "max", "min", "clamp", "sort", "reduce_max", "reduce_min", "cummax", "cummin", "rem"),
    *("scatter", "nextafter", "scatter-max", "scatter-min", "pad", "optimization_barrier"),
}


# What moves numbers.


def _broadcast(eqn, x):
    shape, to = eqn.params["shape"], eqn.params["broadcast_dimensions"]
    lengths = [1] * len(shape)
    for i, n in zip(to, x.shape, strict=True):
        lengths[i] = n
    return [np.broadcast_to(x.reshape(lengths), shape)]


def _reshape(eqn, x):
    order = eqn.params.get("dimensions")
    return [(x if order is None else x.transpose(order)).reshape(eqn.outvars[0].aval.shape)]


def _slice(eqn, x):
    start, stop, steps = (eqn.params[key] for key in ("start_indices", "limit_indices", "strides"))
    return [x[tuple(slice(a, b, s) for a, b, s in zip(start, stop, steps or [1] * x.ndim, strict=True))]]


def _iota(eqn):
    out, axis = eqn.outvars[0].aval, eqn.params["dimension"]
    return [np.indices(out.shape, dtype=out.dtype)[axis]]


def _convert(eqn, x):
    to = eqn.outvars[0].aval.dtype
    if np.issubdtype(to, np.integer) and np.issubdtype(x.dtype, np.floating):  # NaN, and numbers too large
        low, high = np.iinfo(to).min, np.iinfo(to).max
        inside = (x > low) & (x < high)
        found = np.where(inside, x, 0).astype(to)
        return [np.where(inside | np.isnan(x), found, np.where(x > 0, to.type(high), to.type(low)))]
    return [x != 0 if to == bool else x.astype(to)]


def _split(eqn, x):
    return np.split(x, np.cumsum(eqn.params["sizes"])[:-1], eqn.params["axis"])


MOVES = {
    **{"broadcast_in_dim": _broadcast, "reshape": _reshape, "slice": _slice, "convert_element_type": _convert},
    **{"iota": _iota, "split": _split, "squeeze": lambda eqn, x: [x.reshape(eqn.outvars[0].aval.shape)]},
    "transpose": lambda eqn, x: [x.transpose(eqn.params["permutation"])],
    "concatenate": lambda eqn, *x: [np.concatenate(x, eqn.params["dimension"])],
    "stack": lambda eqn, *x: [np.stack(x, eqn.params["axis"])],
    "rev": lambda eqn, x: [np.flip(x, eqn.params["dimensions"])],
    "hhtjax_watch": lambda eqn, x: [x],
}


def size_of(closed):
    """Number of operations, those of functions within it included."""
    inner = [x for eqn in closed.eqns for x in jax.tree.leaves(list(eqn.params.values())) if hasattr(x, "eqns")]
    return reduce(lambda n, x: n + size_of(x), inner, len(closed.eqns))


def is_close(found, expected, rtol):
    """Of arrays of one shape and dtype: NaN in the same places, the same infinities, and the rest to rtol of the
    largest; whole numbers and truths exactly."""
    if found.shape != expected.shape or found.dtype != expected.dtype:
        return False
    if not np.issubdtype(expected.dtype, np.inexact):
        return bool((found == expected).all())
    finite = np.isfinite(expected)
    if not np.array_equal(found[~finite], expected[~finite], equal_nan=True) or not np.isfinite(found[finite]).all():
        return False
    rest, difference = expected[finite], found[finite] - expected[finite]
    return rest.size == 0 or bool((np.abs(difference) <= rtol * np.abs(rest).max()).all())


def signs(x):
    """Of zeros, -1 and 1; 0 elsewhere."""
    if not np.issubdtype(x.dtype, np.floating):
        return np.zeros(x.shape)
    return np.where(x == 0, np.copysign(1.0, x), 0.0)


