"""A run under error control: its steps chosen and its samples kept in one pass, or chosen and run; and its error."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap

from hhtjax.description import is_concrete
from hhtjax.numerics.hoisted import hoisted
from hhtjax.numerics.seldom import derivative_by
from hhtjax.runs.choose import choose, trimmed
from hhtjax.runs.chosen import checked_times, chosen_steps, run_over, steps_for
from hhtjax.runs.freezing import is_pair, run_and_choice
from hhtjax.runs.solution import Solution
from hhtjax.xla import Programs, is_untouched, one_kernel, or_plain

ALARM = 10  # times what was asked for, above which the error of a whole run is a failure


def run_controlled(problem, times, control, progress, events=None, room=()) -> Solution:
    """The run that `simulate` returns for an `Adaptive` in the place of dt."""
    times = checked_times("simulate", problem, times, control)
    data = problem, times, replace(control, verify=False)
    in_one = events is None and problem.system.friction is None and is_untouched() and not is_pair()
    if in_one:  # else the program that chooses steps for a derivative or a batch is that of `choose_steps`
        run, steps, ends = or_plain(partial(run_in_one, *data, progress=progress))
        choice = lax.stop_gradient((problem, times, control, events))
    else:
        (problem, times, control, events), choice = run_and_choice((problem, times, control, events))
        steps, ends = steps_for(choice, progress, room)
        keywords = {"room": room, "rates": problem.rates()}
        run = or_plain(partial(run_over, problem, times, ends, steps.accepted, events, **keywords))
    if control.verify:
        better = finer(problem, times, control, steps, ends, choice, events, room, in_one)
        run = run._replace(**verified(run, better, control, problem.stepper.order))
    steps = trimmed(steps)
    return run._replace(dt=steps.dt, steps=steps)


def finer(problem, times, control, steps, ends, choice, events, room, in_one):
    """The run with every step halved, or with steps chosen anew for a quarter of the tolerance."""
    *start, looser, theirs = choice
    if control.verify == "tolerance" and in_one:
        return or_plain(partial(run_in_one, *start, quarter(replace(looser, verify=False))))[0]
    if control.verify == "tolerance":
        steps, ends = steps_for((*start, quarter(looser), theirs), False, room)
    keywords = {"halved": control.verify != "tolerance", "room": room, "rates": problem.rates()}
    return or_plain(partial(run_over, problem, times, ends, steps.accepted, events, **keywords))


def quarter(control):
    """A quarter of the tolerance."""
    return replace(control, **{name: getattr(control, name) / 4 for name in ("rtol", "atol", "atol_v")})


def verified(run, finer, control, order):
    """The error of the whole run at each of its times, by Richardson from a finer one, and what is allowed."""

    def largest(q):
        return jnp.max(jnp.stack([jnp.max(jnp.abs(x).reshape(len(x), -1), axis=1) for x in jax.tree.leaves(q)]), axis=0)

    q, better = lax.stop_gradient((run.q, finer.q))
    left = 0.25 if control.verify == "tolerance" else 0.5**order  # of the error
    error = largest(jax.tree.map(jnp.subtract, better, q)) / (1 - left)
    rtol, atol = (jnp.asarray(x).astype(error.dtype) for x in (control.rtol, control.atol))
    return {"error": error, "allowed": lax.stop_gradient(ALARM * (rtol * jnp.max(largest(q)) + atol))}


def run_in_two(problem, times, control, progress=False):
    """The `Solution` at `times`, its `Steps`, and the times at which they end."""
    rates, choice = problem.rates(), lax.stop_gradient((problem, times[-1], control))
    steps, ends = chosen_steps(*choice, progress=progress, rates=rates)
    return run_over(problem, times, ends, steps.accepted, rates=rates), steps, ends


@partial(Programs, static_argnames=("progress",))
def run_recorded(problem, times, control, progress=False):
    """The same in one pass, but for what vmap makes of it; without derivatives."""

    def record(problem, times, control):
        steps, ends, run = choose(problem, problem.times(times[-1]), control, progress, times=problem.times(times))
        return run, steps, ends

    @custom_vmap
    def in_one(problem, times, control):
        return one_kernel(record, problem, times, control, around=True)

    @in_one.def_vmap
    def _(size, batched, *args):
        axes = jax.tree.map(lambda mapped: 0 if mapped else None, batched)
        found = jax.vmap(partial(run_in_two, progress=progress), axes, axis_size=size)(*args)
        return found, jax.tree.map(lambda _: True, found)

    return in_one(problem, times, control)


def run_in_one(problem, times, control, progress=False):
    """The same, with the derivatives of two passes, in a jit that may be one of a derivative or a batch."""
    data = problem, times, control
    in_one, in_two = (
        partial(run_recorded, progress=progress, rates=problem.rates()),
        partial(run_in_two, progress=progress),
    )
    if is_concrete(jnp.zeros(())):  # there is no jit
        return in_one(*data)
    in_one, closed_over = hoisted(in_one, *data)
    if not all(map(is_concrete, closed_over)):
        return in_two(*data)
    return derivative_by(in_two, partial(in_one, closed_over), *data)
