"""Turns the values that a function closes over into arguments."""

from __future__ import annotations

from collections.abc import Callable
from itertools import compress

import jax
from jax.core import eval_jaxpr
from jax.tree_util import Partial

from hhtjax.description import PyTree, is_concrete


def hoisted(f: Callable, *args: PyTree):
    """(f as a function of (constants, *args), the constants), where constants are all values that f closes over.

    f runs once. `jax.closure_convert` does not move integers, so that a loop or a derivative rule would hold tracers.

    >>> import jax, jax.numpy as jnp
    >>> n = jnp.array(3)
    >>> f, constants = hoisted(lambda x: {"product": x * n}, jnp.array(1.0))
    >>> len(constants), float(f(constants, jnp.array(2.0))["product"])
    (1, 6.0)
    """
    call, constants = opened(f, *args)
    return jax.jit(call), constants


def opened(f: Callable, *args: PyTree):
    """As `hoisted`, without a `jit` around f.

    >>> import jax, jax.numpy as jnp
    >>> n = jnp.array(3)
    >>> f, constants = opened(lambda x: x * n, jnp.array(1.0))
    >>> len(constants), float(f(constants, jnp.array(2.0)))
    (1, 6.0)
    """
    trace, like = jax.make_jaxpr(f, return_shape=True)(*args)

    def call(constants: list, *args: PyTree):
        return jax.tree.unflatten(jax.tree.structure(like), eval_jaxpr(trace.jaxpr, constants, *jax.tree.leaves(args)))

    return call, trace.consts


def carried(f: Callable, *args: PyTree) -> Partial:
    """f as a pytree whose leaves are the tracers that it closes over, for a loop that carries f.

    Args:
        f: a function of pytrees of arrays; it runs once.
        *args: its arguments, or tracers of them.

    Returns:
        A `jax.tree_util.Partial` with the same values.

    Raises:
        whatever f raises.

    >>> import jax, jax.numpy as jnp
    >>> def root(x):
    ...     f = carried(lambda y: x * y + jnp.arange(2.0), x)
    ...     return len(jax.tree.leaves(f)) + jax.tree.map(jnp.square, f)(x)
    >>> print(jax.jit(root)(3.0))
    [28. 29.]
    """
    call, constants = opened(f, *args)
    moves = [not is_concrete(x) for x in constants]

    def call_with(moving: list, *args: PyTree):
        rest = iter(moving)
        return call([next(rest) if m else x for m, x in zip(moves, constants, strict=True)], *args)

    return Partial(jax.jit(call_with), list(compress(constants, moves)))
