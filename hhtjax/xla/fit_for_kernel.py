"""What a jaxpr holds that cannot be part of one kernel: asked before XLA is, which would fail on the whole program.

XLA:CPU compiles a call that bears `xla_cpu_small_call` into one function, with all its loops, if all that is in it is
known to the emitter of such functions. LAPACK, sorting, scattering, large sums and products are not. Names here are
those of JAX's operations; one that is not listed is taken for unknown: slower, never wrong.
"""

import math
from typing import Any, NamedTuple

import jax
import numpy as np

from hhtjax.xla.parameters import ELEMENTWISE

LARGEST_SUM = 4095  # numbers of a sum; XLA hands larger ones to another library
LARGEST_MATRIX = 4096  # elements of one that meets a vector
MOST_OPERATIONS = 12_000  # of more, compiling takes long, or fails: LLVM takes 20 s for a gradient of 12,500
MOST_IN_BRANCH = 10_000  # the same in one branch, and in all together

KNOWN = ELEMENTWISE | {
    *("broadcast_in_dim", "concatenate", "dynamic_slice", "dynamic_update_slice", "expand_dims", "gather", "iota"),
    *("pad", "reshape", "rev", "shift_right_arithmetic", "shift_left", "shift_right_logical", "slice", "split"),
    *("squeeze", "stack", "transpose", "unstack", "optimization_barrier", "reduce_precision", "clz"),
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
    "while",
    "scan",
    "jit",
    "pjit",
    "closed_call",
    "core_call",
    "custom_jvp_call",
    "custom_vjp_call",
    "remat2",
} | {
    *("checkpoint", "custom_vjp_call_jaxpr", "remat", "custom_linear_solve", "hhtjax_kernel", "custom_lin"),
}
DTYPES = {np.dtype(x) for x in ("float32", "float64", "bool", "int32", "int64", "uint32", "uint64")}


class Verdict(NamedTuple):
    """objection: why it cannot be one kernel, or None; eqn: the operation in question, where it is one; operations: of
    one that can, their number."""

    objection: Any
    eqn: Any = None
    operations: int = 0


class _Objection(Exception):
    """Ends the search."""


def verdict(jaxpr):
    """The `Verdict` on a jaxpr, all that it calls included."""
    try:
        return Verdict(None, None, sum(_count(jaxpr, MOST_OPERATIONS)))
    except _Objection as found:
        return Verdict(*found.args)


def inner(eqn):
    """The jaxprs in an operation that are run."""
    name, params = eqn.primitive.name, eqn.params
    if name == "custom_linear_solve":
        found = [params["jaxprs"].solve]
    else:
        found = [x for x in jax.tree.leaves(list(params.values())) if hasattr(x, "eqns")]
    return [getattr(x, "jaxpr", x) for x in found]


def _count(jaxpr, most):
    """Number of operations, all and those in branches."""
    number = in_branches = 0
    for eqn in jaxpr.eqns:
        number += 1
        name = eqn.primitive.name
        if name == "cond":
            counts = [sum(_count(x, MOST_IN_BRANCH)) for x in inner(eqn)]
            in_branches += sum(counts)
        elif name in INSIDE:
            for x in inner(eqn):
                more, branches = _count(x, most)
                number, in_branches = number + more, in_branches + branches
        else:
            objection = _objection(eqn, name)
            if objection:
                raise _Objection(objection, eqn)
        if number > most or in_branches > MOST_IN_BRANCH:
            raise _Objection(f"more than {most} operations{' in branches' if in_branches > MOST_IN_BRANCH else ''}")
    return number, in_branches


def _objection(eqn, name):
    avals = [x.aval for x in (*eqn.invars, *eqn.outvars)]
    odd = [x for x in avals if getattr(x, "dtype", None) not in DTYPES and not _is_key(x)]
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


def _is_key(aval):
    return jax.dtypes.issubdtype(getattr(aval, "dtype", None), jax.dtypes.extended) or aval.dtype == jax.dtypes.float0


def lengths(eqn):
    """(terms, rows, columns) of a product, each over all its axes; a batch does not count."""
    (over, batch) = eqn.params["dimension_numbers"]
    shapes = [x.aval.shape for x in eqn.invars]
    sides = [
        math.prod(n for i, n in enumerate(shape) if i not in (*o, *b))
        for shape, o, b in zip(shapes, over, batch, strict=True)
    ]
    return math.prod(shapes[0][i] for i in over[0]), *sides


def is_of_vector(eqn):
    """Of a vector, batched or not: with a matrix, or another one, which is a sum. It stays in the kernel as it is."""
    _, rows, columns = lengths(eqn)
    largest = max(x.aval.size for x in eqn.invars)
    return min(rows, columns) <= 1 and largest <= (LARGEST_SUM if max(rows, columns) <= 1 else LARGEST_MATRIX)
