"""The generalised-alpha step with dry friction: set-valued, one factorisation, order 2 through every switch.

While a joint slides in one direction its friction is a smooth force. It is part of the residual, with the direction sig
of the start of the step. Joints that stick, or switch inside the step, get a multiplier dtau, on which the step depends
linearly:

    w1 = wf - G dtau,    G = A^-1 H^T,    s1 = sf - W dtau,    W = H dv/dw G,

by the one factorisation of A; the suffix f denotes the free step, with sig. A switch is resolved within the step, by
the motion on either side of it (friction_switching.py). Then w, a, v and q are moved along G to satisfy the new branch.
The jump of the acceleration never enters the recursion, which therefore does not oscillate, and sticking joints do not
move.

If the predicted velocity of a joint changes sign, the residual contains no friction of this joint, and is expanded
about a state before the change: all of its friction is dtau. Otherwise a limit far above the load would reverse the
predicted velocity, and with it change the directions of all forces, by as much as it could in a whole step.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from jax import lax

from hhtjax.description import Array, PyTree, Real
from hhtjax.numerics.dense_lu import diagonal, matvec
from hhtjax.numerics.low_rank import Updated
from hhtjax.steppers.constrained import equations, report_constraints
from hhtjax.steppers.friction_switching import DEPENDENT, is_settled, run_events, run_pieces, switch
from hhtjax.steppers.implicit_solve import newton, solve_and_keep
from hhtjax.steppers.residual import residual
from hhtjax.steppers.smooth_start import Found, corrected_by, damped_part, lag_left, rate_of, smoothed
from hhtjax.steppers.stepper import FrictionState, join_info
from hhtjax.systems.constraints import answers, curvature
from hhtjax.systems.friction import across, directions, own_rate, reaction, responses
from hhtjax.systems.friction_rows import depends, is_prescribed, rows_of

if TYPE_CHECKING:
    from hhtjax.numerics.low_rank import Changing
    from hhtjax.steppers.friction_switching import Switch
    from hhtjax.steppers.options import Options
    from hhtjax.steppers.smooth_start import Drag, Layer
    from hhtjax.steppers.stepper import Info, State, Stepper
    from hhtjax.systems.flat_system import FlatSystem
    from hhtjax.systems.friction_rows import Dependent, Independent

NOISE = 8  # roundings, of what it is the difference of, below which a number is 0
LAGS = 20  # how often multipliers, and limits that depend on them, are made anew at the start


def begin_friction(
    method, system, q: Array, v: Array, t: Array, params: PyTree, dt: Array, still: Any = False
) -> State:
    """The state at the start: which joints slide, which stick, and the accelerations.

    still: (m,), joints that are at rest, although their velocities may show rounding.
    """
    if method.options.linearize in ("held", "state"):
        raise ValueError(
            f"hht: with friction, leave `linearize` out: it is at the predictor; received {method.options.linearize!r}."
        )
    at = q, v, t, params
    factorize = method.factorize_for(system) if system.num_constraints else method.factorize
    answer, H = answers(system, q, t, params, factorize=factorize), directions(system, q, t, params)
    w, L0 = answer(system.force(*at), -curvature(system, *at) if system.num_constraints else None)
    G, pulls = responses(answer, H)
    rows = rows_of(system, q, t, params, H, G, pulls, False, depends(system, method.redundant))
    K, own = rows.K, own_rate(system, *at)
    size = matvec(jnp.abs(H), jnp.abs(w)) + jnp.abs(own)
    settle = partial(_settle, system, at, H, rows, matvec(H, w) + own, size, still)

    def again(_, L: Array) -> Array:
        """L, for limits that depend on L, with the friction."""
        return L0 - matvec(pulls.T, settle(L)[1])

    L = lax.fori_loop(0, LAGS, again, jnp.zeros_like(L0)) if system.num_constraints else None
    sig, tau = settle(L)
    s = method.begin(smooth_system(system, sig, tau, L), *at, dt)
    a = _taken_off(s.a, rows.solve(K, sig == 0, matvec(H, s.a) + own), G)
    return s._replace(a=a, friction=FrictionState(sig, tau))


def smooth_system(system, sig, tau, L):
    """The system without the friction law, but with the friction of sliding joints, and the forces tau at the
    others."""

    def force(q, v, t, params):
        f = system.friction.limit(q, v, L, t, params)
        return system.force(q, v, t, params) - reaction(system, q, t, params, jnp.where(sig == 0, tau, sig * f))

    return system._replace(force=force, friction=None)


def _settle(system, at: tuple, H: Array, rows, load: Array, size: Array, still: Real, L):
    """sig and tau at the start, where without friction ds/dt is the load, with terms of the given size. Joints at rest
    are held within the limits; those that cannot be held slide. still: which joints are at rest in any case."""
    q, v, t, params = at
    sig, f = jnp.where(still, 0, direction(system, at, H)), system.friction.limit(q, v, L, t, params)
    rests = sig == 0
    slid = jnp.where(rests, 0, sig * f)
    slides, tau = rows.at_rest(rests, load - matvec(rows.K, slid), f, size)
    return jnp.where(rests, slides, sig), jnp.where(rests, tau, slid)


def direction(system, at: tuple, H: Array):
    """The direction in which each joint slides: 0 if its velocity is a rounding of its terms. Otherwise a rounding
    would start with the whole limit, and the accelerations from it."""
    q, v, t, params = at
    s, own = (system.friction.sliding(q, x, t, params) for x in (v, jnp.zeros_like(v)))
    noise = NOISE * float(jnp.finfo(s.dtype).eps) * (matvec(jnp.abs(H), jnp.abs(v)) + jnp.abs(own))
    return jnp.where(jnp.abs(s) <= noise, 0, jnp.sign(s))


def bind_friction(method, system, params: PyTree, dt, kept: Changing | None = None):
    """The step: the free step, the switches within it, and the state after them.

    kept: a `Changing` that has the matrix without the derivatives of the limits, which H^T (constant here) distributes.
    """
    law, size, dependent = system.friction, system.size, depends(system, method.redundant)
    driven = method.redundant is None and system.num_constraints >= system.positions

    def step(s):
        r, path, z, shift, B = equations_of(method, system, params, dt, s)
        stops, at = _foreseen(system, params, dt, s, path(z), driven)
        sig, tau = s.friction
        smooth = jnp.where(stops, 0, sig)

        def rubbing(s1) -> Array:
            f = law.limit(s1.q, s1.v, s1.L, s1.t, params)
            force = reaction(system, s1.q, s1.t, params, smooth * f)
            return r(s1) + jnp.pad(force, (0, z.size - size))

        factorize = method.factorize_for(system) if system.num_constraints else method.factorize
        if kept is not None:
            factorize = _with_slope(kept, system, smooth, at, params)
        z, info, inverse, along = free_step(method.options, system, rubbing, path, z, s, factorize, at)
        H = directions(system, at.q, at.t, params)
        G = each_row(inverse, jnp.pad(H, ((0, 0), (0, z.size - size))))
        pulls = G[:, size : size + system.num_constraints]
        rows = rows_of(system, at.q, at.t, params, H, G[:, :size], pulls, sig == 0, dependent)
        W = across(H, each_row(along, G).v)

        def sliding(z):
            return law.sliding(at.q, path(z).v, at.t, params)  # with H as in W

        held = path(z - matvec(G.T, rows.solve(W, smooth == 0, sliding(z))))
        f = law.limit(held.q, held.v, held.L, held.t, params)
        z = z - matvec(G.T, jnp.where(stops, sig * f, 0))
        given = dependent and is_prescribed(system, rows, pulls, (s, at), params)
        end, left, held = _switches(sliding(z), law.sliding(s.q, s.v, s.t, params), sig, tau, f, W, rows, dt, given)

        def displacement(z):
            x = method.advance(s, dt, z[:size])[0]
            taken = None if shift is None else shift(z[size + system.num_constraints :])
            return x if taken is None else x - taken

        still = displacement(z - matvec(G.T, held)) if dependent else None
        z = z - matvec(G.T, end.tau)
        s1 = system.tidy(_behind(system, params, s, path(z), displacement(z), end, f, G, rows, still))
        if method.estimating:
            defect = _defect(method, system, params, rubbing, path(z), end.tau + jnp.where(stops, sig * f, 0), inverse)
            info = info._replace(defect=defect, switched=_switched(system, s, s1, end, G, dependent))
        left = jnp.where(rows.are_dependent(), DEPENDENT, left)
        info = _told(info, left, _is_limit(law, at, params) & ~jnp.any((f < 0) | (f == jnp.inf)))
        return s1, info if B is None else report_constraints(method, system, params, dt, s, s1, info, B)

    return step


def equations_of(method, system, params: PyTree, dt, s):
    """The factorisation as for constraints, also without any."""
    if system.num_constraints:
        return equations(method, system, params, dt, s)
    return lambda s: residual(system, params, s), lambda w: method.arrive(system, s, dt, w), s.w, None, None


def _foreseen(system, params: PyTree, h: Array, s, predicted, driven: bool):
    """Which joints come to rest within the step if nothing else changes, and the state at which to linearise. This is
    the predicted state, except that accelerations end when the first joint rests: otherwise its whole friction would
    continue to act.

    driven: whether all motion is prescribed; it then continues.
    """
    sliding, (sig, tau) = system.friction.sliding, s.friction
    s0, s1 = (sliding(x.q, x.v, x.t, params) for x in (s, predicted))
    stops = (sig * s1 < 0) & (tau != 0)
    if driven:
        return stops, predicted
    theta = jnp.min(jnp.clip(jnp.where(stops, s0 / jnp.where(stops, s0 - s1, 1), 1), 0, 1))
    q = system.move(s.q, h * s.v + h**2 * theta * (1 - theta / 2) * s.a)
    ended = predicted._replace(q=q, v=s.v + h * theta * s.a, w=theta * s.w)
    return stops, jax.tree.map(partial(jnp.where, jnp.any(stops)), ended, predicted)


def _with_slope(kept, system, sig: Array, at, params: PyTree) -> Updated:
    """`kept`, with the derivatives of limits where joints slide."""
    limit = partial(system.friction.limit, params=params)

    def slope(x: State):
        return jax.linearize(lambda x: sig * limit(x.q, x.v, x.L, x.t), x)[1]

    return Updated(kept, directions(system, at.q, at.t, params), slope)


def free_step(
    options: Options,
    system: FlatSystem,
    r: Callable,
    path: Callable,
    z: Array,
    s: State,
    factorize: Callable | Updated,
    at: State | None,
):
    """The step in which every joint keeps its friction, and sticking joints have none; its factors are kept."""
    if options.iterations is None:
        z, info = newton(system, r, path, z, s, factorize, options.tolerance, options.max_iterations)
        z, _, inverse, along = solve_and_keep(r, path, z, factorize)
        return z, info, inverse, along
    z, info, inverse, along = solve_and_keep(r, path, z, factorize, at)
    for _ in range(options.iterations - 1):
        z, more, inverse, along = solve_and_keep(r, path, z, factorize)
        info = join_info(info, more)
    return z, info, inverse, along


def _switches(
    sf: Array,
    s: Array,
    sig: Array,
    tau: Array,
    f: Array,
    W: Array,
    rows: Dependent | Independent,
    h: Array,
    given: Real,
):
    """The state of joints at the end of the step, and the fraction of it that is left if there were too many events;
    for rows that may depend on each other also the forces that would hold sticking joints."""
    if given is not False:
        return run_pieces(sf, s, sig, tau, f, W, rows, h, given)
    Wh = h * rows.K
    if len(f) == 1:
        return switch(sf, s, sig, tau, f, diagonal(W), diagonal(Wh)), jnp.zeros((), sf.dtype), None
    return *run_events(sf, s, sig, tau, f, W, Wh), None


def _behind(system, params: PyTree, s, s1, x: Array, end, f, G, rows, still) -> State:
    """The state s1 at the end of the step, displaced by x, moved onto the branches on which its joints end.

    still: for rows that may depend on each other, the displacement if no joint switched.
    """
    dependent = still is not None
    h, sig, K = s1.t - s.t, s.friction.sig, rows.K
    size, sliding = system.size, system.friction.sliding
    moves, sticks = ~end.kept & (end.sig != 0), ~end.kept & (end.sig == 0)
    Gv = system.widened(G[:, : system.positions])  # internal states do not jump
    middle = directions(system, system.move(s.q, x / 2), s.t + h / 2, params)
    zero = jnp.zeros(size, x.dtype)
    own = [sliding(y.q, zero, y.t, params) for y in (s, s1)]
    slid, there = matvec(middle, x) + h / 2 * (own[0] + own[1]), rows.carriers(~end.kept)
    if dependent:
        before = jnp.where(sig == 0, 0, matvec(middle, still) + h / 2 * (own[0] + own[1]))
        slid = slid - before
    x = _taken_off(x, rows.solve(K, there, slid - end.slid * h), Gv)
    s1 = s1._replace(q=system.move(s.q, x))
    s1 = s1._replace(v=_taken_off(s1.v, rows.solve(K, sticks, sliding(s1.q, s1.v, s1.t, params)), Gv))

    H = directions(system, s1.q, s1.t, params)
    own = own_rate(system, s1.q, s1.v, s1.t, params)
    change = jnp.where(moves, (end.sig - sig) * f, 0)
    onto = change - end.tau if dependent else jnp.where(moves, (end.sig - sig) * f - end.tau, 0)
    w = s1.w - matvec(Gv.T, onto)
    y = rows.solve(K, sticks, matvec(H, w) + own)
    w = _taken_off(w, y, Gv)
    a = _taken_off(s1.a, rows.solve(K, there, matvec(H, s1.a - w)), Gv)
    borne, tau = onto + y, jnp.where(sticks, sig * f + (end.tau + onto) + y, end.sig * f)
    if dependent:
        shared = rows.shared(sticks, tau, f)
        borne, tau = borne + shared - tau, shared
    if s1.L is not None:
        s1 = s1._replace(L=s1.L - matvec(G[:, size : size + system.num_constraints].T, borne))
    return s1._replace(w=w, a=a, friction=FrictionState(end.sig, tau))


def _defect(method, system, params: PyTree, rubbing, s1, dtau: Array, inverse):
    """`Info.defect` at the end s1 of the step, with the changes dtau of friction; None for the converged method."""
    if method.options.iterations is None:
        return None
    left = rubbing(s1)
    force = reaction(system, s1.q, s1.t, params, dtau)
    return inverse(left + jnp.pad(force, (0, left.size - force.size)))


def _switched(system: FlatSystem, s: State, s1: State, end: Switch, G, dependent: bool) -> Array:
    """`Info.switched`: the change of the accelerations by friction that switched between s and s1."""
    same = end.kept | ((s.friction.sig == 0) & (end.sig == 0))
    if dependent:  # where one switches, others may hold what it held
        same = end.kept | jnp.all(same)
    change = jnp.where(same, 0, s.friction.tau - s1.friction.tau)
    return matvec(system.widened(G[:, : system.positions]).T, change)


def _taken_off(x: Array, y: Array, G: Array) -> Array:
    """x - G^T y; 0 where that is rounding."""
    left = x - matvec(G.T, y)
    noise = NOISE * float(jnp.finfo(x.dtype).eps) * matvec(jnp.abs(G.T), jnp.abs(y))
    return jnp.where(jnp.abs(left) < noise, 0, left)


def each_row(f: Callable, rows):
    """f of each row; a single row is done without vmap, which compiles less."""
    if len(rows) == 1:
        return jax.tree.map(lambda x: x[None], f(rows[0]))
    return jax.vmap(f)(rows)


def _is_limit(law, s: State, params: PyTree) -> Array:
    """Whether the limits at a state are finite and >= 0. A state that is not finite is reported elsewhere."""
    f = law.limit(s.q, s.v, s.L, s.t, params)
    return jnp.all((f >= 0) & (f < jnp.inf)) | ~(jnp.all(jnp.isfinite(s.q)) & jnp.all(jnp.isfinite(s.v)))


def _told(info: Info, left: Array, is_limit: Array) -> Info:
    """The `Info` of a step."""
    left = jnp.where(is_limit, left, jnp.inf)
    found = is_settled(left)
    return info._replace(friction=left, converged=found if info.converged is None else info.converged & found)


# ----------------------------------------------------------------------------
# The smooth start with dry friction: who slides, and who sticks, behind the implicit step of the velocity.
#
#     S dv = h gamma (Q - H^T tau),    tau = f sign(s) where s != 0, |tau| <= f where s = 0,    s = sliding(v + dv)
#
# is the law of friction at the end of the step. Joints that are at rest, and stay so, get no part of P^4 dv. What the
# step resolves does not change; where damping is stiff a limit turns as the motion does, and v+ tells who slides.


def smoothed_friction(
    method: Stepper,
    system: FlatSystem,
    s: State,
    params: PyTree,
    h: Array,
    moves: bool = True,
    resolves: bool = False,
    alone: bool = False,
    lags: bool = False,
) -> State:
    """As `smoothed`, with dry friction."""
    free = system._replace(friction=None)
    return smoothed(method, free, s, params, h, moves, resolves, alone, partial(finished, system.friction), lags)


def finished(
    law, method: Stepper, layer: Layer, inverse: Callable, drag: Drag | None, z: Array, h: Array, corrects: bool
) -> Found:
    """v+, z, dw/dt and the friction there, from the implicit step without friction."""
    system, base, params = layer.system._replace(friction=law), layer.base, layer.params
    q, v, t, n = base.q, base.v, base.t, layer.system.size
    H = directions(system, q, t, params)
    answers = jnp.stack([inverse(jnp.pad(row, (0, z.size - n))) for row in H])
    G, pulls = jnp.stack([layer.located(x) for x in answers[:, :n]]), answers[:, n:]
    rows = rows_of(system, q, t, params, H, G, pulls, False, depends(system, method.redundant))

    def taken_off(x: Array, some: Array, own: Real = 0.0) -> Array:
        """x without the part that moves these joints."""
        return x - matvec(G.T, rows.solve(rows.K, some, matvec(H, x) + own))

    stays = False
    if drag is not None:
        start = begin_friction(method, system, q, v, t, params, h)
        dv = layer.located(layer.V * z[:n])
        f = law.limit(q, v, start.L, t, params)
        load, size = law.sliding(q, v + dv, t, params) / layer.V, matvec(jnp.abs(H), jnp.abs(v + dv)) / layer.V
        ends, tau = rows.at_rest(jnp.ones_like(f) > 0, load, f, size)
        stays = (direction(system, (q, v, t, params), H) == 0) & (ends == 0)
        dv = taken_off(dv - layer.V * matvec(G.T, tau), stays)
        v = v + damped_part(layer, inverse, drag, dv, h, lambda x: taken_off(x, stays))
    found = begin_friction(method, system, q, v, t, params, h, stays)  # who stays: rounding of dv is left in v
    sig, tau = found.friction
    rubbing = layer._replace(system=smooth_system(system, sig, tau, found.L))
    bend = None if layer.B is None else curvature(system, q, v, t, params)
    z = corrected_by(rubbing, inverse, rubbing.rows(base._replace(v=v), bend))
    sticks, own = sig == 0, own_rate(system, q, v, t, params)
    w, L = layer.parts(z)
    z = z.at[:n].set(taken_off(w, sticks, own))
    wdot = None
    if corrects:
        s = base._replace(v=v, w=z[:n], L=L)
        wdot = taken_off(layer.parts(rate_of(rubbing, s, inverse, h))[0], sticks)
    return Found(v, z, wdot, friction=found.friction, lag=lag_left(layer, inverse))
