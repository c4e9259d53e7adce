"""Minimisers of 1/2 sum f(x)^2 on vectors: Levenberg-Marquardt, and any optax optimiser.

All loops are `lax.while_loop`s, so that a fit runs under jit and vmap; what stopped it travels as a code.
"""

import sys
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import lax

RUNNING, COST, STEP, GRADIENT, LIMIT, STUCK, BAD_START = range(7)
REASONS = {
    RUNNING: "still running",
    COST: "converged: the cost changes by less than tolerance",
    STEP: "converged: the step is smaller than tolerance",
    GRADIENT: "converged: the gradient vanishes to within tolerance",
    LIMIT: "stopped: max_iterations reached",
    STUCK: "stopped: no step lowers the cost",
    BAD_START: "failed: the residual is not finite at params0",
}


class History(NamedTuple):
    """Per iteration, the start first: cost, and the damping of Levenberg-Marquardt (None for optax)."""

    cost: Any
    damping: Any


def with_jacobian(f, x):
    """f(x) and its forward-mode Jacobian."""

    def twice(x):
        r = f(x)
        return r, r

    J, r = jax.jacfwd(twice, has_aux=True)(x)
    return r, J


class _Trial(NamedTuple):
    """A point, and the least-squares problem there, its columns scaled to one and reduced to p rows."""

    x: Any
    r: Any
    J: Any
    cost: Any
    column: Any  # norms of the columns of J
    s: Any  # singular values of J/column
    V: Any
    z: Any  # residual in the basis of the left singular vectors


def levenberg_marquardt(f, x, tolerance, max_iterations, progress):
    """Damped Gauss-Newton, dx = -(J^T J + lam D)^-1 J^T r with D the diagonal of J^T J.

    lam shrinks by 8 when a step lowers the cost and grows by 6 when it does not.
    """
    eps = float(jnp.finfo(x.dtype).eps)
    running = jnp.asarray(RUNNING, jnp.int32)

    def look(x):
        r, J = with_jacobian(f, x)
        finite = jnp.all(jnp.isfinite(r)) & jnp.all(jnp.isfinite(J))
        J_safe = jnp.where(finite, J, 0)
        norms = jnp.linalg.norm(J_safe, axis=0)
        column = jnp.where(norms == 0, 1, norms)
        Q, R = jnp.linalg.qr(J_safe / column[None, :])
        U, s, Vt = jnp.linalg.svd(R)
        cost = jnp.where(finite, jnp.sum(r**2) / 2, jnp.inf)
        return _Trial(x, r, J, cost, column, s, Vt.T, U.T @ (Q.T @ r))

    def unfinished(carry):
        return carry[-1] == RUNNING

    def improve(carry):
        now, lam, iteration, history, _ = carry
        weight = now.s / (now.s**2 + lam)
        step = -(now.V @ (weight * now.z)) / now.column
        predicted = jnp.sum(now.z**2 * (1 - (1 - now.s * weight) ** 2)) / 2
        new = look(now.x + step)
        lower = new.cost < now.cost
        lam = jnp.where(lower, lam / 8, lam * 6)
        iteration = iteration + 1
        honest = lower | (lam <= 1)  # a step is also small, and changes little, because lam is large
        flat = (predicted <= tolerance * now.cost) & (jnp.abs(now.cost - new.cost) <= tolerance * now.cost)
        short = jnp.all(jnp.abs(step) <= tolerance * (jnp.abs(now.x) + tolerance))
        best = jax.tree.map(partial(jnp.where, lower), new, now)
        code = jnp.where(iteration == max_iterations, LIMIT, running)
        code = jnp.where(~lower & (lam > 1 / eps), STUCK, code)
        code = jnp.where(honest & short, STEP, code)
        code = jnp.where(honest & flat, COST, code)
        code = jnp.where(_gradient_cosine(best) <= tolerance, GRADIENT, code)
        history = History(history.cost.at[iteration].set(best.cost), history.damping.at[iteration].set(lam))
        if progress:
            _show(iteration, best.cost)
        return best, lam, iteration, history, code

    start = look(x)
    lam = jnp.asarray(1e-3, x.dtype)
    empty = jnp.full(max_iterations + 1, jnp.nan, x.dtype)
    history = History(empty.at[0].set(start.cost), empty.at[0].set(lam))
    code = jnp.where(_gradient_cosine(start) <= tolerance, GRADIENT, running)
    code = jnp.where(jnp.isfinite(start.cost), code, BAD_START)
    carry = start, lam, jnp.zeros((), jnp.int32), history, code
    best, _, iterations, history, code = lax.while_loop(unfinished, improve, carry)
    return best.x, best.r, best.J, history, iterations, code


def _gradient_cosine(trial):
    """Largest |cosine| of the angle between the residual and a column of the Jacobian."""
    length = jnp.sqrt(2 * trial.cost)
    return jnp.max(jnp.abs(trial.V @ (trial.s * trial.z))) / jnp.where(length == 0, 1, length)


def descend(f, x, optimizer, tolerance, max_iterations, progress, patience=5):
    """An optax optimiser on 1/2 sum f(x)^2; returns the best point it saw."""
    optimizer = optax.with_extra_args_support(optimizer)
    running = jnp.asarray(RUNNING, jnp.int32)

    def cost(x):
        return jnp.sum(f(x) ** 2) / 2

    def unfinished(carry):
        return carry[-1] == RUNNING

    def improve(carry):
        x, state, best, before, quiet, iteration, history, _ = carry
        value, gradient = jax.value_and_grad(cost)(x)
        best = jax.tree.map(partial(jnp.where, value < best[1]), (x, value), best)
        history = History(history.cost.at[iteration].set(value), None)
        quiet = jnp.where(jnp.abs(before - value) <= tolerance * value, quiet + 1, 0)
        code = jnp.where(iteration == max_iterations, LIMIT, running)
        code = jnp.where(quiet >= patience, COST, code)
        code = jnp.where(jnp.all(gradient == 0), GRADIENT, code)
        code = jnp.where(jnp.isfinite(value), code, jnp.where(iteration == 0, BAD_START, STUCK))
        if progress:
            _show(iteration, value)
        updates, state = optimizer.update(gradient, state, x, value=value, grad=gradient, value_fn=cost)
        x = jnp.where(code == RUNNING, x + jnp.asarray(updates), x)
        iteration = jnp.where(code == RUNNING, iteration + 1, iteration)
        return x, state, best, value, quiet, iteration, history, code

    infinity = jnp.asarray(jnp.inf, x.dtype)
    history = History(jnp.full(max_iterations + 1, jnp.nan, x.dtype), None)
    zero = jnp.zeros((), jnp.int32)
    carry = x, optimizer.init(x), (x, infinity), infinity, zero, zero, history, running
    _, _, (x, _), _, _, iterations, history, code = lax.while_loop(unfinished, improve, carry)
    return x, history, iterations, code


def covariance(J, r):
    """s^2 (J^T J)^-1, and which parameters the residuals leave undetermined: infinite there."""
    m, p = J.shape
    norms = jnp.linalg.norm(J, axis=0)
    column = jnp.where(norms == 0, 1, norms)
    _, s, Vt = jnp.linalg.svd(jnp.linalg.qr(J / column[None, :], mode="r"))
    seen = s > 10 * m * float(jnp.finfo(J.dtype).eps) * s[0]
    undetermined = jnp.any(~seen[:, None] & (jnp.abs(Vt) > 1e-6), axis=0)
    if m == p:  # nothing left to estimate the variance from
        undetermined = jnp.ones(p, bool)
    inverse = jnp.where(seen, 1 / jnp.where(seen, s, 1) ** 2, 0)
    C = jnp.sum(r**2) / max(m - p, 1) * (Vt.T * inverse[None, :]) @ Vt / jnp.outer(column, column)
    both = undetermined[:, None] & undetermined[None, :]
    C = jnp.where(undetermined[:, None] | undetermined[None, :], 0, C)
    return jnp.where(both & jnp.eye(p, dtype=bool), jnp.inf, C), undetermined


def _show(iteration, cost):
    def show(iteration, cost):
        print(f"fit: iteration {int(iteration)}, cost {float(cost):.9g}", file=sys.stderr, flush=True)

    jax.debug.callback(show, iteration, cost)
