"""A step across events in its pieces, each smooth: what lies between the ends of a step is read off in one of them."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax


class Pieces(NamedTuple):
    """The parts of a step between its events, in their order: states (max_events + 1, ...) at which they start and end;
    those there are not start at infinity. modes: in each the numbers that switches have changed, where asked for."""

    start: Any
    end: Any
    modes: Any = ()

    @classmethod
    def none(cls, state, number, modes=()):
        """Room for so many, like a state, none of them there."""
        like, modes = jax.tree.map(lambda x: jnp.stack([jnp.zeros_like(x)] * number), (state, modes))
        return cls(like._replace(t=jnp.full_like(like.t, jnp.inf)), like, modes)

    def whole(self, start, end, modes=()):
        """A step without events."""

        def first(rows, x):
            return jnp.concatenate([x[None], rows[1:]])

        pieces = jax.tree.map(first, self, Pieces(start, end, modes if self.modes else self.modes))
        later = jnp.full_like(pieces.start.t[1:], jnp.inf)
        return pieces._replace(start=pieces.start._replace(t=jnp.concatenate([pieces.start.t[:1], later])))

    def divided(self, event, start, end, modes=()):
        """The last of them ends at an event; a new one is behind it."""
        new = jnp.sum(jnp.isfinite(self.start.t), dtype=jnp.int32)

        def put(rows, x, here):
            here = jnp.arange(len(rows), dtype=new.dtype) == here
            return jnp.where(here.reshape(-1, *[1] * x.ndim), x[None], rows)

        ends = jax.tree.map(partial(put, here=new - 1), self.end, event)
        pairs = (self.start, start), (ends, end), (self.modes, modes if self.modes else self.modes)
        return Pieces(*(jax.tree.map(partial(put, here=new), old, x) for old, x in pairs))

    def around(self, t):
        """The start and the end of the one in which a time lies, and the modes."""
        i = jnp.maximum(jnp.sum(self.start.t <= t, dtype=jnp.int32) - 1, 0)
        return jax.tree.map(lambda rows: lax.dynamic_index_in_dim(rows, i, keepdims=False), self)
