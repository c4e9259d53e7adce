"""Contact in a plane: where bodies touch, how they slide on each other, and how this affects the accelerations.

    g = gap(q, t) >= 0,    s = sliding(q, v, t),    y = (dg/dt, s),    J = dy/dv
    M(q) w = Q(q, v, t) + B^T L + J^T (f_N, f_T),    f_N >= 0,    f_N g = 0
    f_T = -mu f_N sign(s) where s != 0,    |f_T| <= mu f_N where s = 0

How a step finds f is in hhtjax/steppers/contact.py.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.checks import count, describe, require_function, require_number
from hhtjax.description import Array, Description, PyTree, Real, is_array, thaw
from hhtjax.jaxpr import linear_map
from hhtjax.numerics.dense_lu import product
from hhtjax.primitives import consistent

if TYPE_CHECKING:
    from hhtjax.systems.flat_system import FlatSystem

MOST = 4  # contacts


class Fault:
    """The codes of failures of contacts in steps and runs, as floats; 0 is no failure."""

    NO_FORCES, MANY, JAMMED, SEVERAL, OPEN, OVERLAP, APPROACH, RANGE = (float(k) for k in range(1, 9))


@dataclass(frozen=True, eq=False)
class Contact(Description):
    """Contacts of bodies in a plane, for `System(contact=)`: they collide, rest, stick, slide and separate.

    Args:
        gap: g, `gap(q, t, params)` -> (m,), or a number: the distances in metres, positive where bodies are apart. A
            smooth function. At most m = 4 contacts.
        sliding: s, `sliding(q, v, t, params)` -> (m,), or a number: the velocities along the surfaces in m/s, affine in
            v. The problem is planar: a contact slides along one line.
        friction: mu >= 0, Coulomb's coefficient: a number, (m,), the name of an entry of params, or a function of
            params. It needs `sliding`.
        restitution: e in [0, 1], the ratio of the normal impulse of expansion to that of compression (Poisson); the
            same types as mu.

    Supported by the `hht` family. A step is divided where a contact lands or switches between sticking, sliding and
    separation. q, v and the forces have order 2 through all switches, and gaps of closed contacts are 0 to rounding.
    `run.contact` holds the forces.

    e applies to a contact that lands by itself. A contact that lands while a closed contact depends on it (an impulse
    at one changes the velocity at the other) lands with e = 0. If several such contacts land at the same time, e > 0 is
    a failure, because the outcome would depend on their order. A contact whose flight would be shorter than a step
    stays closed, so bouncing ends. Forces of contacts that depend on each other, such as friction at both feet of a
    table, are only determined in sum.

    `check()` reports these failures: contacts that switch too often within a step; a contact that jams, because its
    friction presses it together (Painleve); forces that are not found; several impacts at once with e > 0.

    Raises:
        TypeError, ValueError: an argument of a wrong kind, or out of its range; friction without `sliding`. In runs: a
            start in which bodies overlap, or touch and approach each other.

    To add contact to an existing system, such as a mechanism, use `dataclasses.replace(system, contact=)`.

    Example: a block slides 0.204 m, v^2/(2 mu g), and stays there:

    >>> import jax.numpy as jnp, hhtjax
    >>> floor = hhtjax.Contact(gap=lambda q, t, params: q[1], sliding=lambda q, v, t, params: v[0], friction="mu")
    >>> block = hhtjax.System(jnp.ones(2), lambda q, v, t, params: jnp.array([0.0, -9.81]), contact=floor)
    >>> run = hhtjax.simulate(
    ...     block, hhtjax.hht(), jnp.zeros(2), jnp.array([1.0, 0.0]), {"mu": 0.25}, dt=0.01, num_steps=100)
    >>> run.check()
    >>> round(float(run.q[-1, 0]), 4), bool(run.contact.sticking[-1, 0]), run.contact.normal.shape
    (0.2039, True, (101, 1))
    """

    gap: Callable
    sliding: Callable | None = None
    friction: Any = 0.0
    restitution: Any = 0.0

    def __post_init__(self):
        require_function("Contact", "gap", self.gap, "gap(q, t, params)")
        if self.sliding is not None:
            require_function("Contact", "sliding", self.sliding, "sliding(q, v, t, params)")
        _require_coefficient("friction", self.friction, lambda mu: mu >= 0, "not be negative")
        _require_coefficient("restitution", self.restitution, lambda e: (e >= 0) & (e <= 1), "lie in [0, 1]")
        if self.sliding is None and not (isinstance(self.friction, (int, float)) and self.friction == 0):
            raise ValueError(
                "Contact: `friction` needs `sliding`, the velocity along the surface; received "
                f"friction={self.friction!r} alone."
            )


def _require_coefficient(name: str, value: Any, valid: Callable, expectation: str):
    """Raises an error unless it is a number, an array, a name or a function of params."""
    if isinstance(value, str):
        return
    if is_array(value) and np.ndim(value) == 1:
        for x in value:
            require_number("Contact", name, x, valid, expectation)
    elif callable(value) and not is_array(value):
        require_function("Contact", name, value, f"{name}(params)")
    else:
        require_number("Contact", name, value, valid, expectation)


class FlatContact(NamedTuple):
    """Contacts on vectors; made by `flat_contact`."""

    gap: Callable  # q, t, params -> (m,)
    sliding: Callable  # q, v, t, params -> (m,), affine in v; 0 where nothing rubs
    friction: Callable  # params -> (m,)
    restitution: Callable  # params -> (m,)
    size: int  # m
    rubs: bool  # whether there is a `sliding`


def flat_contact(
    caller: str, contact: Contact, flat: FlatSystem, q0: PyTree, v0: PyTree, t0: Real, params: PyTree, dtype: Any
) -> FlatContact:
    """The `FlatContact` of a system; raises an error if its functions return wrong shapes or dtypes."""
    m = _rows(caller, "gap", contact.gap, dtype, q0, t0, params)
    if contact.sliding is not None:
        rows = _rows(caller, "sliding", contact.sliding, dtype, q0, v0, t0, params)
        if rows != m:
            raise ValueError(f"{caller}: `sliding` must return ({m},), one velocity for each gap; received ({rows},).")

    def gap(q: Array, t: Array, params: PyTree) -> Array:
        return jnp.ravel(jnp.asarray(contact.gap(flat.unravel(q), t, thaw(params)))).astype(dtype)

    def sliding(q: Array, V: Array, t: Array, params: PyTree) -> Array:
        if contact.sliding is None:
            return jnp.zeros(m, dtype)
        v = flat.unravel_rates(flat.located(V))
        return jnp.ravel(jnp.asarray(contact.sliding(flat.unravel(q), v, t, thaw(params)))).astype(dtype)

    friction, restitution = (
        partial(_coefficient, caller, name, getattr(contact, name), m, dtype) for name in ("friction", "restitution")
    )
    for coefficient in (friction, restitution):  # their errors, at once
        coefficient(params)
    return FlatContact(consistent(gap), consistent(sliding), friction, restitution, m, contact.sliding is not None)


def _rows(caller: str, name: str, function: Callable, dtype: Any, *args: PyTree) -> int:
    """The number of rows that the function returns, checked."""

    def as_row(*args: PyTree) -> Array:
        found = function(*args)
        return found[None] if is_array(found) and jnp.ndim(found) == 0 else found

    return count(caller, name, as_row, MOST, dtype, *args)


def _coefficient(caller: str, name: str, given: Any, m: int, dtype: Any, params: PyTree) -> Array:
    """A coefficient as (m,), from params."""
    params, value = thaw(params), None
    if isinstance(given, str):
        if not isinstance(params, dict) or given not in params:
            raise ValueError(
                f"{caller}: `{name}` must be a name in params; received {given!r} with the params {params!r}."
            )
        value = params[given]
    else:
        value: Any = given(params) if callable(given) and not is_array(given) else given
    value = jnp.asarray(value)
    if value.shape not in ((), (m,)):
        raise ValueError(f"{caller}: `{name}` must be a number or have shape ({m},); received {describe(value)}.")
    return jnp.broadcast_to(value.astype(dtype), (m,))


def rates(system: FlatSystem, q: Array, v: Array, t: Array, params: PyTree) -> Array:
    """y = (dg/dt, s), (2 m,)."""
    contact = system.contact
    along = system.rate(q, v), jnp.ones_like(t)
    gdot = jax.jvp(lambda q, t: contact.gap(q, t, params), (q, t), along)[1]
    return jnp.concatenate([gdot, contact.sliding(q, v, t, params)])


def directions(system: FlatSystem, q: Array, t: Array, params: PyTree) -> Array:
    """J (2 m, N), the derivative of y with respect to the rates."""
    zero = jnp.zeros(system.size, q.dtype)
    return linear_map(jax.linearize(lambda v: rates(system, q, v, t, params), zero)[1], zero)


def reaction(system: FlatSystem, q: Array, t: Array, params: PyTree, f: Array) -> Array:
    """J^T f: (N,)."""
    zero = jnp.zeros(system.size, q.dtype)
    return jax.vjp(lambda v: rates(system, q, v, t, params), zero)[1](f)[0]


def speeds(J: Array, v: Array, w: Array, h: Array) -> Array:
    """(m,): the size of the terms that the rates of each contact consist of in a step h; what is far smaller counts as
    0."""
    fast = product(jnp.abs(J), jnp.abs(v) + h * jnp.abs(w))
    m = len(fast) // 2
    return jnp.maximum(fast[:m], fast[m:])


def rates_of_rates(system: FlatSystem, q: Array, v: Array, w: Array, t: Array, params: PyTree) -> Array:
    """dy/dt for the acceleration w: (2 m,)."""
    along = system.rate(q, v), w, jnp.ones_like(t)
    return jax.jvp(lambda q, v, t: rates(system, q, v, t, params), (q, v, t), along)[1]
