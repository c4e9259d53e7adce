"""The same function with the machinery and without, differentiated and vectorised, evaluated operation by operation.

Columns: on scalars, in stages, whole (stages on scalars, as in a run), and the matrix of the derivative. Modes: values
with forward and reverse derivatives; vmap of values with forward derivatives. Both sides are traced, so arguments are
tracers, and evaluated with NumPy (by_numpy.py). They agree to 1e-12 of the largest number in an array (with single
precision: 5e-4), in NaN and infinities, and values in signs of zeros, but for sums: -0 - 0 is 0 by itself, -0 compiled.
Two licences: where a derivative is NaN, another number may stand, for what is known to be zero is not multiplied; and
where one of reverse mode is infinite, NaN, for at the end of a stage, as of a scan, that zero is a number. A larger
difference counts only if the plain program, disturbed by single roundings, stays far nearer.
"""

import traceback
from collections import Counter
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from by_numpy import Numbers
from jax.extend.core import jaxpr_as_fun
from jax.flatten_util import ravel_pytree
from jax.interpreters import partial_eval as pe
from verdicts import judge

from hhtjax.jaxpr.linear_maps import linear_map
from hhtjax.jaxpr.scalars import by_scalars, in_stages, join, split
from hhtjax.primitives.kernels import STAGED, staged

RTOL = 1e-12


class Difference(NamedTuple):
    """Where a function does not give the same: column, mode, what was found and expected (a traceback, and None)."""

    column: str
    mode: str
    found: Any
    expected: Any


def on_scalars(f):
    return lambda *args: join(by_scalars(f)(*split(args)))


def stages(f):
    def g(*args):
        back = jax.tree.structure(jax.eval_shape(f, *args))
        return back.unflatten(in_stages(STAGED, lambda *args: jax.tree.leaves(f(*args)), *args))

    return g


def whole(f):
    return on_scalars(staged(f))


COLUMNS = {"on scalars": on_scalars, "in stages": stages, "whole": whole}


def is_float(x):
    return jnp.issubdtype(jnp.result_type(x), jnp.floating)


def _of_floats(f, args):
    """(f of the floating-point arguments alone, to what is floating-point and the rest; those arguments)."""
    at = [x for x in args if is_float(x)]

    def g(*at):
        floats = iter(at)
        results = jax.tree.leaves(f(*(next(floats) if is_float(x) else x for x in args)))
        return [y for y in results if is_float(y)], [y for y in results if not is_float(y)]

    return g, at


def direction(x):
    """An array like this, of numbers without meaning."""
    size = int(np.prod(x.shape))
    return np.cos(1.0 + 2.0 * np.arange(size)).reshape(x.shape).astype(x.dtype)


def forward(f):
    def g(*args):
        h, at = _of_floats(f, args)
        values, along, others = jax.jvp(h, at, [*map(direction, at)], has_aux=True)
        return others, values, along

    return g


def both(f):
    """Forward, and back."""

    def g(*args):
        h, at = _of_floats(f, args)
        values, tangent, others = jax.linearize(h, *at, has_aux=True)
        back = jax.linear_transpose(tangent, *at)([*map(direction, values)])
        return others, values, tangent(*map(direction, at)), back

    return g


def reverse(f):
    """Where forward mode is not defined."""

    def g(*args):
        h, at = _of_floats(f, args)
        values, pull, others = jax.vjp(h, *at, has_aux=True)
        return others, values, [], pull([*map(direction, values)])

    return g


def value(f):
    return lambda *args: (jax.tree.leaves(f(*args)),)


def matrix(f):
    """Of the derivative of all floating-point results, in all such arguments."""

    def g(*args):
        h, at = _of_floats(f, args)
        z, back = ravel_pytree(at)
        tangent = jax.linearize(lambda z: ravel_pytree(h(*back(z))[0])[0], z)[1]
        return linear_map(tangent, z)

    return g


def member(args, i):
    """Arguments of member 0, as given, or 1."""
    if i == 0:
        return list(args)
    return [np.flip(x) if x.ndim else ~x if x.dtype == bool else x / 2 if is_float(x) else (x + 1) // 2 for x in args]


def traced(f, args):
    """The program of f, and its results without values."""
    closed, shape = jax.make_jaxpr(f, return_shape=True)(*args)
    # JAX >= 0.12 has operations of a higher kind, such as a search, which become others
    return pe.lower_jaxpr2(closed) if getattr(closed, "is_high", False) else closed, shape


def everywhere(jaxpr):
    """Its operations, those of functions within it included."""
    for eqn in jaxpr.eqns:
        yield eqn
        for inner in jax.tree.leaves(list(eqn.params.values())):
            if hasattr(inner, "eqns"):
                yield from everywhere(getattr(inner, "jaxpr", inner))


class Case:
    """A function and its arguments, and what plain JAX makes of them."""

    def __init__(self, f, args):
        self.args = [np.asarray(x) for x in args]
        closed, shape = traced(f, self.args)
        structure = jax.tree.structure(shape)
        self.f = lambda *args: structure.unflatten(jaxpr_as_fun(closed)(*args))  # quicker than to trace f anew
        self.sizes = {k: sum(x.size for x in self.args if is_float(x) == k) for k in (True, False)}
        self.mode, self.plain = self._most()
        single = any(
            getattr(v.aval, "dtype", None) == np.float32 for e in everywhere(self.plain.jaxpr) for v in e.outvars
        )
        names = {e.primitive.name for e in everywhere(self.plain.jaxpr)}
        self.has_sums = bool(names & {"reduce_sum", "dot_general", "cumsum", "scatter-add"})
        self.rtol = 5e-4 if single or any(x.dtype == np.float32 for x in self.args) else RTOL

    def _most(self):
        """The mode with most derivatives that plain JAX takes."""
        modes = (both, forward, reverse) if self.sizes[True] else ()
        for mode in (*modes, value):
            try:
                trace, shape = traced(mode(self.f), self.args)
                Numbers()(trace, *self.args)
            except Exception as error:  # no derivative, of a loop for one
                reason = error
                continue
            self.lengths = [len(part) for part in shape]
            return mode, trace
        raise NotImplementedError(f"plain JAX does not run this: {reason}")

    def parts(self, results):
        """Results as lists: others, values, along, back; or values alone."""
        parts, results = [], list(results)
        for n in self.lengths:
            parts.append(results[:n])
            results = results[n:]
        return parts

    def derivatives(self, column):
        return (
            traced(self.mode(column(self.f)), self.args)[0],
            self.args,
            lambda numbers: numbers(self.plain, *self.args),
        )

    def batch(self, column):
        members = [member(self.args, i) for i in (0, 1)]
        mode = forward if self.mode in (both, forward) else value
        trace = traced(jax.vmap(mode(column(self.f))), [np.stack(x) for x in zip(*members, strict=True)])[0]
        parts = 3 if mode is forward else 2 if self.mode is reverse else 1

        def expected(numbers):
            each = [[y for part in self.parts(numbers(self.plain, *x))[:parts] for y in part] for x in members]
            return [np.stack(y) for y in zip(*each, strict=True)]

        return trace, [np.stack(x) for x in zip(*members, strict=True)], expected

    def jacobian(self, column):
        """Along the direction, and back, by the matrix."""
        trace = traced(column(matrix(self.f)), self.args)[0]
        ahead = np.concatenate([direction(x).ravel() for x in self.args if is_float(x)])

        def expected(numbers):
            _, _, along, back = self.parts(numbers(self.plain, *self.args))
            along, back = ([np.ravel(y).astype(float) for y in part] for part in (along, back))
            return [np.concatenate([*along, []]), np.concatenate([*back, []])]

        _, values, *_ = self.parts(Numbers()(self.plain, *self.args))
        behind = np.concatenate([*(direction(y).ravel() for y in values), []])
        return trace, self.args, expected, ahead, behind


EVERY = {"derivatives": tuple(COLUMNS), "vmap": tuple(COLUMNS), "matrix": ("alone", "whole")}


def compare(f, args, rng=None, count=None):
    """The differences of a function; rng: by which one column is taken for each mode, else all."""
    columns = EVERY if rng is None else {mode: [rng.choice(names)] for mode, names in EVERY.items()}
    yield from differences(Case(f, args), columns, count)


def differences(case, columns, count=None):
    """Those of a case; columns: for each mode; count: of verdicts, updated."""
    count = Counter() if count is None else count
    todo = {"derivatives": case.derivatives, "vmap": case.batch}
    if case.mode is both:
        todo["matrix"] = case.jacobian
    for (mode, make), name in [(item, name) for item in todo.items() for name in columns[item[0]]]:
        column = COLUMNS.get(name, lambda f: f)
        try:
            trace, at, reference, *directions = make(column)
            found = Numbers()(trace, *at)
        except Exception as error:
            if _fails(make):  # of x**0, linearize knows that its derivative is zero, and jvp does not
                count["plain fails too"] += 1
                continue
            count["error"] += 1
            yield Difference(name, mode, "".join(traceback.format_exception(error)[-6:]), None)
            continue
        if directions:
            with np.errstate(all="ignore"):
                M = found[0].astype(float)
                found = [
                    np.where(np.isfinite(A).all(1), A @ d, np.nan) for A, d in zip((M, M.T), directions, strict=True)
                ]
        values = 0 if directions else max(1, sum(case.lengths[:2]))
        ahead = sum(case.lengths[:3]) if mode == "derivatives" else None
        verdict, expected = judge(found, reference, values, case.rtol, case.has_sums, ahead)
        if verdict.startswith("different") and mode == "vmap":  # of members apart; vmap itself may bring NaN
            plain = case.batch(lambda f: f)[0]
            verdict, expected = judge(
                found, lambda numbers, at=at, plain=plain: numbers(plain, *at), values, case.rtol, case.has_sums
            )
        count[verdict] += 1
        if verdict.startswith("different"):
            yield Difference(name, mode, found, expected)


def _fails(make):
    """Whether the program without the machinery does, in this mode."""
    try:
        trace, at, *_ = make(lambda f: f)
        Numbers()(trace, *at)
    except Exception:
        return True
    return False
