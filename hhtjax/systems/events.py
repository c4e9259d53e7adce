"""Events: a guard that falls to zero, or a known time, and how the motion changes there.

    g(q, v, t) > 0 where the motion is allowed;   at g = 0:  v := reset(q, v, t),  params := switch(params),  or the end

hhtjax/runs/event_step.py finds the time within a step.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree

from hhtjax.checks import in_words, require_function, require_number
from hhtjax.description import Array, Description, PyTree, Real, as_float, freeze, is_array, is_concrete, is_real, thaw
from hhtjax.numerics.batched_cond import call_where
from hhtjax.primitives import consistent
from hhtjax.systems.constraints import answers, pull_back
from hhtjax.systems.sampled import SLOP

if TYPE_CHECKING:
    from hhtjax.systems.flat_system import FlatSystem


@dataclass(frozen=True, eq=False)
class Event(Description):
    """Something that happens when a guard falls to zero, or at known times: `simulate(..., events=[Event(...)])`.

    Args:
        guard: g, `guard(q, v, t, params)` -> a number, smooth, positive where the motion is allowed, negative beyond.
            The event happens when g falls from positive to zero, not when it rises. For the other direction give -g.
            For both directions let a mode change the sign, see `switch`. With internal states z follows v; for a
            `FirstOrderSystem` write guard(y, t, params). A further argument named `multipliers`, as in
            `guard(q, v, t, params, multipliers)`, receives the multipliers L (m,) of the constraint. Use it to end a
            contact described by a constraint when its multiplier falls to zero.
        reset: the velocity after the event, `reset(q, v, t, params)` -> a pytree like v; or `impact(restitution)`. For
            a `FirstOrderSystem` the new y. Default: no change. q cannot change: it is continuous.
        switch: the params after the event, `switch(params)`, of the same structure, shapes and dtypes; or
            `switch(q, v, t, params)`, with the state before the event (arguments as for a guard). Use it for a force
            that jumps: let the force depend on a mode, a number in params, and not on a `where` of the position. A step
            across such a `where` loses its order, and at its edge the motion may be thrown back again and again. If the
            event does not turn the motion back, the guard stays negative after it. The guard must then depend on the
            mode, too.
        terminal: whether the run ends there. All later saved times then repeat the time and the state of the event.
        at: the times at which the event happens, instead of a guard: a number, (K,) in increasing order, or
            `at(params)` -> one of these, called with the params of the start. Steps are divided there, and a run is
            differentiable in the times. Times before t0 are ignored; one at t0 happens at the start of the first step.

    An event without reset, switch and terminal is only recorded and changes nothing. Use it for sections of a Poincare
    map, or times of passage. Of simultaneous events, recorded ones come first. The others happen one after the other if
    none changes the rate of another's guard. Impacts of bodies that do not touch are an example. Otherwise their order
    would matter, and the run fails with a message.

    A guard may jump below zero because another event changes something. The guard -v, for example, jumps in a rebound.
    This is not a crossing. An event that is only recorded then does not happen. (SciPy gives the same result if you
    start a new run after the other event.) If the event is not only recorded, the run fails with a message. To record
    rebounds, use the guard of the impact. Only a guard that reads multipliers may jump, because forces jump, for
    example when a load is switched on; its event then happens at once.

    For such a guard, L within a step is a blend of linear interpolation and the values of a partial step. The time of
    the event has order 2, like the saved L. Its derivatives are those of the computed run, and have order 1.

    Events do not model resting contact. A ball that comes to rest on the floor bounces infinitely often in a finite
    time, and the run fails when more than `max_events` events fall into one step. For lasting contact use a `Contact`
    of the system. In three dimensions use a stiff force, or a constraint that one event switches on and another
    switches off when its multiplier falls to zero: see `hhtjax.scenes.shaken_table`. A body may start at rest at its
    guard if its acceleration lifts it off.

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

    Example: a load is switched on at a given time. The derivative of the final position with respect to that time is
    -F (1 - time)/m:

    >>> import jax
    >>> body = hhtjax.System(mass=jnp.full(1, 2.0), force=lambda q, v, t, params: params["F"] + 0 * q)
    >>> def where(time):
    ...     load = hhtjax.Event(at=lambda params: params["time"], switch=lambda params: params | {"F": 3.0})
    ...     params = {"F": 0.0, "time": time}
    ...     return hhtjax.simulate(
    ...         body, hhtjax.hht(), jnp.zeros(1), jnp.zeros(1), params, dt=0.1, num_steps=10, events=[load]).q[-1, 0]
    >>> [round(float(f(0.62)), 6) for f in (where, jax.grad(where))]           # 3 (1 - .62)^2/4, -3 (1 - .62)/2
    [0.1083, -0.57]
    """

    guard: Callable | None = None
    reset: Any = None
    switch: Callable | None = None
    terminal: bool = False
    at: Any = None

    def __post_init__(self):
        if (self.guard is None) == (self.at is None):
            raise TypeError(f"Event: give either `guard` or `at`; received guard={self.guard!r} and at={self.at!r}.")
        if self.guard is not None:
            require_function("Event", "guard", self.guard, "guard(...)")
        else:
            object.__setattr__(self, "at", _required_times(self.at))
        if self.reset is not None and not isinstance(self.reset, Impact):
            require_function("Event", "reset", self.reset, "reset(...)")
        if self.at is not None and isinstance(self.reset, Impact):
            raise TypeError("Event: an impact needs the direction of a `guard`; received `at` without one.")
        if self.switch is not None:
            require_function("Event", "switch", self.switch, "switch(...)")
            if not any(_takes(self.switch, count) for count in SWITCHES):
                raise TypeError(
                    "Event: `switch` is called as switch(params) or switch(q, v, t, params); received a function of "
                    f"{in_words(inspect.signature(self.switch))}."
                )
        if not isinstance(self.terminal, bool):
            raise TypeError(f"Event: `terminal` must be True or False; received {self.terminal!r}.")

    @property
    def is_noted(self) -> bool:
        """Whether it is only recorded and changes nothing."""
        return self.reset is None and self.switch is None and not self.terminal

    @property
    def sees_multipliers(self) -> bool:
        """Whether its guard has an argument `multipliers`."""
        return self.guard is not None and "multipliers" in _parameters(self.guard)

    @property
    def switch_sees_state(self) -> bool:
        """Whether its switch takes the state too."""
        return self.switch is not None and not _takes(self.switch, 1)

    def times(self, params: PyTree) -> Array:
        """The times of `at`, (K,); NaN if they do not increase."""
        times = jnp.atleast_1d(as_float(self.at(params) if callable(self.at) else self.at))
        return jnp.where(jnp.all(times[1:] >= times[:-1]), times, jnp.nan)


SWITCHES = 1, 3, 4, 5  # how many arguments: params, and before it y, t of a first-order system, q, v, t, or q, v, z, t


def _required_times(at: PyTree):
    """The argument `at` of an `Event`, checked; times given as values become an array."""
    if callable(at) and not is_array(at):
        require_function("Event", "at", at, "at(params)")
        return at
    at = np.asarray(at) if isinstance(at, (int, float, list, tuple)) and not isinstance(at, bool) else at
    if not (is_array(at) and is_real(at)):
        raise TypeError(f"Event: `at` must be a time, (K,) times, or a function at(params); received {at!r}.")
    require_times("Event", at)
    return at.astype(float) if isinstance(at, (np.ndarray, np.generic)) and at.dtype.kind in "iu" else at


def require_times(caller: str, times: np.ndarray):
    """Raises an error for times that are not numbers (K,) in increasing order; tracers pass."""
    if np.ndim(times) > 1 or not np.size(times):
        raise ValueError(f"{caller}: `at` must be a number, or of shape (K,); received the shape {np.shape(times)}.")
    if is_concrete(times):
        known = np.atleast_1d(np.asarray(times))
        wrong = np.flatnonzero(~(known[1:] >= known[:-1]))
        if np.isnan(known).any() or wrong.size:
            raise ValueError(f"{caller}: `at` must hold numbers in increasing order; received {np.asarray(times)}.")


def _parameters(function: Callable):
    """The names of its arguments; an empty list if it has no signature."""
    try:
        return list(inspect.signature(function).parameters)
    except (TypeError, ValueError):
        return []


def _takes(function: Callable, count: int) -> bool:
    """Whether it can be called with `count` arguments; without a signature, whether count is 1."""
    try:
        inspect.signature(function).bind(*range(count))
    except (TypeError, ValueError) as error:
        return isinstance(error, ValueError) and count == 1
    return True


@dataclass(frozen=True, eq=False)
class Impact(Description):
    """Newton's law of impact along a guard; made by `impact`."""

    restitution: Any

    def coefficient(self, params: PyTree):
        """The coefficient of restitution e."""
        e = self.restitution
        if isinstance(e, str):
            return params[e]
        return e(params) if callable(e) else e


def impact(restitution: Real | str = 1.0) -> Impact:
    """Newton's law of impact, for `Event(reset=)`: an impulse along the guard g(q, t), without friction.

        v+ = v - (1 + e) M^-1 n (n.v + g_t)/(n.M^-1 n),    n = dg/dq

    With constraints the impulse obeys them: x with M x = n + B^T L, B x = 0 replaces M^-1 n. Internal states do not
    change.

    Args:
        restitution: e in [0, 1]: a number, the name of a number in params, or a function of params. e = 0 ends in
            resting contact, which is a failure that `check` reports unless something lifts the body off.

    Returns: a value for the argument `reset` of `Event`.
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

    values: Callable  # state, params, the next of the known times -> (E,)
    outcome: Callable  # i, state, params in this step, params -> v, and the modes after event i
    noted: tuple  # (E,), whether it changes nothing
    ends: tuple  # (E,), whether the run ends there
    forced: tuple  # (E,), whether its guard is one of multipliers, which may jump
    times: tuple  # (E,), the times at which it happens, (K,), or None
    switches: bool  # whether one of them changes params
    modes: Callable  # params -> a list of those of its numbers that a switch changes
    with_modes: Callable  # params, modes -> params

    @property
    def timed(self):
        """(E,), whether it happens at known times."""
        return tuple(times is not None for times in self.times)

    @property
    def still(self) -> FlatEvents:
        """As it is, but derivatives treat the times as constants."""
        return self._replace(times=lax.stop_gradient(self.times))

    def guards(self, s, params: PyTree, over: list) -> Array:
        """g, (E,). over: for each event with known times, how many of them have passed."""
        return self.values(s, params, next_times(self.times, over))

    def rates(self, system: FlatSystem, s, params: PyTree, over: list, Ldot=None):
        """g, and dg/dt along the motion: (E,) each. Ldot: the rate of the multipliers."""
        at = s.q, s.v, s.t
        along = system.rate(s.q, s.v), s.w, jnp.ones_like(s.t)
        if any(self.forced):
            at, along = (*at, s.L), (*along, Ldot)

        def guards(q: Array, v: Array, t: Array, L=None) -> Array:
            return self.guards(s._replace(q=q, v=v, t=t, L=s.L if L is None else L), params, over)

        return jax.jvp(guards, at, along)

    def slope(self, s, s1, h: Array) -> Any:
        """The rate of the multipliers between two states, if a guard uses multipliers."""
        return (s1.L - s.L) / jnp.where(h > 0, h, 1) if any(self.forced) else None

    def both(self, system: FlatSystem, s, s1, params: PyTree, over: list, h: Array):
        """The guards and their rates at both ends of a step."""
        Ldot = self.slope(s, s1, h)
        return [self.rates(system, x, params, over, Ldot) for x in (s, s1)]

    def before_any(self, t: Array):
        """For each event with known times, how many of them have passed before the run starts."""

        def passed(times: Array) -> Array:
            slack = SLOP * float(jnp.finfo(t.dtype).eps) * (jnp.abs(t) + jnp.abs(times))
            return jnp.sum(times < t - slack, dtype=jnp.int32)

        return [passed(times) for times in self.times if times is not None]

    def passed(self, i: Array, over: list):
        """`over` after event i."""
        numbers = [number for number, here in enumerate(self.timed) if here]
        return [x + (i == number).astype(x.dtype) for number, x in zip(numbers, over, strict=True)]

    def due_after(self, t, over):
        """The next known time that is more than a rounding after t; inf if there is none."""
        later = t + SLOP * float(jnp.finfo(t.dtype).eps) * jnp.abs(t)
        due = [jnp.where(time > later, time, jnp.inf) for time in next_times(self.times, over)]
        return jnp.min(jnp.stack([jnp.full_like(t, jnp.inf), *due]))


def next_times(times: tuple, over: list):
    """The next time of each event with known times; inf if none is left."""
    known = [x for x in times if x is not None]
    return [_first_left(x, passed) for x, passed in zip(known, over, strict=True)]


def _first_left(times: Array, over: Array) -> Array:
    """The first of the times (K,) that has not passed; inf if all have."""
    last = len(times) - 1
    time = times[0] if last == 0 else lax.dynamic_index_in_dim(times, jnp.minimum(over, last), keepdims=False)
    return jnp.where(over > last, jnp.inf, time)


def flatten_events(system: FlatSystem, events: tuple, params: PyTree, at: tuple, redundant=None) -> FlatEvents:
    """The events of a `FlatSystem`. at: q, v, t of the start; redundant: how its constraints are solved."""
    changed = sorted({i for event in events if event.switch for i in _changed(system, event, params, at)})
    times = tuple(None if event.at is None else event.times(thaw(params)).astype(at[1].dtype) for event in events)
    guards = [None if event.guard is None else consistent(partial(_guard, system, event)) for event in events]

    def values(s, params: PyTree, due) -> Array:
        due = iter(due)
        values = [next(due) - s.t if guard is None else guard(s.q, s.v, s.t, s.L, params) for guard in guards]
        return jnp.stack([jnp.asarray(g).astype(s.v.dtype).reshape(()) for g in values])

    def modes(params: PyTree):
        leaves = jax.tree.leaves(params)
        return [jnp.asarray(leaves[i]) for i in changed]

    def with_modes(params: PyTree, modes: list):
        leaves, structure = jax.tree.flatten(params)
        for i, x in zip(changed, modes, strict=True):
            leaves[i] = x
        return structure.unflatten(leaves)

    def outcome_of(event: Event, before: tuple, q: Array, t: Array, now: dict | None, params: PyTree):
        v, old = before
        after = switched(system, event, q, v, t, params)
        new = [x.astype(y.dtype) for x, y in zip(modes(after), old, strict=True)]
        return _reset(system, event, redundant, q, v, t, now), new

    def outcome(i: Array, s, now: dict | None, params: PyTree):
        after = s.v, modes(params)
        for number, event in enumerate(events):
            if not event.is_noted:
                after = call_where(partial(outcome_of, event), i == number, after, s.q, s.t, now, params)
        return after

    names = "is_noted", "terminal", "sees_multipliers"
    noted, ends, forced = (tuple(getattr(event, name) for event in events) for name in names)
    return FlatEvents(values, outcome, noted, ends, forced, times, bool(changed), modes, with_modes)


def switched(system: FlatSystem, event: Event, q: Array, v: Array, t: Array, params: PyTree):
    """The params after an event, from the flat state before it."""
    if event.switch is None:
        return params
    whole = event.switch_sees_state
    return freeze(_on_vectors(system, event.switch, q, v, t, params) if whole else event.switch(thaw(params)))


def _guard(system: FlatSystem, event, q: Array, v: Array, t: Array, L, params: PyTree) -> Array:
    """The guard of an event at a state."""
    guard = partial(event.guard, multipliers=L) if event.sees_multipliers else event.guard
    return _on_vectors(system, guard, q, v, t, params)


def _on_vectors(system, function, q: Array, v: Array, t: Array, params: PyTree) -> Array:
    """A user's function at a flat state."""
    params = thaw(params)
    if system.positions == 0:
        return function(system.unravel(v), t, params)
    internal = () if system.positions == system.size else (system.unravel_internal(v[system.positions :]),)
    return function(system.unravel(q), system.unravel_rates(system.located(v)), *internal, t, params)


def _changed(system: FlatSystem, event: Event, params: PyTree, at: tuple):
    """The indices of the leaves of params that a switch changes."""
    leaves, structure = jax.tree.flatten(params)
    places = [i for i, x in enumerate(leaves) if is_array(x) or not callable(x)]

    def after(data: PyTree, q: Array, v: Array, t: Array):
        filled = list(leaves)
        for i, x in zip(places, data, strict=True):
            filled[i] = x
        after = jax.tree.leaves(switched(system, event, q, v, t, structure.unflatten(filled)))
        return [after[i] for i in places]

    jaxpr = jax.make_jaxpr(after)([leaves[i] for i in places], *at).jaxpr
    pairs = zip(places, jaxpr.invars, jaxpr.outvars, strict=False)  # the state follows the params
    return [i for i, before, after in pairs if after is not before]


def _reset(system: FlatSystem, event, redundant, q: Array, v: Array, t: Array, params: PyTree) -> Array:
    """The velocity (N,) after an event."""
    if event.reset is None:
        return v
    if isinstance(event.reset, Impact):
        guard = consistent(partial(_on_vectors, system, event.guard))
        return _bounced(system, guard, event.reset, redundant, q, v, t, params)
    reset: Any = consistent(partial(_on_vectors, system, event.reset))
    new = ravel_pytree(reset(q, v, t, params))[0].astype(v.dtype)
    return system.with_internal(jnp.pad(new, (0, system.size - new.size)), v)


def _bounced(
    system: FlatSystem, guard: Callable, law: Impact, redundant, q: Array, v: Array, t: Array, params: PyTree
) -> Array:
    """v after an impact; NaN if no velocity changes the guard."""
    e = jnp.asarray(law.coefficient(thaw(params))).astype(v.dtype)
    gradient, g_t = jax.grad(lambda q, t: jnp.asarray(guard(q, v, t, params)).reshape(()), argnums=(0, 1))(q, t)
    n = pull_back(system, q, gradient)
    x, _ = answers(system, q, t, params, redundant)(n)
    mobility = jnp.sum(n * x)
    approach = jnp.sum(n * v) + g_t
    return v - (1 + e) * approach / jnp.where(mobility > 0, mobility, jnp.nan) * x
