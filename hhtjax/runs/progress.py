"""The bar on stderr: drawn between blocks of steps, so that the steps of a block stay one kernel."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax

from hhtjax.description import Array
from hhtjax.description.presentation import overwrite

MOST = 100  # times that a bar is drawn in a run
LEAST = 30_000  # steps between two, of one unknown: 1.5 ms, where to draw takes .15 ms


def announce():
    """Says on the line of the bar that a program is being compiled: called while it is traced, so only then."""
    overwrite("compiling ...", last=False)


def show_progress(count: Array, total: int, what: str):
    """A bar on stderr, about a hundred times in a run."""
    every = max(1, total // MOST)
    lax.cond((count % every == 0) | (count == total), lambda: draw(count, total, what), lambda: None)


def draw(count: Array, total: int, what: str):
    """The bar itself."""

    jax.debug.callback(lambda count: bar(int(count), total, what), count)


def bar(count: int, total: int, what: str):
    """The same of a number that is known."""
    overwrite(f"[{'#' * (count * 40 // total):<40}] {what} {count} of {total}", last=count == total)


def steps_between(total: int, unknowns: int) -> int:
    """How many steps lie between two drawings, so that these take little: a step of n takes n^2 at least."""
    return min(total, max(total // MOST, LEAST // unknowns**2, 1))


def in_blocks(scan: Callable, carry: tuple, length: int, least: int, show: Callable):
    """scan(carry, length), in blocks of `least` iterations or some more, with show(number of iterations) after each.

    scan: carry, number of iterations -> carry, what they return, stacked.
    """
    size = next((n for n in range(least, min(4 * least, length) + 1) if length % n == 0), least)
    blocks, rest = divmod(length, size)

    def block(carry: tuple, number: Array):
        carry, ys = scan(carry, size)
        show((number + 1) * size)
        return carry, ys

    carry, ys = lax.scan(block, carry, jnp.arange(blocks, dtype=jnp.int32))
    ys = jax.tree.map(lambda y: y.reshape(blocks * size, *y.shape[2:]), ys)
    if not rest:
        return carry, ys
    carry, tail = scan(carry, rest)
    show(jnp.asarray(length, jnp.int32))
    return carry, jax.tree.map(lambda y, z: jnp.concatenate([y, z]), ys, tail)
