"""A traced program, evaluated operation by operation with NumPy: no compilation, and rounding can be disturbed.

What NumPy does otherwise than XLA (integer division, gather, scatter, LAPACK) is left to JAX, which compiles each
operation once. A witness independent of hhtjax: nothing of it is imported here.
"""

from functools import reduce

import jax
import numpy as np
from jax.extend.core import Literal
from numpy_arithmetic import ARITHMETIC, INEXACT, QUIET, SIGNLESS, SUMS, sum_over
from numpy_places import PLACES


class Numbers:
    """How operations are evaluated.

    noise: a generator by which each result of arithmetic, and each term of a sum, is disturbed by a few roundings.
    """

    def __init__(self, noise=None):
        self.noise = noise

    def __call__(self, closed, *args):
        """Values of the results of a closed jaxpr."""
        jaxpr, consts = closed.jaxpr, closed.consts
        known = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*map(np.asarray, consts), *args], strict=True))

        def read(atom):
            return np.asarray(atom.val, atom.aval.dtype) if isinstance(atom, Literal) else known[atom]

        for eqn in jaxpr.eqns:
            results = self.apply(eqn, [read(x) for x in eqn.invars])
            for variable, y in zip(eqn.outvars, results, strict=True):
                known[variable] = _as(y, variable.aval.dtype)
        return [read(x) for x in jaxpr.outvars]

    def apply(self, eqn, values):
        """The results of one operation."""
        name = eqn.primitive.name
        if name in CALLS:
            return CALLS[name](self, eqn.params, *values)
        inexact = np.issubdtype(eqn.outvars[0].aval.dtype, np.inexact)
        if self.noise is not None and name in SUMS:
            values = [self.disturbed(x) for x in values]
        if name in ARITHMETIC and (inexact or name not in INEXACT):
            results = [ARITHMETIC[name](eqn.params, *values)]
        elif name in MOVES:
            return MOVES[name](eqn, *values)
        elif name in PLACES and (name != "scatter" or eqn.params["update_jaxpr"] is None):
            results = PLACES[name](eqn, *values) or by_jax(eqn, values)
        elif name == "dot_general" and all(x.dtype == eqn.outvars[0].aval.dtype for x in values):
            results = [_dot_general(eqn, *values)]
        else:
            results = by_jax(eqn, values)
        if self.noise is None or name in QUIET:
            return results
        if name in SIGNLESS:
            results = [np.where(y == 0, np.copysign(y, self.noise.uniform(-1, 1)), y) for y in results]
        return [self.disturbed(y) for y in results]

    def disturbed(self, x):
        if not np.issubdtype(x.dtype, np.inexact):
            return x
        return (x * (1 + np.finfo(x.dtype).eps * self.noise.uniform(-2, 2, x.shape))).astype(x.dtype)


def _dot_general(eqn, x, y):
    (over, batch), letters = eqn.params["dimension_numbers"], iter("abcdefghijklmnopqrstuvwxyz")
    names = [[""] * x.ndim, [""] * y.ndim]
    for pairs in (batch, over):
        for i, j in zip(*pairs, strict=True):
            names[0][i] = names[1][j] = next(letters)
    result = [names[0][i] for i in batch[0]]
    for side in names:
        for i, letter in enumerate(side):
            if not letter:
                side[i] = next(letters)
                result.append(side[i])
    every = result + [names[0][i] for i in over[0]]
    aligned = []
    for z, side in zip((x, y), names, strict=True):
        order = sorted(range(z.ndim), key=lambda i: every.index(side[i]))
        lengths = [z.shape[side.index(a)] if a in side else 1 for a in every]
        aligned.append(z.transpose(order).reshape(lengths))
    return sum_over({"axes": range(len(result), len(every))}, aligned[0] * aligned[1])


def by_jax(eqn, values):
    """One operation, as JAX does it."""
    results = eqn.primitive.bind(*values, **eqn.primitive.get_bind_params(eqn.params))
    return [np.asarray(y) for y in (results if eqn.primitive.multiple_results else [results])]


def _as(y, dtype):
    return y if not isinstance(dtype, np.dtype) else np.asarray(y, dtype)


# Calls of functions.


def _cond(self, params, which, *values):
    return self(params["branches"][int(np.clip(which, 0, len(params["branches"]) - 1))], *values)


def _while(self, params, *values):
    first, second = params["cond_nconsts"], params["cond_nconsts"] + params["body_nconsts"]
    of_cond, of_body, carry = values[:first], values[first:second], list(values[second:])
    for _ in range(1000):
        goes_on = self(params["cond_jaxpr"], *of_cond, *carry)[0]
        if not goes_on.any():
            return carry
        after = self(params["body_jaxpr"], *of_body, *carry)
        if goes_on.ndim:  # a batch of loops
            after = [
                np.where(goes_on.reshape(goes_on.shape + (1,) * (y.ndim - goes_on.ndim)), y, x)
                for x, y in zip(carry, after, strict=True)
            ]
        carry = after
    raise ValueError("a loop without end")


def _scan(self, params, *values):
    kept = params["ft_in"].unpack() if "ft_in" in params else ()  # JAX >= 0.12
    number, carried = map(len, kept[:2]) if kept else (params["num_consts"], params["num_carry"])
    first, second = number, number + carried
    consts, carry, xs = values[:first], list(values[first:second]), values[second:]
    rows = [None] * params["length"]
    for i in reversed(range(params["length"])) if params["reverse"] else range(params["length"]):
        results = self(params["jaxpr"], *consts, *carry, *(x[i] for x in xs))
        carry, rows[i] = results[: second - first], results[second - first :]
    if not rows:
        return [*carry, *(np.zeros((0, *v.shape), v.dtype) for v in params["jaxpr"].out_avals[second - first :])]
    return [*carry, *map(np.stack, zip(*rows, strict=True))]


def _solve(self, params, *values):
    lengths, closed = params["const_lengths"], params["jaxprs"]
    start = lengths.matvec + lengths.vecmat
    b = values[start + lengths.solve + lengths.transpose_solve :]
    return self(closed.solve, *values[start : start + lengths.solve], *b)


def _called(key):
    return lambda self, params, *values: self(_closed(params[key]), *values)


def _closed(jaxpr):
    return jaxpr if hasattr(jaxpr, "consts") else jax.extend.core.ClosedJaxpr(jaxpr, ())


CALLS = {
    **{"cond": _cond, "while": _while, "scan": _scan, "custom_linear_solve": _solve},
    **{"jit": _called("jaxpr"), "closed_call": _called("call_jaxpr"), "remat2": _called("jaxpr")},
    "eval_jaxpr": _called("call_jaxpr"),
    "hhtjax_in_turn": lambda self, params, asked, *values: self(params["closed"], *values),
    **{"custom_jvp_call": _called("call_jaxpr"), "custom_vjp_call": _called("call_jaxpr")},
    **dict.fromkeys(("hhtjax_family", "hhtjax_bilinear", "hhtjax_map"), _called("jaxpr")),
}


# What moves numbers.


def _broadcast(eqn, x):
    shape, to = eqn.params["shape"], eqn.params["broadcast_dimensions"]
    lengths = [1] * len(shape)
    for i, n in zip(to, x.shape, strict=True):
        lengths[i] = n
    return [np.broadcast_to(x.reshape(lengths), shape)]


def _reshape(eqn, x):
    order = eqn.params.get("dimensions")
    return [(x if order is None else x.transpose(order)).reshape(eqn.outvars[0].aval.shape)]


def _slice(eqn, x):
    start, stop, steps = (eqn.params[key] for key in ("start_indices", "limit_indices", "strides"))
    return [x[tuple(slice(a, b, s) for a, b, s in zip(start, stop, steps or [1] * x.ndim, strict=True))]]


def _iota(eqn):
    out, axis = eqn.outvars[0].aval, eqn.params["dimension"]
    return [np.indices(out.shape, dtype=out.dtype)[axis]]


def _convert(eqn, x):
    to = eqn.outvars[0].aval.dtype
    if x.dtype == jax.dtypes.float0:  # the derivative of a truth
        return [np.zeros(x.shape, to)]
    if np.issubdtype(to, np.integer) and np.issubdtype(x.dtype, np.floating):  # NaN, and numbers too large
        low, high = np.iinfo(to).min, np.iinfo(to).max
        inside = (x > low) & (x < high)
        found = np.where(inside, x, 0).astype(to)
        return [np.where(inside | np.isnan(x), found, np.where(x > 0, to.type(high), to.type(low)))]
    return [x != 0 if to.kind == "b" else x.astype(to)]


def _split(eqn, x):
    return np.split(x, np.cumsum(eqn.params["sizes"])[:-1], eqn.params["axis"])


MOVES = {
    **{"broadcast_in_dim": _broadcast, "reshape": _reshape, "slice": _slice, "convert_element_type": _convert},
    **{"iota": _iota, "split": _split, "squeeze": lambda eqn, x: [x.reshape(eqn.outvars[0].aval.shape)]},
    "transpose": lambda eqn, x: [x.transpose(eqn.params["permutation"])],
    "concatenate": lambda eqn, *x: [np.concatenate(x, eqn.params["dimension"])],
    "stack": lambda eqn, *x: [np.stack(x, eqn.params["axis"])],
    "rev": lambda eqn, x: [np.flip(x, eqn.params["dimensions"])],
    "unstack": lambda eqn, x: list(np.moveaxis(x, eqn.params["axis"], 0)),
    **dict.fromkeys(
        ("hhtjax_held", "hhtjax_watch", "hhtjax_structural", "hhtjax_largest_in_batch"), lambda eqn, x: [x]
    ),
}


def size_of(closed):
    """Number of operations, those of functions within it included."""
    inner = [x for eqn in closed.eqns for x in jax.tree.leaves(list(eqn.params.values())) if hasattr(x, "eqns")]
    return reduce(lambda n, x: n + size_of(x), inner, len(closed.eqns))


def is_close(found, expected, rtol):
    """Of arrays of one shape and dtype: NaN in the same places, the same infinities, and the rest to rtol of the
    largest; whole numbers and truths exactly."""
    if found.shape != expected.shape or found.dtype != expected.dtype:
        return False
    if not np.issubdtype(expected.dtype, np.inexact):
        return bool((found == expected).all())
    finite = np.isfinite(expected)
    if not np.array_equal(found[~finite], expected[~finite], equal_nan=True) or not np.isfinite(found[finite]).all():
        return False
    rest, difference = expected[finite], found[finite] - expected[finite]
    return rest.size == 0 or bool((np.abs(difference) <= rtol * np.abs(rest).max()).all())


def signs(x):
    """Of zeros, -1 and 1; 0 elsewhere."""
    if not np.issubdtype(x.dtype, np.floating):
        return np.zeros(x.shape)
    return np.where(x == 0, np.copysign(1.0, x), 0.0)
