"""A run under error control. Steps and samples are computed in one pass; or steps first, then the run. And its
error."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap

from hhtjax.checks import require_integer
from hhtjax.description import Array, PyTree, Real, all_concrete, is_tracing
from hhtjax.numerics.batched_cond import derivative_by
from hhtjax.numerics.checkpointed_scan import checkpoint
from hhtjax.numerics.closures import hoisted
from hhtjax.numerics.differentiable_while import repeat
from hhtjax.primitives import is_traced, is_untouched, largest_in_batch, one_kernel, or_alone
from hhtjax.runs.adaptive import adaptive, require_controlled, require_single
from hhtjax.runs.driver import drive, resting, steps_of
from hhtjax.runs.error_control import Steps, select_steps, trimmed
from hhtjax.runs.event_step import Pieces
from hhtjax.runs.frozen_steps import frozen, is_pair, run_and_choice
from hhtjax.runs.inputs import Problem, require_events, require_sample_times
from hhtjax.runs.interpolate import kept, output_between, solution_at, with_output
from hhtjax.runs.output import beside_path, output_at_start, without_path
from hhtjax.runs.solution import Solution
from hhtjax.steppers.stepper import Stepper, step_start
from hhtjax.systems.events import Event
from hhtjax.systems.system import AnySystem, require_masses
from hhtjax.xla import Programs

if TYPE_CHECKING:
    from hhtjax.runs.adaptive import Adaptive
    from hhtjax.runs.driver import Loop, Run
    from hhtjax.runs.inputs import EqualSteps
    from hhtjax.runs.output import Output
    from hhtjax.runs.solution import Failure
    from hhtjax.steppers.stepper import State
    from hhtjax.systems.flat_system import FlatSystem


def run_controlled(problem, times: Real, control: Adaptive, progress: bool, events=None, room: tuple = ()) -> Solution:
    """The run of `simulate` with an `Adaptive` as dt."""
    times = checked_times("simulate", problem, times, control)
    if events is not None:
        events = require_events("simulate", problem, events, usual_step(problem.t0, times))
    problem = problem.controlled(control)._replace(output=beside_path(problem.output, control))
    start, alone = (problem, times, control, events), is_untouched() and not is_pair()
    if control.verify == "tighten":
        run = run_tightened(start, alone, progress, room)
        return run if problem.output is None else without_path(run)
    in_one = alone and passes_alone(problem, events)
    if in_one:  # else the program that chooses steps for a derivative or a batch is that of `choose_steps`
        run, steps, ends = run_in_one(problem, times, unverified(control), progress)
        choice = lax.stop_gradient(start) if control.verify else start
    else:
        start, choice = run_and_choice(start)
        run, steps, ends = run_in_two(start, choice, progress, room)
    if control.verify:
        better = finer(start, choice, steps, ends, room, in_one)
        run = run._replace(**verified(run, better, start[2], problem.stepper.order))
    steps = trimmed(steps)
    run = run._replace(dt=steps.dt, steps=steps)
    return run if problem.output is None else without_path(run)


def passes_alone(problem: Problem, events) -> bool:
    """Whether steps and samples are computed in one pass, which is so if the run is not differentiated or batched."""
    return events is None and problem.system.friction is None


def unverified(control: Adaptive) -> Adaptive:
    """A second run with the same steps."""
    return replace(control, verify=False)


def finer(start: tuple, choice: tuple, steps: Steps, ends: Array, room: tuple, in_one: bool) -> Solution:
    """The run with every step halved, or with steps chosen for a quarter of the tolerance."""
    if start[2].verify != "tolerance":
        return over(start, steps, ends, room, halved=True)
    problem, times, looser, theirs = choice
    if in_one:
        return run_in_one(problem, times, scaled(unverified(looser), 1 / 4))[0]
    return run_in_two(start, (problem, times, scaled(looser, 1 / 4), theirs), room=room)[0]


def run_in_two(start: tuple, choice: tuple, progress: bool = False, room: tuple = ()):
    """The `Solution` of a start, (problem, times, control, events), with steps chosen for another start, `choice`; its
    `Steps`, and the times at which they end."""
    steps, ends = steps_for(choice, progress, room)
    return over(start, steps, ends, room), steps, ends


def over(start: tuple, steps: Steps, ends: Array, room: tuple = (), halved: bool = False) -> Solution:
    """The `Solution` with these steps, each halved or not."""
    problem, times, _, events = start
    keywords = {"halved": halved, "room": room, "rates": problem.rates()}
    return run_over(problem, times, ends, steps.accepted, events, **keywords)


def run_tightened(start: tuple, alone: bool, progress: bool, room: tuple) -> Solution:
    """The run whose tolerance is reduced until its error is as small as requested."""
    start, choice = (start, lax.stop_gradient(start)) if alone else run_and_choice(start)
    problem, times, control, events = choice
    choice = problem, times, unverified(control), events
    last = rounds(choice, progress=progress, room=room, rates=problem.rates())
    again = partial(over, room=room)
    if alone and not is_tracing():
        run = last.run
    elif is_pair() or not is_tracing():  # no jit, of which a derivative may or may not be made
        run = again(start, last.steps, last.ends)
    else:
        run = accepted_run(last, again, start)
    steps = trimmed(last.steps)._replace(tightened=last.share)
    return run._replace(dt=steps.dt, steps=steps, error=last.error, allowed=last.allowed)


@partial(Programs, static_argnames=("progress", "room"))
def rounds(choice: tuple, progress: bool, room: tuple) -> Round:
    """The last `Round`. Arguments must not be tracers of autodiff."""
    problem, times, control, events = choice

    def once(share: Array):
        tighter = scaled(control, share)
        if passes_alone(problem, events):
            return run_in_one(problem, times, tighter, progress)
        again = problem, times, tighter, events
        return run_in_two(again, again, progress, room)

    return frozen(partial(tighten, once, partial(compared, control=control)), problem.times(1.0))


@partial(Programs, static_argnames=("progress",))
def run_recorded(problem: Problem, times: Array, control: Adaptive, progress: bool = False):
    """The same in one pass, without derivatives; vmap changes it to two passes."""

    def record(problem: Problem, times: Array, control: Adaptive):
        steps, ends, run = select_steps(
            problem, problem.times(due(problem, times)), control, progress, times=problem.times(times)
        )
        return run, steps, ends

    @custom_vmap
    def in_one(problem: Problem, times: Array, control: Adaptive):
        return one_kernel(record, problem, times, control, around=True)

    @in_one.def_vmap
    def _(size, batched, *args):
        axes = jax.tree.map(lambda mapped: 0 if mapped else None, batched)
        found = jax.vmap(partial(in_two_passes, progress=progress), axes, axis_size=size)(*args)
        return found, jax.tree.map(lambda _: True, found)

    return in_one(problem, times, control)


def in_two_passes(problem: Problem, times: np.ndarray, control: Adaptive, progress: bool = False):
    """The same."""
    start = problem, times, control, None
    return run_in_two(start, lax.stop_gradient(start), progress)


def run_in_one(problem: Problem, times: Real, control: Adaptive, progress: bool = False):
    """One pass, with the derivatives of two passes, inside a jit that may be differentiated or batched."""
    data = problem, times, control
    in_one, in_two = (
        partial(run_recorded, progress=progress, rates=problem.rates()),
        partial(in_two_passes, progress=progress),
    )
    if not is_traced():
        return in_one(*data)
    in_one, closed_over = hoisted(in_one, *data)
    if not all_concrete(closed_over):
        return in_two(*data)
    return derivative_by(in_two, partial(in_one, closed_over), *data)


# ----------------------------------------------------------------------------
# Runs over chosen steps, read off at any times: differentiable, the steps being constant.


@partial(Programs, static_argnames=("progress", "room"))
def chosen_steps(
    problem: Problem,
    end: Array,
    control: Adaptive,
    events: tuple | None = None,
    progress: bool = False,
    room: tuple = (),
):
    """`Steps` to `end`, and the times at which they end. Arguments must not be tracers of autodiff.

    It is one kernel, including what comes before and after the loop: each separate part costs about a microsecond.
    """

    def found(problem: Problem, end: Array, control: Adaptive, events: tuple | None):
        return select_steps(problem, problem.times(end), control, progress, events, room)[:2]

    return frozen(partial(one_kernel, found, around=True), problem, end, control, events)


def steps_for(choice: tuple, progress: bool, room: tuple):
    """The steps to the last of the times, by one program for any number of times, independent of what is done with the
    run."""
    problem, times, control, events = choice
    control, problem = replace(control, verify=False), problem._replace(output=None)
    keywords = {"progress": progress, "room": room[:1], "rates": problem.rates()}
    return chosen_steps(problem, due(problem, times), control, events, **keywords)


def due(problem: Problem, times: Real) -> Real:
    """The end of a run; or all of its times, for a stepper whose steps must end on them."""
    return times if problem.stepper.lands else times[-1]


class Grid(NamedTuple):
    """Frozen steps from t0 on. ends: (N,), inf after the last; counts: (K,), the number of steps from one of the times
    to the next, where the last of them ends at that time or later; reached: the end of the last step."""

    t0: Real
    ends: Array
    counts: Array
    reached: Array

    @classmethod
    def of(cls, t0: Array, times: Array, ends: Array, accepted: Real, halved: bool = False) -> Grid:
        """The steps with these ends, of which `accepted` are valid; each halved or not."""
        reached = jnp.where(accepted > 0, ends[jnp.maximum(accepted - 1, 0)], t0)
        wanted = jnp.minimum(times, reached)
        needed = jnp.searchsorted(ends, wanted)
        needed = needed + (t0 < wanted).astype(needed.dtype)
        if halved:
            starts = jnp.concatenate([t0[None], ends[:-1]])
            ends = jnp.stack([(starts + ends) / 2, ends], 1).ravel()
            needed = 2 * needed - ((needed > 0) & (ends[2 * needed - 2] >= times)).astype(needed.dtype)
        return cls(t0, ends, jnp.diff(needed, prepend=0).astype(jnp.int32), reached)

    def loop(self, flat: FlatSystem, stepper: Stepper, q: Array, v: Array, t0: Array, params: PyTree) -> Loop:
        """The `Loop` over its steps."""
        return steps_of(flat, stepper, q, v, t0, params, self.sizes, resolves=True)

    def sizes(self, number: Real):
        """The size of a step, the size of the previous one, and the end of the step; after the last step 1, and inf."""

        def time(taken: Real) -> Array:
            end = lax.dynamic_index_in_dim(self.ends, jnp.maximum(taken - 1, 0), keepdims=False)
            return jnp.where(taken > 0, end, self.t0)

        before, start, end = (time(number + i) for i in (-1, 0, 1))
        is_there = jnp.isfinite(end) & (number < self.ends.size)
        h = jnp.where(is_there, end - start, 1)
        last = jnp.where(jnp.isfinite(start) & (number > 0), start - before, h)
        return h, last, jnp.where(is_there, end, jnp.inf)


@partial(Programs, static_argnames=("halved", "room"))
def run_over(
    problem: Problem,
    times: Array,
    ends: Array,
    accepted: Array,
    events: tuple | None = None,
    halved: bool = False,
    room: tuple = (),
) -> Solution:
    """The `Solution` at `times` with the steps that have these ends, of which `accepted` are valid; each halved or
    not."""

    def run(problem: Problem, times: Array, ends: Array, accepted: Array, events: tuple | None) -> Solution:
        t0, times = problem.times(problem.t0), problem.times(times)
        return follow(problem, times, Grid.of(t0, times, ends, accepted, halved), events, room)

    return one_kernel(run, problem, times, ends, accepted, events, around=True)  # as above


def follow(
    problem: Problem, times: Array, grid: Grid | EqualSteps, events: tuple | None = None, room: tuple = ()
) -> Solution:
    """The `Solution` at `times` with the steps of a grid. In a batch, a member without steps left waits for the
    others."""
    return drive(problem, grid.loop, partial(_between, times=times, grid=grid), events, room, between=True)


def _between(run: Run, times: Array, grid: Grid | EqualSteps):
    """Samples at these times, each interpolated in the step that ends there or later."""
    problem, flat, params, loop, form = run
    in_pieces = loop.now is not None
    begun = partial(begun_with, flat, problem.stepper, params, loop)
    keep, read = partial(kept, flat, problem.stepper), None
    longest = largest_in_batch(grid.counts)
    if problem.output is not None:
        read = partial(output_in, loop, flat, problem.output, params, keep, times[-1] - loop.carry[0].t)
        if not problem.output.beside_path:
            keep = None
    interval = to_next_sample(loop, form, begun, keep, in_pieces, read)

    def samples(carry: tuple):
        return lax.scan(interval, (() if in_pieces else carry[0], carry), (grid.counts, longest, times))

    (_, carry), (around, found, info) = one_kernel(samples, form.tree)

    def solution(failure: Failure) -> Solution:
        state, _, _, *met = carry
        ends = times
        if met:
            ends = jnp.where(form.joined(met[0]).ended, jnp.minimum(times, state.t), times)
        run = solution_at(flat, loop.start, form.joined(around), ends, grid.reached, info, failure)
        if problem.output is None:
            return run
        first = loop.sizes(jnp.zeros((), jnp.int32))[0]
        at_start = output_at_start(flat, problem.output, params, loop.start, first)
        return with_output(run, at_start, form.joined(found), ends, grid.reached)

    return carry, solution


def to_next_sample(
    loop: Loop, form, begun: Callable, keep: Callable | None, in_pieces: bool, read: Callable | None = None
):
    """The body of the scan over the times: it takes steps until one ends at the time or later, and returns both ends of
    that step.

    in_pieces: both ends of the part between events, which its `Pieces` describe; else the previous state is carried
    along. keep: what to keep of both ends, None for nothing; read: what else to compute from both ends, the run and the
    time.
    """
    advance, begun = form.of(loop.advance), form.of(begun)

    @checkpoint
    def interval(carry: tuple, now: tuple):
        count, most, time = now

        def step(i: Array, carry: tuple):
            last, run, info = carry
            here = or_alone(i < count)
            last = () if in_pieces else jax.tree.map(partial(jnp.where, here), begun(run), last)
            return last, *resting(advance, in_pieces, run, info, here)

        last, run, info = repeat(step, (*carry, loop.no_info), most)
        pair = form.of(Pieces.around)(run[3].pieces, time) if in_pieces else (last, run[0])
        around = None if keep is None else tuple(map(form.of(keep), pair[:2]))
        found = None if read is None else form.of(read)(pair, run, time)
        return (last, run), (around, found, info)

    return interval


def output_in(
    loop: Loop,
    flat: FlatSystem,
    output: Output,
    params: PyTree,
    keep: Callable,
    long: Array,
    pair: tuple,
    run: tuple,
    time: Array,
) -> PyTree:
    """The output of a run at a time between two states, with their modes if there are events."""
    first, second, *modes = pair
    if modes:
        state, _, _, met = run
        time = jnp.where(met.ended, jnp.minimum(time, state.t), time)
        params = loop.now(met._replace(modes=modes[0] or met.modes))
    return output_between(flat, output, params, (keep(first), keep(second)), time, long)


def begun_with(flat: FlatSystem, stepper: Stepper, params: PyTree, loop: Loop, run: tuple) -> State:
    """The state from which the next step of a run starts, after a jump of held inputs if there is one."""
    state, count, _ = run
    h, last = loop.sizes(count)
    return step_start(stepper, flat, params, h, last, state)[1]


def choose_steps(
    system: AnySystem,
    stepper: Stepper,
    q0: PyTree,
    v0: PyTree = None,
    params: PyTree = None,
    *,
    times: Real,
    z0: PyTree = None,
    t0: Real = 0.0,
    progress: bool = False,
    events: Sequence[Event] | None = None,
    max_events: int = 2,
    **tolerances: Any,
) -> Steps:
    """The steps that error control chooses: `simulate(..., dt=adaptive(...))` without the run.

    A run with these steps, `simulate(..., dt=steps.dt)`, is differentiable and smooth in all its arguments. The steps
    are frozen: they fit the motion for which they were chosen, and motions close to it.

    Args:
        system, stepper, q0, v0, params, z0, t0, progress, events, max_events: those of `simulate`.
        times: (K,); steps go to the last of them, and need not end at the others.
        **tolerances: those of `adaptive`: rtol, atol, and others; not `verify`, which needs runs.

    Returns:
        `Steps`, constants for derivatives. Failures are not raised: call `steps.check()`.

    Raises:
        TypeError, ValueError, NotImplementedError: those of `simulate` and `adaptive`; a stepper without an error
            estimate.

    >>> import jax.numpy as jnp, hhtjax
    >>> oscillator = hhtjax.LinearSystem(M=jnp.ones(1), C=jnp.full(1, 8.0), K=jnp.full(1, 16.0))
    >>> start = jnp.ones(1), jnp.zeros(1)
    >>> steps = hhtjax.choose_steps(oscillator, hhtjax.hht(), *start, times=[4.0], rtol=1e-3, atol=1e-6)
    >>> steps.check()
    >>> run = hhtjax.simulate(oscillator, hhtjax.hht(), *start, dt=steps.dt)
    >>> bool(steps.dt[-1] > 10 * steps.dt[0]), bool(abs(run.q[-1, 0] - 17 * jnp.exp(-16.0)) < 1e-3)
    (True, True)
    """
    problem = Problem.checked("choose_steps", system, stepper, q0, v0, params, t0, z0)
    control = adaptive(**tolerances)
    if control.verify:
        raise ValueError(
            f"choose_steps: leave `verify` out; received {control.verify!r}. It takes runs: `simulate` with "
            f"dt=adaptive(..., verify={control.verify!r}) returns its steps as `run.steps`."
        )
    times = checked_times("choose_steps", problem, times, control)
    problem = problem.controlled(control)
    room = (require_integer("choose_steps", "max_events", max_events),)
    if events is not None:
        events = require_events("choose_steps", problem, events, usual_step(problem.t0, times))
    return trimmed(steps_for(lax.stop_gradient((problem, times, control, events)), progress, room)[0])


def usual_step(t0: Real, times: np.ndarray) -> Real:
    """The limit of a step before any is chosen: a thousandth of the run."""
    return (times[-1] - t0) / 1000


def checked_times(caller: str, problem: Problem, times: PyTree, control: Adaptive) -> Real:
    """Returns times, checked; raises an error for a stepper without error control."""
    require_controlled(caller, problem.stepper, problem.system)
    require_masses(caller, problem.system, "take steps without error control")
    require_single(caller, control)
    return require_sample_times(times, problem.t0, jax.tree.leaves(problem.q0)[0].dtype, caller)


# ----------------------------------------------------------------------------
# Steps for the error of a whole run: chosen again for a smaller tolerance, until that error is what was asked for.
#
# Each round is the finer run by which the one before is judged, and it by that one: errors of runs follow the
# tolerance, so that of the round, with a share s of it, is s / (s_before - s) of the difference between both.


ENOUGH, AIM = 0.8, 0.6  # of the tolerance: errors are stated to a tenth or two; and for the next round
LEAST, MOST = 1 / 16, 1 / 4  # of the share before: beyond, the coarser run may be too far off to judge by
ROUNDS = 8


class Round(NamedTuple):
    """run, steps, ends: the results; share: the fraction of the tolerance for which the steps were chosen; following:
    that of the next round; error, allowed: those of the `Solution`; is_open: whether another round is needed; number:
    of rounds."""

    run: Solution
    steps: Steps | None
    ends: Array
    share: Array
    following: Array
    error: Any
    allowed: Any
    is_open: Array
    number: Array

    def told(self):
        """The fields of the `Solution` about its error."""
        return {"error": self.error, "allowed": self.allowed}


def tighten(once: Callable, judge: Callable, one: Array) -> Round:
    """The last `Round`. It is not differentiable. It may be a batch, which continues until all members are finished.

    once: share -> run, `Steps`, their ends; judge: run, previous run, share of their difference -> error, allowed; one:
    the first share, or one for each member.
    """
    found = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(once, one))
    error, allowed = jax.tree.map(jnp.zeros_like, jax.eval_shape(judge, found[0], found[0], one))
    run, steps, ends = found
    begun = Round(run, steps, ends, 2 * one, one, error, allowed, one > 0, jnp.zeros((), jnp.int32))

    def goes_on(last: Round) -> Array:
        return jnp.any(last.is_open) & (last.number < ROUNDS)

    def following(last: Round) -> Round:
        is_first = last.number == 0
        share = jnp.where(last.is_open, last.following, one)  # what costs least, for those who wait for others
        run, steps, ends = once(share)
        error, allowed = judge(run, last.run, jnp.where(last.is_open, share / (last.share - share), one))
        worst = jnp.where(is_first, jnp.inf, jnp.max(error, axis=-1))
        factor = jnp.where(is_first, MOST, jnp.clip(AIM * allowed / worst, LEAST, MOST))
        is_open = ~(worst <= ENOUGH * allowed) & (steps.stop == 0) & last.is_open
        new = Round(run, steps, ends, share, share * factor, error, allowed, is_open, last.number + 1)

        def kept(old: Array, x: Array) -> Array:
            was_open = last.is_open.reshape(last.is_open.shape + (1,) * (x.ndim - last.is_open.ndim))
            return x if x.ndim < last.is_open.ndim else jnp.where(was_open, x, old)

        return jax.tree.map(kept, last, new)

    return lax.while_loop(goes_on, following, begun)


def accepted_run(last, over, start):
    """`last.run`, with the derivatives of over(start, steps, ends), a run with its steps that is only computed for
    derivatives."""
    over, closed_over = hoisted(over, start, last.steps, last.ends)

    def again(_, *args):
        return over(*args)

    return derivative_by(again, lambda run, *_: run, last.run, closed_over, start, last.steps, last.ends)


# ----------------------------------------------------------------------------
# The error of a whole run under error control, by another run of it.


ALARM = 10  # times what was asked for, above which the error of a run is a failure


def scaled(control: Adaptive, share: Real) -> Adaptive:
    """The control with the tolerance multiplied by a share."""
    return replace(control, **{name: share * getattr(control, name) for name in ("rtol", "atol", "atol_v")})


def verified(run: Solution, finer: Solution, control: Adaptive, order: int):
    """The fields of a `Solution` about its error, by Richardson extrapolation from a finer run; constants for
    derivatives."""
    left = 0.25 if control.verify == "tolerance" else 0.5**order  # of the error
    error, tolerance = compared(run, finer, 1 / (1 - left), control)
    return {"error": error, "allowed": ALARM * tolerance}


def compared(run: Solution, other: Solution, share: Real, control: Adaptive):
    """A share of the difference at each of the times, in its largest coordinate; and the allowed error."""

    def largest(q: Array) -> Array:
        return jnp.max(jnp.stack([jnp.max(jnp.abs(x).reshape(len(x), -1), axis=1) for x in jax.tree.leaves(q)]), axis=0)

    q, others, control = lax.stop_gradient((run.q, other.q, control))
    error = largest(jax.tree.map(jnp.subtract, others, q)) * share
    rtol, atol = (jnp.asarray(x).astype(error.dtype) for x in (control.rtol, control.atol))
    return error, rtol * jnp.max(largest(q)) + atol
