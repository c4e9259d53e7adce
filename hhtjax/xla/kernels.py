"""Names by which a program tells where kernels shall be: a loop as one, and a barrier that fusion does not cross.

XLA:CPU runs a loop body as a list of kernels. Each costs a call, and so does every buffer between them: on a small
mechanism several times what the arithmetic costs. And what is fused is evaluated anew in every user: the sines of a
system once for every column of its Jacobian. So functions get names here, which autodiff and vmap keep, and an identity
stands on either side of a loop: when the program is lowered, with vmap and autodiff done, it lets lowering.py decide.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer, eval_jaxpr
from jax.extend.core import Primitive
from jax.interpreters import ad, batching

from hhtjax.xla.gate import is_on

# names of functions; autodiff and vmap keep them
KERNEL, STAGED, PART = "hhtjax_one_kernel", "hhtjax_staged", "hhtjax_part"
AROUND = KERNEL + "_around"
QUICKLY = "hhtjax_quickly"  # of programs that XLA compiles by its older way
WRITTEN_OUT = 32  # numbers of a sum in a loop, one after the other
LOOP = "hhtjax_loop"  # where the machinery is off: a name for `explain` to find, and nothing else


def one_kernel(f, *args, around=False):
    """f(*args) of pytrees of arrays, as one kernel where XLA can; the same values otherwise.

    Args:
        f: a function of pytrees of arrays.
        *args: these.
        around: whether f has kernels of its own, which it keeps where it cannot be one: `explain` tells of these.

    Returns:
        f(*args).

    Raises:
        whatever f raises.

    >>> float(one_kernel(lambda x: 2 * x, jnp.array(3.0)))
    6.0
    """
    if not is_on():
        return f(*args) if around else named(LOOP, f)(*args)
    f, constants = _closed(f, *args)
    return _watch(named(AROUND if around else KERNEL, f)(*_watch(args), *_watch(constants)))


def _closed(f, *args):
    """f as a function of its arguments and of floats that it closes over, and these: what may have derivatives.

    `jax.closure_convert` does it too, and keeps every f that it has met.
    """
    trace, like = jax.make_jaxpr(f, return_shape=True)(*args)
    moves = [isinstance(x, Tracer) and jnp.issubdtype(x.dtype, jnp.inexact) for x in trace.consts]

    def call(*args):
        leaves = iter(jax.tree.leaves(args))
        given = [next(leaves) for _ in trace.jaxpr.invars]
        constants = [next(leaves) if move else x for x, move in zip(trace.consts, moves, strict=True)]
        return jax.tree.unflatten(jax.tree.structure(like), eval_jaxpr(trace.jaxpr, constants, *given))

    return call, [x for x, move in zip(trace.consts, moves, strict=True) if move]


def staged(f, size=None):
    """f of pytrees of arrays; inside `one_kernel` its results are computed once, however many users they have.

    Args:
        f: a function of pytrees of arrays.
        size: number of unknowns. With a single one, of which a Jacobian has one column, nothing is shared.

    Returns:
        A function with the same values.

    Raises:
        whatever f raises, when it is called.

    >>> float(staged(lambda x: 2 * x)(jnp.array(3.0)))
    6.0
    """
    return f if size == 1 or not is_on() else named(STAGED, f)


def part(f, size=None):
    """f of pytrees of arrays; a kernel of its own where it is in none, and XLA would take long for its fusions.

    Args:
        f: a function of pytrees of arrays.
        size: number of unknowns. With a single one there is a kernel around.

    Returns:
        A function with the same values.

    Raises:
        whatever f raises, when it is called.

    >>> float(part(lambda x: 2 * x)(jnp.array(3.0)))
    6.0
    """
    return f if size == 1 or not is_on() else named(PART, f)


def choose(inside, outside, *args):
    """inside(*args) in one kernel, outside(*args) elsewhere: two ways to the same values.

    Args:
        inside, outside: functions of pytrees of arrays.
        *args: these.

    Returns:
        The values of both.

    Raises:
        whatever the two raise.

    >>> float(choose(lambda x: x + x, lambda x: 2 * x, jnp.array(3.0)))
    6.0
    """
    if not is_on():
        return outside(*args)
    return lax.cond(inside_p.bind(jax.tree.leaves(args)[0]), inside, outside, *args)


def structural(x):
    """The array x, whose zeros are such by structure, as in a unit vector: their products may be left out of sums.

    So the sum of 0 y and z is z, also where y is infinite or not a number.

    Args:
        x: an array.

    Returns:
        The same array.

    Raises:
        TypeError: x is no array.

    >>> print(structural(jnp.array([1.0, 0.0])))
    [1. 0.]
    """
    return structural_p.bind(x) if is_on() else jnp.asarray(x)


def largest_in_batch(x, kept=True):
    """The scalar x; under vmap the largest over the members, the same for all of them.

    A bound of a loop that is the same for all, or a condition: of a condition of their own vmap makes a choice, and
    every member takes both ways in every step. Here what few members need in few steps costs nothing in the others; the
    branch has to leave alone what members hold that have not asked for it.

    Args:
        x: an integer or boolean scalar.
        kept: False for a boolean that nothing else needs.

    Returns:
        A scalar, which vmap gives no axis.

    Raises:
        TypeError: x is no array.

    >>> seldom = jax.vmap(lambda x: lax.cond(largest_in_batch(x < 0), lambda x: jnp.maximum(x, 0), lambda x: x, x))
    >>> print(seldom(jnp.array([1.0, -2.0])))
    [1. 0.]
    """
    return largest_p.bind(x, kept=kept)


def or_alone(x):
    """Whether a member of a batch goes on while others do; what is no member always does, and never chooses.

    Args:
        x: a boolean scalar, true where there is no batch.

    Returns:
        x, or, without vmap, True.

    Raises:
        TypeError: x is no array.

    >>> print(or_alone(jnp.array(True)), jax.vmap(or_alone)(jnp.array([True, False])))
    True [ True False]
    """
    return alone_p.bind(x)


def named(name, f):
    """f as a function of this name in the program."""

    def call(*args):
        return f(*args)

    call.__name__ = name
    return jax.jit(call)


def _watch(tree):
    """An identity on either side of a call: whatever autodiff makes of it, one is behind the call or its transpose."""
    return jax.tree.map(watch_p.bind, tree)  # integers too: all that is used of a run may be the number of its steps


def _largest(values, axes, kept):
    """By halves and a sum where the booleans of a batch are in no array, which has instructions of its own."""
    x = jnp.moveaxis(values[0], axes[0], 0)
    if kept:
        return largest_p.bind(jnp.max(x, axis=0), kept=kept), None
    while len(x) > WRITTEN_OUT and len(x) % 2 == 0:
        x = x[: len(x) // 2] | x[len(x) // 2 :]
    return largest_p.bind(jnp.sum(x, axis=0, dtype=int) > 0, kept=kept), None


inside_p = Primitive("hhtjax_inside")  # whether a kernel holds it; the operand keeps it where the choice is
inside_p.def_impl(lambda x: jnp.array(False))
inside_p.def_abstract_eval(lambda x: x.update(shape=(), dtype=np.dtype(bool), weak_type=False))
batching.primitive_batchers[inside_p] = lambda values, axes: (inside_p.bind(*values), None)


structural_p = Primitive("hhtjax_structural")
structural_p.def_impl(jnp.asarray)
structural_p.def_abstract_eval(lambda x: x)
ad.deflinear2(structural_p, lambda cotangent, _: (cotangent,))
batching.defvectorized(structural_p)


largest_p = Primitive("hhtjax_largest_in_batch")
largest_p.def_impl(lambda x, kept: x)
largest_p.def_abstract_eval(lambda x, kept: x)
batching.primitive_batchers[largest_p] = _largest


alone_p = Primitive("hhtjax_or_alone")
alone_p.def_impl(lambda x: jnp.array(True))
alone_p.def_abstract_eval(lambda x: x)
batching.primitive_batchers[alone_p] = lambda values, axes: (values[0], axes[0])


watch_p = Primitive("hhtjax_watch")
watch_p.def_impl(lambda x: x)
watch_p.def_abstract_eval(lambda x: x)
ad.deflinear2(watch_p, lambda cotangent, _: (watch_p.bind(cotangent),))
batching.defvectorized(watch_p)
