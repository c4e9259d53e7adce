"""How a step is solved: by one linearisation, or by Newton's iteration."""

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax

from hhtjax.numerics.linear_solve import invert, solve_map
from hhtjax.steppers.stepper import Info
from hhtjax.xla import staged


def linearized_solve(r, path, w, factorize, at=None):
    """w1 with r(path(w1)) = 0, r replaced by its tangent at the state `at` (default: path(w)).

    One linearisation, one factorisation, one solve: this is the non-iterative step, and Newton's.
    """

    def expand(w, at):
        start, along = jax.linearize(path, w)
        point = start if at is None else at
        value, tangent = jax.linearize(r, point)
        if at is not None:
            value = value + tangent(jax.tree.map(jnp.subtract, start, point))
        return value, along, tangent

    value, along, tangent = staged(expand, w.size)(w, at)
    return w - solve_map(lambda dw: tangent(along(dw)), value, factorize)


def newton(r, path, w, s, factorize, tolerance, max_iterations):
    """Newton on r(path(w)) from w until max|r| <= tolerance or a correction is lost in rounding; s: the state before.

    Differentiated by the implicit-function theorem, forward and reverse.
    """

    def lost_in_rounding(s0, s1):
        """Whether q, and h v, change by less than they are rounded to."""
        h = s1.t - s.t
        size = jnp.maximum(jnp.max(jnp.abs(s1.q)), h * jnp.max(jnp.abs(s1.v)))
        change = jnp.maximum(jnp.max(jnp.abs(s1.q - s0.q)), h * jnp.max(jnp.abs(s1.v - s0.v)))
        return change <= 4 * float(jnp.finfo(s.w.dtype).eps) * size

    def search(f, w):
        def unfinished(carry):
            _, value, iterations, converged = carry
            return ~converged & (iterations < max_iterations) & jnp.all(jnp.isfinite(value))

        def improve(carry):
            w0, value, iterations, _ = carry
            _, tangent = staged(partial(jax.linearize, f), w.size)(w0)
            w1 = w0 - invert(tangent, w, factorize)(value, trans=0)
            value = f(w1)
            converged = jnp.all(jnp.abs(value) <= tolerance) | lost_in_rounding(path(w0), path(w1))
            return w1, value, iterations + 1, converged

        value = f(w)
        begin = w, value, jnp.zeros((), jnp.int32), jnp.all(jnp.abs(value) <= tolerance)
        w, value, iterations, converged = lax.while_loop(unfinished, improve, begin)
        # as floats: custom_root cannot differentiate past integers
        return w, (jnp.max(jnp.abs(value)), iterations.astype(w.dtype), converged.astype(w.dtype))

    def tangent_solve(g, y):
        return solve_map(g, y, factorize)

    w, (size, iterations, converged) = lax.custom_root(lambda w: r(path(w)), w, search, tangent_solve, has_aux=True)
    return w, Info(size, iterations.astype(jnp.int32), converged > 0)
