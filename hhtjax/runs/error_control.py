"""One step under error control: tried, its error estimated, accepted or rejected, and the size of the next chosen."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial, reduce
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.description import Array, PyTree, is_concrete
from hhtjax.description.presentation import shown
from hhtjax.jaxpr import on_scalars
from hhtjax.numerics.approximate_math import approximate_exp, approximate_log, without_rounding
from hhtjax.numerics.batched_cond import call_where_alone, tree_where
from hhtjax.primitives import largest_in_batch, one_kernel, or_alone, row_written, staged
from hhtjax.runs.driver import before_any, flaw_at_start, neutral_info, no_failure, saved, with_flaw
from hhtjax.runs.event_step import SHORT, EventContext, SubStep, asks, pass_events, reaching
from hhtjax.runs.interpolate import kept, output_between, solution_at, with_output
from hhtjax.runs.output import output_at_start
from hhtjax.runs.progress import announce, rewrite, steps_between
from hhtjax.runs.solution import EVENTS, FINE, MANY, SimulationError, first_bad
from hhtjax.steppers.stepper import entered, join_info, step_start
from hhtjax.steppers.variable_step import resized_step
from hhtjax.systems import kinematics, zero_order_hold
from hhtjax.systems.events import flatten_events

if TYPE_CHECKING:
    from hhtjax.runs.adaptive import Adaptive
    from hhtjax.runs.inputs import Problem
    from hhtjax.runs.solution import Solution
    from hhtjax.steppers.stepper import Info, State, Stepper
    from hhtjax.steppers.variable_step import Errors
    from hhtjax.systems.flat_system import FlatSystem

LOWEST = 1e-4  # error of the step before, as the controller sees it
FARTHER = 8  # times the last, that a step may be which its stepper proposes
ROUNDINGS = 16  # of t, of which a step is at least
DONE, TOO_SHORT, TOO_MANY, BROKEN, AT_EVENT = range(5)


class Controller(NamedTuple):
    """The PI controller of the step size: its exponents, divided by the order of the estimate, and bounds of the factor
    by which a step changes after an accepted one. Growth by more than 2 is unstable for some methods."""

    safety: float = 0.9
    proportional: float = 0.7
    integral: float = 0.4
    least: float = 0.2
    most: float = 2.0


PI = Controller()


class Walk(NamedTuple):
    """The carry of the loop over trial steps."""

    state: PyTree
    h: Array
    last: Array
    past: PyTree
    before: PyTree  # logarithm of the error of the last accepted step
    error: Any
    q_size: Array
    v_size: Array
    accepted: Array
    rejected: Array
    stop: Array
    met: Any = None  # of events


class StepTrial(NamedTuple):
    """How steps are tried, up to the time `end`. context: how events are handled; past_events: turns a trial step into
    one that handles them."""

    flat: FlatSystem
    stepper: Any  # a `Stepper` that estimates the error of its steps
    params: PyTree
    end: Any
    bounds: Bounds
    max_steps: int
    context: Any = None
    past_events: Any = None
    controller: Controller = PI
    stops: Any = None  # times at which steps end, too

    def proposed(self, walk: Walk, params: PyTree) -> Walk:
        """The walk with the next step proposed by the stepper itself, if it does so, and the data from which it derived
        it. The sizes passed to it include the absolute tolerances."""
        if not self.stepper.proposes:
            return walk
        rtol, atol, atol_v = self.bounds[:3]
        sizes = walk.q_size + atol / rtol, walk.v_size + atol_v / rtol
        past, h = self.stepper.proposed(self.flat, walk.state, params, rtol, *sizes)
        return walk._replace(past=past, h=jnp.minimum(walk.h, h))

    def params_of(self, walk: Walk):
        """The params of the next step."""
        return self.params if self.context is None else self.context.events.with_modes(self.params, walk.met.modes)


class TrialStep(NamedTuple):
    """A trial step: the walk if it is accepted, its error, the step size to try next, the size that must not fall below
    dt_min, and the reason to stop if it does."""

    walk: Walk
    error: Any
    h: Array
    shortest: Array
    why: Array


class Begun(NamedTuple):
    """More about a trial step: the state it started from, its planned end, and its `Info`."""

    state: PyTree
    end: Any
    info: Info


class Bounds(NamedTuple):
    """Tolerances and bounds in the dtype of the state. scale: the tolerance of the run divided by that of a step."""

    rtol: Array
    atol: Array  # of positions
    atol_v: Array  # (N,), of velocities and of internal states
    scale: Array
    least: Array
    most: Array

    @classmethod
    def of(cls, flat: FlatSystem, stepper, control: Adaptive, t0: Array, end: Array) -> Bounds:
        """The bounds of an `Adaptive`."""
        names = "rtol", "atol", "atol_v", "dt_min", "dt_max"
        rtol, atol, atol_v, least, most = (jnp.asarray(getattr(control, name)).astype(t0.dtype) for name in names)
        n, N = flat.positions, flat.size
        rounding = ROUNDINGS * float(jnp.finfo(t0.dtype).eps) * jnp.maximum(jnp.abs(t0), jnp.abs(end))
        each = jnp.concatenate([jnp.full(n, atol_v), jnp.full(N - n, atol)])
        power = min(0.0, 1 - stepper.estimate_order / stepper.order)  # no step has a looser tolerance than the run
        return cls(rtol, atol, each, rtol**power, jnp.maximum(least, rounding), most)

    def relative(self, flat: FlatSystem, errors: Errors, q_size: Array, v_size: Array) -> Array:
        """The largest error divided by its tolerance."""
        # reciprocals, which are there before the errors are
        error = jnp.max(jnp.abs(errors.v) * (self.scale / (self.atol_v + self.rtol * v_size)))
        if flat.positions:
            e_q = jnp.abs(flat.located(errors.q)) * (self.scale / (self.atol + self.rtol * q_size))
            error = jnp.maximum(error, jnp.max(e_q))
        return error

    def first(self, state: State, v_size: Array, span: Array) -> Array:
        """A first step that changes v by about its tolerance, at most a hundredth of the run."""
        tiny = float(jnp.finfo(span.dtype).tiny)
        slow = (self.atol_v + self.rtol * v_size) / self.scale / jnp.maximum(jnp.abs(state.w), tiny)
        h = jnp.minimum(jnp.min(jnp.sqrt(slow)), jnp.minimum(span / 100, self.most))
        return jnp.where(h > self.least, h, jnp.minimum(span / 100, self.most))


def sizes(flat: FlatSystem, state: State):
    """The sizes of positions and of rates."""
    return kinematics.sizes(flat.blocks, state.q), jnp.abs(state.v)


def next_step(h: Array, error: Array, before: Array, accept: Array, order: int, pi: Controller = PI):
    """The PI controller of Gustafsson, in the form of Hairer and Wanner, Sec. IV.2. `before`, and the second result,
    are logarithms of errors."""
    now = approximate_log(jnp.maximum(error, 1e-10))
    slope = jnp.where(accept, -pi.proportional / order, -1 / order)
    exponent = slope * now + jnp.where(accept, pi.integral / order * before, 0)
    least, most = jnp.where(accept, pi.least, 0.1), jnp.where(accept, pi.most, 0.9)
    factor = jnp.clip(pi.safety * approximate_exp(exponent), least, most)
    return h * factor, jnp.maximum(now, float(np.log(LOWEST)))


def judged(state: State, info: Info, error: Array) -> Array:
    """The error of a step; infinite if the step is not finite, did not converge, or reports another failure."""
    for x in (state.q, state.v, state.w, state.L):
        error = error if x is None else error + jnp.sum(0 * x)  # NaN where one is not finite
    fine = error < jnp.inf
    independent = None if info.dependent_row is None else info.dependent_row < 0
    for told in (info.converged, info.solved, independent):
        fine = fine if told is None else fine & told
    return jnp.where(fine, error, jnp.inf)


def is_walking(walk: Walk, end: Array) -> Array:
    """Whether there are steps left to try."""
    going = (walk.state.t < end) & (walk.stop == DONE)
    return going if walk.met is None else going & ~walk.met.ended


def next_end(trial: StepTrial, params: PyTree, walk: Walk):
    """The next step, and the time at which it ends. The step is the proposed one, or one or two halves of the interval
    to the end or the next jump.

    Step sizes have their last bits cleared. Otherwise rounding differences between a run and a batch, in the interval
    left before a jump, would grow from jump to jump.
    """
    t, end = walk.state.t, trial.end
    h, reach = (jnp.minimum(without_rounding(walk.h, more), trial.bounds.most) for more in (0, 4))
    due = jnp.minimum(end, zero_order_hold.jump_after(params, t)) if zero_order_hold.holds(params) else end
    if trial.stops is not None:
        due = jnp.minimum(due, jnp.min(jnp.where(trial.stops > t, trial.stops, end)))
    if trial.context is not None and walk.met.over:
        due = jnp.minimum(due, trial.context.events.due_after(t, walk.met.over))
    left = due - t
    lands = left <= reach  # what has doubled does, where jumps are equally far apart
    h = jnp.where(lands, left, jnp.minimum(h, without_rounding(left / 2, more=1)))  # the second half is no longer
    return h, jnp.where(lands, due, t + h)


def trial_step(trial: StepTrial, walk: Walk):
    """Walk -> Walk after one trial step, and how that step began."""
    bounds, order, params = trial.bounds, trial.stepper.estimate_order, trial.params_of(walk)
    asked = trial.proposed(walk, params)
    h, t1 = next_end(trial, params, asked)
    resized, state = trial.stepper.resized(walk.state, h / walk.last)
    now, state = step_start(resized, trial.flat, params, h, walk.last, state)
    s1, info, errors, past = resized.bind_estimated(trial.flat, now, h, asked.past)(state)
    s1 = s1._replace(t=t1)
    q_size, v_size = map(jnp.maximum, (walk.q_size, walk.v_size), sizes(trial.flat, s1))
    error = judged(s1, info, bounds.relative(trial.flat, errors, q_size, v_size))
    error = staged(lambda x: x)(error)
    h1, before = next_step(h, error, walk.before, error <= 1, order, trial.controller)
    if trial.stepper.proposes:
        h1 = jnp.where(error <= 1, FARTHER * h, h1)
    h1 = jnp.minimum(h1, bounds.most)
    new = walk._replace(state=s1, last=h, past=past, before=before, q_size=q_size, v_size=v_size)
    tried = TrialStep(new._replace(accepted=walk.accepted + 1), error, h1, h1, why_short(error))
    if trial.context is not None:
        tried = trial.past_events(trial, tried, walk, h)
    return taken(trial, walk, tried), Begun(state, s1.t, info)


def taken(trial: StepTrial, walk: Walk, tried: TrialStep) -> Walk:
    """The walk after a trial step: with the step if it is accepted, else with a smaller step to try."""
    accept = tried.error <= 1
    again = walk._replace(rejected=walk.rejected + 1)
    if walk.met is not None:  # what is wrong there
        again = again._replace(met=walk.met._replace(code=tried.walk.met.code, event=tried.walk.met.event))
    walk = jax.tree.map(partial(jnp.where, accept), tried.walk, again)._replace(h=tried.h, error=tried.error)
    fine = accept | (tried.shortest >= trial.bounds.least)
    spent = (walk.accepted + walk.rejected >= trial.max_steps) & is_walking(walk, trial.end)
    return walk._replace(stop=jnp.where(fine, jnp.where(spent, TOO_MANY, DONE), tried.why).astype(jnp.int32))


def why_short(error: Array) -> Array:
    """The reason to stop if this step has become too short."""
    return jnp.where(error < jnp.inf, TOO_SHORT, BROKEN)


def begin(trial: StepTrial, q: Array, v: Array, t0: Array):
    """The walk before its first step, and the state at t0 as it is saved. The method is started with the longest step
    considered for the start, of which shorter ones are parts."""
    flat, stepper, bounds = trial.flat, trial.stepper, trial.bounds
    longest = jnp.minimum((trial.end - t0) / 100, bounds.most)
    start, state = entered(
        stepper, flat, q, v, t0, zero_order_hold.before(trial.params, t0, longest), longest, resolves=True
    )
    q_size, v_size = sizes(flat, state)
    h = longest if stepper.proposes else bounds.first(state, v_size, trial.end - t0)
    one, none = jnp.ones_like(t0), jnp.zeros((), jnp.int32)
    past = stepper.begin_estimates(flat, state)
    walk = Walk(state, h, longest, past, 0 * one, one, q_size, v_size, none, none, none)
    if trial.context is not None:
        walk = walk._replace(met=before_any(trial.context, trial.params, t0))
    return walk, start


# ----------------------------------------------------------------------------
# Events under error control: a step that is accepted passes them, and what is left of it behind them is judged anew.
#
# The estimate of a step knows nothing of what comes behind an event, where the force may be another: so the rest has
# one of its own, as of a first step. If it is too large the whole step is tried again, with a shorter rest. And if
# there is another event in the rest, the step is tried again up to the middle between both, for what is between has no
# estimate. Where an event cannot be passed, shorter steps are tried too.


def trial_of(
    problem: Problem, end: Array, bounds: Bounds, max_steps: int, events: tuple | None = None, room: tuple = ()
) -> StepTrial:
    """How the steps of a problem are tried, with or without events."""
    flat, q, v, t0, params = problem.flat()
    stepper = problem.stepper.astype(q.dtype)
    trial = StepTrial(flat, stepper, params, end, bounds, max_steps)
    if events is None:
        return trial

    def one(h: Array):
        return resized_step(flat, stepper, params, h, h)(stepper.begin(flat, q, v, t0, params, h))

    no_info = neutral_info(jax.eval_shape(one, end)[1])
    flat_events = flatten_events(flat, events, params, (q, v, t0), stepper.redundant)
    context = EventContext(flat, stepper, flat_events, room[0], no_info, reaching(flat, stepper, no_info))
    return trial._replace(context=context, past_events=past_events)


def past_events(trial: StepTrial, tried: TrialStep, walk: Walk, h: Array) -> TrialStep:
    """The trial step, with the events that happen in it."""
    now = trial.context.during(trial.params, walk.state.t, h).params(trial.params, walk.met.modes)
    asked = (tried.error <= 1) & asks(trial.context, walk.state, tried.walk.state, now, walk.met.over, h)
    return call_where_alone(partial(passed, trial), asked, tried, walk, h)


def passed(trial: StepTrial, tried: TrialStep, walk: Walk, h: Array) -> TrialStep:
    """As `past_events`, where there may be an event."""
    context = trial.context
    met = walk.met._replace(code=jnp.full_like(walk.met.code, FINE))
    part = SubStep.whole(context, walk.state, tried.walk.state, context.no_info, h, walk.last, met, ~met.ended)
    part, (rows, there) = pass_events(context, trial.params, part, h)
    noted = jnp.asarray((*context.events.noted, True))[rows[:, 1].astype(jnp.int32)]
    there = there & ~noted  # which have nothing behind them
    times = jnp.where(there, rows[:, 0], jnp.inf)
    first = jnp.min(times)
    later = there & (times > first + SHORT * h)
    second = jnp.min(jnp.where(later, times, jnp.inf))
    middle = jnp.where(jnp.any(later), (first + second) / 2 - walk.state.t, h / 2)
    code = jnp.where((part.met.code == FINE) & jnp.any(later), MANY, part.met.code).astype(met.code.dtype)
    part = part._replace(met=part.met._replace(code=code))
    lost = tried._replace(
        walk=tried.walk._replace(met=part.met), error=jnp.full_like(tried.error, jnp.inf), h=middle, shortest=middle,
        why=jnp.full_like(tried.why, AT_EVENT),
    )  # fmt: skip
    judged = tree_where(part.divided > 0, behind(trial, tried, walk, part, h), tried)
    return tree_where(code == FINE, judged, lost)


def behind(trial: StepTrial, tried: TrialStep, walk: Walk, part: SubStep, h: Array) -> TrialStep:
    """The trial step with the error of the remainder after an event. While that error is too large, the remainder is
    shortened."""
    past, met = trial.stepper.begin_estimates(trial.flat, part.end), part.met
    reached = [(walk.q_size, walk.v_size), *(sizes(trial.flat, s) for s in (part.start, part.end))]  # and no farther
    q_size, v_size = (reduce(jnp.maximum, x) for x in zip(*reached, strict=True))
    new = tried.walk._replace(
        state=part.end, past=past, before=jnp.zeros_like(h), q_size=q_size, v_size=v_size, met=met
    )
    rest = jnp.maximum(part.rest, SHORT * h)
    params = zero_order_hold.held_at(trial.params_of(new), part.start.t + rest / 2)
    errors = trial.stepper.bind_estimated(trial.flat, params, rest, past)(part.start)[2]
    error = jnp.where(met.ended, 0, trial.bounds.relative(trial.flat, errors, q_size, v_size))
    error = judged(part.end, part.info, error)
    small = jnp.maximum(error, float(jnp.finfo(h.dtype).tiny))
    best = trial.controller.safety * small ** (-1 / trial.stepper.estimate_order)
    shorter = rest * jnp.clip(best, 0.1, 0.9)
    h = jnp.where(error <= 1, jnp.minimum(h, rest * best), h - rest + shorter)
    return TrialStep(new, error, h, shorter, why_short(error))


# ----------------------------------------------------------------------------
# Steps chosen by their errors: one loop, in which a rejected step is taken again, shorter.


WHY = {
    TOO_SHORT: "the step size fell below dt_min={:.3g}, the error estimate being {:.3g} times the tolerance",
    TOO_MANY: "max_steps={} used up; take more of them, or a larger rtol",
    BROKEN: "the step is not finite, at dt_min={:.3g} either",
}


@shown
class Steps(NamedTuple):
    """The steps that error control chose.

    Attributes:
        dt: (N,) the accepted steps; inside jit (max_steps,), NaN after the last one.
        accepted, rejected: their numbers.
        reached: the time at which they end; that of the last sample, unless they failed.
        stop: why they ended: 0 no failure, 1 below dt_min, 2 max_steps used up, 3 not finite, 4 a failure at an event.
        estimate: the estimated error of the last trial step, relative to the tolerance.
        dt_min: the lower bound of the steps.
        event, guard: those of `Failure`, for the last trial step; None without events.
        tightened: with `verify="tighten"`, the factor by which the tolerance was reduced; None without.
    """

    dt: Any
    accepted: Array
    rejected: Array
    reached: Array
    stop: Array
    estimate: Any
    dt_min: Array
    event: Array | None = None
    guard: Array | None = None
    tightened: Array | None = None

    def check(self):
        """Raises `SimulationError` if steps ended too early, naming the reason and the time; for a batch, of the first
        that did."""
        if fault := self._fault():
            raise SimulationError(f"choose_steps: {fault}")

    def _fault(self):
        """The message for what is wrong."""
        stop = np.asarray(self.stop)
        if not stop.any():
            return None
        member, which = first_bad(stop)
        accepted, rejected, reached, why, estimate, least = (np.asarray(x)[member] for x in self[1:7])
        if why == AT_EVENT:
            event, guard = np.asarray(self.event)[member], np.asarray(self.guard)[member]
            what, advice = EVENTS[int(event)]
            return f"{which}stopped at t = {reached:.6g}: {what} {guard}. {advice}."
        values = {TOO_SHORT: (least, estimate), TOO_MANY: (accepted + rejected,), BROKEN: (least,)}[int(why)]
        return f"{which}stopped at t = {reached:.6g}: {WHY[int(why)].format(*values)}."

    def _verdict(self):
        return "" if not is_concrete(self.stop) else self._fault() or "all accepted"


def select_steps(
    problem: Problem,
    end: Array,
    control: Adaptive,
    progress: bool = False,
    events: tuple | None = None,
    room: tuple = (),
    controller: Controller = PI,
    times: Array | None = None,
):
    """`Steps` from t0 to end, and (max_steps,) the times at which they end, inf after the last. Arguments must not be
    tracers of autodiff. times: (K,), samples to keep during the run; the third result is then the `Solution` there,
    else None. end: a time, or the times (K,) for a stepper that ends steps on them."""
    if progress:
        announce()
    stops, end = (end, end[-1]) if end.ndim else (None, end)
    flat, q, v, t0, _ = problem.flat()
    bounds = Bounds.of(flat, problem.stepper, control, t0, end)
    trial = trial_of(problem, end, bounds, control.max_steps, events, room)
    trial = trial._replace(controller=controller, stops=stops)
    walk, start = begin(trial, q, v, t0)
    plain = partial(trial_step, trial._replace(context=None))
    form = on_scalars(plain, walk, derivatives=False)  # as in a run: events are seldom
    one_try = form.of(plain if trial.context is None else partial(trial_step, trial))
    recorder: Any = None
    if times is not None:
        sensed = () if problem.output is None else (problem.output, trial.params, times[-1] - t0)
        recorder = Recorder.of(flat, trial.stepper, form, jax.eval_shape(plain, walk)[1].info, *sensed)

    def unfinished(
        carry: tuple,
    ) -> Array:  # one answer for a batch: else vmap has each try copy the ends of all members
        return largest_in_batch(is_walking(carry[0], end))

    def body(carry: tuple):
        walk, ends, since = carry
        new, begun = one_try(walk)
        here = or_alone(is_walking(walk, end))
        new = jax.tree.map(partial(jnp.where, here), new, walk)
        accepted = new.accepted > walk.accepted
        ends = row_written(ends, jnp.where(accepted, begun.end, jnp.inf), walk.accepted)
        return new, ends, recorder and recorder.add(since, begun, accepted)

    def tries(carry):
        return largest_in_batch(carry[0].accepted + carry[0].rejected)

    def walked(carry: tuple, ahead: Callable):
        """Continues the walk while `ahead` is true; with a bar, in blocks of trial steps, each of them a kernel."""
        if not progress:
            return lax.while_loop(ahead, body, carry)

        def some(carry):
            limit = tries(carry) + steps_between(control.max_steps, q.size)
            block = partial(lax.while_loop, lambda x: ahead(x) & (tries(x) < limit), body)
            carry = one_kernel(block, carry)
            over, t = ~unfinished(carry), carry[0].state.t
            lax.cond(over | (tries(carry) >= limit), lambda: show((t - t0) / (end - t0), over), lambda: None)
            return carry

        return lax.while_loop(ahead, some, carry)

    def to_sample(carry: tuple, time: Array):
        walk, ends, since = walked(carry, lambda x: unfinished(x) & (x[0].state.t < time))
        since, around = recorder.sample(since, walk.state, time)
        return (walk, ends, since), around

    def run(walk):
        carry = walk, jnp.full(control.max_steps, jnp.inf, t0.dtype), recorder and recorder.none
        return (walked(carry, unfinished), None) if times is None else lax.scan(to_sample, carry, times)

    (walk, ends, _), around = (run if progress else partial(one_kernel, run))(form.tree)
    steps = as_steps(form.joined(walk), ends, t0, bounds.least)
    if times is None:
        return steps, ends, None
    return steps, ends, solution(problem, start, form.joined(around), times, steps.reached)


def as_steps(walk: Walk, times: Array, t0: Array, least: Array) -> Steps:
    """The `Steps` of a finished walk whose steps end at these times."""
    numbers = jnp.arange(times.size, dtype=jnp.int32)
    dt = jnp.where(numbers < walk.accepted, jnp.diff(times, prepend=t0), jnp.nan)
    steps = Steps(dt, walk.accepted, walk.rejected, walk.state.t, walk.stop, walk.error, least)
    if walk.met is None:
        return steps
    return steps._replace(event=jnp.where(walk.stop == AT_EVENT, walk.met.code, 0), guard=walk.met.event)


def show(share, over):
    """A progress bar on stderr; over: whether the run is finished."""

    def bar(share, over):
        done = int(100 * min(float(share), 1.0))
        rewrite(f"{done} % of the time", bool(over), done, 100)

    jax.debug.callback(bar, share, over)


def trimmed(steps: Steps) -> Steps:
    """Without the unused entries after the accepted steps (for a batch, after the longest member), if their number is
    known."""
    if not is_concrete(steps.accepted):
        return steps
    dt, accepted = map(np.asarray, (steps.dt, steps.accepted))  # jnp would compile a program for each number
    return steps._replace(dt=jax.device_put(dt[..., : np.max(accepted)]))


# ----------------------------------------------------------------------------
# What lies around the sample times, kept while steps are chosen: a run under error control in one pass.
#
# The values are those of a run over the chosen steps, to rounding; a step that was accepted has not failed. Derivatives
# and batches are those of that run, in a second pass, as is what happens within steps: events, and dry friction.


class Since(NamedTuple):
    """The steps since the last sample. first: what was saved at the start of the last step; info: their joined
    `Info`."""

    first: PyTree
    info: Info


class Recorder(NamedTuple):
    """How samples of a walk are recorded. none: the `Since` before the first trial step; begin, end: what is kept of a
    state."""

    none: Since
    begin: Callable
    end: Any
    read: Any = None
    alone: bool = False  # whether that is all that is kept

    @classmethod
    def of(
        cls, flat: FlatSystem, stepper: Stepper, form, info: Info, output=None, params: PyTree = None, long=None
    ) -> Recorder:
        """info: that of a trial step, for its structure. output: the output function, evaluated with params; long: see
        `read_between`."""
        begin, end = form.of(partial(saved, flat)), form.of(partial(kept, flat, stepper))
        since = Since(begin(form.tree.state), neutral_info(info))
        if output is None:
            return cls(since, begin, end)

        def read(first, second, time):
            return output_between(flat, output, params, ((first, None), second), time, long)

        return cls(since, begin, end, form.of(read), not output.beside_path)

    def add(self, since: Since, begun: Begun, accepted: Array) -> Since:
        """`since` with one more trial step. Also a rejected step sets the beginning, which is that of the next
        trial."""
        return Since(self.begin(begun.state), tree_where(accepted, join_info(since.info, begun.info), since.info))

    def sample(self, since: Since, state: State, time: Array):
        """The steps since a sample before this state, and the values around the sample, which lies in the step that
        ends in this state."""
        end = self.end(state)
        found = None if self.read is None else self.read(since.first, end, time)
        return since._replace(info=self.none.info), (
            None if self.alone else ((since.first, None), end),
            found,
            since.info,
        )


def solution(problem: Problem, start: State, around: tuple, times: Array, reached: Array) -> Solution:
    """The `Solution` at the times, from the values kept around them."""
    flat, _, _, _, params = problem.flat()
    around, found, info = around
    flaw, failure = flaw_at_start(problem.system, flat, start, params), no_failure(jax.tree.map(lambda x: x[0], info))
    run = solution_at(flat, start, around, times, reached, info, with_flaw(failure, flaw))
    if problem.output is None:
        return run
    at_start = output_at_start(flat, problem.output, params, start, (times[-1] - start.t) / 100)
    return with_output(run, at_start, found, times, reached)
