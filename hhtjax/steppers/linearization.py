"""The state about which the non-iterative step expands its residual: where it is worth the most."""

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax

from hhtjax.numerics.elimination import diagonal
from hhtjax.steppers.newton import left_by, told
from hhtjax.steppers.residual import residual
from hhtjax.xla import staged

HELD_THRESHOLD = 0.3  # "auto": residual, relative to M w, above which the held point may be preferred


def linearization_point(system, params, s, predicted, where):
    """The state at t1 about which the non-iterative step expands r; None for the predictor itself."""
    if where == "predictor":
        return None
    if where == "state":
        return s._replace(t=predicted.t)
    held = s._replace(t=predicted.t, q=system.move(s.q, (predicted.t - s.t) * s.v))
    if where == "held":
        return held
    D = system.with_ones(diagonal(system.mass(s.q, params)))

    @staged
    def size(s):
        return jnp.sum(residual(system, params, s) ** 2 / D)

    predicted_size = size(predicted)
    use_predictor = lax.cond(
        predicted_size <= HELD_THRESHOLD**2 * jnp.sum(D * s.w**2),
        lambda: jnp.array(True),
        lambda: predicted_size <= size(held),
    )
    return jax.tree.map(partial(jnp.where, use_predictor), predicted, held)


def refresh(system, params, c, s, factorize):
    """The state with the acceleration that its q and v ask for, w = M^-1 Q, and what the solve left."""
    Q = system.force(s.q, s.v, s.t, params)
    w = system.acceleration(s.q, s.v, s.t, params, factorize)
    left = left_by(factorize, lambda w: system.inertia(s.q, w, params), Q, w)
    return s._replace(w=w, a=s.a + (1 - c.alpha_f) / (1 - c.alpha_m) * (w - s.w)), told(factorize, left)
