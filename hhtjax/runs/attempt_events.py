"""Events under error control: a step that is accepted passes them, and what is left of it behind them is judged anew.

The estimate of a step knows nothing of what comes behind an event, where the force may be another: so the rest has one
of its own, as of a first step. If it is too large the whole step is tried again, with a shorter rest. And if there is
another event in the rest, the step is tried again up to the middle between both, for what is between has no estimate.
Where an event cannot be passed, shorter steps are tried too.
"""

from functools import partial, reduce

import jax
import jax.numpy as jnp

from hhtjax.description import freeze
from hhtjax.numerics.seldom import choose, seldom_alone
from hhtjax.runs.attempt import AT_EVENT, Trial, Try, judged, sizes, why_short
from hhtjax.runs.event_failures import FINE, MANY
from hhtjax.runs.event_parts import SHORT, Part, Ways, reaching
from hhtjax.runs.loop import neutral_info, resized_step
from hhtjax.runs.meeting import asks, pass_events
from hhtjax.systems import held
from hhtjax.systems.events import flatten_events


def trial_of(problem, end, bounds, max_steps, events=None, room=()):
    """How the steps of a problem are tried, with events or without."""
    flat, q, v, t0, params = problem.flat()
    stepper = problem.stepper.astype(q.dtype)
    trial = Trial(flat, stepper, params, end, bounds, max_steps)
    if events is None:
        return trial

    def one(h):
        return resized_step(flat, stepper, params, h, h)(stepper.begin(flat, q, v, t0, params, h))

    no_info = neutral_info(jax.eval_shape(one, end)[1])
    flat_events = flatten_events(flat, events, params, (q, v, t0), stepper.redundant)
    ways = Ways(flat, stepper, flat_events, room[0], no_info, reaching(flat, stepper, no_info))
    return trial._replace(ways=ways, past_events=past_events)


def past_events(trial, tried, walk, h):
    """The try, past the events in its step."""
    now = trial.ways.during(trial.params, walk.state.t, h).params(trial.params, walk.met.modes)
    asked = (tried.error <= 1) & asks(trial.ways, walk.state, tried.walk.state, now, walk.met.over, h)
    return seldom_alone(partial(passed, trial), asked, tried, walk, h)


def passed(trial, tried, walk, h):
    """The same where there may be one."""
    ways = trial.ways
    met = walk.met._replace(code=jnp.full_like(walk.met.code, FINE))
    part = Part.whole(ways, walk.state, tried.walk.state, ways.no_info, h, walk.last, met, ~met.ended)
    part, (rows, there) = pass_events(ways, freeze(trial.params), part, h)
    noted = jnp.asarray((*ways.events.noted, True))[rows[:, 1].astype(jnp.int32)]
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
    judged = choose(part.divided > 0, behind(trial, tried, walk, part, h), tried)
    return choose(code == FINE, judged, lost)


def behind(trial, tried, walk, part, h):
    """The try with the error of the rest behind an event; so long as that is too large, the rest becomes shorter."""
    past, met = trial.stepper.begin_estimates(trial.flat, part.end), part.met
    reached = [(walk.q_size, walk.v_size), *(sizes(trial.flat, s) for s in (part.start, part.end))]  # and no farther
    q_size, v_size = (reduce(jnp.maximum, x) for x in zip(*reached, strict=True))
    new = tried.walk._replace(
        state=part.end, past=past, before=jnp.zeros_like(h), q_size=q_size, v_size=v_size, met=met
    )
    rest = jnp.maximum(part.rest, SHORT * h)
    params = held.held_at(trial.params_of(new), part.start.t + rest / 2)
    errors = trial.stepper.bind_estimated(trial.flat, params, rest, past)(part.start)[2]
    error = jnp.where(met.ended, 0, trial.bounds.relative(trial.flat, errors, q_size, v_size))
    error = judged(part.end, part.info, error)
    small = jnp.maximum(error, float(jnp.finfo(h.dtype).tiny))
    best = trial.controller.safety * small ** (-1 / trial.stepper.estimate_order)
    shorter = rest * jnp.clip(best, 0.1, 0.9)
    h = jnp.where(error <= 1, jnp.minimum(h, rest * best), h - rest + shorter)
    return Try(new, error, h, shorter, why_short(error))
