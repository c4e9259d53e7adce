"""Any optax optimiser on the cost; like Levenberg-Marquardt, a `lax.while_loop` that ends with a code."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from hhtjax.identification.losses import Objective
from hhtjax.identification.progress import (
    BAD_START,
    COST,
    GRADIENT,
    LIMIT,
    NO_INFLUENCE,
    RUNNING,
    STUCK,
    History,
    record,
    show,
)


class Smooth(NamedTuple):
    """A cost of residuals f(x) (m,), of which reverse mode gives the gradient."""

    f: Callable
    objective: Objective

    def cost(self, x):
        """Of all residuals."""
        return self.objective.cost(self.f(x))

    def read(self, _):
        """Nothing: residuals are evaluated apart."""
        return ()

    def slopes(self, x):
        """The gradient of the cost: (1, p)."""
        return jax.grad(self.cost)(x)[None, :]


def descend(problem, x, optimizer, tolerance, max_iterations, progress, patience=5):
    """An optax optimiser on the cost of a `Smooth` problem; returns the best point it saw."""
    import optax  # where a fit needs it: see `for_many`

    optimizer = optax.with_extra_args_support(optimizer)
    running = jnp.asarray(RUNNING, jnp.int32)

    def unfinished(carry):
        return carry[-1] == RUNNING

    def improve(carry):
        x, state, best, before, step, quiet, iteration, history, _ = carry
        value, gradient = jax.value_and_grad(problem.cost)(x)
        best = jax.tree.map(partial(jnp.where, value < best[1]), (x, value), best)
        history = record(history, iteration, value, step, None)
        quiet = jnp.where(jnp.abs(before - value) <= tolerance * value, quiet + 1, 0)
        code = jnp.where(iteration == max_iterations, LIMIT, running)
        code = jnp.where(quiet >= patience, COST, code)
        level = jnp.where((iteration == 0) & (value > 0), NO_INFLUENCE, GRADIENT)
        code = jnp.where(jnp.all(gradient == 0), level, code)
        code = jnp.where(jnp.isfinite(value), code, jnp.where(iteration == 0, BAD_START, STUCK))
        if progress:
            show(iteration, value, step, code)
        updates, state = optimizer.update(gradient, state, x, value=value, grad=gradient, value_fn=problem.cost)
        updates = jnp.where(code == RUNNING, jnp.asarray(updates), 0)
        iteration = jnp.where(code == RUNNING, iteration + 1, iteration)
        return x + updates, state, best, value, jnp.max(jnp.abs(updates)), quiet, iteration, history, code

    infinity = jnp.asarray(jnp.inf, x.dtype)
    empty = jnp.full(max_iterations + 1, jnp.nan, x.dtype)
    begin = x, optimizer.init(x), (x, infinity), infinity, jnp.zeros((), x.dtype)
    zero = jnp.zeros((), jnp.int32)
    carry = (*begin, zero, zero, History(empty, empty, None), running)
    _, _, (x, _), _, _, _, iterations, history, code = lax.while_loop(unfinished, improve, carry)
    return x, history, iterations, code
