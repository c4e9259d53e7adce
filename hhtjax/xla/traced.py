"""A function that is traced once: without what nobody asks for, and with word of what it reads."""

from typing import Any, NamedTuple

import jax
from jax.core import eval_jaxpr
from jax.interpreters import partial_eval as pe


class Traced(NamedTuple):
    """A function that has been traced; made by `traced`.

    Attributes:
        jaxpr: it as a program of JAX.
        constants: what it closes over.
        result: shapes and dtypes of its results.
    """

    jaxpr: Any
    constants: Any
    result: Any

    def __call__(self, *args):
        found = eval_jaxpr(self.jaxpr, self.constants, *jax.tree.leaves(args))
        return jax.tree.unflatten(jax.tree.structure(self.result), found)

    def reads(self, needed):
        """Which of the arrays in its arguments it makes those of its results from that are needed: lists of booleans.

        Args:
            needed: for each array in the results; None: all.

        Returns:
            For each array in the arguments.

        Raises:
            AssertionError: there are fewer or more results.
        """
        needed = [True] * len(self.jaxpr.outvars) if needed is None else list(needed)
        return pe.dce_jaxpr(self.jaxpr, needed)[1]


def traced(f, *like):
    """f, traced once, of arguments like these, without operations that no result is made of.

    XLA would drop these too, but not from what it computes once, such as a stage, nor from the tracing and lowering
    before it. Each operation keeps the line that it comes from, which an inlined jit forgets.

    Args:
        f: a function of pytrees of arrays.
        *like: these, or tracers of theirs.

    Returns:
        `Traced`, a function with the same values.

    Raises:
        whatever f raises.

    >>> import jax.numpy as jnp
    >>> f = traced(lambda x, y: {"double": 2 * x, "y": y}, jnp.array(1.0), jnp.array(1.0))
    >>> float(f(jnp.array(3.0), jnp.array(1.0))["double"]), f.reads(None), f.reads([True, False])
    (6.0, [True, True], [True, False])
    """
    trace, result = jax.make_jaxpr(f, return_shape=True)(*like)
    needed, _ = pe.dce_jaxpr(trace.jaxpr, [True] * len(trace.out_avals), instantiate=True)
    return Traced(needed, trace.consts, result)
