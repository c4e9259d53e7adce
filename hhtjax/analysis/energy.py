"""The energy balance of a run: kinetic and potential energy, work of forces, and the energy error of the method."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.checks import require_function, require_number
from hhtjax.description import Array, PyTree, Real, current, freeze, thaw
from hhtjax.description.presentation import shown
from hhtjax.numerics.dense_lu import matvec
from hhtjax.runs.interpolate import interpolate, on_axes
from hhtjax.runs.output import require_path
from hhtjax.runs.solution import SimulationError, Solution
from hhtjax.systems import zero_order_hold
from hhtjax.systems.constraints import answers
from hhtjax.systems.flat_system import flatten
from hhtjax.systems.friction import directions, responses
from hhtjax.systems.friction_rows import rows_of
from hhtjax.systems.system import AnySystem, LinearSystem, System

if TYPE_CHECKING:
    from hhtjax.systems.flat_system import FlatSystem


@shown
class EnergyBalance(NamedTuple):
    """Result of `energy_balance`: energies at the saved times, (K + 1,) each, in J.

    Attributes:
        t: s.
        kinetic: v' M v/2.
        potential: V; 0 without `potential`.
        work: work since the start of all forces without a potential, and of impacts.
        error: kinetic + potential - their sum at the start - work. For the exact motion it is 0.
    """

    t: Array
    kinetic: Array
    potential: Array
    work: Array
    error: Any

    def check(self, part: Real = 0.5):
        """Raises `SimulationError` if the method has created energy.

        It does so if `error` exceeds `part` of the largest kinetic energy so far.

        This happens, for example, if a stiff spring models contact and the steps are too long for it. The motion stays
        finite, and `Solution.check` does not notice it.

        Do not call it inside jit. In a batch the message names the first bad member.

        >>> import jax.numpy as jnp, hhtjax
        >>> wall = hhtjax.System(jnp.ones(1), lambda q, v, t, params: jnp.where(q < 0, -1e7 * q, 0 * q) - 9.81)
        >>> run = hhtjax.simulate(wall, hhtjax.hht(), jnp.ones(1), jnp.zeros(1), dt=0.01, num_steps=100)
        >>> hhtjax.analysis.energy_balance(wall, run).check()                           # doctest: +ELLIPSIS
        Traceback (most recent call last):
        hhtjax.runs.solution.SimulationError: energy_balance: by t = 0.46 the method has made ... J ...
        """
        require_number("check", "part", part, lambda x: x > 0, "be positive")
        kinetic, error, t = map(np.asarray, (self.kinetic, self.error, self.t))
        most = np.maximum.accumulate(kinetic, axis=-1)
        bad = ~(error <= part * most) & (error != 0)
        for member in np.argwhere(bad)[:1]:
            i, of = tuple(member), f" of member {tuple(map(int, member[:-1]))}" if len(member) > 1 else ""
            raise SimulationError(
                f"energy_balance: by t = {t[i]:g} the method has made {error[i]:.3g} J{of}, with a kinetic energy of "
                f"at most {most[i]:.3g} J so far: dt does not resolve a stiff force. Take a smaller dt. For bodies "
                "that collide, use Contact."
            )


def energy_balance(
    system: AnySystem, solution: Solution, params: PyTree = None, potential: Callable | None = None
) -> EnergyBalance:
    """The energy balance of a run. Its `error` is the energy that the numerical method has added or removed.

        d/dt (T + V) = v' Q + v' Mdot v/2 + L' B v - tau' H v + dV/dt = P,    T = v' M(q) v/2
        work(t) = integral of P:  dampers, inputs, forces without a potential, constraints that move, dry friction

    The integral is by Simpson's rule over each interval between saved times, with dense output. It is of order 4. Save
    every step, or several within the shortest period.

    Dry friction tau jumps when a joint switches between sliding and sticking. There its integral is of order 2. Its
    power is tau s where a joint slides and 0 where it sticks to a body at rest. The work of a moving belt is included.

    The kinetic energy lost in an impact counts as work. The integral ends at the impact and begins again after it, with
    an error of H^3 around it. Switches of params by events are not known here: their change of V, or of forces, counts
    as error from then on.

    If nothing damps or drives the system and V is given, the work is 0, and the error is the drift of the total energy.
    Without V the work includes every force, and the error is a different one of the same order.

    Args:
        system, params: as in `simulate`; no `FirstOrderSystem`.
        solution: solution of one run (vmap this function for a batch).
        potential: V, `potential(q, t, params)`, a scalar in J, of some or all forces of the system; None for 0.

    The function is differentiable and can be used under jit.

    Returns:
        An `EnergyBalance`.

    Raises:
        TypeError, ValueError: an argument of a wrong kind.
        NotImplementedError: a system with contact.

    Example: a damped spring, started with 2 J, after 1 s: kinetic and potential energy, work of the damper, and error.

    >>> import jax.numpy as jnp, hhtjax
    >>> spring = hhtjax.System(jnp.ones(1), lambda q, v, t, params: -4.0 * q - 0.5 * v)
    >>> run = hhtjax.simulate(spring, hhtjax.hht(), jnp.ones(1), jnp.zeros(1), dt=0.1, num_steps=10)
    >>> found = hhtjax.analysis.energy_balance(spring, run, potential=lambda q, t, params: 2.0 * jnp.sum(q**2))
    >>> [round(float(x[-1]), 3) for x in found[1:]]
    [1.045, 0.095, -0.868, 0.008]
    """
    caller = "energy_balance"
    if not isinstance(system, (System, LinearSystem)):
        raise TypeError(f"{caller}: `system` must be a System or LinearSystem; received {system!r}.")
    if not isinstance(solution, Solution) or solution.t.ndim != 1:
        raise ValueError(f"{caller}: `solution` must be of one run (vmap over a batch); received {solution!r}.")
    require_path(caller, solution)
    if system.contact is not None:
        raise NotImplementedError(f"{caller}: `system` has contact, whose friction and impacts are not supported.")
    if potential is not None:
        require_function(caller, "potential", potential, "potential(q, t, params)")
        potential = current(potential)
    return _energy_balance(system, solution, freeze(params), potential)


@partial(jax.jit, static_argnames="potential")
def _energy_balance(system, solution: Solution, params: PyTree, potential) -> EnergyBalance:
    if solution.events is None:
        return _balance(system, solution, solution, None, params, potential)
    run, across, saved = with_event_rows(solution)
    return jax.tree.map(lambda x: x[saved], _balance(system, solution, run, across, params, potential))


def _balance(system, solution: Solution, run: Solution, across, params: PyTree, potential) -> EnergyBalance:
    """The balance at the times of `run`, the solution with rows for its events. across: which intervals are events."""
    q0, v0, t0, z0 = (jax.tree.map(lambda x: x[0], y) for y in (solution.q, solution.v, solution.t, solution.z))
    params = thaw(params)
    flat, _, _ = flatten("energy_balance", system, q0, v0, t0, params, z0)

    def along(v: Array, forces: Array) -> Array:
        """Power v' Q of forces, without internal states."""
        return jnp.dot(flat.located(v), flat.located(forces))

    def energies(q: Array, v: Array, t: Array):
        V = jnp.zeros_like(t) if potential is None else potential(flat.unravel(q), t, params)
        return along(v, flat.inertia(q, v, t, params)) / 2, jnp.asarray(V).astype(t.dtype)

    def power(q: Array, v: Array, t: Array, L, params: PyTree) -> Array:
        """P without dry friction. Derivatives along the motion are by the chain rule, with v held constant."""
        motion = flat.rate(q, v), jnp.ones_like(t)
        _, (T_q, V_dot) = jax.jvp(lambda q, t: energies(q, v, t), (q, t), motion)
        P = along(v, flat.force(q, v, t, params)) + T_q + V_dot
        if not flat.num_constraints:
            return P
        _, stretching = jax.jvp(lambda q: flat.constraint(q, t, params), (q,), motion[:1])
        return P + jnp.dot(L, stretching)

    ends, middles = _points(flat, solution, run, params)

    def over_interval(first: tuple, between: tuple, last: tuple, H: Array) -> Array:
        """Simpson's rule; a held input has its value inside the interval."""
        inside = zero_order_hold.held_at(params, between[2])
        P, P_middle, P_end = (power(q, v, t, L, inside) for q, v, t, L in (first, between, last))
        return H / 6 * (P + 4 * P_middle + P_end)

    t, with_L = run.t, (*ends, run.multipliers)
    first, last = (jax.tree.map(lambda x, part=part: x[part], with_L) for part in (slice(-1), slice(1, None)))
    work = jax.vmap(over_interval)(first, middles, last, jnp.diff(t))
    if flat.friction:
        w = _vectors((run.acceleration, run.zdot))
        work = work + friction_work(flat, run, ends, middles, w, params)
    return _summed(t, *jax.vmap(energies)(*ends), work, across)


def _summed(t: Array, T: Array, V: Array, work: Array, across) -> EnergyBalance:
    """The balance, from the work in each interval; the work of an impact is the change of T."""
    if across is not None:
        work = jnp.where(across, jnp.diff(T), work)
    work = jnp.concatenate([jnp.zeros_like(t[:1]), jnp.cumsum(work)])
    return EnergyBalance(t, T, V, work, T + V - T[0] - V[0] - work)


def _points(flat: FlatSystem, solution: Solution, run: Solution, params: PyTree):
    """q, v and t at the saved times of `run`, and q, v, t and L in the middle between them."""
    t, L = run.t, run.multipliers
    H, middle = jnp.diff(t), (t[1:] + t[:-1]) / 2
    jumps = zero_order_hold.holds(params) or (switches(run) if flat.friction else False)
    q, v = _between(solution, run, H, middle, jumps if not flat.blocks else False)
    ends = _vectors(run.q), _vectors((run.v, run.z)), t
    between = q, v, middle, None if L is None else (L[1:] + L[:-1]) / 2
    return ends, between


def _between(solution: Solution, run: Solution, H: Array, middle: Array, jumps):
    """Positions and rates in the middle of each interval of length H. jumps: whether, or where, accelerations jump."""
    found = interpolate(solution, middle)
    rates = _vectors((found.v, found.z))
    if jumps is not False:  # of the cubic through q and v the slope
        q, v = _vectors(run.q), _vectors(run.v)
        slope = 1.5 * jnp.diff(q, axis=0) / jnp.where(H > 0, H, 1)[:, None] - (v[1:] + v[:-1]) / 4
        n = v.shape[1]
        rates = jnp.concatenate([jnp.where(jumps, slope, rates[:, :n]), rates[:, n:]], axis=1)
    return _vectors(found.q), rates


def _vectors(tree: PyTree) -> Array:
    """Leaves joined, a vector for each time."""
    return jnp.concatenate([x.reshape(len(x), -1) for x in jax.tree.leaves(tree)], axis=1)


# ----------------------------------------------------------------------------
# A run with additional rows before and after each event.


VALUES = "t", "q", "v", "acceleration", "multipliers", "z", "zdot", "friction", "sticking"


def with_event_rows(solution):
    """(solution, across, saved): the `Solution` with a row before and a row after each event, in the order of time.

    across: which intervals between rows are an event. saved: places of the rows that were saved. Fields that an event
    does not record have their values at the saved times before and after it. Unused places of `events` repeat the last
    row.
    """
    events, last = solution.events, solution.t.shape[0] - 1
    met = ~jnp.isnan(events.t)
    behind = jnp.where(met, jnp.clip(jnp.searchsorted(solution.t, events.t), 1, last), last)
    told = {"t": (events.t,) * 2, "q": (events.q,) * 2, "v": (events.before, events.after), "z": (events.z,) * 2}

    def known(new, old):
        return jnp.where(on_axes(met, new), new, old)

    def rows(name):
        saved = getattr(solution, name)
        sides = [jax.tree.map(lambda x, i=i: x[i], saved) for i in (jnp.where(met, behind - 1, last), behind)]
        if name in told:
            sides = [jax.tree.map(known, new, old) for new, old in zip(told[name], sides, strict=True)]
        return jax.tree.map(lambda x, y, z: jnp.concatenate([_alternating(x, y), z]), *sides, saved)

    found = {name: rows(name) for name in VALUES}
    first = jnp.arange(found["t"].shape[0]) == 2 * met.size  # an event at the very start comes behind it
    order = jnp.argsort(jnp.where(first, -jnp.inf, jnp.where(jnp.isnan(found["t"]), jnp.inf, found["t"])), stable=True)
    across = (order[:-1] < 2 * met.size) & (order[:-1] % 2 == 0)
    saved = jnp.argsort(order)[2 * met.size :]
    return solution._replace(**jax.tree.map(lambda x: x[order], found)), across, saved


def _alternating(x, y):
    """x0, y0, x1, y1, ..."""
    return jnp.stack([x, y], axis=1).reshape(-1, *x.shape[1:])


# ----------------------------------------------------------------------------
# The work of dry friction between the saved times of a run.


def directions_of(solution):
    """Sliding direction of each joint: (K + 1, m), 0 where it sticks."""
    return jnp.where(solution.sticking, 0, jnp.sign(solution.friction))


def switches(solution):
    """Whether any joint changes its sliding direction in an interval: (K, 1)."""
    sig = directions_of(solution)
    return jnp.any(sig[1:] != sig[:-1], axis=1, keepdims=True)


def friction_work(flat, solution, ends, middles, w, params: PyTree):
    """Work of dry friction on the system in each interval: minus the integral of tau' H v, (K,).

    H v = s + c, with the speed c of the surface on which a joint rubs. For a joint that does not switch, it uses
    Simpson's rule, with the friction limit in the middle if it slides. For a joint that switches, s is assumed to go
    linearly to 0 at theta h, and linearly on from there, over the distance d. The part of c needs the mean of tau,
    which follows from the jump of w that does not appear in the change of v:

        integral tau s = h (theta tau0 s0 + (1 - theta) tau1 s1)/2,    d = h (theta s0 + (1 - theta) s1)/2
        mean tau = (tau0 + tau1)/2 + K^-1 H [(w0 + w1)/2 - (v1 - v0)/h],    K = H G

    ends: q, v, t at the saved times, middles: q, v, t, L between; w: (K + 1, N).
    """
    h, v = jnp.diff(solution.t), ends[1]
    unseen = (w[1:] + w[:-1]) / 2 - jnp.diff(v, axis=0) / jnp.where(h > 0, h, 1)[:, None]
    saved = (*ends, solution.friction, directions_of(solution))
    first, last = (jax.tree.map(lambda x, part=part: x[part], saved) for part in (slice(-1), slice(1, None)))
    return -h * jax.vmap(partial(_power, flat, params))(first, middles, last, unseen)


def _power(flat, params: PyTree, first, middle, last, unseen):
    """The mean of tau' H v over an interval; a held input has its value inside the interval."""
    (*_, tau0, sig0), (q, v, t, L), (*_, tau1, sig1) = first, middle, last
    params = zero_order_hold.held_at(params, t)
    places = first[:3], (q, v, t), last[:3]
    s = [flat.friction.sliding(*at, params) for at in places]
    c = [-flat.friction.sliding(q, 0 * v, t, params) for q, v, t in places]
    f, mean = flat.friction.limit(q, v, L, t, params), (tau0 + tau1) / 2
    tau = tau0, jnp.where(sig0 == 0, mean, sig0 * f), tau1
    steady = _simpson([tau * (s + c) for tau, s, c in zip(tau, s, c, strict=True)])

    apart = s[0] - s[2]
    theta = jnp.clip((2 * _simpson(s) - s[2]) / jnp.where(apart == 0, 1, apart), 0, 1)
    H = directions(flat, q, t, params)
    G, pulls = responses(answers(flat, q, t, params, "least_squares"), H)
    rows = rows_of(flat, q, t, params, H, G, pulls, False, dependent=True)
    mean = jnp.clip(mean + rows.solve(rows.K, jnp.ones(len(f), bool), matvec(H, unseen)), -f, f)
    switched = (theta * tau0 * s[0] + (1 - theta) * tau1 * s[2]) / 2 + mean * _simpson(c)
    return jnp.sum(jnp.where(sig0 == sig1, steady, switched))


def _simpson(x):
    """The mean over an interval, by Simpson's rule, from values at its ends and in its middle."""
    return (x[0] + 4 * x[1] + x[2]) / 6
