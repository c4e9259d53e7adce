"""What a function closes over, as an argument of it."""

from __future__ import annotations

from collections.abc import Callable
from itertools import compress

import jax
from jax.core import eval_jaxpr
from jax.tree_util import Partial

from hhtjax.description import PyTree, is_concrete


def hoisted(f: Callable, *args: PyTree):
    """f as a function of (constants, *args), and the constants, all that it closes over; f itself runs once.

    `jax.closure_convert` leaves integers where they are, and a loop or a rule for derivatives would then hold tracers.

    >>> import jax, jax.numpy as jnp
    >>> n = jnp.array(3)
    >>> f, constants = hoisted(lambda x: {"product": x * n}, jnp.array(1.0))
    >>> len(constants), float(f(constants, jnp.array(2.0))["product"])
    (1, 6.0)
    """
    call, constants = opened(f, *args)
    return jax.jit(call), constants


def opened(f: Callable, *args: PyTree):
    """The same without a `jit` around it.

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
    """f as a pytree of what is being traced among all that it closes over: for a loop that hands f on.

    Args:
        f: a function of pytrees of arrays; it runs once.
        *args: these, or tracers of theirs.

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
