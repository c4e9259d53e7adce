"""Forces that answer to a load each by itself, and change the loads of each other."""

import jax
import jax.numpy as jnp
from jax import lax

from hhtjax.numerics.elimination import factorize, matvec
from hhtjax.numerics.linear_solve import solve, solve_map

SWEEPS = 60  # over all of them


def balance(answer, b, W, start, f):
    """tau with tau_i = answer(b - (what the others take off, W without its diagonal))_i, and what is left, over f.

    Sweeps over the joints (Gauss-Seidel), each followed by one step of Newton's method where that is better.
    """
    m = len(b)
    if m == 1:
        return answer(b), jnp.zeros((), b.dtype)
    eps, ones = float(jnp.finfo(b.dtype).eps), jnp.eye(m, dtype=b.dtype)
    others = W * (1 - ones)
    size = jnp.maximum(f, jnp.max(jnp.abs(f)) * eps)

    def excess(tau):
        return tau - answer(b - matvec(others, tau))

    def worst(tau):
        return jnp.max(jnp.abs(excess(tau)) / jnp.where(size == 0, 1, size))

    def sweep(k, tau):
        return jnp.where(jnp.arange(m) == k, answer(b - matvec(others, tau)), tau)

    def search(_, tau):
        def unfinished(carry):
            _, left, i = carry
            return (left > 64 * eps) & (i < SWEEPS)

        def improve(carry):
            tau, _, i = carry
            tau = lax.fori_loop(0, m, sweep, tau)
            at = b - matvec(others, tau)
            value, slope = jax.jvp(answer, (at,), (jnp.ones_like(at),))
            jump = tau - solve(ones + slope[:, None] * others, tau - value)
            lefts = worst(tau), worst(jump)
            better = lefts[1] < lefts[0]
            return jnp.where(better, jump, tau), jnp.where(better, lefts[1], lefts[0]), i + 1

        tau, left, _ = lax.while_loop(unfinished, improve, (tau, worst(tau), jnp.zeros((), jnp.int32)))
        return tau, left

    return lax.custom_root(excess, start, search, lambda g, y: solve_map(g, y, factorize), has_aux=True)
