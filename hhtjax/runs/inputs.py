"""Checks of the arguments of a run, and their conversion to vectors."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from hhtjax import checks
from hhtjax.checks import describe, require_function, require_integer, require_number, require_params
from hhtjax.description import (
    Array,
    PyTree,
    Real,
    all_concrete,
    freeze,
    is_array,
    is_concrete,
    is_real,
    known_now,
    thaw,
)
from hhtjax.runs.driver import equal_steps
from hhtjax.runs.event_step import nearness
from hhtjax.steppers.stepper import require_capable, require_stepper, require_system
from hhtjax.systems import zero_order_hold
from hhtjax.systems.affine import require_affine
from hhtjax.systems.contact_start import require_contact_start
from hhtjax.systems.events import Event, Impact, flatten_events, require_times
from hhtjax.systems.flat_system import flatten
from hhtjax.systems.held_nodes import require_held_start
from hhtjax.systems.initial_conditions import initial_values, require_consistent, with_known_rows
from hhtjax.systems.system import AnySystem, FirstOrderSystem, require_masses
from hhtjax.xla import Programs

if TYPE_CHECKING:
    from hhtjax.runs.adaptive import Adaptive
    from hhtjax.runs.driver import Loop
    from hhtjax.steppers.stepper import State, Stepper
    from hhtjax.systems.flat_system import FlatSystem


class Problem(NamedTuple):
    """A system, its stepper and its start. params hold no functions, as returned by `freeze`. output: an `Output`, if a
    run saves it instead of its path."""

    system: Any
    stepper: Any  # the `Stepper`
    q0: PyTree
    v0: PyTree
    params: PyTree
    t0: Real
    z0: PyTree
    output: PyTree = None

    @classmethod
    def checked(
        cls,
        caller: str,
        system: AnySystem,
        stepper: Stepper,
        q0: PyTree,
        v0: PyTree,
        params: PyTree,
        t0: Real,
        z0: PyTree,
    ) -> Problem:
        """The `Problem` of a user's arguments; raises an error that says what is wrong with them."""
        require_system(caller, system, massless=True)
        require_stepper(caller, stepper)
        params = require_params(caller, params)
        if zero_order_hold.holds(params):
            require_masses(caller, system, "leave out held inputs, sampled(order=0)")
        _refuse_checked_axes(caller, q0, v0, params, t0, z0)
        require_number(caller, "t0", t0, np.isfinite, "be finite")
        q0, v0, z0 = initial_values(caller, system, q0, v0, z0, level=4)
        require_capable(caller, system, stepper, q0, v0)
        require_affine(caller, system, q0, v0, t0, params, z0)
        if system.friction is not None:
            system = with_known_rows(caller, system, q0, v0, t0, params, z0)
        require_held_start(caller, system, q0, v0, t0, params)
        if system.contact is not None:
            require_contact_start(caller, system, q0, v0, t0, params, z0)
        if system.constraint is not None:
            require_consistent(caller, system, q0, v0, t0, params, stepper.redundant, z0)
        t0 = float(t0) if is_concrete(t0) else t0  # other number types would be compiled anew
        return cls(system, stepper, q0, v0, params, t0, z0)

    def controlled(self, control: Adaptive) -> Problem:
        """The problem, with the stepper in its form for a tolerance."""
        return self._replace(stepper=self.stepper.for_tolerance(control.rtol))

    def rates(self) -> int:
        """The number of rates: a rotation has three."""
        return self.numbers() if self.v0 is None else sum(x.size for x in jax.tree.leaves(self.v0))

    def numbers(self) -> int:
        """The number of entries of the position: a rotation has nine."""
        return sum(x.size for x in jax.tree.leaves(self.q0))

    def dtype(self) -> np.dtype:
        """The dtype of the state."""
        return jax.tree.leaves(self.q0)[0].dtype

    def times(self, t: Array) -> Array:
        """Times in the dtype of the state."""
        return jnp.asarray(t).astype(self.dtype())

    def flat(self, caller: str = "simulate"):
        """The system on vectors, q, v, t0 and the params."""
        flat, q, v = flatten(caller, self.system, self.q0, self.v0, self.t0, self.params, self.z0)
        return flat, q, v, self.times(self.t0), self.params


def _refuse_checked_axes(caller: str, *args: PyTree):
    """Raises an error under `check_vma` of `jax.shard_map`. There each array declares over which axes it varies.
    Constants would have to do so too, and those of loops, branches and Jacobians do not here."""
    for x in jax.tree.leaves(args):
        kind = getattr(jax.typeof(x), "mat", None) if isinstance(x, Tracer) else None
        if kind is not None and kind.varying:
            raise TypeError(
                f"{caller}: inside `jax.shard_map` with check_vma=True, its default; received arguments that vary over "
                f"the axes {sorted(kind.varying)}. Write jax.shard_map(..., check_vma=False): the values are the same. "
                "`sweep` spreads its members over devices by itself."
            )


# ----------------------------------------------------------------------------
# Steps of sizes that are given, one by one: the checks of what a user hands over.


def require_steps(caller: str, stepper: Stepper, dt: Real, num_steps: int | None, parts: int = 1) -> tuple[Real, int]:
    """dt, a number or (N,), and the number of steps, each of which may be divided into `parts` parts."""
    dt = np.asarray(dt) if isinstance(dt, (list, tuple)) else dt
    if not (is_array(dt) and dt.ndim):
        if num_steps is None:
            raise ValueError(
                f"{caller}: `num_steps` must be a positive integer; received None. Or give `duration`, or `times`."
            )
        num_steps = require_integer(caller, "num_steps", num_steps)
        if num_steps * parts >= 2**31:
            most = f"be less than {2**31 // parts}, because steps are counted in 32 bits"
            raise ValueError(f"{caller}: `num_steps` must {most}; received {num_steps}.")
        require_number(caller, "dt", dt, lambda x: np.isfinite(x) and x > 0, "be positive and finite")
        return float(dt) if is_concrete(dt) else dt, num_steps  # other number types would be compiled anew
    if not is_real(dt):
        raise TypeError(f"{caller}: `dt` must be real numbers; received {dt!r}.")
    if dt.ndim != 1 or not dt.size:
        raise ValueError(f"{caller}: `dt` must be a number, or of shape (N,), one step or more; received {dt.shape}.")
    if num_steps is not None and require_integer(caller, "num_steps", num_steps) != dt.size:
        raise ValueError(
            f"{caller}: `num_steps` must be the length of dt, {dt.size}, or left out; received {num_steps}."
        )
    if stepper.needs_equal_steps:
        raise NotImplementedError(
            f"{caller}: {stepper.name} needs steps of one size: give `dt` as a number, or another stepper."
        )
    if is_concrete(dt):
        fine = (np.asarray(dt) > 0) & np.isfinite(dt)
        if not fine.all():
            bad = int(np.argmin(fine))
            raise ValueError(f"{caller}: `dt` must be positive and finite; received dt[{bad}] = {dt[bad]}.")
    return dt, dt.size


def require_control_alone(caller: str, times: Real, num_steps, save_every: int, extrapolate: int):
    """Raises an error unless error control is given times, and no arguments for steps of given sizes."""
    if times is None:
        raise TypeError(f"{caller}: with dt=adaptive(...), give `times`, (K,), at the last of which the run ends.")
    others = ("num_steps", num_steps, None), ("save_every", save_every, 1), ("extrapolate", extrapolate, 1)
    for name, value, default in others:
        if value != default:
            raise ValueError(f"{caller}: with dt=adaptive(...), leave `{name}` out; received {value!r}.")


def require_steps_to(caller: str, times: Real, dt: Real, num_steps, save_every: int, t0: Real) -> Real:
    """dt, for steps between which `times` are interpolated."""
    for name, value, default in (("num_steps", num_steps, None), ("save_every", save_every, 1)):
        if value != default:
            raise ValueError(f"{caller}: with `times`, leave `{name}` out; received {value!r}.")
    dt = _require_one_size(caller, dt, "times")
    if all_concrete((dt, times, t0)) and (times[-1] - t0) / dt >= 2**31:
        raise ValueError(f"{caller}: `dt` must take fewer than 2^31 steps to times[-1]={times[-1]}; received {dt}.")
    return dt


def _require_one_size(caller: str, dt: Real, beside: str) -> Real:
    """dt, a number."""
    if isinstance(dt, (list, tuple)) or (is_array(dt) and dt.ndim):
        raise NotImplementedError(
            f"{caller}: with `{beside}`, `dt` must be a number or adaptive(...); received {np.shape(dt)}. Leave "
            f"`{beside}` out, and sample the run by `interpolate`."
        )
    require_number(caller, "dt", dt, lambda x: np.isfinite(x) and x > 0, "be positive and finite")
    return float(dt) if is_concrete(dt) else dt


def require_one_length(caller: str, duration: Real, num_samples: int | None, **others: int | None):
    """Raises an error if the length of a run is given by `duration` and by another argument too."""
    if duration is None:
        raise TypeError(f"{caller}: `num_samples` goes with `duration`; received {num_samples!r} alone.")
    require_number(caller, "duration", duration, lambda x: np.isfinite(x) and x > 0, "be positive and finite")
    for name, value in others.items():
        if value is not None and not (name == "save_every" and value == 1):
            instead = ": give `num_samples`" if name == "save_every" else ""
            raise ValueError(f"{caller}: with `duration`, leave `{name}` out{instead}; received {value!r}.")
    if num_samples is not None:
        require_integer(caller, "num_samples", num_samples)


def steps_within(caller: str, dtype: np.dtype, dt: Real, duration: Real, num_samples: int | None):
    """dt, num_steps and save_every, with dt reduced, if necessary, so that steps end on equally spaced samples."""
    dt = _require_one_size(caller, dt, "duration")
    if not all_concrete((dt, duration)):
        raise TypeError(
            f"{caller}: with `duration`, `dt` and `duration` must be known, because the number of steps is part of the "
            "program: give `num_steps`, or use `sweep`, for which they are data."
        )
    H = float(duration) / (num_samples or 1)
    if dt > H * (1 + 1e-6):
        raise ValueError(
            f"{caller}: `dt` must be at most {H:.6g}, the distance of the samples (duration={duration:.6g}, "
            f"num_samples={num_samples or 1}); received {dt:.6g}."
        )
    substeps = max(math.ceil(H / dt * (1 - 64 * float(jnp.finfo(dtype).eps))), 1)
    num_steps = substeps * (num_samples or 1)
    return float(duration) / num_steps, num_steps, 1 if num_samples is None else substeps


class EqualSteps(NamedTuple):
    """Equal steps from t0 on. counts: (K,), the number of steps from one of some times to the next, where the last of
    them ends at that time or later; reached: the end of the interval that can be interpolated."""

    dt: Any
    counts: Array
    reached: Array

    @classmethod
    def to(cls, t0: Array, times: Array, dt: Array) -> EqualSteps:
        """The steps to each of the times; none if dt is traced and not positive."""
        fine, eps = (dt > 0) & jnp.isfinite(dt), 8 * float(jnp.finfo(dt.dtype).eps)
        h = jnp.where(fine, dt, 1)
        number = (times - t0) / h
        rounding = eps * (jnp.abs(number) + jnp.maximum(jnp.abs(times), jnp.abs(t0)) / h)
        number = jnp.where(fine, jnp.maximum(jnp.ceil(number - rounding), 1), 0).astype(jnp.int32)
        counts = jnp.maximum(jnp.diff(number, prepend=0), 0)
        return cls(dt, counts, jnp.where(fine, jnp.inf, t0))

    def loop(self, flat: FlatSystem, stepper: Stepper, q: Array, v: Array, t0: Array, params: PyTree) -> Loop:
        """The `Loop` over these steps."""
        return equal_steps(flat, stepper, q, v, t0, params, self.dt)


def refined(dt: Real, k: int) -> Real:
    """dt, with each step replaced by k steps."""
    return jnp.repeat(dt / k, k) if np.ndim(dt) else dt / k


def warn_of_jumps_to(problem: Problem, dt: Real, times: Real):
    """As `warn_of_jumps_in`, for equal steps to the last of these times."""
    if zero_order_hold.holds(problem.params) and all_concrete((dt, times, problem.t0)):
        warn_of_jumps_in(problem, dt, int(np.ceil((float(times[-1]) - float(problem.t0)) / float(dt) - 1e-6)), 5)


def warn_of_jumps_in(problem: Problem, dt: Real, num_steps, level: int = 4):
    """Warns if a held input jumps within one of these steps, as far as the values are known."""
    if zero_order_hold.holds(problem.params) and all_concrete((dt, problem.t0)):
        dt, t0 = np.asarray(dt, float), np.asarray(problem.t0, float)
        times = t0 + np.append(0.0, np.cumsum(dt) if dt.ndim else num_steps * dt)
        zero_order_hold.warn_of_jumps(
            "simulate", problem.params, times, lambda H: H * 0 + (1 if dt.ndim else num_steps), level
        )


# ----------------------------------------------------------------------------
# The checks of events before a run.


AT_GUARD = 1e3  # roundings of the terms of a guard that count as zero


def require_events(caller: str, problem: Problem, events, step: Real):
    """The events as a tuple; raises an error if one is not an event, or does not fit the problem. step: the size of the
    first step, or its limit under error control. If it is not known, a rate at the level of rounding counts as a
    rate."""
    if isinstance(events, Event) or not isinstance(events, (list, tuple)) or not events:
        raise TypeError(f"{caller}: `events` must be a list of Event(...); received {events!r}.")
    for i, event in enumerate(events):
        if not isinstance(event, Event):
            raise TypeError(f"{caller}: `events[{i}]` must be an Event(...); received {event!r}.")
    if not problem.stepper.meets_events:
        raise NotImplementedError(
            f"{caller}: {problem.stepper.name} does not support events; use hht() or another of "
            "its family, a Rosenbrock method such as rodas5p(), rk4() or dopri5()."
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


def refused_members(problem_of: Callable, arrays: list, axes: list, events, steps):
    """Indices of the members of a batch that `require_events` rejects for their values, as far as these are known.

    problem_of: arrays -> a member's `Problem`; axes: of the arrays, as for `jax.vmap`; steps: the `step` of each
    member.
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


def _known_step(step: Real):
    """A step, or the steps of all members, (B, 1); 0 if unknown."""
    return np.asarray(step)[..., None] if is_concrete(step) else 0.0


def _require_shapes(caller: str, problem: Problem, event):
    """Raises an error for a guard that does not return a number, and for wrong results of a reset or a switch."""
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
        g = checks.evaluate(caller, "guard", guard, *at)
        if not hasattr(g, "shape") or g.shape not in [(), (1,)]:
            raise TypeError(f"{caller}: `guard` must return a number; received {describe(g)}.")
        checks.check_dtype(caller, "guard", g, dtype)
    if isinstance(event.reset, Impact):
        _require_impact(caller, params, event.reset, first_order)
    elif event.reset is not None:
        name, like = ("q0", problem.q0) if first_order else ("v0", problem.v0)
        checks.check_like(caller, "reset", checks.evaluate(caller, "reset", event.reset, *at), name, like, dtype)
    if event.switch is not None:
        seen = at if event.switch_sees_state else (params,)
        _require_same(caller, params, checks.evaluate(caller, "switch", lambda *x: freeze(event.switch(*x)), *seen))


def _require_known_times(caller: str, params: PyTree, event: Event):
    """Raises an error for wrong known times."""
    if not callable(event.at):
        return
    times = checks.evaluate(caller, "at", event.at, params)
    if not hasattr(times, "dtype") or not is_real(np.zeros((), times.dtype)) or times.ndim > 1:
        raise TypeError(f"{caller}: `at` must return a time, or (K,) times; received {describe(times)}.")
    found = known_now(lambda params: jnp.asarray(event.at(params)), params)
    if found is not None:
        require_times(caller, found)


def _with_multipliers(caller: str, problem: Problem, event):
    """The guard as a function that gets no multipliers argument; a guard that needs it receives the multipliers."""
    if not event.sees_multipliers:
        return event.guard
    system = problem.system
    if system.constraint is None:
        raise ValueError(f"{caller}: the `guard` has an argument `multipliers`, but the system has no constraint.")
    if isinstance(event.reset, Impact):
        raise ValueError(f"{caller}: the `guard` of an impact must depend on q and t only, not on multipliers.")
    if problem.stepper.options.formulation == "index3":
        raise NotImplementedError(
            f'{caller}: the `guard` has an argument `multipliers`, and with formulation="index3" the multipliers of a '
            "divided step have order 0: leave `formulation` out."
        )
    at = problem.q0, problem.t0, thaw(problem.params)
    m, dtype = (
        checks.evaluate(caller, "constraint", system.constraint, *at).shape,
        jax.tree.leaves(problem.q0)[0].dtype,
    )
    return partial(event.guard, multipliers=jnp.zeros(m, dtype))


def _require_impact(caller: str, params: PyTree, law: Impact, first_order: bool):
    """Raises an error for an impact without a velocity to change, or without a restitution."""
    if first_order:
        raise TypeError(
            f"{caller}: an impact needs velocities, and a FirstOrderSystem has none: give reset(y, t, params)."
        )
    e = law.restitution
    if isinstance(e, str) and not (isinstance(params, dict) and e in params):
        raise ValueError(f"{caller}: `restitution` of the impact must be the name of one in params; received {e!r}.")
    e = law.coefficient(thaw(params))
    require_number(caller, "restitution", e, lambda e: 0 <= e <= 1, "lie in [0, 1]")


def _require_same(caller: str, params: PyTree, after: dict):
    """Raises an error for params whose structure, shapes or dtypes a switch has changed."""
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
    """The values of all guards at the start of a run: g and dg/dt, the size of the terms of g, whether g depends on v,
    the restitution (0 without), and d2g/dt2 if requested."""

    g: Any
    rate: Any
    terms: Array
    on_velocity: Array
    e: Array
    second: Real = 0.0

    def is_at_guard(self, events: tuple) -> np.ndarray:
        """For each event, whether its guard is zero up to rounding: (..., E)."""
        numbers = np.finfo(self.g.dtype)
        zero = np.abs(self.g) <= AT_GUARD * numbers.eps * np.maximum(self.terms, numbers.tiny)
        return zero & _is_guarded(events)

    def is_beyond(self, events: tuple, step) -> np.ndarray:
        """Whether the start is beyond its guard, or at it and not leaving: (..., E). If the motion would return to the
        guard within a rounding of a step, the acceleration decides."""
        soon = nearness(self.g) * step * np.abs(self.second)
        leaves = np.where(np.abs(self.rate) <= soon, np.greater(self.second, 0), self.rate > 0)
        return _is_guarded(events) & ~(self.g > 0) & ~(self.is_at_guard(events) & leaves)


def _is_guarded(events: tuple) -> np.ndarray:
    """Whether an event has a guard that the start must not violate."""
    return np.array([not event.is_noted and event.guard is not None for event in events])


@Programs
def _guards_at_start(problem: Problem, events: tuple):
    """The `Start`, without d2g/dt2."""
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
    e = jnp.stack([jnp.asarray(law.coefficient(thaw(params))).astype(q.dtype) for law in laws])
    return g, rates, terms, jnp.any(along_v != 0, axis=1), e


@Programs
def _second_at_start(problem: Problem, events: tuple) -> Array:
    """d2g/dt2 of all events, along the motion from the start."""
    flat, q, v, t0, params = problem.flat()
    flat_events = flatten_events(flat, events, params, (q, v, t0), problem.stepper.redundant)
    over = flat_events.before_any(t0)

    def along(f: Callable):
        def rate(q: Array, v: Array, t: Array) -> Array:
            s = _begun(problem, flat, q, v, t, params)
            return jax.jvp(f, (q, v, t), (flat.rate(q, v), s.w, jnp.ones_like(t)))[1]

        return rate

    def guards(q: Array, v: Array, t: Array) -> Array:
        return flat_events.guards(_begun(problem, flat, q, v, t, params), params, over)

    return along(along(guards))(q, v, t0)


def _begun(problem: Problem, flat: FlatSystem, q: Array, v: Array, t: Array, params: PyTree) -> State:
    """The state at the start."""
    size = jnp.ones_like(t)
    return problem.stepper.astype(v.dtype).begin(flat, q, v, t, zero_order_hold.before(params, t, size), size)


def _require_start(caller: str, events: tuple, start: Start, step):
    """Raises an error for a start beyond a guard, and for an impact whose guard depends on v."""
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


# ----------------------------------------------------------------------------
# The times at which a run is sampled.


def equal_times(t0, duration, num_samples):
    """The times of `num_samples` equally spaced samples."""
    return t0 + duration * np.arange(1, num_samples + 1) / num_samples


def require_sample_times(times: PyTree, t0: Real, dtype: np.dtype, caller: str = "sweep") -> Real:
    """times (K,) in the dtype of the state, in which they must increase; checked as far as they are known."""
    times = times if is_array(times) else np.asarray(times)
    if not is_real(times):
        raise TypeError(f"{caller}: `times` must be real numbers; received {times!r}.")
    if times.ndim != 1 or not times.size:
        raise ValueError(f"{caller}: `times` must have shape (K,), one or more; received {times.shape}.")
    if not is_concrete(times):
        return times
    times = np.asarray(times).astype(dtype)
    if not np.all(np.isfinite(times)):
        bad = int(np.argmin(np.isfinite(times)))
        raise ValueError(f"{caller}: `times` must be finite; received times[{bad}] = {times[bad]}.")
    before = np.full(1, t0 if is_concrete(t0) else -np.inf, dtype)
    late = np.diff(times, prepend=before) > 0
    if not late.all():
        bad = int(np.argmin(late))
        last = f"times[{bad - 1}] = {times[bad - 1]}" if bad else f"t0 = {before[0]}"
        at_start = " Leave t0 out: the start is saved in any case." if not bad and times[0] == before[0] else ""
        raise ValueError(
            f"{caller}: `times` must be strictly increasing, and after t0, in {times.dtype}; "
            f"received times[{bad}] = {times[bad]} after {last}.{at_start}"
        )
    return times
