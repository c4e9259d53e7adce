"""The common driver of all runs: start, step from sample to sample, and return the results.

`simulate`, with equal steps, given steps or steps under error control, and each member of a `sweep` call `drive`. They
differ in their step sizes and in the positions of their samples. Events are added if there are any.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from hhtjax.description import Array, PyTree, thaw
from hhtjax.jaxpr import on_scalars
from hhtjax.numerics.batched_cond import if_any, tree_where
from hhtjax.numerics.checkpointed_scan import checkpoint
from hhtjax.numerics.dense_lu import diagonal
from hhtjax.primitives import in_turn
from hhtjax.runs.event_step import EventContext, EventState, Pieces, SubStep, asks, pass_events, reaching, unnoted
from hhtjax.runs.solution import FINE, INTERNAL_STATE, ContactForces, Failure, Log, Solution
from hhtjax.steppers.friction_switching import is_settled
from hhtjax.steppers.stepper import Info, bound, entered, join_info, public, step_start
from hhtjax.steppers.variable_step import resized_step
from hhtjax.systems import zero_order_hold
from hhtjax.systems.contact_start import start_flaws
from hhtjax.systems.events import flatten_events
from hhtjax.systems.friction import directions
from hhtjax.systems.matrices import OF_VELOCITY, RUBBED, mass_flaw
from hhtjax.systems.system import mass_reads_velocity

if TYPE_CHECKING:
    from hhtjax.runs.inputs import Problem
    from hhtjax.steppers.stepper import State, Stepper
    from hhtjax.systems.flat_system import FlatSystem


def drive(
    problem: Problem,
    steps: Callable,
    sampling: Callable,
    events: tuple | None = None,
    room: tuple = (),
    between: bool = False,
    factors=None,
    caller: str = "simulate",
) -> Solution:
    """The `Solution` of a `Problem`. Every run of the library calls this function.

    steps: (flat, stepper, q, v, t0, params) -> `Loop`, which contains the step sizes.
    sampling: `Run` -> the final carry of its loop, and the function that makes the `Solution` for a `Failure`.
    events, room: a list of `Event`, how many of them may divide a step, and how many are recorded. between: whether
        samples lie within steps, so that the pieces of the last step are kept.
    factors: the `FlatSystem` factors, if they are known. caller: the function named by an error in a user's function.
    """
    flat, q, v, t0, params = problem.flat(caller)
    plain = loop = steps(flat._replace(factors=factors), problem.stepper, q, v, t0, params)
    if events is not None:
        pieces = {"in_pieces": between, "with_modes": problem.output is not None}
        loop = loop_with_events(plain, flat, problem.stepper, events, params, *room, **pieces)
    form = on_scalars(lambda carry: plain.advance(carry[:3]), loop.carry)  # without events, which are seldom
    (_, _, failure, *met), solution = sampling(Run(problem, flat, params, loop, form))
    run = solution(with_flaw(failure, flaw_at_start(problem.system, flat, loop.start, params)))
    run = run if flat.contact is None else with_contact_start(run, flat, loop.start, params)
    return with_told_events(flat, run, form.joined(met[0]), room[1]) if met else run


class Run(NamedTuple):
    """A run before its first step. form: whether the carry of the loop consists of arrays or of single numbers."""

    problem: Any
    flat: FlatSystem
    params: PyTree
    loop: Loop
    form: Any


class Loop(NamedTuple):
    """The parts of a run. carry: (state, number of steps, first failure), before the first step; advance: carry ->
    carry, Info; keep: state -> saved values; no_info: the neutral element of `join_info`; bound: params -> advance;
    sizes: number of steps taken -> the size of the next step, and of the previous one; start: the state at t0, as it is
    saved; past: bound, sizes -> advance with events; now: carry of events -> the params after them."""

    carry: PyTree
    advance: Callable
    keep: Callable
    no_info: Info
    bound: Callable
    sizes: Any
    start: Any
    past: Callable | None = None
    now: Callable | None = None


def equal_steps(flat: FlatSystem, stepper: Stepper, q: Array, v: Array, t0: Array, params: PyTree, dt: Array) -> Loop:
    """The `Loop` over steps of one size."""
    stepper = stepper.astype(q.dtype)

    def take_step(params: PyTree):
        return jax.jit(bound(stepper, flat, params, dt), inline=True)  # traced once, wherever it is called

    step = take_step(params)

    def advance(now: PyTree):
        return counted(step if now is params else take_step(now), flat, t0, dt)

    start, first = entered(stepper, flat, q, v, t0, zero_order_hold.before(params, t0, dt), dt, alone=True)
    no_info = neutral_info(jax.eval_shape(step, first)[1])
    carry = first, jnp.zeros((), jnp.int32), no_failure(no_info)
    keep = partial(saved, flat)
    return Loop(carry, counted(step, flat, t0, dt), keep, no_info, advance, lambda count: (dt, dt), start)


def given_steps(
    flat: FlatSystem, stepper: Stepper, q: Array, v: Array, t0: Array, params: PyTree, dt: Array, grows: bool
) -> Loop:
    """The `Loop` over steps dt (N,); NaN from the first one on that is not positive."""
    dt = jnp.where((dt > 0) & jnp.isfinite(dt), dt, jnp.nan)
    steps = dt, jnp.concatenate([dt[:1], dt[:-1]]), t0 + jnp.cumsum(dt)

    def sizes(number: Array):
        return [lax.dynamic_index_in_dim(x, number, keepdims=False) for x in steps]

    return steps_of(flat, stepper, q, v, t0, params, sizes, grows=grows)


def steps_of(
    flat: FlatSystem,
    stepper: Stepper,
    q: Array,
    v: Array,
    t0: Array,
    params: PyTree,
    sizes: Callable,
    resolves: bool = False,
    grows: bool = False,
) -> Loop:
    """The `Loop` over steps of any sizes: number of steps taken -> the next size, the previous one, and the end of the
    step.

    resolves: whether the first step is chosen by error control. grows: see `resized_step`."""
    stepper = stepper.astype(q.dtype)
    none = jnp.zeros((), jnp.int32)
    first = sizes(none)[0]

    def take_step(params: PyTree):
        @partial(jax.jit, inline=True)  # traced once, wherever it is called
        def step(state: State, number: Array):
            h, last, end = sizes(number)
            state, info = resized_step(flat, stepper, params, h, last, grows)(state)
            return state._replace(t=end), info

        return step

    step = take_step(params)

    def advance(now: PyTree):
        one = step if now is params else take_step(now)

        def next_step(carry: tuple):
            state, count, failure = carry
            state, info = one(state, count)
            return (state, count + 1, first_failure(flat, failure, count + 1, state, info)), info

        return next_step

    how = {"resolves": resolves, "alone": not resolves}
    start, begun = entered(stepper, flat, q, v, t0, zero_order_hold.before(params, t0, first), first, **how)
    no_info = neutral_info(jax.eval_shape(step, begun, none)[1])
    carry, keep = (begun, none, no_failure(no_info)), partial(saved, flat)
    return Loop(carry, advance(params), keep, no_info, advance, lambda count: tuple(sizes(count)[:2]), start)


def counted(take_step: Callable, flat: FlatSystem, t0: Array, dt: Array, before: Array | None = None):
    """The step of a run, on (state, number of steps, first failure); also returns its `Info`. before: steps taken at
    t0."""

    def step(carry: tuple):
        state, count, failure = carry
        state, info = take_step(state)
        count = count + 1
        taken = count if before is None else count - before
        state = state._replace(t=t0 + taken.astype(dt.dtype) * dt)  # no rounding piles up
        return (state, count, first_failure(flat, failure, count, state, info)), info

    return step


def resting(advance: Callable, by_itself: bool, run: tuple, info: Info, here: Array):
    """The run and its info after the step if `here` is true, else unchanged. by_itself: whether `advance` can rest."""
    after, more = advance(run, here) if by_itself else advance(run)
    info = tree_where(here, join_info(info, more), info)
    return after if by_itself else if_any(partial(tree_where, here), ~here, after, run, kept=False), info


def saved(flat: FlatSystem, state: State):
    """The values of a state that a run saves."""
    state = public(flat, state)
    return state.t, state.q, state.v, state.w, state.L, state.z, state.zdot, state.friction, state.contact


def as_solution(
    flat: FlatSystem, start: State, path: tuple, dt: Array | None, info: Info, failure: Failure
) -> Solution:
    """The start and the path after it as a `Solution`."""
    path = jax.tree.map(lambda x, y: jnp.concatenate([x[None], y]), saved(flat, start), path)
    return as_path(flat, path)._replace(dt=dt, info=info, failure=failure)


def as_path(flat, path: tuple) -> Solution:
    """The saved values, with a leading axis, as a `Solution` without other information."""
    t, q, v, w, L, *z, friction, contact = path
    q = jax.vmap(flat.unravel)(q)
    v, w = (None if x is None else jax.vmap(flat.unravel_rates)(x) for x in (v, w))
    z, zdot = (None if x is None else jax.vmap(flat.unravel_internal)(x) for x in z)
    nothing: Any = None
    solution = Solution(t, q, v, w, L, nothing, nothing, nothing, z, zdot)
    if contact is not None:
        return solution._replace(contact=ContactForces.of(contact))
    return solution if friction is None else solution._replace(friction=friction.tau, sticking=friction.sig == 0)


def with_flaw(failure: Failure, flaw: Array | None) -> Failure:
    """The failure, or the failure of a wrong mass at the start."""
    return failure if flaw is None else failure._replace(step=jnp.where(flaw > 0, 1, failure.step), mass=flaw)


def flaw_at_start(system, flat, start, params: PyTree):
    """What is wrong with the mass at the start, if it is a function; a constant mass has been checked before. With
    constraints a coordinate may have no mass, unless friction acts there."""
    varies = callable(getattr(system, "mass", None))
    rubs = flat.friction is not None and flat.num_constraints > 0
    if not varies and not rubs:
        return None
    M, flaw = flat.mass(start.q, start.t, params), jnp.zeros((), jnp.int32)
    if varies:
        flaw = mass_flaw(M, system.constraint is not None or system.massless is not None)
    if rubs:
        rubbed = jnp.any(directions(flat, start.q, start.t, params) != 0, axis=0)
        flaw = jnp.where((flaw == 0) & jnp.any(rubbed & (diagonal(M) <= 0)), RUBBED, flaw)
    if not getattr(system.mass, "is_lagrangian", False):
        return flaw
    at = flat.unravel(start.q), flat.unravel_rates(flat.located(start.v)), start.t, thaw(params)
    return jnp.where((flaw == 0) & mass_reads_velocity(system.mass.lagrangian, *at), OF_VELOCITY, flaw)


def with_contact_start(run: Solution, flat: FlatSystem, start: State, params: PyTree) -> Solution:
    """The run; or a failed one, if bodies overlap or approach each other at the start, or coefficients are out of
    range."""
    flaw = jnp.max(start_flaws(flat, start.q, start.v, start.t, params))
    step, code = jnp.where(flaw > 0, 1, run.failure.step), jnp.where(flaw > 0, flaw, run.failure.contact)
    return run._replace(failure=run.failure._replace(step=step, contact=code))


def no_failure(info: Info) -> Failure:
    """The `Failure` of a run without failures."""
    none = jnp.zeros((), jnp.int32)
    return Failure(
        none, jnp.array(False), none, info.dependent_row, info.solve_residual, info.friction, contact=info.contact
    )


def first_failure(flat: FlatSystem, failure: Failure, count: Array, state: State, info: Info) -> Failure:
    """The failure so far, or the failure of this step. Of several quantities an internal state is named, else the
    first."""
    _, *values, _, _ = saved(flat, state)
    known = [(i, x) for i, x in enumerate(values) if x is not None]
    known.sort(key=lambda x: x[0] < INTERNAL_STATE)
    # a sum that is finite tells that all are; where it is not, look closer
    suspect = ~jnp.isfinite(sum(jnp.sum(x) for _, x in known)) | told_failure(info)
    return if_any(partial(failure_of, known, count, info), suspect & (failure.step == 0), failure, kept=False)


def told_failure(info: Info) -> Array:
    """Whether a step reports a failure itself."""
    failed = jnp.array(False) if info.dependent_row is None else info.dependent_row >= 0
    for well in (info.converged, info.solved):
        failed = failed if well is None else failed | ~well
    return failed if info.contact is None else failed | (info.contact > 0)


def failure_of(known: list, count: Array, info: Info, failure: Failure) -> Failure:
    """As above, from each quantity separately, [(number, array)]."""
    quantity, finite = jnp.zeros((), jnp.int32), jnp.array(True)
    for i, x in reversed(known):
        fine = jnp.all(jnp.isfinite(x))
        quantity, finite = jnp.where(fine, quantity, i), finite & fine
    newton, row, left, friction, contact = finite, failure.row, failure.solve, failure.friction, failure.contact
    if info.dependent_row is not None:
        newton = newton & (info.dependent_row < 0)
    if info.solved is not None:
        newton = newton & info.solved
    if info.friction is not None:
        newton = newton & is_settled(info.friction)
    if info.contact is not None:
        newton = newton & (info.contact == 0)
    first = (~finite | told_failure(info)) & (failure.step == 0)
    if info.dependent_row is not None:
        row = jnp.where(first, info.dependent_row, failure.row)
    if info.solved is not None:
        left = jnp.where(first & finite & ~info.solved, info.solve_residual, failure.solve)
    if info.friction is not None:
        friction = jnp.where(first & ~is_settled(info.friction), info.friction, failure.friction)
    if info.contact is not None:
        contact = jnp.where(first, info.contact, failure.contact)
    step, quantity = (jnp.where(first, new, old) for new, old in ((count, failure.step), (quantity, failure.quantity)))
    return Failure(step, jnp.where(first, newton, failure.newton), quantity, row, left, friction, contact=contact)


def neutral_info(shapes: Info) -> Info:
    """The neutral element of `join_info`."""
    neutral = Info(*(None if x is None else jnp.asarray(x.dtype == bool, x.dtype) for x in shapes))
    return neutral if neutral.dependent_row is None else neutral._replace(dependent_row=-1 - neutral.dependent_row)


# ----------------------------------------------------------------------------
# Events: what a run carries along for them, and what it tells of them.


def loop_with_events(
    loop: Loop,
    flat: FlatSystem,
    stepper: Stepper,
    events: tuple,
    params: PyTree,
    max_events: int,
    keep: int,
    in_pieces: bool = False,
    with_modes: bool = False,
) -> Loop:
    """The `Loop` with events: its carry has an `EventState` after (state, number of steps, first failure).

    in_pieces: whether that contains the `Pieces` of the last step; with_modes: whether these contain the modes.
    """
    start = loop.carry[0]
    stepper = stepper.astype(start.v.dtype)
    flat_events = flatten_events(flat, events, params, (start.q, start.v, start.t), stepper.redundant)
    context = EventContext(
        flat, stepper, flat_events, max_events, loop.no_info, reaching(flat, stepper, loop.no_info), keep
    )
    met = before_any(context, params, start.t)
    met = met._replace(log=Log.empty(unnoted(start)[0], keep, context.slots))
    if in_pieces:
        met = met._replace(pieces=Pieces.none(start, max_events + 1, met.modes if with_modes else ()))
    past = partial(step_with_events, context, params)
    more = {"past": past, "now": lambda met: flat_events.with_modes(params, met.modes)}
    return loop._replace(carry=(*loop.carry, met), advance=past(loop.bound, loop.sizes), **more)


def step_with_events(context, params: PyTree, bound, sizes):
    """The step of a run with events. It leaves the run unchanged if `here` is false.

    bound: params -> the step without events. sizes: number of steps taken -> the size of this step, and of the previous
    one.
    """
    events, pass_them = context.events, passage(context)
    fixed = None if events.switches else bound(params)

    def step(carry: tuple, here: Array | None = None):
        *run, met = carry
        now = events.with_modes(params, met.modes)
        (new, count, _), info = (fixed or bound(now))(tuple(run))
        state, before, failure = run
        h, last = sizes(before)
        if any(events.ends):
            new, info = tree_where(met.ended, state, new), tree_where(met.ended, context.no_info, info)
        # before the branch: LLVM makes no vector instructions of a choice between what comes out of one
        new, count = at_rest(here, (new, count), (state, before))
        if met.pieces is not None:
            begun = step_start(context.stepper, context.flat, now, h, last, state)[1]
            met = met._replace(pieces=at_rest(here, met.pieces.whole(begun, new, met.modes), met.pieces))
        part = SubStep.whole(context, state, new, info, h, last, met._replace(log=None))
        counts = None if here is None else (before, count)
        asked = may_meet(context, part, h, params)
        part, log = if_any(pass_them, asked, (part, met.log), counts, h, params, kept=False)
        told = first_failure(context.flat, failure, count, part.end, part.info)
        return (part.end, count, at_rest(here, told, failure), part.met._replace(log=log)), part.info

    return step


def may_meet(context: EventContext, part: SubStep, h: Array, params: PyTree) -> Array:
    """Whether there may be an event in a step."""
    now = context.during(params, part.start.t, h).params(params, part.met.modes)
    asked = asks(context, part.start, part.end, now, part.met.over, h)
    return asked & ~part.met.ended if any(context.events.ends) else asked


def passage(context):
    """The function that handles the events of a step and records them. It also takes the counts of steps before and
    after."""

    @checkpoint  # reverse mode would keep all that is in there for each step
    def noted(now: tuple, h: Array, params: PyTree):
        part, log = now
        part, (rows, there) = pass_events(context, params, part, h)
        return part, log.with_more(rows, there, context.keep)

    def pass_them(now: tuple, counts: tuple | None, h: Array, params: PyTree):
        part, log = now
        # who asks, anew: what is needed here alone is nothing that a step without events has to keep
        asked = may_meet(context, part, h, params)
        if counts is not None:
            asked = asked & (counts[0] != counts[1])  # members that do not rest
        return in_turn(noted, asked, (part._replace(asked=asked), log), h, params)

    return pass_them


def at_rest(here: Array | None, new: PyTree, old: PyTree):
    """The new values; the old ones if a member of a sweep rests."""
    return new if here is None else tree_where(here, new, old)


def before_any(context: EventContext, params: PyTree, t: Array) -> EventState:
    """`EventState` before the first event."""
    none = jnp.zeros((), jnp.int32)
    return EventState(
        context.events.modes(params), jnp.array(False), none + FINE, none, over=context.events.before_any(t)
    )


def with_told_events(flat: FlatSystem, solution: Solution, met: EventState, keep: int) -> Solution:
    """The `Solution` with its `Events`, and what was wrong with one of them."""
    failure = solution.failure._replace(event=met.code, guard=met.event)
    return solution._replace(events=met.log.told(flat, keep), failure=failure)
