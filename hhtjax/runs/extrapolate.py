"""Richardson's extrapolation of whole runs, at their common saved times."""

from functools import partial, reduce

import jax
import jax.numpy as jnp

from hhtjax import rotation
from hhtjax.numerics.richardson import richardson, take_out
from hhtjax.systems import kinematics

MOST = 4  # levels; rounding and work grow with each


def extrapolated(run, levels, order, join):
    """The `Solution` without the leading errors in dt of several runs, at the saved times of the first.

    run: k -> the `Solution` with steps of dt/k at the same saved times. order: of the stepper. join: two `Info` of an
    interval into one. Rotations are moved along the one that leads from the coarse to the fine.
    """
    return _combine([run(2**level) for level in range(levels)], order=order, join=join)


@partial(jax.jit, static_argnames=("order", "join"))
def _combine(solutions, order, join):
    first = solutions[0]

    def value(name, combine=None):
        return richardson([getattr(solution, name) for solution in solutions], order, combine)

    turns = first.acceleration is not None  # a first-order system has no rotations
    q = value("q", partial(_positions, first.v) if turns else None)
    rest = {name: value(name) for name in ("v", "acceleration", "multipliers", "z", "zdot")}
    return first._replace(
        q=q,
        **rest,
        info=reduce(join, [solution.info for solution in solutions]),
        failure=_first([solution.failure for solution in solutions]),
    )


def _positions(v, gain, coarse, fine):
    """`take_out` of saved positions."""

    def turn(coarse, fine):
        shape = fine.shape
        beyond = jax.vmap(lambda A, B: rotation.product(B, rotation.exp(gain * rotation.log(rotation.product(A.T, B)))))
        return beyond(*(R.reshape(-1, 3, 3) for R in (coarse, fine))).reshape(shape)

    def leaf(v, coarse, fine):
        return turn(coarse, fine) if kinematics.is_rotation(fine.shape, v.shape) else take_out(gain, coarse, fine)

    return jax.tree.map(leaf, v, coarse, fine)


def _first(failures):
    """The one that comes first in time, its step counted in those of the first run."""
    first = failures[0]
    for level, failure in enumerate(failures[1:], 1):
        step = -(-failure.step // 2**level)
        earlier = (step > 0) & ((first.step == 0) | (step < first.step))
        first = jax.tree.map(partial(jnp.where, earlier), failure._replace(step=step), first)
    return first
