"""Samples between the ends of steps: read off from the two states around each of the times."""

import jax
import jax.numpy as jnp

from hhtjax.runs.interpolate import between
from hhtjax.runs.loop import saved
from hhtjax.steppers.stepper import State, public

TINY = 1e-9  # part of a run


def kept(flat, stepper, state):
    """What is saved of a state, and what its dense output adds."""
    extra = None
    if stepper.dense_term:
        e_q, e_v = state.memory
        extra = public(flat, State(state.t, e_q, e_v, 0 * e_v))
        extra = extra.q, (None if flat.positions == 0 else extra.v), extra.z
    return saved(flat, state), extra


def read_off(flat, pair, extra, times, reached):
    """The `Solution` at the times, each between the two of a pair; NaN beyond what was reached, and before them."""
    a, b = (jax.tree.map(lambda x: x[1:], run._replace(dt=None, info=None, failure=None)) for run in pair)
    start = jax.tree.map(lambda x: x[:1], pair[0]._replace(dt=None, info=None, failure=None))
    # a part of a step that is a rounding, behind an event, is the beginning of a long one
    long = times[-1] - start.t[0]
    H = jnp.where(b.t - a.t > TINY * long, b.t - a.t, long)
    s = jnp.where((a.t <= times) & (times <= reached), (times - a.t) / H, jnp.nan)
    found = between(a, b, H, s)
    if extra is not None:
        found = with_dense_term(flat, found, extra, s, H)
    path = jax.tree.map(lambda x, y: jnp.concatenate([x, y]), start, found._replace(t=times))
    return path._replace(info=pair[1].info, failure=pair[1].failure)


def with_dense_term(flat, found, extra, s, H):
    """`found`, with s^2 (1 - s)^2 times what the stepper's dense output adds to cubics, and the rate of that."""
    weight, rate = (s * (1 - s)) ** 2, 2 * s * (1 - s) * (1 - 2 * s) / H
    e_q, e_v, e_z = extra
    terms = [("q", flat.unravel, weight, e_q)]
    if flat.positions:
        terms += [("v", flat.unravel_rates, weight, e_v), ("acceleration", flat.unravel_rates, rate, e_v)]
        terms += [("z", flat.unravel_internal, weight, e_z), ("zdot", flat.unravel_internal, rate, e_z)]
    else:
        terms += [("v", flat.unravel_rates, rate, e_q)]
    for name, unravel, factor, e in terms:
        if e is not None:
            more = jax.vmap(unravel)(factor[:, None] * e)
            found = found._replace(**{name: jax.tree.map(jnp.add, getattr(found, name), more)})
    return found
