"""A run: one scan over the steps."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from hhtjax.checks import require_integer
from hhtjax.numerics.checkpointed_scan import checkpointed_scan
from hhtjax.runs.adaptive import Adaptive
from hhtjax.runs.controlled import run_controlled
from hhtjax.runs.event_checks import require_events
from hhtjax.runs.events import loop_with_events, with_told_events
from hhtjax.runs.extrapolate import MOST, extrapolated
from hhtjax.runs.given_steps import refined, require_control_alone, require_steps
from hhtjax.runs.loop import as_solution, flaw_at_start, given_sizes, loop_of, loop_over, show_progress
from hhtjax.runs.problem import Problem
from hhtjax.runs.solution import Solution
from hhtjax.steppers.stepper import Stepper, join_info
from hhtjax.systems.system import FirstOrderSystem, LinearSystem, System
from hhtjax.xla import Programs, is_in_batch, on_scalars, one_kernel, or_plain


def simulate(
    system: System | LinearSystem | FirstOrderSystem,
    stepper: Stepper,
    q0: Any,
    v0: Any = None,
    params: Any = None,
    *,
    z0: Any = None,
    dt: Any,
    num_steps: int | None = None,
    times: Any = None,
    t0: Any = 0.0,
    save_every: int = 1,
    progress: bool = False,
    extrapolate: int = 1,
    events: Any = None,
    max_events: int = 2,
    keep_events: int = 100,
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
        times: (K,), with `adaptive`: increasing, after t0. The run ends at the last, and is read off at the others, by
            cubics between its steps (multipliers by lines).
        save_every: steps between saved times; a divisor of num_steps. save_every=num_steps keeps the
            start and the end only, and stores no path.
        progress: show a bar in one line on stderr, also under jit; once more for each pass of a reverse derivative.
        extrapolate: number of runs, with steps of dt, dt/2, dt/4, ..., that Richardson's extrapolation joins at the
            same saved times, 1 to 4. For a stepper of order p, 2 takes the error dt^p out, for three times the work, 3
            dt^(p + 1) too, for seven times: `hht` becomes of order 3 and 4 (alpha = 0 of order 4 with 2 already; with
            uneven steps only alpha = 0, of order 3). For motions that dt resolves, elsewhere it makes errors larger;
            and for smooth steps, such as linearize="predictor": where "auto" changes its choice, dt^3 is left, as it
            is where an event, or a switch of dry friction, falls into a step; `friction` and `sticking` are then those
            of the run with the shortest steps, as is all at a saved time that an event comes before in some runs only.
        t0: time of the start.
        events: a list of `Event`: impacts, end stops, switches, ends of the run, located within the step in which they
            happen; the grid stays what it is. Steps without one take as long as before, and a look at the guards. For
            the `hht` family, `rosenbrock`, `rowda`, `rk4` and `dopri5`.
        max_events: how many of those that change something may fall into one step; more are a failure. With `adaptive`
            steps become shorter first, and what lies behind an event has an error of its own.
        keep_events: how many `run.events` has room for.

    Returns:
        A `Solution`. Nothing raises while the steps run: call `solution.check()`.

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
    """
    problem = Problem.checked("simulate", system, stepper, q0, v0, params, t0, z0)
    save_every = require_integer("simulate", "save_every", save_every)
    if not isinstance(extrapolate, int) or isinstance(extrapolate, bool) or not 1 <= extrapolate <= MOST:
        raise ValueError(f"simulate: `extrapolate` must be an integer from 1 to {MOST}; received {extrapolate!r}.")
    room = (
        require_integer("simulate", "max_events", max_events),
        require_integer("simulate", "keep_events", keep_events),
    )
    if events is not None:
        events = require_events("simulate", problem, events)
    if isinstance(dt, Adaptive) or times is not None:
        require_control_alone("simulate", dt, times, num_steps, save_every, extrapolate)
        return run_controlled(problem, times, dt, progress, events, room)
    dt, num_steps = require_steps("simulate", stepper, dt, num_steps, 2 ** (extrapolate - 1))
    if num_steps % save_every:
        raise ValueError(f"simulate: `save_every` must divide num_steps={num_steps}; received {save_every}.")

    kind = {"rates": problem.rates(), "numbers": sum(map(jnp.size, jax.tree.leaves(problem.q0)))}

    def run(k):
        sizes = {"num_steps": k * num_steps, "save_every": k * save_every, "room": room, "progress": progress}
        return or_plain(partial(_simulate, problem, refined(dt, k), events, in_batch=is_in_batch(), **sizes, **kind))

    return run(1) if extrapolate == 1 else extrapolated(run, extrapolate, stepper.order, join_info)


@partial(Programs, static_argnames=("num_steps", "save_every", "progress", "room", "in_batch"))
def _simulate(problem, dt, events, *, num_steps, save_every, progress, room, in_batch):
    flat, q, v, t0, params = problem.flat()
    dt = jnp.asarray(dt).astype(q.dtype)
    loop_by, sizes = (loop_over, given_sizes(t0, dt)) if dt.ndim else (loop_of, dt)
    plain = loop = loop_by(flat, problem.stepper, q, v, t0, params, sizes)
    if events is not None:
        loop = loop_with_events(plain, flat, problem.stepper, events, params, *room)

    def with_progress(advance, carry):
        carry, info = advance(carry)
        if progress:
            show_progress(carry[1], num_steps, "step")
        return carry, info

    # without events, which are seldom; never with a callback, which keeps XLA from making one kernel
    form = on_scalars(lambda carry: with_progress(plain.advance, carry[:3]), loop.carry)
    step, keep = form.of(partial(with_progress, loop.advance)), form.of(loop.keep)

    def interval(carry, _):
        if save_every == 1:
            carry, info = step(carry)
        else:
            (carry, info), _ = checkpointed_scan(joined_step, (carry, loop.no_info), save_every, in_batch)
        return carry, (keep(carry[0]), info)

    def joined_step(carry, _):
        carry, info = carry
        carry, new = step(carry)
        return (carry, join_info(info, new)), None

    def run(carry):
        return checkpointed_scan(interval, carry, num_steps // save_every, in_batch)

    (_, _, failure, *met), (path, info) = one_kernel(run, form.tree)
    start = loop.carry[0]
    flaw = flaw_at_start(problem.system, flat, start, params)
    solution = as_solution(flat, start, form.joined(path), dt, info, failure, flaw)
    return with_told_events(flat, solution, form.joined(met[0]), room[1]) if met else solution
