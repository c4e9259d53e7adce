"""A scan whose reverse mode needs memory in proportion to the square root of its length."""

import math
from functools import partial

import jax
import jax.numpy as jnp
from jax import lax

# XLA:CPU runs a loop body serially, without handing each kernel to a thread pool, while no buffer in it
# exceeds 512 bytes. Short innermost loops keep the outputs they stack below that: saving every step of a
# double pendulum then costs 1.2 times saving none, and its gradient half of what one long loop costs.
CHUNK = 16


def checkpointed_scan(body, carry, length):
    """`lax.scan(body, carry, None, length)` in blocks of about sqrt(length) steps, each in short chunks.

    Reverse mode stores the carry before each block, and computes a block again when it comes to it:
    memory for about sqrt(length) carries and the intermediate values of sqrt(length) steps, time for one
    more forward run. Forward evaluation and forward mode do no extra work.
    """
    if length <= 2 * CHUNK:
        return lax.scan(body, carry, None, length)
    chunk, chunks = _sizes(length)
    blocks, rest = divmod(length, chunk * chunks)

    def run_chunk(carry, _):
        return lax.scan(body, carry, None, chunk)

    @partial(jax.checkpoint, prevent_cse=False)  # the scan already keeps the two runs apart
    def run_block(carry, _):
        return lax.scan(run_chunk, carry, None, chunks)

    carry, ys = lax.scan(run_block, carry, None, blocks)
    ys = jax.tree.map(lambda y: y.reshape(-1, *y.shape[3:]), ys)
    if rest:
        carry, tail = lax.scan(body, carry, None, rest)
        ys = jax.tree.map(lambda y, z: jnp.concatenate([y, z]), ys, tail)
    return carry, ys


def _sizes(length):
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
