"""Steps chosen by their errors: one loop, in which a rejected step is taken again, shorter."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.description import is_concrete
from hhtjax.description.presentation import overwrite, shown
from hhtjax.runs.attempt import AT_EVENT, BROKEN, PI, TOO_MANY, TOO_SHORT, Bounds, attempt, begin, is_walking
from hhtjax.runs.attempt_events import trial_of
from hhtjax.runs.event_failures import EVENTS
from hhtjax.runs.faults import first_bad
from hhtjax.runs.progress import announce, steps_between
from hhtjax.runs.recorded import Recorder, solution
from hhtjax.runs.solution import SimulationError
from hhtjax.xla import largest_in_batch, on_scalars, one_kernel, or_alone, row_written

WHY = {
    TOO_SHORT: "the step size fell below dt_min={:.3g}, the error estimate being {:.3g} times the tolerance",
    TOO_MANY: "max_steps={} used up; take more of them, or a larger rtol",
    BROKEN: "the step is not finite, at dt_min={:.3g} either",
}


@shown
class Steps(NamedTuple):
    """What error control chose.

    Attributes:
        dt: (N,) the accepted steps; inside jit (max_steps,), NaN behind them.
        accepted, rejected: their numbers.
        reached: the time at which they end; that of the last sample, unless they failed.
        stop: why they ended: 0 all well, 1 below dt_min, 2 max_steps used up, 3 not finite, 4 what went wrong at an
            event.
        estimate: of the last step tried, relative to the tolerance.
        dt_min: below which steps were not to fall.
        event, guard: those of `Failure`, of the last step tried; None without events.
        tightened: with `verify="tighten"` how much of the tolerance they were chosen for; None without.
    """

    dt: Any
    accepted: Any
    rejected: Any
    reached: Any
    stop: Any
    estimate: Any
    dt_min: Any
    event: Any = None
    guard: Any = None
    tightened: Any = None

    def check(self):
        """Raises `SimulationError` naming why, and at which time, steps ended too early; for a batch the first."""
        if fault := self._fault():
            raise SimulationError(f"choose_steps: {fault}")

    def _fault(self):
        """What is wrong, in words."""
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


def choose(problem, end, control, progress=False, events=None, room=(), controller=PI, times=None):
    """`Steps` from t0 to end, and (max_steps,) the times at which they end, inf behind them; no tracer of autodiff may
    come in. times: where samples are kept on the way, (K,); the third result is the `Solution` there, or None."""
    if progress:
        announce()
    flat, q, v, t0, _ = problem.flat()
    bounds = Bounds.of(flat, problem.stepper, control, t0, end)
    trial = trial_of(problem, end, bounds, control.max_steps, events, room)._replace(controller=controller)
    walk, start = begin(trial, q, v, t0)
    plain = partial(attempt, trial._replace(ways=None))
    form = on_scalars(plain, walk, derivatives=False)  # as in a run: events are seldom
    one_try = form.of(plain if trial.ways is None else partial(attempt, trial))
    recorder: Any = None
    if times is not None:
        sensed = () if problem.output is None else (problem.output, trial.params, times[-1] - t0)
        recorder = Recorder.of(flat, trial.stepper, form, jax.eval_shape(plain, walk)[1].info, *sensed)

    def unfinished(carry):  # one answer for a batch: else vmap has each try copy the ends of all members
        return largest_in_batch(is_walking(carry[0], end))

    def body(carry):
        walk, ends, since = carry
        new, begun = one_try(walk)
        here = or_alone(is_walking(walk, end))
        new = jax.tree.map(partial(jnp.where, here), new, walk)
        accepted = new.accepted > walk.accepted
        ends = row_written(ends, jnp.where(accepted, begun.end, jnp.inf), walk.accepted)
        return new, ends, recorder and recorder.add(since, begun, accepted)

    def tries(carry):
        return largest_in_batch(carry[0].accepted + carry[0].rejected)

    def walked(carry, ahead):
        """The walk on, while `ahead`; with a bar in blocks of tries, each a kernel."""
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

    def to_sample(carry, time):
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


def as_steps(walk, times, t0, least):
    """The `Steps` of a walk that is over, which end at these times."""
    numbers = jnp.arange(times.size, dtype=jnp.int32)
    dt = jnp.where(numbers < walk.accepted, jnp.diff(times, prepend=t0), jnp.nan)
    steps = Steps(dt, walk.accepted, walk.rejected, walk.state.t, walk.stop, walk.error, least)
    if walk.met is None:
        return steps
    return steps._replace(event=jnp.where(walk.stop == AT_EVENT, walk.met.code, 0), guard=walk.met.event)


def show(share, over):
    """A bar on stderr; over: whether it is the last."""

    def bar(share, over):
        done = int(100 * min(float(share), 1.0))
        overwrite(f"[{'#' * (done * 40 // 100):<40}] {done} % of the time", last=bool(over))

    jax.debug.callback(bar, share, over)


def trimmed(steps):
    """Without what is behind the accepted ones, of a batch the most, where their numbers are known."""
    if not is_concrete(steps.accepted):
        return steps
    dt, accepted = map(np.asarray, (steps.dt, steps.accepted))  # jnp would compile a program for each number
    return steps._replace(dt=jax.device_put(dt[..., : np.max(accepted)]))
