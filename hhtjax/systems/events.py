"""Events: a guard that falls to zero, and what becomes of the motion there.

    g(q, v, t) > 0 where the motion is allowed;   at g = 0:  v := reset(q, v, t),  params := switch(params),  or the end

How a step finds the time is in hhtjax/runs/meeting.py.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from hhtjax.checks import require_function, require_number
from hhtjax.description import Description, freeze, is_array, thaw
from hhtjax.numerics.seldom import seldom
from hhtjax.systems.constraints import answers, pull_back
from hhtjax.xla import consistent


@dataclass(frozen=True, eq=False)
class Event(Description):
    """Something that happens where a guard falls to zero: `simulate(..., events=[Event(...)])`.

    Args:
        guard: g, `guard(q, v, t, params)` -> a number, smooth, positive where the motion is allowed, negative beyond.
            It counts where it falls from positive to zero, not where it rises: for the other direction give -g, for
            both a mode that turns the sign, see `switch`. With internal states z stands behind v; of a
            `FirstOrderSystem` guard(y, t, params).
        reset: what the velocity becomes, `reset(q, v, t, params)` -> a pytree like v; or `impact(restitution)`. Of a
            `FirstOrderSystem` what y becomes. By default nothing changes. q cannot: it has to be continuous.
        switch: what the params become, `switch(params)`, of the same structure, shapes and dtypes. So a force that
            jumps is written with a mode, a number in params, and no `where` of the position in it: a step across the
            jump loses its order, and one that ends on it may find itself thrown back for ever. After an event that
            turns nothing back the guard would be negative: let it depend on the mode.
        terminal: whether the run ends there. The state stays what it was, time included.

    An event with none of the three is noted, and changes nothing: sections of a Poincare map, times of passage. Of
    events at one time those come first. Others happen one after the other, where none changes the rate of another's
    guard, as impacts of bodies that do not touch; else their order would matter, and the run fails by name.

    A guard that jumps below zero with what another event changes, as -v does in a rebound, has not fallen there: a
    noted event is not met, as in a run of SciPy's that begins anew behind the other, and any other fails by name. Note
    the rebounds by the guard of the impact.

    Resting contact is no event: a ball that comes to rest on the floor bounces infinitely often in a finite time, and
    the run fails by name when more than `max_events` fall into a step. Give contacts that last a stiff force, or a
    constraint in a run of its own that begins there.

    Raises:
        TypeError, ValueError: an argument of a wrong kind.

    >>> import jax.numpy as jnp, hhtjax
    >>> ball = hhtjax.System(mass=jnp.ones(1), force=lambda q, v, t, params: 0 * q - 9.81)
    >>> floor = hhtjax.Event(guard=lambda q, v, t, params: q[0], reset=hhtjax.impact(restitution="e"))
    >>> run = hhtjax.simulate(
    ...     ball, hhtjax.hht(), jnp.array([1.0]), jnp.zeros(1), {"e": 0.8}, dt=1e-2, num_steps=100, events=[floor])
    >>> run.check()
    >>> int(run.events.count), round(float(run.events.t[0]), 6)                # sqrt(2/9.81)
    (1, 0.451524)
    """

    guard: Callable
    reset: Any = None
    switch: Callable | None = None
    terminal: bool = False

    def __post_init__(self):
        require_function("Event", "guard", self.guard, "guard(...)")
        if self.reset is not None and not isinstance(self.reset, Impact):
            require_function("Event", "reset", self.reset, "reset(...)")
        if self.switch is not None:
            require_function("Event", "switch", self.switch, "switch(params)")
        if not isinstance(self.terminal, bool):
            raise TypeError(f"Event: `terminal` must be True or False; received {self.terminal!r}.")

    @property
    def is_noted(self):
        """Whether it changes nothing."""
        return self.reset is None and self.switch is None and not self.terminal


@dataclass(frozen=True, eq=False)
class Impact(Description):
    """Newton's law of impact along a guard; made by `impact`."""

    restitution: Any

    def coefficient(self, params):
        """e."""
        e = self.restitution
        if isinstance(e, str):
            return params[e]
        return e(params) if callable(e) else e


def impact(restitution: Any = 1.0) -> Impact:
    """Newton's law of impact, for `Event(reset=)`: an impulse along the guard g(q, t), without friction.

        v+ = v - (1 + e) M^-1 n (n.v + g_t)/(n.M^-1 n),    n = dg/dq

    With constraints the impulse obeys them: M x = n + B^T L, B x = 0 in the place of M^-1 n. Internal states stay.

    Args:
        restitution: e in [0, 1]: a number, the name of one in params, or a function of params. 0 ends in a resting
            contact, which is a failure that `check` names, unless something lifts the body off.

    Returns: what `Event` takes as `reset`.
    Raises: TypeError, ValueError: a restitution of a wrong kind, or outside [0, 1].

    References: F. Pfeiffer, C. Glocker, Multibody Dynamics with Unilateral Contacts, 1996.

    >>> import hhtjax
    >>> hhtjax.impact(1.2)
    Traceback (most recent call last):
    ValueError: impact: `restitution` must lie in [0, 1]; received 1.2.
    """
    if callable(restitution) and not is_array(restitution):
        require_function("impact", "restitution", restitution, "restitution(params)")
    elif not isinstance(restitution, str):
        require_number("impact", "restitution", restitution, lambda e: 0 <= e <= 1, "lie in [0, 1]")
    return Impact(restitution)


class FlatEvents(NamedTuple):
    """Events of a system on vectors; made by `flatten_events`. E is their number."""

    guards: Callable  # q, v, t, params -> (E,)
    outcome: Callable  # i, q, v, t, params in this step, params -> v, and the modes after event i
    noted: tuple  # (E,), whether it changes nothing
    ends: tuple  # (E,), whether the run ends there
    modes: Callable  # params -> a list of those of its numbers that a switch changes
    with_modes: Callable  # params, frozen or not, modes -> params

    def rates(self, system, s, params):
        """g, and dg/dt along the motion: (E,) each."""
        at = s.q, s.v, s.t
        along = system.rate(s.q, s.v), s.w, jnp.ones_like(s.t)
        return jax.jvp(lambda q, v, t: self.guards(q, v, t, params), at, along)


def flatten_events(system, events, params, redundant=None):
    """The events of a `FlatSystem`. redundant: how its constraints are solved."""
    calls = [consistent(partial(_on_vectors, system, event.guard)) for event in events]
    changed = sorted({i for event in events if event.switch for i in _changed(event.switch, params)})

    def guards(q, v, t, params):
        return jnp.stack([jnp.asarray(g(q, v, t, params)).astype(q.dtype).reshape(()) for g in calls])

    def modes(params):
        leaves = jax.tree.leaves(params)
        return [jnp.asarray(leaves[i]) for i in changed]

    def with_modes(params, modes):
        leaves, structure = jax.tree.flatten(thaw(params))
        for i, x in zip(changed, modes, strict=True):
            leaves[i] = x
        return structure.unflatten(leaves)

    def outcome_of(event, before, q, t, frozen):
        (v, old), (now, params) = before, thaw(frozen)
        after = params if event.switch is None else event.switch(params)
        new = [x.astype(y.dtype) for x, y in zip(modes(after), old, strict=True)]
        return _reset(system, event, redundant, q, v, t, now), new

    def outcome(i, q, v, t, now, params):
        after, frozen = (v, modes(params)), freeze((now, params))
        for number, event in enumerate(events):
            if not event.is_noted:
                after = seldom(partial(outcome_of, event), i == number, after, q, t, frozen)
        return after

    noted, ends = tuple(event.is_noted for event in events), tuple(event.terminal for event in events)
    return FlatEvents(guards, outcome, noted, ends, modes, with_modes)


def _on_vectors(system, function, q, v, t, params):
    """A user's function at a flat state."""
    if system.positions == 0:
        return function(system.unravel(v), t, params)
    internal = () if system.positions == system.size else (system.unravel_internal(v[system.positions :]),)
    return function(system.unravel(q), system.unravel_rates(system.located(v)), *internal, t, params)


def _changed(switch, params):
    """Numbers of the leaves of params that a switch changes."""
    leaves, structure = jax.tree.flatten(params)
    places = [i for i, x in enumerate(leaves) if is_array(x) or not callable(x)]

    def switched(data):
        filled = list(leaves)
        for i, x in zip(places, data, strict=True):
            filled[i] = x
        after = jax.tree.leaves(switch(structure.unflatten(filled)))
        return [after[i] for i in places]

    jaxpr = jax.make_jaxpr(switched)([leaves[i] for i in places]).jaxpr
    pairs = zip(places, jaxpr.invars, jaxpr.outvars, strict=True)
    return [i for i, before, after in pairs if after is not before]


def _reset(system, event, redundant, q, v, t, params):
    """The velocity (N,) after an event."""
    if event.reset is None:
        return v
    if isinstance(event.reset, Impact):
        guard = consistent(partial(_on_vectors, system, event.guard))
        return _bounced(system, guard, event.reset, redundant, q, v, t, params)
    new = ravel_pytree(consistent(partial(_on_vectors, system, event.reset))(q, v, t, params))[0].astype(v.dtype)
    return system.with_internal(jnp.pad(new, (0, system.size - new.size)), v)


def _bounced(system, guard, law, redundant, q, v, t, params):
    """v behind an impact; NaN where no velocity changes the guard."""
    e = jnp.asarray(law.coefficient(params)).astype(v.dtype)
    gradient, g_t = jax.grad(lambda q, t: jnp.asarray(guard(q, v, t, params)).reshape(()), argnums=(0, 1))(q, t)
    n = pull_back(system, q, gradient)
    x, _ = answers(system, q, t, params, redundant)(n)
    mobility = jnp.sum(n * x)
    approach = jnp.sum(n * v) + g_t
    return v - (1 + e) * approach / jnp.where(mobility > 0, mobility, jnp.nan) * x
