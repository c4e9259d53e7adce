"""Functions with derivatives of their own in forward and reverse mode, for loops that autodiff handles badly.

`jax.custom_jvp` leaves reverse mode to autodiff, which cannot reverse a loop whose number of iterations depends on
data. With `jax.custom_vjp` there is no forward mode. Here a derivative is an operation of JAX. Forward mode evaluates
it together with the values, in one loop. Reverse mode separates the values from the linear part. Each of them becomes
an operation of its own, and the linear one has its transpose as a rule.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive, Var
from jax.interpreters import ad, batching, mlir
from jax.interpreters import partial_eval as pe

from hhtjax.description import Array, PyTree


class TwoWays(NamedTuple):
    """A function of a list of arrays x, with its derivatives by some of them. None of the functions closes over a
    tracer.

    dx is a list of one or more floating tangents of entries of x.

    Attributes:
        number: number of values.
        values: x -> list of values.
        forward: (x, dx) -> (values, list of the tangents dy of the floating values).
        reverse: (x, cotangents of dy) -> cotangents of dx.
        slow, slow_reverse: as forward and reverse, in forms that autodiff can differentiate.
    """

    number: int
    values: PyTree
    forward: Callable
    reverse: Callable
    slow: Callable
    slow_reverse: Callable

    def batched(self, axes: list) -> TwoWays:
        """Those of a batch; axes: of x."""
        out = None if all(axis is None for axis in axes) else 0  # of values
        values = self.values if out is None else jax.vmap(self.values, (axes,))
        forward, slow = (jax.vmap(f, (axes, 0), (out, 0)) for f in (self.forward, self.slow))
        reverse, slow_reverse = (jax.vmap(f, (axes, 0)) for f in (self.reverse, self.slow_reverse))
        return TwoWays(self.number, values, forward, reverse, slow, slow_reverse)


def derivative(ways: TwoWays, x: list, dx: list):
    """The values of a function and their tangents, in forward or reverse mode.

    Args:
        ways: a `TwoWays`.
        x: a list of arrays.
        dx: a list of floating arrays: tangents of the entries of x that have one.

    Returns:
        The lists of values and of tangents.

    Raises:
        whatever the function raises.

    >>> ways = TwoWays(1, lambda x: [x[0] ** 2], lambda x, dx: ([x[0] ** 2], [2 * x[0] * dx[0]]),
    ...                lambda x, dy: [7 * dy[0]], None, None)  # a wrong one, to see it used
    >>> float(jax.grad(lambda dx: derivative(ways, [jnp.array(3.0)], [dx])[1][0])(1.0))
    7.0
    """
    found = both_p.bind(*x, *dx, ways=ways, count=len(x))
    return found[: ways.number], found[ways.number :]


def together(f: Callable, x: list):
    """f(x), a list of arrays. Under vmap all values are batched if any entry of x is, as for `derivative`.

    Args:
        f: a function that does not close over a tracer.
        x: a list of arrays.

    Returns:
        The list of values.

    Raises:
        whatever f raises.

    >>> values = jax.vmap(lambda x: together(lambda x: [x[0], jnp.ones(2)], [x]))(jnp.zeros(3))
    >>> [value.shape for value in values]
    [(3,), (3, 2)]
    """
    return values_p.bind(*x, f=f)


def _divided(args: tuple, count: int):
    return list(args[:count]), list(args[count:])


def both(*args, ways: TwoWays, count: int):
    """The values of a function with two ways to its derivative, and then its tangents."""
    values, dots = ways.forward(*_divided(args, count))
    return [*values, *dots]


def linear(*args, ways: TwoWays, count: int, backwards: bool):
    """Its tangents alone, or, backwards, its cotangents: what is linear in it."""
    x, given = _divided(args, count)
    return ways.reverse(x, given) if backwards else ways.forward(x, given)[1]


def values(*x: Array, f: Callable):
    """Its values alone."""
    return f(list(x))


def _jvp_by(function, args, dots, **params):
    """Tangents by autodiff of the function."""
    found = jax.jvp(partial(function, **params), args, tuple(map(_instantiated, args, dots)))
    return found[0], [no_tangent(x) if x.dtype == jax.dtypes.float0 else x for x in found[1]]


def no_tangent(x: Array):
    """Zero, of a value or of a tangent."""
    dtype = x.dtype if jnp.issubdtype(x.dtype, jnp.inexact) else jax.dtypes.float0
    return ad.Zero(ShapedArray(x.shape, dtype))


def _jvp_of_both(args, dots, ways, count):
    """Of tangents, the same; of x, second derivatives."""
    out = both_p.bind(*args, ways=ways, count=count)
    if all(type(dot) is ad.Zero for dot in dots[:count]):
        moves = map(ad.instantiate_zeros, dots[count:])
        changes = linear_p.bind(*args[:count], *moves, ways=ways, count=count, backwards=False)
        return out, [*(no_tangent(x) for x in out[: ways.number]), *changes]
    return out, _jvp_by(both, args, dots, ways=ways._replace(forward=ways.slow), count=count)[1]


def _jvp_of_linear(args, dots, ways, count, backwards):
    """What changes by the tangents, which can be transposed, and by x."""
    call = partial(linear_p.bind, ways=ways, count=count, backwards=backwards)
    x, given = _divided(args, count)
    changes = []
    if any(type(dot) is not ad.Zero for dot in dots[count:]):
        changes.append(call(*x, *map(ad.instantiate_zeros, dots[count:])))
    if any(type(dot) is not ad.Zero for dot in dots[:count]):
        slow = ways._replace(forward=ways.slow, reverse=ways.slow_reverse)
        moves = list(map(_instantiated, x, dots[:count]))
        by_x = partial(linear, ways=slow, count=count, backwards=backwards)
        changes.append(jax.jvp(lambda *x: by_x(*x, *given), tuple(x), tuple(moves))[1])
    return call(*args), [sum(terms[1:], terms[0]) for terms in zip(*changes, strict=True)]


def _instantiated(x, dot):
    """A tangent; of what is no floating number, that which JAX asks for."""
    if not jnp.issubdtype(jnp.result_type(x), np.inexact):
        return np.zeros(np.shape(x), jax.dtypes.float0)
    return ad.instantiate_zeros(dot)


def _transpose(cotangents: list, *args, ways: TwoWays, count: int, backwards: bool):
    given = map(ad.instantiate_zeros, cotangents)
    found = linear_p.bind(*args[:count], *given, ways=ways, count=count, backwards=not backwards)
    return [None] * count + found


def _batch(primitive, args: tuple, axes: tuple, ways: TwoWays, count: int, **params: PyTree):
    """Every tangent gets the batch, and all values, if part of x has it."""
    size = batch_size(args, axes)
    given = [in_front(x, axis, size) for x, axis in zip(args[count:], axes[count:], strict=True)]
    ways = ways.batched(list(axes[:count]))
    found = primitive.bind(*args[:count], *given, ways=ways, count=count, **params)
    alone = ways.number if primitive is both_p and all(axis is None for axis in axes[:count]) else 0
    return found, [None] * alone + [0] * (len(found) - alone)


def _batch_values(x: tuple, axes: tuple, f: Callable):
    found = values_p.bind(*x, f=jax.vmap(f, (list(axes),)))
    return found, [0] * len(found)


def _divide(trace, *args, ways: TwoWays, count: int):
    """Into the values, which are known, and what is linear in tangents that are not."""
    known = [arg.pval.get_known() for arg in args]
    if all(x is not None for x in known) or any(x is None for x in known[:count]):
        return trace.default_process_primitive(both_p, args, {"ways": ways, "count": count})
    values = together(ways.values, known[:count])
    params = {"ways": ways, "count": count, "backwards": False}
    return [*values, *trace.default_process_primitive(linear_p, args, params)]


def _divide_equation(saveable, unknown, instantiated, eqn):
    """The same of an equation, which may be evaluated again."""
    count, results = eqn.params["count"], len(eqn.outvars)
    needed = [x for x, is_there in zip(eqn.invars, instantiated, strict=True) if isinstance(x, Var) and not is_there]
    if not any(unknown):
        return eqn, None, [False] * results, [False] * results, []
    if any(unknown[:count]):
        return None, eqn, [True] * results, [True] * results, needed
    ways, number = eqn.params["ways"], eqn.params["ways"].number
    x, values = eqn.invars[:count], eqn.outvars[:number]
    first = eqn.replace(primitive=values_p, invars=x, outvars=values, params={"f": ways.values})
    second = eqn.replace(primitive=linear_p, outvars=eqn.outvars[number:], params=eqn.params | {"backwards": False})
    told = [False] * number + [True] * (results - number)
    return first, second, told, told, needed


def _primitive(name: str, run: Callable, batch: Callable):
    primitive = Primitive(name)
    primitive.multiple_results = True
    primitive.def_impl(run)
    primitive.def_abstract_eval(partial(_shapes, run))
    batching.primitive_batchers[primitive] = batch
    mlir.register_lowering(primitive, mlir.lower_fun(run, multiple_results=True))
    return primitive


def _shapes(run: Callable, *args, **params: PyTree):
    return [ShapedArray(x.shape, x.dtype) for x in jax.eval_shape(partial(run, **params), *args)]


values_p = _primitive("hhtjax_values", values, _batch_values)
linear_p = _primitive("hhtjax_linear", linear, lambda *args, **params: _batch(linear_p, *args, **params))
both_p = _primitive("hhtjax_both", both, lambda *args, **params: _batch(both_p, *args, **params))
ad.primitive_jvps[values_p] = partial(_jvp_by, values)
ad.primitive_jvps[both_p] = _jvp_of_both
ad.primitive_jvps[linear_p] = _jvp_of_linear
ad.primitive_transposes[linear_p] = _transpose
pe.custom_partial_eval_rules[both_p] = _divide
pe.partial_eval_jaxpr_custom_rules[both_p] = _divide_equation


# ----------------------------------------------------------------------------
# What of JAX's transformations is at work where a function runs.


KNOWN = "EvalTrace", "DynamicJaxprTrace"  # without any, and inside a jit
IN_PROGRAMS = (
    "DynamicJaxprTrace",
    "LinearizeTrace",
    "JaxprTrace",
)  # of a jit, and of reverse mode, old or new


def is_untouched() -> bool:
    """Whether this code runs outside derivatives and batches. A jit around it may still be differentiated later.

    Args:
        None.

    Returns:
        A Boolean, known while a function is being traced; False with a JAX whose tracers are not known here.

    Raises:
        Nothing.

    >>> import jax
    >>> seen, x = [], jax.numpy.ones(())
    >>> for change in (lambda f: f, jax.jit, jax.grad, lambda f: jax.jit(jax.grad(f)), lambda f: jax.grad(jax.jit(f))):
    ...     _ = change(lambda x: seen.append(is_untouched()) or x)(x)
    >>> seen
    [True, True, False, False, True]
    """
    return type(_here.bind()).__name__ in KNOWN


def is_traced() -> bool:
    """Whether this code is being traced: for a program, a derivative or a batch. It takes less than a microsecond.

    Args:
        None.

    Returns:
        A Boolean, known while a function is being traced; True with a JAX whose tracers are not known here.

    Raises:
        Nothing.

    >>> import jax
    >>> seen = []
    >>> for change in (lambda f: f, jax.jit, jax.grad):
    ...     _ = change(lambda x: seen.append(is_traced()) or x)(1.0)
    >>> seen
    [False, True, True]
    """
    return type(_here.bind()).__name__ != KNOWN[0]


def batch_size(args: tuple, axes: tuple) -> int:
    """Number of the members of a batch. axes: of the arguments, None where all members share one."""
    return next(x.shape[axis] for x, axis in zip(args, axes, strict=True) if axis is not None)


def in_front(x: Array, axis: int | None, size: int) -> Array:
    """An argument with the axis of the members in front, repeated where they share it."""
    return jnp.broadcast_to(x, (size, *jnp.shape(x))) if axis is None else jnp.moveaxis(x, axis, 0)


def is_in_batch() -> bool:
    """Whether this code runs inside vmap, as far as JAX shows it. A jit around it may still be batched later.

    Args:
        None.

    Returns:
        A Boolean, known while a function is being traced.

    Raises:
        Nothing.

    >>> import jax
    >>> seen, x = [], jax.numpy.ones(1)
    >>> for change in (jax.jit, jax.vmap, lambda f: jax.jit(jax.vmap(jax.grad(f)))):
    ...     _ = change(lambda x: seen.append(is_in_batch()) or x.sum())(x)
    >>> seen
    [False, True, True]
    """
    trace = _here.bind()
    while trace is not None and type(trace).__name__ != "BatchTrace":
        trace = getattr(trace, "parent_trace", None)
    return trace is not None


def is_in_program() -> bool:
    """Whether a function called here becomes part of a larger program: inside jit or reverse mode.

    A jit called there must not have compiler options. In reverse mode JAX raises its error only after it has compiled
    and run the forward part with them.

    >>> import jax
    >>> seen, x = [], jax.numpy.ones(1)
    >>> for change in (jax.vmap, jax.jacfwd, jax.jit, jax.grad, lambda f: jax.vmap(jax.grad(lambda x: f(x[None])))):
    ...     _ = change(lambda x: seen.append(is_in_program()) or x.sum())(x)
    >>> seen
    [False, False, True, True, True]
    """
    trace = _here.bind()
    while trace is not None and type(trace).__name__ not in IN_PROGRAMS:
        trace = getattr(trace, "parent_trace", None)
    return trace is not None


def forward_only(x: Array, words: str) -> Array:
    """The array x. Reverse mode raises an error with the given words, instead of JAX's own error.

    Args:
        x: an array.
        words: text of the error.

    Returns:
        The same array.

    Raises:
        TypeError: in reverse mode.

    >>> import jax
    >>> f = lambda x: forward_only(2 * x, "no reverse derivative")
    >>> float(jax.jvp(f, (1.0,), (1.0,))[1])
    2.0
    >>> try:
    ...     jax.grad(f)(1.0)
    ... except TypeError as error:
    ...     print(error)
    no reverse derivative
    """
    return forward_only_p.bind(x, words=words)


def _refuse(cotangent: Array, x, words: str):
    raise TypeError(words)


forward_only_p = Primitive("hhtjax_forward_only")
forward_only_p.def_impl(lambda x, words: x)
forward_only_p.def_abstract_eval(lambda x, words: x)
ad.deflinear2(forward_only_p, _refuse)
batching.defvectorized(forward_only_p)
mlir.register_lowering(forward_only_p, lambda ctx, x, words: [x])


class _Here(Primitive):
    """What evaluates it; an older JAX hands over less beside that."""

    def bind_with_trace(self, trace, *_):
        return trace


_here = _Here("hhtjax_here")
