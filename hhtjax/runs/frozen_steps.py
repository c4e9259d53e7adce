"""Steps that are chosen for one point, while the run over them is of another: how a fit freezes the steps of its runs.

The residuals are evaluated for two points at once, as a batch whose axis has a name. Wherever they simulate under error
control, inside whatever of jit, vmap and scan, the run takes the first point, and the choice of its steps the second.
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
    """f(x) of an array x, with the steps of all runs under error control as for y.

    >>> bool(with_steps_for(jnp.sin, jnp.ones(2), jnp.zeros(2))[0] == jnp.sin(1.0))
    True
    """
    pair = jnp.stack([x, lax.stop_gradient(y)])
    return jax.tree.map(lambda found: found[0], jax.vmap(f, axis_name=PAIR)(pair))


def run_and_choice(data: PyTree):
    """What a run starts from, and what its steps are chosen for, constant to derivatives: the same, but inside
    `with_steps_for`."""
    if not is_pair():
        return data, lax.stop_gradient(data)
    both = jax.tree.map(lambda x: lax.all_gather(x, PAIR) if is_array(x) else (x, x), data)
    run, choice = (jax.tree.map(lambda x, two, i=i: two[i], data, both) for i in (0, 1))
    return run, lax.stop_gradient(choice)


def frozen(f: Callable, *args: PyTree) -> PyTree:
    """f(*args), constant to derivatives also in what f closes over, as a force does over what is differentiated.

    args: the second of `run_and_choice`. To be called inside a jit: it compiles f anew.

    >>> float(jax.grad(lambda x: x * frozen(lambda y: x * y, 5.0))(3.0))
    15.0
    """
    call, closed_over = hoisted(f, *args)
    return call(run_and_choice(closed_over)[1], *args)


def chooses_steps(f: Callable, *args: PyTree) -> bool:
    """Whether there are runs under error control in f(*args).

    >>> chooses_steps(jnp.sin, jnp.ones(2))
    False
    """
    return calls(CONTROLLED, f, *args)


def is_pair() -> bool:
    """Whether both points of `with_steps_for` are here."""
    if not is_traced():  # JAX takes a millisecond to say that there is no such axis
        return False
    try:
        lax.axis_index(PAIR)
    except NameError:
        return False
    return True
