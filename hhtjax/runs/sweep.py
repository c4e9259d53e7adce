"""Many runs in one compiled call: step sizes, parameters, initial states and coefficients as data."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from hhtjax.checks import require_number, require_params
from hhtjax.description import is_array, is_concrete
from hhtjax.numerics.checkpointed_scan import checkpoint
from hhtjax.numerics.counted_loop import repeat
from hhtjax.runs.loop import advance_from, as_solution, loop_of, show_progress
from hhtjax.runs.solution import Solution
from hhtjax.runs.sweep_grid import (
    fit_to_samples,
    fit_to_times,
    require_one_grid,
    require_step_sizes,
    require_steps_within,
    require_times,
)
from hhtjax.steppers.stepper import join_info, require_capable, require_stepper, require_system
from hhtjax.systems.consistent import examine, require_consistent
from hhtjax.systems.flat_system import flatten
from hhtjax.systems.initial_values import initial_values
from hhtjax.xla import on_scalars, one_kernel

LANES, BLOCKS = 128, 32  # members in a block at most; blocks, where there are fewer members than that takes


def sweep(
    system,
    stepper,
    q0,
    v0=None,
    params=None,
    *,
    dts,
    duration=None,
    num_samples=None,
    times=None,
    t0=0.0,
    in_axes=None,
    mesh=None,
    progress=False,
) -> Solution:
    """Runs `system` once for each of `dts`, all from t0 on, sampled at common times.

    These are `num_samples` at distances H = duration/num_samples, or `times`, at any distances H from one to the next.
    Each step size is made smaller, if need be, so that a whole number of steps lands on every sample: h = H/ceil(H/dt),
    reported as `sweep.dt`. Members are sorted by their number of steps and run in blocks, vectorised, each block for as
    many steps as its longest member needs: the work is about the sum over the members. A member that fails is named by
    `check()` and leaves the others as they are.

    Args:
        system, stepper, q0, v0, params, t0: as for `simulate`.
        dts: (B,) step sizes, positive, at most H. Their number B is part of the program, their values are data.
        duration: positive. num_samples: K, the number of samples after the start.
        times: (K,), in the place of both: strictly increasing, after t0; data too. Steps end at each: unlike SciPy's
            `t_eval` they shorten steps, and dts are upper bounds, like its `max_step`. A dt larger than H, or infinite,
            takes the one step H. The `hht` family is of order 2 as dts shrink between given times; where there is one
            step from sample to sample, unequal ones add an error of first order unless alpha = 0.
        in_axes: what else differs between members: (stepper, q0, v0, params), each 0 where all its arrays have a
            leading axis B, None where the members share it, or a pytree of these, as for `jax.vmap`. A stepper with an
            axis is `jax.vmap(lambda alpha: hhtjax.hht(alpha))(alphas)`.
        mesh: devices that share the work, `jax.make_mesh((jax.device_count(),), ("members",))`, also of several
            processes; each then holds all results, bitwise those of one device.
        progress: show a bar on stderr, also under jit.

    Returns:
        A `Solution` whose leaves have a leading axis B: q (B, K + 1, n), start included; t (B, K + 1), the same for
        all; dt (B,), the step sizes used, or (B, K), those before each of `times`; failure.step counts each member's
        own steps.

    Compiled once for each system, stepper, structure, B and K. To be used inside jit and under vmap over all but dts
    and times; differentiable, forward and reverse, in all that `simulate` is, and in times, except that the dts only
    choose the number of steps. Derivatives cost several runs, and are NaN for members with more than 262144 steps
    between samples; those of a failed member are not finite, nor are those in what it shares with others.

    Raises:
        TypeError, ValueError: an argument of a wrong kind, shape or value; those of `simulate`.
        NotImplementedError: `times` for a stepper that needs equal steps, `houbolt` or `park`; those of `simulate`.

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
    """
    grid = {"duration": duration, "num_samples": num_samples, "times": times, "t0": t0}
    inputs = Inputs.checked(system, stepper, q0, v0, params, dts=dts, in_axes=in_axes, **grid)
    return inputs.run(mesh=mesh, progress=progress)


class Inputs(NamedTuple):
    """What a sweep is made from, checked: `data` is (stepper, q0, v0, params), `mapped` which of its leaves differ."""

    system: Any
    data: Any
    dts: Any
    duration: Any
    t0: Any
    mapped: tuple
    num_samples: int
    times: Any = None

    @classmethod
    def checked(cls, system, stepper, q0, v0, params, *, dts, duration, num_samples, t0, in_axes, times=None):
        """An error that names what is wrong, or the inputs."""
        require_system("sweep", system)
        require_stepper("sweep", stepper)
        require_params("sweep", params)
        require_number("sweep", "t0", t0, np.isfinite, "be finite")
        require_one_grid(stepper, duration, num_samples, times)
        dts = require_step_sizes(dts)
        (q0, v0), mapped = _initial_values(system, q0, v0, params, stepper, in_axes, dts.size)
        if times is None:
            require_steps_within(dts, 0.0, duration, num_samples)
        else:
            times = require_times(times, t0, jax.tree.leaves(q0)[0].dtype)
            num_samples = times.size
            require_steps_within(dts, t0, times[-1])
        data = stepper, q0, v0, params
        require_capable("sweep", system, stepper, *_member(data, mapped, 0)[1:3])
        if system.constraint is not None:
            _require_consistent(system, data, mapped, t0)
        duration, t0 = (x if x is None or not is_concrete(x) else float(x) for x in (duration, t0))
        return cls(system, data, dts, duration, t0, mapped, int(num_samples), times)

    def chunk(self, members):
        """The same for the members of these numbers."""
        return self._replace(data=_member(self.data, self.mapped, members), dts=self.dts[members])

    def call(self, mesh=None, progress=False):
        """The arguments of `run_sweep`."""
        if mesh is not None and not isinstance(mesh, Mesh):
            raise TypeError(f"sweep: `mesh` must be a jax.sharding.Mesh; received {mesh!r}.")
        data, dts = self.data, self.dts
        if mesh is not None:
            mesh = Mesh(mesh.devices.ravel(), ("members",))  # whatever its shape and its types of axes
            # arrays on one device could not be read by another process
            data, dts = jax.tree.map(lambda x: np.asarray(x) if is_array(x) and is_concrete(x) else x, (data, dts))
        static = {"mapped": self.mapped, "num_samples": self.num_samples, "lanes": _lanes(dts.size)}
        arguments = self.system, data, dts, self.duration, self.t0, self.times
        return arguments, {**static, "mesh": mesh, "progress": progress}

    def run(self, **options):
        """The sweep."""
        arguments, keywords = self.call(**options)
        return run_sweep(*arguments, **keywords)


def _initial_values(system, q0, v0, params, stepper, in_axes, size):
    """q0 and v0, checked, and for each leaf of (stepper, q0, v0, params) whether it has the axis of members."""
    if in_axes is None:
        in_axes = (None,) * 4
    if not isinstance(in_axes, tuple) or len(in_axes) != 4:
        raise ValueError(f"sweep: `in_axes` must be a tuple of four, (stepper, q0, v0, params); received {in_axes!r}.")
    names = "stepper", "q0", "v0", "params"
    trees = dict(zip(names, (stepper, q0, v0, params), strict=True))
    flags = {name: _flags(name, trees[name], axes, size) for name, axes in zip(names, in_axes, strict=True)}
    if v0 is not None and any(flags["q0"] + flags["v0"]) and not all(flags["q0"] + flags["v0"]):
        for name in ("q0", "v0"):
            leaves, structure = jax.tree.flatten(trees[name])
            leaves = [
                x if flag else jnp.broadcast_to(x, (size, *jnp.shape(x)))
                for x, flag in zip(leaves, flags[name], strict=True)
            ]
            trees[name], flags[name] = jax.tree.unflatten(structure, leaves), [True] * len(leaves)
    values = initial_values("sweep", system, trees["q0"], trees["v0"])
    return values, tuple(flag for name in names for flag in flags[name])


def _flags(name, tree, axes, size):
    """For each leaf of `tree` whether it has an axis of members, from a prefix of 0 and None as for `jax.vmap`."""
    try:
        flags = jax.tree.map(lambda axis, part: [axis] * len(jax.tree.leaves(part)), axes, tree, is_leaf=_is_none)
    except (ValueError, TypeError) as error:
        raise ValueError(f"sweep: `in_axes` for {name} must be a prefix of its structure: {error}") from None
    flags = jax.tree.leaves(flags, is_leaf=_is_none)
    for x, flag in zip(jax.tree.leaves(tree), flags, strict=True):
        if flag is not None and (flag != 0 or isinstance(flag, bool)):
            raise ValueError(f"sweep: `in_axes` must hold 0 and None; received {flag!r} for {name}.")
        if flag == 0 and (jnp.ndim(x) == 0 or jnp.shape(x)[0] != size):
            raise ValueError(
                f"sweep: `{name}` must have a leading axis of {size} members, as many as dts, where in_axes is 0; "
                f"received shape {jnp.shape(x)}."
            )
    return [flag == 0 for flag in flags]


def _is_none(x):
    return x is None


def _member(data, mapped, i):
    """One member's part of the data, or, for an array i, that of several."""
    leaves, structure = jax.tree.flatten(data)
    return jax.tree.unflatten(structure, [x[i] if flag else x for x, flag in zip(leaves, mapped, strict=True)])


def _require_consistent(system, data, mapped, t0):
    """An error for the members that are farthest from the constraint, and for the first; tracers pass."""
    leaves, structure = jax.tree.flatten(data)
    if not all(map(is_concrete, leaves)):
        return
    worst = {0}
    if any(mapped):

        def distances(leaves):
            stepper, q0, v0, params = jax.tree.unflatten(structure, leaves)
            _, found = examine(system, q0, v0, t0, params, stepper.redundant)
            return [distance for _, distance in found]

        with jax.ensure_compile_time_eval():  # under jit too
            found = jax.vmap(distances, ([0 if flag else None for flag in mapped],))(leaves)
        worst |= {int(np.argmax(distance)) for distance in found}
    for i in sorted(worst):
        stepper, q0, v0, params = _member(data, mapped, i)
        require_consistent(f"sweep: member {i}", system, q0, v0, t0, params, stepper.redundant)


def _lanes(size):
    """Members in a block: a power of two, so that every block runs the same vector instructions.

    A batch takes half the time of single runs, so blocks have to be short enough for their members to be alike.
    """
    return min(LANES, 1 << (size // BLOCKS).bit_length())


@partial(jax.jit, static_argnames=("mapped", "num_samples", "lanes", "mesh", "progress"))
def run_sweep(system, data, dts, duration, t0, times, *, mapped, num_samples, lanes, mesh, progress):
    """The sweep of `Inputs`, compiled."""
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

    def member(leaves, dt, substeps, longest):
        return _run(system, jax.tree.unflatten(structure, leaves), dt, substeps, longest, t0, num_samples, times)

    def block(leaves, dts, substeps, numbered):
        number, members = numbered
        if progress:
            show_progress(number + 1, rounds, "block")
        mine = [x[members] if flag else x for x, flag in zip(leaves, mapped, strict=True)]
        longest = jnp.max(substeps[members], axis=0)
        return jax.vmap(member, (axes, 0, 0, None))(mine, dts[members], substeps[members], longest)

    def hand(members, *data):
        """The blocks of one device, one after the other."""
        return lax.map(partial(block, *data), (jnp.arange(rounds, dtype=jnp.int32), members[0]))

    if mesh is not None:
        spread, shared = PartitionSpec("members"), PartitionSpec()
        hand = jax.shard_map(
            hand, mesh=mesh, in_specs=(spread, shared, shared, shared), out_specs=spread, check_vma=False
        )
    runs = hand(members, leaves, dts, substeps)
    back = jnp.asarray(np.argsort(dealt.ravel()))[jnp.argsort(order)]
    if mesh is not None:  # gathered before they are put in order: a sum over devices would lose the sign of zeros
        runs = lax.with_sharding_constraint(runs, NamedSharding(mesh, PartitionSpec()))
    runs = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[back], runs)
    if times is None:
        times = t0 + H * jnp.arange(num_samples + 1).astype(dtype)
    return runs._replace(t=jnp.broadcast_to(times, (len(dts), num_samples + 1)))


def _run(system, data, dt, substeps, longest, t0, num_samples, times):
    """One member; it rests from `substeps` to `longest`, where its block still works.

    With `times`, start included, dt, substeps and longest are (K,), and the step is bound anew in each interval.
    """
    stepper, q0, v0, params = data
    flat, q, v = flatten("sweep", system, q0, v0, t0, params)
    intervals = None if times is None else (times[:-1], dt, substeps, longest)
    loop = loop_of(flat, stepper, q, v, t0, params, dt if times is None else dt[0])
    form = on_scalars(loop.advance, loop.carry)
    keep = form.of(loop.keep)

    def pace(run, interval):
        """The step, and how many of them this member takes, and its block."""
        if interval is None:
            return form.of(loop.advance), substeps, longest
        t, h, mine, most = interval
        return form.of(advance_from(flat, stepper, q, params, t, h, run[1])), mine, most

    @checkpoint
    def interval(run, here):
        advance, substeps, longest = pace(run, here)

        def step(i, carry):
            run, info = advance(carry[0])
            new = run, join_info(carry[1], info)
            return jax.tree.map(partial(jnp.where, i < substeps), new, carry)

        run, info = repeat(step, (run, loop.no_info), longest)
        return run, (keep(run[0]), info)

    def samples(carry):
        return lax.scan(interval, carry, intervals, num_samples)

    (_, _, failure), (path, info) = one_kernel(samples, form.tree)
    return as_solution(flat, loop.carry[0], form.joined(path), dt, info, failure)
