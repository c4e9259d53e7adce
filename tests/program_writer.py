"""Random programs as text: functions f(x, y, k) of two small float arrays and three integers, in jnp and lax.

Every line is tried as it is written, in a trace, so that shapes and dtypes of what it gives are known; a line that JAX
refuses is left out. The text is the program: it runs by itself below `HEADER`.
"""

import math
import random
from contextlib import contextmanager
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from program_operations import OPERATIONS

HEADER = """\
from functools import partial
import jax, jax.numpy as jnp, numpy as np
from jax import lax
@jax.custom_jvp
def steep(x):
    return jnp.sin(x)
steep.defjvp(lambda x, dx: (steep(*x), 2 * jnp.cos(x[0]) * dx[0]))

@jax.custom_vjp
def flat(x):
    return x * x
flat.defvjp(lambda x: (flat(x), x), lambda x, dy: (0.5 * x * dy,))
"""
SHAPES = (
    *((), (1,), (2,), (2,), (3,), (3,), (4,), (2, 3), (2, 3), (2, 2), (2, 2), (1, 3), (3, 1)),
    *((3, 3), (2, 2, 2), (9,), (0,), (2, 0)),
)
NUMBERS = ("0.0", "0.0", "1.0", "1.0", "-0.0", "2.0", "-1.0", "0.5", "-0.75", "1.3", "3.0", "0.1")
KEPT = 20  # elements of the largest array, now and then 30 times as many


@contextmanager
def usual_promotion():
    """As for users: operands of different ranks and dtypes are taken."""
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        yield


class Refused(Exception):
    """There is no operand for such a line, or JAX does not take it."""


class Program:
    """The text of a function and what its variables hold. rng: of the module random, or one by hypothesis."""

    def __init__(self, rng: random.Random, names: dict[str, Any], depth=0, indent="    ", scope=None):
        self.rng, self.names, self.depth, self.indent = rng, names, depth, indent
        self.scope = scope if scope is not None else _scope()
        self.lines, self.count = [], 0

    # What lines are made of.

    def choice(self, options):
        return options[self.rng.randrange(len(options))]

    def chance(self, p):
        return self.rng.random() < p

    def number(self):
        return self.choice(NUMBERS)

    def integer(self, low, high):
        return self.rng.randint(low, high)

    def pick(self, *conditions, kind="f"):
        """A variable of this kind (f, i, b), the later ones rather."""
        names = [n for n, x in self.names.items() if x.dtype.kind == kind and all(c(x) for c in conditions)]
        if not names:
            raise Refused
        return names[max(self.rng.randrange(len(names)), self.rng.randrange(len(names)))]

    def like(self, name):
        """A variable of the same shape and dtype, or a constant."""
        x = self.names[name]
        if self.chance(0.35):
            return self.constant(x.shape)
        return self.pick(lambda y: y.shape == x.shape and y.dtype == x.dtype)

    def shape(self, name):
        return self.names[name].shape

    def constant(self, shape):
        if shape and self.chance(0.15):
            return self.choice([f"jnp.zeros({shape})", f"jnp.ones({shape})", f"np.full({shape}, -0.0)"])
        if len(shape) == 2 and shape[0] == shape[1] and self.chance(0.3):
            return f"jnp.eye({shape[0]})"
        if shape == () and self.chance(0.5):
            return self.number()
        numbers = ", ".join(self.number() for _ in range(math.prod(shape)))
        array = f"np.array([{numbers}])" if shape else f"np.float64({numbers})"
        return array if len(shape) == 1 or not shape else f"{array}.reshape({shape})"

    def indices(self, n, length, outside=0.0):
        """Text of a list of places in an axis of n, some of them outside."""
        low, high = (-n - 2, n + 2) if self.chance(outside) else (-n, n - 1) if self.chance(0.3) else (0, n - 1)
        return [self.integer(low, max(low, high)) for _ in range(length)]

    def body(self, arguments):
        """Text of a function of variables like these: its lines and its names afterwards."""
        names = {name: self.names[like] if isinstance(like, str) else like for name, like in arguments.items()}
        names["k"] = self.names["k"]
        inner = Program(self.rng, names, self.depth + 1, self.indent + "    ", self.scope)
        inner.write(self.integer(1, 2))
        return inner

    def define(self, parameters, inner, result):
        """A function within the function; its name."""
        name = f"f{self.depth}{self.fresh()}"
        self.nested = [f"def {name}({parameters}):", *inner.lines, f"    return {result}"]
        return name

    def fresh(self):
        self.count += 1
        return self.count

    # Writing.

    def write(self, number):
        tries = 0
        while number and tries < 60:
            tries += 1
            try:
                self.line()
                number -= 1
            except Refused:
                continue
        return self

    def line(self):
        self.nested = []
        operations = OPERATIONS if self.depth < 2 else [x for x in OPERATIONS if not x.__name__.startswith("call_")]
        text = self.choice(operations)(self)
        name = f"{'abcd'[self.depth]}{self.fresh()}"
        lines = [*self.nested, f"{name} = {text}"]
        local: dict[str, Any] = {**self.scope, **self.names}
        try:
            exec("\n".join(lines), local)
        except Exception as error:  # whatever JAX has against it
            self.scope["refused"](lines, error)
            raise Refused from None
        value = local[name]
        if (
            isinstance(value, (tuple, list))
            or not hasattr(value, "shape")
            or value.size > KEPT * self.choice([1] * 24 + [30])
        ):
            raise Refused
        self.lines += ["    " + x for x in lines]
        self.names[name] = value

    def text(self, results):
        return "\n".join(["def f(x, y, k):", *self.lines, f"    return {', '.join(results)},"])


def _scope():
    scope: dict[str, Any] = {"refused": lambda lines, error: None}
    exec(HEADER, scope)
    return scope


def _array(rng, shape):
    return np.array([rng.choice([0.0, 1.0, -0.0, rng.uniform(-1.5, 1.5), rng.uniform(-1.5, 1.5)])
                     for _ in range(math.prod(shape))]).reshape(shape)  # fmt: skip


def program(rng, depth, refused=None, args=None):
    """Text and arguments of a program of this many lines. args: x and y, else drawn by chance."""
    args = [_array(rng, SHAPES[rng.randrange(len(SHAPES))]) for _ in range(2)] if args is None else list(args)
    args.append(np.array([rng.randint(-1, 4) for _ in range(3)], np.int32))
    texts = []

    def trace(x, y, k):
        written = Program(rng, {"x": x, "y": y, "k": k})
        if refused is not None:
            written.scope["refused"] = refused
        written.write(depth)
        made = [n for n in written.names if n not in "xyk"] or ["x"]
        chosen = {made[-1], rng.choice(made), rng.choice(made)}
        texts.append(written.text([n for n in made if n in chosen]))
        return jnp.zeros(())

    jax.make_jaxpr(trace)(*args)
    return texts[0], args


def function(text):
    """The function of a program's text."""
    scope = _scope()
    exec(text, scope)
    return scope["f"]
