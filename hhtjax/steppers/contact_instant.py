"""Contacts at an instant: which of them are closed afterwards, and the velocities, accelerations and forces.

    impact:      v := v + M^-1 J^T (C + E)     by Poisson's law, compression and expansion (numerics/coulomb.py)
    closing:     contacts whose flight would be shorter than a step stay closed
    modes:       of the closed ones, by the complementarity problem of their accelerations
    forces:      f, for these modes, and w = M^-1 (Q + J^T f)

Poisson's law does not create energy; Newton's, with friction, can. A contact that depends on a closed one lands without
restitution.

References: F. Pfeiffer, C. Glocker, Multibody Dynamics with Unilateral Contacts, 1996, Sec. 8; D. Stewart, J. Trinkle,
Int. J. Numer. Methods Eng. 39, 1996, 2673-2691 (the complementarity problem).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import jax.numpy as jnp

from hhtjax.description import Array, PyTree
from hhtjax.numerics.coulomb import choice, impulses, inverted
from hhtjax.numerics.dense_lu import diagonal, product
from hhtjax.steppers.contact_modes import Modes, matrix, right_side
from hhtjax.steppers.stepper import ContactState, State
from hhtjax.steppers.variable_step import drifted
from hhtjax.systems.constraints import answers, curvature
from hhtjax.systems.contact import Fault, directions, rates, rates_of_rates, speeds
from hhtjax.systems.contact_start import nearly_closed
from hhtjax.systems.friction import across

if TYPE_CHECKING:
    from hhtjax.steppers.contact_modes import Switch
    from hhtjax.systems.flat_system import FlatSystem

STILL = 1e-9  # part of what moves in a step, within which a rate is 0
NEAR = 1e-6  # the same of a gap that is closed
SHORT = 1.0  # steps: a flight that is shorter does not begin
LATE = 0.1  # part of a step, by which a landing or a stop may be corrected
COUPLED = 1e-9  # of what a force does to its own contact, that it does to another


class Place(NamedTuple):
    """The effect of contact forces at a position: answer, force -> accelerations and multipliers; J; G = M^-1 J^T and
    its multipliers, by rows; K = J G."""

    answer: Any
    J: Array
    G: Array
    pulls: Any
    K: Array


def _place(method, system: FlatSystem, q: Array, t: Array, params: PyTree) -> Place:
    factorize = method.factorize_for(system) if system.num_constraints else method.factorize
    answer, J = answers(system, q, t, params, factorize=factorize), directions(system, q, t, params)
    G, pulls = zip(*[answer(row) for row in J], strict=True)
    G = jnp.stack(G)
    return Place(answer, J, G, None if pulls[0] is None else jnp.stack(pulls), across(J, G))


def begin_contact(method, system: FlatSystem, q: Array, v: Array, t: Array, params: PyTree, h: Array) -> State:
    """The state at a start: contacts that touch are closed, unless their accelerations separate them."""
    place, m = _place(method, system, q, t, params), system.contact.size
    w, _ = _free(system, place, q, v, t, params)
    fast, y = speeds(place.J, v, w, h), rates(system, q, v, t, params)
    near = jnp.maximum(NEAR * h * fast, nearly_closed(system, q, place.J))
    down = (jnp.abs(system.contact.gap(q, t, params)) <= near) & (jnp.abs(y[:m]) <= _still(fast))
    sig = jnp.where(jnp.abs(y[m:]) > _still(fast), jnp.sign(y[m:]), 0)
    zero = jnp.zeros_like(fast)
    unknown = ContactState(jnp.zeros_like(y), zero, sig, zero, zero - jnp.inf, zero, jnp.zeros_like(t))
    return _anew(system, place, State(t, q, v, w, w, contact=unknown), down, sig, params)


def past_switch(method, system: FlatSystem, params: PyTree, before: tuple, switch: Switch, at_once: Array, h: Array):
    """The state after a switch, and how much later it is than the state before. at_once: whether the switch is at the
    start of the part being tried. A contact that lands there without speed has separated only by an error of the step,
    and stays closed. h: the whole step."""
    s, _ = before
    contact, m = system.contact, system.contact.size
    late = _late(system, params, s, switch, h)
    s = drifted(system, s, late)
    q, v, t = s.q, s.v, s.t
    place, y, mu = _place(method, system, q, t, params), rates(system, q, v, t, params), contact.friction(params)
    fast, modes = speeds(place.J, v, s.w, h), Modes(s.contact.closed, s.contact.sig).behind(switch)
    closed = modes.closed > 0
    meets = (contact.gap(q, t, params) <= NEAR * h * fast) & (y[:m] < -_still(fast))
    hits = ~closed & ((switch.lands > 0) | meets)
    counted = hits & (y[:m] < -_still(fast))
    stays = hits & ~counted & at_once
    here = closed | hits
    coupled = jnp.abs(place.K[:m, :m]) > COUPLED * jnp.abs(diagonal(place.K)[:m, None])
    others = coupled & here[None, :] & ~jnp.eye(m, dtype=bool)
    e = contact.restitution(params)
    several = jnp.any(jnp.any(others & hits[None, :], axis=1) & hits & (e > 0))
    e = jnp.where(hits & ~jnp.any(others, axis=1), e, 0)
    struck = jnp.any(hits)
    imp = impulses(place.K, y, mu, e, here & struck)
    v, y = v + product(place.G.T, imp), y + product(place.K, imp)

    w, _ = _free(system, place, q, v, t, params)
    falling = -rates_of_rates(system, q, v, w, t, params)[:m]
    flies = y[:m] > _still(fast)
    down = here & (~flies | (2 * y[:m] <= SHORT * h * falling))
    slides = jnp.where(jnp.abs(y[m:]) > _still(fast), jnp.sign(y[m:]), jnp.where(struck, 0, modes.sig))
    slides = jnp.where(switch.stops > 0, 0, slides)
    v = _held(place, Modes(down.astype(v.dtype), slides).held(mu), v, y)
    # what would still bounce, infinitely often, rests behind all that
    zeno = jnp.where(flies & down, 2 * y[:m] / jnp.where(down & flies, falling * (1 - e), 1), 0)
    since, impacts = jnp.where(closed, s.contact.since, t + zeno), s.contact.impacts + counted.astype(h.dtype)
    code = jnp.where(several, Fault.SEVERAL, 0).astype(h.dtype)
    known = s.contact._replace(since=since, impacts=impacts, code=code)
    return _anew(system, place, s._replace(v=v, contact=known), down, slides, params, stays), late


def jumped_contact(method, system: FlatSystem, s: State, params: PyTree, h: Array) -> State:
    """The state where forces jump: closed contacts separate or start to slide at once, if they must."""
    place, m = _place(method, system, s.q, s.t, params), system.contact.size
    along = rates(system, s.q, s.v, s.t, params)[m:]
    slides = jnp.where(jnp.abs(along) > _still(speeds(place.J, s.v, s.w, h)), s.contact.sig, 0)
    return _anew(system, place, s, s.contact.closed > 0, slides, params)


def _late(system: FlatSystem, params: PyTree, s: State, switch: Switch, h: Array) -> Array:
    """How much later than at a state the gap of a landing contact, or the velocity of a stopping one, is 0: one Newton
    step, because the state is close."""
    m = len(switch.lands)
    y, ydot = rates(system, s.q, s.v, s.t, params), rates_of_rates(system, s.q, s.v, s.w, s.t, params)
    some = jnp.concatenate([switch.lands, switch.stops]) > 0
    value = jnp.concatenate([system.contact.gap(s.q, s.t, params), y[m:]])
    slope = jnp.concatenate([jnp.minimum(y[:m], 0), ydot[m:]])
    late = -value / jnp.where(slope == 0, jnp.inf, slope)
    late = jnp.where(some & (jnp.abs(late) <= LATE * h), late, jnp.inf)
    first = jnp.arange(2 * m) == jnp.argmin(late)
    return jnp.sum(jnp.where(first & jnp.isfinite(late), late, 0))


def _held(place: Place, held: Array, v: Array, y: Array) -> Array:
    """The velocities for which the held rates y, (2 m,), are 0."""
    S = jnp.where(held[:, None], place.K, jnp.eye(len(y), dtype=y.dtype))
    return v + product(place.G.T, inverted(S)(jnp.where(held, -y, 0)))


def _anew(
    system: FlatSystem, place: Place, s: State, down: Array, sig: Array, params: PyTree, stays: Array | None = None
):
    """The state with the modes, forces and accelerations of closed contacts. sig: their sliding directions, 0 for those
    that do not slide. stays: (m,), which of them are closed whatever their force."""
    q, v, t, mu = s.q, s.v, s.t, system.contact.friction(params)
    w, L = _free(system, place, q, v, t, params)
    ydot = rates_of_rates(system, q, v, w, t, params)
    found = choice(place.K, ydot, mu, jnp.zeros_like(mu), down, jnp.where(down, sig, 0))
    closed = found.pushes if stays is None else found.pushes | (stays & down)
    modes = Modes(closed.astype(v.dtype), jnp.where(closed, found.sig, 0))
    f = inverted(matrix(place.K, modes, mu))(right_side(ydot, jnp.zeros_like(ydot), modes, mu))
    w = w + product(place.G.T, f)
    L = None if L is None else L + product(place.pulls.T, f)
    code = jnp.where(found.jams, Fault.JAMMED, jnp.where(found.found, 0, Fault.NO_FORCES)).astype(v.dtype)
    known = s.contact._replace(sticks=modes.which(mu)[1].astype(v.dtype), code=jnp.maximum(s.contact.code, code))
    return s._replace(v=v, w=w, a=w, L=L, contact=known._replace(f=f, closed=modes.closed, sig=modes.sig))


def _free(system: FlatSystem, place: Place, q: Array, v: Array, t: Array, params: PyTree):
    """Accelerations and multipliers without contact forces."""
    rows = (-curvature(system, q, v, t, params),) if system.num_constraints else ()
    return place.answer(system.force(q, v, t, params), *rows)


def _still(fast: Array) -> Array:
    return max(STILL, 1e3 * float(jnp.finfo(fast.dtype).eps)) * fast
