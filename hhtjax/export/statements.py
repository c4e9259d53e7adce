"""A list of operations as statements of C99: a constant for each result, braces for branches and loops."""

from dataclasses import replace

import numpy as np

from hhtjax.export.expressions import TYPES, expression, number
from hhtjax.xla import Scalar

HELPED = {"max": "max", "min": "min", "clamp": ("max", "min"), "sign": "sign"}


class Statements:
    """Writes operations. names: {scalar: its name}; helpers: (name, dtype) of the helper functions that are called.

    prefix: of their names; real: (dtype, name) of the type of the state.
    """

    def __init__(self, names, prefix, real):
        self.names, self.prefix, self.real = dict(names), prefix, real
        self.helpers, self.lines, self.depth = set(), [], 1

    def write(self, operations):
        """All of them, at the end of `lines`."""
        for x in operations:
            getattr(self, f"_{x.name}", self._plain)(x)

    def text(self, operand):
        """The name of a scalar, or a number."""
        return self.names[operand] if isinstance(operand, Scalar) else number(operand)

    def type(self, dtype):
        """Of C."""
        return self.real[1] if dtype == self.real[0] else TYPES[np.dtype(dtype)]

    def line(self, text):
        """One more."""
        self.lines.append("    " * self.depth + text)

    def _name(self, scalar):
        self.names[scalar] = f"{'a' if scalar.size else 'x'}{len(self.names)}"
        return self.names[scalar]

    def _helper(self, name, dtype):
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
        """An array that is to be written over."""
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

    def _inside(self, block, targets):
        """A block, whose results are then given to variables; first read, if they are such variables themselves."""
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
    """An operation, or a type, that has no text."""
