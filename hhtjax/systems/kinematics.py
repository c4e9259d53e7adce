"""Positions with rotations: how a displacement changes them, and how its rates are related to velocities.

A leaf R (..., 3, 3) of q whose leaf of v is Om (..., 3) is a rotation, Rdot = R hat(Om). For all other leaves qdot = v.
A displacement x (n,) is structured like v; for a rotation it is the rotation vector of the increment.

    q (+) x = q + x,  or  R exp(x)

In chart form the recursion of a step runs on the rotation vector psi from R_n, with psidot and psiddot, and

    Om = T(psi) psidot,    A = T(psi) psiddot + Tdot psidot

give the angular velocity and acceleration at its end (Cardona, Geradin 1989, Eq. 69-71). In Lie form, Om and A are used
directly instead of psidot and psiddot.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from hhtjax import rotation
from hhtjax.description import Array, PyTree, Real
from hhtjax.numerics.dense_lu import matvec


class Block(NamedTuple):
    """A block of adjacent coordinates: plain ones, or rotations, each with 9 numbers in q and 3 in v."""

    is_rotation: bool
    q: slice
    v: slice


def layout(q0: PyTree, v0: PyTree):
    """The blocks of the flat vectors of q0 and v0; empty if there are no rotations."""
    blocks, nq, nv = [], 0, 0
    for R, Om in zip(jax.tree.leaves(q0), jax.tree.leaves(v0), strict=True):
        q, v = slice(nq, nq + R.size), slice(nv, nv + Om.size)
        blocks.append(Block(R.size > 0 and is_rotation(R.shape, Om.shape), q, v))
        nq, nv = q.stop, v.stop
    return tuple(blocks) if any(block.is_rotation for block in blocks) else ()


def is_rotation(q_shape: tuple, v_shape: tuple) -> bool:
    """Whether leaves of these shapes are rotations (..., 3, 3) with their angular velocities (..., 3)."""
    return q_shape[-2:] == (3, 3) and v_shape == q_shape[:-1]


def move(blocks: tuple, q: Array, x: Array) -> Array:
    """q (+) x."""
    return _each(blocks, jnp.add, lambda R, psi: rotation.product(R, rotation.exp(psi)), q, x)


def rate(blocks: tuple, q: Array, v: Array) -> Array:
    """qdot: linear in v."""
    return _each(blocks, lambda q, v: v, lambda R, Om: rotation.product(R, rotation.hat(Om)), q, v)


def terms(blocks: tuple, q0: PyTree, q1: Array, x: Array) -> Array:
    """The sizes of the terms of q1, which is the sum of q0 and a displacement of at most x: (n,) for positions, 1 for
    rotations."""
    return _each(blocks, lambda q0, q1, x: jnp.abs(q0) + jnp.abs(q1) + x, lambda R, *_: jnp.ones_like(R), q0, q1, x)


def sizes(blocks: tuple, q: Array) -> Array:
    """The sizes of displacements, (n,): |q| for positions, and one radian for rotations."""
    return _each(blocks, jnp.abs, lambda R: jnp.ones(3, R.dtype), q)


def orthonormalize(blocks: tuple, q: Array) -> Array:
    """q with the rounding errors of its rotations squared, that is, practically removed."""
    return _each(blocks, lambda q: q, rotation.orthonormalize, q)


def pull_back(blocks: tuple, x: Array, Q: Array) -> Array:
    """The force conjugate to the rate of the displacement x: Q, and T(x)^T Q for rotations."""
    return _each(blocks, lambda Q, x: Q, lambda Q, psi: matvec(rotation.tangent(psi).T, Q), Q, x)


def chart_jerk(blocks, v, w, wdot) -> Array:
    """The third rate of the displacement at x = 0: the second rate of v, and wdot + Om x w/2 for rotations."""
    return _each(blocks, lambda wdot, v, w: wdot, lambda wdot, Om, w: wdot + rotation.cross(Om, w) / 2, wdot, v, w)


def end_of_chart(blocks: tuple, x: Array, v: Array, w: Array, a: Array):
    """Velocity, acceleration and algorithmic acceleration, from first and second rates of the displacement x."""
    if not blocks:
        return v, w, a

    def turn(psi: Array, psidot: Array, w: Array, a: Array):
        T, convective = rotation.tangent(psi), rotation.tangent_rate(psi, psidot)
        return matvec(T, psidot), matvec(T, w) + convective, matvec(T, a) + convective

    ends = []
    for block in blocks:
        pieces = [y[block.v] for y in (x, v, w, a)]
        ends.append(_turned(turn, *(y.reshape(-1, 3) for y in pieces)) if block.is_rotation else pieces[1:])
    return tuple(jnp.concatenate([y.ravel() for y in parts]) for parts in zip(*ends, strict=True))


def in_chart(blocks: tuple, x: Array, v: Array, w: Array) -> Array:
    """The second rate of the displacement x, given its first rate v and the acceleration w; the inverse of
    `end_of_chart`."""

    def turn(w: Array, psi: Array, psidot: Array) -> Array:
        return matvec(rotation.inverse_tangent(psi), w - rotation.tangent_rate(psi, psidot))

    return _each(blocks, lambda w, x, v: w, turn, w, x, v)


def hermite(rise: Array, d0: Array, d1: Array, s: Array) -> Array:
    """The cubic in s from 0 at 0 to `rise` at 1, with the slopes d0 and d1 there."""
    return s * (d0 + s * (3 * rise - 2 * d0 - d1 + s * (d0 + d1 - 2 * rise)))


def hermite_rate(rise: Array, d0: Array, d1: Array, s: Array) -> Array:
    """The slope of the cubic."""
    return d0 + s * (2 * (3 * rise - 2 * d0 - d1) + s * (3 * (d0 + d1 - 2 * rise)))


def interpolate_rotation(R0: Array, R1: Array, d0: Array, d1: Array, s: Array) -> Array:
    """R0 exp(psi(s)) with the cubic psi that ends in R1; d0, d1 (..., 3): angular velocities times the interval."""

    def between(R0: Array, R1: Array, d0: Array, d1: Array, s: Array) -> Array:
        psi = rotation.log(rotation.product(R0.T, R1))
        slope = matvec(rotation.inverse_tangent(psi), d1)
        return rotation.product(R0, rotation.exp(hermite(psi, d0, slope, s)))

    shape = R0.shape
    s = jnp.broadcast_to(s, d0.shape)
    R = jax.vmap(between)(*(y.reshape(-1, 3, 3) for y in (R0, R1)), *(y.reshape(-1, 3) for y in (d0, d1, s)))
    return R.reshape(shape)


def _each(blocks: tuple, plain: Callable, turn: Callable, *vectors):
    """`plain` on the plain blocks of vectors like q or like v, `turn` on each rotation, joined again."""
    if not blocks:
        return plain(*vectors)
    length = blocks[-1].q.stop  # of q, longer than v
    parts = []
    for block in blocks:
        pieces = [y[block.q if y.size == length else block.v] for y in vectors]
        if block.is_rotation:
            shapes = [(-1, 3, 3) if y.size == length else (-1, 3) for y in vectors]
            parts.append(_turned(turn, *(y.reshape(shape) for y, shape in zip(pieces, shapes, strict=True))).ravel())
        else:
            parts.append(plain(*pieces))
    return jnp.concatenate(parts)


def _turned(turn: Callable, *arrays: Real) -> PyTree:
    """`turn` on each of several rotations; a single one is done without vmap, which compiles less."""
    return turn(*(y[0] for y in arrays)) if len(arrays[0]) == 1 else jax.vmap(turn)(*arrays)
