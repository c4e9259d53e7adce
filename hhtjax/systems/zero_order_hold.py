"""Held inputs, `sampled(order=0)` in params: they are constant over a step, and jump between two steps.

A step that ends on a jump must not use the new value at its end, and the next step must not use the old value at its
start. Each step therefore uses the value in its middle. If a step ends on a sample of uneven times, the value before it
is the one held until then. The change of the state at a jump is in steppers/stepper.py, `behind_jump`.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.description import Array, PyTree, all_concrete
from hhtjax.systems.sampled import SLOP, Sampled

OFF_GRID = 1e-6  # of a step, from which on a jump within it is told: what it costs is as much of a step's error


class JumpWarning(UserWarning):
    """A held input jumps within a step. The method then has order 1 there, whatever its order is elsewhere."""


def warn_of_jumps(caller: str, params: PyTree, times: np.ndarray, steps: Callable, level: int):
    """Warns with a `JumpWarning` if a held input jumps within a step, as far as the values are known.

    times: (K + 1,), at which steps of any size end. steps: H (J,), the lengths of intervals between two of these -> the
    number of equal steps in each, (J,), or (J, B) in B runs.
    """
    for x in filter(_is_held, jax.tree.leaves(params, is_leaf=_is_held)):
        if not all_concrete((x, times)):
            continue
        jumps = np.asarray(x.jumps(), float)
        jumps = jumps[(times[0] < jumps) & (jumps < times[-1])]
        before = np.searchsorted(times, jumps, side="right") - 1
        length = times[before + 1] - times[before]
        share = (jumps - times[before]) / length
        number = steps(length)
        passed = share[:, None] * (number if number.ndim > 1 else number[:, None])  # steps before the jump
        off = np.max(np.abs(passed - np.round(passed)), axis=1, initial=0) > OFF_GRID
        if np.any(off):
            warnings.warn(
                f"{caller}: a held input, sampled(order=0), jumps at t = {jumps[np.argmax(off)]:.9g}, within a step: "
                "its error falls as dt, not as dt^2. Let steps end at the jumps: by a dt that divides the sampling "
                "period, by dt=(N,), by sweep(times=), or by dt=adaptive(...).",
                JumpWarning,
                stacklevel=level,
            )
            return


def holds(params: PyTree) -> bool:
    """Whether there is a held input among the params."""
    return any(map(_is_held, jax.tree.leaves(params, is_leaf=_is_held)))


def held_at(params: PyTree, t: Array):
    """The params with each held input constant, at its value at t."""
    return _with_held(params, lambda x: x(t))


def before(params: PyTree, t: Array, dt):
    """The params of a step that ends at t."""
    return _with_held(params, lambda x: x.held_before(t, dt)) if holds(params) else params


def passed(params: PyTree, t: Array, last: Array, dt: Array) -> Array:
    """Whether the sample of a held input in a step dt from t differs from the one in the previous step, `last`, which
    ended at t."""
    held = filter(_is_held, jax.tree.leaves(params, is_leaf=_is_held))
    return jnp.any(jnp.stack([x.place_before(t, last) != x.place(t + dt / 2) for x in held]))


def jump_after(params: PyTree, t: Array) -> Array:
    """The time of the first jump after t; inf if there is none."""
    leaves = jax.tree.leaves(params, is_leaf=_is_held)
    t = t + SLOP * float(jnp.finfo(t.dtype).eps) * jnp.abs(t)  # a jump that t is, in its dtype, is over
    times = [x.jump_after(t).astype(t.dtype) for x in leaves if _is_held(x)]
    return jnp.min(jnp.stack([*times, jnp.full_like(t, jnp.inf)]))


def _is_held(x: PyTree) -> bool:
    return isinstance(x, Sampled) and jnp.ndim(x.polynomials) > 1 and jnp.shape(x.polynomials)[1] == 1


def _with_held(params: PyTree, value: Callable):
    return jax.tree.map(lambda x: x.constant(value(x)) if _is_held(x) else x, params, is_leaf=_is_held)
