"""Coulomb's law of a few contacts in a plane as a linear complementarity problem, for forces and for impulses.

    y + K f,   f_N >= 0,   (y + K f)_N >= 0,   of each contact one is 0
    |f_T| <= mu (f_N + off),   opposite to (y + K f)_T where that is not 0

f_T is written as the difference of two parts >= 0, and each contact has a sliding speed >= 0 as another unknown. This
gives 4 m rows with a copositive matrix, for which Lemke's method finds a solution (Stewart, Trinkle 1996). If rows are
dependent, the forces are not unique, and one solution is returned.
"""

from __future__ import annotations

from functools import reduce
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax

from hhtjax.description import Array
from hhtjax.numerics.complementarity import complement
from hhtjax.numerics.dense_lu import diagonal, product, with_slope

PROXIMAL = 1e-9  # of a row, added to its diagonal: contacts may depend on each other; in float32 100 roundings


def proximal(dtype: Any) -> float:
    """The part of a row that is added to its diagonal: large beside roundings, by which rows that depend differ."""
    return max(PROXIMAL, 100 * float(jnp.finfo(dtype).eps))


class SmallInverse(NamedTuple):
    """b -> S^-1 b of a small matrix whose rows may depend on each other, for b that allow it."""

    S: Array
    near: Array  # the inverse of S, a little regularised, which is right to `proximal`

    def __call__(self, b: Array) -> Array:
        x = product(self.near, b)
        return x if len(b) == 2 else x + product(self.near, b - product(self.S, x))


def inverted(S: Array) -> SmallInverse:
    """The `SmallInverse`; of one contact without regularisation."""
    if len(S) == 2:
        return SmallInverse(S, with_slope(_eliminated, S))
    largest = reduce(jnp.maximum, jnp.abs(S).T)
    return SmallInverse(S, with_slope(_eliminated, S + jnp.diag(proximal(S.dtype) * largest)))


def _eliminated(S: Array) -> Array:
    """S^-1 without a search for pivots: tangential rows first, which hold what is semidefinite, or a unit; behind them
    the normal ones have a pivot unless a contact jams."""
    n = len(S)
    both = jnp.concatenate([S, jnp.eye(n, dtype=S.dtype)], axis=1)
    for k in [*range(n // 2, n), *range(n // 2)]:
        row = both[k] / both[k, k]
        both = jnp.where((jnp.arange(n) == k)[:, None], row[None, :], both - both[:, k][:, None] * row[None, :])
    return both[:, n:]


class Choice(NamedTuple):
    """pushes: (m,), whether f_N makes (y + K f)_N = 0; sticks: whether f_T makes (y + K f)_T = 0; sig: the direction of
    that, 0 where it is 0; f: such forces; found: whether there are any; jams: whether normal force of a contact that
    slides presses it together. All is constant to derivatives."""

    pushes: Array
    sticks: Array
    sig: Array
    f: Array
    found: Array
    jams: Array


def choice(K: Array, y: Array, mu: Array, off: Array, here: Array, sliding: Array) -> Choice:
    """Which of the contacts `here` push and stick. sliding: -1 or 1 where f_T = -sliding mu f_N is known, else 0."""
    K, y, mu, off = lax.stop_gradient((K, y, mu, off))
    m, rests = len(mu), here & (sliding == 0) & (mu > 0)
    unit = 1 / jnp.sqrt(jnp.where(diagonal(K) > 0, diagonal(K), 1))
    K, y = K * unit[:, None] * unit[None, :], y * unit
    largest = jnp.max(jnp.abs(y))
    largest = jnp.where(largest > 0, largest, 1)
    y, mu, off = y / largest, mu * unit[:m] / unit[m:], off / (unit[:m] * largest)
    of_N, of_T = K[:, :m] - (sliding * mu)[None, :] * K[:, m:], K[:, m:]
    one, none = jnp.eye(m, dtype=K.dtype), jnp.zeros((m, m), K.dtype)
    rows = [  # of f_N, of both parts of f_T, and of the speed of what slides off
        [of_N[:m], of_T[:m], -of_T[:m], none],
        [of_N[m:], of_T[m:], -of_T[m:], one],
        [-of_N[m:], -of_T[m:], of_T[m:], one],
        [mu[None, :] * one, -one, -one, none],
    ]
    M = jnp.concatenate([jnp.concatenate(row, axis=1) for row in rows])
    some = jnp.concatenate([here, rests, rests, rests])
    M = jnp.where(some[:, None] & some[None, :], M, jnp.eye(4 * m, dtype=K.dtype))
    found = complement(M, jnp.where(some, jnp.concatenate([y, -y[m:], mu * off]), 1))
    f_N, one_way, other, _ = found.z.reshape(4, m)
    f = jnp.concatenate([f_N, jnp.where(rests, one_way - other, -sliding * mu * f_N)])
    along = (y + product(K, f))[m:]
    pushes, one_way, other, slips = found.basic.reshape(4, m)
    jams = jnp.any(here & (sliding != 0) & (diagonal(of_N[:m]) <= proximal(K.dtype)))
    sticks = jnp.where(slips, one_way & other, one_way | other)
    # what slides off with no speed yet does so against its force
    direction = jnp.where(one_way, -1, jnp.where(other, 1, jnp.sign(along)))
    sig = jnp.where(rests, jnp.where(slips & ~sticks, direction, 0), sliding).astype(y.dtype)
    return Choice(here & pushes, rests & sticks, sig, f * unit * largest, found.found, jams)


def impulses(K: Array, y: Array, mu: Array, e: Array, here: Array) -> Array:
    """(2 m,): those of an impact of the contacts `here`, by Poisson's law, e (m,) being the restitution."""
    m = len(mu)

    def phase(now: tuple, _):
        y, back = now  # in the second one at least e times the normal impulses of the first come back
        f = _phase(K, y, mu, back, here) + jnp.concatenate([back, jnp.zeros_like(back)])
        return (y + product(K, f) + product(K[:, :m], e * f[:m]), e * f[:m]), f

    return jnp.sum(lax.scan(phase, (y, jnp.zeros_like(e)), length=2)[1], axis=0)


def _phase(K: Array, y: Array, mu: Array, off: Array, here: Array) -> Array:
    """f of the law above."""
    m = len(mu)
    chosen = choice(K, y, mu, off, here, jnp.zeros_like(mu))
    one = jnp.eye(2 * m, dtype=K.dtype)
    along = one[m:] + (chosen.sig * mu)[:, None] * one[:m]
    S = jnp.concatenate(
        [jnp.where(chosen.pushes[:, None], K[:m], one[:m]), jnp.where(chosen.sticks[:, None], K[m:], along)]
    )
    b = jnp.concatenate([jnp.where(chosen.pushes, -y[:m], 0), jnp.where(chosen.sticks, -y[m:], -chosen.sig * mu * off)])
    return chosen.f + inverted(S)(b - product(S, chosen.f))
