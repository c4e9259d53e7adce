"""The checks of events before a run."""

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.checks import describe, require_function, require_number
from hhtjax.description import freeze, known_now, thaw
from hhtjax.systems import held, returned
from hhtjax.systems.events import Event, Impact, flatten_events
from hhtjax.systems.system import FirstOrderSystem
from hhtjax.xla import Programs

AT_GUARD = 1e3  # roundings of the terms of a guard that count as zero


def require_events(caller, problem, events):
    """The events as a tuple, or an error for what is none, or does not fit the problem."""
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
    for i, event in enumerate(events):
        _require_shapes(f"{caller}: events[{i}]", problem, event)
    found = known_now(_guards_at_start, problem, tuple(events))
    if found is not None:
        _require_start(caller, events, *found[:4])
    return tuple(events)


def refused_members(problem_of, arrays, axes, events):
    """Numbers of those members of a batch that `require_events` refuses for their values, as far as these are known.

    problem_of: arrays -> a member's `Problem`; axes: of the arrays, as for `jax.vmap`.
    """
    found = known_now(jax.vmap(lambda arrays: _guards_at_start(problem_of(arrays), events), (axes,)), arrays)
    if found is None:
        return []
    g, rates, terms, on_velocity, e = found
    impacts = np.array([isinstance(event.reset, Impact) for event in events])
    bad = _is_beyond(events, g, rates, terms) | (impacts & (on_velocity | ~((e >= 0) & (e <= 1))))
    return np.flatnonzero(bad.any(axis=1))


def _require_shapes(caller, problem, event):
    """An error for a guard that is no number, and for what a reset or a switch returns."""
    params, first_order = thaw(problem.params), isinstance(problem.system, FirstOrderSystem)
    at = (problem.q0,) if first_order else (problem.q0, problem.v0) + (() if problem.z0 is None else (problem.z0,))
    at, dtype = (*at, problem.t0, params), jax.tree.leaves(problem.q0)[0].dtype
    arguments = "y, t, params" if first_order else "q, v, t, params" if problem.z0 is None else "q, v, z, t, params"
    for name in ("guard", "reset"):
        function = getattr(event, name)
        if function is not None and not isinstance(function, Impact):
            require_function(caller, name, function, f"{name}({arguments})")
    g = returned.evaluate(caller, "guard", event.guard, *at)
    if not hasattr(g, "shape") or g.shape not in [(), (1,)]:
        raise TypeError(f"{caller}: `guard` must return a number; received {describe(g)}.")
    returned.check_dtype(caller, "guard", g, dtype)
    if isinstance(event.reset, Impact):
        _require_impact(caller, params, event.reset, first_order)
    elif event.reset is not None:
        name, like = ("q0", problem.q0) if first_order else ("v0", problem.v0)
        returned.check_like(caller, "reset", returned.evaluate(caller, "reset", event.reset, *at), name, like, dtype)
    if event.switch is not None:
        _require_same(caller, params, returned.evaluate(caller, "switch", lambda p: freeze(event.switch(p)), params))


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


@Programs
def _guards_at_start(problem, events):
    """g and dg/dt of all events, what g is the sum of, whether it depends on v, and the restitution, 0 without."""
    flat, q, v, t0, params = problem.flat()
    flat_events = flatten_events(flat, events, params, problem.stepper.redundant)
    size = jnp.ones_like(t0)
    start = problem.stepper.astype(q.dtype).begin(flat, q, v, t0, held.before(params, t0, size), size)
    g, rates = flat_events.rates(flat, start, params)
    along_q, along_v = (
        jax.jacfwd(f)(x)
        for f, x in (
            (lambda q: flat_events.guards(q, v, t0, params), q),
            (lambda v: flat_events.guards(q, v, t0, params), v),
        )
    )
    terms = jnp.sum(jnp.abs(along_q * q[None, :]), axis=1)
    laws = [event.reset if isinstance(event.reset, Impact) else Impact(0.0) for event in events]
    e = jnp.stack([jnp.asarray(law.coefficient(params)).astype(q.dtype) for law in laws])
    return g, rates, terms, jnp.any(along_v != 0, axis=1), e


def _is_beyond(events, g, rates, terms):
    """Of each event, whether the start is beyond its guard, or at it without rising: (..., E)."""
    noted, numbers = np.array([event.is_noted for event in events]), np.finfo(g.dtype)
    at_guard = np.abs(g) <= AT_GUARD * numbers.eps * np.maximum(terms, numbers.tiny)
    return ~noted & ~(g > 0) & ~(at_guard & (rates > 0))


def _require_start(caller, events, g, rates, terms, on_velocity):
    """An error for a start beyond a guard, and an impact along a velocity."""
    beyond = _is_beyond(events, g, rates, terms)
    for i, event in enumerate(events):
        if isinstance(event.reset, Impact) and on_velocity[i]:
            raise ValueError(f"{caller}: events[{i}]: the `guard` of an impact must depend on q and t only, not on v.")
        if beyond[i]:
            raise ValueError(
                f"{caller}: the start is beyond the guard of events[{i}]: it is {g[i]:.6g}, with the rate "
                f"{rates[i]:.6g}; it must be positive, or zero and rising."
            )
