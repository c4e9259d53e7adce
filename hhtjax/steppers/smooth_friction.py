"""The smooth start with dry friction: who slides, and who sticks, behind the implicit step of the velocity.

    S dv = h gamma (Q - H^T tau),    tau = f sign(s) where s != 0, |tau| <= f where s = 0,    s = sliding(v + dv)

is the law of friction at the end of the step. Joints that are at rest, and stay so, get no part of P^4 dv. What the
step resolves does not change; where damping is stiff a limit turns as the motion does, and v+ tells who slides.
"""

from functools import partial

import jax.numpy as jnp

from hhtjax.numerics.elimination import matvec
from hhtjax.steppers.friction import begin_friction, direction, smooth_system
from hhtjax.steppers.smooth_start import Found, corrected_by, damped_part, lag_left, rate_of, smoothed
from hhtjax.systems.constraints import curvature
from hhtjax.systems.friction import directions, own_rate
from hhtjax.systems.friction_rows import depends, rows_of


def smoothed_friction(method, system, s, params, h, moves=True, resolves=False, alone=False, lags=False):
    """As `smoothed`."""
    free = system._replace(friction=None)
    return smoothed(method, free, s, params, h, moves, resolves, alone, partial(finished, system.friction), lags)


def finished(law, method, layer, inverse, drag, z, h, corrects):
    """v+, z, dw/dt and the friction there, from the implicit step without friction."""
    system, base, params = layer.system._replace(friction=law), layer.base, layer.params
    q, v, t, n = base.q, base.v, base.t, layer.system.size
    H = directions(system, q, t, params)
    answers = jnp.stack([inverse(jnp.pad(row, (0, z.size - n))) for row in H])
    G, pulls = jnp.stack([layer.located(x) for x in answers[:, :n]]), answers[:, n:]
    rows = rows_of(system, q, t, params, H, G, pulls, False, depends(system, method.redundant))

    def taken_off(x, some, own=0.0):
        """x without what moves these joints."""
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
