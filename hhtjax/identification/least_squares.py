"""Levenberg-Marquardt on vectors: a loop of JAX, which runs under jit and vmap, or of NumPy, which does not compile.

What ended it is a code.
"""

import jax.numpy as jnp
import numpy as np

from hhtjax.identification.progress import (
    BAD_START,
    COST,
    GRADIENT,
    LIMIT,
    NO_INFLUENCE,
    RUNNING,
    STEP,
    STUCK,
    History,
    record,
    show,
)
from hhtjax.numerics.either import choose, namespace_of, while_loop


def levenberg_marquardt(problem, x, longest, tolerance, max_iterations, progress, room=None, enough=None):
    """Damped Gauss-Newton on a `Dense` or an `Arrow` problem; returns the best trial, the history, and why it ended.

    dx = -(J^T J + lam D^2)^-1 J^T r. With rho the decrease of the cost over that predicted, lam changes by the factor
    max(1/8, 1 - (2 rho - 1)^3) when a step lowers the cost (Nielsen 1999), and grows by 6 when it does not. Before that
    it grows until no entry of dx is longer than that of `longest`. room: for how many iterations the history has
    room, where max_iterations is a tracer. enough: trial, step -> whether to end with a step like that, for STEP.
    """
    xp, eps = namespace_of(x), float(jnp.finfo(x.dtype).eps)
    running = xp.asarray(RUNNING, np.int32)

    def unfinished(carry):
        return carry[-1] == RUNNING

    def improve(carry):
        now, lam, iteration, history, _ = carry
        first = iteration < 0
        lam, step, predicted = _within(problem, now, lam, longest)
        new = problem.look(now.x + xp.where(first, 0, step), now.D)
        lower = new.cost < now.cost
        gain = (now.cost - new.cost) / predicted
        small = _small(problem, now, new, lower, (step, predicted, lam), history.cost[0], tolerance)
        lam = xp.where(first, lam, lam * xp.where(lower, xp.maximum(1 / 8, 1 - (2 * gain - 1) ** 3), 6))
        iteration = iteration + 1
        best = choose(lower | first, new, now)
        code = xp.where(iteration == max_iterations, LIMIT, running)
        code = xp.where(~lower & (lam > 1 / eps), STUCK, code)
        code = xp.where(small == RUNNING, code, small)
        if enough is not None:
            code = xp.where((code == RUNNING) & enough(now, step), STEP, code)
        code = xp.where(first, running, code)
        code = xp.where(problem.cosine(best) <= tolerance, GRADIENT, code)
        code = xp.where(first & xp.all(best.column == 0), NO_INFLUENCE, code)
        code = xp.where(first & ~xp.isfinite(new.cost), BAD_START, code)
        taken = xp.where(lower & ~first, xp.max(xp.abs(step)), 0)
        history = record(history, iteration, best.cost, taken, lam)
        if progress:
            show(iteration, best.cost, taken, code)
        return best, lam, iteration, history, code

    # nothing is known before the first evaluation, which is that of the loop: f is compiled once
    empty = xp.full((max_iterations if room is None else room) + 1, xp.nan, x.dtype)
    start = xp.asarray(1e-3, x.dtype), xp.asarray(-1, np.int32), History(empty, empty, empty), running
    best, _, iterations, history, code = while_loop(unfinished, improve, (problem.nothing(x), *start))
    return best, history, iterations, code


def _small(problem, now, new, lower, attempt, start, tolerance):
    """COST or STEP where an attempt has changed the cost or the unknowns too little to go on; else RUNNING.

    A step is also small, and changes little, because it is damped, or because a derivative is 1e10, as of a chaotic
    run: the gradient has to be small too, or the residual next to nothing.
    """
    xp, (step, predicted, lam) = namespace_of(now.x), attempt
    flat = (predicted <= tolerance * now.cost) & (xp.abs(now.cost - new.cost) <= tolerance * now.cost)
    short = xp.all(xp.abs(step) <= tolerance * (xp.abs(now.x) + tolerance))
    damped = lam * xp.max(xp.where(now.column > 0, now.D / now.column, 1)) ** 2
    best = choose(lower, new, now)
    reach = xp.linalg.norm(best.column * xp.maximum(xp.abs(best.x), 1))  # of parameters changed by themselves
    rounding = 10 * float(jnp.finfo(reach.dtype).eps) * reach
    nothing = (best.cost <= tolerance * start) | (best.length <= rounding)
    minimum = (damped <= 1) & (nothing | (problem.cosine(best) <= 10 * xp.sqrt(tolerance)))
    return xp.where(minimum & flat, COST, xp.where(minimum & short, STEP, RUNNING))


def _within(problem, now, lam, longest):
    """The least damping, lam times a power of 4, whose step is within `longest`; that step, and what it predicts."""
    if np.all(np.isinf(longest)):
        return lam, *problem.step(now, lam)  # the loop would only cost time to compile
    xp = namespace_of(now.x)
    longest = np.minimum(longest, np.finfo(lam.dtype).max).astype(lam.dtype)  # so that inf is too long

    def too_long(carry):
        return xp.any(xp.abs(carry[1]) > longest)

    def damp(carry):
        lam = 4 * carry[0]
        return lam, *problem.step(now, lam)

    return while_loop(too_long, damp, (lam / 4, xp.full_like(now.x, xp.inf), lam))
