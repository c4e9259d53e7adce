"""The matrix of a linear map, from one evaluation that uses its sparsity.

With n unit vectors, computing the matrix takes n times the work of the map. But most operations of a mechanical system
do not couple unknowns: sines of angles, products with masses and velocities. Element i then depends only on unknown i,
and n numbers suffice instead of n^2. Springs between neighbours depend on unknowns i and i + 1, sums of differences on
two of n. A product with a matrix, A diag(d), is a scaling of its columns.

So the derivative of every value is stored as `Terms`. For each axis of the value, they have the parts of the derivative
in which the index along that axis determines the unknown. All other parts are one full array. Operations without a rule
here run on whole columns, as with vmap.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial, reduce
from operator import add
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.description import Array, PyTree, Real
from hhtjax.jaxpr.scalar_rules import is_understood
from hhtjax.primitives.compat import is_on
from hhtjax.primitives.interpreter import alone, evaluate
from hhtjax.primitives.kernels import structural

if TYPE_CHECKING:
    from jax.extend.core import ClosedJaxpr, JaxprEqn


def linear_map(f, like):
    """The matrix of a linear map f of vectors like `like` to vectors.

    Args:
        f: a linear function of a vector (n,) that returns one, (m,).
        like: a vector (n,) of the size and dtype of its argument; its values do not matter.

    Returns:
        (m, n).

    Raises:
        whatever f raises.

    >>> print(linear_map(lambda x: jnp.stack([x[0] + x[1], 3 * x[1]]), jnp.zeros(2)))
    [[1. 1.]
     [0. 3.]]
    """
    if like.size == 1 or not is_on():
        return jax.vmap(f, out_axes=1)(jnp.eye(like.size, dtype=like.dtype))
    trace = jax.make_jaxpr(f)(like)
    (result,) = _evaluate(trace, Terms(like.size, like.shape, {(0, 0): jnp.ones_like(like)}))
    return result.whole().T if isinstance(result, Terms) else jnp.zeros((*result.shape, like.size), result.dtype)


def _evaluate(closed: ClosedJaxpr, *values):
    """The values of a jaxpr's results; `Terms` for what depends on the unknowns."""
    return evaluate(closed.jaxpr, [*closed.consts, *values], _apply)


def _apply(eqn: JaxprEqn, values: list):
    """The results of one operation."""
    if not any(map(_depends, values)):
        return alone(eqn)(*values)
    rule = RULES.get(eqn.primitive.name) if is_understood(eqn) else None
    results = None if rule is None else rule(eqn, *values)
    return _by_columns(eqn, values) if results is None else results


def _depends(value: Array | Terms):
    return isinstance(value, Terms)


def _by_columns(eqn, values: list):
    n = next(x.n for x in values if _depends(x))
    columns = [x.whole() if _depends(x) else x for x in values]
    results = jax.vmap(alone(eqn), [0 if _depends(x) else None for x in values], axis_size=n)(*columns)
    return [Terms(n, x.aval.shape, full=y) for x, y in zip(eqn.outvars, results, strict=True)]


# Rules: (eqn, *values) -> list of results, or None for whole columns.


def _each(eqn: JaxprEqn, x: Terms):
    """A linear function of each element."""
    return [x.map(lambda y: alone(eqn)(y)[0], x.shape)]


def _spread(x: Terms, shape: tuple, to: PyTree) -> Terms:
    """The `Terms` x broadcast: its axis i becomes to[i]. One of length 1 is repeated, and then tells no unknown."""
    return x.map(
        lambda y: lax.broadcast_in_dim(y, shape, to),
        shape,
        lambda axis, offset: (to[axis], offset) if x.shape[axis] == shape[to[axis]] else None,
    )


def _fit(x, shape: tuple):
    """The same as operations on elements do it."""
    return x if x.shape == shape else _spread(x, shape, range(len(shape) - len(x.shape), len(shape)))


def _add(eqn, *values):
    """What does not depend on x adds nothing: the map is linear."""
    shape = eqn.outvars[0].aval.shape
    if eqn.primitive.name == "sub" and _depends(values[1]):
        values = values[0], values[1].map(lax.neg, values[1].shape)
    return [reduce(add, [_fit(x, shape) for x in values if _depends(x)])]


def _multiply(eqn, x, y):
    shape = eqn.outvars[0].aval.shape
    if _depends(x) and _depends(y):
        return None
    x, y = (x, y) if _depends(x) else (y, x)
    return [_fit(x, shape).map(lambda z: lax.mul(z, y), shape)]


def _divide(eqn, x, y: Real):
    shape = eqn.outvars[0].aval.shape
    return None if _depends(y) else [_fit(x, shape).map(lambda z: lax.div(z, y), shape)]


def _select(eqn, which: Array, *cases):
    def chosen(y: Array, case: int):
        return lax.select_n(
            which, *(y if i == case else lax.broadcast(zero_like(y), y.shape) for i in range(len(cases)))
        )

    return [reduce(add, [x.map(partial(chosen, case=i), x.shape) for i, x in enumerate(cases) if _depends(x)])]


def _broadcast(eqn: JaxprEqn, x: Terms, *sizes):
    return [_spread(x, eqn.params["shape"], eqn.params["broadcast_dimensions"])]


def _reshape(eqn, x, *sizes):
    """Axes of length 1 come and go; others, where they are joined or divided, are kept apart no longer."""
    if eqn.params.get("dimensions") is not None and eqn.primitive.name == "reshape":
        return None
    return [_reshaped(x, eqn.outvars[0].aval.shape)]


def _reshaped(x: Terms, shape: tuple):
    old, new = ([i for i, length in enumerate(s) if length != 1] for s in (x.shape, shape))
    same = [x.shape[i] for i in old] == [shape[i] for i in new]
    return x.map(
        lambda y: lax.reshape(y, shape),
        shape,
        lambda axis, offset: (new[old.index(axis)], offset) if same and axis in old else None,
    )


def _transpose(eqn, x):
    to, shape = eqn.params["permutation"], eqn.outvars[0].aval.shape
    return [x.map(lambda y: lax.transpose(y, to), shape, lambda axis, offset: (to.index(axis), offset))]


def _cut(x: Terms, start: Sequence, stop: Sequence, steps: tuple):
    shape = tuple(-(-(b - a) // step) for a, b, step in zip(start, stop, steps, strict=True))
    return x.map(
        lambda y: lax.slice(y, start, stop, steps),
        shape,
        lambda axis, offset: (axis, offset + start[axis]) if steps[axis] == 1 else None,
    )


def _slice(eqn: JaxprEqn, x: Terms):
    start, stop, steps = (eqn.params[name] for name in ("start_indices", "limit_indices", "strides"))
    return [_cut(x, start, stop, steps or (1,) * len(start))]


def _split(eqn, x):
    results, start = [], [0] * len(x.shape)
    for variable in eqn.outvars:
        stop = [i + length for i, length in zip(start, variable.aval.shape, strict=True)]
        results.append(_cut(x, start, stop, (1,) * len(start)))
        start[eqn.params["axis"]] = stop[eqn.params["axis"]]
    return results


def _unstack(eqn, x):
    axis, results = eqn.params["axis"], []
    for i, variable in enumerate(eqn.outvars):
        start, stop = [0] * len(x.shape), list(x.shape)
        start[axis], stop[axis] = i, i + 1
        results.append(_reshaped(_cut(x, start, stop, (1,) * len(start)), variable.aval.shape))
    return results


def _put(x, shape: tuple, config: Sequence) -> Terms:
    """Among zeros."""
    return x.map(
        lambda y: lax.pad(y, zero_like(y), config),
        shape,
        lambda axis, offset: (axis, offset - config[axis][0]) if config[axis][2] == 0 else None,
    )


def _pad(eqn, x: Terms, filling: Array):
    return None if _depends(filling) else [_put(x, eqn.outvars[0].aval.shape, eqn.params["padding_config"])]


def _concatenate(eqn, *values):
    if any(_depends(x) and x.full is not None for x in values):
        return None
    axis, shape, start, parts = eqn.params["dimension"], eqn.outvars[0].aval.shape, 0, []
    for x in values:
        stop = start + x.shape[axis]
        if _depends(x):
            config = [(0, 0, 0)] * len(shape)
            config[axis] = start, shape[axis] - stop, 0
            parts.append(_put(x, shape, config))
        start = stop
    return [reduce(add, parts)]


def _unknown_first(y: Array, axis: int, offset: int, n: int):
    """A term along `axis` as an array whose first axis is that of the unknowns, once this axis is summed over."""
    y = jnp.moveaxis(y, axis, 0)
    return lax.pad(y, zero_like(y), [(offset, n - offset - len(y), 0), *[(0, 0, 0)] * (y.ndim - 1)])


def _reduce_sum(eqn, x):
    axes, shape = eqn.params["axes"], eqn.outvars[0].aval.shape
    kept = [i for i in range(len(x.shape)) if i not in axes]
    summed, rest = x.apart(axes)
    result = rest.map(lambda y: y.sum(axes), shape, lambda axis, offset: (kept.index(axis), offset))
    for (axis, offset), y in summed.items():
        y = y.sum([i for i in axes if i != axis], keepdims=True)
        y = _unknown_first(y, axis, offset, x.n)
        result += Terms(x.n, shape, full=y.reshape(x.n, *shape))
    return [result]


def _dot_general(eqn, x, y):
    over, batch = eqn.params["dimension_numbers"]
    shape, dtype = eqn.outvars[0].aval.shape, eqn.outvars[0].aval.dtype
    side, terms = (0, x) if _depends(x) else (1, y)
    options = {"precision": eqn.params["precision"], "preferred_element_type": dtype}

    def product(z, over=over, batch=batch):
        return lax.dot_general(*((z, y) if side == 0 else (x, z)), (over, batch), **options)

    free = [[i for i in range(len(z.shape)) if i not in (*o, *b)] for z, o, b in zip((x, y), over, batch, strict=True)]
    place = [*batch[side], *([None] * len(free[0]) if side else []), *free[side]]  # of our axes in the result
    summed, rest = terms.apart(over[side])
    result = rest.map(product, shape, lambda axis, offset: (place.index(axis), offset))
    for (axis, offset), z in summed.items():  # the sum over this axis has one term for each unknown
        i = over[side].index(axis)
        others = tuple((*o[:i], *o[i + 1 :]) for o in over)
        batches = tuple((o[i], *b) for o, b in zip(over, batch, strict=True))
        z = _unknown_first(product(z, others, batches), 0, offset, terms.n)
        result += Terms(terms.n, shape, full=z)
    return [result]


def _call(eqn: JaxprEqn, *values):
    return _evaluate(eqn.params["jaxpr"], *values)


RULES = {
    **dict.fromkeys(("neg", "convert_element_type", "copy"), _each),
    **dict.fromkeys(("add", "add_any", "sub"), _add),
    "mul": _multiply,
    "div": _divide,
    "select_n": _select,
    "broadcast_in_dim": _broadcast,
    **dict.fromkeys(("reshape", "squeeze"), _reshape),
    "transpose": _transpose,
    "slice": _slice,
    "split": _split,
    "unstack": _unstack,
    "pad": _pad,
    "concatenate": _concatenate,
    "reduce_sum": _reduce_sum,
    "dot_general": _dot_general,
    **dict.fromkeys(("jit", "hhtjax_bilinear", "hhtjax_map"), _call),
}


# ----------------------------------------------------------------------------
# Derivatives that know what they depend on.


MOST_TERMS = 4  # beyond, a full array is no more work


@dataclass
class Terms:
    """The derivative dy/dx of an array y of this shape by n unknowns x. It is the sum over all (axis, offset) of

    dy[index]/dx[k] = along[axis, offset][index] where k = index[axis] + offset, and zero elsewhere;
    plus dy[index]/dx[k] = full[k, index].
    """

    n: int
    shape: tuple
    along: dict = field(default_factory=dict)
    full: Any = None

    def map(self, f: Callable, shape: tuple, keys: Callable = lambda axis, offset: (axis, offset)):
        """The same of f(y), for a linear f that keeps indices along our axes apart, but may move them.

        keys: (axis, offset) before -> after, or None where f does not keep them apart.
        """
        moved = {key: keys(*key) for key in self.along}
        along = {new: f(self.along[key]) for key, new in moved.items() if new is not None}
        rest = Terms(self.n, self.shape, {key: self.along[key] for key, new in moved.items() if new is None}, self.full)
        return Terms(self.n, shape, along, jax.vmap(f)(rest.whole()) if rest.along or rest.full is not None else None)

    def __add__(self, other: Terms) -> Terms:
        keys = {**self.along, **other.along}
        along = {key: add_if_any(self.along.get(key), other.along.get(key)) for key in keys}
        both = Terms(self.n, self.shape, along, add_if_any(self.full, other.full))
        if both.full is None and len(along) <= MOST_TERMS:
            return both
        return Terms(self.n, self.shape, full=both.whole())  # to carry both would be twice the work

    def apart(self, axes: tuple):
        """The terms along these axes, and all the rest."""
        found = {key: y for key, y in self.along.items() if key[0] in axes}
        others = {key: y for key, y in self.along.items() if key not in found}
        return found, Terms(self.n, self.shape, others, self.full)

    def whole(self):
        """dy/dx as an array (n, *shape)."""
        shape, total = (self.n, *self.shape), self.full
        for (axis, offset), y in self.along.items():
            k, i = (lax.broadcasted_iota(jnp.int32, shape, j) for j in (0, axis + 1))
            y = lax.broadcast_in_dim(y, shape, range(1, len(shape)))
            there = lax.eq(k, lax.add(i, np.int32(offset)) if offset else i)
            total = add_if_any(total, lax.select(there, y, lax.broadcast(zero_like(y), shape)))
        return total


def zero_like(like: PyTree) -> Array:
    """Zero, where there is nothing to depend on."""
    return structural(np.zeros((), like.dtype))


def add_if_any(x: Array | None, y: Array | None):
    """x + y, where None is nothing."""
    return y if x is None else x if y is None else lax.add(x, y)
