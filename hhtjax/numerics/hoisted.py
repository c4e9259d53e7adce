"""What a function closes over, as an argument of it."""

from typing import Any, NamedTuple

import jax
from jax.core import eval_jaxpr
from jax.interpreters import partial_eval as pe


def hoisted(f, *args):
    """f as a function of (constants, *args), and the constants, all that it closes over; f itself runs once.

    `jax.closure_convert` leaves integers where they are, and a loop or a rule for derivatives would then hold tracers.

    >>> import jax, jax.numpy as jnp
    >>> n = jnp.array(3)
    >>> f, constants = hoisted(lambda x: {"product": x * n}, jnp.array(1.0))
    >>> len(constants), float(f(constants, jnp.array(2.0))["product"])
    (1, 6.0)
    """
    trace, like = jax.make_jaxpr(f, return_shape=True)(*args)

    @jax.jit
    def call(constants, *args):
        return jax.tree.unflatten(jax.tree.structure(like), eval_jaxpr(trace.jaxpr, constants, *jax.tree.leaves(args)))

    return call, trace.consts


def traced(f, *like):
    """f, traced once, of arguments like these; each operation keeps the line that it comes from, which an inlined jit
    forgets.

    >>> import jax.numpy as jnp
    >>> double = traced(lambda x, y: {"double": 2 * x, "y": y}, jnp.array(1.0), jnp.array(1.0))
    >>> float(double(jnp.array(3.0), jnp.array(1.0))["double"]), double.reads(), double.reads([True, False])
    (6.0, [True, True], [True, False])
    """
    return Traced(*jax.make_jaxpr(f, return_shape=True)(*like))


class Traced(NamedTuple):
    """A function that has been traced."""

    trace: Any
    result: Any

    def __call__(self, *args):
        found = eval_jaxpr(self.trace.jaxpr, self.trace.consts, *jax.tree.leaves(args))
        return jax.tree.unflatten(jax.tree.structure(self.result), found)

    def reads(self, needed=None):
        """Which of the arrays in its arguments it makes those of its results from that are needed; None: all."""
        needed = [True] * len(self.trace.out_avals) if needed is None else list(needed)
        return pe.dce_jaxpr(self.trace.jaxpr, needed)[1]
