"""Checks of the arguments of a sweep, and which of them differ between members."""

from __future__ import annotations

import math
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from hhtjax.checks import notes_on_lists, require_integer, require_number, require_params
from hhtjax.description import Array, PyTree, Real, all_concrete, is_array, is_concrete, is_real, known_now
from hhtjax.runs.adaptive import Adaptive, lengths, require_controlled
from hhtjax.runs.inputs import (
    Problem,
    equal_times,
    refused_members,
    require_events,
    require_sample_times,
)
from hhtjax.steppers.stepper import require_capable, require_stepper, require_system
from hhtjax.steppers.variable_step import GROWTH
from hhtjax.systems import zero_order_hold
from hhtjax.systems.held_nodes import require_held_start
from hhtjax.systems.initial_conditions import distances, examine, initial_values, require_consistent, with_known_rows
from hhtjax.systems.system import require_masses

if TYPE_CHECKING:
    from hhtjax.steppers.stepper import Stepper
    from hhtjax.systems.linear_system import LinearSystem
    from hhtjax.systems.system import System

LANES, BLOCKS = 128, 32  # members in a block at most; blocks, where there are fewer members than that takes
VECTORS = 32  # members, of fewer of which LLVM often writes loops out, one member after the other
NUMBERS = 4095  # in the matrices of a block; more are slower, and may keep XLA from making one kernel of the steps
ALIKE = 1.5  # times the number of steps
NAMES = "stepper", "q0", "v0", "params", "z0"  # of what may differ


class Inputs(NamedTuple):
    """The checked arguments of a sweep: `data` is (stepper, q0, v0, params, z0), `mapped` says which leaves differ
    between members. With an `Adaptive` as dts, times are given."""

    system: Any
    data: PyTree
    dts: Any
    duration: Real
    t0: Real
    mapped: tuple
    num_samples: int
    times: Any
    size: int
    events: Any = None
    room: tuple = ()
    output: PyTree = None

    @classmethod
    def checked(
        cls,
        system,
        stepper: Stepper,
        q0: PyTree,
        v0: PyTree,
        params: PyTree,
        *,
        dts: PyTree,
        duration: Real,
        num_samples,
        t0: Real,
        in_axes: tuple | None,
        times: PyTree = None,
        z0: PyTree = None,
    ) -> Inputs:
        """The inputs; raises an error that says what is wrong."""
        require_system("sweep", system, massless=True)
        require_stepper("sweep", stepper)
        params = require_params("sweep", params)
        if zero_order_hold.holds(params):
            require_masses("sweep", system, "leave out held inputs, sampled(order=0)")
        require_number("sweep", "t0", t0, np.isfinite, "be finite")
        require_one_grid(stepper, duration, num_samples, times)
        if isinstance(dts, Adaptive):
            require_controlled("sweep", stepper, system)
            stepper = stepper.for_tolerance(dts.rtol)
            require_masses("sweep", system, "take steps without error control")
            size = _members(dts, dict(zip(NAMES, (stepper, q0, v0, params, z0), strict=True)), in_axes)
        else:
            dts = require_step_sizes(dts)
            size = dts.size
        (q0, v0, z0), mapped = _initial_values(system, q0, v0, params, z0, stepper, in_axes, size)
        if isinstance(dts, Adaptive):
            times = equal_times(t0, duration, num_samples) if times is None else times
            times = require_sample_times(times, t0, jax.tree.leaves(q0)[0].dtype)
            num_samples = times.size
        elif times is None:
            require_steps_within(dts, 0.0, duration, num_samples)
        else:
            times = require_sample_times(times, t0, jax.tree.leaves(q0)[0].dtype)
            num_samples = times.size
            require_steps_within(dts, t0, times[-1])
        data = stepper, q0, v0, params, z0
        if zero_order_hold.holds(params) and not isinstance(dts, Adaptive):
            _warn_of_jumps(params, t0, equal_times(t0, duration, num_samples) if times is None else times, dts)
        require_capable("sweep", system, stepper, *_member(data, mapped, 0)[1:3])
        _, q, v, p, z = _member(data, mapped, 0)
        require_held_start("sweep", system, q, v, t0, p)
        if system.constraint is not None:
            _require_consistent(system, data, mapped, t0)
        if system.friction is not None:
            system = with_known_rows("sweep", system, q, v, t0, p, z)
        duration, t0 = (x if x is None or not is_concrete(x) else float(x) for x in (duration, t0))
        return cls(system, data, dts, duration, t0, mapped, int(num_samples), times, size)

    def with_events(self, events, max_events: int, keep_events: int) -> Inputs:
        """The inputs with events, which are checked for each member."""
        room = require_integer("sweep", "max_events", max_events), require_integer("sweep", "keep_events", keep_events)
        if events is None:
            return self

        def problem_of(data: PyTree) -> Problem:
            stepper, q0, v0, params, z0 = data
            return Problem(self.system, stepper, q0, v0, params, self.t0, z0)

        if isinstance(self.dts, Adaptive):
            assert self.times is not None
            steps = jnp.full(self.size, (self.times[-1] - self.t0) / 1000)
        else:
            steps = self.dts

        def require(i: int):
            where = f"sweep: member {i}" if any(self.mapped) else "sweep"
            return require_events(where, problem_of(_member(self.data, self.mapped, i)), events, steps[i])

        events = require(0)
        leaves, structure = jax.tree.flatten(self.data)
        if any(self.mapped) and all_concrete((self.system, leaves, self.t0, events)):
            axes = [0 if flag else None for flag in self.mapped]
            for i in refused_members(lambda x: problem_of(structure.unflatten(x)), leaves, axes, events, steps)[:1]:
                require(i)
        return self._replace(events=events, room=room)

    @contextmanager
    def telling_of_axes(self):
        """Replaces an error about shapes if `in_axes` is missing and some arrays are as long as there are members, by
        one that names these arrays."""
        try:
            yield
        except (TypeError, ValueError) as error:
            long = [
                f"{name}{jax.tree_util.keystr(path)}"
                for name, tree in zip(NAMES, self.data, strict=True)
                for path, x in jax.tree_util.tree_leaves_with_path(tree)
                if jnp.shape(x)[:1] == (self.size,)
            ]
            if self.size > 1 and long and not any(self.mapped):
                raise (TypeError if isinstance(error, TypeError) else ValueError)(
                    f"sweep: `in_axes` must say which arrays have one row for each of the {self.size} members, as "
                    f"{', '.join(long)} may: in_axes=(stepper, q0, v0, params), each 0 where all its arrays have, "
                    f"None where members share it, or a pytree of these; received None. Else: {error}"
                ) from error
            raise

    def chunk(self, members):
        """The inputs of the members with these indices."""
        dts = self.dts[members]
        return self._replace(data=_member(self.data, self.mapped, members), dts=dts, size=dts.size)

    def sizes(self):
        """The number of entries of the position of a member, and the number of its rates."""
        leaves, structure = jax.tree.flatten(self.data)
        sizes = [math.prod(jnp.shape(x)[flag:]) for x, flag in zip(leaves, self.mapped, strict=True)]
        numbers, rates = (sum(jax.tree.leaves(x)) for x in structure.unflatten(sizes)[1:3])
        return numbers, rates or numbers

    def call(self, mesh=None, progress: bool = False):
        """The arguments and keywords of `run_sweep`, which also determine its program."""
        if mesh is not None and not isinstance(mesh, Mesh):
            raise TypeError(f"sweep: `mesh` must be a jax.sharding.Mesh; received {mesh!r}.")
        data, dts = self.data, self.dts
        if mesh is not None:
            mesh = Mesh(mesh.devices.ravel(), ("members",))  # whatever its shape and its types of axes
            # arrays on one device could not be read by another process
            data, dts = jax.tree.map(lambda x: np.asarray(x) if is_array(x) and is_concrete(x) else x, (data, dts))
        hands = 1 if mesh is None else mesh.size
        unknowns, rates = self.sizes()
        lanes = lanes_for(self.size, least_lanes(self.size, unknowns, hands) if are_alike(dts) else 1)
        static = {"mapped": self.mapped, "num_samples": self.num_samples, "lanes": lanes}
        fitting = {"rates": rates, "numbers": unknowns if lanes > 1 else None}
        arguments = self.system, data, dts, self.duration, self.t0, self.times, self.events, self.output
        static["grows"] = self.times is not None and may_grow(self.dts, self.t0, self.times)
        return arguments, {**static, **fitting, "mesh": mesh, "progress": progress, "room": self.room}


def lanes_for(size: int, least: int = 1) -> int:
    """Members in a block: a power of two, so that every block runs the same vector instructions.

    A block takes as long as its slowest member, so blocks should be short enough that their members take about the same
    number of steps. If all members are alike, blocks are not shorter than `least`.
    """
    return min(LANES, max(1 << (size // BLOCKS).bit_length(), least))


def least_lanes(size: int, unknowns: int, hands: int = 1) -> int:
    """The block size for members that are alike: as many as vector instructions handle efficiently, if this does not
    increase the work of a device."""
    if size < 2 * VECTORS:
        return 1
    most = max(VECTORS, min(LANES, NUMBERS // max(unknowns, 1) ** 2))
    choices = [VECTORS << i for i in reversed(range((most // VECTORS).bit_length()))]
    return min(choices, key=lambda lanes: -(-size // (lanes * hands)) * lanes)


def are_alike(dts: Real) -> bool:
    """Whether members are known to take about the same number of steps."""
    if not is_concrete(dts):
        return False
    dts = np.asarray(dts)  # inside a jit, what is done to an array of JAX would be traced
    return float(np.max(dts)) <= ALIKE * float(np.min(dts))


def _members(control: Adaptive, trees: PyTree, in_axes) -> int:
    """The number of members of a sweep under error control: the number of tolerances, or of other values that
    differ."""
    if sizes := lengths(jax.tree.leaves(control)):
        return sizes[0]
    for (name, tree), axes in zip(trees.items(), in_axes if isinstance(in_axes, tuple) else (), strict=False):
        for x, flag in zip(jax.tree.leaves(tree), _flags(name, tree, axes), strict=True):
            if flag and jnp.ndim(x):
                return jnp.shape(x)[0]
    raise ValueError("sweep: with dts=adaptive(...), give an array (B,) of tolerances, or `in_axes`, else none differ.")


def _initial_values(
    system: LinearSystem | System,
    q0: PyTree,
    v0: PyTree,
    params: PyTree,
    z0: PyTree,
    stepper: Stepper,
    in_axes: tuple | None,
    size: int,
):
    """q0, v0, z0, checked, and for each leaf of (stepper, q0, v0, params, z0) whether it has the axis of members."""
    if in_axes is None:
        in_axes = (None,) * 4
    if not isinstance(in_axes, tuple) or len(in_axes) not in (4, 5):
        raise ValueError(
            "sweep: `in_axes` must be a tuple of four, (stepper, q0, v0, params), or of five, with z0; "
            f"received {in_axes!r}."
        )
    trees = dict(zip(NAMES, (stepper, q0, v0, params, z0), strict=True))
    in_axes = (*in_axes, None)[:5]
    flags = {name: _flags(name, trees[name], axes, size) for name, axes in zip(NAMES, in_axes, strict=True)}
    if v0 is not None and any(flags["q0"] + flags["v0"]) and not all(flags["q0"] + flags["v0"]):
        for name in ("q0", "v0"):
            leaves, structure = jax.tree.flatten(trees[name])
            leaves = [
                x if flag else jnp.broadcast_to(x, (size, *jnp.shape(x)))
                for x, flag in zip(leaves, flags[name], strict=True)
            ]
            trees[name], flags[name] = jax.tree.unflatten(structure, leaves), [True] * len(leaves)
    values = initial_values("sweep", system, trees["q0"], trees["v0"], z0)
    return values, tuple(flag for name in NAMES for flag in flags[name])


def axis_of_each(axes: PyTree, tree: PyTree) -> list:
    """For each leaf of `tree` the value of a prefix of it, such as the axes of `jax.vmap`; ValueError or TypeError if
    it is not a prefix."""
    spread = jax.tree.map(lambda axis, part: [axis] * len(jax.tree.leaves(part)), axes, tree, is_leaf=_is_none)
    return jax.tree.leaves(spread, is_leaf=_is_none)


def _flags(name: str, tree: PyTree, axes: PyTree, size: int | None = None):
    """For each leaf of `tree` whether it has an axis of members, from a prefix of 0 and None as for `jax.vmap`."""
    try:
        flags = axis_of_each(axes, tree)
    except (ValueError, TypeError):
        like, received = jax.tree.structure(tree), jax.tree.structure(axes, is_leaf=_is_none)
        raise ValueError(
            f"sweep: `in_axes` for {name} must be a prefix of its structure, {like}; received {received}."
        ) from None
    for (path, x), flag in zip(jax.tree_util.tree_leaves_with_path(tree), flags, strict=True):
        if flag is not None and (flag != 0 or isinstance(flag, bool)):
            raise ValueError(f"sweep: `in_axes` must hold 0 and None; received {flag!r} for {name}.")
        if size is not None and flag == 0 and (jnp.ndim(x) == 0 or jnp.shape(x)[0] != size):
            error = ValueError(
                f"sweep: `{name}{jax.tree_util.keystr(path)}` must have a leading axis of {size} members, as many as "
                f"dts, where in_axes is 0; received shape {jnp.shape(x)}."
            )
            for note in notes_on_lists("sweep", name, tree):
                error.add_note(note)
            raise error
    return [flag == 0 for flag in flags]


def _is_none(x: PyTree) -> bool:
    return x is None


def _member(data: PyTree, mapped: tuple, i: int):
    """The data of one member; for an array i, those of several."""
    leaves, structure = jax.tree.flatten(data)
    return jax.tree.unflatten(structure, [x[i] if flag else x for x, flag in zip(leaves, mapped, strict=True)])


def _require_consistent(system, data: PyTree, mapped: tuple, t0: Real):
    """Raises an error that names the members farthest from the constraint, and the first one; tracers pass."""
    leaves, structure = jax.tree.flatten(data)
    worst = {0}
    if any(mapped):

        def examined(leaves: list):
            _, q0, v0, params, z0 = jax.tree.unflatten(structure, leaves)
            return examine(system, q0, v0, t0, params, z0)

        every = known_now(jax.vmap(examined, ([0 if flag else None for flag in mapped],)), leaves)
        if every is None:
            return
        found = distances(every, data[0].redundant)
        worst |= {int(np.argmax(relative)) for _, _, relative, _ in found}
    for i in sorted(worst):
        stepper, q0, v0, params, z0 = _member(data, mapped, i)
        require_consistent(f"sweep: member {i}", system, q0, v0, t0, params, stepper.redundant, z0)


def _warn_of_jumps(params: PyTree, t0: Real, times: np.ndarray, dts: np.ndarray):
    """Warns if a held input that the members share jumps within a step of one of them."""
    if all_concrete((t0, times, dts)):
        dts = np.unique(np.asarray(dts, float))
        times = np.append(np.asarray(t0, float), np.asarray(times, float))
        zero_order_hold.warn_of_jumps(
            "sweep", params, times, lambda H: np.maximum(np.ceil(H[:, None] / dts * (1 - 1e-9)), 1), 5
        )


# ----------------------------------------------------------------------------
# The steps of members, which land on the samples.


def require_one_grid(stepper: Stepper, duration: Real, num_samples: int | None, times: PyTree):
    """Raises an error unless the samples are given in one of the two ways, and the stepper supports it."""
    given = [x is not None for x in (duration, num_samples, times)]
    if given not in ([True, True, False], [False, False, True]):
        raise TypeError(
            "sweep: give `duration` and `num_samples`, or `times` alone; "
            f"received duration={duration!r}, num_samples={num_samples!r}, times={times!r}."
        )
    if times is not None:
        if stepper.needs_equal_steps:
            raise NotImplementedError(
                f"sweep: {stepper.name} needs steps of one size, which differ between `times`: give "
                "`duration` and `num_samples`, or another stepper."
            )
        return
    require_integer("sweep", "num_samples", num_samples)
    require_number("sweep", "duration", duration, lambda x: np.isfinite(x) and x > 0, "be positive and finite")


def require_step_sizes(dts: PyTree) -> Real:
    """dts as an array (B,)."""
    dts = dts if is_array(dts) else np.asarray(dts)
    if not is_real(dts):
        raise TypeError(f"sweep: `dts` must be real numbers; received {dts!r}.")
    if dts.ndim != 1 or not dts.size:
        raise ValueError(f"sweep: `dts` must have shape (B,), one step size for each member; received {dts.shape}.")
    return dts


def require_steps_within(dts: Real, start: float, end: Real, num_samples: int | None = None):
    """Raises an error for step sizes that are not positive, take too many steps, or exceed the spacing of equal
    samples."""
    if not all_concrete((dts, start, end)):
        return
    h, span = np.asarray(dts, float), float(end) - float(start)
    limit, at_most = np.inf, ""
    if num_samples is not None:
        limit = span / num_samples
        at_most = (
            f", and at most {limit:.6g}, the distance of the samples (duration={span:.6g}, num_samples={num_samples})"
        )
    fine = (h > 0) & (h <= limit * (1 + 1e-6))
    if not fine.all():
        bad = int(np.argmin(fine))
        raise ValueError(f"sweep: `dts` must be positive{at_most}; received dts[{bad}] = {h[bad]:.6g}.")
    if span / h.min() >= 2**31:
        raise ValueError(f"sweep: `dts` must take fewer than 2^31 steps; received dts[{h.argmin()}] = {h.min():.6g}.")


def fit_to_samples(dts: Array, H: Array):
    """The numbers of steps between two samples, and the step sizes; NaN if a traced dt is not in (0, H]."""
    slack = 64 * float(jnp.finfo(dts.dtype).eps)
    return _fit(dts, H, (dts > 0) & (dts <= H * (1 + 1e-6)), slack)


def fit_to_times(dts: Array, times: Array):
    """As `fit_to_samples`, for each interval, (B, K); NaN if a traced dt is not positive, or a time not after the
    previous one."""
    H, eps = jnp.diff(times), float(jnp.finfo(dts.dtype).eps)
    increasing = (H > 0) & jnp.isfinite(H)
    H = jnp.where(increasing, H, 1)
    size = jnp.where(increasing, jnp.maximum(jnp.abs(times[1:]), jnp.abs(times[:-1])), 0)
    slack = eps * (64 + 4 * size / H)  # H is a difference of rounded times
    return jax.vmap(lambda dt: _fit(dt, H, (dt > 0) & increasing, slack))(dts)


def may_grow(dts: np.ndarray, t0: Real, times: np.ndarray) -> bool:
    """Whether a step may be too long compared with the previous one, as after a short interval; True if it is not
    known."""
    if not all_concrete((dts, t0, times)):
        return True
    H = np.diff(np.asarray(times, float), prepend=float(t0))
    return bool(np.any(np.minimum(H[1:], np.max(dts)) > GROWTH * H[:-1]))


def _fit(dts: Array, H: Array, fine: Array, slack: Real):
    """The smallest numbers of steps in H that are not longer than dts, up to a slack, and their sizes."""
    substeps = jnp.maximum(jnp.ceil(H / jnp.where(fine, dts, H) * (1 - slack)), 1).astype(jnp.int32)
    return substeps, jnp.where(fine, H / substeps.astype(dts.dtype), jnp.nan)
