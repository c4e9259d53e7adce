"""The dry friction of a run between its saved times, for integrals over them."""

import jax
import jax.numpy as jnp

from hhtjax.numerics.elimination import matvec
from hhtjax.numerics.linear_solve import solve
from hhtjax.systems.constraints import factorize_constrained
from hhtjax.systems.friction import across, directions, responses


def friction_between(flat, solution, v, w, at, params):
    """tau in the middle of each interval, (K, m): of a joint that slides all along the limit there, with its direction.

    Where one switches, tau jumps somewhere inside, and what w does at the ends does not make v: the mean of tau is

        mean = (tau0 + tau1)/2 + K^-1 H [(w0 + w1)/2 - (v1 - v0)/h],    K = H G,

    and the value in the middle the one with which Simpson's rule gives that mean. So integrals are of order 2.

    v, w: (K + 1, N). at: q, v, t and L in the middles. params: of each interval.
    """
    tau, sig = solution.friction, jnp.where(solution.sticking, 0, jnp.sign(solution.friction))
    h = jnp.diff(solution.t)[:, None]
    missing = (w[1:] + w[:-1]) / 2 - jnp.diff(v, axis=0) / h

    def middle(at, tau, sig, missing, params):
        q, v, t, L = at
        f = flat.friction.limit(q, v, L, t, params)
        H = directions(flat, q, t, params)
        ways = () if L is None else (factorize_constrained(flat.size, "least_squares"),)
        K = across(H, responses(flat, q, t, params, H, *ways))
        mean = jnp.clip((tau[0] + tau[1]) / 2 + solve(K, matvec(H, missing)), -f, f)
        steady = jnp.where(sig[0] == 0, (tau[0] + tau[1]) / 2, sig[0] * f)
        return jnp.where(jnp.any(sig[0] != sig[1]), (6 * mean - tau[0] - tau[1]) / 4, steady)

    pairs = (jnp.stack([x[:-1], x[1:]], axis=1) for x in (tau, sig))
    return jax.vmap(middle)(at, *pairs, missing, params)
