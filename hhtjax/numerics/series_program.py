"""A traced program as operations on power series: sums, products, quotients, roots, and differential equations.

A number that depends on time is a series x(t0 + s) = sum_k x_k s^k. Each operation of a program gives the coefficient k
of its result from the coefficients of its operands up to k (`power_series.py`). With D = s d/ds, (D x)_k = k x_k, few
kinds of operations are needed:

    exp x = exp x_0 + I(z D x)            sin x, cos x = sin x_0 + I(c D x), cos x_0 - I(s D x)
    log x = log x_0 + I(D x / x)          x^a = x_0^a + I(a z D x / x)
    tan x = tan x_0 + I((1 + z^2) D x)    atan2(y, x) = atan2(y_0, x_0) + I((x D y - y D x) / (x^2 + y^2))

and so on, where z is the result itself and (I g)_k = g_k / k. Numbers that depend only on parameters are computed as
they are. A linear solve M x = b becomes M_0 x_k = b_k - sum_{j > 0} M_j x_{k-j}, with the same matrix for all k.

A. Jorba, M. Zou, Experimental Mathematics 14 (2005) 99-117, Sec. 2.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from hhtjax.jaxpr import Listing, NotListed, Scalar


@dataclass(eq=False)
class Node:
    """An operation on series. zero: whether its first coefficient is; row: its number among the convolutions, or -1."""

    kind: str
    operands: list = field(default_factory=list)  # nodes, and numbers that are known
    zero: bool = False
    row: int = -1
    name: str = ""  # of the function that gives the first coefficient, or of an operation on what does not move
    at: list = field(default_factory=list)  # what that takes
    more: Any = None


@dataclass(eq=False)
class Solve:
    """A linear solve: M x = b. matrix: nodes that give M x from x, the `results`."""

    right: list
    unknowns: list
    matrix: list
    results: list

    @cached_property
    def key(self) -> tuple:
        """The same for all solves with one matrix."""
        places = {id(x): i for i, x in enumerate((*self.unknowns, *self.matrix))}

        def told(x: Any):
            if not isinstance(x, Node):
                return x.tobytes()
            return ("own", places[id(x)]) if id(x) in places else id(x)

        operations = tuple((x.kind, *map(told, x.operands)) for x in self.matrix)
        return len(self.unknowns), operations, tuple(map(told, self.results))


@dataclass(frozen=True)
class SeriesProgram:
    """A program on series. arguments: nodes, one for each number; known: what does not move; nodes: what does, in their
    order; rows: the convolutions, pairs of operands; results: nodes and numbers."""

    arguments: list
    known: list
    nodes: list
    rows: list
    results: list


def series_program(listing: Listing, results: Sequence, moving: int) -> SeriesProgram:
    """The program of a listing whose first arguments, so many, are series, and the others constant.

    Raises NotListed, with the name and the line of an operation that has no series.
    """
    builder = _Builder()
    arguments = []
    for i, x in enumerate(listing.arguments):
        node = Node("argument" if i < moving else "known", more=i)
        builder.values[x] = node
        arguments.append(node)
    builder.write(listing.operations)
    return SeriesProgram(arguments, builder.known, builder.nodes, builder.rows, [builder.value(x) for x in results])


def moves(x: Node | np.generic) -> bool:
    """Whether an operand is a series, and not one number."""
    return isinstance(x, Node) and x.kind != "known"


def is_zero(x: Any) -> bool:
    """Whether an operand is known to be zero, or begins with it."""
    return x.zero if isinstance(x, Node) else bool(x == 0)


class _Builder:
    """What writes the nodes."""

    def __init__(self):
        self.values = {}  # {scalar of the listing: node}
        self.known, self.nodes, self.rows, self.done = [], [], [], {}

    def value(self, x: Scalar | np.generic) -> Any:
        return self.values[x] if isinstance(x, Scalar) else x

    def write(self, operations: list):
        """The operations of a listing."""
        for x in operations:
            if x.name == "solve":
                self.solve(x)
                continue
            operands = [self.value(y) for y in x.operands]
            if any(map(moves, operands)):
                is_float = np.dtype(x.results[0].dtype).kind == "f"
                found = RULES[x.name](self, *operands) if is_float and x.name in RULES else None
            else:
                found = self.constant(x, operands)
            if found is None:
                raise NotListed(x.name, x.line)
            self.values[x.results[0]] = found

    def constant(self, x: Any, operands: list):
        """An operation on numbers that do not move."""
        if x.name not in ON_KNOWN or len(x.results) != 1:
            return None
        node = Node("known", name=x.name, at=operands, more=x.results[0].dtype)
        self.known.append(node)
        return node

    def solve(self, x: Any):
        """A linear solve, whose matrix is one of the nodes before it."""
        unknowns = [Node("unknown") for _ in x.results]
        self.values.update(zip(x.results, unknowns, strict=True))
        outer, done, self.nodes, self.done = self.nodes, self.done, [], dict(self.done)
        (block,) = x.blocks
        self.write(block.operations)
        results = [self.value(y) for y in block.results]
        matrix, self.nodes, self.done = self.nodes, outer, done
        right = [self.value(y) for y in x.operands]
        self.nodes.append(Node("solve", more=Solve(right, unknowns, matrix, results)))

    # operations on series

    def node(self, kind: str, *operands: Any, zero: bool = False, **more: Any) -> Node:
        """One of them, found if it was there before."""
        key = (kind, *(id(x) if isinstance(x, Node) else (str(x.dtype), x.tobytes()) for x in operands))
        if kind != "integral" and key in self.done:
            return self.done[key]
        made = Node(kind, list(operands), zero, **more)
        self.done[key] = made
        self.nodes.append(made)
        return made

    def convolution(self, kind: str, *operands: Any, pair: tuple = (), zero: bool = False) -> Node:
        """One with a sum over products of coefficients, of the pair, or of the first and the result."""
        count = len(self.nodes)
        made = self.node(kind, *operands, zero=zero)
        if len(self.nodes) > count:
            made.row = len(self.rows)
            self.rows.append(pair or ((made, made) if kind == "root" else (operands[1], made)))
        return made

    def add(self, x: Any, y: Any) -> Any:
        return self.node("add", x, y, zero=is_zero(x) and is_zero(y))

    def sub(self, x: Any, y: Any) -> Any:
        return self.node("sub", x, y, zero=is_zero(x) and is_zero(y))

    def neg(self, x: Node) -> Node:
        return self.node("neg", x, zero=x.zero)

    def mul(self, x: Any, y: Any) -> Node:
        if not moves(x):
            x, y = y, x
        if not moves(y):
            return self.node("scale", x, y, zero=x.zero)
        if y.zero:
            x, y = y, x
        return self.convolution("product", x, y, pair=(x, y), zero=x.zero)

    def div(self, x: Any, y: Any) -> Node:
        if not moves(y):
            return self.node("divide", x, y, zero=x.zero)
        return self.convolution("quotient", x, y, zero=is_zero(x))

    def rate(self, x: Any) -> Any:
        """D x."""
        return self.node("rate", x, zero=True) if moves(x) else np.float64(0)

    def root(self, x: Node) -> Node:
        return self.convolution("root", x)

    def waiting(self, name: str, *at: Any) -> Node:
        """f(x), whose first coefficient is f of theirs, before it is known what it is the integral of."""
        return Node("integral", name=name, at=list(at))

    def integral(self, z: Node, g: Any) -> Node:
        """z = z_0 + I(g)."""
        z.operands = [g]
        self.nodes.append(z)
        return z

    def once(self, name: str, operands: tuple, make: Callable):
        """What make() gives, found if it was there before."""
        key = (name, *map(id, operands))
        if key not in self.done:
            self.done[key] = make()
        return self.done[key]


def _exp(b: _Builder, x: Node, name: str = "exp", rate: float = 1.0) -> Node:
    def make():
        z = b.waiting(name, x)
        g = b.mul(b.rate(x), z)
        return b.integral(z, g if rate == 1 else b.mul(g, np.float64(rate)))

    return b.once(name, (x,), make)


def _expm1(b: _Builder, x: Node) -> Node:
    return b.integral(b.waiting("expm1", x), b.mul(b.rate(x), _exp(b, x)))


def _pair(which: int, names: tuple, sign: int):
    """s' = c x', c' = sign s x'."""

    def rule(b: _Builder, x: Node) -> Node:
        def make():
            s, c = (b.waiting(name, x) for name in names)
            gs, gc = b.mul(b.rate(x), c), b.mul(b.rate(x), s)
            gc = b.neg(gc) if sign < 0 else gc
            return b.integral(s, gs), b.integral(c, gc)

        return b.once(names[0], (x,), make)[which]

    return rule


def _tangent(name: str, sign: float):
    """z' = (1 + sign z^2) x'."""

    def rule(b: _Builder, x: Node) -> Node:
        def make():
            z, w = b.waiting(name, x), Node("add")
            row = len(b.rows)
            g = Node("product", [b.rate(x), w], zero=True, row=row)
            b.rows.append((b.rate(x), w))
            b.nodes.append(g)
            b.integral(z, g)
            w.operands = [np.float64(1), b.mul(z, z) if sign > 0 else b.neg(b.mul(z, z))]
            b.nodes.append(w)
            return z

        return b.once(name, (x,), make)

    return rule


def _logistic(b: _Builder, x: Node) -> Node:
    """1/(1 + exp(-x)) = (1 + tanh(x/2))/2."""
    half = b.mul(x, np.float64(0.5))
    return b.add(b.mul(RULES["tanh"](b, half), np.float64(0.5)), np.float64(0.5))


def _quotient_of(name: str, denominator: Callable, sign: int = 1):
    """z' = sign x' / denominator."""

    def rule(b: _Builder, x: Node) -> Node:
        def make():
            g = b.div(b.rate(x), denominator(b, x))
            return b.integral(b.waiting(name, x), g if sign > 0 else b.neg(g))

        return b.once(name, (x,), make)

    return rule


def _one_and(sign: int, root: bool = False, minus: bool = False):
    """1 + sign x^2, or its square root; minus: x^2 - 1."""

    def denominator(b: _Builder, x: Node) -> Node:
        square, one = b.mul(x, x), np.float64(1)
        w = b.sub(square, one) if minus else b.add(square, one) if sign > 0 else b.sub(one, square)
        return b.root(w) if root else w

    return denominator


def _atan2(b: _Builder, y: Any, x: Any) -> Node:
    parts = [b.mul(p, b.rate(q)) if moves(q) else None for p, q in ((x, y), (y, x))]
    squares = [z if moves(z) else _square(b, z) for z in (x, y)]
    x2, y2 = (b.mul(z, z) if moves(z) else s for z, s in zip((x, y), squares, strict=True))
    top = b.sub(*parts) if None not in parts else parts[0] if parts[1] is None else b.neg(parts[1])
    return b.integral(b.waiting("atan2", y, x), b.div(top, b.add(x2, y2)))


def _square(b: _Builder, x: Any):
    """Of a number that does not move."""
    if not isinstance(x, Node):
        return x * x
    node = Node("known", name="mul", at=[x, x], more=np.dtype(np.float64))
    b.known.append(node)
    return node


def _power(b: _Builder, x: Any, a: Any, name: str = "pow") -> Node:
    """x^a."""
    if not isinstance(a, Node) and float(a).is_integer() and abs(a) <= MOST_FACTORS:
        return _whole_power(b, x, int(a))
    at = (x,) if name != "pow" else (x, a)
    z = b.waiting(name, *at)
    if moves(a) and not moves(x):
        logarithm = Node("known", name="log", at=[x], more=np.dtype(np.float64))
        b.known.append(logarithm)
        return b.integral(z, b.mul(b.mul(b.rate(a), logarithm), z))
    if moves(a):
        return b.integral(z, b.mul(b.rate(b.mul(a, RULES["log"](b, x))), z))
    return b.integral(z, b.mul(b.mul(b.div(b.rate(x), x), z), a))


def _whole_power(b: _Builder, x: Node, a: int) -> Any:
    if a < 0:
        return b.div(np.float64(1), _whole_power(b, x, -a))
    found = None
    while a:
        if a & 1:
            found = x if found is None else b.mul(found, x)
        a >>= 1
        x = b.mul(x, x) if a else x
    return found


def _erf(b: _Builder, x: Node) -> Node:
    bell = _exp(b, b.neg(b.mul(x, x)))
    return b.integral(b.waiting("erf", x), b.mul(b.mul(b.rate(x), bell), np.float64(2 / math.sqrt(math.pi))))


def _select(b: _Builder, which: Any, *cases: Any):
    """Between series, by what does not move."""
    return None if moves(which) else b.node("select", which, *cases, zero=all(map(is_zero, cases)))


MOST_FACTORS = 16  # of a power that is written as products

RULES = {
    **{"add": _Builder.add, "sub": _Builder.sub, "neg": _Builder.neg, "mul": _Builder.mul, "div": _Builder.div},
    **{"sqrt": _Builder.root, "rsqrt": lambda b, x: b.div(np.float64(1), b.root(x))},
    "cbrt": lambda b, x: _power(b, x, np.float64(1 / 3), "cbrt"),
    "pow": _power,
    **{"exp": _exp, "exp2": lambda b, x: _exp(b, x, "exp2", math.log(2)), "expm1": _expm1},
    **{"sin": _pair(0, ("sin", "cos"), -1), "cos": _pair(1, ("sin", "cos"), -1)},
    **{"sinh": _pair(0, ("sinh", "cosh"), 1), "cosh": _pair(1, ("sinh", "cosh"), 1)},
    **{"tan": _tangent("tan", 1), "tanh": _tangent("tanh", -1), "logistic": _logistic, "erf": _erf},
    "log": _quotient_of("log", lambda b, x: x),
    "log1p": _quotient_of("log1p", lambda b, x: b.add(x, np.float64(1))),
    "atan": _quotient_of("atan", _one_and(1)),
    "asin": _quotient_of("asin", _one_and(-1, root=True)),
    "acos": _quotient_of("acos", _one_and(-1, root=True), -1),
    "asinh": _quotient_of("asinh", _one_and(1, root=True)),
    "acosh": _quotient_of("acosh", _one_and(-1, root=True, minus=True)),
    "atanh": _quotient_of("atanh", _one_and(-1)),
    "atan2": _atan2,
    "select_n": _select,
    "convert_element_type": lambda b, x: x,
}
# operations on what does not move, by their names in LAX
ON_KNOWN = {
    **dict.fromkeys(("add", "sub", "neg", "mul", "div", "rem", "max", "min", "abs", "sign", "floor", "ceil")),
    **dict.fromkeys(("sqrt", "rsqrt", "cbrt", "pow", "exp", "exp2", "expm1", "log", "log1p", "logistic", "erf")),
    **dict.fromkeys(("sin", "cos", "tan", "sinh", "cosh", "tanh", "asin", "acos", "atan", "atan2")),
    **dict.fromkeys(("asinh", "acosh", "atanh", "eq", "ne", "lt", "le", "gt", "ge", "select_n", "clamp")),
    **dict.fromkeys(("is_finite", "convert_element_type")),
    **{"and": "bitwise_and", "or": "bitwise_or", "not": "bitwise_not", "xor": "bitwise_xor"},
}
