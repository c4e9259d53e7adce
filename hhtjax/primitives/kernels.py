"""Marks in a program for its kernels: a loop that shall be one kernel, and results that shall be computed once.

XLA:CPU runs a loop body as a list of kernels. Each kernel costs a call, and each buffer between them costs time too. On
a small mechanism this takes several times as long as the arithmetic. Also, fused operations are evaluated again for
each user: the sines of a system, for example, once for every column of its Jacobian. Therefore a loop becomes one
operation here (kernel_primitive.py), which autodiff and vmap keep, and functions get names. When the program is
lowered, after vmap and autodiff, lowering.py decides which of them become kernels.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr, Primitive
from jax.interpreters import ad, batching

from hhtjax.description import Array, PyTree
from hhtjax.primitives.compat import is_on, why_off
from hhtjax.primitives.kernel_primitive import kernel_p

if TYPE_CHECKING:
    from hhtjax.primitives.interpreter import Traced

# names of functions; autodiff and vmap keep them
KERNEL, STAGED, PART = "hhtjax_one_kernel", "hhtjax_staged", "hhtjax_part"
AROUND = "hhtjax_around"
WRITTEN_OUT = 32  # numbers of a sum in a loop, one after the other


def one_kernel(f: Callable, *args: PyTree, around: bool = False):
    """f(*args) as one kernel if XLA can compile it so; otherwise the same values without it.

    Args:
        f: a function of pytrees of arrays.
        *args: its arguments.
        around: whether f contains kernels of its own. They remain if f cannot be one kernel, and `explain` reports
            them.

    Returns:
        f(*args).

    Raises:
        whatever f raises.

    >>> float(one_kernel(lambda x: 2 * x, jnp.array(3.0)))
    6.0
    """
    if off := why_off():
        return f(*args) if around else _told(off, f(*args))
    leaves, structure = jax.tree.flatten(args)
    leaves = [jnp.asarray(x) for x in leaves]

    def on_leaves(*leaves: Array):
        return f(*structure.unflatten(leaves))

    trace, like = jax.make_jaxpr(on_leaves, return_shape=True)(*leaves)
    closed, constants = _with_arguments(trace)
    if closed.effects:
        return f(*args) if around else _told(", ".join(sorted(map(str, closed.effects))), f(*args))
    found = kernel_p.bind(*leaves, *constants, closed=closed, name=AROUND if around else KERNEL)
    return jax.tree.structure(like).unflatten(found)


def _with_arguments(closed: ClosedJaxpr):
    """The closed jaxpr with those of its constants that are being traced as arguments, and these: they may have
    derivatives."""
    moves = [isinstance(x, Tracer) for x in closed.consts]
    constvars, more = ([x for x, m in zip(closed.jaxpr.constvars, moves, strict=True) if m == k] for k in (False, True))
    consts, values = ([x for x, m in zip(closed.consts, moves, strict=True) if m == k] for k in (False, True))
    return ClosedJaxpr(closed.jaxpr.replace(constvars=constvars, invars=[*closed.jaxpr.invars, *more]), consts), values


def staged(f: Callable | Traced, size: int | None = None) -> Callable | Traced:
    """The function f, whose results are computed only once inside `one_kernel`, however many users they have.

    Args:
        f: a function of pytrees of arrays.
        size: number of unknowns. With a single unknown a Jacobian has one column, and nothing is shared.

    Returns:
        A function with the same values.

    Raises:
        whatever f raises, when it is called.

    >>> float(staged(lambda x: 2 * x)(jnp.array(3.0)))
    6.0
    """
    return f if size == 1 or not is_on() else named(STAGED, f)


def part(f: Callable, size: int | None = None):
    """The function f, which becomes a kernel of its own if it is in no other, and if compiling its fusions would be
    slow.

    Args:
        f: a function of pytrees of arrays.
        size: number of unknowns. With a single unknown f is always inside a kernel.

    Returns:
        A function with the same values.

    Raises:
        whatever f raises, when it is called.

    >>> float(part(lambda x: 2 * x)(jnp.array(3.0)))
    6.0
    """
    return f if size == 1 or not is_on() else named(PART, f)


def choose(inside: Callable, outside: Callable, *args: PyTree) -> PyTree:
    """inside(*args) in one kernel, outside(*args) elsewhere. Both must give the same values.

    Args:
        inside, outside: functions of pytrees of arrays.
        *args: their arguments.

    Returns:
        The values.

    Raises:
        whatever the two raise.

    >>> float(choose(lambda x: x + x, lambda x: 2 * x, jnp.array(3.0)))
    6.0
    """
    if not is_on():
        return outside(*args)
    return lax.cond(inside_p.bind(jax.tree.leaves(args)[0]), inside, outside, *args)


def structural(x: np.ndarray) -> Array:
    """The array x with its zeros marked as structural, as in a unit vector. Products with them may be left out of sums.

    So the sum of 0 y and z is z, also if y is infinite or NaN.

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


def largest_in_batch(x: Array, kept: bool = True) -> Array:
    """The scalar x; under vmap the largest x of the batch, which all members share.

    Use it as a common bound of a loop, or as the condition of a branch. If members have different conditions, vmap
    evaluates both branches for every member in every step. With a common condition, a branch that few members need in
    few steps costs nothing in the other steps. The branch must not change the values of members that have not asked for
    it.

    Args:
        x: an integer or boolean scalar, or another one that no derivative is taken of.
        kept: False for a boolean that nothing else needs.

    Returns:
        A scalar, without a batch axis under vmap.

    Raises:
        TypeError: x is no array.

    >>> seldom = jax.vmap(lambda x: lax.cond(largest_in_batch(x < 0), lambda x: jnp.maximum(x, 0), lambda x: x, x))
    >>> print(seldom(jnp.array([1.0, -2.0])))
    [1. 0.]
    """
    return largest_p.bind(x, kept=kept)


def or_alone(x: Array) -> Array:
    """x for a member of a batch, True without a batch: whether the member goes on while others do.

    Without a batch there is nothing to select, so the condition is constant.

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


def named(name: str, f: Callable | Traced):
    """f as a function of this name in the program."""

    def call(*args: PyTree):
        return f(*args)

    call.__name__ = name
    return jax.jit(call)


def _told(why: str, tree: PyTree) -> PyTree:
    """The results of a loop that is no kernel, for `explain` to find."""
    loop = object()
    return jax.tree.map(lambda x: told_p.bind(x, why=why, loop=loop), tree)


def _largest(values: tuple, axes: tuple, kept: bool):
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


told_p = Primitive("hhtjax_told")
told_p.def_impl(lambda x, why, loop: x)
told_p.def_abstract_eval(lambda x, why, loop: x)
ad.deflinear2(told_p, lambda cotangent, _, why, loop: (told_p.bind(cotangent, why=why, loop=loop),))
batching.defvectorized(told_p)
