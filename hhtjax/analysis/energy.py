"""The energy of a run: what it holds, what forces put in and took out, and what the method made or lost."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from hhtjax.analysis.event_rows import with_event_rows
from hhtjax.analysis.friction_work import friction_work, switches
from hhtjax.checks import require_function
from hhtjax.description import current, freeze, thaw
from hhtjax.description.presentation import shown
from hhtjax.runs.interpolate import interpolate
from hhtjax.runs.output import require_path
from hhtjax.runs.solution import Solution
from hhtjax.systems import held
from hhtjax.systems.flat_system import flatten
from hhtjax.systems.system import LinearSystem, System


@shown
class EnergyBalance(NamedTuple):
    """Energies by saved time, (K + 1,) each, in J.

    Attributes:
        t: s.
        kinetic: v' M v/2.
        potential: V, 0 without.
        work: of all other forces since the start, and of impacts.
        error: kinetic + potential - their sum at the start - work, which the motion itself leaves at 0.
    """

    t: Any
    kinetic: Any
    potential: Any
    work: Any
    error: Any


def energy_balance(system, solution, params=None, potential=None) -> EnergyBalance:
    """The energy balance along a run: a diagnostic, whose `error` is the energy that the method itself made or lost.

        d/dt (T + V) = v' Q + v' Mdot v/2 + L' B v - tau' H v + dV/dt = P,    T = v' M(q) v/2
        work(t) = integral of P:  dampers, inputs, forces without a potential, constraints that move, dry friction

    The integral is Simpson's over each interval between saved times, on dense output: of order 4. Save every step, or
    some within the shortest period. Dry friction tau jumps where a joint switches: its integral is of order 2 there.
    It takes tau s where a joint slides, nothing where it sticks to what rests, and what a moving belt gives or takes.
    What an impact takes from T is work; the integral ends there and begins anew, with an error of H^3 around it.
    A switch of params it does not know: what that changes, in V or in forces, counts as error from there on.
    Where nothing damps or drives, and V is given, work is 0 and the error is the drift of the total energy; without V,
    work counts every force, and the error is another, of the same order.

    Args:
        system, params: as in `simulate`; no `FirstOrderSystem`.
        solution: of one run (vmap this function for a batch).
        potential: V, `potential(q, t, params)`, a scalar in J, of forces that are part of the system's; None for 0.

    Differentiable; goes under jit.

    Returns:
        An `EnergyBalance`.

    Raises:
        TypeError, ValueError: an argument of a wrong kind.

    Example: a damped spring, started with 2 J, after 1 s: both energies, what the damper took, what HHT made.

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
    if potential is not None:
        require_function(caller, "potential", potential, "potential(q, t, params)")
        potential = current(potential)
    return _energy_balance(system, solution, freeze(params), potential)


@partial(jax.jit, static_argnames="potential")
def _energy_balance(system, solution, params, potential):
    if solution.events is None:
        return _balance(system, solution, solution, None, params, potential)
    run, across, saved = with_event_rows(solution)
    return jax.tree.map(lambda x: x[saved], _balance(system, solution, run, across, params, potential))


def _balance(system, solution, run, across, params, potential):
    """At the times of the run, the solution with its events, if it has some; across: whether an interval is one."""
    q0, v0, t0, z0 = (jax.tree.map(lambda x: x[0], y) for y in (solution.q, solution.v, solution.t, solution.z))
    params = thaw(params)
    flat, _, _ = flatten("energy_balance", system, q0, v0, t0, params, z0)

    def along(v, forces):
        """What forces do with the velocities, internal states left out: v' Q."""
        return jnp.dot(flat.located(v), flat.located(forces))

    def energies(q, v, t):
        V = jnp.zeros_like(t) if potential is None else potential(flat.unravel(q), t, params)
        return along(v, flat.inertia(q, v, t, params)) / 2, jnp.asarray(V).astype(t.dtype)

    def power(q, v, t, L, params):
        """P, without dry friction; derivatives along the motion by the chain rule, q at the rate qdot and v held."""
        motion = flat.rate(q, v), jnp.ones_like(t)
        _, (T_q, V_dot) = jax.jvp(lambda q, t: energies(q, v, t), (q, t), motion)
        P = along(v, flat.force(q, v, t, params)) + T_q + V_dot
        if not flat.num_constraints:
            return P
        _, stretching = jax.jvp(lambda q: flat.constraint(q, t, params), (q,), motion[:1])
        return P + jnp.dot(L, stretching)

    ends, middles = _points(flat, solution, run, params)

    def over_interval(first, between, last, H):
        """Simpson's rule; a held input has the value that it has inside."""
        inside = held.held_at(params, between[2])
        P, P_middle, P_end = (power(q, v, t, L, inside) for q, v, t, L in (first, between, last))
        return H / 6 * (P + 4 * P_middle + P_end)

    t, with_L = run.t, (*ends, run.multipliers)
    first, last = (jax.tree.map(lambda x, part=part: x[part], with_L) for part in (slice(-1), slice(1, None)))
    work = jax.vmap(over_interval)(first, middles, last, jnp.diff(t))
    if flat.friction:
        w = _vectors((run.acceleration, run.zdot))
        work = work + friction_work(flat, run, ends, middles, w, params)
    return _summed(t, *jax.vmap(energies)(*ends), work, across)


def _summed(t, T, V, work, across):
    """The balance, from the work in each interval; that of an impact is all that T loses."""
    if across is not None:
        work = jnp.where(across, jnp.diff(T), work)
    work = jnp.concatenate([jnp.zeros_like(t[:1]), jnp.cumsum(work)])
    return EnergyBalance(t, T, V, work, T + V - T[0] - V[0] - work)


def _points(flat, solution, run, params):
    """q, v and t at the saved times of the run, which is the solution with its events, and q, v, t and L between."""
    t, L = run.t, run.multipliers
    H, middle = jnp.diff(t), (t[1:] + t[:-1]) / 2
    jumps = held.holds(params) or (switches(run) if flat.friction else False)
    q, v = _between(solution, run, H, middle, jumps if not flat.blocks else False)
    ends = _vectors(run.q), _vectors((run.v, run.z)), t
    between = q, v, middle, None if L is None else (L[1:] + L[:-1]) / 2
    return ends, between


def _between(solution, run, H, middle, jumps):
    """Positions and rates in the middle of each interval, of length H; jumps: whether, or where, accelerations do."""
    found = interpolate(solution, middle)
    rates = _vectors((found.v, found.z))
    if jumps is not False:  # of the cubic through q and v the slope
        q, v = _vectors(run.q), _vectors(run.v)
        slope = 1.5 * jnp.diff(q, axis=0) / jnp.where(H > 0, H, 1)[:, None] - (v[1:] + v[:-1]) / 4
        n = v.shape[1]
        rates = jnp.concatenate([jnp.where(jumps, slope, rates[:, :n]), rates[:, n:]], axis=1)
    return _vectors(found.q), rates


def _vectors(tree):
    """Leaves joined, a vector for each time."""
    return jnp.concatenate([x.reshape(len(x), -1) for x in jax.tree.leaves(tree)], axis=1)
