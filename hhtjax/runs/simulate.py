"""`simulate`: one run, as one scan over its steps."""

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
    """Simulates `system` from (q0, v0) at t0, with internal states from (q0, v0, z0), in num_steps steps of size dt.

    Args:
        system: a `System`, `LinearSystem` or `FirstOrderSystem`.
        stepper: `hht()`, `rk4()`, ...
        q0, v0: initial position and velocity, pytrees of the same structure; float32 or float64, integers become the
            default float type. For a `FirstOrderSystem` pass y0 as q0, and no v0.
        params: any pytree; it is passed to the functions of the system. Its arrays and numbers are data. Functions in
            it, such as the activations of a neural network in an `equinox.Module`, are part of the program and are
            compared by identity. So a new module of the same structure costs no compilation, but a new lambda does.
        z0: initial internal states of a `System(..., internal=)`, any pytree of arrays.
        dt: step size, positive. Or (N,), the sizes of N steps, in any order; then leave out `num_steps`. With unequal
            steps the `hht` family keeps order 2 (except for the multipliers of index 3), and a `LinearSystem` is
            factorised anew in each step. A step more than twice as long as the previous one can make a method with
            rho_inf near 0 unstable. Or `adaptive(rtol, atol)`, which chooses the steps by their errors; derivatives
            treat these steps as constants.
        num_steps: number of steps.
        duration: length of the run, instead of num_steps. dt is reduced, if necessary, so that a whole number of steps
            fits; `run.dt` is the size used. The number of steps is then part of the program, so dt and duration cannot
            be traced. With `adaptive` the duration is data.
        num_samples: K, with `duration`: the number of equally spaced samples after the start. Each is at the end of a
            step (with `adaptive` it may be within one). Default: every step is saved.
        times: (K,), sample times, instead of num_steps: increasing, after t0, data. The run continues to the last of
            them. Samples are interpolated between steps, by cubics (multipliers and dry friction linearly), so steps
            need not end at the times: dt is a number or `adaptive`, and the steps are the same as without `times`.
            (With contact, and in `sweep` with step sizes, steps end at the times.)
        save_every: number of steps between saved times; a divisor of num_steps. save_every=num_steps saves only the
            start and the end.
        progress: shows a progress bar in one line on stderr, also under jit. A reverse derivative shows one for each
            pass.
        extrapolate: number of runs for Richardson extrapolation, 1 to 4, with steps dt, dt/2, dt/4, ... and the same
            saved times. For a stepper of order p, 2 runs remove the error of order dt^p for three times the work; 3
            also remove that of order dt^(p + 1), for seven times the work. `hht` then has order 3 or 4. (alpha = 0 has
            order 4 with 2 already, but order 3 with rotations unless kinematics="lie". With uneven steps only alpha = 0
            gains, to order 3.) Use it for motions that dt resolves; elsewhere it increases errors. Steps must be
            smooth, as with linearize="predictor". An error dt^3 remains where "auto" changes its choice, or where a
            step contains an event or a switch of dry friction. `friction` and `sticking` are taken from the run with
            the shortest steps. So is everything at a saved time that lies after an event in some of the runs only.
        t0: time of the start.
        events: a list of `Event`: impacts, end stops, switches, ends of the run. Each is located within the step in
            which it happens, or given at a known time; the time grid does not change. A step without an event costs
            one more evaluation of the guards. Supported by the `hht` family, Rosenbrock and Runge-Kutta methods and
            `taylor`.
        max_events: largest number of events with a reset or switch in one step; with more the run fails. With
            `adaptive`, steps are shortened first, and the remainder of a step after an event has its own error
            estimate.
        keep_events: number of events that `run.events` can hold.
        output: a function whose arguments are any of q, v, w (the acceleration), L (multipliers), z, zdot, friction,
            sticking, contact, t and params, by these names: `output(q, w, params)`, `output(q, v, w, L, z, t, params)`.
            It returns a pytree of arrays, which is saved as `run.output` instead of q, v and everything else. A long
            run of a large system then needs little memory. `check` works as before. Quantities that the system does not
            have are None. For a first-order system q is y and v its rate. params are those valid at the time, after
            switches of events and with held inputs. Richardson extrapolation is applied to each number of the output,
            so do not return rotations with it: the result would not be orthogonal. `verify` compares q at the samples,
            which it keeps during the run.
        throw: whether a failed run raises an error; otherwise it gives a `FailedRunWarning`. Both say what
            `solution.check()` says. Neither works inside jit and vmap: call `check()` on the result there.

    Returns:
        A `Solution`.

    Differentiable, forward and reverse, in dt, t0, params, q0, v0, z0 and the numbers of the stepper. Reverse mode
    recomputes the steps in blocks; its memory grows with the square root of num_steps. Up to 1 MB of states is stored
    instead, so that steps are recomputed only once.

    Compiled once for each system, stepper, structure, num_steps and save_every. A new dt, q0 or params costs no
    compilation unless a type changes. 4 instead of 4.0, np.float64(4.0) instead of 4.0, or an array instead of a number
    needs another program. Functions are compared by identity and by everything they read from outside: globals, closure
    variables, attributes of modules and objects, entries of lists and dicts, and arrays by their bytes. If any of these
    has changed, the program is compiled anew, here as in `fit`. Values passed through params cost no compilation.
    Inside your own `jit` JAX's rule holds: values that a function read during tracing are kept.

    Raises:
        TypeError, ValueError: an argument of a wrong kind, shape, structure or value; initial values that violate a
            constraint. Values of tracers are not checked.
        SimulationError: the run failed, if `throw`.
        NotImplementedError: the stepper does not support constraints, rotations, internal states, dry friction, events,
            unequal steps or error control, and one of them is asked for.

    >>> import jax.numpy as jnp, hhtjax
    >>> spring = hhtjax.System(mass=jnp.array([1.0]), force=lambda q, v, t, params: -params["k"] * q)
    >>> solution = hhtjax.simulate(
    ...     spring, hhtjax.hht(alpha=-0.05), jnp.array([1.0]), jnp.array([0.0]), {"k": 4.0},
    ...     dt=1e-3, num_steps=1000, save_every=250)
    >>> solution.check()
    >>> [round(float(q), 4) for q in solution.q[:, 0]]                       # cos(2 t)
    [1.0, 0.8776, 0.5403, 0.0707, -0.4161]

    Saving only what a sensor shows at given times:

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
            "simulate: leave `extrapolate` out with contact: a step in which a contact switches has no error expansion "
            f"in powers of dt; received {extrapolate!r}."
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
                "simulate: with `times` and a number for `dt`, leave `progress` out. All steps are then one program, "
                "which cannot be interrupted to draw a bar. For a bar give `num_steps`, and sample the run by "
                "hhtjax.interpolate(run, times)."
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
    """Whether a step of dt (N,) may be too long compared with the previous one; True if dt is not concrete."""
    return not is_concrete(dt) or bool(np.any(np.asarray(dt)[1:] > GROWTH * np.asarray(dt)[:-1]))


@partial(Programs, static_argnames=("room",))
def _read_off(problem: Problem, times: Array, dt: Array, events, *, room: tuple) -> Solution:
    """The run with equal steps, sampled at times between them."""

    def run(problem: Problem, times: Array, dt: Array, events) -> Solution:
        t0, times, dt = map(problem.times, (problem.t0, times, dt))
        return follow(problem, times, EqualSteps.to(t0, times, dt), events, room)._replace(dt=dt)

    return one_kernel(run, problem, times, dt, events, around=True)  # also what comes before and after the loop


@partial(Programs, static_argnames=("room",))
def _land(problem: Problem, times: Array, dt: Array, events, *, room: tuple) -> Solution:
    """The run with steps of at most dt that end at the times. Contacts have kinks in the motion, where interpolation
    would be inaccurate."""
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
    """A sample at the end of each of `length` intervals of `every` steps."""
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
    """The same intervals with a progress bar, which is drawn outside of kernels: between blocks of intervals, or within
    long ones."""
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
# Short runs of one linear system in a scan of the user's have the same factors. They are computed once, before it.
#
# XLA moves computations that do not change out of a loop, but not those that consist of constants only. So without this
# each run would factorise its matrices.


def known_factors(problem: Problem, dt: Real):
    """The `Factors` of a `LinearSystem` for steps of size dt, computed now although a caller is being traced. None if
    they are not constant, or so large that the program should not contain them."""
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
