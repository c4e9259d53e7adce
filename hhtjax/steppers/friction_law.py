"""What dry friction does within one step, on the sliding velocities alone.

A joint goes into the step with the velocity s and would come out of it with b, if it kept its friction. It may

    keep it:        sig b >= 0
    stop:           at theta h, theta = s/(s - b), where b crosses zero, and stay
    reverse:        go on from there with the acceleration of the other branch, D/h: s1 = (1 - theta) D
    hold:           stick, if the force that holds it, b/W, is no larger than the limit f
    break away:     at theta h, where the load has grown to f; then s1 = (1 - theta) (b - W f)
"""

from typing import Any, NamedTuple

import jax.numpy as jnp

DEPENDENT = 2.0  # `Info.friction` where rows that are taken to be independent are not
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


def is_settled(left):
    """Whether so much may be left."""
    return left <= max(SETTLED, 1e3 * float(jnp.finfo(left.dtype).eps))
