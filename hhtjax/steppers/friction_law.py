"""What dry friction does within one step, on the sliding velocities alone.

A joint goes into the step with the velocity s and would come out of it with b, if it kept its friction. It may

    keep it:        sig b >= 0
    stop:           at theta h, theta = s/(s - b), where b crosses zero, and stay
    reverse:        go on from there with the acceleration of the other branch, D/h: s1 = (1 - theta) D
    hold:           stick, if the force that holds it, b/W, is no larger than the limit f
    break away:     at theta h, where the load has grown to f; then s1 = (1 - theta) (b - W f)
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from hhtjax.numerics.elimination import factorize, matvec
from hhtjax.numerics.linear_solve import solve, solve_map

SWEEPS = 60  # over the joints
SETTLED = 1e-9  # change of friction over its limit that passes; 1000 roundings in float32


class Switch(NamedTuple):
    """How joints come out of a step: sliding velocity s, direction, change of friction tau, the distance slid over h,
    and whether they kept their friction."""

    s: Any
    sig: Any
    tau: Any
    slid: Any
    kept: Any


def switch(b, s, sig, tau, f, W, Wh):
    """Each joint by itself, elementwise. W: fall of b by a unit of friction; Wh: that of s in a time h."""
    slides, smooth = sig != 0, f == 0  # where nothing rubs, nothing switches
    keeps = slides & (sig * b >= 0) | smooth
    D = b - s + 2 * sig * f * Wh
    reverses = sig * D < 0
    ratio = s / jnp.where(slides & ~keeps, s - b, 1)
    theta_slid = jnp.clip(jnp.where(slides & ~keeps, ratio, 1), 0, 1)
    s_slid = jnp.where(keeps, b, jnp.where(reverses, (1 - theta_slid) * D, 0))

    load = b / jnp.where(W == 0, 1, W)
    d = jnp.sign(load)
    holds = jnp.abs(load) <= f
    breaks = ~slides & ~holds & ~smooth
    rise = d * (load - tau)
    crossed = (f - d * tau) / jnp.where(breaks & (rise > 0), rise, 1)
    theta_stuck = jnp.where(breaks & (rise > 0), jnp.clip(crossed, 0, 1), 0)
    s_stuck = jnp.where(breaks, (1 - theta_stuck) * (b - W * d * f), 0)

    s1 = jnp.where(keeps, b, jnp.where(slides, s_slid, s_stuck))
    new = jnp.where(slides, jnp.where(reverses, -sig, 0), jnp.where(holds, 0, d))
    new = jnp.where(keeps, jnp.where(smooth, jnp.sign(b), sig), new)
    slid = jnp.where(slides, (theta_slid * s + (1 - theta_slid) * s1) / 2, (1 - theta_stuck) * s1 / 3)
    return Switch(s1, new, jnp.where(keeps, 0, (b - s1) / jnp.where(W == 0, 1, W)), slid, keeps)


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

    def search(_, tau):
        def unfinished(carry):
            _, left, i = carry
            return (left > 64 * eps) & (i < SWEEPS)

        def improve(carry):
            tau, _, i = carry
            for k in range(m):
                tau = jnp.where(ones[k] > 0, answer(b - matvec(others, tau)), tau)
            at = b - matvec(others, tau)
            value, slope = jax.jvp(answer, (at,), (jnp.ones_like(at),))
            jump = tau - solve(ones + slope[:, None] * others, tau - value)
            lefts = worst(tau), worst(jump)
            better = lefts[1] < lefts[0]
            return jnp.where(better, jump, tau), jnp.where(better, lefts[1], lefts[0]), i + 1

        tau, left, _ = lax.while_loop(unfinished, improve, (tau, worst(tau), jnp.zeros((), jnp.int32)))
        return tau, left

    return lax.custom_root(excess, start, search, lambda g, y: solve_map(g, y, factorize), has_aux=True)


def is_settled(left):
    """Whether so much may be left."""
    return left <= max(SETTLED, 1e3 * float(jnp.finfo(left.dtype).eps))
