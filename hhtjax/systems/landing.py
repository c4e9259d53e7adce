"""Impacts of contacts: what the velocities become where bodies meet that were apart.

    compression: C >= 0 with (y + K C)_N >= 0, of each contact one is 0, and Coulomb's law for (y + K C)_T
    expansion:   E, the same from y + K C on, with E_N >= e C_N
    v+ = v + M^-1 J^T (C + E)

Poisson's law of restitution, in each phase with friction. It makes no energy; Newton's, with friction, can.

References: F. Pfeiffer, C. Glocker, Multibody Dynamics with Unilateral Contacts, 1996, Sec. 8; D. Stewart, J. Trinkle,
Int. J. Numer. Methods Eng. 39, 1996, 2673-2691 (the complementarity problem).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax.numpy as jnp

from hhtjax.description import Array, PyTree
from hhtjax.numerics.coulomb import choice, impulses, inverted
from hhtjax.numerics.dense_lu import matvec
from hhtjax.systems.constraints import answers, curvature
from hhtjax.systems.contact import directions, rates, rates_of_rates, speeds
from hhtjax.systems.friction import across

if TYPE_CHECKING:
    from hhtjax.systems.flat_system import FlatSystem

FAR = 1.0  # m, or what the gap is in: of a contact that is closed, whose gap is a rounding of 0 and no guard
NEAR = 1e-6  # part of what moves in a step, within which a contact takes part in an impact
SHORT = 1.0  # steps: a flight that is shorter does not begin


def guards(system: FlatSystem, s: Any, params: PyTree) -> Array:
    """(m,): the gaps of contacts that are open."""
    assert system.contact is not None
    return jnp.where(s.contact.closed > 0, FAR, system.contact.gap(s.q, s.t, params))


def landed(system: FlatSystem, s: Any, params: PyTree, h: Array, redundant=None) -> Array:
    """The velocities (N,) behind an impact at a state s in which a gap has closed; h: the step, by which flights that
    are too short for it are known."""
    contact = system.contact
    assert contact is not None
    m = contact.size
    q, v, t = s.q, s.v, s.t
    answer = answers(system, q, t, params, redundant)
    J, y = directions(system, q, t, params), rates(system, q, v, t, params)
    G = jnp.stack([answer(row)[0] for row in J])
    fast = speeds(J, v, s.w, h)
    closed = s.contact.closed > 0
    here = closed | (contact.gap(q, t, params) <= NEAR * h * fast)
    hits = here & ~closed & (y[:m] < 0)
    e = jnp.where(jnp.any(closed & here), 0, contact.restitution(params))
    falling = -rates_of_rates(system, q, v, s.w, t, params)[:m]
    short = hits & (2 * e * -y[:m] <= SHORT * h * falling)
    e = jnp.where(hits & ~short, e, 0)
    K, mu, small = across(J, G), contact.friction(params), NEAR * fast
    f = impulses(K, y, mu, e, here)
    v = v + matvec(G.T, f)
    if m == 1:
        return v
    w, _ = answer(
        system.force(q, v, t, params), -curvature(system, q, v, t, params) if system.num_constraints else None
    )
    return v + matvec(
        G.T, _settling(K, y + matvec(K, f), rates_of_rates(system, q, v, w, t, params), mu, here, small, h)
    )


def _settling(K: Array, y: Array, ydot: Array, mu: Array, here: Array, small: Array, h: Array) -> Array:
    """The impulses (2 m,) that keep contacts down which an impact of another lets up, for a flight too short for the
    step: as those of a block do that comes to rest on both its corners, in infinitely many impacts."""
    m = len(mu)
    rests = here & (y[:m] <= small)
    slides = jnp.where(jnp.abs(y[m:]) > small, jnp.sign(y[m:]), 0)
    falling = -(ydot + matvec(K, choice(K, ydot, mu, jnp.zeros_like(mu), rests, slides).f))[:m]
    short = here & ~rests & (2 * y[:m] <= SHORT * h * falling)
    down = (rests | short) & jnp.any(short)
    held = jnp.concatenate([down, down & (slides == 0) & (mu > 0)])
    S = jnp.where(held[:, None], K, jnp.eye(2 * m, dtype=K.dtype))
    return inverted(S)(jnp.where(held, -y, 0))
