"""Small arrays as scalars: a function of vectors of a few numbers, evaluated number by number.

XLA:CPU runs a loop over each small array, with a branch for every part of a concatenation; and vmap puts members first,
so that in memory the coordinates of one lie side by side, and no vector instruction fits. A function that is traced,
and evaluated anew with arrays of scalars in the place of small arrays, is rid of both: to move numbers about costs
nothing, products with the zeros and ones of unit vectors vanish, and a batch of each scalar is one array without gaps.

It comes before vmap and autodiff, which then see scalars. An operation that has no rule here runs on whole arrays.
"""

import math
from dataclasses import dataclass
from functools import partial, reduce

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import Literal

from hhtjax.kernels import STAGED, TESTED, named

LARGEST = 64  # numbers in an array that is split
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
    if jax.default_backend() != "cpu" or jax.__version_info__ < TESTED:
        return False
    if all(jnp.size(x) == 1 for x in jax.tree.leaves(args)):
        return False
    return _work(jax.make_jaxpr(f)(*args).jaxpr) <= MOST_OPERATIONS


def _work(jaxpr):
    """Number of operations on scalars, infinite with one that is not known; none for what only moves numbers."""
    total = 0
    for eqn in jaxpr.eqns:
        name = eqn.primitive.name
        if name not in ELEMENTWISE | RULES.keys():
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
    return jax.tree.map(lambda x: Scalars(tuple(_cells(x).flat), x.shape) if x.ndim and _is_small(x) else x, tree)


def join(tree):
    """The tree with arrays for its `Scalars`; what they are stacked along comes first."""

    def whole(x):
        if not isinstance(x, Scalars):
            return x
        array = jnp.stack(x.elements, axis=-1)
        return array.reshape(*array.shape[:-1], *x.shape)

    return jax.tree.map(whole, tree, is_leaf=_is_scalars)


def on_scalars(f):
    """f of trees that `split` made, to such trees; f itself of trees it left alone."""

    def g(*args):
        leaves, structure = jax.tree.flatten(args, is_leaf=_is_scalars)
        if not any(map(_is_scalars, leaves)):
            return f(*args)
        shapes = [jax.ShapeDtypeStruct(x.shape, _dtype(x)) for x in leaves]
        trace, like = jax.make_jaxpr(f, return_shape=True)(*structure.unflatten(shapes))
        values = [_array(x.elements, x.shape) if _is_scalars(x) else _cells(x) for x in leaves]
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
    if not _is_cells(value):
        return value
    elements = tuple(jnp.asarray(x, like.dtype) for x in value.flat)
    return Scalars(elements, like.shape) if like.shape else elements[0]


# What is evaluated: small arrays as NumPy arrays of objects, the elements: tracers, or numbers that are known. Larger
# ones as they are.


def _is_small(aval):
    return math.prod(aval.shape) <= LARGEST and not jnp.issubdtype(aval.dtype, jax.dtypes.extended)


def _is_cells(value):
    return isinstance(value, np.ndarray) and value.dtype == object


def _is_known(x):
    return isinstance(x, np.generic)


def _array(elements, shape):
    cells = np.empty(len(elements), object)
    for i, x in enumerate(elements):  # one by one: NumPy would ask a tracer for its array
        cells[i] = x
    return cells.reshape(shape)


def _cells(x):
    """A small array taken to pieces; a large one as it is."""
    if isinstance(x, (np.ndarray, np.generic, int, float, complex)):
        x = np.asarray(x)
    if not _is_small(x):
        return x
    return _array([x[i] if x.shape else x[()] for i in np.ndindex(*x.shape)], x.shape)


def _whole(value, aval):
    """The array of a value."""
    if not _is_cells(value):
        return value
    elements = [jnp.asarray(x, aval.dtype) for x in value.flat]
    return jnp.stack(elements).reshape(aval.shape) if aval.shape else elements[0]


def _evaluate(jaxpr, consts, values):
    """The values of a jaxpr's results."""
    values = [*map(_cells, consts), *values]
    known = dict(zip([*jaxpr.constvars, *jaxpr.invars], values, strict=True))

    def read(atom):
        return _cells(np.asarray(atom.val)) if isinstance(atom, Literal) else known[atom]

    for eqn in jaxpr.eqns:
        known.update(zip(eqn.outvars, _apply(eqn, [read(x) for x in eqn.invars]), strict=True))
    return [read(x) for x in jaxpr.outvars]


def _apply(eqn, values):
    """The results of one operation."""
    name = eqn.primitive.name
    results = None
    if name in CALLS or (all(map(_is_cells, values)) and all(_is_small(x.aval) for x in eqn.outvars)):
        rule = _elementwise if name in ELEMENTWISE else RULES.get(name)
        results = rule and rule(eqn, *values)
    if results is None:
        arrays = [_whole(value, x.aval) for value, x in zip(values, eqn.invars, strict=True)]
        results = map(_cells, _alone(eqn)(*arrays))
    return results


def _alone(eqn):
    """The operation as a function of its arrays, to a list."""

    def f(*arrays):
        with eqn.ctx.manager:
            results = eqn.primitive.bind(*arrays, **eqn.primitive.get_bind_params(eqn.params))
        return results if eqn.primitive.multiple_results else [results]

    return f


# Rules: (operation, values) -> the values of the results, or None for whole arrays.


def _elementwise(eqn, *values):
    out = eqn.outvars[0].aval
    columns = [np.broadcast_to(x, out.shape).flat for x in values]
    return [_array([_scalar(eqn, out.dtype, *x) for x in zip(*columns, strict=True)], out.shape)]


def _scalar(eqn, dtype, *x):
    """One operation on scalars, or what is known without it."""
    name = eqn.primitive.name
    if name == "select_n" and _is_known(x[0]):
        return x[1 + int(x[0])]
    found = _without(name, dtype, *x)
    return eqn.primitive.bind(*x, **eqn.params) if found is None else found


def _without(name, dtype, *x):
    """What is known of the result of an operation, or None."""
    if name in NUMPY and all(map(_is_known, x)):
        return dtype.type(NUMPY[name](*x))
    return SHORT[name](dtype, *x) if name in SHORT and jnp.issubdtype(dtype, jnp.inexact) else None


def _is(x, number):
    return _is_known(x) and x == number


def _product(dtype, x, y):
    if _is(x, 0) or _is(y, 0):
        return dtype.type(0)
    return y if _is(x, 1) else x if _is(y, 1) else None


def _sum(dtype, x, y):
    return y if _is(x, 0) else x if _is(y, 0) else None


def _difference(dtype, x, y):
    return x if _is(y, 0) else lax.neg(y) if _is(x, 0) else None


def _quotient(dtype, x, y):
    return dtype.type(0) if _is(x, 0) else x if _is(y, 1) else None


def _fold(name, dtype, x):
    """x[0] o x[1] o ..., o one of the operations of LAX."""

    def combine(x, y):
        found = _without(name, dtype, x, y)
        return LAX[name](x, y) if found is None else found

    return reduce(combine, x)


def _reduction(name):
    def rule(eqn, x):
        axes, out = eqn.params["axes"], eqn.outvars[0].aval
        rows = _rows(x, [i for i in range(x.ndim) if i not in axes], axes)
        return [_array([_fold(name, out.dtype, row) for row in rows], out.shape)] if x.size else None

    return rule


def _rows(x, first, last):
    """x as a matrix, the axes `first` along its columns, `last` along its rows."""
    lengths = [math.prod(x.shape[i] for i in axes) for axes in (first, last)]
    return x.transpose(*first, *last).reshape(lengths)


def _dot_general(eqn, x, y):
    out = eqn.outvars[0].aval
    if not (x.size and y.size) or any(v.aval.dtype != out.dtype for v in eqn.invars):
        return None
    over, batch = eqn.params["dimension_numbers"]
    rows = []
    for value, summed, batched in zip((x, y), over, batch, strict=True):
        kept = [i for i in range(value.ndim) if i not in (*summed, *batched)]
        members = _rows(value, batched, [*kept, *summed])
        rows.append(members.reshape(len(members), -1, math.prod(value.shape[i] for i in summed)))

    def dot(a, b):
        return _fold("add", out.dtype, [_fold("mul", out.dtype, pair) for pair in zip(a, b, strict=True)])

    return [_array([dot(a, b) for left, right in zip(*rows, strict=True) for a in left for b in right], out.shape)]


def _reshape(eqn, x):
    return [x.reshape(eqn.outvars[0].aval.shape)]


def _transpose(eqn, x):
    return [x.transpose(eqn.params["permutation"])]


def _broadcast_in_dim(eqn, x):
    shape = [1] * len(eqn.params["shape"])
    for axis, n in zip(eqn.params["broadcast_dimensions"], x.shape, strict=True):
        shape[axis] = n
    return [np.broadcast_to(x.reshape(shape), eqn.params["shape"])]


def _concatenate(eqn, *parts):
    return [np.concatenate(parts, eqn.params["dimension"])]


def _stack(eqn, *parts):
    return [np.stack(parts, eqn.params["axis"])]


def _split(eqn, x):
    return np.split(x, np.cumsum(eqn.params["sizes"])[:-1], eqn.params["axis"])


def _rev(eqn, x):
    return [np.flip(x, eqn.params["dimensions"])]


def _slice(eqn, x):
    start, stop, step = (eqn.params[key] for key in ("start_indices", "limit_indices", "strides"))
    return [x[tuple(map(slice, start, stop, step or [1] * x.ndim))]]


def _iota(eqn):
    out, axis = eqn.outvars[0].aval, eqn.params["dimension"]
    return [_cells(np.indices(out.shape)[axis].astype(out.dtype))]


def _moved(*moves):
    """Of what moves elements to places that are known: asked where it takes the numbers of the elements."""

    def rule(eqn, *values):
        if not all(_is_known(x) for i, value in enumerate(values) if i not in moves for x in value.flat):
            return None
        dtype = eqn.invars[0].aval.dtype
        if not jnp.issubdtype(dtype, jnp.floating):
            return None
        elements = np.concatenate([values[i].ravel() for i in moves])
        numbers = iter(np.split(np.arange(elements.size, dtype=dtype), np.cumsum([values[i].size for i in moves])))
        arrays = [
            next(numbers).reshape(value.shape) if i in moves else np.asarray(value.tolist(), x.aval.dtype)
            for i, (value, x) in enumerate(zip(values, eqn.invars, strict=True))
        ]
        with jax.ensure_compile_time_eval():
            taken = np.asarray(eqn.primitive.bind(*arrays, **eqn.params))
        return [elements[taken.astype(int)]] if np.isfinite(taken).all() else None  # NaN: outside the array

    return rule


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

    found = named(name, call)(*given)
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
        if _is_known(x):
            return x
        if id(x) in passed:
            return passed[id(x)]
        if id(x) not in places:
            places[id(x)] = _Place(len(found))
            found.append(x)
        return places[id(x)]

    template = [_each(place, value) for value in values]

    def fill(new):
        return [_each(lambda x: new[x.index] if isinstance(x, _Place) else x, value) for value in template]

    return found, fill


def _each(f, value):
    return _array([f(x) for x in value.flat], value.shape) if _is_cells(value) else f(value)


def _layout(variables):
    """Values of such variables as a list of arrays, and back."""
    avals = [x.aval for x in variables]

    def flat(values):
        pairs = zip(values, avals, strict=True)
        return [jnp.asarray(x, aval.dtype) for v, aval in pairs for x in (v.flat if _is_cells(v) else [v])]

    def back(arrays):
        arrays = iter(arrays)
        return [
            _array([next(arrays) for _ in range(math.prod(aval.shape))], aval.shape)
            if _is_small(aval)
            else next(arrays)
            for aval in avals
        ]

    return flat, back


def _while_loop(eqn, *values):
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
        rule = jax.make_jaxpr(lambda x, dx: jax.jvp(_alone(eqn), x, dx))(shapes, shapes)
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
RULES = {
    **{"broadcast_in_dim": _broadcast_in_dim, "concatenate": _concatenate, "dot_general": _dot_general, "iota": _iota},
    **{"reshape": _reshape, "squeeze": _reshape, "expand_dims": _reshape, "rev": _rev, "slice": _slice},
    **{"split": _split, "stack": _stack, "transpose": _transpose},
    **{
        "gather": _moved(0),
        "dynamic_slice": _moved(0),
        "dynamic_update_slice": _moved(0, 1),
        "pad": _moved(0, 1),
        "scatter": _moved(0, 2),
    },
    **{f"reduce_{kind}": _reduction(kind) for kind in ("max", "min", "and", "or")},
    **{"reduce_sum": _reduction("add"), "reduce_prod": _reduction("mul")},
    **CALLS,
}
ELEMENTWISE = {
    *("abs", "acos", "acosh", "add", "add_any", "and", "asin", "asinh", "atan", "atan2", "atanh", "cbrt", "ceil"),
    *("clamp", "convert_element_type", "copy", "cos", "cosh", "div", "eq", "erf", "exp", "exp2", "expm1", "floor"),
    *("ge", "gt", "integer_pow", "is_finite", "le", "log", "log1p", "logistic", "lt", "max", "min", "mul", "ne"),
    *("neg", "nextafter", "not", "or", "pow", "rem", "round", "rsqrt", "select_n", "sign", "sin", "sinh", "sqrt"),
    *("square", "stop_gradient", "sub", "tan", "tanh", "xor"),
}
NUMPY = {
    **{"add": np.add, "add_any": np.add, "sub": np.subtract, "mul": np.multiply, "neg": np.negative},
    **{"eq": np.equal, "ne": np.not_equal, "lt": np.less, "le": np.less_equal, "gt": np.greater},
    **{"ge": np.greater_equal, "and": np.bitwise_and, "or": np.bitwise_or, "max": np.maximum, "min": np.minimum},
    "convert_element_type": lambda x: x,
}
SHORT = {"mul": _product, "add": _sum, "add_any": _sum, "sub": _difference, "div": _quotient}
LAX = {
    **{"add": lax.add, "mul": lax.mul, "max": lax.max, "min": lax.min},
    **{"and": lax.bitwise_and, "or": lax.bitwise_or},
}
