"""Arithmetic of JAX's operations with NumPy, signs of zeros, NaN and infinities as XLA has them."""

import math

import numpy as np
from jax import lax
from scipy import special


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


def sum_over(params, x):
    """From 0, so that a sum of -0 is 0; but one term alone is the sum."""
    axes = tuple(params["axes"])
    if math.prod(x.shape[i] for i in axes) == 1:
        return x.reshape([n for i, n in enumerate(x.shape) if i not in axes])
    return np.add.reduce(x, axes, initial=x.dtype.type(0))


def _raised(x, y):
    """NumPy takes a root for the power 0.5, of -0 and -infinity too."""
    return np.where((y == 0.5) & ((x == 0) | np.isinf(x)), np.abs(x), np.power(x, y))


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
    return (False, True) if dtype.kind == "b" else (np.iinfo(dtype).min, np.iinfo(dtype).max)


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
    **{
        "atan2": _plain(np.arctan2),
        "nextafter": _plain(np.nextafter),
        "sign": _plain(lambda x: np.where(x == 0, x, np.sign(x))),
    },
    **{"select_n": _select, "eq": _plain(np.equal), "ne": _plain(np.not_equal), "lt": _plain(np.less)},
    **{"le": _plain(np.less_equal), "gt": _plain(np.greater), "ge": _plain(np.greater_equal)},
    **{"is_finite": _plain(np.isfinite), "and": _plain(np.bitwise_and), "or": _plain(np.bitwise_or)},
    **{"xor": _plain(np.bitwise_xor), "max": _plain(_larger), "min": _plain(_smaller)},
    **{"pow": _plain(_raised), "rem": _plain(np.fmod), "clamp": _plain(lambda a, x, b: _smaller(_larger(x, a), b))},
    "round": lambda params, x: (
        np.rint(x) if params["rounding_method"] == lax.RoundingMethod.TO_NEAREST_EVEN else _away(x)
    ),
    "reduce_sum": lambda params, x: sum_over(params, x),
    **{"copy": _plain(np.copy), "stop_gradient": _plain(np.copy)},
    "reduce_prod": lambda params, x: np.multiply.reduce(x, tuple(params["axes"]), initial=x.dtype.type(1)),
    "reduce_max": lambda params, x: _greatest(x, tuple(params["axes"])),
    "reduce_min": lambda params, x: (
        -_greatest(-x, tuple(params["axes"]))
        if x.dtype.kind == "f"
        else np.minimum.reduce(x, tuple(params["axes"]), initial=_extreme(x.dtype)[1])
    ),
    **{"reduce_or": _over_axes(np.bitwise_or.reduce), "reduce_and": _over_axes(np.bitwise_and.reduce)},
}
SUMS = ("reduce_sum", "dot_general", "cumsum", "reduce_prod", "cumprod", "cumlogsumexp", "reduce_window_sum")
# where they give zero, its sign is rounding: compiled, what is known to be zero is not added
SIGNLESS = ("add", "add_any", "sub", "scatter-add", "reduce_sum", "dot_general", "cumsum", "reduce_window_sum")
INEXACT = ("div", "rem", "pow", "integer_pow", "round")  # NumPy does otherwise with integers
QUIET = {
    *("select_n", "copy", "stop_gradient", "neg", "abs", "sign", "floor", "ceil", "gather", "dynamic_slice", "round"),
    *("dynamic_update_slice", "max", "min", "clamp", "sort", "reduce_max", "reduce_min", "cummax", "cummin", "rem"),
    *("scatter", "nextafter", "scatter-max", "scatter-min", "pad", "optimization_barrier"),
}
