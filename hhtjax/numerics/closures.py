"""What a function closes over, as an argument of it."""

from __future__ import annotations

from collections.abc import Callable

import jax
from jax.core import eval_jaxpr

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


def carried(f: Callable, *args: PyTree):
    """f as a function of (constants, *args), and the constants, of all that it closes over only what is being traced:
    for a loop that hands f on.

    >>> import jax, jax.numpy as jnp
    >>> def root(x):
    ...     f, constants = carried(lambda y: x * y + jnp.arange(2.0), x)
    ...     return len(constants) + f(constants, x)
    >>> print(jax.jit(root)(3.0))
    [10. 11.]
    """
    trace, like = jax.make_jaxpr(f, return_shape=True)(*args)
    known = [is_concrete(x) for x in trace.consts]

    def call(constants: list, *args: PyTree):
        rest = iter(constants)
        given = [x if told else next(rest) for x, told in zip(trace.consts, known, strict=True)]
        return jax.tree.unflatten(jax.tree.structure(like), eval_jaxpr(trace.jaxpr, given, *jax.tree.leaves(args)))

    return jax.jit(call), [x for x, told in zip(trace.consts, known, strict=True) if not told]
