"""The generalised-alpha step with contacts. Closed contacts are modes of the step, which is divided where one switches.

The residual contains the contact forces f0 of the start of the step. The effect of their change df is linear,

    w1 = wf + G df,    G = A^-1 J^T,    y1 = yf + h gamma' K df,    K = J G,

where the suffix f denotes the free step, with f0, and gamma' = gamma (1 - alpha_f)/(1 - alpha_m). The modes of contacts
determine df (contact_modes.py). Then q, v, w and a are moved along G to satisfy the modes: gaps become 0, rates of held
contacts become 0, and accelerations agree with the forces.

If a contact separates, starts to slide, stops or lands within the step, the step is taken again, up to that instant.
There accelerations and forces start anew (contact_instant.py), with the velocities after an impact, and the rest of the
step follows. The instant is a differentiable function of both ends of the step that was tried first.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax.numpy as jnp
from jax import lax

from hhtjax.description import Array, PyTree
from hhtjax.numerics.batched_cond import call_where, tree_where
from hhtjax.numerics.checkpointed_scan import checkpoint
from hhtjax.numerics.coulomb import inverted
from hhtjax.numerics.dense_lu import product
from hhtjax.steppers.constrained import report_constraints
from hhtjax.steppers.contact_instant import past_switch
from hhtjax.steppers.contact_modes import (
    ROUNDING,
    Course,
    Modes,
    Switch,
    asks,
    first_switch,
    matrix,
    presses,
    right_side,
)
from hhtjax.steppers.friction import each_row, equations_of, free_step
from hhtjax.steppers.stepper import join_info
from hhtjax.steppers.variable_step import drifted, moved
from hhtjax.systems.contact import Fault, directions, rates, rates_of_rates, reaction
from hhtjax.systems.friction import across

if TYPE_CHECKING:
    from hhtjax.steppers.stepper import Info, State
    from hhtjax.systems.flat_system import FlatSystem

SWITCHES = 4, 2  # in a step, and for each contact
CORRECTIONS, MORE = 2, 24  # of the gap; and where it is not closed yet
OPEN = 64.0  # of what may be rounding, beyond which the gap of a closed contact has stayed open


def bind_contact(method, system: FlatSystem, params: PyTree, dt: Array):
    """The step, State -> (State, Info)."""
    mu = system.contact.friction(params)

    def step(s: State):
        s1, info, course = _part(method, system, params, s, dt)
        switches = jnp.any(jnp.concatenate(asks(course, Modes(s.contact.closed, s.contact.sig), mu)))
        return call_where(partial(_in_parts, method, system, params), switches, (s1, info), s, dt)

    return step


class Way(NamedTuple):
    """The remainder of a step: from `start`, of size `rest`. The next part has the size `aim`, and ends with a switch,
    if there is one. end: of the whole step, once it is `done`."""

    start: Any
    rest: Array
    aim: Array
    switch: Switch
    end: Any
    info: Info
    done: Array


def _in_parts(method, system: FlatSystem, params: PyTree, found: tuple, s: State, h: Array):
    """The step h from s, divided where contacts switch."""
    end, info = found
    way = Way(s, h, h, Switch.none(s.contact.closed), end, info, jnp.zeros_like(h))

    @checkpoint
    def visit(way: Way, _):
        return call_where(partial(_go_on, method, system, params), way.done == 0, way, h), None

    first, more = SWITCHES
    way = lax.scan(visit, way, length=1 + 2 * (first + more * system.contact.size))[0]
    divided = way.rest < h  # if so, a is made for another step than the next
    end = way.end._replace(t=s.t + h, a=jnp.where(divided, way.end.w, way.end.a))
    code = jnp.where((way.done == 0) & (way.info.contact == 0), Fault.MANY, way.info.contact)
    return end, way.info._replace(contact=code)


def _go_on(method, system: FlatSystem, params: PyTree, way: Way, h: Array) -> Way:
    """The next part of a step h: to its end, or, if a contact switches before, a shorter one to be tried next."""
    s, aim = way.start, way.aim
    short = h * math.sqrt(float(jnp.finfo(h.dtype).eps))
    size = jnp.maximum(aim, short)
    s1, info, course = _part(method, system, params, moved(s, size / h), size)
    theta, switch = first_switch(course, Modes(s.contact.closed, s.contact.sig), system.contact.friction(params))
    s1 = tree_where(aim <= short, drifted(system, s, aim), s1)
    switches = way.switch.any()
    fails = ~switches & (theta < 1) & (aim > short)
    past = partial(past_switch, method, system, params)
    s2, late = call_where(past, switches, (s1, jnp.zeros_like(h)), way.switch, aim <= short, h)
    start = tree_where(switches, s2, s)
    rest = jnp.where(switches, way.rest - aim - late, way.rest)
    aim = jnp.where(fails, theta * aim, rest)
    none = Switch.none(s.contact.closed)
    done = (~switches & ~fails).astype(h.dtype)
    info = tree_where(fails, way.info, join_info(way.info, info))
    return Way(start, rest, aim, tree_where(fails, switch, none), tree_where(done > 0, s1, s2), info, done)


def _part(method, system: FlatSystem, params: PyTree, s: State, h: Array):
    """The step h from s in which all contacts keep their modes, its `Info`, and its `Course`."""
    mu, c, size, n = system.contact.friction(params), method.coefficients, system.size, system.num_constraints
    modes, f0, y = Modes(s.contact.closed, s.contact.sig), s.contact.f, partial(rates, system, params=params)
    r, path, z, shift, B = equations_of(method, system, params, h, s)

    def loaded(s1: State) -> Array:
        push = reaction(system, s1.q, s1.t, params, f0)
        return r(s1) - jnp.pad(push, (0, z.size - size))

    factorize = method.factorize_for(system) if n else method.factorize
    at = path(z)
    z, info, inverse, _ = free_step(method.options, system, loaded, path, z, s, factorize, None)
    J = directions(system, at.q, at.t, params)
    answers = each_row(inverse, jnp.pad(J, ((0, 0), (0, z.size - size))))  # by rows: G, and what it does to L
    K = across(J, answers[:, :size])
    forces = partial(product, inverted(matrix(K, modes, mu)).near)
    lag = h * c.gamma * (1 - c.alpha_f) / (1 - c.alpha_m)
    df = forces(right_side(y(at.q, path(z).v, at.t) / lag, f0, modes, mu))

    z = z + product(answers.T, df)
    x, s1 = method.advance(s, h, z[:size])[0], path(z)
    if shift is not None and (taken := shift(z[size + n :])) is not None:
        x = x - taken
    G = system.widened(answers[:, : system.positions]).T  # internal states do not jump
    held, roundings = modes.held(mu), _roundings(s1, J, K, f0 + df, h)

    def taken_off(rates: Array) -> Array:
        """The change of forces that makes these values 0 where they are held."""
        return product(G, forces(jnp.where(held, rates, 0)))

    q = system.move(s.q, _closed_up(system, params, s, x, h, held, taken_off, roundings[0]))
    y1 = y(q, s1.v, s1.t)
    v = s1.v - taken_off(y1)
    more = forces(right_side(rates_of_rates(system, q, v, s1.w, s1.t, params), f0 + df, modes, mu))
    w = s1.w + product(G, more)
    a = s1.a - taken_off(product(J, s1.a - w))
    L = None if s1.L is None else s1.L + product(answers[:, size : size + n].T, more)
    contact = s.contact._replace(f=f0 + df + more, code=jnp.zeros_like(h))
    s1 = system.tidy(s1._replace(q=q, v=v, w=w, a=a, L=L, contact=contact))
    course, code = _course(system, params, s, s1, y1, modes, presses(K, modes, mu), roundings)
    info = info._replace(contact=jnp.maximum(s.contact.code, code))
    return s1, info if B is None else report_constraints(method, system, params, h, s, s1, info, B), course


def _closed_up(
    system: FlatSystem,
    params: PyTree,
    s: State,
    x: Array,
    h: Array,
    held: Array,
    taken_off: Callable,
    of_gap: Array,
) -> Array:
    """The displacement x, corrected so that gaps of closed contacts are 0, and sticking contacts do not move."""
    m = len(of_gap)

    def gaps(x: Array) -> Array:
        return system.contact.gap(system.move(s.q, x), s.t + h, params)

    def closer(x: Array, slid: Array) -> Array:
        return x - taken_off(jnp.concatenate([gaps(x), slid]))

    slid = h * system.contact.sliding(system.move(s.q, x / 2), x / h, s.t + h / 2, params)
    x = closer(x, slid)
    for _ in range(CORRECTIONS - 1):
        x = closer(x, jnp.zeros_like(slid))

    def again(x: Array) -> Array:
        return lax.fori_loop(0, MORE, lambda _, x: closer(x, jnp.zeros_like(slid)), x)

    return call_where(again, jnp.any(held[:m] & (jnp.abs(gaps(x)) > of_gap)), x)


def _course(
    system: FlatSystem,
    params: PyTree,
    s: State,
    s1: State,
    y1: Array,
    modes: Modes,
    pressing: Array,
    roundings: tuple,
):
    """The `Course` from s to s1, with the rates y1 at the end, and what has gone wrong in it. pressing: of
    `presses`."""
    gap, closed, held = system.contact.gap, modes.closed > 0, modes.held(system.contact.friction(params))
    g0, g1, y0 = gap(s.q, s.t, params), gap(s1.q, s1.t, params), rates(system, s.q, s.v, s.t, params)
    ends = (jnp.where(closed, 0, g0), jnp.where(closed, 0, g1)), (jnp.where(held, 0, y0), jnp.where(held, 0, y1))
    course = Course(s1.t - s.t, *ends, (s.contact.f, s1.contact.f), roundings)
    jams, opens = closed & (pressing <= 0), closed & (jnp.abs(g1) > OPEN * roundings[0])
    code = jnp.where(jnp.any(jams), Fault.JAMMED, jnp.where(jnp.any(opens), Fault.OPEN, 0)).astype(s.t.dtype)
    return course, code


def _roundings(s: State, J: Array, K: Array, f: Array, h: Array):
    """How far gaps, rates and forces may be beyond 0: the roundings of their terms, including contact forces."""
    few, m = ROUNDING * float(jnp.finfo(f.dtype).eps), len(J) // 2
    along, pushed = product(jnp.abs(J), jnp.abs(s.v))[m:], h * product(jnp.abs(K), jnp.abs(f))
    of_gap = jnp.sum(jnp.abs(J[:m]), axis=1) * jnp.max(jnp.abs(s.q)) + h * pushed[:m]
    return few * of_gap, few * (along + pushed[m:]), few * jnp.max(jnp.abs(f))
