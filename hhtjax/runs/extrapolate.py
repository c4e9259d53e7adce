"""Richardson's extrapolation of whole runs, at their common saved times."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial, reduce
from itertools import pairwise
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from hhtjax import rotation
from hhtjax.description import Array, PyTree
from hhtjax.runs.interpolate import on_axes
from hhtjax.runs.solution import DIFFER
from hhtjax.systems import kinematics
from hhtjax.xla import Programs

if TYPE_CHECKING:
    from hhtjax.runs.solution import Failure, Solution

MOST = 4  # levels; rounding and work grow with each


def extrapolated(run: Callable, levels: int, order: int, join: Callable) -> Solution:
    """The `Solution` at the saved times of the first run, with the leading errors in dt removed by several runs.

    run: k -> the `Solution` with steps of dt/k at the same saved times. order: of the stepper. join: combines two
    `Info` of an interval. Rotations are extrapolated along the rotation from the coarse to the fine one.
    """
    return _combine([run(2**level) for level in range(levels)], order=order, join=join)


@partial(Programs, static_argnames=("order", "join"))
def _combine(solutions: list, order: int, join: Callable) -> Solution:
    first, finest = solutions[0], solutions[-1]
    together = None if first.events is None else _together(solutions)

    def value(name: str, combine: Callable | None = None):
        better = richardson([getattr(solution, name) for solution in solutions], order, combine)
        if together is None:
            return better
        return jax.tree.map(lambda x, y: jnp.where(on_axes(together, y), x, y), better, getattr(finest, name))

    turns = first.acceleration is not None  # a first-order system has no rotations
    q = value("q", partial(_positions, first.v) if turns else None)
    rest = {name: value(name) for name in ("v", "acceleration", "multipliers", "z", "zdot")}
    rest["output"] = value("output", _outputs)
    if first.friction is not None:  # which jump, at times that each run has for itself
        rest |= {name: getattr(finest, name) for name in ("friction", "sticking")}
    failure = _first([solution.failure for solution in solutions])
    if first.events is not None:
        rest["t"] = value("t")  # behind a terminal event its time
        combine = None if first.events.q is None else partial(_positions, first.events.before)
        rest["events"], same = _events([solution.events for solution in solutions], order, combine)
        failure = _told_apart(first, failure, same)
    return first._replace(q=q, **rest, info=reduce(join, [solution.info for solution in solutions]), failure=failure)


def _together(solutions: list) -> Array:
    """For each saved time, whether the same number of events lies before it in all runs. Otherwise some runs are after
    a jump there and others before it."""
    before = [jnp.sum(run.events.t[None, :] <= run.t[:, None], axis=1, dtype=jnp.int32) for run in solutions]
    return reduce(jnp.logical_and, [number == before[-1] for number in before])


def _events(runs: list, order: int, combine):
    """The `Events` without their leading errors, and whether all runs have the same events. combine: for their
    positions."""
    finest = runs[-1]
    names = "t", "before", "after", "z", "rate"
    better = {name: richardson([getattr(events, name) for events in runs], order) for name in names}
    better["q"] = richardson([events.q for events in runs], order, combine)
    same = [(events.which == finest.which) & (events.count == finest.count) for events in runs]
    return finest._replace(**better), reduce(jnp.logical_and, same)


def _told_apart(first: Solution, failure: Failure, same: Array) -> Failure:
    """The failure, or the failure that the runs have different events."""
    differ = ~jnp.all(same) & (failure.step == 0)
    here = jnp.argmin(same)
    ahead = jnp.maximum(first.events.t[here] - first.t[0], 0)
    dt = first.dt
    step = jnp.ceil(ahead / dt) if dt.ndim == 0 else 1 + jnp.sum(jnp.cumsum(dt) < ahead)
    step = jnp.maximum(jnp.nan_to_num(step, nan=1), 1).astype(failure.step.dtype)
    new = failure._replace(step=step, event=jnp.full_like(failure.event, DIFFER), guard=first.events.which[here])
    return jax.tree.map(partial(jnp.where, differ), new, failure)


def _positions(v: PyTree, gain: float, coarse: PyTree, fine: PyTree) -> PyTree:
    """`take_out` for saved positions."""

    def turn(coarse: Array, fine: Array) -> Array:
        shape = fine.shape
        beyond = jax.vmap(lambda A, B: rotation.product(B, rotation.exp(gain * rotation.log(rotation.product(A.T, B)))))
        return beyond(*(R.reshape(-1, 3, 3) for R in (coarse, fine))).reshape(shape)

    def leaf(v: Array, coarse: Array, fine: Array) -> Array:
        return turn(coarse, fine) if kinematics.is_rotation(fine.shape, v.shape) else take_out(gain, coarse, fine)

    return jax.tree.map(leaf, v, coarse, fine)


def _outputs(gain: float, coarse, fine):
    """`take_out` for the results of a user's function. Flags and integers are those of the finest run."""

    def leaf(coarse, fine):
        return take_out(gain, coarse, fine) if jnp.issubdtype(fine.dtype, jnp.floating) else fine

    return jax.tree.map(leaf, coarse, fine)


def _first(failures: list) -> Failure:
    """The earliest failure, with its step counted in steps of the first run."""
    first = failures[0]
    for level, failure in enumerate(failures[1:], 1):
        step = -(-failure.step // 2**level)
        earlier = (step > 0) & ((first.step == 0) | (step < first.step))
        first = jax.tree.map(partial(jnp.where, earlier), failure._replace(step=step), first)
    return first


# ----------------------------------------------------------------------------
# Richardson's extrapolation over the step size.


def richardson(values: list, order: int, combine: Callable | None = None):
    """Richardson extrapolation of pytrees computed with h, h/2, h/4, ..., with errors h^order, h^(order + 1), ...

        fine + (fine - coarse)/(2^p - 1),    p = order, order + 1, ...

    combine: (gain, coarse, fine) -> fine + gain (fine - coarse); it replaces this formula on each leaf.

    >>> [round(richardson([1 + h**2 + h**3 for h in (0.4, 0.2, 0.1)][:levels], 2), 6) + 0.0 for levels in (2, 3)]
    [0.989333, 1.0]
    """
    combine = combine or _on_leaves
    while len(values) > 1:
        gain = 1 / (2**order - 1)
        values = [combine(gain, coarse, fine) for coarse, fine in pairwise(values)]
        order += 1
    return values[0]


def _on_leaves(gain: float, coarse: PyTree, fine: PyTree):
    return jax.tree.map(partial(take_out, gain), coarse, fine)


def take_out(gain: float, coarse: Array, fine: Array) -> Array:
    """The value without the leading error that both have."""
    return fine + gain * (fine - coarse)
