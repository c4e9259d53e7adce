"""A loop whose number of iterations is data, with derivatives forward and reverse."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import eval_jaxpr
from jax.custom_derivatives import SymbolicZero

from hhtjax.numerics.checkpointed_scan import checkpoint

SLOTS, LEVELS = 64, 3
LONGEST = SLOTS**LEVELS  # iterations that can be differentiated


def repeat(body, carry, count):
    """carry -> body(i, carry) for i = 0, ..., count - 1, count a traced integer.

    A plain while loop, so that another count costs no compilation. Its derivatives run through nested loops of fixed
    length that skip what is beyond count and keep the carry of `SLOTS` iterations on each of `LEVELS` levels, computing
    the levels below again: one more evaluation for each. Up to LONGEST iterations; beyond it they are NaN.
    """
    trace = jax.make_jaxpr(body)(jnp.zeros((), jnp.int32), carry)  # tells what body closes over, integers too
    structure = jax.tree.structure(carry)

    def traced(i, carry, *constants):
        return jax.tree.unflatten(structure, eval_jaxpr(trace.jaxpr, constants, i, *jax.tree.leaves(carry)))

    return _repeat(traced, count, carry, trace.consts)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _repeat(body, count, carry, constants):
    return lax.fori_loop(0, count, lambda i, carry: body(i, carry, *constants), carry)


@partial(_repeat.defjvp, symbolic_zeros=True)
def _(body, primals, tangents):
    """Constants without a tangent stay so: a long array of them would cost its length in every reverse iteration."""
    count, carry, constants = primals
    moves = [not isinstance(x, SymbolicZero) for x in tangents[2]]
    moving = [x for x, moved in zip(constants, moves, strict=True) if moved]

    def run(carry, moving):
        moving = iter(moving)
        mixed = [next(moving) if moved else x for x, moved in zip(constants, moves, strict=True)]
        return _repeat_in_levels(body, count, carry, mixed)

    carry_dot = jax.tree.map(_instantiate, tangents[1], is_leaf=lambda x: isinstance(x, SymbolicZero))
    moving_dot = [x for x in tangents[2] if not isinstance(x, SymbolicZero)]
    return jax.jvp(run, (carry, moving), (carry_dot, moving_dot))


def _instantiate(tangent):
    if not isinstance(tangent, SymbolicZero):
        return tangent
    like: Any = tangent.aval
    if like.dtype == jax.dtypes.float0:
        return np.zeros(like.shape, jax.dtypes.float0)
    return jnp.zeros(like.shape, like.dtype)


def _repeat_in_levels(body, count, carry, constants):
    def level(depth):
        """(first, carry) -> the carry after SLOTS**depth iterations from `first`."""
        if depth == 0:
            return lambda i, carry: body(i, carry, *constants)
        inner = level(depth - 1)

        def run(first, carry):
            @checkpoint
            def visit(carry, j):
                i = first + j * SLOTS ** (depth - 1)
                return lax.cond(i < count, inner, lambda i, carry: carry, i, carry), None

            return lax.scan(visit, carry, jnp.arange(SLOTS, dtype=jnp.int32))[0]

        return run

    carry = level(LEVELS)(jnp.zeros((), jnp.int32), carry)
    known = jnp.where(count <= LONGEST, 1.0, jnp.nan)  # a factor, so that derivatives are NaN too
    return jax.tree.map(lambda x: x * known.astype(x.dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x, carry)
