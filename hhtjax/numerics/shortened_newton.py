"""Newton's method with damping: a step is shortened until the step after it would be shorter."""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
from jax import lax

from hhtjax.description import Array, PyTree
from hhtjax.numerics.batched_cond import tree_where

ITERATIONS = 40  # at most
SHORTEST = 1e-3  # part of a step below which there is no way on


def improved(around: Callable, z: Array, *more: PyTree):
    """The best z that Newton's method finds, with steps that are shortened until the next would be shorter, the next
    step, and what else `around` tells there."""
    eps = float(jnp.finfo(z.dtype).eps)

    def unfinished(carry: tuple) -> Array:
        _, (_, energy, *_), first, part, count = carry
        small = (count > 0) & (energy <= eps**1.1 * first)
        return ~small & (part > SHORTEST) & (count < ITERATIONS)

    def improve(carry: tuple):
        z, best, first, part, count = carry
        trial = z - part * best[0]
        found = around(trial)
        better = found[1] < best[1]
        z, best = tree_where(better, (trial, found), (z, best))
        return z, best, jnp.where(count == 0, best[1], first), jnp.where(better, 1, part / 4), count + 1

    one = jnp.ones((), z.dtype)
    begin = z, (jnp.zeros_like(z), jnp.inf * one, *more), one, one, jnp.zeros((), jnp.int32)
    z, (dz, _, *found), *_ = lax.while_loop(unfinished, improve, begin)
    return z, dz, *found
