"""Minimisers of 1/2 sum rho((w f(x))^2) on vectors: Levenberg-Marquardt, and any optax optimiser.

All loops are `lax.while_loop`s, so that a fit runs under jit and vmap; what stopped it travels as a code.
"""

import sys
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import lax

RUNNING, COST, STEP, GRADIENT, LIMIT, STUCK, BAD_START, NO_INFLUENCE = range(8)
REASONS = {
    RUNNING: "still running",
    COST: "converged: the cost changes by less than tolerance",
    STEP: "converged: the step is smaller than tolerance",
    GRADIENT: "converged: the gradient vanishes to within tolerance",
    LIMIT: "stopped: max_iterations reached",
    STUCK: "stopped: no step lowers the cost",
    BAD_START: "failed: the residual is not finite at params0",
    NO_INFLUENCE: "failed: no parameter changes the residual at params0",
}


def huber(z):
    """z up to 1, then 2 sqrt(z) - 1: the square of a small residual, the size of a large one."""
    return jnp.where(z <= 1, z, 2 * jnp.sqrt(jnp.maximum(z, 1)) - 1)


def soft_l1(z):
    """2 (sqrt(1 + z) - 1): Huber's loss made smooth."""
    return 2 * z / (jnp.sqrt(1 + z) + 1)


LEAST_BEND = 0.1  # share of rho' that rho' + 2 rho'' z is taken to have at least, in a step
LOSSES = {"huber": huber, "soft_l1": soft_l1, "cauchy": jnp.log1p}


class History(NamedTuple):
    """Per iteration, the start first: cost; largest entry of the step in the scaled coordinates, 0 where it was
    taken back; and the damping of Levenberg-Marquardt (None for optax)."""

    cost: Any
    step: Any
    damping: Any


class Objective(NamedTuple):
    """1/2 sum rho(z) with z = (w r)^2 for the first `data` residuals, and rho(z) = z for the others, the priors."""

    weights: Any  # (m,); 0: missing, whatever the residual
    loss: Callable | None
    data: int

    def scaled(self, r):
        """w r, with 0 in the place of what is missing; r may be a Jacobian."""
        w = self.weights.reshape(-1, *(1,) * (r.ndim - 1))
        return jnp.where(w == 0, 0, w * r)

    def losses(self, r):
        """rho of each residual, and its first two derivatives."""
        z = self.scaled(r) ** 2
        ones = jnp.ones_like(z)
        loss = self.loss
        if loss is None:
            return z, ones, 0 * z

        def rho(z):
            return jnp.concatenate([loss(z[: self.data]), z[self.data :]])

        (value, slope), (_, curvature) = jax.jvp(lambda z: jax.jvp(rho, (z,), (ones,)), (z,), (ones,))
        return value, slope, curvature

    def cost(self, r):
        """1/2 sum rho."""
        return jnp.sum(self.losses(r)[0]) / 2

    def least_squares(self, r, J):
        """(r, J) of an ordinary least-squares problem with the same gradient J^T r.

        The rows of J are scaled by sqrt(rho' + 2 rho'' z) (Triggs et al. 2000, Sec. 4.3), but not far below the
        sqrt(rho') of iterative reweighting: so the length of r stays that of the gradient's own residual.
        """
        if self.loss is None:
            return self.scaled(r), self.scaled(J)
        r, J, (_, slope, curvature) = self.scaled(r), self.scaled(J), self.losses(r)
        row = jnp.sqrt(jnp.maximum(slope + 2 * curvature * r**2, LEAST_BEND * slope))
        return slope * r / jnp.where(row == 0, 1, row), J * row[:, None]

    def estimating(self, r, J):
        """w J, and the first and second derivative of the loss of each weighted residual (None without a loss: 1).

        With them J^T pull is the gradient of the cost, and J^T diag(bend) J its second derivative.
        """
        r, J, (_, slope, curvature) = self.scaled(r), self.scaled(J), self.losses(r)
        return J, slope * r, None if self.loss is None else slope + 2 * curvature * r**2


def levenberg_marquardt(problem, x, longest, tolerance, max_iterations, progress):
    """Damped Gauss-Newton on a `Dense` or an `Arrow` problem; returns the best trial, the history, and why it ended.

    dx = -(J^T J + lam D^2)^-1 J^T r. With rho the decrease of the cost over that predicted, lam changes by the factor
    max(1/8, 1 - (2 rho - 1)^3) when a step lowers the cost (Nielsen 1999), and grows by 6 when it does not. Before that
    it grows until no entry of dx is longer than that of `longest`.
    """
    eps = float(jnp.finfo(x.dtype).eps)
    running = jnp.asarray(RUNNING, jnp.int32)

    def unfinished(carry):
        return carry[-1] == RUNNING

    def improve(carry):
        now, lam, iteration, history, _ = carry
        first = iteration < 0
        lam, step, predicted = _within(problem, now, lam, longest)
        new = problem.look(now.x + jnp.where(first, 0, step), now.D)
        lower = new.cost < now.cost
        gain = (now.cost - new.cost) / predicted
        damped = lam * jnp.max(jnp.where(now.column > 0, now.D / now.column, 1)) ** 2
        lam = jnp.where(first, lam, lam * jnp.where(lower, jnp.maximum(1 / 8, 1 - (2 * gain - 1) ** 3), 6))
        iteration = iteration + 1
        best = jax.tree.map(partial(jnp.where, lower | first), new, now)
        honest = damped <= 1  # a step is also small, and changes little, because it is damped
        honest &= _settled(problem, best, history.cost[0], tolerance)
        flat = (predicted <= tolerance * now.cost) & (jnp.abs(now.cost - new.cost) <= tolerance * now.cost)
        short = jnp.all(jnp.abs(step) <= tolerance * (jnp.abs(now.x) + tolerance))
        code = jnp.where(iteration == max_iterations, LIMIT, running)
        code = jnp.where(~lower & (lam > 1 / eps), STUCK, code)
        code = jnp.where(honest & short, STEP, code)
        code = jnp.where(honest & flat, COST, code)
        code = jnp.where(first, running, code)
        code = jnp.where(problem.cosine(best) <= tolerance, GRADIENT, code)
        code = jnp.where(first & jnp.all(best.column == 0), NO_INFLUENCE, code)
        code = jnp.where(first & ~jnp.isfinite(new.cost), BAD_START, code)
        taken = jnp.where(lower & ~first, jnp.max(jnp.abs(step)), 0)
        history = _record(history, iteration, best.cost, taken, lam)
        if progress:
            _show(iteration, best.cost, taken)
        return best, lam, iteration, history, code

    # nothing is known before the first evaluation, which is that of the loop: f is compiled once
    nothing = jax.tree.map(lambda y: jnp.zeros(y.shape, y.dtype), jax.eval_shape(problem.look, x, x))
    nothing = nothing._replace(x=x, cost=jnp.asarray(jnp.inf, x.dtype))
    empty = jnp.full(max_iterations + 1, jnp.nan, x.dtype)
    carry = nothing, jnp.asarray(1e-3, x.dtype), jnp.asarray(-1, jnp.int32), History(empty, empty, empty), running
    best, _, iterations, history, code = lax.while_loop(unfinished, improve, carry)
    return best, history, iterations, code


def _settled(problem, best, start, tolerance):
    """Whether small steps mean a minimum: the gradient is small too, or the residual next to nothing.

    Without that, a residual with a derivative of 1e10, as of a chaotic run, would call its first step small.
    """
    reach = jnp.linalg.norm(best.column * jnp.maximum(jnp.abs(best.x), 1))  # of parameters changed by themselves
    rounding = 10 * float(jnp.finfo(reach.dtype).eps) * reach
    nothing = (best.cost <= tolerance * start) | (best.length <= rounding)
    return nothing | (problem.cosine(best) <= 10 * jnp.sqrt(tolerance))


def _within(problem, now, lam, longest):
    """The least damping, lam times a power of 4, whose step is within `longest`; that step, and what it predicts."""
    if np.all(np.isinf(longest)):
        return lam, *problem.step(now, lam)  # the loop would only cost time to compile
    longest = np.minimum(longest, np.finfo(lam.dtype).max).astype(lam.dtype)  # so that inf is too long

    def too_long(carry):
        return jnp.any(jnp.abs(carry[1]) > longest)

    def damp(carry):
        lam = 4 * carry[0]
        return lam, *problem.step(now, lam)

    return lax.while_loop(too_long, damp, (lam / 4, jnp.full_like(now.x, jnp.inf), lam))


def descend(f, x, objective, optimizer, tolerance, max_iterations, progress, patience=5):
    """An optax optimiser on the cost; returns the best point it saw."""
    optimizer = optax.with_extra_args_support(optimizer)
    running = jnp.asarray(RUNNING, jnp.int32)

    def cost(x):
        return objective.cost(f(x))

    def unfinished(carry):
        return carry[-1] == RUNNING

    def improve(carry):
        x, state, best, before, step, quiet, iteration, history, _ = carry
        value, gradient = jax.value_and_grad(cost)(x)
        best = jax.tree.map(partial(jnp.where, value < best[1]), (x, value), best)
        history = _record(history, iteration, value, step, None)
        quiet = jnp.where(jnp.abs(before - value) <= tolerance * value, quiet + 1, 0)
        code = jnp.where(iteration == max_iterations, LIMIT, running)
        code = jnp.where(quiet >= patience, COST, code)
        level = jnp.where((iteration == 0) & (value > 0), NO_INFLUENCE, GRADIENT)
        code = jnp.where(jnp.all(gradient == 0), level, code)
        code = jnp.where(jnp.isfinite(value), code, jnp.where(iteration == 0, BAD_START, STUCK))
        if progress:
            _show(iteration, value, step)
        updates, state = optimizer.update(gradient, state, x, value=value, grad=gradient, value_fn=cost)
        updates = jnp.where(code == RUNNING, jnp.asarray(updates), 0)
        iteration = jnp.where(code == RUNNING, iteration + 1, iteration)
        return x + updates, state, best, value, jnp.max(jnp.abs(updates)), quiet, iteration, history, code

    infinity = jnp.asarray(jnp.inf, x.dtype)
    empty = jnp.full(max_iterations + 1, jnp.nan, x.dtype)
    zero = jnp.zeros((), jnp.int32)
    start = x, infinity
    carry = (
        x,
        optimizer.init(x),
        start,
        infinity,
        jnp.zeros((), x.dtype),
        zero,
        zero,
        History(empty, empty, None),
        running,
    )
    _, _, (x, _), _, _, _, iterations, history, code = lax.while_loop(unfinished, improve, carry)
    return x, history, iterations, code


def _record(history, i, *values):
    return History(*(None if x is None else x.at[i].set(value) for x, value in zip(history, values, strict=True)))


def _show(iteration, cost, step):
    def show(iteration, cost, step):
        what = f"step {float(step):.3g}" if step else "no step" if iteration else "start"
        print(f"fit: iteration {int(iteration)}, cost {float(cost):.9g}, {what}", file=sys.stderr, flush=True)

    jax.debug.callback(show, iteration, cost, step)
