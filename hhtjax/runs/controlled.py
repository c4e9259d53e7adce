"""A run under error control: its steps chosen and its samples kept in one pass, or chosen and run; and its error."""

from dataclasses import replace
from functools import partial

import jax
from jax import lax
from jax.custom_batching import custom_vmap

from hhtjax.description import all_concrete, is_tracing
from hhtjax.numerics.hoisted import hoisted
from hhtjax.numerics.seldom import derivative_by
from hhtjax.runs.choose import choose, trimmed
from hhtjax.runs.chosen import checked_times, run_over, steps_for, usual_step
from hhtjax.runs.event_checks import require_events
from hhtjax.runs.freezing import frozen, is_pair, run_and_choice
from hhtjax.runs.output import beside_path, without_path
from hhtjax.runs.solution import Solution
from hhtjax.runs.tightened import accepted_run, tighten
from hhtjax.runs.verified import compared, scaled, verified
from hhtjax.xla import Programs, is_untouched, one_kernel, or_plain


def run_controlled(problem, times, control, progress, events=None, room=()) -> Solution:
    """The run that `simulate` returns for an `Adaptive` in the place of dt."""
    times = checked_times("simulate", problem, times, control)
    if events is not None:
        events = require_events("simulate", problem, events, usual_step(problem.t0, times))
    problem = problem._replace(output=beside_path(problem.output, control))
    start, alone = (problem, times, control, events), is_untouched() and not is_pair()
    if control.verify == "tighten":
        run = run_tightened(start, alone, progress, room)
        return run if problem.output is None else without_path(run)
    in_one = alone and passes_alone(problem, events)
    if in_one:  # else the program that chooses steps for a derivative or a batch is that of `choose_steps`
        run, steps, ends = or_plain(partial(run_in_one, problem, times, unverified(control), progress=progress))
        choice = lax.stop_gradient(start)
    else:
        start, choice = run_and_choice(start)
        run, steps, ends = run_in_two(start, choice, progress, room)
    if control.verify:
        better = finer(start, choice, steps, ends, room, in_one)
        run = run._replace(**verified(run, better, start[2], problem.stepper.order))
    steps = trimmed(steps)
    run = run._replace(dt=steps.dt, steps=steps)
    return run if problem.output is None else without_path(run)


def passes_alone(problem, events):
    """Whether the steps and the samples are found in one pass, where nothing is made of the run."""
    return events is None and problem.system.friction is None


def unverified(control):
    """The same steps."""
    return replace(control, verify=False)


def finer(start, choice, steps, ends, room, in_one):
    """The run with every step halved, or with steps chosen anew for a quarter of the tolerance."""
    if start[2].verify != "tolerance":
        return over(start, steps, ends, room, halved=True)
    *begin, looser, theirs = choice
    if in_one:
        return or_plain(partial(run_in_one, *begin, scaled(unverified(looser), 1 / 4)))[0]
    return run_in_two(start, (*begin, scaled(looser, 1 / 4), theirs), room=room)[0]


def run_in_two(start, choice, progress=False, room=()):
    """The `Solution` of a start, (problem, times, control, events), over the steps for a choice, another; its `Steps`,
    and the times at which they end."""
    steps, ends = steps_for(choice, progress, room)
    return over(start, steps, ends, room), steps, ends


def over(start, steps, ends, room=(), halved=False):
    """The `Solution` over these steps, each halved or not."""
    problem, times, _, events = start
    keywords = {"halved": halved, "room": room, "rates": problem.rates()}
    return or_plain(partial(run_over, problem, times, ends, steps.accepted, events, **keywords))


def run_tightened(start, alone, progress, room):
    """The run with steps for as much of the tolerance as makes its error what was asked for."""
    start, choice = (start, lax.stop_gradient(start)) if alone else run_and_choice(start)
    problem, times, control, events = choice
    choice = problem, times, unverified(control), events
    last = or_plain(partial(rounds, choice, progress=progress, room=room, rates=problem.rates()))
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
def rounds(choice, progress, room):
    """The last `Round`; no tracer of autodiff may come in."""
    problem, times, control, events = choice

    def once(share):
        tighter = scaled(control, share)
        if passes_alone(problem, events):
            return run_in_one(problem, times, tighter, progress)
        again = problem, times, tighter, events
        return run_in_two(again, again, progress, room)

    return frozen(partial(tighten, once, partial(compared, control=control)), problem.times(1.0))


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
        found = jax.vmap(partial(in_two_passes, progress=progress), axes, axis_size=size)(*args)
        return found, jax.tree.map(lambda _: True, found)

    return in_one(problem, times, control)


def in_two_passes(problem, times, control, progress=False):
    """The same."""
    start = problem, times, control, None
    return run_in_two(start, lax.stop_gradient(start), progress)


def run_in_one(problem, times, control, progress=False):
    """The same, with the derivatives of two passes, in a jit that may be one of a derivative or a batch."""
    data = problem, times, control
    in_one, in_two = (
        partial(run_recorded, progress=progress, rates=problem.rates()),
        partial(in_two_passes, progress=progress),
    )
    if not is_tracing():
        return in_one(*data)
    in_one, closed_over = hoisted(in_one, *data)
    if not all_concrete(closed_over):
        return in_two(*data)
    return derivative_by(in_two, partial(in_one, closed_over), *data)
