"""What a function closes over, as an argument of it."""

from __future__ import annotations

from collections.abc import Callable

import jax
from jax.core import eval_jaxpr

from hhtjax.description import PyTree


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
