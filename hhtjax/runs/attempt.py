"""One step under error control: tried, judged by the estimate of its error, taken or not; and how long the next is."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.numerics.rough import rough_exp, rough_log, without_rounding
from hhtjax.runs.events import before_any
from hhtjax.steppers.stepper import entered
from hhtjax.systems import held, kinematics
from hhtjax.xla import staged

LOWEST = 1e-4  # error of the step before, as the controller sees it
ROUNDINGS = 16  # of t, of which a step is at least
DONE, TOO_SHORT, TOO_MANY, BROKEN, AT_EVENT = range(5)


class Controller(NamedTuple):
    """Of the factors by which steps change: the PI controller's exponents, divided by the order of the estimate, and
    bounds behind a step that was accepted. Growth by more than 2 is unstable for some methods."""

    safety: Any = 0.9
    proportional: Any = 0.7
    integral: Any = 0.4
    least: Any = 0.2
    most: Any = 2.0


PI = Controller()


class Walk(NamedTuple):
    """What the loop carries."""

    state: Any
    h: Any
    last: Any
    past: Any
    before: Any  # logarithm of the error of the last accepted step
    error: Any
    q_size: Any
    v_size: Any
    accepted: Any
    rejected: Any
    stop: Any
    met: Any = None  # of events


class Trial(NamedTuple):
    """How steps are tried, to the time `end`. ways, past_events: how to pass events, and what a try becomes by it."""

    flat: Any
    stepper: Any
    params: Any
    end: Any
    bounds: Any
    max_steps: int
    ways: Any = None
    past_events: Any = None
    controller: Controller = PI

    def params_of(self, walk):
        """The params of the next step."""
        return self.params if self.ways is None else self.ways.events.with_modes(self.params, walk.met.modes)


class Try(NamedTuple):
    """A step that was tried: the walk if it is accepted, its error, the step to try next, what of it must not fall
    below the least step, and why there are no more steps if it does."""

    walk: Walk
    error: Any
    h: Any
    shortest: Any
    why: Any


class Begun(NamedTuple):
    """What else is known of a try: the state it began with, when it was to end, and its `Info`."""

    state: Any
    end: Any
    info: Any


class Bounds(NamedTuple):
    """Tolerances and bounds in the dtype of the state. scale: the tolerance of the run, relative to that of a step."""

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
        power = 1 - stepper.estimate_order / stepper.order
        return cls(rtol, atol, each, rtol**power, jnp.maximum(least, rounding), most)

    def relative(self, flat, errors, q_size, v_size):
        """The largest error, 1 where it is the tolerance."""
        # reciprocals, which are there before the errors are
        error = jnp.max(jnp.abs(errors.v) * (self.scale / (self.atol_v + self.rtol * v_size)))
        if flat.positions:
            e_q = jnp.abs(flat.located(errors.q)) * (self.scale / (self.atol + self.rtol * q_size))
            error = jnp.maximum(error, jnp.max(e_q))
        return error

    def first(self, state, v_size, span):
        """A step that changes v by about its tolerance, and not more than a hundredth of all."""
        tiny = float(jnp.finfo(span.dtype).tiny)
        slow = (self.atol_v + self.rtol * v_size) / self.scale / jnp.maximum(jnp.abs(state.w), tiny)
        h = jnp.minimum(jnp.min(jnp.sqrt(slow)), jnp.minimum(span / 100, self.most))
        return jnp.where(h > self.least, h, jnp.minimum(span / 100, self.most))


def sizes(flat, state):
    """Of positions and rates."""
    return kinematics.sizes(flat.blocks, state.q), jnp.abs(state.v)


def next_step(h, error, before, accept, order, pi=PI):
    """The PI controller: Gustafsson's, in the form of Hairer and Wanner, Sec. IV.2; before, and what is returned beside
    the step, are logarithms of errors."""
    now = rough_log(jnp.maximum(error, 1e-10))
    slope = jnp.where(accept, -pi.proportional / order, -1 / order)
    exponent = slope * now + jnp.where(accept, pi.integral / order * before, 0)
    least, most = jnp.where(accept, pi.least, 0.1), jnp.where(accept, pi.most, 0.9)
    factor = jnp.clip(pi.safety * rough_exp(exponent), least, most)
    return h * factor, jnp.maximum(now, float(np.log(LOWEST)))


def judged(state, info, error):
    """The error of a step, infinite where something that it tells is not fine."""
    for x in (state.q, state.v, state.w, state.L):
        error = error if x is None else error + jnp.sum(0 * x)  # NaN where one is not finite
    fine = error < jnp.inf
    independent = None if info.dependent_row is None else info.dependent_row < 0
    for told in (info.converged, info.solved, independent):
        fine = fine if told is None else fine & told
    return jnp.where(fine, error, jnp.inf)


def is_walking(walk, end):
    """Whether there is more to try."""
    going = (walk.state.t < end) & (walk.stop == DONE)
    return going if walk.met is None else going & ~walk.met.ended


def next_end(trial, params, walk):
    """The next step, and the time at which it ends: that of the walk, or one or two halves, to the end, or a jump.

    Without rounding: what is left until a jump, less than the steps, and halved, would differ between a run and a batch
    by more than the steps before, and so on from jump to jump.
    """
    t, end = walk.state.t, trial.end
    h, reach = (jnp.minimum(without_rounding(walk.h, more), trial.bounds.most) for more in (0, 4))
    due = jnp.minimum(end, held.jump_after(params, t)) if held.holds(params) else end
    if trial.ways is not None and walk.met.over:
        due = jnp.minimum(due, trial.ways.events.due_after(t, walk.met.over))
    left = due - t
    lands = left <= reach  # what has doubled does, where jumps are equally far apart
    h = jnp.where(lands, left, jnp.minimum(h, without_rounding(left / 2, more=1)))  # the second half is no longer
    return h, jnp.where(lands, due, t + h)


def attempt(trial, walk):
    """Walk -> Walk after one try, and how that began."""
    bounds, order, params = trial.bounds, trial.stepper.estimate_order, trial.params_of(walk)
    h, t1 = next_end(trial, params, walk)
    resized, state = trial.stepper.resized(walk.state, h / walk.last)
    now, state = held.entered(resized, trial.flat, params, h, walk.last, state)
    s1, info, errors, past = resized.bind_estimated(trial.flat, now, h, walk.past)(state)
    s1 = s1._replace(t=t1)
    q_size, v_size = map(jnp.maximum, (walk.q_size, walk.v_size), sizes(trial.flat, s1))
    error = judged(s1, info, bounds.relative(trial.flat, errors, q_size, v_size))
    error = staged(lambda x: x)(error)
    h1, before = next_step(h, error, walk.before, error <= 1, order, trial.controller)
    h1 = jnp.minimum(h1, bounds.most)
    new = walk._replace(state=s1, last=h, past=past, before=before, q_size=q_size, v_size=v_size)
    tried = Try(new._replace(accepted=walk.accepted + 1), error, h1, h1, why_short(error))
    if trial.ways is not None:
        tried = trial.past_events(trial, tried, walk, h)
    return taken(trial, walk, tried), Begun(state, s1.t, info)


def taken(trial, walk, tried):
    """The walk after a try: taken, or to be taken again."""
    accept = tried.error <= 1
    again = walk._replace(rejected=walk.rejected + 1)
    if walk.met is not None:  # what is wrong there
        again = again._replace(met=walk.met._replace(code=tried.walk.met.code, event=tried.walk.met.event))
    walk = jax.tree.map(partial(jnp.where, accept), tried.walk, again)._replace(h=tried.h, error=tried.error)
    fine = accept | (tried.shortest >= trial.bounds.least)
    spent = (walk.accepted + walk.rejected >= trial.max_steps) & is_walking(walk, trial.end)
    return walk._replace(stop=jnp.where(fine, jnp.where(spent, TOO_MANY, DONE), tried.why).astype(jnp.int32))


def why_short(error):
    """Why there are no more steps if this one has become too short."""
    return jnp.where(error < jnp.inf, TOO_SHORT, BROKEN)


def begin(trial, q, v, t0):
    """The walk before its first step, and the state at t0 as it is saved. The method starts with the longest of these,
    of which others are parts."""
    flat, stepper, bounds = trial.flat, trial.stepper, trial.bounds
    longest = jnp.minimum((trial.end - t0) / 100, bounds.most)
    start, state = entered(stepper, flat, q, v, t0, held.before(trial.params, t0, longest), longest, resolves=True)
    q_size, v_size = sizes(flat, state)
    h = bounds.first(state, v_size, trial.end - t0)
    one, none = jnp.ones_like(t0), jnp.zeros((), jnp.int32)
    past = stepper.begin_estimates(flat, state)
    walk = Walk(state, h, longest, past, 0 * one, one, q_size, v_size, none, none, none)
    if trial.ways is not None:
        walk = walk._replace(met=before_any(trial.ways, trial.params, t0))
    return walk, start
