"""A run whose events are saved times, too."""

import jax
import jax.numpy as jnp

from hhtjax.runs.interpolate import on_axes

VALUES = "t", "q", "v", "acceleration", "multipliers", "z", "zdot", "friction", "sticking"


def with_event_rows(solution):
    """The `Solution` with a row before and a row behind each event, in the order of time; between which rows an event
    lies, and the places of the rows that were saved.

    What an event does not tell is there as at the saved time before it, and behind it. Where `events` has room left,
    the last row repeats.
    """
    events, last = solution.events, solution.t.shape[0] - 1
    met = ~jnp.isnan(events.t)
    behind = jnp.where(met, jnp.clip(jnp.searchsorted(solution.t, events.t), 1, last), last)
    told = {"t": (events.t,) * 2, "q": (events.q,) * 2, "v": (events.before, events.after), "z": (events.z,) * 2}

    def known(new, old):
        return jnp.where(on_axes(met, new), new, old)

    def rows(name):
        saved = getattr(solution, name)
        sides = [jax.tree.map(lambda x, i=i: x[i], saved) for i in (jnp.where(met, behind - 1, last), behind)]
        if name in told:
            sides = [jax.tree.map(known, new, old) for new, old in zip(told[name], sides, strict=True)]
        return jax.tree.map(lambda x, y, z: jnp.concatenate([_alternating(x, y), z]), *sides, saved)

    found = {name: rows(name) for name in VALUES}
    first = jnp.arange(found["t"].shape[0]) == 2 * met.size  # an event at the very start comes behind it
    order = jnp.argsort(jnp.where(first, -jnp.inf, jnp.where(jnp.isnan(found["t"]), jnp.inf, found["t"])), stable=True)
    across = (order[:-1] < 2 * met.size) & (order[:-1] % 2 == 0)
    saved = jnp.argsort(order)[2 * met.size :]
    return solution._replace(**jax.tree.map(lambda x: x[order], found)), across, saved


def _alternating(x, y):
    """x0, y0, x1, y1, ..."""
    return jnp.stack([x, y], axis=1).reshape(-1, *x.shape[1:])
