"""Small arrays as scalars: a function of vectors of a few numbers, evaluated number by number.

XLA:CPU runs a loop over each small array, with a branch for every part of a concatenation; and vmap puts members first,
so that in memory the coordinates of one lie side by side, and no vector instruction fits. A function that is traced,
and evaluated anew with arrays of scalars in the place of small arrays, is rid of both: to move numbers about costs
nothing, products with the zeros and ones of unit vectors vanish, and a batch of each scalar is one array without gaps.

It comes before vmap and autodiff, which then see scalars. An operation that has no rule here runs on whole arrays.
"""

import math
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.xla.gate import is_on
from hhtjax.xla.interpreter import alone, evaluate
from hhtjax.xla.kernels import STAGED
from hhtjax.xla.scalar_rules import ELEMENTWISE, RULES, arranged, each, is_in_pieces, is_known, is_small, pieces, whole
from hhtjax.xla.sharing import in_stages

MOST_OPERATIONS = 2000  # on scalars: the gradient of more is no kernel any more


@partial(jax.tree_util.register_dataclass, data_fields=["elements"], meta_fields=["shape"])
@dataclass(frozen=True)
class Scalars:
    """An array as its elements, each a scalar, or stacked along axes that come before those of `shape`."""

    elements: tuple
    shape: tuple


def pays(f, *args):
    """Whether f of these trees is better evaluated on scalars: few operations, all known, of more than one number.

    Operations that are not known may keep XLA from making one kernel of a loop; without one, scalars take longer.
    """
    if jax.default_backend() != "cpu" or not is_on():
        return False
    if all(jnp.size(x) == 1 for x in jax.tree.leaves(args)):
        return False
    return _work(jax.make_jaxpr(f)(*args).jaxpr) <= MOST_OPERATIONS


def _work(jaxpr):
    """Number of operations on scalars, infinite with one that is not known; none for what only moves numbers."""
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


def split(tree):
    """The tree with `Scalars` for its small arrays; scalars and empty arrays stay."""

    def scalars(x):
        return Scalars(tuple(pieces(x).flat), x.shape) if x.ndim and x.size and is_small(x) else x

    return jax.tree.map(scalars, tree)


class Form(NamedTuple):
    """How functions of a tree are evaluated. tree: with `Scalars` for its small arrays, or as it was; `of` gives the
    form of a function, and `joined` arrays again."""

    tree: Any

    def of(self, f):
        """f of such trees, to such trees."""
        return by_scalars(f)

    def joined(self, tree):
        """Any such tree as arrays; what its scalars are stacked along comes first."""
        return join(tree)


def on_scalars(f, tree):
    """The form in which f of the tree is better evaluated: on scalars where that pays, else on arrays."""
    return Form(split(tree) if pays(f, tree) else tree)


def join(tree):
    """The tree with arrays for its `Scalars`; what they are stacked along comes first."""

    def joined(x):
        if not _is_scalars(x):
            return x
        array = jnp.stack(x.elements, axis=-1)
        return array.reshape(*array.shape[:-1], *x.shape)

    return jax.tree.map(joined, tree, is_leaf=_is_scalars)


def by_scalars(f):
    """f of trees that `split` made, to such trees; f itself of trees it left alone."""

    def g(*args):
        leaves, structure = jax.tree.flatten(args, is_leaf=_is_scalars)
        if not any(map(_is_scalars, leaves)):
            return f(*args)
        shapes = [jax.ShapeDtypeStruct(x.shape, _dtype(x)) for x in leaves]
        trace, like = jax.make_jaxpr(f, return_shape=True)(*structure.unflatten(shapes))
        values = [arranged(x.elements, x.shape) if _is_scalars(x) else pieces(x) for x in leaves]
        with np.errstate(all="ignore"):
            values = _evaluate(trace.jaxpr, trace.consts, values)
        leaves, structure = jax.tree.flatten(like)
        return structure.unflatten(map(_as_scalars, values, leaves))

    return g


def _is_scalars(x):
    return isinstance(x, Scalars)


def _dtype(x):
    return x.elements[0].dtype if _is_scalars(x) else x.dtype


def _as_scalars(value, like):
    if not is_in_pieces(value) or not value.size:
        return whole(value, like)
    elements = tuple(jnp.asarray(x, like.dtype) for x in value.flat)
    return Scalars(elements, like.shape) if like.shape else elements[0]


def _evaluate(jaxpr, consts, values):
    """The values of a jaxpr's results."""
    return evaluate(jaxpr, [*map(pieces, consts), *values], _apply, lambda x: pieces(np.asarray(x)))


def _apply(eqn, values):
    """The results of one operation."""
    name = eqn.primitive.name
    results = None
    if name in CALLS:
        results = CALLS[name](eqn, *values)
    elif name in RULES and all(map(is_in_pieces, values)) and all(is_small(x.aval) for x in eqn.outvars):
        results = RULES[name](eqn, *values)
    if results is None:
        arrays = [whole(value, x.aval) for value, x in zip(values, eqn.invars, strict=True)]
        results = map(pieces, alone(eqn)(*arrays))
    return results


# Functions within functions.


def _call(eqn, *values):
    """A staged function stays a call, of scalars."""
    closed, name = eqn.params["jaxpr"], eqn.params["name"]
    if not name.startswith(STAGED):
        return _evaluate(closed.jaxpr, closed.consts, values)
    given, fill = _unknowns(values)
    after = []

    def call(*arrays):
        results = _evaluate(closed.jaxpr, closed.consts, fill(arrays))
        found, refill = _unknowns(results, dict(zip(map(id, arrays), given, strict=True)))
        after.append(refill)
        return found

    found = in_stages(name, call, *given)
    return after[-1](found)


@dataclass(frozen=True)
class _Place:
    index: int


def _unknowns(values, passed=()):
    """What is not known in the values, each once, and the function that puts others in its place.

    passed: {id of a tracer: what it stands for}, which is put there instead.
    """
    found, places = [], {}

    def place(x):
        if is_known(x):
            return x
        if id(x) in passed:
            return passed[id(x)]
        if id(x) not in places:
            places[id(x)] = _Place(len(found))
            found.append(x)
        return places[id(x)]

    template = [each(place, value) for value in values]

    def fill(new):
        return [each(lambda x: new[x.index] if isinstance(x, _Place) else x, value) for value in template]

    return found, fill


def _layout(variables):
    """Values of such variables as a list of arrays, and back."""
    avals = [x.aval for x in variables]

    def flat(values):
        pairs = zip(values, avals, strict=True)
        return [jnp.asarray(x, aval.dtype) for v, aval in pairs for x in (v.flat if is_in_pieces(v) else [v])]

    def back(arrays):
        arrays = iter(arrays)
        return [
            arranged([next(arrays) for _ in range(math.prod(aval.shape))], aval.shape)
            if is_small(aval)
            else next(arrays)
            for aval in avals
        ]

    return flat, back


def _while_loop(eqn, *values):
    if eqn.params["cond_jaxpr"].out_avals[0].shape:  # a batch, whose members end at different times
        return None
    params, flat, back = eqn.params, *_layout(eqn.outvars)
    first = params["cond_nconsts"]
    second = first + params["body_nconsts"]

    def unfinished(carry):
        closed = params["cond_jaxpr"]
        return _evaluate(closed.jaxpr, closed.consts, [*values[:first], *back(carry)])[0].item()

    def body(carry):
        closed = params["body_jaxpr"]
        return flat(_evaluate(closed.jaxpr, closed.consts, [*values[first:second], *back(carry)]))

    return back(lax.while_loop(unfinished, body, flat(values[second:])))


def _cond(eqn, which, *values):
    (flat, back), (flat_results, back_results) = _layout(eqn.invars[1:]), _layout(eqn.outvars)

    def branch(closed):
        return lambda *x: flat_results(_evaluate(closed.jaxpr, closed.consts, back(x)))

    return back_results(lax.switch(which.item(), [branch(closed) for closed in eqn.params["branches"]], *flat(values)))


def _custom_linear_solve(eqn, *values):
    lengths, closed = eqn.params["const_lengths"], eqn.params["jaxprs"]
    flat, back = _layout(eqn.outvars)
    ends = np.cumsum([lengths.matvec, lengths.vecmat, lengths.solve, lengths.transpose_solve])
    *constants, b = [values[start:stop] for start, stop in zip([0, *ends], [*ends, None], strict=True)]
    if closed.transpose_solve is None or len(b) != len(eqn.outvars):  # no reverse mode, or results beside x
        return None

    def scalar(name, constants):
        function = getattr(closed, name)
        return lambda x: flat(_evaluate(function.jaxpr, function.consts, [*constants, *back(x)]))

    matvec, _, solve, transpose_solve = map(scalar, lengths._fields, constants)
    return back(
        lax.custom_linear_solve(
            matvec, flat(b), solve=lambda _, b: solve(b), transpose_solve=lambda _, b: transpose_solve(b)
        )
    )


def _custom_jvp_call(eqn, *values):
    """A function with a rule of its own for derivatives, which serves scalars too."""
    if not any(x.aval.shape for x in eqn.invars) or not all(
        jnp.issubdtype(x.aval.dtype, jnp.floating) for x in eqn.invars
    ):
        return None
    closed = eqn.params["call_jaxpr"]
    (flat, back), (flat_results, back_results) = _layout(eqn.invars), _layout(eqn.outvars)

    @jax.custom_jvp
    def call(*x):
        return flat_results(_evaluate(closed.jaxpr, closed.consts, back(x)))

    @call.defjvp
    def _(x, dx):
        shapes = [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in eqn.invars]
        rule = jax.make_jaxpr(lambda x, dx: jax.jvp(alone(eqn), x, dx))(shapes, shapes)
        results = _evaluate(rule.jaxpr, rule.consts, [*back(x), *back(dx)])
        half = len(results) // 2
        return flat_results(results[:half]), flat_results(results[half:])

    return back_results(call(*flat(values)))


CALLS = {
    "cond": _cond,
    "jit": _call,
    "while": _while_loop,
    "custom_linear_solve": _custom_linear_solve,
    "custom_jvp_call": _custom_jvp_call,
}
