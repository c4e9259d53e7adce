"""Small arrays as scalars: functions of vectors of a few numbers are evaluated number by number.

XLA:CPU runs a loop over each small array, with a branch for every part of a concatenation. Under vmap the coordinates
of one member are next to each other in memory, so that vector instructions cannot be used. Both problems disappear if a
traced function is evaluated again with scalars instead of small arrays. Then moving numbers costs nothing, products
with the zeros and ones of unit vectors disappear, and a batch of each scalar is one contiguous array.

This happens before vmap and autodiff, which then see scalars. An operation without a rule here runs on whole arrays.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import Literal

from hhtjax.description import Array, PyTree, Real
from hhtjax.jaxpr.listing import FUNCTIONS
from hhtjax.jaxpr.scalar_rules import (
    ELEMENTWISE,
    RULES,
    arranged,
    as_scalar,
    each,
    is_in_pieces,
    is_known,
    is_small,
    is_understood,
    pieces,
    whole,
)
from hhtjax.primitives.batching import in_turn
from hhtjax.primitives.compat import is_on
from hhtjax.primitives.interpreter import alone, evaluate, needed
from hhtjax.primitives.kernels import STAGED, named

if TYPE_CHECKING:
    from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn

MOST_OPERATIONS = 2000  # on scalars: the gradient of more is no kernel any more
MOST_IN_VALUES = 2500  # where nobody asks for derivatives; of more compiling takes longer than it saves


@partial(jax.tree_util.register_dataclass, data_fields=["elements"], meta_fields=["shape"])
@dataclass(frozen=True)
class Scalars:
    """An array as its elements, each a scalar, or stacked along axes that come before those of `shape`."""

    elements: tuple
    shape: tuple


def pays(f: Callable, *args: PyTree, derivatives: bool = True) -> bool:
    """Whether f of these trees is faster on scalars: few operations, all with rules, on more than one number.

    Operations without a rule may prevent XLA from making one kernel of a loop. Without that kernel, scalars are slower.
    """
    if jax.default_backend() != "cpu" or not is_on():
        return False
    if all(jnp.size(x) == 1 for x in jax.tree.leaves(args)):
        return False
    return _work(_traced(f, *args)[0].jaxpr) <= (MOST_OPERATIONS if derivatives else MOST_IN_VALUES)


def _traced(f: Callable, *args: PyTree):
    """The closed jaxpr of f of trees, of `Scalars` too, and what it returns, in shapes. JAX traces a function once."""

    def like(x: Array | Scalars):
        return jax.ShapeDtypeStruct(x.shape if _is_scalars(x) else jnp.shape(x), _dtype(x))

    return jax.make_jaxpr(f, return_shape=True)(*jax.tree.map(like, args, is_leaf=_is_scalars))


def _work(jaxpr):
    """Number of operations on scalars; infinite if one has no rule. Operations that only move numbers do not count."""
    total = 0
    for eqn in jaxpr.eqns:
        name = eqn.primitive.name
        if name not in RULES and name not in CALLS:
            return math.inf
        if name in ELEMENTWISE:
            total += eqn.outvars[0].aval.size
        elif name == "dot_general":
            over, _ = eqn.params["dimension_numbers"]
            total += eqn.outvars[0].aval.size * math.prod(eqn.invars[0].aval.shape[i] for i in over[0])
        elif name.startswith("reduce_"):
            total += eqn.invars[0].aval.size
        else:
            closed = [x for x in jax.tree.leaves(list(eqn.params.values())) if hasattr(x, "eqns")]
            total += sum(_work(x) for x in closed)
    return total


def split(tree: PyTree):
    """The tree with `Scalars` for its small arrays."""
    return jax.tree.map(lambda x: Scalars(tuple(pieces(x).flat), x.shape) if x.ndim and is_small(x) else x, tree)


class Form(NamedTuple):
    """How functions of a tree are evaluated. tree: with `Scalars` for its small arrays, or as it was; `of` gives the
    form of a function, `like` that of another such tree, and `joined` arrays again."""

    tree: PyTree
    is_split: bool = False

    def of(self, f: Callable):
        """f of such trees, to such trees."""
        return by_scalars(f)

    def like(self, tree: PyTree) -> PyTree:
        """Another tree of the same arrays, in this form."""
        return split(tree) if self.is_split else tree

    def joined(self, tree: PyTree):
        """Any such tree as arrays; what its scalars are stacked along comes first."""
        return join(tree)


def on_scalars(f: Callable, tree: PyTree, derivatives: bool = True) -> Form:
    """The form in which f(tree) is evaluated faster: on scalars or on arrays.

    Args:
        f: a function of the tree.
        tree: a pytree of arrays.
        derivatives: whether derivatives may be taken.

    Returns:
        A `Form`. Evaluate `form.of(f)`, or other functions of the tree, with its `tree`; `joined` converts the results
        to arrays.

    Raises:
        whatever f raises.

    >>> form = on_scalars(jnp.sin, jnp.ones(2))
    >>> bool(jnp.all(form.joined(form.of(jnp.sin)(form.tree)) == jnp.sin(1.0)))
    True
    """
    form = Form(tree, pays(f, tree, derivatives=derivatives))
    return form._replace(tree=form.like(tree))


def join(tree: PyTree):
    """The tree with arrays for its `Scalars`; what they are stacked along comes first."""

    def joined(x):
        if not _is_scalars(x):
            return x
        array = jnp.stack(x.elements, axis=-1)
        return array.reshape(*array.shape[:-1], *x.shape)

    return jax.tree.map(joined, tree, is_leaf=_is_scalars)


def by_scalars(f: Callable):
    """f of trees that `split` made, to such trees; f itself of trees it left alone."""

    def g(*args: PyTree) -> PyTree:
        leaves = jax.tree.leaves(args, is_leaf=_is_scalars)
        if not any(map(_is_scalars, leaves)):
            return f(*args)
        trace, like = _traced(f, *args)
        values = [arranged(x.elements, x.shape) if _is_scalars(x) else pieces(x) for x in leaves]
        with np.errstate(all="ignore"):
            values = _run(trace, values)
        leaves, structure = jax.tree.flatten(like)
        return structure.unflatten(map(_as_scalars, values, leaves))

    return g


def _is_scalars(x: PyTree) -> bool:
    return isinstance(x, Scalars)


def _dtype(x):
    return jnp.result_type(x.elements[0] if _is_scalars(x) else x)


def _as_scalars(value: np.ndarray, like: PyTree):
    if not is_in_pieces(value):
        return value
    elements = tuple(as_scalar(x, like.dtype) for x in value.flat)
    return Scalars(elements, like.shape) if like.shape else elements[0]


def _run(closed: ClosedJaxpr, values):
    """The values of the results of a closed jaxpr."""
    return evaluate(closed.jaxpr, [*map(pieces, closed.consts), *values], _apply, lambda x: pieces(np.asarray(x)))


def _apply(eqn: JaxprEqn, values: list):
    """The results of one operation."""
    name = eqn.primitive.name
    results = None
    if not is_understood(eqn):
        pass
    elif name in CALLS:
        results = CALLS[name](_run, eqn, *values)
    elif name in RULES and all(map(is_in_pieces, values)) and all(is_small(x.aval) for x in eqn.outvars):
        results = RULES[name](eqn, *values)
    if results is None:
        arrays = [whole(value, x.aval) for value, x in zip(values, eqn.invars, strict=True)]
        results = map(pieces, alone(eqn)(*arrays))
    return results


# ----------------------------------------------------------------------------
# A function of scalars in stages: the operands of its sines, the sines, and the rest.
#
# XLA:CPU fuses an operation with all that it comes from, anew for each of its users: for the sine of a difference, its
# cosine, and each column of a derivative that takes them, the difference is formed and the sine called again. What a
# staged call gives is computed once; and from a sine and a cosine of the same number, next to each other, LLVM makes
# one call.


class _Stage(NamedTuple):
    """Part of a jaxpr."""

    invars: Any
    eqns: Any
    outvars: Any
    constvars: Any = ()


def in_stages(name: str, f: Callable, *args: Array):
    """f(*args), as calls of functions of this name."""
    closed = jax.make_jaxpr(f)(*args)
    eqns, results = _each_once(closed.jaxpr)
    known = dict(zip([*closed.jaxpr.constvars, *closed.jaxpr.invars], [*closed.consts, *args], strict=True))
    for wanted in [*_layers(eqns), results]:
        stage = _stage(eqns, known, wanted)
        call = named(name, lambda *x, stage=stage: evaluate(stage, x, lambda eqn, x: alone(eqn)(*x)))
        known.update(zip(stage.outvars, call(*(known[x] for x in stage.invars)), strict=True))
    return [jnp.asarray(x.val) if isinstance(x, Literal) else known[x] for x in results]


def _each_once(jaxpr: Jaxpr):
    """The operations of a jaxpr without repeated operations on the same numbers, and its results."""
    eqns, done, same = [], {}, {}

    def renamed(atoms: list):
        return [x if isinstance(x, Literal) else same.get(x, x) for x in atoms]

    for eqn in needed(jaxpr):
        eqn = eqn.replace(invars=renamed(eqn.invars))
        key = eqn
        if eqn.primitive.name in ELEMENTWISE and is_understood(eqn):
            operands = [(repr(x.val), x.aval) if isinstance(x, Literal) else x for x in eqn.invars]
            key = (eqn.primitive, *operands, *eqn.params.items())
        before = done.setdefault(key, eqn)
        if before is eqn:
            eqns.append(eqn)
        same.update(zip(eqn.outvars, before.outvars, strict=True))
    return eqns, renamed(jaxpr.outvars)


def _variables(atoms):
    """Each once, in their order."""
    return list(dict.fromkeys(x for x in atoms if not isinstance(x, Literal)))


def _layers(eqns: list):
    """What is to be known one after the other: operands of functions, their results, operands of functions of those."""
    depth, layers = {}, {}
    for eqn in eqns:
        d = max((depth.get(x, 0) for x in _variables(eqn.invars)), default=0)
        if eqn.primitive.name in FUNCTIONS or eqn.primitive.name not in ELEMENTWISE:
            layers.setdefault(d, []).append(eqn)
            d += 1
        depth.update(dict.fromkeys(eqn.outvars, d))
    for layer in layers.values():
        operands = _variables(x for eqn in layer for x in eqn.invars)
        yield operands
        layer.sort(key=lambda eqn: [operands.index(x) for x in _variables(eqn.invars)])
        yield _variables(x for eqn in layer for x in eqn.outvars)


def _stage(eqns: list, known, wanted):
    """From what is known to what is wanted."""
    wanted = [x for x in _variables(wanted) if x not in known]
    missing, needed = set(wanted), []
    for eqn in reversed(eqns):
        if not missing.isdisjoint(eqn.outvars):
            needed.insert(0, eqn)
            missing.update(x for x in _variables(eqn.invars) if x not in known)
    return _Stage([x for x in _variables(x for eqn in needed for x in eqn.invars) if x in known], needed, wanted)


# ----------------------------------------------------------------------------
# Functions within functions, evaluated number by number: calls, branches, loops, solves, rules for derivatives.
#
# Each takes `run`, (closed jaxpr, values) -> values of its results, the evaluator that it is a part of.


def _call(run: Callable, eqn: JaxprEqn, *values: np.ndarray):
    """A staged function stays a call, of scalars."""
    closed, name = eqn.params["jaxpr"], eqn.params["name"]
    if not name.startswith(STAGED):
        return run(closed, values)
    given, fill = _unknowns(values)
    after = []

    def call(*arrays: Array):
        results = run(closed, fill(arrays))
        found, refill = _unknowns(results, dict(zip(map(id, arrays), given, strict=True)))
        after.append(refill)
        return found

    found = in_stages(name, call, *given)
    return after[-1](found)


@dataclass(frozen=True)
class _Place:
    index: int


def _unknowns(values: Sequence, passed: PyTree = ()):
    """What is not known in the values, each once, and the function that puts others in its place.

    passed: {id of a tracer: what it stands for}, which is put there instead.
    """
    found, places = [], {}

    def place(x: Real):
        if is_known(x):
            return x
        if id(x) in passed:
            return passed[id(x)]
        if id(x) not in places:
            places[id(x)] = _Place(len(found))
            found.append(x)
        return places[id(x)]

    template = [each(place, value) for value in values]

    def fill(new: Sequence):
        return [each(lambda x: new[x.index] if isinstance(x, _Place) else x, value) for value in template]

    return found, fill


def _layout(variables: list):
    """Values of such variables as a list of arrays, and back."""
    avals = [x.aval for x in variables]

    def flat(values: Sequence):
        pairs = zip(values, avals, strict=True)
        return [as_scalar(x, aval.dtype) for v, aval in pairs for x in (v.flat if is_in_pieces(v) else [v])]

    def back(arrays):
        arrays = iter(arrays)
        return [
            arranged([next(arrays) for _ in range(math.prod(aval.shape))], aval.shape)
            if is_small(aval)
            else next(arrays)
            for aval in avals
        ]

    return flat, back


def _while_loop(run: Callable, eqn: JaxprEqn, *values: np.ndarray):
    params, flat, back = eqn.params, *_layout(eqn.outvars)
    if params["cond_jaxpr"].out_avals[0].shape:  # vmap: each member has its own end
        return None
    first = params["cond_nconsts"]
    second = first + params["body_nconsts"]

    def unfinished(carry: list) -> Array:
        closed = params["cond_jaxpr"]
        return run(closed, [*values[:first], *back(carry)])[0].item()

    def body(carry: list):
        closed = params["body_jaxpr"]
        return flat(run(closed, [*values[first:second], *back(carry)]))

    return back(lax.while_loop(unfinished, body, flat(values[second:])))


def _cond(run: Callable, eqn: JaxprEqn, which: np.ndarray, *values: Real):
    (flat, back), (flat_results, back_results) = _layout(eqn.invars[1:]), _layout(eqn.outvars)

    def branch(closed: ClosedJaxpr):
        return lambda *x: flat_results(run(closed, back(x)))

    return back_results(lax.switch(which.item(), [branch(closed) for closed in eqn.params["branches"]], *flat(values)))


def _in_turn(run: Callable, eqn: JaxprEqn, asked: np.ndarray, *values: Real):
    number, closed = eqn.params["number"], eqn.params["closed"]
    if closed is not eqn.params["at_once"]:  # of a batch
        return None
    (flat, back), (flat_more, back_more) = _layout(eqn.outvars), _layout(eqn.invars[1 + number :])

    def f(carry: list, more: list):
        return flat(run(closed, [*back(carry), *back_more(more)]))

    return back(in_turn(f, asked.item(), flat(values[:number]), flat_more(values[number:])))


def _custom_linear_solve(run: Callable, eqn: JaxprEqn, *values: np.ndarray):
    lengths, closed = eqn.params["const_lengths"], eqn.params["jaxprs"]
    flat, back = _layout(eqn.outvars)
    ends = np.cumsum([lengths.matvec, lengths.vecmat, lengths.solve, lengths.transpose_solve])
    *constants, b = [values[start:stop] for start, stop in zip([0, *ends], [*ends, None], strict=True)]
    if closed.transpose_solve is None or len(b) != len(eqn.outvars):  # no reverse mode, or results beside x
        return None
    scalars = flat(b)
    if not scalars or len({x.dtype for x in scalars}) > 1:
        return None

    def vector(name: str, constants: tuple):
        function = getattr(closed, name)
        return lambda x: jnp.stack(flat(run(function, [*constants, *back(list(x))])))

    matvec, _, solve, transpose_solve = map(vector, lengths._fields, constants)
    # as one vector: JAX does not transpose a solve of which some numbers on the right are constant, and some are not
    x = lax.custom_linear_solve(matvec, jnp.stack(scalars), lambda _, b: solve(b), lambda _, b: transpose_solve(b))
    return back(list(x))


def _custom_jvp_call(run, eqn, *values: np.ndarray):
    """A function with a rule of its own for derivatives, which serves scalars too."""
    if not any(x.aval.shape for x in eqn.invars) or not all(
        jnp.issubdtype(x.aval.dtype, jnp.floating) for x in eqn.invars
    ):
        return None
    closed = eqn.params["call_jaxpr"]
    (flat, back), (flat_results, back_results) = _layout(eqn.invars), _layout(eqn.outvars)

    @jax.custom_jvp
    def call(*x: Array):
        return flat_results(run(closed, back(x)))

    @call.defjvp
    def _(x: tuple, dx: tuple):
        shapes = [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in eqn.invars]
        rule = jax.make_jaxpr(lambda x, dx: jax.jvp(alone(eqn), x, dx))(shapes, shapes)
        results = run(rule, [*back(x), *back(dx)])
        half = len(results) // 2
        return flat_results(results[:half]), flat_results(results[half:])

    return back_results(call(*flat(values)))


def _family(run, eqn, x: np.ndarray):
    """Of each element."""
    n, family, dtype = eqn.params["n"], eqn.params["family"], eqn.outvars[0].aval.dtype
    if not is_in_pieces(x) or not x.size:
        return None
    columns = zip(*(family(n, as_scalar(y, dtype)) for y in x.flat), strict=True)
    return [arranged(list(column), x.shape) for column in columns]


CALLS = {
    "cond": _cond,
    "hhtjax_in_turn": _in_turn,
    "jit": _call,
    "hhtjax_family": _family,
    "hhtjax_bilinear": lambda run, eqn, x, y: run(eqn.params["jaxpr"], [x, y]),
    "hhtjax_map": lambda run, eqn, x: run(eqn.params["jaxpr"], [x]),
    "while": _while_loop,
    "custom_linear_solve": _custom_linear_solve,
    "custom_jvp_call": _custom_jvp_call,
}
