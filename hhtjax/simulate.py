"""The run: one scan over the steps, what it saves, and what it says about itself."""

import sys
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.boundary import require_number
from hhtjax.checkpointing import checkpointed_scan
from hhtjax.constraints import require_consistent
from hhtjax.description import is_concrete
from hhtjax.extrapolation import MOST, extrapolated
from hhtjax.flat_system import flatten, initial_values
from hhtjax.kernels import one_kernel, staged
from hhtjax.scalars import join, on_scalars, split_if_it_pays
from hhtjax.steppers.stepper import Info, public, require_capable, require_stepper, require_system


class SimulationError(RuntimeError):
    """A run in which a step failed; raised by `Solution.check`."""


class Failure(NamedTuple):
    """The first step that failed. step: its number, from 1, or 0 if none did; newton: True if Newton's
    iteration failed while the state was still finite; quantity: index into QUANTITIES of the first that is not finite;
    row: number, from 1, of the constraint that came to depend on those before it, 0 if none did, None without
    constraints."""

    step: Any
    newton: Any
    quantity: Any
    row: Any = None


QUANTITIES = "the position q", "the velocity v", "the acceleration", "the vector of multipliers"


class Solution(NamedTuple):
    """A trajectory at its saved times, the start included.

    t: (K + 1,). q, v, acceleration: pytrees like q0 and v0 with a leading axis K + 1; of a first-order
    system y, y' and None.
    multipliers: L (K + 1, m), None without constraints: M w = Q + B^T L.
    dt: the step size; (K,) of a sweep over `times`, one for each interval.
    info: `Info` for each of the K intervals between saved times: largest residual, number of Newton
    iterations, all converged; None where the method has nothing to tell.
    failure: the first step that failed, as data; `check` turns it into an error.
    """

    t: Any
    q: Any
    v: Any
    acceleration: Any
    multipliers: Any
    dt: Any
    info: Info
    failure: Failure

    def check(self, reach=None):
        """Raises `SimulationError` naming the first bad step, the quantity and why; silent when all is well.

        reach: how far q may get from its start, in any coordinate and its unit. A run that gets farther has blown up,
        although it is finite still, and is named by the first saved time. By default q may go anywhere.

        For a batch made by vmap, names the first bad member. Not to be called inside jit.
        """
        if not all(map(is_concrete, jax.tree.leaves((self.failure, self.dt, self.t)))):
            raise TypeError("check: the solution is a tracer: call check() outside jit, vmap and grad.")
        steps = np.asarray(self.failure.step)
        strays = np.zeros_like(steps)
        if reach is not None:
            require_number("check", "reach", reach, lambda x: x > 0, "be positive")
            strays = self._first_beyond(reach)
            strays = np.where((steps > 0) & (steps <= strays), 0, strays)
        bad = np.where(strays > 0, strays, steps)
        if not bad.any():
            return
        member = tuple(int(i) for i in np.argwhere(bad)[0])
        step, time = bad[member], self._time_of(bad[member], member)
        failed = f"({np.count_nonzero(bad)} of {bad.size} failed)"
        which = f"member {', '.join(map(str, member))} {failed}, " if member else ""
        why = (
            f"the position q is farther than {reach:g} from its start. Take a smaller dt, or a method that damps"
            if strays[member]
            else self._why(member)
        )
        raise SimulationError(f"simulate: {which}step {step} (to t = {time:.6g}) failed: {why}.")

    def _why(self, member):
        """What `failure` says of one member of a batch."""
        _, newton, quantity, row = (0 if x is None else np.asarray(x)[member] for x in self.failure)
        if newton:
            return (
                "Newton's iteration did not converge; the state is still finite. Take a smaller dt, or more "
                "max_iterations, or a larger tolerance"
            )
        if row:
            return (
                f"row {row - 1} of the constraint depends on the rows before it: the position is singular. Give the "
                'stepper redundant="least_squares", or formulate the constraint anew'
            )
        names = ("the position", "y", "y'") if self.acceleration is None else QUANTITIES
        return f"{names[quantity]} is not finite. Take a smaller dt, or another linearize=, or a method that damps"

    def _first_beyond(self, reach):
        """Step of the first saved time at which q is farther than `reach` from its start; 0 if none is."""
        t, axis = np.asarray(self.t), self.t.ndim - 1
        far: Any = np.zeros(t.shape, bool)
        for q in map(np.asarray, jax.tree.leaves(self.q)):
            with np.errstate(invalid="ignore"):
                far |= (abs(q - np.take(q, [0], axis)) > reach).any(axis=tuple(range(axis + 1, q.ndim)))
        return np.take_along_axis(self._steps_taken(), far.argmax(axis)[..., None], axis)[..., 0]

    def _steps_taken(self):
        """How many steps come before each saved time."""
        t, dt = np.asarray(self.t), np.asarray(self.dt)
        with np.errstate(all="ignore"):  # what was traced may be anything
            if dt.ndim < t.ndim:
                taken = (t - t[..., :1]) / dt[..., None]
            else:
                counts = np.nan_to_num(np.rint(np.diff(t) / dt), nan=1)
                taken = np.insert(np.cumsum(counts, axis=-1), 0, 0, axis=-1)
        return np.rint(np.nan_to_num(taken, posinf=0, neginf=0)).astype(int)

    def _time_of(self, step, member):
        """The time at which a step of a member of a batch ends."""
        taken, t = self._steps_taken()[member], np.asarray(self.t)[member]
        dt = np.broadcast_to(np.asarray(self.dt)[member], t[1:].shape)
        i = np.clip(np.searchsorted(taken, step) - 1, 0, dt.size - 1)
        return t[i] + (step - taken[i]) * dt[i]


def simulate(
    system, stepper, q0, v0=None, params=None, *, dt, num_steps, t0=0.0, save_every=1, progress=False, extrapolate=1
) -> Solution:
    """Steps `system` from (q0, v0) at t0, num_steps times by dt.

    Args:
        system: a `System`, `LinearSystem` or `FirstOrderSystem`.
        stepper: `hht()`, `rk4()`, ...
        q0, v0: position and velocity, pytrees of the same structure; float32 or float64, integers become
            the default float type. A `FirstOrderSystem` has y0 in the place of q0, and no v0.
        params: any pytree, handed to the functions of the system.
        dt: step size, positive. num_steps: number of steps.
        save_every: steps between saved times; a divisor of num_steps. save_every=num_steps keeps the
            start and the end only, and stores no path.
        progress: show a bar on stderr, also under jit.
        extrapolate: number of runs, with steps of dt, dt/2, dt/4, ..., that Richardson's extrapolation joins at the
            same saved times, 1 to 4. For a stepper of order p, 2 takes the error dt^p out, for three times the work, 3
            dt^(p + 1) too, for seven times: `hht` becomes of order 3 and 4 (alpha = 0 of order 4 with 2 already). For
            motions that dt resolves, elsewhere it makes errors larger; and for smooth steps, such as
            linearize="predictor": where "auto" changes its choice, dt^3 is left.

    Returns:
        A `Solution`. Nothing raises while the steps run: call `solution.check()`.

    Differentiable, forward and reverse, in dt, t0, params, q0, v0 and the numbers of the stepper; reverse
    mode computes the steps again, in blocks, and its memory grows with the square root of num_steps.
    Compiled once for each system, stepper, structure, num_steps and save_every; a new dt, q0 or params
    costs no compilation.

    Raises:
        TypeError, ValueError: an argument of a wrong kind, shape, structure or value; initial values that violate
            a constraint. Values are checked unless they are tracers.
        NotImplementedError: the system has a constraint, and the stepper cannot solve one.

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
    for name, value in (("num_steps", num_steps), ("save_every", save_every)):
        if not isinstance(value, (int, np.integer)) or isinstance(value, bool) or value < 1:
            raise ValueError(f"simulate: `{name}` must be a positive integer; received {value!r}.")
    if num_steps % save_every:
        raise ValueError(f"simulate: `save_every` must divide num_steps={num_steps}; received {save_every}.")
    if not isinstance(extrapolate, int) or isinstance(extrapolate, bool) or not 1 <= extrapolate <= MOST:
        raise ValueError(f"simulate: `extrapolate` must be an integer from 1 to {MOST}; received {extrapolate!r}.")
    require_number("simulate", "dt", dt, lambda x: np.isfinite(x) and x > 0, "be positive and finite")
    require_number("simulate", "t0", t0, np.isfinite, "be finite")
    q0, v0 = initial_values("simulate", system, q0, v0)
    require_capable("simulate", system, stepper, q0, v0)
    if system.constraint is not None:
        require_consistent("simulate", system, q0, v0, t0, params, stepper.redundant)
    dt, t0 = (float(x) if is_concrete(x) else x for x in (dt, t0))  # other number types would be compiled anew

    def run(k):
        sizes = {"num_steps": k * int(num_steps), "save_every": k * int(save_every)}
        return _simulate(system, stepper, q0, v0, params, dt / k, t0, **sizes, progress=progress)

    return run(1) if extrapolate == 1 else extrapolated(run, extrapolate, stepper.order, join_info)


@partial(jax.jit, static_argnames=("num_steps", "save_every", "progress"))
def _simulate(system, stepper, q0, v0, params, dt, t0, *, num_steps, save_every, progress):
    flat, q, v = flatten("simulate", system, q0, v0, t0, params)
    dt, t0 = (jnp.asarray(x).astype(q.dtype) for x in (dt, t0))
    loop = loop_of(flat, stepper, q, v, t0, params, dt)

    def step(carry):
        carry, info = loop.advance(carry)
        if progress:
            show_progress(carry[1], num_steps, "step")
        return carry, info

    def interval(carry, _):
        if save_every == 1:
            carry, info = step(carry)
        else:
            (carry, info), _ = checkpointed_scan(joined_step, (carry, loop.no_info), save_every)
        return carry, (loop.keep(carry[0]), info)

    def joined_step(carry, _):
        carry, info = carry
        carry, new = step(carry)
        return (carry, join_info(info, new)), None

    def run(carry):
        return checkpointed_scan(interval, carry, num_steps // save_every)

    # a callback keeps XLA from making one kernel
    carry = loop.carry if progress else split_if_it_pays(loop.advance, loop.carry)
    (_, _, failure), (path, info) = one_kernel(run, carry)
    return as_solution(flat, loop.carry[0], join(path), dt, info, failure)


class Loop(NamedTuple):
    """What a run is made of. carry: (state, number of steps, first failure), before the first; advance: carry -> carry,
    Info; keep: state -> what is saved; no_info: what `join_info` leaves unchanged."""

    carry: Any
    advance: Any
    keep: Any
    no_info: Info


def loop_of(flat, stepper, q, v, t0, params, dt):
    """The loop over a stepper's steps; its functions work on scalars too."""
    stepper = stepper.astype(q.dtype)
    take_step = jax.jit(stepper.bind(flat, params, dt), inline=True)  # traced once, wherever it is called
    start = stepper.begin(flat, q, v, t0, params, dt)
    no_info = neutral_info(jax.eval_shape(take_step, start)[1])
    carry = start, jnp.zeros((), jnp.int32), no_failure(no_info)
    advance = on_scalars(counted(take_step, flat, q, t0, dt))
    return Loop(carry, advance, on_scalars(partial(saved, flat)), no_info)


def advance_from(flat, stepper, q0, params, t, dt, count):
    """`Loop.advance` with another dt, from the time t on, where `count` steps have been taken."""
    take_step = stepper.astype(q0.dtype).bind(flat, params, dt)
    return on_scalars(counted(take_step, flat, q0, t, dt, count))


def counted(take_step, flat, q0, t0, dt, before=None):
    """The step of a run, on (state, number of steps, first failure); also its `Info`. before: steps taken at t0."""

    def step(carry):
        state, count, failure = carry
        state, info = take_step(state)
        count = count + 1
        taken = count if before is None else count - before
        state = state._replace(t=t0 + taken.astype(dt.dtype) * dt)  # no rounding piles up
        if flat.first_order:
            state = state._replace(q=q0)  # stays zero
        return (state, count, _first_failure(failure, count, state, info)), info

    return step


def saved(flat, state):
    """What a run saves of a state."""
    state = public(flat, state)
    return state.t, state.q, state.v, state.w, state.L


def as_solution(flat, start, path, dt, info, failure):
    """The start and the path after it as a `Solution`."""
    t, q, *rates, L = jax.tree.map(lambda x, y: jnp.concatenate([x[None], y]), saved(flat, start), path)
    q = jax.vmap(flat.unravel)(q)
    v, w = (None if x is None else jax.vmap(flat.unravel_rates)(x) for x in rates)
    return Solution(t, q, v, w, L, dt, info, failure)


def no_failure(info):
    """What `Solution.failure` says of a run in which all went well."""
    none = jnp.zeros((), jnp.int32)
    return Failure(none, jnp.array(False), none, info.dependent_row)


def _first_failure(failure, count, state, info):
    """The failure so far, or this step's."""
    known = [(i, x) for i, x in enumerate((state.q, state.v, state.w, state.L)) if x is not None]
    checks = staged(lambda values: [jnp.all(jnp.isfinite(x)) for x in values])([x for _, x in known])
    quantity, finite = jnp.zeros((), jnp.int32), jnp.array(True)
    for (i, _), fine in reversed(list(zip(known, checks, strict=True))):
        quantity, finite = jnp.where(fine, quantity, i), finite & fine
    failed, newton, row = ~finite, finite, failure.row
    if info.converged is not None:
        failed = failed | ~info.converged
    if info.dependent_row is not None:
        failed, newton = failed | (info.dependent_row > 0), newton & (info.dependent_row == 0)
    first = failed & (failure.step == 0)
    if info.dependent_row is not None:
        row = jnp.where(first, info.dependent_row, failure.row)
    step, quantity = (jnp.where(first, new, old) for new, old in ((count, failure.step), (quantity, failure.quantity)))
    return Failure(step, jnp.where(first, newton, failure.newton), quantity, row)


def neutral_info(shapes):
    """What `join_info` leaves unchanged."""
    return Info(*(None if x is None else jnp.asarray(x.dtype == bool, x.dtype) for x in shapes))


def join_info(info, new):
    """Info of several steps as one: largest residuals, number of iterations, all converged."""
    join = {"iterations": jnp.add, "converged": jnp.logical_and}
    pairs = {name: (x, getattr(new, name)) for name, x in info._asdict().items() if x is not None}
    return info._replace(**{name: join.get(name, jnp.maximum)(*pair) for name, pair in pairs.items()})


def show_progress(count, total, what):
    """A bar on stderr, about a hundred times in a run."""
    every = max(1, total // 100)

    def show(count):
        done = int(count) * 40 // total
        end = "\n" if int(count) == total else ""
        print(f"\r[{'#' * done:<40}] {what} {int(count)} of {total}", end=end, file=sys.stderr, flush=True)

    due = (count % every == 0) | (count == total)
    lax.cond(due, lambda: jax.debug.callback(show, count), lambda: None)
