"""Branches that are seldom taken. A batch takes one only if a member asks for it; otherwise it costs nothing."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_derivatives import SymbolicZero

from hhtjax.description import Array, PyTree, all_concrete
from hhtjax.numerics.closures import hoisted
from hhtjax.primitives import in_turn, largest_in_batch


def tree_where(where: Array, x: PyTree, y: PyTree):
    """One of two trees."""
    return jax.tree.map(partial(jnp.where, where), x, y)


def call_where(f: Callable, asked: Array, carry: PyTree, *more: PyTree) -> PyTree:
    """f(carry, *more) if `asked`, otherwise the carry. f returns a pytree like the carry.

    For an ordinary `lax.cond` vmap evaluates both branches, for every member in every step. Here f is evaluated only if
    a member has asked. It is then evaluated for all members, but its values and derivatives reach only those that
    asked.

    >>> import jax, jax.numpy as jnp
    >>> def root(x):
    ...     return call_where(jnp.sqrt, x > 1, x)
    >>> [float(y) for y in jax.vmap(root)(jnp.array([4.0, 0.0]))], [float(jax.grad(root)(x)) for x in (4.0, 0.0)]
    ([2.0, 0.0], [0.25, 1.0])
    """
    return if_any(_careful(f, asked), asked, carry, *more)


def call_where_alone(f: Callable, asked: Array, carry, *more):
    """As `call_where`, with the members of a batch evaluated one by one: for a long f that few members need at a time.

    >>> import jax, jax.numpy as jnp
    >>> print(jax.vmap(lambda x: call_where_alone(jnp.sqrt, x > 1, x))(jnp.array([4.0, 0.0])))
    [2. 0.]
    """
    return if_any(partial(in_turn, _careful(f, asked), asked), asked, carry, *more)


def _careful(f: Callable, asked: Array):
    """f with results that reach only the members that have asked."""

    def branch(carry: PyTree, *more: PyTree):
        known = tree_where(asked, (carry, more), lax.stop_gradient((carry, more)))
        return tree_where(asked, f(known[0], *known[1]), carry)

    return branch


def if_any(f: Callable, asked: Array, carry: PyTree, *more: PyTree, kept: bool = True):
    """As `call_where`, for an f that itself ignores members that have not asked. kept: as for `largest_in_batch`."""
    return lax.cond(largest_in_batch(asked, kept), f, lambda carry, *_: carry, carry, *more)


def derivative_of(f: Callable, value: Callable) -> PyTree:
    """value() with the derivatives of f(). Both must be equal; use it if value cannot be differentiated.

    >>> import jax, jax.numpy as jnp
    >>> print(jax.grad(lambda x: derivative_of(lambda: x**2, lambda: x * x))(3.0))
    6.0
    """
    (value, in_value), (f, in_f) = map(hoisted, (value, f))

    @jax.custom_jvp
    def call(in_value: list, in_f: list) -> PyTree:
        return value(in_value)

    @call.defjvp
    def _(x: tuple, dx: tuple):
        return jax.jvp(f, x[1:], dx[1:])

    return call(in_value, in_f)


def derivative_by(f: Callable, value: Callable, *args) -> PyTree:
    """value(*args) with the derivatives of f(*args) by those arguments that have tangents. Both must be equal.

    >>> import jax
    >>> print(jax.grad(lambda x: derivative_by(lambda x, y: x**y, lambda x, y: x * x, x, 2))(3.0))
    6.0
    """
    leaves, structure = jax.tree.flatten(args)

    @jax.custom_jvp
    def call(leaves: list) -> PyTree:
        return value(*structure.unflatten(leaves))

    @partial(call.defjvp, symbolic_zeros=True)
    def _(primals: tuple, tangents: tuple):
        (x,), (dots,) = primals, tangents
        moving = [i for i, dot in enumerate(dots) if not isinstance(dot, SymbolicZero)]

        def of_moving(moved: list):
            new = dict(zip(moving, moved, strict=True))
            return f(*structure.unflatten([new.get(i, old) for i, old in enumerate(x)]))

        return jax.jvp(of_moving, ([x[i] for i in moving],), ([dots[i] for i in moving],))

    return call(leaves)


def derivative_at_need(f: Callable, value: Callable, *args):
    """As `derivative_by`, but f is traced only if a derivative is taken, unless value closes over tracers.

    >>> import jax
    >>> print(jax.grad(lambda x: derivative_at_need(lambda x, y: x**y, lambda x, y: x * x, x, 2))(3.0))
    6.0
    """
    call, constants = hoisted(value, *args)
    if all_concrete(constants):
        return derivative_by(f, partial(call, constants), *args)
    return derivative_of(lambda: f(*args), lambda: call(constants, *args))
