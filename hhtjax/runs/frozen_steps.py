"""Frozen steps: a fit evaluates runs at one point with the steps that error control chose at another point.

The residuals are evaluated for both points together, as a batch whose axis has a name. Wherever they simulate under
error control, inside any jit, vmap and scan, the run uses the first point, and the choice of its steps the second.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax

from hhtjax.description import Array, PyTree, is_array
from hhtjax.numerics.closures import hoisted
from hhtjax.primitives import is_traced
from hhtjax.xla import calls

PAIR = "hhtjax: a run, and the choice of its steps"
CONTROLLED = {"run_over", "run_recorded", "run_chosen"}  # names of what runs over the steps that have been chosen


def with_steps_for(f: Callable, x: Array, y: Array) -> Array:
    """f(x) for an array x, with the steps of all runs under error control as chosen for y.

    >>> bool(with_steps_for(jnp.sin, jnp.ones(2), jnp.zeros(2))[0] == jnp.sin(1.0))
    True
    """
    pair = jnp.stack([x, lax.stop_gradient(y)])
    return jax.tree.map(lambda found: found[0], jax.vmap(f, axis_name=PAIR)(pair))


def run_and_choice(data: PyTree):
    """The start of a run, and the start for which its steps are chosen, constant for derivatives. Both are equal,
    except inside `with_steps_for`."""
    if not is_pair():
        return data, lax.stop_gradient(data)
    both = jax.tree.map(lambda x: lax.all_gather(x, PAIR) if is_array(x) else (x, x), data)
    run, choice = (jax.tree.map(lambda x, two, i=i: two[i], data, both) for i in (0, 1))
    return run, lax.stop_gradient(choice)


def frozen(f: Callable, *args: PyTree) -> PyTree:
    """f(*args), constant for derivatives, also in values that f closes over, as a force may do.

    args: the second result of `run_and_choice`. Call it inside a jit, because it compiles f anew.

    >>> float(jax.grad(lambda x: x * frozen(lambda y: x * y, 5.0))(3.0))
    15.0
    """
    call, closed_over = hoisted(f, *args)
    return call(run_and_choice(closed_over)[1], *args)


def chooses_steps(f: Callable, *args: PyTree) -> bool:
    """Whether f(*args) contains runs under error control.

    >>> chooses_steps(jnp.sin, jnp.ones(2))
    False
    """
    return calls(CONTROLLED, f, *args)


def is_pair() -> bool:
    """Whether both points of `with_steps_for` are present."""
    if not is_traced():  # JAX takes a millisecond to say that there is no such axis
        return False
    try:
        lax.axis_index(PAIR)
    except NameError:
        return False
    return True
