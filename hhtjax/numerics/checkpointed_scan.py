"""A scan whose reverse mode needs memory in proportion to the square root of its length."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jax import lax

# XLA:CPU runs a loop body serially, without handing each kernel to a thread pool, while no buffer in it
# exceeds 512 bytes. Short innermost loops keep what they stack below that: on a double pendulum saving every
# step then costs 1.1 times saving none (2.3 times in one long loop), and a gradient a third.
CHUNK = 16
KEPT = 2**20  # bytes; carries of all steps that take no more are kept: a copy of the step less to compile, and to run
KEPT_OF_MEMBER = 2**15  # of a batch: 34 MB of 256 double pendulums took 1.6 times as long to fill as to compute again

checkpoint = partial(jax.checkpoint, prevent_cse=False)  # inside a scan nothing can be merged anyway


def checkpointed_scan(body: Callable, carry: tuple, length: int, in_batch: bool = False):
    """`lax.scan(body, carry, None, length)` in blocks of about sqrt(length) steps, each in short chunks.

    The forward pass of reverse mode stores the carry before each block. The backward pass computes each block again,
    stores the carry before each of its steps, and computes each step once more. This needs memory for about 2
    sqrt(length) carries. If the carries of all steps are small, it stores them all and computes no block again. Forward
    evaluation and forward mode do no extra work.

    in_batch: whether this is one member of many.
    """
    if length <= 2 * CHUNK:
        return lax.scan(body, carry, None, length)
    chunk, chunks = _sizes(length)
    blocks, rest = divmod(length, chunk * chunks)

    body = checkpoint(body)
    size = length * sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(carry))
    keeps = size <= (KEPT_OF_MEMBER if in_batch else KEPT)

    def run_chunk(carry: tuple, _):
        return lax.scan(body, carry, None, chunk)

    def run_block(carry: tuple, _):
        return lax.scan(run_chunk, carry, None, chunks)

    carry, ys = lax.scan(run_block if keeps else checkpoint(run_block), carry, None, blocks)
    ys = jax.tree.map(lambda y: y.reshape(math.prod(y.shape[:3]), *y.shape[3:]), ys)
    if rest:
        carry, tail = lax.scan(body, carry, None, rest)
        ys = jax.tree.map(lambda y, z: jnp.concatenate([y, z]), ys, tail)
    return carry, ys


def _sizes(length: int):
    """Steps in a chunk and chunks in a block: without a rest if possible, then nearest to the aims."""
    root = math.sqrt(length)
    choices = [
        (chunk, chunks)
        for chunk in range(CHUNK // 2, 2 * CHUNK + 1)
        for chunks in range(math.ceil(root / (2 * chunk)), math.floor(2 * root / chunk) + 1)
        if length % (chunk * chunks) == 0
    ]
    if not choices:
        return CHUNK, max(1, round(root / CHUNK))
    return min(choices, key=lambda s: abs(math.log(s[0] * s[1] / root)) + abs(math.log(s[0] / CHUNK)))
