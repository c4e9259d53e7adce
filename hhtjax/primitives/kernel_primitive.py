"""A function that may become one kernel, as one operation of JAX that contains its jaxpr: `kernel_p`.

Autodiff and vmap keep the operation and transform its jaxpr, by JAX's own transformations. So when the program is
lowered, the whole function can be examined, after autodiff and vmap. lowering.py then decides what to do with it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial, wraps
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.custom_batching import custom_vmap
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import ClosedJaxpr, Primitive, Var, jaxpr_as_fun
from jax.extend.linear_util import wrap_init
from jax.interpreters import ad, batching
from jax.interpreters import partial_eval as pe

from hhtjax.description import Array, PyTree
from hhtjax.primitives.interpreter import holds_jaxprs

if TYPE_CHECKING:
    from jax.extend.core import JaxprEqn

kernel_p = holds_jaxprs(Primitive("hhtjax_kernel"))
kernel_p.multiple_results = True


def of_jaxpr(f: Callable):
    """f(closed jaxpr, *args), computed once for each jaxpr that is alive, and hashable args."""
    known = WeakKeyDictionary()

    @wraps(f)
    def remembered(closed: ClosedJaxpr, *args: PyTree) -> PyTree:
        found = known.setdefault(closed, {})
        if args not in found:
            found[args] = f(closed, *args)
        return found[args]

    return remembered


def _seen_moving(x: list, marks: list):
    """The list x; of a derivative that is being made, `marks` gets which of it move."""

    @jax.custom_jvp
    def seen(*x):
        return x

    @partial(seen.defjvp, symbolic_zeros=True)
    def _(x: tuple, dx: tuple):
        marks[:] = [not isinstance(dot, SymbolicZero) for dot in dx]
        return x, dx

    seen(*x)  # for its rule alone: of a list of which nothing moves it would stay, and hold known and unknown together
    return x


def _seen_in_batch(x: list, marks: list):
    """The list x; of a batch that is being made, `marks` gets which of it differ from member to member."""

    @custom_vmap
    def seen(*x: Array):
        return x

    @seen.def_vmap
    def _(size: int, differ: list, *x: Array):
        marks[:] = differ
        return x, tuple(differ)

    seen(*x)
    return x


def _pruned(closed: ClosedJaxpr) -> ClosedJaxpr:
    """The closed jaxpr without what no result is made of."""
    jaxpr, _ = pe.dce_jaxpr(closed.jaxpr, [True] * len(closed.out_avals), instantiate=True)
    return ClosedJaxpr(jaxpr, closed.consts)


def _abstract(*avals, closed: ClosedJaxpr, name: str):
    return closed.out_avals


def _run(*args, closed, name):
    return jaxpr_as_fun(closed)(*args)


# forward mode


@of_jaxpr
def _forward(closed: ClosedJaxpr, moves: tuple):
    """closed and its tangents: arguments, tangents of those that move -> results, tangents of those that then do."""
    moved = [False] * len(closed.out_avals)

    def both(*args: Array):
        static, moving = _parted(args[: len(moves)], moves)

        def f(*moving: Array):
            return _seen_moving(jaxpr_as_fun(closed)(*_merged(static, moving, moves)), moved)

        out, changes = jax.jvp(f, tuple(moving), tuple(args[len(moves) :]))
        return [*out, *_parted(changes, moved)[1]]

    given = [aval.to_tangent_aval() for aval in _parted(closed.in_avals, moves)[1]]
    return _pruned(jax.make_jaxpr(both)(*closed.in_avals, *given)), tuple(moved)


def _parted(values: Sequence, marks: Sequence):
    """Those that are not marked, and those that are."""
    return tuple([x for x, mark in zip(values, marks, strict=True) if mark == which] for which in (False, True))


def _merged(unmarked: Sequence, marked: Sequence, marks: tuple):
    """The inverse of `_parted`."""
    sources = iter(unmarked), iter(marked)
    return [next(sources[bool(mark)]) for mark in marks]


def _jvp(args: tuple, dots: tuple, closed: ClosedJaxpr, name: str):
    moves = tuple(type(dot) is not ad.Zero for dot in dots)
    forward, moved_out = _forward(closed, moves)
    found = kernel_p.bind(*args, *_parted(dots, moves)[1], closed=forward, name=name)
    out, changes = found[: len(moved_out)], iter(found[len(moved_out) :])
    return out, [next(changes) if m else _no_tangent(x) for x, m in zip(closed.out_avals, moved_out, strict=True)]


def _no_tangent(aval):
    return ad.Zero(aval.to_tangent_aval())


# what reverse mode takes apart


@of_jaxpr
def _divided(closed: ClosedJaxpr, unknown: tuple):
    """Into what is known before the arguments that `unknown` marks, and the rest.

    The first gives the known results, and what the rest needs; the rest takes that, and the unknown arguments, and
    gives the other results. told: which results are unknown.
    """
    rest = {}

    def first(*known: Array):
        values = iter(known)
        pvals = [
            pe.PartialVal.unknown(aval) if mark else pe.PartialVal.known(next(values))
            for aval, mark in zip(closed.in_avals, unknown, strict=True)
        ]
        f = wrap_init(jaxpr_as_fun(closed), debug_info=closed.jaxpr.debug_info)
        jaxpr, found, needed = pe.trace_to_jaxpr_nounits(f, pvals, instantiate=False)
        rest["jaxpr"], rest["told"] = jaxpr, tuple(x.get_known() is None for x in found)
        return [*(x.get_known() for x in found if x.get_known() is not None), *needed]

    known = jax.make_jaxpr(first)(*_parted(closed.in_avals, unknown)[0])
    jaxpr = rest["jaxpr"]
    jaxpr = jaxpr.replace(constvars=[], invars=[*jaxpr.constvars, *jaxpr.invars])
    return known, ClosedJaxpr(jaxpr, ()), rest["told"]


def _divide(trace, *args, closed, name):
    tracers = [trace.to_jaxpr_tracer(x) if hasattr(trace, "to_jaxpr_tracer") else x for x in args]
    unknown = tuple(x.pval.get_known() is None for x in tracers)
    if not any(unknown):
        return trace.default_process_primitive(kernel_p, args, {"closed": closed, "name": name})
    first, rest, told = _divided(closed, unknown)
    values = [x.pval.get_known() for x, u in zip(tracers, unknown, strict=True) if not u]
    found = kernel_p.bind(*values, closed=first, name=name)
    number = len(told) - sum(told)
    needed = [trace.new_instantiated_const(x) for x in found[number:]]
    moving = [x for x, u in zip(tracers, unknown, strict=True) if u]
    others = []
    if any(told):
        others = trace.default_process_primitive(kernel_p, [*needed, *moving], {"closed": rest, "name": name})
    return _merged(found[:number], others, told)


@of_jaxpr
def _without(closed: ClosedJaxpr, wanted: tuple):
    """closed with the wanted results only, of the arguments that these need: and which these are."""
    jaxpr, used = pe.dce_jaxpr(closed.jaxpr, list(wanted))
    return ClosedJaxpr(jaxpr, closed.consts), tuple(used)


def _divide_equation(saveable, unknown, instantiated, eqn):
    """The same of an equation that may be evaluated again: the known results at once, the others from all arguments."""
    needed = [x for x, there in zip(eqn.invars, instantiated, strict=True) if isinstance(x, Var) and not there]
    if not any(unknown):
        return eqn, None, [False] * len(eqn.outvars), [False] * len(eqn.outvars), []
    _, _, told = _divided(eqn.params["closed"], tuple(unknown))
    known = None if all(told) else _eliminated([not x for x in told], eqn)[1]
    rest = _eliminated(list(told), eqn)[1] if any(told) else None
    return known, rest, list(told), list(told), needed


def _eliminated(used: list, eqn: JaxprEqn):
    """Of an equation whose results are not all used: which arguments it still needs, and what is left of it."""
    if not any(used):
        return [False] * len(eqn.invars), None
    closed, needed = _without(eqn.params["closed"], tuple(used))
    return list(needed), eqn.replace(
        invars=_parted(eqn.invars, needed)[1],
        outvars=_parted(eqn.outvars, used)[1],
        params=eqn.params | {"closed": closed},
    )


# transposition


@of_jaxpr
def _transposed(closed: ClosedJaxpr, linear: tuple, given: tuple) -> ClosedJaxpr:
    """Arguments that are not linear, cotangents of the results that have one -> cotangents of the linear ones."""
    out_avals = closed.out_avals

    def transpose(*args: Array):
        number = len(linear) - sum(linear)
        known, cotangents = args[:number], iter(args[number:])

        def f(*moving: Array):
            return jaxpr_as_fun(closed)(*_merged(known, moving, linear))

        full = [next(cotangents) if g else jnp.zeros(x.shape, x.dtype) for g, x in zip(given, out_avals, strict=True)]
        back = jax.linear_transpose(f, *_parted(closed.in_avals, linear)[1])
        return back(full)

    parts = _parted(closed.in_avals, linear)[0], _parted(out_avals, given)[1]
    return jax.make_jaxpr(transpose)(*parts[0], *parts[1])


def _transpose(cotangents: list, *args, closed: ClosedJaxpr, name: str):
    linear = tuple(map(ad.is_undefined_primal, args))
    given = tuple(type(ct) is not ad.Zero for ct in cotangents)
    back = _transposed(closed, linear, given)
    found = iter(kernel_p.bind(*_parted(args, linear)[0], *_parted(cotangents, given)[1], closed=back, name=name))
    return [next(found) if mark else None for mark in linear]


# batches


@of_jaxpr
def _batched(closed: ClosedJaxpr, axes: tuple, size: int, axis_name: str):
    """Of a batch whose members stand along these axes: the jaxpr, and which results have one, in front."""
    marks = [False] * len(closed.out_avals)

    def member(*x: Array):
        return _seen_in_batch(jaxpr_as_fun(closed)(*x), marks)

    def batch(*x: Array):
        found = jax.vmap(member, in_axes=axes, axis_size=size, axis_name=axis_name)(*x)
        marks[:] = [mark or not size for mark in marks]  # nobody has what members would share
        return [x if mark else x[0] for x, mark in zip(found, marks, strict=True)]

    avals = [
        x if axis is None else ShapedArray((*x.shape[:axis], size, *x.shape[axis:]), x.dtype, x.weak_type)
        for x, axis in zip(closed.in_avals, axes, strict=True)
    ]
    return _pruned(jax.make_jaxpr(batch)(*avals)), [0 if mark else None for mark in marks]


def _batch(data: PyTree, args: tuple, axes: tuple, closed: ClosedJaxpr, name: str):
    axes = tuple(None if axis is None else int(axis) for axis in axes)
    batched, out = _batched(closed, axes, data.size, data.name)
    return kernel_p.bind(*args, closed=batched, name=name), out


kernel_p.def_abstract_eval(_abstract)
kernel_p.def_impl(lambda *args, closed, name: jax.jit(jaxpr_as_fun(closed))(*args))
ad.primitive_jvps[kernel_p] = _jvp
ad.primitive_transposes[kernel_p] = _transpose
batching.fancy_primitive_batchers[kernel_p] = _batch
pe.custom_partial_eval_rules[kernel_p] = _divide
pe.partial_eval_jaxpr_custom_rules[kernel_p] = _divide_equation
pe.dce_rules[kernel_p] = lambda used, *more: _eliminated(list(used), more[-1])  # a newer JAX tells more
