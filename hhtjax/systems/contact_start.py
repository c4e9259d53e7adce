"""The check of a start with contacts: bodies are apart, or touch without approaching; coefficients are in range."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np

from hhtjax.description import Array, PyTree, Real, known_now
from hhtjax.numerics.dense_lu import matvec
from hhtjax.systems import kinematics
from hhtjax.systems.contact import Fault, directions, rates
from hhtjax.systems.flat_system import flatten
from hhtjax.xla import Programs

if TYPE_CHECKING:
    from hhtjax.systems.flat_system import FlatSystem

CLOSED = 1e-9  # of the coordinates that it is made of, as which a gap is 0
STILL = 1e-6  # of the velocities that a rate is made of, as which it is 0
ROUNDING = 1e-12  # a gap that is always 0: what is known of its size may be 0


def require_contact_start(
    caller: str, system, q0: PyTree, v0: PyTree, t0: Real, params: PyTree, z0: PyTree = None
) -> None:
    """Raises an error for a start in which bodies overlap, or touch and approach each other, and for coefficients out
    of range; tracers pass."""
    found = known_now(_start, system, q0, v0, t0, params, z0)
    if found is None:
        return
    gap, rate, friction, restitution, flaws = map(np.asarray, found)
    for name, x, most, range_ in (
        ("friction", friction, np.inf, "finite numbers, 0 or more"),
        ("restitution", restitution, 1, "numbers in [0, 1]"),
    ):
        if not np.all((x >= 0) & (x <= most) & np.isfinite(x)):
            raise ValueError(f"{caller}: `{name}` of the contacts must be {range_}; received {x}.")
    flaws = flaws.reshape(-1, flaws.shape[-1]).max(axis=0)
    for i in np.flatnonzero(flaws)[:1]:
        g, speed = (x.reshape(-1, x.shape[-1])[:, i] for x in (gap, rate))
        if flaws[i] == Fault.OVERLAP:
            raise ValueError(
                f"{caller}: `q0` must keep bodies apart: the gap of contact {i} is {g.min():.6g}; expected 0 or more."
            )
        raise ValueError(
            f"{caller}: `v0` must not press bodies together that touch: the gap of contact {i} is 0 and changes by "
            f"{speed.min():.6g} a unit of time; expected 0 or more. Start before the impact, or after it."
        )


@Programs
def _start(system, q0: PyTree, v0: PyTree, t0: Array, params: PyTree, z0: PyTree):
    """The gaps, their rates, the coefficients, and what is wrong with each contact."""
    flat, q, v = flatten("simulate", system, q0, v0, t0, params, z0)
    t = jnp.asarray(t0).astype(q.dtype)
    m = flat.contact.size
    contact = flat.contact
    coefficients = contact.friction(params), contact.restitution(params)
    flaws = start_flaws(flat, q, v, t, params)
    return contact.gap(q, t, params), rates(flat, q, v, t, params)[:m], *coefficients, flaws


def start_flaws(flat: FlatSystem, q: Array, v: Array, t: Array, params: PyTree) -> Array:
    """(m,): what is wrong with the start of each contact, 0 nothing."""
    assert flat.contact is not None
    m = flat.contact.size
    gap, y = flat.contact.gap(q, t, params), rates(flat, q, v, t, params)[:m]
    J = directions(flat, q, t, params)
    zero, fast = nearly_closed(flat, q, J), matvec(jnp.abs(J[:m]), jnp.abs(v))
    still = max(STILL, 1e3 * float(jnp.finfo(v.dtype).eps)) * fast
    approaches = (gap <= zero) & (y < -still)
    mu, e = flat.contact.friction(params), flat.contact.restitution(params)
    in_range = (mu >= 0) & jnp.isfinite(mu) & (e >= 0) & (e <= 1)
    flaws = jnp.where(gap < -zero, Fault.OVERLAP, jnp.where(approaches, Fault.APPROACH, 0.0))
    return jnp.where(in_range, flaws, Fault.RANGE).astype(q.dtype)


def nearly_closed(flat: FlatSystem, q: Array, J: Array) -> Array:
    """(m,): the size of gaps that count as 0 at a start, relative to the coordinates from which they are computed."""
    few = float(jnp.finfo(q.dtype).eps) / float(jnp.finfo(jnp.float64).eps)
    size = kinematics.sizes(flat.blocks, q)
    gap_of = jnp.abs(J[: len(J) // 2, : size.shape[0]])
    return min(few * CLOSED, 1e-4) * matvec(gap_of, size) + min(few * ROUNDING, 1e-6)
