"""Steps for the error of a whole run: chosen again for a smaller tolerance, until that error is what was asked for.

Each round is the finer run by which the one before is judged, and it by that one: errors of runs follow the tolerance,
so that of the round, with a share s of it, is s / (s_before - s) of the difference between both.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from hhtjax.numerics.hoisted import hoisted
from hhtjax.numerics.seldom import derivative_by

ENOUGH, AIM = 0.8, 0.6  # of the tolerance: errors are stated to a tenth or two; and for the next round
LEAST, MOST = 1 / 16, 1 / 4  # of the share before: beyond, the coarser run may be too far off to judge by
ROUNDS = 8


class Round(NamedTuple):
    """run, steps, ends: what was found; share: of the tolerance that the steps were chosen for, and following: that of
    the next round; error, allowed: those of the `Solution`; is_open: whether more is to be done; number: of rounds."""

    run: Any
    steps: Any
    ends: Any
    share: Any
    following: Any
    error: Any
    allowed: Any
    is_open: Any
    number: Any

    def told(self):
        """What the `Solution` tells of it."""
        return {"error": self.error, "allowed": self.allowed}


def tighten(once, judge, one):
    """The last `Round`; none of it is differentiable, and all of it may be a batch, which goes on until all are done.

    once: share -> run, `Steps`, their ends; judge: a run, the one before, share of their difference -> error, allowed;
    one: the share to begin with, or one for each member.
    """
    found = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(once, one))
    error, allowed = jax.tree.map(jnp.zeros_like, jax.eval_shape(judge, found[0], found[0], one))
    run, steps, ends = found
    begun = Round(run, steps, ends, 2 * one, one, error, allowed, one > 0, jnp.zeros((), jnp.int32))

    def goes_on(last):
        return jnp.any(last.is_open) & (last.number < ROUNDS)

    def following(last):
        is_first = last.number == 0
        share = jnp.where(last.is_open, last.following, one)  # what costs least, for those who wait for others
        run, steps, ends = once(share)
        error, allowed = judge(run, last.run, jnp.where(last.is_open, share / (last.share - share), one))
        worst = jnp.where(is_first, jnp.inf, jnp.max(error, axis=-1))
        factor = jnp.where(is_first, MOST, jnp.clip(AIM * allowed / worst, LEAST, MOST))
        is_open = ~(worst <= ENOUGH * allowed) & (steps.stop == 0) & last.is_open
        new = Round(run, steps, ends, share, share * factor, error, allowed, is_open, last.number + 1)

        def kept(old, x):
            was_open = last.is_open.reshape(last.is_open.shape + (1,) * (x.ndim - last.is_open.ndim))
            return x if x.ndim < last.is_open.ndim else jnp.where(was_open, x, old)

        return jax.tree.map(kept, last, new)

    return lax.while_loop(goes_on, following, begun)


def accepted_run(last, over, start):
    """`last.run`, with the derivatives of over(start, steps, ends), a run over its steps that only they ask for."""
    over, closed_over = hoisted(over, start, last.steps, last.ends)

    def again(_, *args):
        return over(*args)

    return derivative_by(again, lambda run, *_: run, last.run, closed_over, start, last.steps, last.ends)
