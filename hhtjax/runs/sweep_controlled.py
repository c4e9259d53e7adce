"""Sweeps under error control: first the steps of all members, then their runs, with long ones grouped together."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.description import Array, PyTree, Real
from hhtjax.jaxpr import on_scalars
from hhtjax.primitives import one_kernel
from hhtjax.runs.controlled_run import Grid, accepted_run, compared, follow, scaled, tighten, verified
from hhtjax.runs.error_control import Bounds, as_steps, begin, is_walking, trial_of, trial_step, trimmed
from hhtjax.runs.frozen_steps import frozen, is_pair, run_and_choice
from hhtjax.runs.inputs import Problem
from hhtjax.runs.output import beside_path, without_path
from hhtjax.runs.progress import announce, show_progress
from hhtjax.runs.sweep_inputs import lanes_for
from hhtjax.xla import Programs

if TYPE_CHECKING:
    from hhtjax.runs.adaptive import Adaptive
    from hhtjax.runs.error_control import Steps, StepTrial, Walk
    from hhtjax.runs.solution import Solution
    from hhtjax.runs.sweep_inputs import Inputs
    from hhtjax.systems.system import System


def sweep_chosen(inputs: Inputs, progress: bool) -> Solution:
    """The `Solution` of a sweep whose `dts` are an `Adaptive`."""
    static = {"mapped": inputs.mapped, "size": inputs.size, "lanes": lanes_for(inputs.size), "progress": progress}
    static |= {"pair": is_pair(), "room": inputs.room}
    output = beside_path(inputs.output, inputs.dts)
    starts = run_and_choice((inputs.data, inputs.dts, inputs.t0, inputs.times, inputs.events, output))
    runs = run_chosen(inputs.system, *starts, **static, rates=inputs.sizes()[1])
    steps = trimmed(runs.steps)
    runs = runs._replace(dt=steps.dt, steps=steps)
    return runs if output is None else without_path(runs)


@partial(Programs, static_argnames=("mapped", "size", "lanes", "progress", "pair", "room"))
def run_chosen(
    system: System,
    start: tuple,
    choice: tuple,
    *,
    mapped: tuple,
    size: int,
    lanes: int,
    progress: bool,
    pair: bool,
    room: tuple,
) -> Solution:
    """As above, compiled, with all max_steps. start, choice: data, tolerances, t0, times, events and output of the
    runs, and of the steps; pair: whether the two differ."""
    if progress:
        announce()

    def members_of(data: PyTree, control: Adaptive, t0: Array, times: Array, events, output) -> Members:
        dtype = jax.tree.leaves(data[1])[0].dtype
        times, t0 = (jnp.asarray(x).astype(dtype) for x in (times, t0))
        arrays, structure = jax.tree.flatten((data, control))
        return Members(system, arrays, structure, axes, t0, times, size, lanes, events, room, output)

    control = start[1]
    axes = [0 if flag else None for flag in mapped] + [0 if jnp.ndim(x) else None for x in jax.tree.leaves(control)]
    members, choosing = members_of(*start), members_of(*choice)

    if control.verify == "tighten":
        last = frozen(partial(rounds, choosing, progress))
        steps, told = last.steps._replace(tightened=last.share), {"error": last.error, "allowed": last.allowed}

        def again(start, steps, ends):
            return run_many(members_of(*start), steps, ends, progress)

        runs = again(start, steps, last.ends) if pair else accepted_run(last, again, start)
    else:
        steps, ends = frozen(partial(choose_many, choosing))
        runs = run_many(members, steps, ends, progress)
        told = errors(members, choosing, control.verify, runs, steps, ends, progress) if control.verify else {}
    return runs._replace(dt=steps.dt, steps=steps, **told)


def errors(members, choosing, verify, runs, steps, ends, progress):
    """The fields of the `Solution` about its errors, from runs with halved steps, or with steps for a quarter of the
    tolerance."""

    def error(arrays, run, finer):
        return verified(run, finer, members.control(arrays), members.problem(arrays).stepper.order)

    is_halved = verify != "tolerance"
    if not is_halved:
        steps, ends = frozen(partial(choose_many, choosing.for_share(1 / 4)))
    finer = run_many(members, steps, ends, progress, halved=is_halved)
    return jax.vmap(error, (members.axes, 0, 0))(members.arrays, runs, finer)


def rounds(members, progress):
    """The last `Round` of all members; members whose error is small enough wait for the others."""

    def once(share):
        steps, ends = choose_many(members.for_share(share))
        return run_many(members, steps, ends, progress), steps, ends

    def judge(run, before, share):
        def one(arrays, run, before, share):
            return compared(run, before, share, members.control(arrays))

        return jax.vmap(one, (members.axes, 0, 0, 0))(members.arrays, run, before, share)

    return tighten(once, judge, jnp.ones(members.size, members.t0.dtype))


def run_many(members: Members, steps: Steps, ends: Array, progress: bool, halved: bool = False) -> Solution:
    """The runs with these steps, each halved or not, in blocks: the longest members first, then the next longest."""
    t0, times, size, lanes = members.t0, members.times, members.size, members.lanes

    def grid(ends: Array, accepted: Array) -> Grid:
        return Grid.of(t0, times, ends, accepted, halved)

    def member(arrays: list, grid: Grid) -> Solution:
        return follow(members.problem(arrays), times, grid, members.events, members.room)

    def block(numbered: tuple) -> Solution:
        number, those = numbered
        if progress:
            show_progress(number + 1, len(blocks), "block")
        grids = jax.vmap(grid)(ends[those], steps.accepted[those])
        return jax.vmap(member, (members.axes, 0))(members.of(those), grids)

    order = jnp.argsort(-steps.accepted)
    blocks = np.minimum(np.arange(-(-size // lanes) * lanes), size - 1).reshape(-1, lanes)  # the last one fills up
    runs = lax.map(block, (jnp.arange(len(blocks), dtype=jnp.int32), order[blocks]))
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[jnp.argsort(order)], runs)


# ----------------------------------------------------------------------------
# The steps of many members: tried in blocks, each member at its own pace, and sorted again and again on the way.
#
# How many tries a member needs is not known before. So each round takes those that are not done, sorted by how many
# more their present steps would be, in blocks, and each block for a number of tries, or until the last of it is done.


ROUND = 256  # tries of a block, before members are sorted anew


class Members(NamedTuple):
    """Problems and tolerances of many members that share a part: arrays, with 0 or None for each, as in `jax.vmap`."""

    system: Any
    arrays: list
    structure: Any  # of (stepper, q0, v0, params, z0), tolerances
    axes: list
    t0: Real
    times: Any
    size: int
    lanes: int  # members in a block
    events: Any = None
    room: tuple = ()
    output: PyTree = None

    def problem(self, arrays: list) -> Problem:
        """The problem of one member."""
        (stepper, q0, v0, params, z0), _ = jax.tree.unflatten(self.structure, arrays)
        return Problem(self.system, stepper, q0, v0, params, self.t0, z0, self.output)

    def control(self, arrays: list) -> Adaptive:
        """The tolerances of one member."""
        return jax.tree.unflatten(self.structure, arrays)[1]

    def for_share(self, share):
        """The members with their tolerances multiplied by a share, one number or one for each member."""
        data, control = jax.tree.unflatten(self.structure, self.arrays)
        tolerances = jax.tree.leaves(scaled(control, share))
        of_data = len(self.axes) - len(tolerances)
        axes = self.axes[:of_data] + [0 if jnp.ndim(x) else None for x in tolerances]
        return self._replace(arrays=jax.tree.leaves(data) + tolerances, axes=axes)

    def of(self, numbers: Real):
        """The arrays of the members with these indices."""
        return [x if axis is None else x[numbers] for x, axis in zip(self.arrays, self.axes, strict=True)]


def choose_many(members: Members):
    """`Steps` of each member to the last of the times, and (size, max_steps) the times at which they end; inf after the
    last.

    Arguments must not be tracers of autodiff.
    """
    search, bounds, walks = Search.begun(members)
    max_steps, size, lanes = search.max_steps, members.size, members.lanes

    def block(order: Array, number: Array, carry: tuple):
        walks, ends = carry
        those = order[jnp.minimum(number * lanes + np.arange(lanes, dtype=np.int32), size - 1)]  # the last one fills up
        before, limits = (jax.tree.map(lambda x: x[those], tree) for tree in (walks, bounds))
        after, rows = one_kernel(search.tries, before, members.of(those), limits)
        took = ~jnp.isnan(rows)
        places = jnp.where(took, before.accepted[None] + jnp.cumsum(took, axis=0, dtype=jnp.int32) - 1, max_steps)
        ends = ends.at[jnp.broadcast_to(those, places.shape), places].set(rows, mode="drop")
        return jax.tree.map(lambda x, y: x.at[those].set(y), walks, after), ends

    def rounds(carry: tuple):
        walks, _ = carry
        waiting = is_walking(walks, search.end)
        order = jnp.argsort(jnp.where(waiting, -(search.end - walks.state.t) / walks.h, jnp.inf))
        blocks = -(-jnp.sum(waiting, dtype=jnp.int32) // lanes)
        return lax.fori_loop(0, blocks, partial(block, order), carry)

    def unfinished(carry: tuple) -> Array:
        return jnp.any(is_walking(carry[0], search.end))

    ends = jnp.full((size, max_steps), jnp.inf, search.end.dtype)
    walks, ends = lax.while_loop(unfinished, rounds, (walks, ends))
    return jax.vmap(as_steps, (0, 0, None, 0))(walks, ends, members.t0, bounds.least), ends


class Search(NamedTuple):
    """How the members of a block try steps."""

    members: Members
    end: Any
    max_steps: int
    form: Any  # of a walk

    @classmethod
    def begun(cls, members: Members):
        """The search, and the `Bounds` and walks of all members before their first steps."""
        one = members.of(0)
        search = cls(members, members.times[-1], members.control(one).max_steps, None)
        bounds, walk = search.start(one)
        plain = search.trial(one, bounds)._replace(context=None)
        search = search._replace(form=on_scalars(partial(trial_step, plain), walk))
        bounds, walks = jax.vmap(search.start, (members.axes,))(members.arrays)
        return search, bounds, jax.vmap(search.form.like)(walks)

    def start(self, arrays: list):
        """A member's `Bounds` and walk."""
        problem = self.members.problem(arrays)
        flat, q, v, t0, _ = problem.flat()
        bounds = Bounds.of(flat, problem.stepper, self.members.control(arrays), t0, self.end)
        return bounds, begin(self.trial(arrays, bounds), q, v, t0)[0]

    def trial(self, arrays: list, bounds: Bounds) -> StepTrial:
        """How a member's steps are tried."""
        members = self.members
        problem = members.problem(arrays)
        trial = trial_of(problem, self.end, bounds, self.max_steps, members.events, members.room)
        return trial._replace(stops=members.times if problem.stepper.lands else None)

    def next(self, arrays: list, bounds: Bounds, walk: Walk):
        """The walk after one trial step (unchanged if it is finished), and the end of the step; NaN if it was
        rejected."""
        new, begun = self.form.of(partial(trial_step, self.trial(arrays, bounds)))(walk)
        new = jax.tree.map(partial(jnp.where, is_walking(walk, self.end)), new, walk)
        return new, jnp.where(new.accepted > walk.accepted, begun.end, jnp.nan)

    def tries(self, walks: Walk, arrays: list, bounds: Bounds):
        """The walks of a block after a number of trial steps, and (ROUND, lanes) the ends of steps."""

        def unfinished(carry: tuple) -> Array:
            walks, _, number = carry
            return jnp.any(is_walking(walks, self.end)) & (number < ROUND)

        def body(carry: tuple):
            walks, rows, number = carry
            walks, t = jax.vmap(self.next, (self.members.axes, 0, 0))(arrays, bounds, walks)
            return walks, lax.dynamic_update_index_in_dim(rows, t, number, 0), number + 1

        # a row for all members, so that no try writes to several places
        rows = jnp.full((ROUND, self.members.lanes), jnp.nan, self.end.dtype)
        return lax.while_loop(unfinished, body, (walks, rows, jnp.zeros((), jnp.int32)))[:2]
