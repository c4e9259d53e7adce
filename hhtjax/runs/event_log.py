"""What a run tells of its events."""

from typing import Any, NamedTuple

import jax.numpy as jnp

from hhtjax.description.presentation import shown


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


def noted_down(log, t, which, q, before, after, rate):
    """`Events` on vectors, z within before and after, with one more, as long as there is room."""
    here = jnp.arange(log.t.size, dtype=log.count.dtype) == log.count

    def put(new, old):
        return jnp.where(here, new, old) if jnp.ndim(new) == 0 else jnp.where(here[:, None], new[None, :], old)

    entry = {"t": t, "which": which, "q": q, "before": before, "after": after, "rate": rate}
    return log._replace(count=log.count + 1, **{name: put(x, getattr(log, name)) for name, x in entry.items()})
