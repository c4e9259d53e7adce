"""Rewrites a jaxpr for a kernel: replaces operations that XLA:CPU's emitter of kernels does not support.

Products of small matrices become sums; large sums become sums of partial sums; scatters of few windows become updates;
sines of float64 numbers become polynomials. Of a function in two forms (`choose`) the one for kernels is taken. All
other operations are copied without being traced again.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from copy import copy
from functools import lru_cache, partial, reduce
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, jaxpr_as_fun
from jax.extend.core.primitives import closed_call_p

from hhtjax.description import Array
from hhtjax.jaxpr.scalar_rules import replaces
from hhtjax.primitives import batching, two_mode_derivative
from hhtjax.primitives.consistent import held_p
from hhtjax.primitives.interpreter import lowered
from hhtjax.primitives.kernel_primitive import of_jaxpr
from hhtjax.primitives.kernels import PART, STAGED
from hhtjax.xla.fit_for_kernel import (
    DTYPES,
    FEW_TERMS,
    LARGEST_SUM,
    REDUCTIONS,
    is_large_reduction,
    is_of_vector,
    lengths,
    verdict,
)
from hhtjax.xla.sines import sines

if TYPE_CHECKING:
    from jax.extend.core import JaxprEqn, Var

MOST_TERMS = 32  # of the sum that a product is written as
MOST_ROWS = 64  # in one of the factors, of the product that is written out; the other may be a batch
EXACT = {np.dtype(x) for x in ("float32", "float64", "int32", "int64", "uint32", "uint64")}
MOST_WINDOWS = 32  # of a scatter; beyond, it takes longer to compile than it is worth
MOST_PLACES = 4096  # for a window, side by side; each of a step's updates may copy all
COMBINED = {"scatter": lambda before, given: given} | {
    f"scatter-{name}": getattr(lax, name) for name in ("add", "sub", "mul", "min", "max")
}
LEAST = 6  # operations of a stage that is a kernel; fewer are one fusion or two anyway
LARGEST = 8192  # numbers of an array; XLA may divide the work on larger ones among threads
IDLE = {"broadcast_in_dim"}  # what a branch may hold that has nothing to do
SINES = {"sin", "cos"}
MANY = 4  # values of a conditional: of fewer, a loop is no better
INSIDE = object()  # what becomes of the question whether a kernel holds it
IDENTITIES = {"hhtjax_structural", "hhtjax_largest_in_batch"}
OURS = {  # operations of this package -> what they do, a function of arrays and parameters
    "hhtjax_row_written": batching.written,
    "hhtjax_in_turn": batching.values,
    "hhtjax_values": two_mode_derivative.values,
    "hhtjax_linear": two_mode_derivative.linear,
    "hhtjax_both": two_mode_derivative.both,
}


def for_kernel(closed: ClosedJaxpr) -> ClosedJaxpr:
    """The closed jaxpr, as a kernel needs it."""
    return with_values_held(_Copier(_in_kernel, sines=True).copied(closed))


def for_list(closed: ClosedJaxpr, stages_are_kernels: bool) -> ClosedJaxpr:
    """The closed jaxpr in the form of a list of kernels: stages are computed once, or become kernels; kernels stay."""
    return with_values_held(_Copier(partial(_in_list, stages_are_kernels)).copied(closed))


class _Copier:
    """Copies jaxprs, each once: functions that are called often stay one function."""

    def __init__(self, other: Callable, sines: bool = False):
        """other: equation, copier -> the closed jaxpr that takes its place, or None; sines: as polynomials."""
        self.other, self.sines, self.done = other, sines, {}

    def copied(self, closed: ClosedJaxpr) -> ClosedJaxpr:
        if id(closed) not in self.done:
            self.done[id(closed)] = closed, ClosedJaxpr(self.jaxpr(closed.jaxpr), closed.consts)
        return self.done[id(closed)][1]

    def jaxpr(self, jaxpr: Jaxpr) -> Jaxpr:
        if id(jaxpr) not in self.done:
            self.done[id(jaxpr)] = jaxpr, self._jaxpr(jaxpr)
        return self.done[id(jaxpr)][1]

    def _jaxpr(self, jaxpr: Jaxpr) -> Jaxpr:
        new, eqns, given = {}, [], jaxpr.eqns  # what stands for a variable
        if self.sines:
            given, new = _each_sine_once(given)
            given = _with_sines_together(given)

        def read(x: Literal | Var) -> Literal | Var:
            return x if isinstance(x, Literal) else new.get(x, x)

        for eqn in given:
            invars = [read(x) for x in eqn.invars]
            if self.other is _in_kernel:
                if eqn.primitive.name in IDENTITIES:
                    new[eqn.outvars[0]] = invars[0]
                    continue
                if eqn.primitive.name == "hhtjax_inside" or (
                    invars and invars[0] is INSIDE and eqn.primitive.name != "cond"
                ):  # the answer, and the same as an integer
                    new[eqn.outvars[0]] = INSIDE
                    continue
            eqn = eqn.replace(invars=invars)
            other = self.other(eqn, self)
            if other is None:
                eqns.append(self._with_copies(eqn))
            else:
                invars = invars[1:] if invars and invars[0] is INSIDE else invars
                params = {"call_jaxpr": other}
                eqns.append(eqn.replace(primitive=closed_call_p, invars=invars, params=params, effects=other.effects))
        return jaxpr.replace(eqns=eqns, outvars=[read(x) for x in jaxpr.outvars])

    def _with_copies(self, eqn: JaxprEqn) -> JaxprEqn:
        """The equation with copies of the jaxprs in it."""

        def copied(x):
            if isinstance(x, ClosedJaxpr):
                return self.copied(x)
            return self.jaxpr(x) if isinstance(x, Jaxpr) else x

        if not any(isinstance(x, (ClosedJaxpr, Jaxpr)) for x in jax.tree.leaves(list(eqn.params.values()))):
            return eqn
        return eqn.replace(params={key: jax.tree.map(copied, x) for key, x in eqn.params.items()})


def _is_seldom(eqn: JaxprEqn) -> bool:
    """Whether an operation is a conditional on a Boolean that does nothing if it is false, and returns many values."""
    branches = eqn.params["branches"]
    if len(branches) != 2 or len(eqn.outvars) < MANY:
        return False
    return {x.primitive.name for x in branches[0].jaxpr.eqns} <= IDLE


def _loop_at_most_once(eqn: JaxprEqn, copier) -> ClosedJaxpr:
    """A conditional as a loop of at most one iteration. XLA copies values that a branch returns unchanged, but not
    those that a loop carries."""
    idle, taken = (copier.copied(x) for x in eqn.params["branches"])
    passed = {x: i for i, x in enumerate(idle.jaxpr.outvars) if not isinstance(x, Literal)}
    place = [passed.get(x) for x in idle.jaxpr.invars]

    def run(which: Array, *x: Array):
        def body(carry: tuple):
            given = [x if i is None else carry[1 + i] for x, i in zip(x, place, strict=True)]
            return jnp.array(False), *as_call(taken)(*given)

        return lax.while_loop(lambda carry: carry[0], body, (which != 0, *jaxpr_as_fun(idle)(*x)))[1:]

    return _traced(run, [x.aval for x in eqn.invars])


def _is_named(name: str, eqn: JaxprEqn) -> bool:
    return eqn.primitive.name == "jit" and eqn.params["name"].startswith(name)


_is_staged = partial(_is_named, STAGED)


def _in_list(stages_are_kernels: bool, eqn: JaxprEqn, copier):
    """The replacement of an equation in a list of kernels."""
    if _is_staged(eqn) or (stages_are_kernels and _is_named(PART, eqn)):
        found = _stage_kernel(eqn.params["jaxpr"], LEAST, LARGEST) if stages_are_kernels else None
        if found is not None or _is_staged(eqn):
            return found or computed_once(copier.copied(eqn.params["jaxpr"]))
    return _expanded(eqn, copier)


@of_jaxpr
def _stage_kernel(closed: ClosedJaxpr, least: int, largest: int):
    """A stage as a kernel, if it can be one and is large enough; otherwise None.

    It uses XLA's own sines. Polynomials, many of which a kernel computes at a time, would take longer to compile."""
    form = _Copier(_in_kernel).copied(closed)
    found = verdict(form.jaxpr)
    if found.objection or found.operations < least or any(x.size > largest for x in (*form.in_avals, *form.out_avals)):
        return None
    return jax.make_jaxpr(kernel(form))(*form.in_avals)


def _expanded(eqn: JaxprEqn, copier):
    """An operation of this package written out as a function; None for any other operation."""
    name, params = eqn.primitive.name, eqn.params
    if name in ("hhtjax_family", "hhtjax_bilinear", "hhtjax_map"):
        return copier.copied(params["jaxpr"])
    if name in OURS:
        return copier.copied(_traced(partial(OURS[name], **params), [x.aval for x in eqn.invars]))
    return None


def _in_kernel(eqn: JaxprEqn, copier):
    """The replacement of an equation in a kernel, a closed jaxpr; None if the equation stays."""
    name, params = eqn.primitive.name, eqn.params
    if name == "cond":
        if eqn.invars[0] is INSIDE:
            return copier.copied(params["branches"][1])
        return _loop_at_most_once(eqn, copier) if _is_seldom(eqn) else None
    if name == "hhtjax_kernel":
        return copier.copied(params["closed"])
    if _is_staged(eqn):
        return computed_once(copier.copied(params["jaxpr"]))
    avals = tuple(x.aval for x in eqn.invars)
    if name == "dot_general" and _is_to_write_out(eqn):
        return _product(avals, params["dimension_numbers"])
    if is_large_reduction(eqn):
        return _traced(partial(_reduced, name, axes=params["axes"]), avals)
    if name == "dot_general" and _is_of_long_vectors(eqn):
        return _traced(partial(_product_of_vectors, params["dimension_numbers"]), avals)
    if name in COMBINED and _is_of_few_windows(eqn):
        return _traced(partial(_scattered, COMBINED[name], params["dimension_numbers"]), avals)
    if name == "hhtjax_sines":
        return sines(avals, params["wanted"])
    return _expanded(eqn, copier)


def _traced(f: Callable, avals: Sequence) -> ClosedJaxpr:
    def run(*x: Array) -> Sequence:
        found = f(*x)
        return found if isinstance(found, (list, tuple)) else [found]

    return lowered(jax.make_jaxpr(run)(*avals))


# products


def _is_to_write_out(eqn) -> bool:
    """Of two matrices, or of large arrays, with few terms."""
    terms, *sides = lengths(eqn)
    few = 0 < terms <= MOST_TERMS and min(sides) <= MOST_ROWS
    return few and (min(sides) > 1 or not is_of_vector(eqn)) and _is_of_one_type(eqn)


def _is_of_one_type(eqn) -> bool:
    """Whether factors and result have one dtype, in which sums are exact enough."""
    types = {x.aval.dtype for x in (*eqn.invars, *eqn.outvars)}
    return len(types) == 1 and types <= EXACT


@lru_cache(maxsize=256)
def _product(avals: tuple, dimension_numbers: tuple) -> ClosedJaxpr:
    """A product as a sum over its terms, each a column times a row."""
    (over, batch) = dimension_numbers

    def product(x: Array, y: Array):
        rest = [[i for i in range(z.ndim) if i not in (*o, *b)] for z, o, b in zip((x, y), over, batch, strict=True)]
        shapes = [x.shape[i] for i in batch[0]], [x.shape[i] for i in rest[0]], [y.shape[i] for i in rest[1]]
        x = lax.transpose(x, (*batch[0], *rest[0], *over[0]))
        y = lax.transpose(y, (*batch[1], *rest[1], *over[1]))
        terms = math.prod(x.shape[x.ndim - len(over[0]) :])
        sizes = [math.prod(shape) for shape in shapes]
        x, y = x.reshape(sizes[0], sizes[1], terms), y.reshape(sizes[0], sizes[2], terms)
        found = reduce(lax.add, (x[:, :, None, k] * y[:, None, :, k] for k in range(terms)))
        return found.reshape(*shapes[0], *shapes[1], *shapes[2])

    return computed_once(_traced(product, avals))


def _is_of_long_vectors(eqn) -> bool:
    """A product of vectors, or a batch of them, that is too long a sum."""
    is_long = max(lengths(eqn)[1:]) == 1 and max(x.aval.size for x in eqn.invars) > LARGEST_SUM
    return is_long and _is_of_one_type(eqn)


def _product_of_vectors(dimension_numbers: tuple, x: Array, y: Array) -> Array:
    (over, batch) = dimension_numbers
    aligned = []
    for z, o, b in zip((x, y), over, batch, strict=True):
        rest = [i for i in range(z.ndim) if i not in (*o, *b)]  # of length 1
        aligned.append(lax.transpose(z, (*o, *b, *rest)).reshape([z.shape[i] for i in (*o, *b)]))
    found = _reduced("reduce_sum", aligned[0] * aligned[1], tuple(range(len(over[0]))))
    return found.reshape(*found.shape, *(1,) * (x.ndim + y.ndim - sum(z.ndim for z in aligned)))


def _reduced(name: str, x: Array, axes: tuple) -> Array:
    """A reduction of a large array: halves are combined until it is small, or until the few remaining terms can be
    written out."""
    combine, reduction = REDUCTIONS[name]
    rest = [i for i in range(x.ndim) if i not in axes]
    x = lax.transpose(x, (*axes, *rest)).reshape(-1, *(x.shape[i] for i in rest))
    while x.size > LARGEST_SUM and len(x) > FEW_TERMS:
        half = len(x) // 2
        x = jnp.concatenate([combine(x[:half], x[half : 2 * half]), x[2 * half :]])
    return reduction(x, axis=0) if x.size <= LARGEST_SUM else reduce(combine, list(x))


# scatters


def _is_of_few_windows(eqn):
    """Of few windows, in a small array, none of a batch with places of its own."""
    dims = eqn.params["dimension_numbers"]
    x, indices, updates = (z.aval for z in eqn.invars)
    number = math.prod(indices.shape[:-1])
    usual = not getattr(dims, "operand_batching_dims", ()) and number and 0 not in updates.shape
    sizes = updates.size // max(number, 1)
    clips = eqn.params["mode"] == lax.GatherScatterMode.CLIP
    usual = usual and (eqn.primitive.name != "scatter" or replaces(eqn.params["update_jaxpr"]))
    return usual and not clips and number <= MOST_WINDOWS and x.size <= MOST_PLACES * sizes


def _scattered(combine: Callable, dims, x: Array, indices: Array, updates: Array) -> Array:
    """A slice, an operation and an update for each window."""
    windows = [i for i in range(updates.ndim) if i not in dims.update_window_dims]
    lengths = iter(updates.shape[i] for i in dims.update_window_dims)
    sizes = [1 if i in dims.inserted_window_dims else next(lengths) for i in range(x.ndim)]
    for which in np.ndindex(indices.shape[:-1]):
        at = lax.reshape(
            lax.slice(indices, (*which, 0), (*(i + 1 for i in which), indices.shape[-1])), (indices.shape[-1],)
        )
        start = [jnp.zeros((), indices.dtype)] * x.ndim
        for number, axis in enumerate(dims.scatter_dims_to_operand_dims):
            start[axis] = at[number]
        fixed = dict(zip(windows, which, strict=True))
        low = [fixed.get(i, 0) for i in range(updates.ndim)]
        high = [fixed[i] + 1 if i in fixed else n for i, n in enumerate(updates.shape)]
        given = lax.reshape(lax.slice(updates, low, high), sizes)
        before = lax.dynamic_slice(x, start, sizes)
        known = [
            (start[axis] >= 0) & (start[axis] <= x.shape[axis] - sizes[axis])
            for axis in dims.scatter_dims_to_operand_dims
        ]
        new = combine(before, given)
        inside = reduce(lax.bitwise_and, known) if known else None  # a slice would move it there, a scatter drops it
        new = new if inside is None else jnp.where(inside, new, before)
        x = lax.dynamic_update_slice(x, new, start)
    return x


# sines


def _each_sine_once(eqns: list):
    """The equations without repeated sines and cosines of the same number, and the variables that replace these. XLA
    does not recognise repeated sines, because they are calls."""
    if sum(eqn.primitive.name in SINES for eqn in eqns) < 2:
        return eqns, {}
    made, same, known, instead = [], {}, {}, {}  # variable -> the first one of its value; what makes it -> variables
    for eqn in eqns:
        operands = tuple((str(x), x.aval) if isinstance(x, Literal) else same.get(x, x) for x in eqn.invars)
        try:
            found = known.setdefault((eqn.primitive, operands, tuple(eqn.params.items())), eqn.outvars)
        except TypeError:  # parameters that nothing is known of
            found = eqn.outvars
        if found is not eqn.outvars and not eqn.effects:
            same.update(zip(eqn.outvars, found, strict=True))
            if eqn.primitive.name in SINES:
                instead[eqn.outvars[0]] = found[0]
                continue
        made.append(eqn)
    return made, instead


def _with_sines_together(eqns: list):
    """The equations, with one for all sines and cosines of float64 numbers that can be computed together."""
    made, group, since = [], [], set()

    def end():
        if group:
            operands = list(dict.fromkeys(x.invars[0] for x in group if not isinstance(x.invars[0], Literal)))
            wanted = tuple((x.primitive.name, operands.index(x.invars[0])) for x in group)
            made[made.index(None)] = group[0].replace(
                primitive=_SINES, invars=operands, outvars=[x.outvars[0] for x in group], params={"wanted": wanted}
            )
        group.clear()
        since.clear()

    for eqn in eqns:
        if eqn.primitive.name in SINES and _is_sine(eqn):
            x = eqn.invars[0]
            if group and (x.aval.shape != group[0].invars[0].aval.shape or x in since):
                end()
            if not group:
                made.append(None)
            group.append(eqn)
        else:
            made.append(eqn)
        if group:
            since.update(eqn.outvars)
    end()
    return made


def _is_sine(eqn) -> bool:
    x = eqn.invars[0]
    return not isinstance(x, Literal) and x.aval.dtype == np.float64 and eqn.params.get("accuracy") is None


class _Name:
    name = "hhtjax_sines"


_SINES = _Name()


# ----------------------------------------------------------------------------
# Values of a kernel that several operations use, computed once.
#
# XLA:CPU fuses an operation into all that use it, and evaluates for each of them anew all that it comes from: of the
# 14,000 operations of a spinning top's gradient it makes 37,000, and LLVM compiles them all. Across a call it fuses
# nothing. So what is much to evaluate, and used by several, is handed on by a call that gives it as it is.


ONCE = "hhtjax_once"  # name of a function that XLA computes once
LEAST_HELD = 40  # operations that are evaluated once more without a call; of fewer, nothing is gained
CALLS = {"jit", "closed_call", "eval_jaxpr", "custom_jvp_call", "custom_vjp_call", "remat2"}
LOOPS = {"cond", "while", "scan", "custom_linear_solve"}
MADE_ONCE = LOOPS | {"dot_general", "hhtjax_held"}  # by XLA in any case
BROADCAST = "broadcast_in_dim"  # handed on before it is one
FREE = {BROADCAST, "convert_element_type", "reshape", "slice", "transpose", "squeeze", "expand_dims", "copy", "split"}


def with_values_held(closed: ClosedJaxpr) -> ClosedJaxpr:
    """The closed jaxpr, in which such values are handed on by calls."""
    return ClosedJaxpr(_Holder().held(closed.jaxpr)[0], closed.consts)


class _Holder:
    """Of a jaxpr and of all within it, each once."""

    def __init__(self):
        self.done = {}  # id of a jaxpr: (it, what has become of it, costs of its results, uses of its arguments)

    def held(self, jaxpr: Jaxpr):
        if id(jaxpr) not in self.done:
            self.done[id(jaxpr)] = jaxpr, *self._held(jaxpr)
        return self.done[id(jaxpr)][1:]

    def _held(self, jaxpr: Jaxpr):
        eqns = [self._inside(eqn) for eqn in jaxpr.eqns]
        uses = {}
        for eqn, _, inner_uses in eqns:
            for i, x in enumerate(eqn.invars):
                if not isinstance(x, Literal):
                    uses[x] = uses.get(x, 0) + (inner_uses[i] if inner_uses else 1)
        for x in jaxpr.outvars:
            if not isinstance(x, Literal):
                uses[x] = uses.get(x, 0) + 1
        new, cost, made = {}, {}, []
        for eqn, costs, _ in eqns:
            if new:
                eqn = eqn.replace(invars=[x if isinstance(x, Literal) else new.get(x, x) for x in eqn.invars])
            name = eqn.primitive.name
            before = sum(cost.get(x, 0) for x in {x for x in eqn.invars if not isinstance(x, Literal)})
            made.append(eqn)
            for i, x in enumerate(eqn.outvars):
                own = 0 if name in MADE_ONCE or costs == "once" else costs[i] if costs else name not in FREE
                taken = 0 if name in MADE_ONCE or costs == "once" else before + own
                if taken and name != BROADCAST and taken * (uses.get(x, 0) - 1) >= LEAST_HELD:
                    made.append(_handed_on(eqn, x, new))
                    taken = 0
                    cost[new[x]] = 0
                cost[x] = taken
        outvars = [x if isinstance(x, Literal) else new.get(x, x) for x in jaxpr.outvars]
        after = jaxpr.replace(eqns=made, outvars=outvars)
        return (
            after,
            [0 if isinstance(x, Literal) else cost.get(x, 0) for x in outvars],
            [uses.get(x, 0) for x in jaxpr.invars],
        )

    def _inside(self, eqn: JaxprEqn):
        """The equation with what is inside done, costs of its results as a call, uses of its arguments."""
        name = eqn.primitive.name
        if name not in CALLS and name not in LOOPS:
            return eqn, None, None
        told = []

        def inner(x):
            if isinstance(x, ClosedJaxpr):
                after, *more = self.held(x.jaxpr)
                told.append(more)
                return ClosedJaxpr(after, x.consts)
            if isinstance(x, Jaxpr):
                after, *more = self.held(x)
                told.append(more)
                return after
            return x

        eqn = eqn.replace(params={key: jax.tree.map(inner, x) for key, x in eqn.params.items()})
        if name in LOOPS:
            return eqn, None, None
        if eqn.params.get("name") == ONCE:
            return eqn, "once", None
        return eqn, *told[0]


def _handed_on(eqn: JaxprEqn, x: Var, new: dict) -> JaxprEqn:
    """An equation that gives x by another name."""
    other = new[x] = copy(x)  # a variable is known by its identity
    return eqn.replace(primitive=held_p, invars=[x], outvars=[other], params={}, effects=frozenset(), ctx=eqn.ctx)


# ----------------------------------------------------------------------------
# Calls that bear attributes for XLA:CPU: what is called is compiled into one kernel, or computed once.


def kernel(form: ClosedJaxpr):
    """The function of a closed jaxpr as one kernel.

    XLA aborts if a parameter of a kernel is unused, or becomes unused when a constant replaces it. So the kernel also
    returns a number that depends on an element of each parameter, and the values are hidden from XLA."""
    call = _one_call(form, lambda _, args: _of_each(args), inlineable="false", xla_cpu_small_call="true")
    return lambda *args: call(*lax.optimization_barrier(args))


def as_call(closed: ClosedJaxpr) -> Callable:
    """The function of a closed jaxpr as a single call. `jaxpr_as_fun` would trace every operation in it again.

    The call is traced with zeros as results, which are then replaced by the jaxpr."""
    if any(x.dtype not in DTYPES for x in closed.out_avals):  # no zeros of keys
        return jaxpr_as_fun(closed)

    def body(*_: Array):
        return [lax.full(x.shape, 0, x.dtype) for x in closed.out_avals]

    around = jax.make_jaxpr(jax.jit(body, keep_unused=True))(*closed.in_avals)
    (call,) = around.jaxpr.eqns
    held = ClosedJaxpr(closed.jaxpr, closed.consts)  # another one: what `of_jaxpr` knows ends with the jaxpr it is of
    call = call.replace(params=call.params | {"jaxpr": held}, effects=closed.effects)
    return jaxpr_as_fun(ClosedJaxpr(around.jaxpr.replace(eqns=[call], effects=closed.effects), around.consts))


def _one_call(closed: ClosedJaxpr, more: Callable, name: str = "kernel", **attributes: str):
    """The function of a closed jaxpr as a call with these attributes. more(results, arguments): additional results of
    the call, which only XLA needs.

    Results that are arguments do not pass through the call, because XLA:CPU may store a parameter that a call returns
    in the place of another number."""
    given = _passed_by(closed.jaxpr)

    def body(*args: Array):
        found = [x for i, x in enumerate(as_call(closed)(*args)) if i not in given]
        return [*found, *more(found, args)]

    body.__name__ = name
    call = jax.jit(body, keep_unused=True)

    def bearing(*args: Array):
        first, *rest = call(*args)
        found = iter([set_xla_metadata(first, **attributes), *rest])  # it finds what made the value
        return [args[given[i]] if i in given else next(found) for i in range(len(closed.out_avals))]

    return bearing


def _passed_by(jaxpr: Jaxpr) -> dict:
    """The number of a result that is an argument -> the number of that."""
    results = enumerate(jaxpr.outvars)
    return {i: jaxpr.invars.index(x) for i, x in results if not isinstance(x, Literal) and x in jaxpr.invars}


def _of_each(values: tuple):
    """A sum of one element of each value, and the values that cannot be added. Returning each would take a buffer."""
    terms, rest = [], []
    for x in values:
        if x.size and x.dtype in DTYPES:
            terms.append(_first(x).reshape(()).astype(np.float32))
        else:
            rest.append(x)
    return [*([reduce(jnp.add, terms)] if terms else []), *rest]


def _first(x: Array) -> Array:
    """An element, with as many axes."""
    return lax.slice(x, [0] * x.ndim, [1] * x.ndim)


@of_jaxpr
def computed_once(closed: ClosedJaxpr) -> ClosedJaxpr:
    """The closed jaxpr as a call that XLA does not inline, and so computes once, however many users its values have.

    XLA may divide a call with a single result among threads, and then the kernel does not link. So it gets a second
    one."""
    if len(_passed_by(closed.jaxpr)) == len(closed.out_avals):  # nothing to compute
        return closed

    def second(found: list, args: tuple):
        if len(found) > 1 or found[0].size <= 1:
            return []
        return [_first(next((x for x in args if x.size), found[0]))]  # of what is known before all else

    return jax.make_jaxpr(_one_call(closed, second, ONCE, inlineable="false"))(*closed.in_avals)
