"""A run: one scan over the steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.checks import require_integer
from hhtjax.description import Array, PyTree, Real, all_concrete, is_array, is_concrete, known_now
from hhtjax.numerics.checkpointed_scan import checkpointed_scan
from hhtjax.numerics.dense_lu import LARGEST, UNROLLED
from hhtjax.primitives import is_in_batch, is_traced, one_kernel
from hhtjax.runs.adaptive import Adaptive
from hhtjax.runs.controlled_run import follow, run_controlled
from hhtjax.runs.driver import drive, equal_steps, given_steps
from hhtjax.runs.extrapolate import MOST, extrapolated
from hhtjax.runs.inputs import (
    EqualSteps,
    Problem,
    equal_times,
    refined,
    require_control_alone,
    require_events,
    require_one_length,
    require_sample_times,
    require_steps,
    require_steps_to,
    steps_within,
    warn_of_jumps_in,
    warn_of_jumps_to,
)
from hhtjax.runs.output import require_output, savings
from hhtjax.runs.progress import announce, draw, in_blocks, steps_between
from hhtjax.runs.solution import Solution, told
from hhtjax.runs.sweep import run_member
from hhtjax.runs.sweep_inputs import fit_to_times
from hhtjax.steppers.implicit_solve import callbacks_named
from hhtjax.steppers.stepper import Stepper, join_info
from hhtjax.steppers.variable_step import GROWTH
from hhtjax.systems.events import Event
from hhtjax.systems.flat_system import flatten
from hhtjax.systems.system import AnySystem, LinearSystem
from hhtjax.xla import Programs

if TYPE_CHECKING:
    from hhtjax.runs.driver import Loop, Run


def simulate(
    system: AnySystem,
    stepper: Stepper,
    q0: PyTree,
    v0: PyTree = None,
    params: PyTree = None,
    *,
    z0: PyTree = None,
    dt: Real,
    num_steps: int | None = None,
    duration: Real = None,
    num_samples: int | None = None,
    times: Real | None = None,
    t0: Real = 0.0,
    save_every: int = 1,
    progress: bool = False,
    extrapolate: int = 1,
    events: Sequence[Event] | None = None,
    max_events: int = 2,
    keep_events: int = 100,
    throw: bool = False,
    output: Callable | None = None,
) -> Solution:
    """Steps `system` from (q0, v0) at t0, with internal states from (q0, v0, z0), num_steps times by dt.

    Args:
        system: a `System`, `LinearSystem` or `FirstOrderSystem`.
        stepper: `hht()`, `rk4()`, ...
        q0, v0: position and velocity, pytrees of the same structure; float32 or float64, integers become
            the default float type. A `FirstOrderSystem` has y0 in the place of q0, and no v0.
        params: any pytree, handed to the functions of the system. Its arrays and numbers are data. Functions in it,
            such as the activations of a neural network in an `equinox.Module`, are part of the program, and told apart
            by identity: a new module of the same structure costs no compilation, a new lambda does.
        z0: internal states of a `System(..., internal=)`, any pytree of arrays.
        dt: step size, positive; or (N,), the sizes of N steps, whatever they are, and `num_steps` is left out.
            The `hht` family keeps its order 2 (with index 3 not in the multipliers), and a `LinearSystem` is factorised
            anew in each step. A step more than twice as long as the one before can make rho_inf near 0 unstable.
            Or `adaptive(rtol, atol)`, steps that are chosen by their errors, and constant to derivatives.
        num_steps: number of steps.
        duration: in the place of num_steps, as in a sweep: dt is made smaller, if need be, so that a whole number of
            steps is as long, which is reported as `run.dt`. Both are part of the program then; or, with `adaptive`,
            data.
        num_samples: K, with `duration`: the number of samples after the start, at equal distances, each at the end of
            a step (with `adaptive` between two). Default: every step is saved.
        times: (K,), in the place of num_steps: increasing, after t0, data. The run goes on to the last, and is read off
            at all of them, by cubics between its steps (multipliers and dry friction by lines): the steps stay what
            they are, a number dt or `adaptive`, and end at none of the times. (In `sweep` with step sizes they do.)
        save_every: steps between saved times; a divisor of num_steps. save_every=num_steps keeps the
            start and the end only, and stores no path.
        progress: show a bar in one line on stderr, also under jit; once more for each pass of a reverse derivative.
        extrapolate: number of runs, with steps of dt, dt/2, dt/4, ..., that Richardson's extrapolation joins at the
            same saved times, 1 to 4. For a stepper of order p, 2 takes the error dt^p out, for three times the work, 3
            dt^(p + 1) too, for seven times: `hht` becomes of order 3 and 4 (alpha = 0 of order 4 with 2 already, but
            of order 3 with rotations, unless kinematics="lie"; with uneven steps only alpha = 0, of order 3). For
            motions that dt resolves, elsewhere it makes errors larger; and for smooth steps, such as
            linearize="predictor": where "auto" changes its choice, dt^3 is left, as it is where an event, or a switch
            of dry friction, falls into a step; `friction` and `sticking` are then those of the run with the shortest
            steps, as is all at a saved time that an event comes before in some runs only.
        t0: time of the start.
        events: a list of `Event`: impacts, end stops, switches, ends of the run, located within the step in which they
            happen, or at known times; the grid stays what it is. Steps without one take as long as before, and a look
            at the guards. For the `hht` family, Rosenbrock and Runge-Kutta methods.
        max_events: how many of those that change something may fall into one step; more are a failure. With `adaptive`
            steps become shorter first, and what lies behind an event has an error of its own.
        keep_events: how many `run.events` has room for.
        output: a function of some of q, v, w (the acceleration), L (multipliers), z, zdot, friction, sticking, t and
            params, by these names: `output(q, w, params)`, `output(q, v, w, L, z, t, params)`. It returns a pytree of
            arrays. These are saved, as `run.output`, in the place of q, v and all else, so that a long run of a large
            system keeps little. `check` works as before. What a system does not have is None; of a first-order system
            q is y, and v its rate. params are those of the moment, as events have switched them and inputs are held.
            Extrapolation takes the errors out of the outputs, number by number: of rotations return their entries
            only where that is meant. `verify` compares q at the samples, which it keeps while it runs.
        throw: whether a run that failed is an error; else it is a `FailedRunWarning`. Both say what `solution.check()`
            says. Inside jit and vmap neither is known: there call `check()` on what comes out.

    Returns:
        A `Solution`.

    Differentiable, forward and reverse, in dt, t0, params, q0, v0, z0 and the numbers of the stepper; reverse
    mode computes the steps again, in blocks, and its memory grows with the square root of num_steps, but for a
    megabyte that it may take to do so only once.
    Compiled once for each system, stepper, structure, num_steps and save_every; a new dt, q0 or params
    costs no compilation, but for numbers of another type: 4 after 4.0, or np.float64(4.0), is another program, and
    so is an array after a number. Functions are known by identity and by what they read from outside: globals, cells of
    closures, attributes of modules and of objects, entries of lists and dicts, arrays by their bytes. Where one of
    these differs, here as in `fit`, the program is made anew; through params it costs no compilation. Inside a `jit` of
    your own JAX's rule holds: what a function has read when that was traced stays.

    Raises:
        TypeError, ValueError: an argument of a wrong kind, shape, structure or value; initial values that violate
            a constraint. Values are checked unless they are tracers.
        SimulationError: the run failed, if `throw`.
        NotImplementedError: a constraint, rotations, internal states, dry friction, events, steps of unequal size or
            error control, where the stepper does not know them.

    >>> import jax.numpy as jnp, hhtjax
    >>> spring = hhtjax.System(mass=jnp.array([1.0]), force=lambda q, v, t, params: -params["k"] * q)
    >>> solution = hhtjax.simulate(
    ...     spring, hhtjax.hht(alpha=-0.05), jnp.array([1.0]), jnp.array([0.0]), {"k": 4.0},
    ...     dt=1e-3, num_steps=1000, save_every=250)
    >>> solution.check()
    >>> [round(float(q), 4) for q in solution.q[:, 0]]                       # cos(2 t)
    [1.0, 0.8776, 0.5403, 0.0707, -0.4161]

    What a sensor shows, at its own times, and nothing else:

    >>> solution = hhtjax.simulate(
    ...     spring, hhtjax.hht(), jnp.array([1.0]), jnp.array([0.0]), {"k": 4.0}, dt=1e-3, times=[0.25, 0.6, 1.0],
    ...     output=lambda q, params: {"pull": params["k"] * q[0]})
    >>> [round(float(x), 4) for x in solution.output["pull"]], solution.q                     # 4 cos(2 t)
    ([4.0, 3.5103, 1.4494, -1.6646], None)
    """
    problem = Problem.checked("simulate", system, stepper, q0, v0, params, t0, z0)
    problem = problem._replace(output=require_output("simulate", output))
    save_every = require_integer("simulate", "save_every", save_every)
    if system.contact is not None and extrapolate != 1:
        raise NotImplementedError(
            "simulate: leave `extrapolate` out with contact: steps within which it switches have no error in powers of "
            f"dt; received {extrapolate!r}."
        )
    if not isinstance(extrapolate, int) or isinstance(extrapolate, bool) or not 1 <= extrapolate <= MOST:
        raise ValueError(f"simulate: `extrapolate` must be an integer from 1 to {MOST}; received {extrapolate!r}.")
    room = (
        require_integer("simulate", "max_events", max_events),
        require_integer("simulate", "keep_events", keep_events),
    )
    dtype = problem.dtype()
    if duration is not None or num_samples is not None:
        rest = {"num_steps": num_steps, "times": times, "save_every": save_every}
        require_one_length("simulate", duration, num_samples, **rest)
        if not isinstance(dt, Adaptive):
            dt, num_steps, save_every = steps_within("simulate", dtype, dt, duration, num_samples)
        elif num_samples is not None:
            times = equal_times(problem.t0, duration, num_samples)
    if isinstance(dt, Adaptive):
        require_control_alone("simulate", times, num_steps, save_every, extrapolate)
        return told("simulate", run_controlled(problem, times, dt, progress, events, room), throw)
    kind = {"rates": problem.rates(), "numbers": problem.numbers()}
    if times is not None:
        times = require_sample_times(times, problem.t0, dtype, "simulate")
        dt = require_steps_to("simulate", times, dt, num_steps, save_every, problem.t0)
        if progress:
            raise NotImplementedError(
                "simulate: with `times` and a number for `dt`, leave `progress` out. The number of steps is data, "
                "and all of them are one program, between whose parts nothing can be drawn. For a bar give `num_steps` "
                "and read the run off by hhtjax.interpolate(run, times)."
            )
        if events is not None:
            events = require_events("simulate", problem, events, dt)
        warn_of_jumps_to(problem, dt, times)

        read_off = _read_off if system.contact is None else _land

        def run_to(k: int) -> Solution:
            with callbacks_named():
                return read_off(problem, times, dt / k, events, room=room, rates=kind["rates"])

        solution = run_to(1) if extrapolate == 1 else extrapolated(run_to, extrapolate, stepper.order, join_info)
        return told("simulate", solution, throw)
    dt, num_steps = require_steps("simulate", stepper, dt, num_steps, 2 ** (extrapolate - 1))
    if events is not None:
        events = require_events("simulate", problem, events, dt[0] if jnp.ndim(dt) else dt)
    if num_steps % save_every:
        raise ValueError(f"simulate: `save_every` must divide num_steps={num_steps}; received {save_every}.")

    warn_of_jumps_in(problem, dt, num_steps)

    def run(k) -> Solution:
        sizes = {"num_steps": k * num_steps, "save_every": k * save_every, "room": room, "progress": progress}
        sizes["grows"] = np.ndim(dt) > 0 and grows_at_once(dt)
        step = refined(dt, k)
        data = problem, step, events, known_factors(problem, step)
        with callbacks_named():
            return _simulate(*data, in_batch=is_in_batch(), **sizes, **kind)

    solution = run(1) if extrapolate == 1 else extrapolated(run, extrapolate, stepper.order, join_info)
    return told("simulate", solution, throw)


def grows_at_once(dt: Real) -> bool:
    """Whether some of these steps (N,), as far as they are known, are too long behind the one before."""
    return not is_concrete(dt) or bool(np.any(np.asarray(dt)[1:] > GROWTH * np.asarray(dt)[:-1]))


@partial(Programs, static_argnames=("room",))
def _read_off(problem: Problem, times: Array, dt: Array, events, *, room: tuple) -> Solution:
    """The run with equal steps, at times between them."""

    def run(problem: Problem, times: Array, dt: Array, events) -> Solution:
        t0, times, dt = map(problem.times, (problem.t0, times, dt))
        return follow(problem, times, EqualSteps.to(t0, times, dt), events, room)._replace(dt=dt)

    return one_kernel(run, problem, times, dt, events, around=True)  # what comes before and behind the loop too


@partial(Programs, static_argnames=("room",))
def _land(problem: Problem, times: Array, dt: Array, events, *, room: tuple) -> Solution:
    """The run with steps that end at the times, and are no longer than dt: between those of a contact that meets,
    sticks or lets go there are kinks."""
    t0, times, dt = map(problem.times, (problem.t0, times, dt))
    grid = jnp.concatenate([t0[None], times])
    substeps, sizes = (x[0] for x in fit_to_times(dt[None], grid))
    data = problem.stepper, problem.q0, problem.v0, problem.params, problem.z0
    steps = sizes, substeps, substeps, t0, len(times), grid
    run = run_member(problem.system, data, *steps, events, room, problem.output, grows=True, caller="simulate")
    return run._replace(dt=dt)


@partial(Programs, static_argnames=("num_steps", "save_every", "progress", "room", "grows", "in_batch"))
def _simulate(
    problem: Problem,
    dt: Array,
    events: tuple | None,
    factors,
    *,
    num_steps: int,
    save_every: int,
    progress: bool,
    room: tuple,
    grows: bool,
    in_batch: bool,
) -> Solution:
    dt = problem.times(dt)
    steps = partial(given_steps, dt=dt, grows=grows) if dt.ndim else partial(equal_steps, dt=dt)
    size = {"every": save_every, "length": num_steps // save_every}
    sampling = partial(_at_ends, dt=dt, in_batch=in_batch, progress=progress, **size)
    return drive(problem, steps, sampling, events, room, factors=factors)


def _at_ends(run: Run, dt: Array, every: int, length: int, in_batch: bool, progress: bool):
    """A sample at the end of each of `length` intervals of so many steps."""
    loop, form = run.loop, run.form
    step = form.of(loop.advance)
    save, as_saved = savings(run)

    def interval(carry: tuple, _):
        if every == 1:
            carry, info = step(carry)
        else:
            (carry, info), _ = joined_steps((carry, loop.no_info), every)
        return carry, (save(carry), info)

    def joined_step(carry: tuple, _):
        carry, info = carry
        carry, new = step(carry)
        return (carry, join_info(info, new)), None

    def joined_steps(carry: tuple, length: int):
        return checkpointed_scan(joined_step, carry, length, in_batch)

    def intervals(carry: tuple, length: int):
        return one_kernel(lambda carry: checkpointed_scan(interval, carry, length, in_batch), carry)

    if progress:
        carry, (path, info) = _with_bar(intervals, joined_steps, save, loop, form.tree, length, every, run.flat.size)
    else:
        carry, (path, info) = intervals(form.tree, length)
    return carry, partial(as_saved, form.joined(path), dt, info)


def _with_bar(
    intervals: Callable,
    joined_steps: Callable,
    save: Callable,
    loop: Loop,
    carry: tuple,
    length: int,
    save_every: int,
    unknowns: int,
):
    """The same intervals, with a bar drawn outside of kernels: between several of them, or within long ones."""
    announce()
    total = length * save_every
    every = steps_between(total, unknowns)
    if every >= save_every:
        return in_blocks(intervals, carry, length, every // save_every, lambda n: draw(n * save_every, total, "step"))

    def interval(carry: tuple, number: Array):
        def steps(carry: tuple, length: int):
            return one_kernel(partial(joined_steps, length=length), carry)

        def show(n: Array):
            draw(number * save_every + n, total, "step")

        (carry, info), _ = in_blocks(steps, (carry, loop.no_info), save_every, every, show)
        return carry, (save(carry), info)

    return lax.scan(interval, carry, jnp.arange(length, dtype=jnp.int32))


# ----------------------------------------------------------------------------
# What short runs of one linear system, in a scan of the user's, have in common: factorised once, where it is written.
#
# XLA takes what does not change out of a loop, but not where all that does not change is constant: there each run
# factorised its matrices.


def known_factors(problem: Problem, dt: Real):
    """The `Factors` for the steps dt of a run, while something is traced; None where they are not constant, or large:
    a program would hold them."""
    system, stepper = problem.system, problem.stepper
    if not isinstance(system, LinearSystem) or not is_traced() or jnp.ndim(dt):
        return None
    given = [A for A in (system.M, system.C, system.K) if A is not None]
    if not all(map(is_array, given)) or not any(A.ndim == 2 for A in given) or not UNROLLED < len(system.M) <= LARGEST:
        return None
    if not all_concrete((given, stepper, dt)):
        return None
    return known_now(_factors, system.alone(), stepper, np.asarray(dt, jax.tree.leaves(problem.q0)[0].dtype))


@jax.jit
def _factors(system, stepper, dt):
    zero = jnp.zeros(len(system.M), dt.dtype)
    flat, *_ = flatten("simulate", system, zero, zero, 0 * dt, None)
    return stepper.astype(dt.dtype).factors_of(flat, dt)
