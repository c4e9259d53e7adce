"""The error of a whole run under error control, by another run of it."""

from dataclasses import replace

import jax
import jax.numpy as jnp
from jax import lax

ALARM = 10  # times what was asked for, above which the error of a run is a failure


def scaled(control, share):
    """So much of the tolerance."""
    return replace(control, **{name: share * getattr(control, name) for name in ("rtol", "atol", "atol_v")})


def verified(run, finer, control, order):
    """What a `Solution` tells of its error, by Richardson from a finer run; constant to derivatives."""
    left = 0.25 if control.verify == "tolerance" else 0.5**order  # of the error
    error, tolerance = compared(run, finer, 1 / (1 - left), control)
    return {"error": error, "allowed": ALARM * tolerance}


def compared(run, other, share, control):
    """So much of the difference at each of the times, in its largest coordinate, and what is asked for."""

    def largest(q):
        return jnp.max(jnp.stack([jnp.max(jnp.abs(x).reshape(len(x), -1), axis=1) for x in jax.tree.leaves(q)]), axis=0)

    q, others, control = lax.stop_gradient((run.q, other.q, control))
    error = largest(jax.tree.map(jnp.subtract, others, q)) * share
    rtol, atol = (jnp.asarray(x).astype(error.dtype) for x in (control.rtol, control.atol))
    return error, rtol * jnp.max(largest(q)) + atol
