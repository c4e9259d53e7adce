"""Fits whose residuals simulate under error control: steps are frozen, and chosen again, until the estimates stay.

Steps that are chosen anew for each trial make the cost jump by what tolerances leave, and Levenberg-Marquardt ends
where it jumps down by chance. So a first round, which does that, comes near, to steps of a small part of the standard
errors. Those after it keep the steps that are chosen where the round before has ended. These are for the motion there,
and wrong far away: a frozen round that moves the estimates by no more than such a part is the last.
"""

from functools import partial

import jax.numpy as jnp
from jax import lax

from hhtjax.identification.gauss_newton import deviation
from hhtjax.identification.least_squares import levenberg_marquardt
from hhtjax.identification.progress import BAD_START, NO_INFLUENCE, RUNNING, UNSETTLED, History

MOST = 5  # rounds with frozen steps
SMALL = 0.1  # standard errors


def in_rounds(problem_for, x, longest, tolerance, max_iterations, progress):
    """`levenberg_marquardt` in rounds; also how many had frozen steps.

    problem_for: y, whether steps are chosen at each trial -> the problem, with steps as for y if they are not.
    """

    def unfinished(carry):
        return carry[-1]

    def one(carry):
        best, history, before, _, choices, _ = carry
        fresh = choices < 0
        problem = problem_for(best.x, fresh)
        limits = tolerance, max_iterations - before, progress, max_iterations

        def near(trial, step, problem=problem, fresh=fresh):
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


def joined(before, fresh, old, new):
    """The history of a round behind that of those before it, after so many iterations."""
    behind = jnp.arange(old.size, dtype=jnp.int32) > before
    return jnp.where(behind | fresh, jnp.roll(new, before), old)
