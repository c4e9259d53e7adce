"""The generalised-alpha step with contacts that are closed: one factorisation, order 2 through every switch.

The residual holds the contact forces f0 of the start of the step; what they change by is answered linearly,

    w1 = wf + G df,    G = A^-1 J^T,    y1 = yf + h gamma' K df,    K = J G,

f standing for the free step, with f0, and gamma' = gamma (1 - alpha_f)/(1 - alpha_m). The modes that contacts have at
the start give df (contact_modes.py). Where that lets a contact pull, hold more than friction allows, or slide
backwards, the step is gone through from switch to switch. Behind it q, v, w and a go along G to where the modes have
them: gaps to 0, rates of what is held to 0, and accelerations onto the branch of the end, so that no jump enters the
recursion.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax.numpy as jnp

from hhtjax.description import Array, PyTree
from hhtjax.numerics.batched_cond import call_where
from hhtjax.numerics.coulomb import SmallInverse, inverted
from hhtjax.numerics.dense_lu import matvec
from hhtjax.steppers.constrained import report_constraints
from hhtjax.steppers.contact_modes import (
    FINE,
    ROUNDING,
    Course,
    Modes,
    Moment,
    matrix,
    right_side,
    settled,
    to_the_end,
)
from hhtjax.steppers.friction import each_row, equations_of, free_step
from hhtjax.steppers.stepper import ContactState
from hhtjax.systems.constraints import answers, curvature
from hhtjax.systems.contact import directions, rates, rates_of_rates, reaction, speeds
from hhtjax.systems.friction import across

if TYPE_CHECKING:
    from hhtjax.steppers.stepper import State
    from hhtjax.systems.flat_system import FlatSystem

CLOSED = 1e-9  # part of what moves in a step, within which the rate of a gap is 0
TOUCHING = 1e-6  # the same of a gap: an event that is located to rounding of the time
CORRECTIONS = 2  # of the gap
PENETRATES = 4.0  # the code of a step, as those of contact_modes.py


def begin_contact(method, system: FlatSystem, q: Array, v: Array, t: Array, params: PyTree, dt: Array) -> State:
    """The state at the start: who is closed, who sticks, and the accelerations of that."""
    at = q, v, t, params
    factorize = method.factorize_for(system) if system.num_constraints else method.factorize
    answer = answers(system, q, t, params, factorize=factorize)
    w, _ = answer(system.force(*at), -curvature(system, *at) if system.num_constraints else None)
    J, mu = directions(system, q, t, params), system.contact.friction(params)
    G = jnp.stack([answer(row)[0] for row in J])
    K, ydot = across(J, G), rates_of_rates(system, q, v, w, t, params)
    modes, _ = settled(K, ydot, _touching(system, at, J, w, dt), mu)
    f = inverted(matrix(K, modes, mu))(right_side(ydot, jnp.zeros_like(ydot), modes, mu))

    def force(q: Array, v: Array, t: Array, params: PyTree) -> Array:
        return system.force(q, v, t, params) + reaction(system, q, t, params, f)

    s = method.begin(system._replace(force=force, contact=None), *at, dt)
    return s._replace(contact=ContactState(f, *modes))


def _touching(system: FlatSystem, at: tuple, J: Array, w: Array, h: Array) -> Modes:
    """Contacts that are closed, but for those that the accelerations take apart, and who of them slides."""
    q, v, t, params = at
    m, gap, y = system.contact.size, system.contact.gap(q, t, params), rates(system, *at)
    fast = speeds(J, v, w, h)
    small = max(CLOSED, 1e3 * float(jnp.finfo(q.dtype).eps)) * fast
    closed = (jnp.abs(gap) <= TOUCHING * h * fast) & (jnp.abs(y[:m]) <= small)
    slides = closed & (jnp.abs(y[m:]) > small)
    return Modes(closed.astype(q.dtype), jnp.where(slides, jnp.sign(y[m:]), 0))


class End(NamedTuple):
    """How contacts come out of a step: the modes, the integral of the rates over theta, the forces; by how much those
    in the residual change, which rates are corrected by what, by what held ones are, and the code."""

    modes: Modes
    moved: Array
    f: Array
    df: Array
    there: Array
    of_path: SmallInverse
    of_held: SmallInverse
    code: Any


def bind_contact(method, system: FlatSystem, params: PyTree, dt: Array):
    """The step: the free one, what contacts make of it, and what becomes of the state behind that."""
    mu, c, size = system.contact.friction(params), method.coefficients, system.size
    lag = dt * c.gamma * (1 - c.alpha_f) / (1 - c.alpha_m)

    def step(s: State):
        f0 = s.contact.f
        r, path, z, shift, B = equations_of(method, system, params, dt, s)

        def loaded(s1: State) -> Array:
            push = reaction(system, s1.q, s1.t, params, f0)
            return r(s1) - jnp.pad(push, (0, z.size - size))

        factorize = method.factorize_for(system) if system.num_constraints else method.factorize
        at = path(z)
        z, info, inverse, _ = free_step(method.options, system, loaded, path, z, s, factorize, None)
        J = directions(system, at.q, at.t, params)
        answers = each_row(inverse, jnp.pad(J, ((0, 0), (0, z.size - size))))
        G = answers[:, :size]
        K, yf = across(J, G), rates(system, at.q, path(z).v, at.t, params)
        end = _end(s.contact, K, rates(system, s.q, s.v, s.t, params), yf, mu, lag, dt)
        z = z + matvec(answers.T, end.df)
        x = method.advance(s, dt, z[:size])[0]
        if shift is not None and (taken := shift(z[size + system.num_constraints :])) is not None:
            x = x - taken
        s1 = system.tidy(_behind(system, params, dt, s, path(z), x, end, answers, J, f0, mu))
        through = _goes_through(system, params, dt, s1, J, mu)
        info = info._replace(contact=jnp.maximum(end.code, jnp.where(through, PENETRATES, FINE).astype(dt.dtype)))
        return s1, info if B is None else report_constraints(method, system, params, dt, s, s1, info, B)

    return step


def _goes_through(system: FlatSystem, params: PyTree, h: Array, s: State, J: Array, mu: Array) -> Array:
    """Whether bodies that do not touch are in each other."""
    m, gap = system.contact.size, system.contact.gap(s.q, s.t, params)
    small = max(CLOSED, 1e3 * float(jnp.finfo(gap.dtype).eps)) * h * matvec(jnp.abs(J), jnp.abs(s.v))[:m]
    return jnp.any((s.contact.closed == 0) & (gap < -small))


def _end(s: ContactState, K: Array, y0: Array, yf: Array, mu: Array, lag: Array, h: Array) -> End:
    """How contacts come out of a step. y0: rates at its start; yf: those at its end with the forces of the start; lag:
    what K is multiplied by in between."""
    m, modes, f0 = len(mu), Modes(s.closed, s.sig), s.f
    closed, stuck, slides = modes.which(mu)
    held = modes.held(mu)
    y0 = jnp.where(held, 0, y0)
    of_held = inverted(matrix(K, modes, mu))
    df = of_held(right_side(yf / lag, f0, modes, mu))
    y1, f1 = jnp.where(held, 0, yf + lag * matvec(K, df)), f0 + df
    noise = ROUNDING * float(jnp.finfo(f1.dtype).eps) * jnp.max(jnp.abs(f1))
    good = jnp.all(~closed | (f1[:m] >= -noise)) & jnp.all(~stuck | (jnp.abs(f1[m:]) <= mu * f1[:m] + noise))
    good = good & jnp.all(~slides | (mu == 0) | (modes.sig * y1[m:] >= 0))
    steady = End(modes, (y0 + y1) / 2, f1, df, held, of_held, of_held, jnp.zeros_like(h))

    def switches(steady: End, y0: Array, yf: Array, y1: Array, f0: Array, K: Array) -> End:
        begin = Moment(jnp.zeros_like(h), y0, steady.modes, jnp.zeros_like(y0), f0, jnp.zeros_like(h))
        at = to_the_end(begin, Course(y1 - y0, f0, steady.df, h * K, mu))
        there = jnp.concatenate([closed, closed & (mu > 0)])
        block = inverted(jnp.where(there[:, None] & there[None, :], K, jnp.eye(2 * m, dtype=K.dtype)))
        df = block(jnp.where(there, (at.y - yf) / lag, 0))
        return End(at.modes, at.moved, at.f, df, there, block, inverted(matrix(K, at.modes, mu)), at.code)

    return call_where(switches, ~good, steady, y0, yf, y1, f0, K)


def _behind(
    system: FlatSystem,
    params: PyTree,
    h: Array,
    s: State,
    s1: State,
    x: Array,
    end: End,
    answers: Array,
    J: Array,
    f0: Array,
    mu: Array,
) -> State:
    """The state s1 at the end of the step, displaced by x, moved to where the modes of its end have it."""
    n, size = system.num_constraints, system.size
    gap, y = system.contact.gap, partial(rates, system, params=params)
    closed, *_ = end.modes.which(mu)
    held = end.modes.held(mu)
    Gv = system.widened(answers[:, : system.positions])  # internal states do not jump
    moved = h * y(system.move(s.q, x / 2), x / h, s.t + h / 2)
    x = x + matvec(Gv.T, end.of_path(jnp.where(end.there, h * end.moved - moved, 0)))
    for _ in range(CORRECTIONS):
        open_by = jnp.where(closed, gap(system.move(s.q, x), s1.t, params), 0)
        x = x - matvec(Gv.T, end.of_held(jnp.concatenate([open_by, jnp.zeros_like(open_by)])))
    q = system.move(s.q, x)
    v = s1.v - matvec(Gv.T, end.of_held(jnp.where(held, y(q, s1.v, s1.t), 0)))
    jump = end.f - f0 - end.df
    w = s1.w + matvec(Gv.T, jump)
    change = end.of_held(right_side(rates_of_rates(system, q, v, w, s1.t, params), end.f, end.modes, mu))
    w = w + matvec(Gv.T, change)
    a = s1.a - matvec(Gv.T, end.of_path(jnp.where(end.there, matvec(J, s1.a - w), 0)))
    if s1.L is not None:
        s1 = s1._replace(L=s1.L + matvec(answers[:, size : size + n].T, jump + change))
    return s1._replace(q=q, v=v, w=w, a=a, contact=ContactState(end.f + change, *end.modes))
