"""A branch that few members of a batch take in few steps: each of them by itself, one after the other."""

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jax.core import eval_jaxpr
from jax.extend.core import Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir

from hhtjax.xla.kernels import largest_in_batch


def in_turn(f, asked, carry, *more):
    """f(carry, *more), of the structure of the carry, where `asked`; else the carry.

    A batch visits those of its members that ask: what one of them takes is what it takes alone, and costs the others
    nothing. Derivatives are those of one conditional for the whole batch, in which all members go through f.

    Args:
        f: a function that by itself leaves members alone that have not asked.
        asked: a boolean scalar.
        carry, *more: pytrees of arrays.

    Returns:
        A pytree like the carry.

    Raises:
        whatever f raises; TypeError where it returns something else than the carry is.

    >>> def halved(x):
    ...     return in_turn(lambda x: jnp.where(x > 1, x / 2, x), x > 1, x)
    >>> print(jax.vmap(halved)(jnp.array([4.0, 0.5])), jax.grad(halved)(4.0))
    [2.  0.5] 0.5
    """
    leaves, structure = jax.tree.flatten(carry)
    leaves = [jnp.asarray(x) for x in leaves]
    others, of_more = jax.tree.flatten(more)

    def on_leaves(leaves, others):
        after, found = jax.tree.flatten(f(structure.unflatten(leaves), *of_more.unflatten(others)))
        if found != structure or any(jnp.shape(x) != y.shape for x, y in zip(after, leaves, strict=True)):
            raise TypeError(f"in_turn: the function must return what the carry is, {structure}; it returns {found}.")
        return [jnp.asarray(x, y.dtype) for x, y in zip(after, leaves, strict=True)]

    closed = jax.make_jaxpr(on_leaves)(leaves, others)
    branch = closed.replace(jaxpr=_with_constants(closed.jaxpr), consts=[])
    return structure.unflatten(visit(branch, asked, leaves, [*others, *closed.consts]))
