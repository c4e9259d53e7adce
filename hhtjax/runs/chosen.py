"""Runs over chosen steps, read off at any times: differentiable, the steps being constant."""

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from hhtjax.checks import require_integer
from hhtjax.numerics.checkpointed_scan import checkpoint
from hhtjax.numerics.counted_loop import repeat
from hhtjax.runs.adaptive import adaptive, require_controlled, require_single
from hhtjax.runs.choose import Steps, choose, trimmed
from hhtjax.runs.event_checks import require_events
from hhtjax.runs.event_pieces import Pieces
from hhtjax.runs.events import loop_with_events, with_told_events
from hhtjax.runs.freezing import frozen
from hhtjax.runs.loop import flaw_at_start, loop_over, resting, with_flaw
from hhtjax.runs.output import output_at_start
from hhtjax.runs.problem import Problem
from hhtjax.runs.read_off import kept, output_between, solution_at, with_output
from hhtjax.runs.sweep_grid import require_times
from hhtjax.steppers.stepper import Stepper
from hhtjax.systems import held
from hhtjax.systems.system import FirstOrderSystem, LinearSystem, System, require_masses
from hhtjax.xla import Programs, largest_in_batch, on_scalars, one_kernel, or_alone, or_plain


@partial(Programs, static_argnames=("progress", "room"))
def chosen_steps(problem, end, control, events=None, progress=False, room=()):
    """`Steps` to `end`, and the times at which they end; no tracer of autodiff may come in.

    One kernel, what comes before and behind the loop too: each part that stands alone costs about a microsecond.
    """

    def found(problem, end, control, events):
        return choose(problem, problem.times(end), control, progress, events, room)[:2]

    return frozen(partial(one_kernel, found, around=True), problem, end, control, events)


def steps_for(choice, progress, room):
    """The same to the last of the times, in one program for any number of these, and whatever becomes of the run."""
    problem, times, control, events = choice
    control, problem = replace(control, verify=False), problem._replace(output=None)
    keywords = {"progress": progress, "room": room[:1], "rates": problem.rates()}
    return or_plain(partial(chosen_steps, problem, times[-1], control, events, **keywords))


class Grid(NamedTuple):
    """Frozen steps from t0 on. ends: (N,), inf behind the last; counts: (K,), how many there are from one of the times
    to the next, the last of them ending at it or beyond; reached: the end of the last."""

    t0: Any
    ends: Any
    counts: Any
    reached: Any

    @classmethod
    def of(cls, t0, times, ends, accepted, halved=False):
        """Those with these ends, of which so many were accepted; each halved or not."""
        reached = jnp.where(accepted > 0, ends[jnp.maximum(accepted - 1, 0)], t0)
        wanted = jnp.minimum(times, reached)
        needed = jnp.searchsorted(ends, wanted)
        needed = needed + (t0 < wanted).astype(needed.dtype)
        if halved:
            starts = jnp.concatenate([t0[None], ends[:-1]])
            ends = jnp.stack([(starts + ends) / 2, ends], 1).ravel()
            needed = 2 * needed - ((needed > 0) & (ends[2 * needed - 2] >= times)).astype(needed.dtype)
        return cls(t0, ends, jnp.diff(needed, prepend=0).astype(jnp.int32), reached)

    def loop(self, flat, stepper, q, v, t0, params):
        """The `Loop` over its steps."""
        return loop_over(flat, stepper, q, v, t0, params, self.sizes, resolves=True)

    def sizes(self, number):
        """Of a step its size, that of the one before, and where it ends; behind the last 1, and inf."""

        def time(taken):
            end = lax.dynamic_index_in_dim(self.ends, jnp.maximum(taken - 1, 0), keepdims=False)
            return jnp.where(taken > 0, end, self.t0)

        before, start, end = (time(number + i) for i in (-1, 0, 1))
        is_there = jnp.isfinite(end) & (number < self.ends.size)
        h = jnp.where(is_there, end - start, 1)
        last = jnp.where(jnp.isfinite(start) & (number > 0), start - before, h)
        return h, last, jnp.where(is_there, end, jnp.inf)


@partial(Programs, static_argnames=("halved", "room"))
def run_over(problem, times, ends, accepted, events=None, halved=False, room=()):
    """The `Solution` at `times` over the steps with these ends, of which so many were accepted; each halved or not."""

    def run(problem, times, ends, accepted, events):
        t0, times = problem.times(problem.t0), problem.times(times)
        return follow(problem, times, Grid.of(t0, times, ends, accepted, halved), events, room)

    return one_kernel(run, problem, times, ends, accepted, events, around=True)  # as above


def follow(problem, times, grid, events=None, room=()):
    """The `Solution` at `times` over the steps of a grid; in a batch it rests while others have more of them."""
    flat, q, v, t0, params = problem.flat()
    longest = largest_in_batch(grid.counts)
    plain = loop = grid.loop(flat, problem.stepper, q, v, t0, params)
    if events is not None:
        more = {"in_pieces": True, "with_modes": problem.output is not None}
        loop = loop_with_events(plain, flat, problem.stepper, events, params, *room, **more)
    form = on_scalars(lambda carry: plain.advance(carry[:3]), loop.carry)
    begun = partial(begun_with, flat, problem.stepper, params, loop)
    keep, read = partial(kept, flat, problem.stepper), None
    if problem.output is not None:
        read = partial(output_in, loop, flat, problem.output, params, keep, times[-1] - loop.carry[0].t)
        if not problem.output.beside_path:
            keep = None
    interval = to_next_sample(loop, form, begun, keep, in_pieces=events is not None, read=read)

    def samples(carry):
        return lax.scan(interval, (carry[0] if events is None else (), carry), (grid.counts, longest, times))

    (_, (state, _, failure, *met)), (around, found, info) = one_kernel(samples, form.tree)
    start = loop.start
    flaw = flaw_at_start(problem.system, flat, start, params)
    if met:
        met = form.joined(met[0])
        times = jnp.where(met.ended, jnp.minimum(times, state.t), times)
    run = solution_at(flat, start, form.joined(around), times, grid.reached, info, with_flaw(failure, flaw))
    if problem.output is not None:
        first = loop.sizes(jnp.zeros((), jnp.int32))[0]
        at_start = output_at_start(flat, problem.output, params, start, first)
        run = with_output(run, at_start, form.joined(found), times, grid.reached)
    return with_told_events(flat, run, met, room[1]) if met else run


def to_next_sample(loop, form, begun, keep, in_pieces, read=None):
    """The body of the scan over the times: steps until one of them ends at the time or beyond, and both ends of that.

    in_pieces: of the part of it between events, of which its `Pieces` tell; else the state before is carried along.
    keep: what is kept of both, None for nothing; read: what else, of both, the run and the time.
    """
    advance, begun = form.of(loop.advance), form.of(begun)

    @checkpoint
    def interval(carry, now):
        count, most, time = now

        def step(i, carry):
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


def output_in(loop, flat, output, params, keep, long, pair, run, time):
    """The output of a run at a time between a pair of states, with their modes where there are events."""
    first, second, *modes = pair
    if modes:
        state, _, _, met = run
        time = jnp.where(met.ended, jnp.minimum(time, state.t), time)
        params = loop.now(met._replace(modes=modes[0] or met.modes))
    return output_between(flat, output, params, (keep(first), keep(second)), time, long)


def begun_with(flat, stepper, params, loop, run):
    """The state with which the next step of a run begins: behind a jump of held inputs."""
    state, count, _ = run
    h, last = loop.sizes(count)
    return held.entered(stepper, flat, params, h, last, state)[1]


def choose_steps(
    system: System | LinearSystem | FirstOrderSystem,
    stepper: Stepper,
    q0: Any,
    v0: Any = None,
    params: Any = None,
    *,
    times: Any,
    z0: Any = None,
    t0: Any = 0.0,
    progress: bool = False,
    events: Any = None,
    max_events: int = 2,
    **tolerances: Any,
) -> Steps:
    """The steps that error control takes: `simulate(..., dt=adaptive(...))` without the run.

    The run over them, `simulate(..., dt=steps.dt)`, is differentiable, smooth in all its arguments, and frozen: it is
    for the motion that the steps were chosen for, and others near by.

    Args:
        system, stepper, q0, v0, params, z0, t0, progress, events, max_events: those of `simulate`.
        times: (K,); steps go to the last, and end at no other.
        **tolerances: those of `adaptive`: rtol, atol, and others; not `verify`, which takes runs.

    Returns:
        `Steps`, constant to derivatives. Nothing raises while they are chosen: call `steps.check()`.

    Raises:
        TypeError, ValueError, NotImplementedError: those of `simulate` and `adaptive`; a stepper without an estimate.

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
    room = (require_integer("choose_steps", "max_events", max_events),)
    if events is not None:
        events = require_events("choose_steps", problem, events, usual_step(problem.t0, times))
    return trimmed(steps_for(lax.stop_gradient((problem, times, control, events)), progress, room)[0])


def usual_step(t0, times):
    """How long a step may be before any is chosen: a thousandth of the run."""
    return (times[-1] - t0) / 1000


def checked_times(caller, problem, times, control):
    """times, for a stepper that can be controlled."""
    require_controlled(caller, problem.stepper)
    require_masses(caller, problem.system, "take steps without error control")
    require_single(caller, control)
    return require_times(times, problem.t0, jax.tree.leaves(problem.q0)[0].dtype, caller)
