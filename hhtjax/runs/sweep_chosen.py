"""Sweeps under error control: the steps of all members first, then their runs over them, the long ones together."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.runs.choose import trimmed
from hhtjax.runs.choose_many import Members, choose_many
from hhtjax.runs.chosen import Grid, follow
from hhtjax.runs.freezing import frozen, is_pair, run_and_choice
from hhtjax.runs.output import beside_path, without_path
from hhtjax.runs.progress import announce, show_progress
from hhtjax.runs.sweep_inputs import lanes_for
from hhtjax.runs.tightened import accepted_run, tighten
from hhtjax.runs.verified import compared, verified
from hhtjax.xla import Programs, or_plain


def sweep_chosen(inputs, progress):
    """The `Solution` of a sweep whose `dts` are an `Adaptive`."""
    static = {"mapped": inputs.mapped, "size": inputs.size, "lanes": lanes_for(inputs.size), "progress": progress}
    static |= {"pair": is_pair(), "room": inputs.room}
    output = beside_path(inputs.output, inputs.dts)
    starts = run_and_choice((inputs.data, inputs.dts, inputs.t0, inputs.times, inputs.events, output))
    runs = or_plain(partial(run_chosen, inputs.system, *starts, **static, rates=inputs.sizes()[1]))
    steps = trimmed(runs.steps)
    runs = runs._replace(dt=steps.dt, steps=steps)
    return runs if output is None else without_path(runs)


@partial(Programs, static_argnames=("mapped", "size", "lanes", "progress", "pair", "room"))
def run_chosen(system, start, choice, *, mapped, size, lanes, progress, pair, room):
    """The same, compiled, with all max_steps. start, choice: data, tolerances, t0, times, events, output, of runs, of
    steps; pair: whether the two differ."""
    if progress:
        announce()

    def members_of(data, control, t0, times, events, output):
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
    """What the `Solution` tells of its errors, by the runs with halved steps, or with those for a quarter of the
    tolerance."""

    def error(arrays, run, finer):
        return verified(run, finer, members.control(arrays), members.problem(arrays).stepper.order)

    is_halved = verify != "tolerance"
    if not is_halved:
        steps, ends = frozen(partial(choose_many, choosing.for_share(1 / 4)))
    finer = run_many(members, steps, ends, progress, halved=is_halved)
    return jax.vmap(error, (members.axes, 0, 0))(members.arrays, runs, finer)


def rounds(members, progress):
    """The last `Round` of all members; those whose runs are as good as asked for wait for the others."""

    def once(share):
        steps, ends = choose_many(members.for_share(share))
        return run_many(members, steps, ends, progress), steps, ends

    def judge(run, before, share):
        def one(arrays, run, before, share):
            return compared(run, before, share, members.control(arrays))

        return jax.vmap(one, (members.axes, 0, 0, 0))(members.arrays, run, before, share)

    return tighten(once, judge, jnp.ones(members.size, members.t0.dtype))


def run_many(members, steps, ends, progress, halved=False):
    """The runs over these steps, each halved or not, in blocks: of the longest members, the next longest, and so on."""
    t0, times, size, lanes = members.t0, members.times, members.size, members.lanes

    def grid(ends, accepted):
        return Grid.of(t0, times, ends, accepted, halved)

    def member(arrays, grid):
        return follow(members.problem(arrays), times, grid, members.events, members.room)

    def block(numbered):
        number, those = numbered
        if progress:
            show_progress(number + 1, len(blocks), "block")
        grids = jax.vmap(grid)(ends[those], steps.accepted[those])
        return jax.vmap(member, (members.axes, 0))(members.of(those), grids)

    order = jnp.argsort(-steps.accepted)
    blocks = np.minimum(np.arange(-(-size // lanes) * lanes), size - 1).reshape(-1, lanes)  # the last one fills up
    runs = lax.map(block, (jnp.arange(len(blocks), dtype=jnp.int32), order[blocks]))
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[jnp.argsort(order)], runs)
