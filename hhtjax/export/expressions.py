"""Operations on scalars as expressions of C99, with what XLA computes for NaN, zeros of both signs, and integers."""

import math

import numpy as np

TYPES = {
    **{np.dtype(f"{sign}int{bits}"): f"{sign}int{bits}_t" for sign in ("", "u") for bits in (8, 16, 32, 64)},
    **{np.dtype(np.float64): "double", np.dtype(np.float32): "float", np.dtype(bool): "int"},
}
INFIX = {
    **{"add": "+", "sub": "-", "mul": "*", "and": "&", "or": "|", "xor": "^"},
    **{"eq": "==", "ne": "!=", "lt": "<", "le": "<=", "gt": ">", "ge": ">="},
}
CALLS = {  # functions of <math.h>
    **{name: name for name in ("acos", "acosh", "asin", "asinh", "atan", "atan2", "atanh", "cbrt", "ceil", "cos")},
    **{name: name for name in ("cosh", "erf", "exp", "exp2", "expm1", "floor", "log", "log1p", "nextafter", "pow")},
    **{name: name for name in ("sin", "sinh", "sqrt", "tan", "tanh")},
}


def number(x):
    """A known number."""
    dtype = np.dtype(x.dtype)
    if dtype.kind == "b":
        return "1" if x else "0"
    if dtype.kind in "iu":
        smallest = dtype.kind == "i" and x == np.iinfo(dtype).min  # whose absolute value has no constant
        unsigned, value = dtype.kind == "u", int(x) + int(smallest)
        text = f"{'U' * unsigned}INT64_C({value})" if dtype.itemsize == 8 else f"{value}{'u' * unsigned}"
        return f"({text} - 1)" if smallest else f"({text})" if x < 0 else text
    if not math.isfinite(x):
        return "NAN" if math.isnan(x) else "INFINITY" if x > 0 else "(-INFINITY)"
    text = f"{x!s}{'f' * (dtype.itemsize == 4)}"
    return f"({text})" if text.startswith("-") else text


def expression(operation, x, prefix):
    """One operation. x: its operands as text; prefix: of the names of the helper functions."""
    name, dtype = operation.name, np.dtype(operation.results[0].dtype)
    kind = np.dtype(operation.operands[-1].dtype)
    suffix = "f" if dtype == np.float32 else ""
    if name in INFIX:
        return f"{x[0]} {INFIX[name]} {x[1]}"
    if name in CALLS:
        return f"{CALLS[name]}{suffix}({', '.join(x)})"
    found = (_of_floats if kind.kind == "f" else _of_integers).get(name) or _OF_BOTH.get(name)
    return None if found is None else found(x, kind, dtype, suffix, prefix, operation.params)


def _converted(x, kind, dtype, suffix, prefix, params):
    if dtype.kind == "b":
        return f"{x[0]} != 0"
    if kind.kind == "f" and dtype.kind in "iu":
        return f"({TYPES[dtype]}){prefix}_whole({x[0]}, {_bound(dtype, 'min')}, {_bound(dtype, 'max')})"
    return f"({TYPES[dtype]}){x[0]}"


def _bound(dtype, which):
    """The outermost number of an integer type that a double holds."""
    limit = getattr(np.iinfo(dtype), which)
    return repr(float(limit) if float(limit) <= limit else float(np.nextafter(float(limit), 0)))


def _selected(x, kind, dtype, suffix, prefix, params):
    which, *cases = x
    if len(cases) == 2:
        return f"{which} ? {cases[1]} : {cases[0]}"
    text = cases[-1]
    for i in reversed(range(len(cases) - 1)):
        text = f"{which} == {i} ? {cases[i]} : ({text})"
    return text


_OF_BOTH = {
    "convert_element_type": _converted,
    "select_n": _selected,
    "neg": lambda x, *_: f"-{x[0]}",
}
_of_floats = {
    "abs": lambda x, kind, dtype, f, *_: f"fabs{f}({x[0]})",
    "clamp": lambda x, kind, dtype, f, prefix, _: f"{prefix}_min{f}({prefix}_max{f}({x[1]}, {x[0]}), {x[2]})",
    "div": lambda x, *_: f"{x[0]} / {x[1]}",
    "is_finite": lambda x, *_: f"isfinite({x[0]}) != 0",
    "le_to": lambda x, *_: f"isnan({x[1]}) || {x[0]} <= {x[1]}",
    "logistic": lambda x, kind, dtype, f, *_: f"1 / (1 + exp{f}(-{x[0]}))",
    "lt_to": lambda x, *_: f"isnan({x[1]}) ? !isnan({x[0]}) : {x[0]} < {x[1]}",
    "max": lambda x, kind, dtype, f, prefix, _: f"{prefix}_max{f}({x[0]}, {x[1]})",
    "min": lambda x, kind, dtype, f, prefix, _: f"{prefix}_min{f}({x[0]}, {x[1]})",
    "rem": lambda x, kind, dtype, f, *_: f"fmod{f}({x[0]}, {x[1]})",
    "round": lambda x, kind, dtype, f, p, params: f"{_ROUND[int(params['rounding_method'])]}{f}({x[0]})",
    "rsqrt": lambda x, kind, dtype, f, *_: f"1 / sqrt{f}({x[0]})",
    "sign": lambda x, kind, dtype, f, prefix, _: f"{prefix}_sign{f}({x[0]})",
}
_ROUND = {0: "round", 1: "rint"}  # halves away from zero, or to even
_of_integers = {
    "abs": lambda x, *_: f"{x[0]} < 0 ? -{x[0]} : {x[0]}",
    "clamp": lambda x, *_: f"{x[1]} < {x[0]} ? {x[0]} : {x[1]} > {x[2]} ? {x[2]} : {x[1]}",
    "div": lambda x, kind, dtype, *_: f"{x[1]} == 0 ? ({TYPES[dtype]})-1 : {x[0]} / {x[1]}",
    "max": lambda x, *_: f"{x[0]} > {x[1]} ? {x[0]} : {x[1]}",
    "min": lambda x, *_: f"{x[0]} < {x[1]} ? {x[0]} : {x[1]}",
    "not": lambda x, kind, *_: f"!{x[0]}" if kind.kind == "b" else f"~{x[0]}",
    "rem": lambda x, *_: f"{x[1]} == 0 ? {x[0]} : {x[0]} % {x[1]}",
    "sign": lambda x, *_: f"({x[0]} > 0) - ({x[0]} < 0)",
}
