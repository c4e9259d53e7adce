"""Sweeps under error control: the steps of all members first, then their runs over them, the long ones together."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.runs.choose import trimmed
from hhtjax.runs.choose_many import choose_many
from hhtjax.runs.chosen import Grid, follow, quarter, verified
from hhtjax.runs.loop import show_progress
from hhtjax.runs.problem import Problem
from hhtjax.runs.sweep_inputs import lanes_for
from hhtjax.xla import or_plain


def sweep_chosen(inputs, progress):
    """The `Solution` of a sweep whose `dts` are an `Adaptive`."""
    static = {"mapped": inputs.mapped, "size": inputs.size, "lanes": lanes_for(inputs.size), "progress": progress}
    arguments = inputs.system, inputs.data, inputs.dts, inputs.t0, inputs.times
    runs = or_plain(partial(run_chosen, *arguments, **static))
    steps = trimmed(runs.steps)
    return runs._replace(dt=steps.dt, steps=steps)


@partial(jax.jit, static_argnames=("mapped", "size", "lanes", "progress"))
def run_chosen(system, data, control, t0, times, *, mapped, size, lanes, progress):
    """The same, compiled, with all max_steps."""
    dtype = jax.tree.leaves(data[1])[0].dtype
    times, t0 = (jnp.asarray(x).astype(dtype) for x in (times, t0))
    leaves, structure = jax.tree.flatten((data, control))
    axes = [0 if flag else None for flag in mapped] + [0 if jnp.ndim(x) else None for x in jax.tree.leaves(control)]

    def problem_of(leaves):
        (stepper, q0, v0, params, z0), control = jax.tree.unflatten(structure, leaves)
        return Problem(system, stepper, q0, v0, params, t0, z0), control

    def quarter_of(leaves):
        problem, control = problem_of(leaves)
        return problem, quarter(control)

    def choose(problem_of):
        data, end = lax.stop_gradient((leaves, times[-1]))
        return choose_many(problem_of, data, axes, size, end, lanes, control.max_steps)

    def over(steps, ends, halved=False):
        """The runs over these steps."""

        def grid(ends, accepted):
            return Grid.of(t0, times, ends, accepted, halved)

        def member(leaves, grid, longest):
            return follow(problem_of(leaves)[0], times, grid, longest)

        def block(numbered):
            number, members = numbered
            if progress:
                show_progress(number + 1, len(blocks), "block")
            mine = [x if axis is None else x[members] for x, axis in zip(leaves, axes, strict=True)]
            grids = jax.vmap(grid)(ends[members], steps.accepted[members])
            return jax.vmap(member, (axes, 0, None))(mine, grids, jnp.max(grids.counts, axis=0))

        order = jnp.argsort(-steps.accepted)
        blocks = np.minimum(np.arange(-(-size // lanes) * lanes), size - 1).reshape(-1, lanes)  # the last one fills up
        runs = lax.map(block, (jnp.arange(len(blocks), dtype=jnp.int32), order[blocks]))
        return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[jnp.argsort(order)], runs)

    def error(leaves, run, finer):
        problem, control = problem_of(leaves)
        return verified(run, finer, control, problem.stepper.order)

    steps, ends = choose(problem_of)
    runs = over(steps, ends)
    if control.verify:
        again = over(*choose(quarter_of)) if control.verify == "tolerance" else over(steps, ends, halved=True)
        runs = runs._replace(**jax.vmap(error, (axes, 0, 0))(leaves, runs, again))
    return runs._replace(dt=steps.dt, steps=steps)
