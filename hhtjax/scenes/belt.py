"""Two masses on a moving belt, each on a spring, with a third spring between them: they stick to the belt and slip.

s = v - u,    |tau_i| <= F_i (1 + stiction exp(-|s_i|/vs))
"""

from __future__ import annotations

import jax.numpy as jnp

from hhtjax.description import PyTree
from hhtjax.scenes import drawings
from hhtjax.scenes.scene import Scene, array
from hhtjax.systems.system import System


def mass(q, params: PyTree):
    """M, a diagonal."""
    return params["m"]


def force(q, v, t, params: PyTree):
    """Q, without the friction."""
    spring = params["between"] * (q[1] - q[0]) * jnp.array([1.0, -1.0], q.dtype)
    return spring - params["k"] * q - params["c"] * v


def sliding(q, v, t, params: PyTree):
    """Velocities relative to the belt."""
    return v - params["u"]


def limit(q, v, t, params: PyTree):
    """F, with a Stribeck curve."""
    return params["F"] * (1 + params["stiction"] * jnp.exp(-jnp.abs(sliding(q, v, t, params)) / params["vs"]))


@drawings.Drawing
def drawing(q, t, params: PyTree):
    """The blocks on the belt, whose hatches move with it. When the springs are at rest, the blocks are 0.5 m apart."""
    size, wall = 0.2, -0.5
    first, second = q[0], q[1] + 0.5
    low, middle = 0.3 * size, 0.6 * size  # heights of the springs
    return [
        drawings.block((first, size / 2), size, size),
        drawings.block((second, size / 2), size, size),
        drawings.spring((wall, middle), (first - size / 2, middle), 0.3 * size),
        drawings.spring((first + size / 2, low), (second - size / 2, low), 0.3 * size),
        drawings.spring((second + size / 2, middle), (1.0, middle), 0.3 * size),
        drawings.wall_at(wall, size, -1),
        drawings.wall_at(1.0, size, 1),
        drawings.ground((-0.4, 0.0), (0.9, 0.0), 0.04, 13, shift=params["u"] * t / 0.1),
    ]


def two_masses() -> Scene:
    """A motion with 25 switches between sticking and slipping in 5 s (SI units)."""
    params = {
        "m": array([1.0, 0.7]), "k": array([30.0, 50.0]), "between": 40.0, "c": 0.05, "u": 0.3,
        "F": array([5.0, 4.0]), "stiction": 0.5, "vs": 0.1,
    }  # fmt: skip
    system = System(mass, force, friction=limit, sliding=sliding)
    return Scene(system, params, array([0.1, 0.0]), array([0.0, 0.0]), 5.0, drawing)
