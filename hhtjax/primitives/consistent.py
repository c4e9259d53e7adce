"""Functions whose results do not depend on rounding differences between two evaluations of the same number.

XLA may evaluate a cheap number again for each of its users, and LLVM may round a product and a sum together. So a
program can have two values of one number, which differ in the last place. Then x == max(x) may be false for every
element of x. JAX's derivative of a maximum counts the elements for which it is true. The derivative becomes 0/0, or 0
for a maximum of two numbers. Therefore numbers that are tested for equality are `held`: computed once for all their
users. `lax.optimization_barrier` does not achieve this, because XLA:CPU removes it before fusion.

Comparisons by order, x < y, are not changed. If two roundings of x give different answers, both are right to rounding.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend.core import ClosedJaxpr, Literal, Primitive
from jax.interpreters import ad, batching, mlir

from hhtjax.description import Array, PyTree, Real
from hhtjax.primitives.compat import is_on
from hhtjax.primitives.interpreter import alone, evaluate

if TYPE_CHECKING:
    from jax.extend.core import Jaxpr, JaxprEqn

SHORT = 512  # numbers; XLA divides no work on so few among threads, which in a kernel takes a second result
EQUALITIES = {"eq", "ne"}
CHOICES = {"max", "min", "reduce_max", "reduce_min", "cummax", "cummin"}  # JAX's derivatives ask who equals the result
# what a number passes unchanged, or with another sign, and what makes the same number of the same numbers
EXACT = CHOICES | {
    *(
        "abs",
        "broadcast_in_dim",
        "clamp",
        "concatenate",
        "copy",
        "dynamic_slice",
        "expand_dims",
        "gather",
        "neg",
        "pad",
    ),
    *("reshape", "rev", "select_n", "slice", "sort", "split", "squeeze", "stack", "stop_gradient", "transpose"),
    *("unstack",),
}
INLINED = {"jit": "jaxpr", "closed_call": "call_jaxpr", "eval_jaxpr": "call_jaxpr"}  # the parameter: what is called
REBUILT = {"cond", "scan", "while"}


def held(x: Real) -> Array:
    """The array x, computed once for all its users. Its tangent is not changed.

    >>> print(held(jnp.arange(2.0)))
    [0. 1.]
    """
    return held_p.bind(jnp.asarray(x))


def consistent(f: Callable):
    """f with values and derivatives that do not depend on how often XLA evaluates the numbers compared in it.

    Args:
        f: a function of pytrees of arrays that returns a pytree of arrays.

    Returns:
        A function with the same values. On plain JAX it is f itself. If f compares nothing, its trace is that of f.

    Raises:
        whatever f raises, when it is called.

    >>> largest = consistent(lambda x: jnp.max(x * x + x))
    >>> print(jax.grad(largest)(jnp.array([1.0, 3.0])))
    [0. 7.]
    """
    if f is None or not is_on():
        return f
    compares = True

    @wraps(f)
    def g(*args: PyTree, **keywords: PyTree) -> Array:
        nonlocal compares
        if not compares:
            return f(*args, **keywords)
        leaves, structure = jax.tree.flatten((args, keywords))
        places = [i for i, x in enumerate(leaves) if hasattr(x, "dtype")]  # numbers of Python, and functions, stay

        def on_arrays(*arrays: Array) -> Array:
            new = dict(zip(places, arrays, strict=True))
            args, keywords = structure.unflatten([new.get(i, x) for i, x in enumerate(leaves)])
            return f(*args, **keywords)

        arrays = [leaves[i] for i in places]
        trace, like = jax.make_jaxpr(on_arrays, return_shape=True)(*arrays)
        compares = _compares(trace.jaxpr)
        return jax.tree.structure(like).unflatten(_run(trace.jaxpr, trace.consts, arrays))

    return g


def _run(jaxpr: Jaxpr, constants: list, values, inside: bool = False):
    """The values of a jaxpr's results. inside: of one within, of which arguments are held where it stands."""
    hold = _to_hold(jaxpr)
    given = [*constants, *values]
    if not inside:
        given = _held_where(hold, [*jaxpr.constvars, *jaxpr.invars], given)
    return evaluate(jaxpr, given, lambda eqn, values: _held_where(hold, eqn.outvars, _apply(eqn, values)))


def _held_where(hold, variables: list, values: list):
    return [held(x) if v in hold else x for v, x in zip(variables, values, strict=True)]


def _to_hold(jaxpr: Jaxpr):
    """The variables from which the numbers tested for equality follow by exact operations."""
    hold = set()
    for eqn in reversed(jaxpr.eqns):
        name = eqn.primitive.name
        asked = name in EQUALITIES or any(map(_asks, _inner(eqn)))
        if asked or not hold.isdisjoint(eqn.outvars):
            if name in EXACT:
                hold.difference_update(eqn.outvars)
            if asked or name in EXACT or _inner(eqn):
                hold.update(x for x in eqn.invars if _is_floating(x))
    return hold


def _is_floating(x):
    return not isinstance(x, Literal) and jnp.issubdtype(x.aval.dtype, np.floating)


def _inner(eqn: JaxprEqn):
    """The jaxprs within an operation that are evaluated anew here."""
    if eqn.primitive.name not in REBUILT and eqn.primitive.name not in INLINED:
        return []
    return [getattr(x, "jaxpr", x) for x in jax.tree.leaves(list(eqn.params.values())) if hasattr(x, "eqns")]


def _asks(jaxpr: Jaxpr) -> bool:
    """Whether an operation tests floating numbers for equality."""
    return _has(EQUALITIES, jaxpr)


def _compares(jaxpr: Jaxpr) -> bool:
    """Whether an operation, or its derivative, tests floating numbers for equality."""
    return _has(EQUALITIES | CHOICES, jaxpr)


def _has(names, jaxpr) -> bool:
    for eqn in jaxpr.eqns:
        if eqn.primitive.name in names and any(map(_is_floating, eqn.invars)):
            return True
        if any(_has(names, x) for x in _inner(eqn)):
            return True
    return False


def _apply(eqn, values: list):
    """The results of one operation."""
    name = eqn.primitive.name
    if name in CHOICES and any(map(_is_floating, eqn.invars)):
        return [_choice(eqn)(*values)]
    if not any(map(_compares, _inner(eqn))):
        return alone(eqn)(*values)
    if name in INLINED:
        closed = eqn.params[INLINED[name]]
        return _run(closed.jaxpr, closed.consts, values, inside=True)
    params = jax.tree.map(lambda x: _rebuilt(x) if isinstance(x, ClosedJaxpr) else x, eqn.params)
    return alone(eqn.replace(params=params))(*values)


def _rebuilt(closed: ClosedJaxpr) -> ClosedJaxpr:
    """The body of a loop, or a branch."""
    like = [jax.ShapeDtypeStruct(x.shape, x.dtype, weak_type=x.weak_type) for x in closed.in_avals]
    return jax.make_jaxpr(lambda *x: _run(closed.jaxpr, closed.consts, x, inside=True))(*like)


def _choice(eqn: JaxprEqn):
    """A maximum or minimum as a function whose derivative compares it with the numbers that it was taken of."""

    def plain(*x: Array) -> Array:
        return alone(eqn)(*x)[0]

    choose = jax.custom_jvp(plain)
    choose.defjvp(lambda x, dx: jax.jvp(plain, tuple(map(held, x)), tuple(dx)))
    return choose


def _jvp(primals: tuple, tangents: tuple):
    return held_p.bind(*primals), tangents[0]


def _lower(ctx, x):
    """A call that XLA does not inline.

    It computes something: where a call returns its parameter, XLA:CPU may keep that where it keeps another number, and
    steps were wrong without a word (the whole run of seed 830017 in tests/whole_runs.py).
    """

    def same(x: Array) -> list:
        y = _same(x)
        return [y] if x.size <= SHORT else [y, y.ravel()[:1]]

    call = jax.jit(same)
    return mlir.lower_fun(lambda x: set_xla_metadata(call(x)[0], inlineable="false"), multiple_results=False)(ctx, x)


def _same(x: Array) -> Array:
    """x, by an operation on its bits that XLA leaves, and that LLVM takes out."""
    if x.dtype == bool:
        return _same(x.astype(np.int8)) != 0
    if jnp.issubdtype(x.dtype, np.complexfloating):
        return lax.complex(_same(x.real), _same(x.imag))
    if jnp.issubdtype(x.dtype, np.floating):
        return lax.bitcast_convert_type(_same(lax.bitcast_convert_type(x, f"int{8 * x.dtype.itemsize}")), x.dtype)
    return x & x


held_p = Primitive("hhtjax_held")
held_p.def_impl(lambda x: x)
held_p.def_abstract_eval(lambda x: x)
ad.primitive_jvps[held_p] = _jvp
batching.defvectorized(held_p)
mlir.register_lowering(held_p, lambda ctx, x: [x])
mlir.register_lowering(held_p, _lower, platform="cpu")
