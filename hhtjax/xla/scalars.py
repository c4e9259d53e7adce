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

from hhtjax.xla.gate import is_on
from hhtjax.xla.interpreter import alone, evaluate
from hhtjax.xla.parameters import ELEMENTWISE, is_understood
from hhtjax.xla.pieces import arranged, as_scalar, is_in_pieces, is_small, pieces, whole
from hhtjax.xla.scalar_calls import CALLS
from hhtjax.xla.scalar_rules import RULES

MOST_OPERATIONS = 2000  # on scalars: the gradient of more is no kernel any more
MOST_IN_VALUES = 2500  # where nobody asks for derivatives; of more compiling takes longer than it saves


@partial(jax.tree_util.register_dataclass, data_fields=["elements"], meta_fields=["shape"])
@dataclass(frozen=True)
class Scalars:
    """An array as its elements, each a scalar, or stacked along axes that come before those of `shape`."""

    elements: tuple
    shape: tuple


def pays(f, *args, derivatives=True):
    """Whether f of these trees is better evaluated on scalars: few operations, all known, of more than one number.

    Operations that are not known may keep XLA from making one kernel of a loop; without one, scalars take longer.
    """
    if jax.default_backend() != "cpu" or not is_on():
        return False
    if all(jnp.size(x) == 1 for x in jax.tree.leaves(args)):
        return False
    return _work(_traced(f, *args)[0].jaxpr) <= (MOST_OPERATIONS if derivatives else MOST_IN_VALUES)


def _traced(f, *args):
    """The closed jaxpr of f of trees, of `Scalars` too, and what it returns, in shapes. JAX traces a function once."""

    def like(x):
        return jax.ShapeDtypeStruct(x.shape if _is_scalars(x) else jnp.shape(x), _dtype(x))

    return jax.make_jaxpr(f, return_shape=True)(*jax.tree.map(like, args, is_leaf=_is_scalars))


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
    """The tree with `Scalars` for its small arrays."""
    return jax.tree.map(lambda x: Scalars(tuple(pieces(x).flat), x.shape) if x.ndim and is_small(x) else x, tree)


class Form(NamedTuple):
    """How functions of a tree are evaluated. tree: with `Scalars` for its small arrays, or as it was; `of` gives the
    form of a function, `like` that of another such tree, and `joined` arrays again."""

    tree: Any
    is_split: bool = False

    def of(self, f):
        """f of such trees, to such trees."""
        return by_scalars(f)

    def like(self, tree):
        """Another tree of the same arrays, in this form."""
        return split(tree) if self.is_split else tree

    def joined(self, tree):
        """Any such tree as arrays; what its scalars are stacked along comes first."""
        return join(tree)


def on_scalars(f, tree, derivatives=True):
    """The form in which f of the tree is better evaluated: on scalars where that pays, else on arrays.

    Args:
        f: a function of the tree.
        tree: a pytree of arrays.
        derivatives: whether some may be taken.

    Returns:
        A `Form`: its `tree` is what f, and others, are evaluated with, and `joined` makes arrays of what they return.

    Raises:
        whatever f raises.

    >>> form = on_scalars(jnp.sin, jnp.ones(2))
    >>> bool(jnp.all(form.joined(form.of(jnp.sin)(form.tree)) == jnp.sin(1.0)))
    True
    """
    form = Form(tree, pays(f, tree, derivatives=derivatives))
    return form._replace(tree=form.like(tree))


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


def _is_scalars(x):
    return isinstance(x, Scalars)


def _dtype(x):
    return jnp.result_type(x.elements[0] if _is_scalars(x) else x)


def _as_scalars(value, like):
    if not is_in_pieces(value):
        return value
    elements = tuple(as_scalar(x, like.dtype) for x in value.flat)
    return Scalars(elements, like.shape) if like.shape else elements[0]


def _run(closed, values):
    """The values of the results of a closed jaxpr."""
    return evaluate(closed.jaxpr, [*map(pieces, closed.consts), *values], _apply, lambda x: pieces(np.asarray(x)))


def _apply(eqn, values):
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
