"""Finds operations of a jaxpr that cannot be part of one kernel. XLA would fail on the whole program because of them.

XLA:CPU compiles a call with the attribute `xla_cpu_small_call` into one function, with all its loops, if the emitter of
such functions supports all its operations. It does not support LAPACK, sorting, scattering, large sums and products.
The names here are those of JAX's operations. An operation that is not listed counts as unsupported: this can make a
program slower, but never wrong.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import Literal

from hhtjax.jaxpr.scalar_rules import ELEMENTWISE

if TYPE_CHECKING:
    from jax.extend.core import Jaxpr, JaxprEqn

LARGEST_SUM = 4095  # numbers of a sum; XLA hands larger ones to another library
FEW_TERMS = 32  # of a sum over an axis, up to which it is written out where the array is large
REDUCTIONS = {  # written in parts where the array is large: what combines two numbers, and many
    "reduce_sum": (lax.add, jnp.sum),
    "reduce_prod": (lax.mul, jnp.prod),
    "reduce_max": (lax.max, jnp.max),
    "reduce_min": (lax.min, jnp.min),
}
LARGEST_MATRIX = 4096  # elements of one that meets a vector
# of a kernel with more, compiling takes longer than 20 s, or fails: on one core 3 s for 4,700, 7 s for 8,500, 18 s for
# 13,900; gradients and branches take .2 to 1.2 ms an operation
MOST_OPERATIONS = 15_000
MOST_IN_BRANCH = 12_500  # the same in one branch, which is seldom taken
MOST_IN_BRANCHES = 15_000  # and in all together

KNOWN = ELEMENTWISE | {
    *("broadcast_in_dim", "concatenate", "dynamic_slice", "dynamic_update_slice", "expand_dims", "gather", "iota"),
    *("pad", "reshape", "rev", "shift_right_arithmetic", "shift_left", "shift_right_logical", "slice", "split"),
    *("squeeze", "stack", "transpose", "unstack", "optimization_barrier", "reduce_precision", "clz"),
    *("empty", "empty2", "eq_to", "le_to", "lt_to"),
    *("bessel_i1e", "digamma", "erf_inv", "erfc", "lgamma", "zeta", "copy_p", "pvary", "pcast", "population_count"),
    *("random_bits", "random_fold_in", "random_seed", "random_split", "random_unwrap", "random_wrap", "threefry2x32"),
    *("nextafter", "xla_metadata_value", "acosh", "square"),
    *("hhtjax_held", "hhtjax_largest_in_batch", "hhtjax_or_alone", "hhtjax_structural"),
}
SUMS = {
    *("argmax", "argmin", "reduce", "reduce_max", "reduce_min", "reduce_prod", "reduce_sum", "reduce_and", "reduce_or"),
    *("cumlogsumexp", "cummax", "cummin", "cumprod", "cumsum", "reduce_xor"),
}
INSIDE = {
    *("closed_call", "custom_jvp_call", "custom_lin", "custom_linear_solve", "custom_vjp_call", "eval_jaxpr"),
    *("hhtjax_kernel", "jit", "remat2", "scan", "while"),
}
REPLACED = "hhtjax_", "scatter", "dot_general"  # how names begin of operations that for_kernel.py may replace
DTYPES = {np.dtype(x) for x in ("float32", "float64", "bool", "int32", "int64", "uint32", "uint64")}


class Verdict(NamedTuple):
    """objection: why it cannot be one kernel, or None; eqns: the operation in question, and those around it;
    operations: of one that can be, their number."""

    objection: Any
    eqns: tuple = ()
    operations: int = 0


class _Objection(Exception):
    """Ends the search: why, and the operations, the innermost first."""

    def __init__(self, why: str, *eqns: JaxprEqn):
        self.why, self.eqns = why, eqns


def verdict(jaxpr: Jaxpr, before: bool = False) -> Verdict:
    """The `Verdict` on a jaxpr, all that it calls included.

    before: whether the jaxpr has not been rewritten by for_kernel.py yet. Then only objections count that remain after
    rewriting, so that hopeless cases need not be copied. The rewritten jaxpr may have more."""
    try:
        return Verdict(None, operations=sum(_count(jaxpr, MOST_OPERATIONS, before)))
    except _Objection as found:
        return Verdict(found.why, found.eqns)


def inner(eqn: JaxprEqn):
    """The jaxprs in an operation that are run."""
    name, params = eqn.primitive.name, eqn.params
    if name == "custom_linear_solve":
        found = [params["jaxprs"].solve]
    else:
        found = [x for x in jax.tree.leaves(list(params.values())) if hasattr(x, "eqns")]
    return [getattr(x, "jaxpr", x) for x in found]


def _count(jaxpr: Jaxpr, most: int, before: bool):
    """Number of operations, all and those in branches."""
    number = in_branches = 0
    asking = set()  # variables that ask whether a kernel holds them: in one that is known, and for_kernel.py drops them
    for eqn in jaxpr.eqns:
        number += 1
        name = eqn.primitive.name
        is_asking = not asking.isdisjoint(x for x in eqn.invars[:1] if not isinstance(x, Literal))
        if before and (name == "hhtjax_inside" or (is_asking and name != "cond")):
            asking.add(eqn.outvars[0])
        elif name in INSIDE or name == "cond":
            for x in inner(eqn)[1:] if is_asking else inner(eqn):
                try:
                    more, branches = _count(x, MOST_IN_BRANCH if name == "cond" else most, before)
                except _Objection as found:
                    found.eqns = (*found.eqns, eqn)
                    raise
                if name == "cond":
                    more, branches = 0, more + branches
                number, in_branches = number + more, in_branches + branches
        elif not (before and (name.startswith(REPLACED) or is_large_reduction(eqn))) and (
            objection := _objection(eqn, name)
        ):
            raise _Objection(objection, eqn)
        if number > most:
            raise _Objection(f"more than {most} operations")
        if in_branches > MOST_IN_BRANCHES:
            raise _Objection(f"more than {MOST_IN_BRANCHES} operations in branches")
    return number, in_branches


def _objection(eqn, name: str):
    odd = [x.aval for x in (*eqn.invars, *eqn.outvars) if not _is_usual(x.aval)]
    if odd:
        return f"{name} of {odd[0].str_short()}"
    if name in KNOWN:
        return None
    if name in SUMS:
        x = eqn.invars[0].aval
        return None if x.size <= LARGEST_SUM or x.dtype == bool else f"{name} of {x.str_short()}"
    if name == "dot_general":
        return None if is_of_vector(eqn) else f"{name} of {' and '.join(x.aval.str_short() for x in eqn.invars)}"
    return name


def is_large_reduction(eqn) -> bool:
    """Whether it is a sum, or the like, of so many numbers that for_kernel.py writes it in parts."""
    if eqn.primitive.name not in REDUCTIONS:
        return False
    x = eqn.invars[0].aval
    return x.size > LARGEST_SUM and np.issubdtype(x.dtype, np.floating)


def _is_usual(aval) -> bool:
    """Of numbers that the emitter has been seen with; keys of random numbers are arrays of these."""
    dtype: Any = getattr(aval, "dtype", None)
    return dtype in DTYPES or dtype == jax.dtypes.float0 or jnp.issubdtype(dtype, jax.dtypes.extended)


def lengths(eqn):
    """(terms, rows, columns) of a product, each over all its axes; a batch does not count."""
    (over, batch) = eqn.params["dimension_numbers"]
    shapes = [x.aval.shape for x in eqn.invars]
    sides = [
        math.prod(n for i, n in enumerate(shape) if i not in (*o, *b))
        for shape, o, b in zip(shapes, over, batch, strict=True)
    ]
    return math.prod(shapes[0][i] for i in over[0]), *sides


def is_of_vector(eqn) -> bool:
    """Whether a product is that of a vector with a matrix or a vector, batched or not. It can stay in a kernel."""
    _, rows, columns = lengths(eqn)
    largest = max(x.aval.size for x in eqn.invars)
    return min(rows, columns) <= 1 and largest <= (LARGEST_SUM if max(rows, columns) <= 1 else LARGEST_MATRIX)
