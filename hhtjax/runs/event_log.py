"""What a run tells of its events."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from hhtjax.description.presentation import between, known, shown
from hhtjax.xla import block_written

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
        rate: (keep_events,), dg/dt before, the part of multipliers as they change over the step. Where it is small
            beside the velocities the motion grazes the guard, and derivatives are huge, at last infinite.
    """

    count: Any
    t: Any
    which: Any
    q: Any
    before: Any
    after: Any
    z: Any
    rate: Any

    def _verdict(self):
        """How many, and whether some are lost; of a batch the fewest and the most."""
        count, times = known(self.count), known(self.t)
        if count is None or times is None or not count.size or not times.ndim:
            return ""
        lost = f", {times.shape[-1]} kept" if count.max() > times.shape[-1] else ""
        return f"{between(count)} {'event' if count.max() == count.min() == 1 else 'events'}{lost}"


class Log(NamedTuple):
    """The events met so far, on vectors: how many, and a column of numbers for each that is kept, NaN beyond, and for
    those of one step more, of which nothing is told."""

    count: Any
    columns: Any

    @classmethod
    def empty(cls, like, keep, at_once):
        """Room for so many columns like this one, and for so many in a step."""
        number = max(keep + at_once, -(-WHOLE // like.size))
        return cls(jnp.zeros((), jnp.int32), jnp.full((like.size, number), jnp.nan, like.dtype))

    def with_more(self, rows, there, keep):
        """With the first of these, as many as are there, as long as there is room; the others are NaN."""
        places = jnp.cumsum(there, dtype=self.count.dtype) - 1
        numbers = jnp.arange(len(places), dtype=places.dtype)
        here = there[None, :] & (places[None, :] == numbers[:, None])  # some that are not there may be before
        rows = jnp.sum(jnp.where(here[:, :, None], rows[None], 0), axis=1)
        rows = jnp.where(jnp.any(here, axis=1)[:, None], rows, jnp.nan)
        columns = block_written(self.columns, rows.T, jnp.minimum(self.count, keep), axis=1)
        return Log(self.count + jnp.sum(there, dtype=self.count.dtype), columns)

    def told(self, flat, keep):
        """As `Events`."""
        n, N, columns = flat.positions, flat.size, self.columns[:, :keep]
        end = len(columns) - 2 * N  # of q, in which a rotation has nine numbers
        t, which, rate, *columns = jnp.split(columns, [1, 2, 3, end, end + N])
        which = jnp.where(jnp.isnan(which[0]), -1, which[0]).astype(jnp.int32)
        q, before, after = (x.reshape(-1, 1) if len(x) == 1 else x.T for x in columns)  # no copy
        z = None if n in (0, N) else jax.vmap(flat.unravel_internal)(before[:, n:])
        q, unravel = (jax.vmap(flat.unravel)(q), flat.unravel_rates) if n else (None, flat.unravel)
        before, after = (jax.vmap(lambda v: unravel(flat.located(v) if n else v))(v) for v in (before, after))
        return Events(self.count, t[0], which, q, before, after, z, rate[0])


def row_of(t, which, rate, q, before, after):
    """What is noted of an event."""
    return jnp.concatenate([jnp.stack([t, which.astype(t.dtype), rate]), q, before, after])
