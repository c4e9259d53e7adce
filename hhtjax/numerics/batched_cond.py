"""A branch that is seldom taken: a batch takes it where one of its members asks, and pays nothing elsewhere."""

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
    """f(carry, *more), of the structure of the carry, where `asked`; else the carry.

    Of a plain condition vmap makes a choice between both, for every member and in every step. Members that have not
    asked go through f too where another one has, but neither its values nor its derivatives reach them.

    >>> import jax, jax.numpy as jnp
    >>> def root(x):
    ...     return call_where(jnp.sqrt, x > 1, x)
    >>> [float(y) for y in jax.vmap(root)(jnp.array([4.0, 0.0]))], [float(jax.grad(root)(x)) for x in (4.0, 0.0)]
    ([2.0, 0.0], [0.25, 1.0])
    """
    return if_any(_careful(f, asked), asked, carry, *more)


def call_where_alone(f: Callable, asked: Array, carry, *more):
    """The same, one member of a batch after the other, each as it is alone: for what is long, and seldom at one time.

    >>> import jax, jax.numpy as jnp
    >>> print(jax.vmap(lambda x: call_where_alone(jnp.sqrt, x > 1, x))(jnp.array([4.0, 0.0])))
    [2. 0.]
    """
    return if_any(partial(in_turn, _careful(f, asked), asked), asked, carry, *more)


def _careful(f: Callable, asked: Array):
    """f, of which only members that have asked see anything."""

    def branch(carry: PyTree, *more: PyTree):
        known = tree_where(asked, (carry, more), lax.stop_gradient((carry, more)))
        return tree_where(asked, f(known[0], *known[1]), carry)

    return branch


def if_any(f: Callable, asked: Array, carry: PyTree, *more: PyTree, kept: bool = True):
    """The same of an f that by itself leaves members alone that have not asked. kept: as of `largest_in_batch`."""
    return lax.cond(largest_in_batch(asked, kept), f, lambda carry, *_: carry, carry, *more)


def derivative_of(f: Callable, value: Callable) -> PyTree:
    """value(), which is what f() is, with the derivatives of f: for a way to the value that is no way to those.

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
    """value(*args), which is what f(*args) is, with the derivatives of f in those of the arguments that move.

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
    """The same, f traced for a derivative only, unless value closes over numbers that are not known.

    >>> import jax
    >>> print(jax.grad(lambda x: derivative_at_need(lambda x, y: x**y, lambda x, y: x * x, x, 2))(3.0))
    6.0
    """
    call, constants = hoisted(value, *args)
    if all_concrete(constants):
        return derivative_by(f, partial(call, constants), *args)
    return derivative_of(lambda: f(*args), lambda: call(constants, *args))
