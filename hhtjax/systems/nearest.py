"""The position nearest to a guess that satisfies the constraints: sequential quadratic programs, from several starts.

    min |x|_M^2/2 with Phi(q0 (+) x) = 0

A step solves with the Hessian of the Lagrangian where that is convex on the constraints, else with M, the one of Gauss
and Newton. It is shortened until  |x|_M^2/2 + rho |Phi|_1  falls; rho exceeds the multipliers, so that the minimum of
the sum is the one with constraints. A full step that fails only because the constraints are curved gets a correction
(Fletcher 1982). Newton's iteration alone, from far away, ends at any stationary point, the farthest one among them.

Where the constraints bend between the guess and what is found there may be a nearer one: others are sought, from starts
inside the ball that ends there. Near a guess that fits, where the constraints are almost linear, the first one is it.

J. Nocedal, S. Wright, Numerical Optimization, Ch. 18.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.numerics.implicit_root import implicit_root
from hhtjax.numerics.linear_solve import solve_map
from hhtjax.systems import kinematics
from hhtjax.systems.constraints import jacobian

STARTS = 24
PARTS = 1.0, 0.5, 0.25  # of the distance found, in turn, at which other starts are
MAX_ITERATIONS = 60
HALVINGS = 12
DECREASE = 1e-4  # of what the slope promises, which a step has to bring (Armijo)
WEIGHT = 1e3  # of the constraints, beside the Hessian of which convexity on them is asked (Debreu 1952)
BENT = 0.1  # of Phi(q0), what either end's slope may miss of it where the first point found is taken for the nearest


class Problem(NamedTuple):
    """What the search knows of its guess."""

    conditions: Any  # z -> (M x - B^T mu, Phi)
    constraint: Any  # x -> Phi
    M: Any
    d: Any  # the diagonal of M, ones in the place of zeros
    unit: Any  # (m,), makes distances of Phi
    Phi: Any  # at the guess
    B: Any
    size: Any  # of the largest coordinate
    reach: Any  # of all of them, in the norm of M
    factorize: Any


def nearest_position(system, q0, t, params, factorize):
    """q on Phi = 0, its displacement x from q0 smallest in the norm of M(q0); x, and whether the search converged.

    Derivatives are those of the conditions for a minimum.
    """
    n, eps = system.size, float(jnp.finfo(q0.dtype).eps)

    def constraint(x):
        return system.constraint(system.move(q0, x), t, params)

    def conditions(z):
        x, mu = z[:n], z[n:]
        Phi, pull = jax.vjp(constraint, x)
        return jnp.concatenate([system.inertia(q0, x, t, params) - pull(mu)[0], Phi])

    def search(z):
        problem = lax.stop_gradient(_problem(system, q0, t, params))
        return _search(problem._replace(conditions=conditions, constraint=constraint, factorize=factorize), z)

    z0 = jnp.zeros(n + system.num_constraints, q0.dtype)
    z, found = implicit_root(conditions, z0, search, lambda g, y: solve_map(g, y, factorize))
    return system.move(q0, z[:n]), z[:n], found > math.sqrt(eps)


def _problem(system, q0, t, params):
    """Sizes and slopes at the guess."""
    M, B = system.full_mass(q0, t, params), jacobian(system, q0, t, params)
    d = jnp.diagonal(M)
    d = jnp.where(d == 0, 1, d)
    row = jnp.sqrt(jnp.sum(B**2 / d[None, :], axis=1))
    sizes = system.with_internal(jnp.zeros_like(d), jnp.zeros_like(d))
    sizes = sizes.at[: system.positions].set(kinematics.sizes(system.blocks, q0))
    Phi = system.constraint(q0, t, params)
    return Problem(
        None, None, M, d, 1 / jnp.where(row == 0, 1, row), Phi, B, jnp.max(sizes), jnp.sqrt(jnp.sum(d * sizes**2)), None
    )


def _search(p, z0):
    """The nearest of the points that were found, and 1 if there is one, else 0, as a float, for autodiff."""
    n, eps = len(p.d), float(jnp.finfo(z0.dtype).eps)
    ways = np.random.default_rng(0).standard_normal((STARTS, n))
    ways *= np.resize(PARTS, (STARTS, 1)) / np.linalg.norm(ways, axis=1, keepdims=True)
    ways = jnp.asarray(ways, z0.dtype).at[0].set(0)  # the first is the guess itself
    apart = jnp.sum(p.unit * jnp.abs(p.Phi))

    def unfinished(carry):
        _, _, found, certain, i = carry
        return ~(found & certain) & (i < STARTS)

    def again(carry):
        best, distance, found, _, i = carry
        radius = jnp.where(found, distance, jnp.maximum(apart, jnp.where(i > 0, jnp.sqrt(jnp.sum(p.d)), 0)))
        z, converged = _descend(p, z0.at[:n].set(radius * ways[i] / jnp.sqrt(p.d)))
        x = z[:n]
        away = jnp.sqrt(jnp.abs(x @ (p.M @ x)))
        better = converged & (away < distance)
        best = jnp.where(better | (i == 0), z, best)
        distance, found, x = jnp.where(better, away, distance), found | converged, best[:n]
        slopes = p.B, jax.jacfwd(p.constraint)(x)
        missed = jnp.stack([jnp.sum(p.unit * jnp.abs(p.Phi + B @ x)) for B in slopes])
        certain = (jnp.max(missed) <= BENT * apart) | (apart <= 1e3 * eps * p.reach)
        return best, distance, found, certain, i + 1

    far, no = jnp.asarray(jnp.inf, z0.dtype), jnp.array(False)
    best, _, found, *_ = lax.while_loop(unfinished, again, (z0, far, no, no, 0))
    return best, found.astype(z0.dtype)


def _descend(p, z0):
    """Where steps from z0 end, and whether that is a point on the constraints."""
    n, eps = len(p.d), float(jnp.finfo(z0.dtype).eps)

    def largest(z):
        return p.size + jnp.max(jnp.abs(z[:n]))

    def unfinished(carry):
        z, _, change, last, i = carry
        ends = change <= 16 * eps * (largest(z) + jnp.where(change > last / 2, 1, 0))
        return ~ends & ~jnp.isnan(change) & (i < MAX_ITERATIONS)

    def improve(carry):
        z, rho, last, _, i = carry
        z, rho, change = _step(p, z, rho)
        return z, rho, change, last, i + 1

    far = jnp.asarray(jnp.inf, z0.dtype)
    z, _, change, *_ = lax.while_loop(unfinished, improve, (z0, jnp.zeros_like(far), far, far, 0))
    left, apart = (jnp.sum(p.unit * jnp.abs(Phi)) for Phi in (p.constraint(z[:n]), p.Phi))
    root = math.sqrt(eps)
    met = left <= root * (jnp.sqrt(jnp.min(p.d)) + p.reach + apart)  # not beside x: some searches run away
    return z, (change <= root * (1 + largest(z))) & met


def _step(p, z, rho):
    """One step from z: the new z, rho, and the largest change of a coordinate."""
    n, eps = len(p.d), float(jnp.finfo(z.dtype).eps)
    x, value, A = z[:n], p.conditions(z), jax.jacfwd(p.conditions)(z)
    inverse = p.factorize(A.at[:n, :n].set(jnp.where(_is_convex(p, A, n), A[:n, :n], p.M)))
    step = -inverse(value, trans=0)
    dx, mu = step[:n], z[n:] + step[n:]
    rho = jnp.maximum(rho, 1.5 * jnp.max(jnp.abs(mu) / p.unit))

    def merit(x):
        return x @ (p.M @ x) / 2 + rho * jnp.sum(p.unit * jnp.abs(p.constraint(x)))

    now = merit(x)
    slope = (p.M @ x) @ dx - rho * jnp.sum(p.unit * jnp.abs(value[n:]))
    rounding = 64 * eps * (now + rho * p.reach)

    def falls(part, dx):
        return merit(x + dx) <= now + DECREASE * part * slope + rounding

    bend = -inverse(jnp.concatenate([jnp.zeros_like(x), p.constraint(x + dx)]), trans=0)[:n]
    bent = ~falls(1.0, dx) & falls(1.0, dx + bend)
    one = jnp.ones_like(rho)
    part = lax.while_loop(lambda a: ~falls(a, a * dx) & ~bent & (a > 2.0**-HALVINGS), lambda a: a / 2, one)
    taken = jnp.where(bent, dx + bend, part * dx)
    return jnp.concatenate([x + taken, z[n:] + part * step[n:]]), rho, jnp.max(jnp.abs(taken))


def _is_convex(p, A, n):
    """Whether the Hessian of the Lagrangian is positive definite along the constraints."""
    rows, unit = p.unit[:, None] * A[n:, :n], 1 / jnp.sqrt(p.d)
    H = (A[:n, :n] + A[:n, :n].T) / 2 + WEIGHT * rows.T @ rows
    return jnp.all(jnp.isfinite(jnp.linalg.cholesky(unit[:, None] * H * unit[None, :])))
