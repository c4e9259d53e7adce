"""The state about which the non-iterative step expands its residual: where it is worth the most."""

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax

from hhtjax.numerics.elimination import diagonal
from hhtjax.numerics.hoisted import hoisted
from hhtjax.numerics.seldom import choose, derivative_of, seldom
from hhtjax.steppers.newton import Expand, left_by, linearize_rows, linearized_solve, solve_expanded, told
from hhtjax.xla import staged, traced

HELD_THRESHOLD = 0.3  # "auto": residual, relative to M w, above which the held point may be preferred


def linearized_step(system, params, r, path, s, dt, factorize, where, again=False):
    """w at t + dt by one linearisation of r, about the state that `where` says, and its `Info`."""
    if where == "predictor":
        return linearized_solve(r, path, s.w, factorize, None, again)
    now = s._replace(t=s.t + dt)
    if where == "state":
        return linearized_solve(r, path, s.w, factorize, now, again)
    held = now._replace(q=system.move(s.q, dt * s.v))
    if where == "held":
        return linearized_solve(r, path, s.w, factorize, held, again)

    # each traced once, for both states that r is expanded about
    rows = partial(linearize_rows, r, linearize=linearize)
    expand = Expand(traced(rows, now), traced(partial(linearize, path), s.w), s.w)

    @jax.jit
    def solution(expansion):
        return solve_expanded(r, path, s.w, factorize, again, expansion)[:2]

    def about(at, first=None):
        expansion = expand(at, first)
        return *solution(expansion), expansion

    D = system.with_ones(diagonal(system.mass(s.q, s.t, params)))
    limit = HELD_THRESHOLD**2 * jnp.sum(D * s.w**2)
    ways = path(s.w), held, lambda r: jnp.sum(r * (r / D)), limit
    # derivatives by one expansion about the state that was chosen: through both they would take longer to compile
    return derivative_of(lambda: about(better_state(r, *ways))[:2], lambda: better_solve(about, *ways[1:]))


def linearize(f, x):
    """As JAX does it, with a tangent that can leave a jit, and is traced once, however often it is called."""
    value, tangent = jax.linearize(f, x)
    call, constants = hoisted(tangent, x)
    return value, jax.tree_util.Partial(call, constants)


def better_state(r, predicted, held, size, limit):
    """The predicted state; or the held one, where the residual at the predicted is large, and the larger one."""
    size = staged(lambda s, size=size: size(r(s)))
    predicted_size = size(predicted)
    use_predictor = lax.cond(predicted_size <= limit, lambda: jnp.array(True), lambda: predicted_size <= size(held))
    return choose(use_predictor, predicted, held)


def better_solve(about, held, size, limit):
    """The solution about that state, with a second evaluation of r only where the first residual is large.

    A branch around it all, and no choice of a state before it: the processor goes on while it waits for the residual.
    """
    w, info, first = about(None)
    predicted_size = size(first.here)

    def better(found):
        w, info, expansion = about(held, first)
        return choose(predicted_size <= size(expansion.here), found, (w, info))

    return seldom(better, ~(predicted_size <= limit), (w, info))


def refresh(system, params, c, s, factorize):
    """The state with the acceleration that its q and v ask for, w = M^-1 Q, and what the solve left."""
    Q = system.force(s.q, s.v, s.t, params)
    w = system.acceleration(s.q, s.v, s.t, params, factorize)
    left = left_by(factorize, lambda w: system.inertia(s.q, w, s.t, params), Q, w)
    return s._replace(w=w, a=s.a + (1 - c.alpha_f) / (1 - c.alpha_m) * (w - s.w)), told(factorize, left)
