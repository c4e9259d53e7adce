"""Dry friction of a system: where it acts, its limits, and its effect on the accelerations.

    s = sliding(q, v, t),    H = ds/dv,    F = limit(q, v, t) >= 0
    M(q) w = Q(q, v, t) + B^T L - H^T tau,    tau = F sign(s) if s != 0, else |tau| <= F

How a step finds tau is in hhtjax/steppers/friction.py.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree

from hhtjax import checks
from hhtjax.checks import describe, require_function
from hhtjax.description import Array, PyTree, Real, thaw
from hhtjax.jaxpr import linear_map
from hhtjax.numerics.dense_lu import diagonal, matvec
from hhtjax.numerics.linear_solve import solver
from hhtjax.primitives import consistent

MOST = 16  # directions of friction
FEW = 8  # up to so many are taken to be independent of each other, unless something speaks against it
ROUNDING = 64  # of a load that a joint at rest bears beyond its limit


class FrictionLaw(NamedTuple):
    """Dry friction on vectors; made by `flat_friction`."""

    limit: Callable  # q, v, L, t, params -> F (m,)
    sliding: Callable  # q, v, t, params -> s (m,), affine in v
    size: int  # m
    dependent: bool  # whether rows of `sliding` may depend on each other, or on constraints


def require_friction(caller: str, friction: Callable | None, sliding: Callable | None, *more: str):
    """Raises an error for wrong functions of dry friction. more: the arguments of `friction` between v and t."""
    if friction is None:
        if sliding is not None:
            raise ValueError(f"{caller}: `sliding` must go with `friction`, the limits of the forces there.")
        return
    require_function(caller, "friction", friction, f"friction({', '.join(('q, v', *more))}, t, params)")
    if sliding is not None:
        require_function(caller, "sliding", sliding, "sliding(q, v, t, params)")


def flat_friction(
    caller: str, system, flat, q0: PyTree, v0: PyTree, z0: PyTree, t0: Real, params: PyTree
) -> FrictionLaw:
    """The `FrictionLaw` of a system; raises an error if its functions return wrong shapes."""
    dtype, n = ravel_pytree(q0)[0].dtype, flat.positions
    z = () if z0 is None else (z0,)
    L = (jnp.zeros(flat.num_constraints, dtype),) if flat.num_constraints else ()
    F = checks.evaluate(caller, "friction", system.friction, q0, v0, *z, *L, t0, params)
    if system.sliding is None:
        checks.check_like(caller, "friction", F, "v0", v0, dtype)
        m = n
        if m > MOST:
            raise ValueError(
                f"{caller}: `friction` acts on at most {MOST} directions; received one for each of {n} coordinates: "
                "give `sliding`, the sliding velocities of those with friction."
            )
    else:
        m = checks.count(caller, "sliding", system.sliding, MOST, dtype, q0, v0, t0, params)
        if not hasattr(F, "shape") or F.shape != (m,):
            raise ValueError(
                f"{caller}: `friction` must return ({m},), one limit for each of `sliding`; received {describe(F)}."
            )
        checks.check_dtype(caller, "friction", F, dtype)
    unravel_internal = (lambda V: ()) if z0 is None else (lambda V: (flat.unravel_internal(V[n:]),))

    def limit(q: Array, V: Array, L: Array | None, t: Array, params: PyTree):
        multipliers = (L,) if flat.num_constraints else ()
        at = flat.unravel(q), flat.unravel_rates(flat.located(V)), *unravel_internal(V), *multipliers
        return ravel_pytree(system.friction(*at, t, thaw(params)))[0].astype(dtype)

    def sliding(q: Array, V: Array, t: Array, params: PyTree):
        v = flat.located(V)
        if system.sliding is None:
            return v
        return jnp.asarray(system.sliding(flat.unravel(q), flat.unravel_rates(v), t, thaw(params))).astype(dtype)

    dependent = m > min(n - flat.num_constraints, FEW) or system.depending
    return FrictionLaw(consistent(limit), consistent(sliding), m, dependent)


def directions(system, q, t, params: PyTree) -> Array:
    """H (m, N), the derivative of the sliding velocities with respect to the rates."""
    zero = jnp.zeros(system.size, q.dtype)
    s = partial(system.friction.sliding, q, t=t, params=params)
    return linear_map(jax.linearize(s, zero)[1], zero)


def reaction(system, q, t, params: PyTree, tau) -> Array:
    """H^T tau: (N,)."""
    zero = jnp.zeros(system.size, q.dtype)
    return jax.vjp(lambda v: system.friction.sliding(q, v, t, params), zero)[1](tau)[0]


def own_rate(system, q, v, t, params):
    """The part of ds/dt that does not depend on w: (m,)."""

    def s(q, t):
        return system.friction.sliding(q, v, t, params)

    return jax.jvp(s, (q, t), (system.rate(q, v), jnp.ones_like(t)))[1]


def responses(answer: Callable, H: Array):
    """G = M^-1 H^T (m, N), the accelerations for a unit of force in each direction of H, including constraints; and the
    multipliers for it. answer: of `answers`."""
    return jax.vmap(answer)(H)


def across(H: Array, G: Array):
    """K = H G^T (m, m): K_ij is the acceleration in direction i for a unit of force in direction j."""
    return jnp.stack([matvec(H, g) for g in G], axis=1)


def solve_some(K: Array, some: Array, b: Array) -> Array:
    """y with K y = b on these rows and columns, and 0 elsewhere."""
    return solver_of_some(K, some)(b)


def solver_of_some(K: Array, some: Array):
    """The function b -> y for many b, factorised once."""
    if len(K) == 1:
        return lambda b: jnp.where(some, b, 0) / jnp.where(some, K[0], 1)
    solve = solver(block_of(K, some))
    return lambda b: solve(jnp.where(some, b, 0))


def block_of(A: Array, some: Array) -> Array:
    """A on these rows and columns, the identity elsewhere."""
    return jnp.where(some[:, None] & some[None, :], A, jnp.eye(len(A), dtype=A.dtype))


def at_rest(K: Array, rests: Array, load: Array, f: Array):
    """sig and tau of joints at rest: those that can be held against their loads within their limits are; the others
    slide.

    At first all are held. Then, one at a time, the first joint with a wrong state changes it: a held joint that exceeds
    its limit slides, and a sliding joint that its friction would accelerate is held. No choice comes twice (Murty 1974:
    K is positive).
    """
    if len(f) == 1:
        tau = jnp.clip(load / K[0], -f, f)
        return jnp.where(jnp.abs(load) > f * K[0], jnp.sign(load), 0), tau
    m, fixed = len(f), lax.stop_gradient((K, load, f))

    def unfinished(carry: tuple) -> Array:
        _, _, wrong, i = carry
        return jnp.any(wrong) & (i < 3**m)

    def change(carry: tuple):
        sig, to, wrong, i = carry
        sig = jnp.where(jnp.arange(m) == jnp.argmax(wrong), to, sig)
        return sig, *_wrong(*fixed, rests, sig), i + 1

    begin = jnp.zeros_like(load)
    sig, *_ = lax.while_loop(unfinished, change, (begin, *_wrong(*fixed, rests, begin), 0))
    return sig, _holding(K, load, f, rests, sig)


def _holding(K: Array, load: Array, f: Array, rests: Array, sig: Array) -> Array:
    """tau of joints that slide in the directions sig, and of the others, which are held at rest."""
    slid = sig * f
    return slid + solve_some(K, rests & (sig == 0), load - matvec(K, slid))


def _wrong(K: Array, load: Array, f: Array, rests: Array, sig: Array):
    """The state that each joint at rest should change to, and for which joints this is more than a rounding."""
    tau, alone = _holding(K, load, f, rests, sig), diagonal(K)
    over = jnp.where(sig == 0, jnp.abs(tau) - f, sig * (matvec(K, tau) - load) / alone)
    noise = ROUNDING * float(jnp.finfo(f.dtype).eps) * (jnp.abs(load) + matvec(jnp.abs(K), f)) / alone
    return jnp.where(sig == 0, jnp.sign(tau), 0), over > noise
