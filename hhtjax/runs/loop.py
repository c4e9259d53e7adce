"""What a run is made of: the step that counts, watches and saves, for one run as for a sweep."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.description import all_concrete, freeze, is_array, is_concrete, known_now, thaw
from hhtjax.numerics.batched_cond import choose, if_any, seldom
from hhtjax.numerics.dense_lu import LARGEST, UNROLLED
from hhtjax.primitives import is_traced
from hhtjax.runs.solution import INTERNAL_STATE, Failure, Solution
from hhtjax.steppers.friction_switching import is_settled
from hhtjax.steppers.stepper import Info, bound, entered, join_info, public
from hhtjax.systems import zero_order_hold
from hhtjax.systems.flat_system import flatten
from hhtjax.systems.linear_system import LinearSystem
from hhtjax.systems.matrices import OF_VELOCITY, mass_flaw
from hhtjax.systems.system import mass_reads_velocity

GROWTH = 2.05  # of a step, up to which the recursion follows


class Loop(NamedTuple):
    """What a run is made of. carry: (state, number of steps, first failure), before the first; advance: carry -> carry,
    Info; keep: state -> what is saved; no_info: what `join_info` leaves unchanged; bound: params -> advance; sizes:
    number of steps taken -> the size of the next, and of the last; start: the state at t0, as it is saved; past: bound,
    sizes -> advance past events; now: what events carry along -> the params after them."""

    carry: Any
    advance: Any
    keep: Any
    no_info: Info
    bound: Any
    sizes: Any
    start: Any
    past: Any = None
    now: Any = None


def loop_of(flat, stepper, q, v, t0, params, dt):
    """The loop over a stepper's steps."""
    stepper = stepper.astype(q.dtype)

    def take_step(params):
        return jax.jit(bound(stepper, flat, params, dt), inline=True)  # traced once, wherever it is called

    step = take_step(params)

    def advance(now):
        return counted(step if now is params else take_step(now), flat, t0, dt)

    start, first = entered(stepper, flat, q, v, t0, zero_order_hold.before(params, t0, dt), dt, alone=True)
    no_info = neutral_info(jax.eval_shape(step, first)[1])
    carry = first, jnp.zeros((), jnp.int32), no_failure(no_info)
    keep = partial(saved, flat)
    return Loop(carry, counted(step, flat, t0, dt), keep, no_info, advance, lambda count: (dt, dt), start)


def given_sizes(t0, dt):
    """`sizes` of `loop_over` for steps dt (N,); NaN where one is not positive."""
    dt = jnp.where((dt > 0) & jnp.isfinite(dt), dt, jnp.nan)
    steps = dt, jnp.concatenate([dt[:1], dt[:-1]]), t0 + jnp.cumsum(dt)
    return lambda number: [lax.dynamic_index_in_dim(x, number, keepdims=False) for x in steps]


def loop_over(flat, stepper, q, v, t0, params, sizes, resolves=False, grows=False):
    """The same with steps of any sizes: number of steps taken -> the next, the one before, and where it ends.

    resolves: whether the first is one of error control. grows: of `resized_step`."""
    stepper = stepper.astype(q.dtype)
    none = jnp.zeros((), jnp.int32)
    first = sizes(none)[0]

    def take_step(params):
        @partial(jax.jit, inline=True)  # traced once, wherever it is called
        def step(state, number):
            h, last, end = sizes(number)
            state, info = resized_step(flat, stepper, params, h, last, grows)(state)
            return state._replace(t=end), info

        return step

    step = take_step(params)

    def advance(now):
        one = step if now is params else take_step(now)

        def next_step(carry):
            state, count, failure = carry
            state, info = one(state, count)
            return (state, count + 1, first_failure(flat, failure, count + 1, state, info)), info

        return next_step

    how = {"resolves": resolves, "alone": not resolves}
    start, begun = entered(stepper, flat, q, v, t0, zero_order_hold.before(params, t0, first), first, **how)
    no_info = neutral_info(jax.eval_shape(step, begun, none)[1])
    carry, keep = (begun, none, no_failure(no_info)), partial(saved, flat)
    return Loop(carry, advance(params), keep, no_info, advance, lambda count: tuple(sizes(count)[:2]), start)


def grows_at_once(dt):
    """Whether some of these steps (N,), as far as they are known, are too long behind the one before."""
    return not is_concrete(dt) or bool(np.any(np.asarray(dt)[1:] > GROWTH * np.asarray(dt)[:-1]))


def resized_step(flat, stepper, params, dt, last, grows=False):
    """State -> (State, Info) for a step dt after one of another size; grows: whether it may be far longer."""

    def step(state):
        resized, state = stepper.resized(state, dt / last)
        if grows and stepper.throws(flat):

            def begin(state, params, dt):
                return resized.grown(flat, state, zero_order_hold.before(thaw(params), state.t, last), dt)

            state = seldom(begin, dt > GROWTH * last, state, freeze(params), dt)
        return bound(resized, flat, params, dt, last)(state)

    return step


def advance_from(flat, stepper, dtype, params, t, dt, count, last=None, grows=False):
    """`Loop.advance` with another dt, from the time t on, where `count` steps have been taken, each of size `last`."""
    stepper = stepper.astype(dtype)
    if last is None:
        take_step = bound(stepper, flat, params, dt)
    else:
        take_step = resized_step(flat, stepper, params, dt, last, grows)
    return counted(take_step, flat, t, dt, count)


def counted(take_step, flat, t0, dt, before=None):
    """The step of a run, on (state, number of steps, first failure); also its `Info`. before: steps taken at t0."""

    def step(carry):
        state, count, failure = carry
        state, info = take_step(state)
        count = count + 1
        taken = count if before is None else count - before
        state = state._replace(t=t0 + taken.astype(dt.dtype) * dt)  # no rounding piles up
        return (state, count, first_failure(flat, failure, count, state, info)), info

    return step


def resting(advance, by_itself, run, info, here):
    """The run and what is known of it after a step, or, not `here`, without. by_itself: whether `advance` can rest."""
    after, more = advance(run, here) if by_itself else advance(run)
    info = choose(here, join_info(info, more), info)
    return after if by_itself else if_any(partial(choose, here), ~here, after, run, kept=False), info


def saved(flat, state):
    """What a run saves of a state."""
    state = public(flat, state)
    return state.t, state.q, state.v, state.w, state.L, state.z, state.zdot, state.friction


def as_solution(flat, start, path, dt, info, failure, flaw=None):
    """The start and the path after it as a `Solution`; flaw: of the mass at the start, as `mass_flaw` says it."""
    failure = with_flaw(failure, flaw)
    path = jax.tree.map(lambda x, y: jnp.concatenate([x[None], y]), saved(flat, start), path)
    return as_path(flat, path)._replace(dt=dt, info=info, failure=failure)


def as_path(flat, path):
    """What was saved, with a leading axis, as a `Solution` that knows nothing else."""
    t, q, v, w, L, *z, friction = path
    q = jax.vmap(flat.unravel)(q)
    v, w = (None if x is None else jax.vmap(flat.unravel_rates)(x) for x in (v, w))
    z, zdot = (None if x is None else jax.vmap(flat.unravel_internal)(x) for x in z)
    nothing: Any = None
    solution = Solution(t, q, v, w, L, nothing, nothing, nothing, z, zdot)
    return solution if friction is None else solution._replace(friction=friction.tau, sticking=friction.sig == 0)


def with_flaw(failure, flaw):
    """The failure, or that of a mass that is none at the start."""
    return failure if flaw is None else failure._replace(step=jnp.where(flaw > 0, 1, failure.step), mass=flaw)


def flaw_at_start(system, flat, start, params):
    """What is wrong with the mass there, where it is a function; a constant one has been looked at."""
    if not callable(getattr(system, "mass", None)):
        return None
    flaw = mass_flaw(flat.mass(start.q, start.t, params), system.constraint is not None or system.massless is not None)
    if not getattr(system.mass, "is_lagrangian", False):
        return flaw
    at = flat.unravel(start.q), flat.unravel_rates(flat.located(start.v)), start.t, params
    return jnp.where((flaw == 0) & mass_reads_velocity(system.mass.lagrangian, *at), OF_VELOCITY, flaw)


def no_failure(info):
    """What `Solution.failure` says of a run in which all went well."""
    none = jnp.zeros((), jnp.int32)
    return Failure(none, jnp.array(False), none, info.dependent_row, info.solve_residual, info.friction)


def first_failure(flat, failure, count, state, info):
    """The failure so far, or this step's. Of several quantities an internal state is named, then the first."""
    _, *values, _ = saved(flat, state)
    known = [(i, x) for i, x in enumerate(values) if x is not None]
    known.sort(key=lambda x: x[0] < INTERNAL_STATE)
    # a sum that is finite tells that all are; where it is not, look closer
    suspect = ~jnp.isfinite(sum(jnp.sum(x) for _, x in known)) | told_failure(info)
    return if_any(partial(failure_of, known, count, info), suspect & (failure.step == 0), failure, kept=False)


def told_failure(info):
    """Whether a step says by itself that it failed."""
    failed = jnp.array(False) if info.dependent_row is None else info.dependent_row >= 0
    for well in (info.converged, info.solved):
        failed = failed if well is None else failed | ~well
    return failed


def failure_of(known, count, info, failure):
    """The same, from each quantity by itself, [(number, array)]."""
    quantity, finite = jnp.zeros((), jnp.int32), jnp.array(True)
    for i, x in reversed(known):
        fine = jnp.all(jnp.isfinite(x))
        quantity, finite = jnp.where(fine, quantity, i), finite & fine
    newton, row, left, friction = finite, failure.row, failure.solve, failure.friction
    if info.dependent_row is not None:
        newton = newton & (info.dependent_row < 0)
    if info.solved is not None:
        newton = newton & info.solved
    if info.friction is not None:
        newton = newton & is_settled(info.friction)
    first = (~finite | told_failure(info)) & (failure.step == 0)
    if info.dependent_row is not None:
        row = jnp.where(first, info.dependent_row, failure.row)
    if info.solved is not None:
        left = jnp.where(first & finite & ~info.solved, info.solve_residual, failure.solve)
    if info.friction is not None:
        friction = jnp.where(first & ~is_settled(info.friction), info.friction, failure.friction)
    step, quantity = (jnp.where(first, new, old) for new, old in ((count, failure.step), (quantity, failure.quantity)))
    return Failure(step, jnp.where(first, newton, failure.newton), quantity, row, left, friction)


def neutral_info(shapes):
    """What `join_info` leaves unchanged."""
    neutral = Info(*(None if x is None else jnp.asarray(x.dtype == bool, x.dtype) for x in shapes))
    return neutral if neutral.dependent_row is None else neutral._replace(dependent_row=-1 - neutral.dependent_row)


# ----------------------------------------------------------------------------
# What short runs of one linear system, in a scan of the user's, have in common: factorised once, where it is written.
#
# XLA takes what does not change out of a loop, but not where all that does not change is constant: there each run
# factorised its matrices.


def known_factors(problem, dt):
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
