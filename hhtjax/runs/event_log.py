"""What a run tells of its events."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from hhtjax.description.presentation import shown
from hhtjax.xla import largest_in_batch, row_written

WHOLE = 65  # numbers, at least: an array of fewer would be taken to pieces


@shown
class Events(NamedTuple):
    """The events of a run, in their order; with `keep_events` entries, NaN (of `which` -1) beyond those that were met.

    Attributes:
        count: how many were met, also those beyond the entries.
        t: (keep_events,), when; differentiable.
        which: (keep_events,), the number of the event.
        q: where, like q0 with a leading axis; None of a first-order system.
        before, after: v before and after each, like v0 with a leading axis; y of a first-order system.
        z: internal states there, None without.
        rate: (keep_events,), dg/dt before. Where it is small beside the velocities the motion grazes the guard, and
            derivatives are huge, at last infinite.
    """

    count: Any
    t: Any
    which: Any
    q: Any
    before: Any
    after: Any
    z: Any
    rate: Any


class Log(NamedTuple):
    """The events met so far, on vectors: how many, a row of numbers for each that is kept, and one for all others."""

    count: Any
    rows: Any

    @classmethod
    def empty(cls, like, keep):
        """Room for so many rows like this one."""
        number = max(keep + 1, -(-WHOLE // like.size))
        return cls(jnp.zeros((), jnp.int32), jnp.full((number, like.size), jnp.nan, like.dtype))

    def with_more(self, rows, there, keep):
        """With those of the rows that are there, as long as there is room. What is written moves nothing else."""

        def enter(log, more):
            row, there = more
            return lax.cond(largest_in_batch(there), write, lambda log, *_: log, log, row, there), None

        def write(log, row, there):
            number = jnp.where(there & (log.count < keep), log.count, keep)
            return Log(log.count + there.astype(log.count.dtype), row_written(log.rows, row, number))

        return lax.scan(enter, self, (rows, there))[0]

    def told(self, flat, keep):
        """As `Events`."""
        n, N, rows = flat.positions, flat.size, self.rows[:keep]
        q, before, after = jnp.split(rows[:, 3:], [rows.shape[1] - 3 - 2 * N, rows.shape[1] - 3 - N], axis=1)
        t, which, rate = rows[:, 0], jnp.where(jnp.isnan(rows[:, 1]), -1, rows[:, 1]).astype(jnp.int32), rows[:, 2]
        z = None if n in (0, N) else jax.vmap(flat.unravel_internal)(before[:, n:])
        q, unravel = (jax.vmap(flat.unravel)(q), flat.unravel_rates) if n else (None, flat.unravel)
        before, after = (jax.vmap(lambda v: unravel(flat.located(v) if n else v))(v) for v in (before, after))
        return Events(self.count, t, which, q, before, after, z, rate)


def row_of(t, which, rate, q, before, after):
    """What is noted of an event."""
    return jnp.concatenate([jnp.stack([t, which.astype(t.dtype), rate]), q, before, after])
