"""A branch that is seldom taken, at its price only where it is: also in a batch."""

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jax.core import eval_jaxpr

from hhtjax.numerics.checkpointed_scan import checkpoint


def seldom(f, asked, carry):
    """f(carry), of the same structure, where `asked`, else the carry.

    A loop of at most one round: of a condition vmap would make a choice between both for every member, where of a loop
    it makes the rounds that some member needs. Derivatives are those of the condition, forward and reverse. Whatever f
    takes long for must depend on the carry: what does not, XLA computes before the loop, each time.

    >>> import jax, jax.numpy as jnp
    >>> def root(x):
    ...     return seldom(jnp.sqrt, x > 1, x)
    >>> [float(y) for y in jax.vmap(root)(jnp.array([4.0, 0.5]))], float(jax.grad(root)(4.0))
    ([2.0, 0.5], 0.25)
    """
    trace = jax.make_jaxpr(f)(carry)  # tells what f closes over
    structure = jax.tree.structure(carry)

    def traced(carry, *constants):
        return jax.tree.unflatten(structure, eval_jaxpr(trace.jaxpr, constants, *jax.tree.leaves(carry)))

    return _seldom(traced, asked, carry, trace.consts)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _seldom(f, asked, carry, constants):
    def once(state):
        return jnp.zeros_like(state[0]), f(state[1], *constants)

    return lax.while_loop(lambda state: state[0], once, (jnp.asarray(asked), carry))[1]


@_seldom.defjvp
def _(f, primals, tangents):
    def branch(asked, carry, constants):
        return lax.cond(asked, checkpoint(f), lambda carry, *_: carry, carry, *constants)

    return jax.jvp(branch, primals, tangents)
