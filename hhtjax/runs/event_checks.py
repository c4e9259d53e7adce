"""The checks of events before a run."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.checks import describe, require_function, require_number
from hhtjax.description import freeze, is_concrete, is_real, known_now, thaw
from hhtjax.runs.event_times import nearness
from hhtjax.systems import held, returned
from hhtjax.systems.events import Event, Impact, flatten_events, require_times
from hhtjax.systems.system import FirstOrderSystem, require_masses
from hhtjax.xla import Programs

AT_GUARD = 1e3  # roundings of the terms of a guard that count as zero


def require_events(caller, problem, events, step):
    """The events as a tuple, or an error for what is none, or does not fit the problem. step: the size of the first,
    of a run under error control what may be; where it is not known, a rate of rounding counts as one."""
    if isinstance(events, Event) or not isinstance(events, (list, tuple)) or not events:
        raise TypeError(f"{caller}: `events` must be a list of Event(...); received {events!r}.")
    for i, event in enumerate(events):
        if not isinstance(event, Event):
            raise TypeError(f"{caller}: `events[{i}]` must be an Event(...); received {event!r}.")
    if not problem.stepper.meets_events:
        raise NotImplementedError(
            f"{caller}: {type(problem.stepper).__name__} cannot begin anew behind an event; use hht() or another of "
            "its family, rosenbrock(), rowda(), rk4() or dopri5()."
        )
    require_masses(caller, problem.system, "leave out `events`")
    for i, event in enumerate(events):
        _require_shapes(f"{caller}: events[{i}]", problem, event)
    events = tuple(events)
    found = known_now(_guards_at_start, problem, events)
    if found is not None:
        start = Start(*found)
        if start.is_at_guard(events).any():
            start = start._replace(second=known_now(_second_at_start, problem, events))
        _require_start(caller, events, start, _known_step(step))
    return events


def refused_members(problem_of, arrays, axes, events, steps):
    """Numbers of those members of a batch that `require_events` refuses for their values, as far as these are known.

    problem_of: arrays -> a member's `Problem`; axes: of the arrays, as for `jax.vmap`; steps: as there, of each member.
    """

    def of_all(f):
        return known_now(jax.vmap(lambda arrays: f(problem_of(arrays), events), (axes,)), arrays)

    found = of_all(_guards_at_start)
    if found is None:
        return []
    start = Start(*found)
    if start.is_at_guard(events).any():
        start = start._replace(second=of_all(_second_at_start))
    impacts = np.array([isinstance(event.reset, Impact) for event in events])
    bad = start.is_beyond(events, _known_step(steps)) | (
        impacts & (start.on_velocity | ~((start.e >= 0) & (start.e <= 1)))
    )
    return np.flatnonzero(bad.any(axis=1))


def _known_step(step):
    """A step, or those of all members, (B, 1); 0 where it is not known."""
    return np.asarray(step)[..., None] if is_concrete(step) else 0.0


def _require_shapes(caller, problem, event):
    """An error for a guard that is no number, and for what a reset or a switch returns."""
    params, first_order = thaw(problem.params), isinstance(problem.system, FirstOrderSystem)
    if event.at is not None:
        _require_known_times(caller, params, event)
    at = (problem.q0,) if first_order else (problem.q0, problem.v0) + (() if problem.z0 is None else (problem.z0,))
    at, dtype = (*at, problem.t0, params), jax.tree.leaves(problem.q0)[0].dtype
    arguments = "y, t, params" if first_order else "q, v, t, params" if problem.z0 is None else "q, v, z, t, params"
    guard = _with_multipliers(caller, problem, event)
    for name, function in (("guard", guard), ("reset", event.reset), ("switch", event.switch)):
        whole = name != "switch" or event.switch_sees_state
        if function is not None and not isinstance(function, Impact):
            require_function(caller, name, function, f"{name}({arguments if whole else 'params'})")
    if guard is not None:
        g = returned.evaluate(caller, "guard", guard, *at)
        if not hasattr(g, "shape") or g.shape not in [(), (1,)]:
            raise TypeError(f"{caller}: `guard` must return a number; received {describe(g)}.")
        returned.check_dtype(caller, "guard", g, dtype)
    if isinstance(event.reset, Impact):
        _require_impact(caller, params, event.reset, first_order)
    elif event.reset is not None:
        name, like = ("q0", problem.q0) if first_order else ("v0", problem.v0)
        returned.check_like(caller, "reset", returned.evaluate(caller, "reset", event.reset, *at), name, like, dtype)
    if event.switch is not None:
        seen = at if event.switch_sees_state else (params,)
        _require_same(caller, params, returned.evaluate(caller, "switch", lambda *x: freeze(event.switch(*x)), *seen))


def _require_known_times(caller, params, event):
    """An error for known times that are none."""
    if not callable(event.at):
        return
    times = returned.evaluate(caller, "at", event.at, params)
    if not hasattr(times, "dtype") or not is_real(np.zeros((), times.dtype)) or times.ndim > 1:
        raise TypeError(f"{caller}: `at` must return a time, or (K,) times; received {describe(times)}.")
    found = known_now(lambda params: jnp.asarray(event.at(params)), params)
    if found is not None:
        require_times(caller, found)


def _with_multipliers(caller, problem, event):
    """The guard as a function without multipliers, which it may see."""
    if not event.sees_multipliers:
        return event.guard
    system = problem.system
    if system.constraint is None:
        raise ValueError(f"{caller}: the `guard` asks for `multipliers`, and the system has no constraint.")
    if isinstance(event.reset, Impact):
        raise ValueError(f"{caller}: the `guard` of an impact must depend on q and t only, not on multipliers.")
    if problem.stepper.options.formulation == "index3":
        raise NotImplementedError(
            f'{caller}: the `guard` asks for `multipliers`, and with formulation="index3" those of a step that is '
            "divided are of order 0: leave `formulation` out."
        )
    at = problem.q0, problem.t0, thaw(problem.params)
    m, dtype = (
        returned.evaluate(caller, "constraint", system.constraint, *at).shape,
        jax.tree.leaves(problem.q0)[0].dtype,
    )
    return partial(event.guard, multipliers=jnp.zeros(m, dtype))


def _require_impact(caller, params, law, first_order):
    """An error for an impact that has no velocity to change, or no restitution."""
    if first_order:
        raise TypeError(
            f"{caller}: an impact needs velocities, and a FirstOrderSystem has none: give reset(y, t, params)."
        )
    e = law.restitution
    if isinstance(e, str) and not (isinstance(params, dict) and e in params):
        raise ValueError(f"{caller}: `restitution` of the impact must be the name of one in params; received {e!r}.")
    e = law.coefficient(params)
    require_number(caller, "restitution", e, lambda e: 0 <= e <= 1, "lie in [0, 1]")


def _require_same(caller, params, after):
    """An error for params that a switch has given another form."""
    before = freeze(params)
    if jax.tree.structure(before) != jax.tree.structure(after):
        raise TypeError(
            f"{caller}: `switch` must return params like its own, {describe(before)}; received {describe(after)}."
        )
    for (path, x), y in zip(jax.tree_util.tree_leaves_with_path(before), jax.tree.leaves(after), strict=True):
        if jnp.shape(x) != y.shape or jnp.result_type(x) != y.dtype:
            raise TypeError(
                f"{caller}: `switch` must keep shapes and dtypes; params{jax.tree_util.keystr(path)} was "
                f"{describe(x)}, and became {describe(y)}."
            )


class Start(NamedTuple):
    """What is known of all guards where a run starts: g and dg/dt, what g is the sum of, whether it depends on v, the
    restitution, 0 without, and d2g/dt2, where that was asked for."""

    g: Any
    rate: Any
    terms: Any
    on_velocity: Any
    e: Any
    second: Any = 0.0

    def is_at_guard(self, events):
        """Of each event, whether its guard is zero but for rounding: (..., E)."""
        numbers = np.finfo(self.g.dtype)
        zero = np.abs(self.g) <= AT_GUARD * numbers.eps * np.maximum(self.terms, numbers.tiny)
        return zero & _is_guarded(events)

    def is_beyond(self, events, step):
        """Whether the start is beyond its guard, or at it and not leaving: (..., E). Of a motion that is back at its
        guard within a rounding of a step the acceleration tells."""
        soon = nearness(self.g) * step * np.abs(self.second)
        leaves = np.where(np.abs(self.rate) <= soon, np.greater(self.second, 0), self.rate > 0)
        return _is_guarded(events) & ~(self.g > 0) & ~(self.is_at_guard(events) & leaves)


def _is_guarded(events):
    """Whether an event has a guard that a motion must not be beyond."""
    return np.array([not event.is_noted and event.guard is not None for event in events])


@Programs
def _guards_at_start(problem, events):
    """What `Start` tells, but for d2g/dt2."""
    flat, q, v, t0, params = problem.flat()
    flat_events = flatten_events(flat, events, params, (q, v, t0), problem.stepper.redundant)
    start, over = _begun(problem, flat, q, v, t0, params), flat_events.before_any(t0)
    Ldot = None if start.L is None else jnp.zeros_like(start.L)
    g, rates = flat_events.rates(flat, start, params, over, Ldot)
    along_q, along_v = (
        jax.jacfwd(f)(x)
        for f, x in (
            (lambda q: flat_events.guards(start._replace(q=q), params, over), q),
            (lambda v: flat_events.guards(start._replace(v=v), params, over), v),
        )
    )
    terms = jnp.sum(jnp.abs(along_q * q[None, :]), axis=1)
    if any(flat_events.forced):
        along_L = jax.jacfwd(lambda L: flat_events.guards(start._replace(L=L), params, over))(start.L)
        size = jnp.max(jnp.abs(flat.force(q, v, t0, params)))  # that of what the multipliers are the difference of
        terms = terms + jnp.sum(jnp.abs(along_L), axis=1) * size
    laws = [event.reset if isinstance(event.reset, Impact) else Impact(0.0) for event in events]
    e = jnp.stack([jnp.asarray(law.coefficient(params)).astype(q.dtype) for law in laws])
    return g, rates, terms, jnp.any(along_v != 0, axis=1), e


@Programs
def _second_at_start(problem, events):
    """d2g/dt2 of all events, along the motion from the start."""
    flat, q, v, t0, params = problem.flat()
    flat_events = flatten_events(flat, events, params, (q, v, t0), problem.stepper.redundant)
    over = flat_events.before_any(t0)

    def along(f):
        def rate(q, v, t):
            s = _begun(problem, flat, q, v, t, params)
            return jax.jvp(f, (q, v, t), (flat.rate(q, v), s.w, jnp.ones_like(t)))[1]

        return rate

    def guards(q, v, t):
        return flat_events.guards(_begun(problem, flat, q, v, t, params), params, over)

    return along(along(guards))(q, v, t0)


def _begun(problem, flat, q, v, t, params):
    """The state at the start."""
    size = jnp.ones_like(t)
    return problem.stepper.astype(v.dtype).begin(flat, q, v, t, held.before(params, t, size), size)


def _require_start(caller, events, start, step):
    """An error for a start beyond a guard, and an impact along a velocity."""
    beyond, at_guard = start.is_beyond(events, step), start.is_at_guard(events)
    for i, event in enumerate(events):
        if isinstance(event.reset, Impact) and start.on_velocity[i]:
            raise ValueError(f"{caller}: events[{i}]: the `guard` of an impact must depend on q and t only, not on v.")
        if beyond[i]:
            rests = f" and the second derivative {start.second[i]:.6g}" if at_guard[i] else ""
            raise ValueError(
                f"{caller}: the start is beyond the guard of events[{i}]: it is {start.g[i]:.6g}, with the rate "
                f"{start.rate[i]:.6g}{rests}; it must be positive, or zero and rising."
            )
