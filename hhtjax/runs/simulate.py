"""A run: one scan over the steps."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.checks import require_integer, require_number, require_params
from hhtjax.description import is_concrete, thaw
from hhtjax.numerics.checkpointed_scan import checkpointed_scan
from hhtjax.runs.extrapolate import MOST, extrapolated
from hhtjax.runs.given_steps import refined, require_steps
from hhtjax.runs.loop import as_solution, flaw_at_start, loop_of, loop_over, show_progress
from hhtjax.runs.solution import Solution
from hhtjax.steppers.stepper import Stepper, join_info, require_capable, require_stepper, require_system
from hhtjax.systems.consistent import require_consistent
from hhtjax.systems.flat_system import flatten
from hhtjax.systems.initial_values import initial_values
from hhtjax.systems.rubbing import require_independent_friction
from hhtjax.systems.system import FirstOrderSystem, LinearSystem, System
from hhtjax.xla import on_scalars, one_kernel, or_plain


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
    t0: Any = 0.0,
    save_every: int = 1,
    progress: bool = False,
    extrapolate: int = 1,
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
        num_steps: number of steps.
        save_every: steps between saved times; a divisor of num_steps. save_every=num_steps keeps the
            start and the end only, and stores no path.
        progress: show a bar in one line on stderr, also under jit; once more for each pass of a reverse derivative.
        extrapolate: number of runs, with steps of dt, dt/2, dt/4, ..., that Richardson's extrapolation joins at the
            same saved times, 1 to 4. For a stepper of order p, 2 takes the error dt^p out, for three times the work, 3
            dt^(p + 1) too, for seven times: `hht` becomes of order 3 and 4 (alpha = 0 of order 4 with 2 already; with
            uneven steps only alpha = 0, of order 3). For motions that dt resolves, elsewhere it makes errors larger;
            and for smooth steps, such as linearize="predictor": where "auto" changes its choice, dt^3 is left.
        t0: time of the start.

    Returns:
        A `Solution`. Nothing raises while the steps run: call `solution.check()`.

    Differentiable, forward and reverse, in dt, t0, params, q0, v0, z0 and the numbers of the stepper; reverse
    mode computes the steps again, in blocks, and its memory grows with the square root of num_steps.
    Compiled once for each system, stepper, structure, num_steps and save_every; a new dt, q0 or params
    costs no compilation. Functions are told apart by identity, here as in `fit`: one that reads a global variable, or
    data around it, keeps the values of its first call. Pass through params what may change, or define the function
    anew, or call `jax.clear_caches()`.

    Raises:
        TypeError, ValueError: an argument of a wrong kind, shape, structure or value; initial values that violate
            a constraint. Values are checked unless they are tracers.
        NotImplementedError: the system has a constraint, or internal states, and the stepper cannot solve them.

    >>> import jax.numpy as jnp, hhtjax
    >>> spring = hhtjax.System(mass=jnp.array([1.0]), force=lambda q, v, t, params: -params["k"] * q)
    >>> solution = hhtjax.simulate(
    ...     spring, hhtjax.hht(alpha=-0.05), jnp.array([1.0]), jnp.array([0.0]), {"k": 4.0},
    ...     dt=1e-3, num_steps=1000, save_every=250)
    >>> solution.check()
    >>> [round(float(q), 4) for q in solution.q[:, 0]]                       # cos(2 t)
    [1.0, 0.8776, 0.5403, 0.0707, -0.4161]
    """
    require_system("simulate", system)
    require_stepper("simulate", stepper)
    dt, num_steps = require_steps("simulate", stepper, dt, num_steps)
    save_every = require_integer("simulate", "save_every", save_every)
    if num_steps % save_every:
        raise ValueError(f"simulate: `save_every` must divide num_steps={num_steps}; received {save_every}.")
    if not isinstance(extrapolate, int) or isinstance(extrapolate, bool) or not 1 <= extrapolate <= MOST:
        raise ValueError(f"simulate: `extrapolate` must be an integer from 1 to {MOST}; received {extrapolate!r}.")
    params = require_params("simulate", params)
    require_number("simulate", "t0", t0, np.isfinite, "be finite")
    q0, v0, z0 = initial_values("simulate", system, q0, v0, z0)
    require_capable("simulate", system, stepper, q0, v0)
    if system.friction is not None and extrapolate > 1:
        raise NotImplementedError(
            "simulate: leave `extrapolate` out: with dry friction the error is no power series in dt; "
            f"received {extrapolate}."
        )
    if system.friction is not None:
        require_independent_friction("simulate", system, q0, v0, t0, params, z0)
    if system.constraint is not None:
        require_consistent("simulate", system, q0, v0, t0, params, stepper.redundant, z0)
    t0 = float(t0) if is_concrete(t0) else t0  # other number types would be compiled anew

    def run(k):
        sizes = {"num_steps": k * num_steps, "save_every": k * save_every}
        arguments = system, stepper, q0, v0, params, refined(dt, k), t0, z0
        return or_plain(partial(_simulate, *arguments, **sizes, progress=progress))

    return run(1) if extrapolate == 1 else extrapolated(run, extrapolate, stepper.order, join_info)


@partial(jax.jit, static_argnames=("num_steps", "save_every", "progress"))
def _simulate(system, stepper, q0, v0, params, dt, t0, z0, *, num_steps, save_every, progress):
    params = thaw(params)
    flat, q, v = flatten("simulate", system, q0, v0, t0, params, z0)
    dt, t0 = (jnp.asarray(x).astype(q.dtype) for x in (dt, t0))
    loop = (loop_over if dt.ndim else loop_of)(flat, stepper, q, v, t0, params, dt)

    def with_progress(carry):
        carry, info = loop.advance(carry)
        if progress:
            show_progress(carry[1], num_steps, "step")
        return carry, info

    form = on_scalars(with_progress, loop.carry)  # never with a callback, which keeps XLA from making one kernel
    step, keep = form.of(with_progress), form.of(loop.keep)

    def interval(carry, _):
        if save_every == 1:
            carry, info = step(carry)
        else:
            (carry, info), _ = checkpointed_scan(joined_step, (carry, loop.no_info), save_every)
        return carry, (keep(carry[0]), info)

    def joined_step(carry, _):
        carry, info = carry
        carry, new = step(carry)
        return (carry, join_info(info, new)), None

    def run(carry):
        return checkpointed_scan(interval, carry, num_steps // save_every)

    (_, _, failure), (path, info) = one_kernel(run, form.tree)
    start = loop.carry[0]
    return as_solution(flat, start, form.joined(path), dt, info, failure, flaw_at_start(system, flat, start, params))
