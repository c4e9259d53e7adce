"""Levenberg-Marquardt on vectors: a loop of JAX, which runs under jit and vmap, or of NumPy, which does not compile.

The reason for which it ended is returned as a code, whose text is in REASONS.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.description import Array, Real
from hhtjax.description.presentation import shown
from hhtjax.identification.gauss_newton import deviation, or_one
from hhtjax.identification.losses import Objective
from hhtjax.numerics.array_namespace import namespace_of, select, while_loop, with_entry
from hhtjax.primitives import largest_in_batch
from hhtjax.runs.progress import rewrite

if TYPE_CHECKING:
    from hhtjax.identification.gauss_newton import Dense, DenseTrial

ALIKE = 0.7  # least cosine of two steps at which the curvature along one is used for the other
MOST_BENT = 1.5  # largest 2 |D a|/|D v|: beyond it a is too large to be a correction of v
LESS, AGAIN, FASTER = 2.0, 4.0, 6  # lam is divided by 2 after a good step, by 4 times more after each further one


class Course(NamedTuple):
    """Damping and curvature, as learnt from the steps so far."""

    lam: Array
    radius: Array  # |D dx| of the next step at most; inf after a success
    good: Array  # how many good steps, one after the other; 0, 1, ..
    failures: Array  # how many trials have not lowered the cost, one after the other
    along: Any  # the last step, taken or not
    slope: Any  # J^T r'' with r'' the second derivative of the residual along it


def levenberg_marquardt(
    problem,
    x: Real,
    longest: np.ndarray,
    tolerance: Real,
    max_iterations: Real,
    progress: str,
    room: int | None = None,
    enough: Callable | None = None,
):
    """Damped Gauss-Newton on a `Dense` or an `Arrow` problem; returns the best trial, the history, and why it ended.

    dx = v + a/2,    v = -(J^T J + lam D^2)^-1 J^T r,    a = -(J^T J + lam D^2)^-1 J^T r''

    v and a are the velocity and the acceleration of a path that follows a curved valley (Transtrum, Sethna 2012). r''
    is the second derivative of the residual along v. It is estimated from the difference of the Jacobians at the ends
    of the last step, using the part of v along that step. So it needs no further run and no second derivative.

    Let rho be the decrease of the cost divided by the predicted one. When a step lowers the cost, lam is multiplied by
    max(least, 1 - (2 rho - 1)^3) (Nielsen 1999). least is 1/2; it is divided by 4 for each further step in a row with
    rho > 0.9. When a step does not lower the cost, lam grows until |D v| is half as long, or a quarter after two
    failures, an eighth after three, ... lam also grows until no entry of v is longer than that of `longest`.

    room: length of the history if max_iterations is a tracer. enough: (trial, step) -> whether to end, with code STEP.
    """
    xp, eps = namespace_of(x), float(jnp.finfo(x.dtype).eps)
    running = xp.asarray(RUNNING, np.int32)

    def unfinished(carry: tuple) -> Real:
        return carry[-1] == RUNNING

    def improve(carry: tuple):
        now, course, iteration, history, _ = carry
        first = iteration < 0
        lam, v, predicted = _within(problem, now, course, longest)
        step = xp.where(first, 0, v + _half_acceleration(problem, now, course, (lam, v), longest))
        new = problem.look(now.x + step, now.D)
        lower = new.cost < now.cost
        small = _small(problem, now, new, lower, (step, predicted, lam), history.cost[0], tolerance)
        best = select(lower | first, new, now)
        course = _learn(problem, (now, new, best), course, (lam, v, step), (now.cost - new.cost) / predicted, lower)
        course = select(first, carry[1], course)
        iteration = iteration + 1
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
        history = record(history, iteration, best.cost, taken, course.lam)
        if progress:
            show(progress, (iteration, best.cost, taken, code), (now.cost, carry[-1]))
        return best, course, iteration, history, code

    # nothing is known before the first evaluation, which is that of the loop: f is compiled once
    empty = xp.full((max_iterations if room is None else room) + 1, xp.nan, x.dtype)
    zero = xp.zeros((), np.int32)
    course = Course(xp.asarray(1e-3, x.dtype), xp.asarray(xp.inf, x.dtype), zero, zero, 0 * x, 0 * x)
    start = course, xp.asarray(-1, np.int32), History(empty, empty, empty), running
    best, _, iterations, history, code = while_loop(unfinished, improve, (problem.nothing(x), *start))
    return best, history, iterations, code


def _half_acceleration(problem, now: DenseTrial, course: Course, attempt: tuple, longest: np.ndarray) -> np.ndarray:
    """a/2 of the step v; 0 if v is not nearly along the last step, of which r'' is known, or if a is not small."""
    xp, (lam, v) = namespace_of(now.x), attempt
    own, last = now.D * v, now.D * course.along
    size, both = xp.linalg.norm(last), xp.sum(own * last)
    part = both / or_one(size) ** 2
    half = -problem.damped(now, lam, part**2 * course.slope) / 2
    alike = (xp.abs(both) > ALIKE * size * xp.linalg.norm(own)) & (size > 0)
    straight = 4 * xp.linalg.norm(now.D * half) <= MOST_BENT * xp.linalg.norm(own)
    return xp.where(alike & straight & xp.all(xp.abs(v + half) <= _bounded(longest, v.dtype)), half, 0)


def _learn(problem, trials: tuple, course: Course, attempt: tuple, rho: Real, lower: Real) -> Course:
    """The `Course` after an attempt."""
    (now, new, best), (lam, v, step) = trials, attempt
    xp, eps = namespace_of(now.x), float(jnp.finfo(now.x.dtype).eps)
    good = xp.where(lower & (rho > 0.9), xp.minimum(course.good + 1, FASTER), 0)
    failures = xp.where(lower, 0, course.failures + 1)
    further = xp.maximum(good - 1, 0).astype(lam.dtype)
    least = AGAIN**-further / LESS
    eased = xp.maximum(lam * xp.maximum(least, 1 - (2 * rho - 1) ** 3), eps**2)
    shorter = xp.where(xp.isfinite(new.cost), 0.5 ** xp.minimum(failures, 9).astype(lam.dtype), 0.1)
    radius = xp.where(lower, xp.inf, shorter * xp.linalg.norm(now.D * v))
    known = xp.isfinite(new.cost)
    slope = xp.where(known, problem.bending(now, new, best, step), course.slope)
    along = xp.where(known, step, course.along)
    kept = Course(xp.where(lower, eased, 2 * lam), radius, good, failures, along, slope)
    return Course(*(xp.asarray(x, y.dtype) for x, y in zip(kept, course, strict=True)))


def _small(problem, now: DenseTrial, new, lower: Real, attempt: tuple, start: Real, tolerance: Real) -> np.ndarray:
    """The code COST or STEP if an attempt has changed the cost or the unknowns too little to go on, otherwise RUNNING.

    GRADIENT if the residual is only rounding. A step can also be small because it is damped, or because a derivative is
    huge (1e10), as of a chaotic run. So two more conditions must hold. First, the gradient or the residual is small.
    Second, the damping is small, or so is the part of the residual that an undamped step would remove (the relative
    offset of Bates, Watts 1981).
    """
    xp, (step, predicted, lam) = namespace_of(now.x), attempt
    flat = (predicted <= tolerance * now.cost) & (xp.abs(now.cost - new.cost) <= tolerance * now.cost)
    short = xp.all(xp.abs(step) <= tolerance * (xp.abs(now.x) + tolerance))
    damped = lam * xp.max(xp.where(now.column > 0, now.D / or_one(now.column), 1)) ** 2
    best = select(lower, new, now)
    reach = xp.linalg.norm(best.column * xp.maximum(xp.abs(best.x), 1))  # of parameters changed by themselves
    rounding = 10 * float(jnp.finfo(reach.dtype).eps) * reach
    little = (best.cost <= tolerance * start) | (best.length <= rounding)
    nothing = (best.cost <= tolerance**2 * start) & (best.length <= rounding)
    sound = (damped <= 1) | (problem.offset(best) <= 10 * xp.sqrt(tolerance))
    minimum = sound & (little | (problem.cosine(best) <= 10 * xp.sqrt(tolerance)))
    code = xp.where(minimum & flat, COST, xp.where(minimum & short, STEP, RUNNING))
    return xp.where(nothing, GRADIENT, code)


def _within(problem, now: DenseTrial, course: Course, longest: np.ndarray):
    """(lam, step, predicted decrease): the least damping, lam times a power of 2, whose step is not too long.

    A step is too long if it exceeds `longest` or the radius.
    """
    xp = namespace_of(now.x)
    longest = _bounded(longest, now.x.dtype)

    def too_long(carry: tuple) -> Real:
        _, v, _ = carry
        return xp.any(xp.abs(v) > longest) | (xp.linalg.norm(now.D * v) > course.radius)

    def damp(carry: tuple):
        lam = 2 * carry[0]
        return lam, *problem.step(now, lam)

    return while_loop(too_long, damp, (course.lam / 2, xp.full_like(now.x, xp.inf), course.lam))


def _bounded(longest: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """`longest` with finite numbers instead of inf, so that an infinite step counts as too long."""
    return np.minimum(longest, np.finfo(dtype).max).astype(dtype)


# ----------------------------------------------------------------------------
# Fits whose residuals simulate under error control: steps are frozen and chosen again until the estimates settle.
#
# Steps that are chosen anew at each trial make the cost jump by the errors that the tolerances allow. A fit would then
# end where the cost jumps down by chance. So the first round, which chooses steps at each trial, ends when it moves the
# estimates by a small part of the standard errors. Each later round keeps the steps that were chosen at the end of the
# round before. They suit the motion there, and would be wrong far away. So the last round is the first one that moves
# the estimates by no more than such a small part.


MOST = 5  # rounds with frozen steps
SMALL = 0.1  # standard errors


def in_rounds(
    problem_for: Callable, x: Array, longest: np.ndarray, tolerance: Array, max_iterations: int, progress: str
):
    """`levenberg_marquardt` in rounds; also returns the number of rounds with frozen steps.

    problem_for: (y, fresh) -> the problem. With `fresh` steps are chosen at each trial, otherwise they are those at y.
    """

    def unfinished(carry: tuple) -> Array:
        return carry[-1]

    def one(carry: tuple):
        best, history, before, _, choices, _ = carry
        fresh = choices < 0
        problem = problem_for(best.x, fresh)
        limits = tolerance, max_iterations - before, progress, max_iterations

        def near(trial: DenseTrial, step: Array, problem: Dense = problem, fresh: Array = fresh) -> Array:
            return fresh & (problem.length(trial, step) <= SMALL * deviation(trial))

        found, new, iterations, code = levenberg_marquardt(problem, best.x, longest, *limits, near)
        history = History(*map(partial(joined, before, fresh), history, new))
        moved = problem.length(found, found.x - best.x)
        small = SMALL * deviation(found) + tolerance * problem.length(found, found.x)
        choices, before = choices + 1, before + iterations
        failed = (code == BAD_START) | (code == NO_INFLUENCE) | (before >= max_iterations)
        settled = (moved <= small) & ~fresh
        last = choices == MOST
        code = jnp.where(last & ~settled & ~failed, UNSETTLED, code)
        return found, history, before, code, choices, ~(failed | settled | last)

    start = problem_for(x, jnp.array(True))
    empty = jnp.full(max_iterations + 1, jnp.nan, x.dtype)
    zero = jnp.zeros((), jnp.int32)
    carry = start.nothing(x), History(empty, empty, empty), zero, zero + RUNNING, zero - 1, jnp.array(True)
    best, history, iterations, code, choices, _ = lax.while_loop(unfinished, one, carry)
    return best, history, iterations, code, choices


def joined(before: Array, fresh: Array, old: Array, new: Array) -> Array:
    """The history of a round appended to that of the earlier rounds, which had `before` iterations."""
    behind = jnp.arange(old.size, dtype=jnp.int32) > before
    return jnp.where(behind | fresh, jnp.roll(new, before), old)


# ----------------------------------------------------------------------------
# Any optax optimiser on the cost; like Levenberg-Marquardt, a `lax.while_loop` that ends with a code.


class Smooth(NamedTuple):
    """A cost of residuals f(x) (m,), whose gradient is computed by reverse mode."""

    f: Callable
    objective: Objective

    def cost(self, x: Array) -> Array:
        """The cost at x."""
        return self.objective.cost(self.f(x))

    def read(self, _):
        """Nothing: residuals are evaluated apart."""
        return ()

    def slopes(self, x: Array) -> Array:
        """The gradient of the cost: (1, p)."""
        return jax.grad(self.cost)(x)[None, :]


def descend(
    problem: Smooth, x: Array, optimizer, tolerance: Array, max_iterations: int, progress: str, patience: int = 5
):
    """Minimises the cost of a `Smooth` problem by an optax optimiser; returns the best point of all iterations."""
    import optax  # where a fit needs it: see `for_many`

    optimizer = optax.with_extra_args_support(optimizer)
    running = jnp.asarray(RUNNING, jnp.int32)

    def unfinished(carry: tuple) -> Array:
        return carry[-1] == RUNNING

    def improve(carry: tuple):
        x, state, best, before, step, quiet, iteration, history, ended = carry
        lowest = best[1]
        value, gradient = jax.value_and_grad(problem.cost)(x)
        best = jax.tree.map(partial(jnp.where, value < best[1]), (x, value), best)
        history = record(history, iteration, value, step, None)
        quiet = jnp.where(jnp.abs(before - value) <= tolerance * value, quiet + 1, 0)
        code = jnp.where(iteration == max_iterations, LIMIT, running)
        code = jnp.where(quiet >= patience, COST, code)
        level = jnp.where((iteration == 0) & (value > 0), NO_INFLUENCE, GRADIENT)
        code = jnp.where(jnp.all(gradient == 0), level, code)
        code = jnp.where(jnp.isfinite(value), code, jnp.where(iteration == 0, BAD_START, STUCK))
        if progress:
            show(progress, (iteration, value, step, code), (lowest, ended))
        updates, state = optimizer.update(gradient, state, x, value=value, grad=gradient, value_fn=problem.cost)
        updates = jnp.where(code == RUNNING, jnp.asarray(updates), 0)
        iteration = jnp.where(code == RUNNING, iteration + 1, iteration)
        return x + updates, state, best, value, jnp.max(jnp.abs(updates)), quiet, iteration, history, code

    infinity = jnp.asarray(jnp.inf, x.dtype)
    empty = jnp.full(max_iterations + 1, jnp.nan, x.dtype)
    begin = x, optimizer.init(x), (x, infinity), infinity, jnp.zeros((), x.dtype)
    zero = jnp.zeros((), jnp.int32)
    carry = (*begin, zero, zero, History(empty, empty, None), running)
    _, _, (x, _), _, _, _, iterations, history, code = lax.while_loop(unfinished, improve, carry)
    return x, history, iterations, code


# ----------------------------------------------------------------------------
# The course of a fit: why it ended, its history, and the line of progress.


RUNNING, COST, STEP, GRADIENT, LIMIT, STUCK, BAD_START, NO_INFLUENCE, UNSETTLED = range(9)
CONVERGED = COST, STEP, GRADIENT
REASONS = {
    RUNNING: "still running",
    COST: "converged: the cost changes by less than tolerance",
    STEP: "converged: the step is smaller than tolerance",
    GRADIENT: "converged: the gradient vanishes to within tolerance",
    LIMIT: "stopped: max_iterations reached",
    STUCK: "stopped: no step lowers the cost",
    BAD_START: "failed: the residual is not finite at params0",
    NO_INFLUENCE: "failed: no parameter changes the residual at params0",
    UNSETTLED: "stopped: the estimates change whenever steps are chosen anew; take a smaller rtol",
}
NO_SLOPE = (
    "a finite residual whose derivative is not finite: at 0, roots and norms have no derivative, and max(x, 0)**1.5 "
    "has no second derivative; use max(x, 1e-12) for x there"
)


@shown
class History(NamedTuple):
    """The course of a fit: one entry for each iteration, the first one for the initial guess.

    Attributes:
        cost: cost after the iteration.
        step: largest entry of the step in the scaled coordinates, 0 if the step was rejected.
        damping: damping of Levenberg-Marquardt (None for optax).
    """

    cost: Any
    step: Any
    damping: Any


def record(history: History, i: Real, *values):
    """The history with the values of iteration i entered; fields that are None stay None."""
    return History(*(None if x is None else with_entry(x, i, y) for x, y in zip(history, values, strict=True)))


def show(caller: str, now: tuple, before: tuple):
    """A line on stderr, the same one at every iteration; at the end with the reason. Of `multistart`, one for all.

    now: iteration, cost, step, code. before: the lowest cost and the code until then, which fits that have ended keep.
    """

    def tell(iteration, cost, step, code):
        what = f"step {float(step):.3g}" if step else "no step" if iteration else "start"
        what = what if code == RUNNING else REASONS[int(code)]
        words = f"fit: iteration {int(iteration)}, cost {float(cost):.9g}, {what}"
        rewrite(words, code != RUNNING, int(iteration))

    def tell_of_all(iteration, lowest, is_over):
        what = "; all starts have ended" if is_over else ""
        rewrite(f"{caller}: iteration {int(iteration)}, lowest cost {float(lowest):.9g}{what}", is_over, int(iteration))

    if namespace_of(now[1]) is np:
        tell(*now)
    elif caller == "multistart":
        jax.debug.callback(tell_of_all, *of_all(now, before))
    else:
        jax.debug.callback(tell, *now)


def of_all(now: tuple, before: tuple):
    """Iteration, lowest cost and whether all have ended, of a batch of fits. One that has ended is not changed."""
    iteration, cost, _, code = now
    lowest, ended = before
    runs = ended == RUNNING
    lowest = jnp.where(runs, jnp.fmin(cost, lowest), lowest)
    lowest = -largest_in_batch(-jnp.where(jnp.isnan(lowest), jnp.inf, lowest))
    return largest_in_batch(jnp.where(runs, iteration, -1)), lowest, ~largest_in_batch(runs & (code == RUNNING))
