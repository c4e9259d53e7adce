"""Functions within functions, evaluated number by number: calls, branches, loops, solves, rules for derivatives.

Each takes `run`, (closed jaxpr, values) -> values of its results, the evaluator that it is a part of.
"""

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.xla.interpreter import alone
from hhtjax.xla.kernels import STAGED
from hhtjax.xla.pieces import arranged, as_scalar, each, is_in_pieces, is_known, is_small
from hhtjax.xla.sharing import in_stages
from hhtjax.xla.turns import in_turn


def _call(run, eqn, *values):
    """A staged function stays a call, of scalars."""
    closed, name = eqn.params["jaxpr"], eqn.params["name"]
    if not name.startswith(STAGED):
        return run(closed, values)
    given, fill = _unknowns(values)
    after = []

    def call(*arrays):
        results = run(closed, fill(arrays))
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


def _while_loop(run, eqn, *values):
    params, flat, back = eqn.params, *_layout(eqn.outvars)
    if params["cond_jaxpr"].out_avals[0].shape:  # vmap: each member has its own end
        return None
    first = params["cond_nconsts"]
    second = first + params["body_nconsts"]

    def unfinished(carry):
        closed = params["cond_jaxpr"]
        return run(closed, [*values[:first], *back(carry)])[0].item()

    def body(carry):
        closed = params["body_jaxpr"]
        return flat(run(closed, [*values[first:second], *back(carry)]))

    return back(lax.while_loop(unfinished, body, flat(values[second:])))


def _cond(run, eqn, which, *values):
    (flat, back), (flat_results, back_results) = _layout(eqn.invars[1:]), _layout(eqn.outvars)

    def branch(closed):
        return lambda *x: flat_results(run(closed, back(x)))

    return back_results(lax.switch(which.item(), [branch(closed) for closed in eqn.params["branches"]], *flat(values)))


def _in_turn(run, eqn, asked, *values):
    number, closed = eqn.params["number"], eqn.params["closed"]
    if closed is not eqn.params["at_once"]:  # of a batch
        return None
    (flat, back), (flat_more, back_more) = _layout(eqn.outvars), _layout(eqn.invars[1 + number :])

    def f(carry, more):
        return flat(run(closed, [*back(carry), *back_more(more)]))

    return back(in_turn(f, asked.item(), flat(values[:number]), flat_more(values[number:])))


def _custom_linear_solve(run, eqn, *values):
    lengths, closed = eqn.params["const_lengths"], eqn.params["jaxprs"]
    flat, back = _layout(eqn.outvars)
    ends = np.cumsum([lengths.matvec, lengths.vecmat, lengths.solve, lengths.transpose_solve])
    *constants, b = [values[start:stop] for start, stop in zip([0, *ends], [*ends, None], strict=True)]
    if closed.transpose_solve is None or len(b) != len(eqn.outvars):  # no reverse mode, or results beside x
        return None
    scalars = flat(b)
    if not scalars or len({x.dtype for x in scalars}) > 1:
        return None

    def vector(name, constants):
        function = getattr(closed, name)
        return lambda x: jnp.stack(flat(run(function, [*constants, *back(list(x))])))

    matvec, _, solve, transpose_solve = map(vector, lengths._fields, constants)
    # as one vector: JAX does not transpose a solve of which some numbers on the right are constant, and some are not
    x = lax.custom_linear_solve(matvec, jnp.stack(scalars), lambda _, b: solve(b), lambda _, b: transpose_solve(b))
    return back(list(x))


def _custom_jvp_call(run, eqn, *values):
    """A function with a rule of its own for derivatives, which serves scalars too."""
    if not any(x.aval.shape for x in eqn.invars) or not all(
        jnp.issubdtype(x.aval.dtype, jnp.floating) for x in eqn.invars
    ):
        return None
    closed = eqn.params["call_jaxpr"]
    (flat, back), (flat_results, back_results) = _layout(eqn.invars), _layout(eqn.outvars)

    @jax.custom_jvp
    def call(*x):
        return flat_results(run(closed, back(x)))

    @call.defjvp
    def _(x, dx):
        shapes = [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in eqn.invars]
        rule = jax.make_jaxpr(lambda x, dx: jax.jvp(alone(eqn), x, dx))(shapes, shapes)
        results = run(rule, [*back(x), *back(dx)])
        half = len(results) // 2
        return flat_results(results[:half]), flat_results(results[half:])

    return back_results(call(*flat(values)))


def _family(run, eqn, x):
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
    "while": _while_loop,
    "custom_linear_solve": _custom_linear_solve,
    "custom_jvp_call": _custom_jvp_call,
}
