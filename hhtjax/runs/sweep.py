"""`sweep`: many runs in one compiled call, with step sizes, parameters, initial states and coefficients as data."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import NamedSharding, PartitionSpec

from hhtjax.description import Array, PyTree, Real
from hhtjax.numerics.batched_cond import derivative_by
from hhtjax.numerics.checkpointed_scan import checkpoint
from hhtjax.numerics.differentiable_while import repeat
from hhtjax.primitives import one_kernel, or_alone
from hhtjax.runs.adaptive import Adaptive
from hhtjax.runs.driver import counted, drive, equal_steps, resting
from hhtjax.runs.inputs import Problem
from hhtjax.runs.output import require_output, savings
from hhtjax.runs.progress import announce, show_progress
from hhtjax.runs.solution import Solution, told
from hhtjax.runs.sweep_controlled import sweep_chosen
from hhtjax.runs.sweep_inputs import VECTORS, Inputs, fit_to_samples, fit_to_times
from hhtjax.steppers.stepper import Stepper, bound
from hhtjax.steppers.variable_step import resized_step
from hhtjax.systems.events import Event
from hhtjax.systems.system import AnySystem
from hhtjax.xla import Programs

if TYPE_CHECKING:
    from hhtjax.runs.driver import Run
    from hhtjax.runs.output import Output
    from hhtjax.systems.flat_system import FlatSystem
    from hhtjax.systems.linear_system import LinearSystem
    from hhtjax.systems.system import System


def sweep(
    system: AnySystem,
    stepper: Stepper,
    q0: PyTree,
    v0: PyTree = None,
    params: PyTree = None,
    *,
    z0: PyTree = None,
    dts: Real,
    duration: Real = None,
    num_samples: int | None = None,
    times: Real | None = None,
    t0: Real = 0.0,
    in_axes: PyTree = None,
    mesh=None,
    progress: bool = False,
    events: Sequence[Event] | None = None,
    max_events: int = 2,
    keep_events: int = 100,
    throw: bool = False,
    output: Callable | None = None,
) -> Solution:
    """Simulates `system` once for each of `dts`, all from t0 on, and samples all runs at the same times.

    The samples are `num_samples` equally spaced times, at intervals H = duration/num_samples, or `times`, at any
    intervals H. Each step size is reduced, if necessary, so that a whole number of steps ends on every sample: h =
    H/ceil(H/dt), returned as `sweep.dt`. Members are sorted by their number of steps and run in vectorised blocks. A
    block takes as many steps as its longest member needs, so the total work is close to the sum over the members. A
    member that fails is named by `check()` and does not affect the others.

    Args:
        system, stepper, q0, v0, params, z0, t0: as for `simulate`.
        dts: (B,) step sizes, positive, at most H. Their number B is part of the program, their values are data. Or
            `adaptive(rtol, atol)`, where each number may be (B,): each member then has steps chosen by its errors,
            which need not end on the samples. This takes memory for max_steps numbers per member.
        duration: positive. num_samples: K, the number of samples after the start.
        times: (K,), instead of both: strictly increasing, after t0; data too. Steps end at each of them. Unlike SciPy's
            `t_eval` they therefore shorten steps, and dts are upper bounds, like SciPy's `max_step`. A dt larger than
            H, or infinite, gives one step of size H. The `hht` family has order 2 for any times.
        in_axes: what else differs between members: (stepper, q0, v0, params), or one more entry for z0. Each entry is 0
            if all its arrays have a leading axis B, None if all members share it, or a pytree of these, as for
            `jax.vmap`. A stepper with an axis is `jax.vmap(lambda alpha: hhtjax.hht(alpha))(alphas)`.
        mesh: devices that share the work, `jax.make_mesh((jax.device_count(),), ("members",))`, also of several
            processes. Every process then holds all results, which agree with those of one device to rounding. They lie
            on all devices: call `jax.device_get` before combining them with other arrays.
        progress: shows a progress bar in one line on stderr, also under jit. A reverse derivative shows one for each
            pass.
        output: as for `simulate`: a function whose values are saved instead of q, v and everything else. A large sweep
            then needs little memory, and little disk space with `sweep_to_disk`.
        events, max_events, keep_events: as for `simulate`. A block does the work of an event only in steps in which
            one of its members has one, so events add little time to a sweep.
        throw: as for `simulate`; the first member that failed is named.

    Returns:
        A `Solution` whose leaves have a leading axis B: q (B, K + 1, n), start included; t (B, K + 1), the same for
        all; dt (B,), the step sizes used, or with `times` (B, K), one for each interval; failure.step counts the steps
        of each member. With error control, `steps` holds the steps of each member, and dt is (B, N), NaN after the last
        step of each.

    Compiled once for each system, stepper, structure, B and K. Works inside jit, and under vmap over everything but dts
    and times. Differentiable, forward and reverse, in everything in which `simulate` is, and in times, except that dts
    only choose the number of steps. Derivatives cost several runs. They are NaN for members with more than 262144 steps
    between samples. Derivatives of a failed member are not finite, nor are those with respect to inputs that it shares
    with other members.

    Raises:
        TypeError, ValueError: an argument of a wrong kind, shape or value; those of `simulate`.
        SimulationError: a member failed, if `throw`.
        NotImplementedError: `times` with `houbolt` or `park`, which need equal steps; `adaptive` with a mesh, or with a
            stepper that has no error estimate; those of `simulate`.

    >>> import jax.numpy as jnp, hhtjax
    >>> spring = hhtjax.System(mass=jnp.array([1.0]), force=lambda q, v, t, params: -params["k"] * q)
    >>> runs = hhtjax.sweep(
    ...     spring, hhtjax.hht(alpha=0.0), jnp.array([1.0]), jnp.array([0.0]), {"k": 4.0},
    ...     dts=jnp.array([0.1, 0.03, 0.01]), duration=1.0, num_samples=5)
    >>> runs.check()
    >>> [round(float(h), 6) for h in runs.dt]
    [0.1, 0.028571, 0.01]
    >>> [round(float(q), 4) for q in runs.q[:, -1, 0]]                        # cos(2) = -0.4161
    [-0.4101, -0.4157, -0.4161]

    Different parameters for each member, and which members failed:

    >>> runs = hhtjax.sweep(
    ...     spring, hhtjax.hht(alpha=0.0), jnp.array([1.0]), jnp.array([0.0]), {"k": jnp.array([4.0, 9.0])},
    ...     dts=jnp.full(2, 0.01), duration=1.0, num_samples=5, in_axes=(None, None, None, 0))
    >>> [round(float(q), 2) for q in runs.q[:, -1, 0]], runs.failed.tolist()          # cos(2), cos(3)
    ([-0.42, -0.99], [False, False])

    Saving only the energies:

    >>> runs = hhtjax.sweep(
    ...     spring, hhtjax.hht(), jnp.array([1.0]), jnp.array([0.0]), {"k": 4.0}, dts=jnp.full(2, 0.01), duration=1.0,
    ...     num_samples=5, output=lambda q, v, params: 0.5 * jnp.sum(v**2) + 0.5 * params["k"] * jnp.sum(q**2))
    >>> runs.output.shape, runs.q
    ((2, 6), None)
    """
    grid = {"duration": duration, "num_samples": num_samples, "times": times, "t0": t0}
    inputs = Inputs.checked(system, stepper, q0, v0, params, z0=z0, dts=dts, in_axes=in_axes, **grid)
    inputs = inputs.with_events(events, max_events, keep_events)._replace(output=require_output("sweep", output))
    with inputs.telling_of_axes():
        if isinstance(dts, Adaptive):
            if mesh is not None:
                raise NotImplementedError("sweep: with dts=adaptive(...), leave `mesh` out.")
            return told("sweep", sweep_chosen(inputs, progress), throw)
        arguments, keywords = inputs.call(mesh=mesh, progress=progress)
        runs = partial(run_sweep, **keywords)
        if events is None or keywords["lanes"] <= VECTORS:
            return told("sweep", runs(*arguments), throw)
        # derivatives store many states; those of so many members do not fit into a cache
        found = derivative_by(partial(runs, lanes=VECTORS), runs, *arguments)
        return told("sweep", found, throw)


@partial(Programs, static_argnames=("mapped", "num_samples", "lanes", "mesh", "progress", "room", "grows"))
def run_sweep(
    system: LinearSystem | System,
    data: PyTree,
    dts: Array,
    duration,
    t0: Array,
    times,
    events: tuple | None,
    output: Output | None = None,
    *,
    mapped: tuple,
    num_samples: int,
    lanes: int,
    mesh,
    progress: bool,
    room: tuple,
    grows: bool,
) -> Solution:
    """The sweep of `Inputs`, compiled."""
    if progress:
        announce()
    dtype = jax.tree.leaves(data[1])[0].dtype
    dts, duration, t0, times = jax.tree.map(lambda x: jnp.asarray(x).astype(dtype), (dts, duration, t0, times))
    if times is None:
        H = duration / num_samples
        substeps, dts = fit_to_samples(dts, H)
        order = jnp.argsort(-substeps)
    else:
        times = jnp.concatenate([t0[None], times])
        substeps, dts = fit_to_times(dts, times)
        order = jnp.argsort(-jnp.sum(substeps, axis=1))
    hands = 1 if mesh is None else mesh.size
    rounds = -(-len(dts) // (lanes * hands))
    dealt = np.arange(rounds * hands * lanes).reshape(rounds, hands, lanes).swapaxes(0, 1)  # whole blocks, like cards
    members = order[np.minimum(dealt, len(dts) - 1)]  # the last one fills the last blocks
    leaves, structure = jax.tree.flatten(data)
    axes = [0 if flag else None for flag in mapped]

    def member(leaves: list, dt: Array, substeps: Array, longest: Array) -> Solution:
        grid = dt, substeps, longest, t0, num_samples, times
        return run_member(system, jax.tree.unflatten(structure, leaves), *grid, events, room, output, grows)

    def block(leaves: list, dts: Array, substeps: Array, numbered: tuple) -> Solution:
        number, members = numbered
        if progress:
            show_progress(number + 1, rounds, "block")
        mine = [x[members] if flag else x for x, flag in zip(leaves, mapped, strict=True)]
        return _together(member, axes, mine, dts[members], substeps[members])

    def hand(members: Array, *data: PyTree) -> Solution:
        """The blocks of one device, one after the other."""
        return lax.map(partial(block, *data), (jnp.arange(rounds, dtype=jnp.int32), members[0]))

    runs = (hand if mesh is None else _by_many(hand, mesh))(members, leaves, dts, substeps)
    back = jnp.asarray(np.argsort(dealt.ravel()))[jnp.argsort(order)]
    runs = jax.tree.map(lambda x: x.reshape(dealt.size, *x.shape[2:])[back], runs)
    if times is None:
        times = t0 + H * jnp.arange(num_samples + 1).astype(dtype)
    ends = any(event.terminal for event in events or ())  # then each has times of its own
    return runs if ends else runs._replace(t=jnp.broadcast_to(times, (len(dts), num_samples + 1)))


def _together(member: Callable, axes: list, mine: list, dts: Array, substeps: Array) -> Solution:
    """The members of a block. A single member is not batched: a batch of one would be slower, and could rest."""
    if len(dts) > 1:
        return jax.vmap(member, (axes, 0, 0, None))(mine, dts, substeps, jnp.max(substeps, axis=0))
    alone = [x if axis is None else x[0] for x, axis in zip(mine, axes, strict=True)]
    return jax.tree.map(lambda x: x[None], member(alone, dts[0], substeps[0], substeps[0]))


def _by_many(hand, mesh):
    """`hand` on each device, and all results on all of them."""
    spread, shared = PartitionSpec("members"), PartitionSpec()
    hands = jax.shard_map(hand, mesh=mesh, in_specs=(spread, shared, shared, shared), out_specs=spread, check_vma=False)
    # gathered before they are put in order: a sum over devices would lose the sign of zeros
    return lambda *args: lax.with_sharding_constraint(hands(*args), NamedSharding(mesh, shared))


# ----------------------------------------------------------------------------
# One member of a sweep: it takes its own steps, then rests until the longest member of its block is done.


def run_member(
    system: LinearSystem | System,
    data: PyTree,
    dt: Array,
    substeps: Array,
    longest: Array,
    t0: Array,
    num_samples: int,
    times: Array | None,
    events: tuple | None,
    room: tuple,
    output: Output | None = None,
    grows: bool = False,
    caller: str = "sweep",
) -> Solution:
    """One member. After `substeps` steps it rests until `longest`, the number of steps of its block.

    With `times`, start included, dt, substeps and longest are (K,). The step is then bound anew in each interval, and
    again after the first step of an interval if the method needs the size of the step before. grows: as for
    `resized_step`.
    """
    stepper, q0, v0, params, z0 = data
    problem = Problem(system, stepper, q0, v0, params, t0, z0, output)
    steps = partial(equal_steps, dt=dt if times is None else dt[0])
    intervals = dt, substeps, longest, num_samples, times
    return drive(problem, steps, partial(_at_ends, intervals=intervals, grows=grows), events, room, caller=caller)


def _at_ends(run: Run, intervals: tuple, grows: bool):
    """A sample at the end of each interval."""
    dt, substeps, longest, num_samples, times = intervals
    stepper, loop, form, past_events = run.problem.stepper, run.loop, run.form, run.loop.past is not None
    grows = grows and stepper.throws(run.flat)
    resizes = times is not None and (stepper.resizes or grows)
    save, as_saved = savings(run)
    pace = _paces(run, substeps, longest, grows)

    def part(carry: tuple, here: tuple | None):
        advance, substeps, longest = pace(carry[0], here)

        def step(i: Array, carry: tuple):
            before, info = carry
            return resting(advance, past_events, before, info, or_alone(i < substeps))

        return repeat(step, carry, longest), None

    @checkpoint
    def interval(before: tuple, here: tuple | None):
        carry = before, loop.no_info
        (after, info), _ = lax.scan(part, carry, here) if resizes else part(carry, here)
        last = None if here is None or run.problem.output is None else here[1].ravel()[0]
        return after, (save(after, last), info)

    def samples(carry: tuple):
        if times is None:
            return lax.scan(interval, carry, None, num_samples)
        each = times[:-1], dt, substeps, longest
        return lax.scan(interval, carry, in_two_parts(*each) if resizes else each)

    carry, (path, info) = one_kernel(samples, form.tree)
    return carry, partial(as_saved, form.joined(path), dt, info)


def _paces(run: Run, substeps: Array, longest: Array, grows: bool):
    """A function of the carry of the loop and an interval. It returns the step, the number of steps of the member, and
    that of its block."""
    stepper, params, loop, form = run.problem.stepper, run.params, run.loop, run.form

    def stepped(step_for: Callable, sizes: Callable):
        """The step; with events one that can rest."""
        return form.of(step_for(params) if loop.past is None else loop.past(step_for, sizes))

    def pace(before: tuple, interval: tuple | None):
        if interval is None:
            return stepped(loop.bound, loop.sizes), substeps, longest
        t, h, mine, most, *part = interval
        taken, last = part or (None, None)
        count = before[1] if taken is None else before[1] - taken

        def from_here(params: PyTree):
            return advance_from(run.flat, stepper, h.dtype, params, t, h, count, last, grows)

        return stepped(from_here, lambda _: (h, h if last is None else last)), mine, most

    return pace


def advance_from(
    flat: FlatSystem,
    stepper: Stepper,
    dtype: np.dtype,
    params: PyTree,
    t: Array,
    dt: Array,
    count: Array,
    last: Array | None = None,
    grows: bool = False,
):
    """`Loop.advance` with another dt, from the time t on, where `count` steps have been taken, each of size `last`."""
    stepper = stepper.astype(dtype)
    if last is None:
        take_step = bound(stepper, flat, params, dt)
    else:
        take_step = resized_step(flat, stepper, params, dt, last, grows)
    return counted(take_step, flat, t, dt, count)


def in_two_parts(t: Array, dt: Array, substeps: Array, longest: Array):
    """The intervals (K, 2), divided into the first step and the others; then the number of steps before each part, and
    the size of the last step before it."""
    last = jnp.concatenate([dt[:1], dt[:-1]])
    firsts = t, dt, jnp.ones_like(substeps), jnp.ones_like(longest), jnp.zeros_like(substeps), last
    others = t, dt, substeps - 1, longest - 1, jnp.ones_like(substeps), dt
    return tuple(map(partial(jnp.stack, axis=1), zip(firsts, others, strict=True)))
