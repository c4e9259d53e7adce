"""The right-hand side of a scene for packages that compile it: the same operations on scalars, in their language.

The scene's own functions are traced to a list of operations on scalars (`hhtjax.jaxpr.listed`). That list is evaluated
on the expressions of a package, which have + - * / and functions called sin, cos and sqrt, or on names that write each
operation down as a line of text. What the list has once is there once in the package's program, too.

    program(name)               the list of a scene: (t, y, params) -> dy/dt
    program(name).on(...)       its values on numbers, expressions, or names
    python_source, diffsl       the list as text
"""

import math
import re
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from experiments.work_precision.cases import cases
from hhtjax.jaxpr import Listing, Scalar, listed
from hhtjax.scenes import double_pendulum

PLAIN_SINES = {  # systems without the polynomials of `hhtjax.trigonometry`, of which there are no series
    "free double pendulum": double_pendulum.free().system,
    "stiff double pendulum": double_pendulum.stiff().system,
    "stiff double pendulum, torques as printed": double_pendulum.stiff(True).system,
}


class Program(NamedTuple):
    """dy/dt of a scene. listing: of (t, y, params as a vector); numbers: the params; size: of y."""

    listing: Listing
    numbers: np.ndarray
    size: int

    def on(self, t, y, params: Any = None, functions: Any = math):
        """dy/dt, a list. params: by default the scene's numbers, with which all that can be computed is computed.

        functions: has sin, cos and sqrt of what t and y are.
        """
        numbers = [float(x) for x in self.numbers] if params is None else list(params)
        return Evaluation(self.listing, [t, *y, *numbers], functions).results()

    def split(self):
        """The list in two: of (params) -> constants, and of (t, y, constants) -> dy/dt, which has no operation left
        that depends on params alone."""
        params = self.listing.arguments[1 + self.size :]
        known, first, rest = set(params), [], []
        for x in self.listing.operations:
            if all(not isinstance(y, Scalar) or y in known for y in x.operands):
                known.update(x.results)
                first.append(x)
            else:
                rest.append(x)
        needed = dict.fromkeys(y for x in rest for y in x.operands if isinstance(y, Scalar) and y in known)
        needed |= dict.fromkeys(y for y in self.listing.results.flat if isinstance(y, Scalar) and y in known)
        constants = list(needed)
        arguments = self.listing.arguments[: 1 + self.size]
        ahead = Listing(params, first, np.array(constants, object))
        return ahead, Listing([*arguments, *constants], rest, self.listing.results)


def rate(name, t, y, params):
    """dy/dt, in sines, cosines, and with a mass matrix that is solved with as one operation.

    The list of our own elimination has the choices of its pivots. A mass matrix needs none; nor does the matrix of the
    squeezer, whose mass matrix comes first.
    """
    case = cases()[name]
    system: Any = PLAIN_SINES.get(name, case.scene.system)
    q, v = y[: case.size], y[case.size :]
    if system.constraint is not None or q.size != v.size:
        return case.rate(t, y, params)
    M = system.mass(q, params)
    w = system.force(q, v, t, params)
    return jnp.concatenate([v, w / M if M.ndim == 1 else jnp.linalg.solve(M, w)])


@cache
def program(name):
    """The `Program` of a scene."""
    case = cases()[name]
    numbers, unravel = ravel_pytree(case.scene.params)
    found = listed(lambda t, y, vector: rate(name, t, y, unravel(vector)), jnp.zeros(()), jnp.asarray(case.y0), numbers)
    return Program(found, np.asarray(numbers, float), len(case.y0))


def places(name, keys):
    """Where the numbers of these params are in the vector of all."""
    params = cases()[name].scene.params
    marked = {key: jax.tree.map(lambda x, key=key: jnp.full(jnp.shape(x), key in keys), x) for key, x in params.items()}
    return [int(i) for i in np.flatnonzero(np.asarray(ravel_pytree(marked)[0]))]


# ----------------------------------------------------------------------------
# Evaluation on whatever has + - * /.


class Evaluation:
    """The values of a list. Numbers of Python are computed with, and zeros and ones among them left out."""

    def __init__(self, listing, arguments, functions):
        self.values = dict(zip(listing.arguments, arguments, strict=True))
        self.functions, self.listing = functions, listing
        for x in listing.operations:
            found = getattr(self, f"_{x.name}", self._plain)(x)
            self.values.update(zip(x.results, found, strict=True))

    def results(self):
        """Those of the list."""
        return [self.value(x) for x in self.listing.results.flat]

    def value(self, operand):
        """Of an operand: a number, an expression, or a list of these."""
        return self.values[operand] if isinstance(operand, Scalar) else operand.item()

    def _plain(self, x):
        operands = [self.value(y) for y in x.operands]
        if x.name in FOLDED and all(map(is_number, operands)):
            return [FOLDED[x.name](*operands)]
        if x.name in ("sin", "cos", "sqrt"):
            return [getattr(math if is_number(operands[0]) else self.functions, x.name)(operands[0])]
        if x.name not in ARITHMETIC:
            raise NotImplementedError(f"{x.name} of a number that is not known: no straight line of sums and products.")
        return [ARITHMETIC[x.name](*operands)]

    def _array(self, x):
        return [[self.value(y) for y in x.operands]]

    def _element(self, x):
        array, index = map(self.value, x.operands)
        return [array[int(index)]]

    def _lu(self, x):
        n, (A,) = x.params["n"], map(self.value, x.operands)
        return [eliminated(A, n), list(range(n)), list(range(n))]

    def _triangular_solve(self, x):
        n, (A, b), params = x.params["n"], map(self.value, x.operands), x.params
        at = (lambda i, j: A[j * n + i]) if params["transpose"] else (lambda i, j: A[i * n + j])
        downwards, found = params["lower"] != params["transpose"], list(b)
        for i in range(n) if downwards else reversed(range(n)):
            for j in range(i) if downwards else range(i + 1, n):
                found[i] = minus(found[i], times(at(i, j), found[j]))
            if not params["unit_diagonal"]:
                found[i] = over(found[i], at(i, i))
        return [found]


def eliminated(A, n):
    """L below the diagonal and U on and above it, A = L U, rows in their order."""
    A = list(A)
    for k in range(n):
        for i in range(k + 1, n):
            factor = A[i * n + k] = over(A[i * n + k], A[k * n + k])
            for j in range(k + 1, n):
                A[i * n + j] = minus(A[i * n + j], times(factor, A[k * n + j]))
    return A


def is_number(x):
    """Whether Python can compute with it."""
    return isinstance(x, (bool, int, float))


def is_(x, number):
    """Whether it is that number."""
    return is_number(x) and x == number


def plus(a, b):
    """a + b."""
    return b if is_(a, 0) else a if is_(b, 0) else a + b


def minus(a, b):
    """a - b."""
    return a if is_(b, 0) else -b if is_(a, 0) else a - b


def times(a, b):
    """a b."""
    if is_(a, 0) or is_(b, 0):
        return 0.0
    return b if is_(a, 1) else a if is_(b, 1) else -b if is_(a, -1) else -a if is_(b, -1) else a * b


def over(a, b):
    """a / b; a product, where b is known."""
    if is_(a, 0):
        return 0.0
    return times(a, 1 / b) if is_number(b) and not is_number(a) else a / b


ARITHMETIC = {"add": plus, "sub": minus, "mul": times, "div": over, "neg": lambda x: -x}
FOLDED = {  # of numbers that are known, such as the indices of an elimination
    "convert_element_type": lambda x: x,
    "lt": lambda a, b: a < b,
    "max": max,
    "min": min,
    "select_n": lambda which, *cases: cases[int(which)],
}


# ----------------------------------------------------------------------------
# As text: one line for each operation.


class Name:
    """A number with a name, which writes down what is done with it. writer: a `Writer`."""

    def __init__(self, text, writer):
        self.text, self.writer = text, writer

    def __add__(self, x):
        return self.writer.line(f"{self.text} + {word(x)}")

    def __radd__(self, x):
        return self.writer.line(f"{word(x)} + {self.text}")

    def __sub__(self, x):
        return self.writer.line(f"{self.text} - {word(x)}")

    def __rsub__(self, x):
        return self.writer.line(f"{word(x)} - {self.text}")

    def __mul__(self, x):
        return self.writer.line(f"{self.text} * {word(x)}")

    def __rmul__(self, x):
        return self.writer.line(f"{word(x)} * {self.text}")

    def __truediv__(self, x):
        return self.writer.line(f"{self.text} / {word(x)}")

    def __rtruediv__(self, x):
        return self.writer.line(f"{word(x)} / {self.text}")

    def __neg__(self):
        return self.writer.line(f"-{self.text}")


def word(x):
    """A name, or a number."""
    return x.text if isinstance(x, Name) else f"({x!r})" if x < 0 else repr(x)


class Writer:
    """Lines of text. pattern: of a line, with `name` and `text`. It is the `functions` of an evaluation, too."""

    def __init__(self, pattern):
        self.pattern, self.texts = pattern, {}

    def name(self, text):
        """A name that is there already."""
        return Name(text, self)

    def line(self, text):
        """One more, and the name that it gives."""
        name = f"x{len(self.texts)}"
        self.texts[name] = text
        return Name(name, self)

    def lines(self, results):
        """Those that the results come from."""
        wanted, kept = {x.text for x in results if isinstance(x, Name)}, []
        for name, text in reversed(self.texts.items()):
            if name in wanted:
                wanted.update(re.findall(r"\bx\d+", text))
                kept.append(self.pattern.format(name=name, text=text))
        return kept[::-1]

    def sin(self, x):
        """sin x."""
        return self.line(f"sin({x.text})")

    def cos(self, x):
        """cos x."""
        return self.line(f"cos({x.text})")

    def sqrt(self, x):
        """The root of x."""
        return self.line(f"sqrt({x.text})")


def python_source(listing, called, arguments, names):
    """A function of Python, `called(*arguments)`, that writes the results into the array `dy`.

    names: of the numbers that the list takes, such as "y[0]"; or a number itself. sin, cos, sqrt: those of `math`.
    """
    writer = Writer("    {name} = {text}")
    values = [writer.name(x) if isinstance(x, str) else x for x in names]
    found = Evaluation(listing, values, writer).results()
    ends = [f"    dy[{i}] = {word(x)}" for i, x in enumerate(found)]
    return "\n".join([f"def {called}({', '.join(arguments)}):", *writer.lines(found), *ends, ""])


def compiled_source(text, called):
    """The function of that name in a text of Python."""
    names = {"sin": math.sin, "cos": math.cos, "sqrt": math.sqrt}
    exec(text, names)
    return names[called]


def python_rate(name):
    """`rate(t, y, dy)` of a scene, in Python, for numba."""
    found = program(name)
    names = ["t", *(f"y[{i}]" for i in range(found.size)), *map(float, found.numbers)]
    return compiled_source(python_source(found.listing, "rate", ("t", "y", "dy"), names), "rate")


def diffsl(name):
    """A scene in DiffSL, the language of diffsol."""
    found, case = program(name), cases()[name]
    writer = Writer("{name} {{ {text} }}")
    y = [f"y{i}" for i in range(found.size)]
    rates = found.on(writer.name("t"), map(writer.name, y), functions=writer)
    starts = ",\n".join(f"    {name} = {float(x)!r}" for name, x in zip(y, case.y0, strict=True))
    ends = ",\n".join(f"    {word(x)}" for x in rates)
    shown = ",\n".join(f"    {name}" for name in y[: case.size])
    return f"u_i {{\n{starts}\n}}\n" + "\n".join(writer.lines(rates)) + f"\nF_i {{\n{ends}\n}}\nout_i {{\n{shown}\n}}\n"
