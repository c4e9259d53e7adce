"""A row of N four-bar loops in natural coordinates: one degree of freedom, and N + 1 where all bars are horizontal.

N + 1 cranks stand on pivots A_i = (i l, 0), i = 0 ... N, and N couplers join their ends B_i in a row. All bars are
slender and uniform, of the length l (m) and the mass m (kg); gravity g (m/s^2) acts along -y.

q (N + 1, 2): the points B_i, in m. Phi (2 N + 1,): (length^2 - l^2)/2 of the cranks, then of the couplers. When the
cranks lie along the x axis, so do the couplers. The rank of B = dPhi/dq then falls from 2 N + 1 to N + 1: the
multipliers are not unique, and the loops could fold. The benchmark passes through such a position twice per turn.

While no loop folds, all cranks are at one angle a from the x axis, and

    ((N + 1)/3 + N) l a'' = -((N + 1)/2 + N) g cos a

References:
    Bayo, Avello, Nonlinear Dynamics 5 (1994), 209-231; Gonzalez, Dopico, Lugris, Cuadrado, Multibody Syst. Dyn. 16
    (2006), 179-190: benchmark A02, "N four-bar mechanism".
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from hhtjax.checks import require_integer
from hhtjax.description import Array, PyTree, Real
from hhtjax.scenes import drawings
from hhtjax.scenes.scene import Scene, array
from hhtjax.systems.system import System

GRAVITY = 9.81


def couplers(q: Array) -> Array:
    """A matrix (N + 1, N + 1) with 1 where a coupler joins B_i and B_j."""
    upper = jnp.eye(len(q), k=1, dtype=q.dtype)
    return upper + upper.T


def mass(q: Array, params: PyTree) -> Array:
    """M, constant: a bar contributes m/6 [[2, 1], [1, 2]] to its two ends, in x and in y."""
    joined = couplers(q)
    bars = jnp.sum(joined, axis=0) + 1
    return jnp.kron(params["m"] / 6 * (joined + 2 * jnp.diag(bars)), jnp.eye(2, dtype=q.dtype))


def force(q: Array, v: Array, t: Real, params: PyTree) -> Array:
    """Q: half of each bar's weight at each of its ends."""
    bars = jnp.sum(couplers(q), axis=0) + 1
    weight = params["m"] * params["g"] / 2 * bars
    return jnp.stack([jnp.zeros_like(weight), -weight], axis=1)


def constraint(q: Array, t: Real, params: PyTree) -> Array:
    """Phi: cranks, then couplers."""
    pivots = params["l"] * jnp.arange(len(q), dtype=q.dtype)
    cranks = q - jnp.stack([pivots, jnp.zeros_like(pivots)], axis=1)
    bars = jnp.concatenate([cranks, jnp.diff(q, axis=0)])
    return (jnp.sum(bars**2, axis=1) - params["l"] ** 2) / 2


@drawings.Drawing
def drawing(q, t, params: PyTree):
    """Couplers, cranks, and the ground below each pivot."""
    pivots = [np.array([i * params["l"], 0.0]) for i in range(len(q))]
    side = np.array([0.15 * params["l"], 0.0])
    return [
        drawings.bar(*q),
        *(drawings.bar(pivot, end) for pivot, end in zip(pivots, q, strict=True)),
        *(drawings.ground(x - side, x + side, side[0] / 2, 4) for x in pivots),
    ]


def four_bars(loops: int = 2) -> Scene:
    """A row of N squares of 1 m bars of 1 kg, whose upper bars start at 1 m/s.

    Args:
        loops: N, number of squares.

    Raises:
        ValueError: loops is not a positive integer.

    >>> four_bars(loops=2).q0.tolist()
    [[0.0, 1.0], [1.0, 1.0], [2.0, 1.0]]
    """
    loops = require_integer("four_bars", "loops", loops)
    along = np.arange(loops + 1.0)
    ones = np.ones_like(along)
    params = {"m": 1.0, "l": 1.0, "g": GRAVITY}
    q0, v0 = (array(np.stack(x, axis=1)) for x in ((along, ones), (ones, 0 * ones)))
    return Scene(System(mass, force, constraint), params, q0, v0, 10.0, drawing)
