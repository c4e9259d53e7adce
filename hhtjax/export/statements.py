"""A list of operations as statements of C99: a constant for each result, braces for branches and loops."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from hhtjax.description import PyTree, Real
from hhtjax.jaxpr import Scalar

HELPED = {"max": "max", "min": "min", "clamp": ("max", "min"), "sign": "sign"}


class Statements:
    """Writes operations. names: {scalar: its name}; helpers: (name, dtype) of the helper functions that are called.

    prefix: of their names; real: (dtype, name) of the type of the state.
    """

    def __init__(self, names: dict, prefix: str, real: tuple):
        self.names, self.prefix, self.real = dict(names), prefix, real
        self.helpers, self.lines, self.depth = set(), [], 1

    def write(self, operations: list):
        """Adds all operations to `lines`."""
        for x in operations:
            getattr(self, f"_{x.name}", self._plain)(x)

    def text(self, operand) -> str:
        """The name of a scalar, or a number."""
        return self.names[operand] if isinstance(operand, Scalar) else number(operand)

    def type(self, dtype: np.dtype):
        """The C name of a type."""
        return self.real[1] if dtype == self.real[0] else TYPES[np.dtype(dtype)]

    def line(self, text: str):
        """Adds a line."""
        self.lines.append("    " * self.depth + text)

    def _name(self, scalar) -> str:
        self.names[scalar] = f"{'a' if scalar.size else 'x'}{len(self.names)}"
        return self.names[scalar]

    def _helper(self, name: str, dtype: np.dtype) -> str:
        self.helpers.add((name, np.dtype(dtype)))
        return f"{self.prefix}_{name}{'f' * (np.dtype(dtype) == np.float32)}"

    def _plain(self, x):
        (result,) = x.results
        dtype, kind = np.dtype(result.dtype), np.dtype(x.operands[-1].dtype)
        if dtype not in TYPES or kind not in TYPES:
            raise NotWritten(f"numbers of type {dtype if dtype not in TYPES else kind}")
        if kind.kind == "f":
            for name in np.atleast_1d(HELPED.get(x.name, ())):
                self._helper(str(name), kind)
            if x.name == "convert_element_type" and dtype.kind in "iu":
                self.helpers.add(("whole", np.dtype(np.float64)))
        text = expression(x, [self.text(y) for y in x.operands], self.prefix)
        if text is None:
            raise NotWritten(x.name)
        self.line(f"const {self.type(dtype)} {self._name(result)} = {text};")

    def _array(self, x):
        (result,) = x.results
        known = not any(isinstance(y, Scalar) for y in x.operands)
        values = ", ".join(self.text(y) for y in x.operands)
        kind = f"{'static ' * known}const {self.type(result.dtype)}"
        self.line(f"{kind} {self._name(result)}[{result.size}] = {{{values}}};")

    def _element(self, x):
        array, index = x.operands
        self.line(f"const {self.type(x.results[0].dtype)} {self._name(x.results[0])} = "
                  f"{self.text(array)}[{self.text(index)}];")  # fmt: skip

    def _taken(self, x):
        (result,), source, count = x.results, self.text(x.operands[0]), x.results[0].size
        name = self._name(result)
        self.line(f"static const int32_t {name}_at[{count}] = {{{', '.join(map(str, x.params['at']))}}};")
        self.line(f"{self.type(result.dtype)} {name}[{count}];")
        self.line(f"for (int i = 0; i < {count}; i++) {{")
        self.line(f"    {name}[i] = {source}[{name}_at[i]];")
        self.line("}")

    def _map(self, x):
        (result,) = x.results
        operands = [f"{self.text(y)}{'[i]' * (isinstance(y, Scalar) and y.size > 0)}" for y in x.operands]
        self.line(f"{self.type(result.dtype)} {self._name(result)}[{result.size}];")
        self.line(f"for (int i = 0; i < {result.size}; i++) {{")
        self.line(f"    {self.text(result)}[i] = {expression(replace(x, name=x.params['of']), operands, self.prefix)};")
        self.line("}")

    def _product(self, x):
        """Column by column for a vector, so that sums of all rows go on side by side."""
        (a, b), (result,), params = map(self.text, x.operands), x.results, x.params
        (row, along), (down, column) = params["strides"]
        count, rows, columns = (params[name] for name in ("count", "rows", "columns"))
        loops = [("i", rows), ("l", count), ("j", columns)] if columns > 1 else [("l", count), ("i", rows)]
        places = [f"i * {columns}", f"i * {row} + l * {along}", f"l * {down}"]
        places = [f"{places[0]} + j", places[1], f"{places[2]} + j * {column}"] if columns > 1 else ["i", *places[1:]]
        name = self._name(result)
        self.line(f"{self.type(result.dtype)} {name}[{result.size}];")
        self.line(f"memset({name}, 0, sizeof {name});")
        for depth, (index, end) in enumerate(loops):
            self.line(f"{'    ' * depth}for (int {index} = 0; {index} < {end}; {index}++) {{")
        y, a, b = (f"{array}[{place}]" for array, place in zip((name, a, b), places, strict=True))
        self.line(f"{'    ' * len(loops)}{y} += {a} * {b};")
        for depth in reversed(range(len(loops))):
            self.line(f"{'    ' * depth}}}")

    def _lu(self, x):
        (A,), (LU, pivots, order), n = x.operands, x.results, x.params["n"]
        dtype = self.type(LU.dtype)
        self._copy(A, LU)
        self.line(f"int32_t {self._name(pivots)}[{n}], {self._name(order)}[{n}];")
        names = ", ".join(self.text(y) for y in x.results)
        self.line(f"{self._helper('lu', LU.dtype)}({n}, {names});")
        assert dtype

    def _svd(self, x):
        (A,), dtype = x.operands, x.results[0].dtype
        names = [self._name(y) for y in x.results]
        self.line(f"{self.type(dtype)} {', '.join(f'{n}[{y.size}]' for n, y in zip(names, x.results, strict=True))};")
        self.line(f"{self._helper('svd', dtype)}({x.params['n']}, {self.text(A)}, {', '.join(names)});")

    def _triangular_solve(self, x):
        (A, b), (found,), params = x.operands, x.results, x.params
        self._copy(b, found)
        flags = ", ".join(str(int(params[name])) for name in ("lower", "transpose", "unit_diagonal"))
        function = self._helper("triangular", found.dtype)
        self.line(f"{function}({params['n']}, {self.text(A)}, {self.text(found)}, {flags});")

    def _copy(self, source, target):
        """Declares an array as a copy of `source`, to be overwritten."""
        name = self._name(target)
        self.line(f"{self.type(target.dtype)} {name}[{target.size}];")
        self.line(f"memcpy({name}, {self.text(source)}, sizeof {name});")

    def _cond(self, x):
        for result in x.results:
            self.line(f"{self.type(result.dtype)} {self._name(result)};")
        (which,) = x.operands
        is_choice = np.dtype(which.dtype) == bool
        for i, block in enumerate(x.blocks):
            at = f"{self.text(which)} {'<=' if i == 0 else '=='} {i}" if not is_choice else f"!{self.text(which)}"
            last = i == len(x.blocks) - 1
            opening = "{" if last and len(x.blocks) == 1 else "else {" if last else f"if ({at}) {{"
            self.line(opening if i == 0 else f"}} {'' if last else 'else '}{opening}")
            self._inside(block, x.results)
        self.line("}")

    def _while(self, x):
        unfinished, body = x.blocks
        for result, start in zip(x.results, x.operands, strict=True):
            self.line(f"{self.type(result.dtype)} {self._name(result)} = {self.text(start)};")
        self.line("for (;;) {")
        self.depth += 1
        self.write(unfinished.operations)
        self.line(f"if (!({self.text(unfinished.results[0])})) {{")
        self.line("    break;")
        self.line("}")
        self.depth -= 1
        self._inside(body, x.results)
        self.line("}")

    def _inside(self, block, targets: list):
        """A block and the assignment of its results to variables. Results that are such variables are copied first."""
        self.depth += 1
        self.write(block.operations)
        pairs = [(target, y) for target, y in zip(targets, block.results, strict=True) if target is not y]
        values = []
        for _, y in pairs:
            text = self.text(y)
            if y in targets:
                text = f"n{len(self.names)}_{len(values)}"
                self.line(f"const {self.type(y.dtype)} {text} = {self.text(y)};")
            values.append(text)
        for (target, _), text in zip(pairs, values, strict=True):
            self.line(f"{self.text(target)} = {text};")
        self.depth -= 1


class NotWritten(Exception):
    """An operation, or a type, that cannot be written in C."""


# ----------------------------------------------------------------------------
# Operations on scalars as expressions of C99, with what XLA computes for NaN, zeros of both signs, and integers.


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


def number(x: Real) -> str:
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


def expression(operation, x: list, prefix: str):
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


def _converted(x: list, kind: np.dtype, dtype: np.dtype, suffix: str, prefix: str, params: PyTree) -> str:
    if dtype.kind == "b":
        return f"{x[0]} != 0"
    if kind.kind == "f" and dtype.kind in "iu":
        return f"({TYPES[dtype]}){prefix}_whole({x[0]}, {_bound(dtype, 'min')}, {_bound(dtype, 'max')})"
    return f"({TYPES[dtype]}){x[0]}"


def _bound(dtype: np.dtype, which: str) -> str:
    """The outermost number of an integer type that a double holds."""
    limit = getattr(np.iinfo(dtype), which)
    return repr(float(limit) if float(limit) <= limit else float(np.nextafter(float(limit), 0)))


def _selected(x: list, kind: np.dtype, dtype: np.dtype, suffix: str, prefix: str, params: PyTree) -> str:
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


# ----------------------------------------------------------------------------
# Functions of C99 that exported models call: elimination, singular values, and what C has not as XLA does it.


HELPERS = {
    "max": "static @ #_max(const @ a, const @ b) { return (a > b || isnan(a)) ? a : b; }",
    "min": "static @ #_min(const @ a, const @ b) { return (a < b || isnan(a)) ? a : b; }",
    "sign": "static @ #_sign(const @ a) { return a > 0 ? 1 : (a < 0 ? -1 : a); }",
    "whole": """static double #_whole(const double a, const double low, const double high)
{
    return isnan(a) ? 0 : (a < low ? low : (a > high ? high : a));
}""",
    "lu": """/* replaces a by L (below the diagonal) and U: L U is a with its rows in the returned order */
static void #_lu(const int n, @ *const a, int32_t *const pivots, int32_t *const order)
{
    int i, j, k;
    for (i = 0; i < n; i++) {
        order[i] = i;
    }
    for (k = 0; k < n; k++) {
        int pivot = k;
        for (i = k + 1; i < n; i++) {
            if (fabs~(a[i * n + k]) > fabs~(a[pivot * n + k])) {
                pivot = i;
            }
        }
        pivots[k] = pivot;
        if (pivot != k) {
            const int32_t row = order[k];
            order[k] = order[pivot];
            order[pivot] = row;
            for (j = 0; j < n; j++) {
                const @ x = a[k * n + j];
                a[k * n + j] = a[pivot * n + j];
                a[pivot * n + j] = x;
            }
        }
        for (i = k + 1; i < n; i++) {
            const @ factor = a[i * n + k] / a[k * n + k];
            a[i * n + k] = factor;
            for (j = k + 1; j < n; j++) {
                a[i * n + j] -= factor * a[k * n + j];
            }
        }
    }
}""",
    "triangular": """/* solves with a triangle of a, or with its transpose; x: the right-hand side, then the result */
static void #_triangular(const int n, const @ *const a, @ *const x, const int lower, const int transpose,
                         const int unit)
{
    int i, j;
    for (i = 0; i < n; i++) {
        const int forward = (lower != transpose);
        const int k = forward ? i : n - 1 - i;
        if (!unit) {
            x[k] /= a[k * n + k];
        }
        for (j = forward ? k + 1 : 0; j < (forward ? n : k); j++) {
            x[j] -= (transpose ? a[k * n + j] : a[j * n + k]) * x[k];
        }
    }
}""",
    "svd": """/* s, u and the transpose of v with a = u diag(s) v^T and decreasing s: rotates columns in pairs until
   they are orthogonal, or only rounding (Hestenes 1958); NaN if this takes too many sweeps */
static void #_svd(const int n, const @ *const a, @ *const s, @ *const u, @ *const vt)
{
    int i, j, k, sweep, turned = 1;
    @ rounding = 0;
    for (i = 0; i < n * n; i++) {
        rounding += a[i] * a[i];
        u[i] = a[i];
        vt[i] = (i % (n + 1) == 0) ? 1 : 0;
    }
    rounding = n * $ * sqrt~(rounding);
    for (sweep = 0; sweep < 40 && turned; sweep++) {
        turned = 0;
        for (i = 0; i < n; i++) {
            for (j = i + 1; j < n; j++) {
                @ p = 0, q = 0, r = 0;
                for (k = 0; k < n; k++) {
                    p += u[k * n + i] * u[k * n + i];
                    q += u[k * n + j] * u[k * n + j];
                    r += u[k * n + i] * u[k * n + j];
                }
                p = sqrt~(p);
                q = sqrt~(q);
                if (p > rounding && q > rounding && fabs~(r) > n * $ * p * q) {
                    const @ z = (q - p) * (q + p) / (2 * r);
                    const @ t = (z < 0 ? -1 : 1) / (fabs~(z) + sqrt~(1 + z * z));
                    const @ cosine = 1 / sqrt~(1 + t * t), sine = t * cosine;
                    turned = 1;
                    for (k = 0; k < n; k++) {
                        const @ x = u[k * n + i], y = vt[i * n + k];
                        u[k * n + i] = cosine * x - sine * u[k * n + j];
                        u[k * n + j] = sine * x + cosine * u[k * n + j];
                        vt[i * n + k] = cosine * y - sine * vt[j * n + k];
                        vt[j * n + k] = sine * y + cosine * vt[j * n + k];
                    }
                }
            }
        }
    }
    for (i = 0; i < n; i++) {
        @ p = 0;
        for (k = 0; k < n; k++) {
            p += u[k * n + i] * u[k * n + i];
        }
        s[i] = turned ? (@)NAN : sqrt~(p);
    }
    for (i = 0; i < n; i++) {
        int largest = i;
        for (j = i + 1; j < n; j++) {
            if (s[j] > s[largest]) {
                largest = j;
            }
        }
        const @ size = s[largest];
        s[largest] = s[i];
        s[i] = size;
        for (k = 0; k < n; k++) {
            const @ x = u[k * n + i], y = vt[i * n + k];
            u[k * n + i] = (size <= rounding) ? 0 : u[k * n + largest] / size;
            vt[i * n + k] = vt[largest * n + k];
            if (largest != i) {
                u[k * n + largest] = x;
                vt[largest * n + k] = y;
            }
        }
    }
    for (i = 0; i < n; i++) { /* of rounding: the unit vector of which most is left beside the other columns */
        int at, again;
        for (at = 0; s[i] <= rounding && at < n; at++) {
            @ left = 1;
            for (j = 0; j < i; j++) {
                left -= u[at * n + j] * u[at * n + j];
            }
            if (2 * n * left >= 1) {
                break;
            }
        }
        for (k = 0; s[i] <= rounding && k < n; k++) {
            u[k * n + i] = (k == at) ? 1 : 0;
        }
        for (again = 0; s[i] <= rounding && again < 2; again++) {
            @ size = 0;
            for (j = 0; j < i; j++) {
                @ r = 0;
                for (k = 0; k < n; k++) {
                    r += u[k * n + j] * u[k * n + i];
                }
                for (k = 0; k < n; k++) {
                    u[k * n + i] -= r * u[k * n + j];
                }
            }
            for (k = 0; k < n; k++) {
                size += u[k * n + i] * u[k * n + i];
            }
            for (k = 0; k < n; k++) {
                u[k * n + i] /= sqrt~(size);
            }
        }
    }
}""",
}


def helper(name: str, prefix: str, dtype) -> str:
    """The text of a helper function; lower-case f behind the names of those in single precision."""
    suffix = "f" if np.dtype(dtype) == np.float32 else ""
    text = HELPERS[name].replace("~", suffix).replace("@", TYPES[np.dtype(dtype)])
    text = text.replace("$", number(np.finfo(dtype).eps))
    return text.replace(f"#_{name}(", f"{prefix}_{name}{suffix if name != 'whole' else ''}(")
