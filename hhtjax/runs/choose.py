"""Steps chosen by their errors: one loop, in which a rejected step is taken again, shorter."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.description import is_concrete
from hhtjax.description.presentation import overwrite, shown
from hhtjax.runs.solution import SimulationError, first_bad
from hhtjax.systems import held, kinematics
from hhtjax.xla import on_scalars, one_kernel

SAFETY, LEAST, MOST = 0.9, 0.2, 2.0  # of the factors by which steps change; more than 2 is unstable for some methods
PROPORTIONAL, INTEGRAL = 0.7, 0.4  # of the PI controller, divided by the order of the estimate
NOT_FINITE = 1e6  # the error of a step that is not finite
LOWEST = 1e-4  # error of the step before, as the controller sees it
ROUNDINGS = 16  # of t, of which a step is at least
DONE, TOO_SHORT, TOO_MANY, BROKEN = range(4)
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
        stop: why they ended: 0 all well, 1 below dt_min, 2 max_steps used up, 3 not finite.
        estimate: of the last step tried, relative to the tolerance.
        dt_min: below which steps were not to fall.
    """

    dt: Any
    accepted: Any
    rejected: Any
    reached: Any
    stop: Any
    estimate: Any
    dt_min: Any

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
        _, accepted, rejected, reached, why, estimate, least = (np.asarray(x)[member] for x in self)
        values = {TOO_SHORT: (least, estimate), TOO_MANY: (accepted + rejected,), BROKEN: (least,)}[int(why)]
        return f"{which}stopped at t = {reached:.6g}: {WHY[int(why)].format(*values)}."

    def _verdict(self):
        return "" if not is_concrete(self.stop) else self._fault() or "all accepted"


class Walk(NamedTuple):
    """What the loop carries."""

    state: Any
    h: Any
    last: Any
    past: Any
    before: Any  # error of the last accepted step
    error: Any
    q_size: Any
    v_size: Any
    accepted: Any
    rejected: Any
    stop: Any


class Bounds(NamedTuple):
    """Tolerances and bounds in the dtype of the state. scale: the tolerance of a step, relative to that of the run."""

    rtol: Any
    atol: Any  # of positions
    atol_v: Any  # (N,), of velocities and of internal states
    scale: Any
    least: Any
    most: Any

    @classmethod
    def of(cls, flat, stepper, control, t0, end):
        """Those of an `Adaptive`."""
        names = "rtol", "atol", "atol_v", "dt_min", "dt_max"
        rtol, atol, atol_v, least, most = (jnp.asarray(getattr(control, name)).astype(t0.dtype) for name in names)
        n, N = flat.positions, flat.size
        rounding = ROUNDINGS * float(jnp.finfo(t0.dtype).eps) * jnp.maximum(jnp.abs(t0), jnp.abs(end))
        each = jnp.concatenate([jnp.full(n, atol_v), jnp.full(N - n, atol)])
        power = stepper.estimate_order / stepper.order - 1
        return cls(rtol, atol, each, rtol**power, jnp.maximum(least, rounding), most)

    def relative(self, flat, errors, q_size, v_size):
        """The largest error, 1 where it is the tolerance."""
        error = jnp.max(jnp.abs(errors.v) / (self.atol_v + self.rtol * v_size))
        if flat.positions:
            e_q = jnp.abs(flat.located(errors.q)) / (self.atol + self.rtol * q_size)
            error = jnp.maximum(error, jnp.max(e_q))
        return error / self.scale

    def first(self, state, v_size, span):
        """A step that changes v by about its tolerance, and not more than a hundredth of all."""
        tiny = float(jnp.finfo(span.dtype).tiny)
        slow = (self.atol_v + self.rtol * v_size) * self.scale / jnp.maximum(jnp.abs(state.w), tiny)
        h = jnp.minimum(jnp.min(jnp.sqrt(slow)), jnp.minimum(span / 100, self.most))
        return jnp.where(h > self.least, h, jnp.minimum(span / 100, self.most))


def sizes(flat, state):
    """Of positions and rates."""
    return kinematics.sizes(flat.blocks, state.q), jnp.abs(state.v)


def next_step(h, error, before, accept, order):
    """The PI controller: Gustafsson's, in the form of Hairer and Wanner, Sec. IV.2."""
    small = jnp.maximum(error, 1e-10)
    grown = SAFETY * small ** (-PROPORTIONAL / order) * before ** (INTEGRAL / order)
    shrunk = jnp.clip(SAFETY * small ** (-1 / order), 0.1, 0.9)
    return h * jnp.where(accept, jnp.clip(grown, LEAST, MOST), shrunk)


def succeeded(state, info, error):
    """Whether all that a step tells is fine."""
    fine = jnp.isfinite(error) & jnp.all(jnp.isfinite(state.w)) & jnp.all(jnp.isfinite(state.q))
    independent = None if info.dependent_row is None else info.dependent_row == 0
    for told in (info.converged, info.solved, independent):
        fine = fine if told is None else fine & told
    return fine


def is_walking(walk, end):
    """Whether there is more to try."""
    return (walk.state.t < end) & (walk.stop == DONE)


def next_end(params, end, walk):
    """The next step, and the time at which it ends: that of the walk, or one or two halves, to the end, or a jump."""
    t, h = walk.state.t, walk.h
    due = jnp.minimum(end, held.jump_after(params, t)) if held.holds(params) else end
    left = due - t
    lands = left <= h
    h = jnp.where(lands, left, jnp.where(left < 2 * h, left / 2, h))
    return h, jnp.where(lands, due, t + h)


def attempt(flat, stepper, params, end, bounds, max_steps, walk):
    """Walk -> Walk after one try, and the time at which it would have ended."""
    h, t1 = next_end(params, end, walk)
    resized, state = stepper.resized(walk.state, h / walk.last)
    now, state = held.entered(resized, flat, params, h, walk.last, state)
    s1, info, errors, past = resized.bind_estimated(flat, now, h, walk.past)(state)
    s1 = s1._replace(t=t1)
    q_size, v_size = map(jnp.maximum, (walk.q_size, walk.v_size), sizes(flat, s1))
    error = bounds.relative(flat, errors, q_size, v_size)
    fine = succeeded(s1, info, error)
    error = jnp.where(fine, error, NOT_FINITE)
    accept = error <= 1
    h1 = jnp.minimum(next_step(h, error, walk.before, accept, stepper.estimate_order), bounds.most)
    floor = jnp.maximum(error, LOWEST)
    new = walk._replace(state=s1, h=h1, last=h, past=past, before=floor, error=error, q_size=q_size, v_size=v_size)
    new = new._replace(accepted=walk.accepted + 1)
    old = walk._replace(h=h1, error=error, rejected=walk.rejected + 1)
    walk = jax.tree.map(partial(jnp.where, accept), new, old)
    stop = jnp.where(accept | (h1 >= bounds.least), DONE, jnp.where(fine, TOO_SHORT, BROKEN))
    spent = (walk.state.t < end) & (walk.accepted + walk.rejected >= max_steps) & (stop == DONE)
    return walk._replace(stop=jnp.where(spent, TOO_MANY, stop).astype(jnp.int32)), s1.t


def begin(flat, stepper, q, v, t0, end, params, bounds):
    """The walk before its first step. The method starts with the longest of these, of which others are parts."""
    longest = jnp.minimum((end - t0) / 100, bounds.most)
    state = stepper.begin(flat, q, v, t0, held.before(params, t0, longest), longest)
    q_size, v_size = sizes(flat, state)
    h = bounds.first(state, v_size, end - t0)
    one, none = jnp.ones_like(t0), jnp.zeros((), jnp.int32)
    past = stepper.begin_estimates(flat, state)
    return Walk(state, h, longest, past, one, one, q_size, v_size, none, none, none)


def choose(flat, stepper, q, v, t0, end, params, control, progress=False):
    """`Steps` from t0 to end, and (max_steps,) the times at which they end; no tracer of autodiff may come in."""
    stepper = stepper.astype(q.dtype)
    bounds = Bounds.of(flat, stepper, control, t0, end)
    walk = begin(flat, stepper, q, v, t0, end, params, bounds)
    one_try = partial(attempt, flat, stepper, params, end, bounds, control.max_steps)
    form = on_scalars(one_try, walk)
    one_try = form.of(one_try)

    def unfinished(carry):
        return is_walking(carry[0], end)

    def body(carry):
        walk, times = carry
        new, t = one_try(walk)
        if progress:
            show(walk.state.t, new.state.t, t0, end)
        return new, lax.dynamic_update_index_in_dim(times, t, walk.accepted, 0)

    def run(walk):
        return lax.while_loop(unfinished, body, (walk, jnp.zeros(control.max_steps, t0.dtype)))

    walk, times = one_kernel(run, form.tree)
    return as_steps(form.joined(walk), times, t0, bounds.least), times


def as_steps(walk, times, t0, least):
    """The `Steps` of a walk that is over, which end at these times."""
    numbers = jnp.arange(times.size, dtype=jnp.int32)
    dt = jnp.where(numbers < walk.accepted, jnp.diff(times, prepend=t0), jnp.nan)
    return Steps(dt, walk.accepted, walk.rejected, walk.state.t, walk.stop, walk.error, least)


def show(before, now, t0, end):
    """A bar on stderr, a hundred times in a run."""
    before, now = (jnp.floor(100 * (t - t0) / (end - t0)).astype(jnp.int32) for t in (before, now))

    def bar(done):
        overwrite(f"[{'#' * (int(done) * 40 // 100):<40}] {int(done)} % of the time", last=int(done) == 100)

    lax.cond(now > before, lambda: jax.debug.callback(bar, now), lambda: None)


def trimmed(steps):
    """Without what is behind the accepted ones, of a batch the most, where their numbers are known."""
    if not is_concrete(steps.accepted):
        return steps
    return steps._replace(dt=steps.dt[..., : int(np.max(steps.accepted))])
