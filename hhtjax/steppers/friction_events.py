"""What the dry friction of several joints does within one step: from event to event, for what one does jerks the others.

Between events the sliding velocities go linearly: p, by which the friction differs from that of the step in which
nobody switches, is known where a joint slides, and at rest it is what keeps the velocity there at 0,

    ds/dtheta = c - Wh p,    p = (sig f - base) where sliding,    (c - Wh p) = 0 where at rest,    theta = (t - t0)/h.

An event: a joint that slides comes to rest, or the load of one at rest grows to its limit and it breaks away. Who does
it first switches; of several at once, the first of them, until none is left (Murty 1974: finite, as K is positive).
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax

from hhtjax.numerics.elimination import matvec
from hhtjax.steppers.friction_law import Switch
from hhtjax.systems.friction import solve_some

EVENTS = 4  # per joint and step


class Moment(NamedTuple):
    """Within a step: time since its start over h, sliding velocities, directions, distances over h, who kept on."""

    theta: Any
    s: Any
    sig: Any
    slid: Any
    kept: Any


def run_events(sf, s, sig, tau, f, W, Wh):
    """How joints come out of a step that start with s and, unless they stick, would come out with sf; and what part of
    the step is left where the events were too many. W: fall of sf by units of friction; Wh: that of s in a time h."""
    smooth = f == 0  # where nothing rubs, nothing switches
    stuck = (sig == 0) & ~smooth
    held = solve_some(W, stuck, sf)
    still = sf - matvec(W, held)
    c = jnp.where(stuck, 0, still - s)
    start, rise = jnp.where(stuck, tau, sig * f), jnp.where(stuck, held - tau, 0)  # base = start + theta rise

    def rates(sig):
        """ds/dtheta and the friction at theta, as functions of theta, with these directions."""
        rests = (sig == 0) & ~smooth
        p = [jnp.where(rests, 0, sig * f - start), jnp.where(rests, 0, -rise)]
        p = [x + solve_some(Wh, rests, y - matvec(Wh, x)) for x, y in zip(p, (c, jnp.zeros_like(c)), strict=True)]

        def rate(theta):
            return jnp.where(rests, 0, c - matvec(Wh, p[0] + theta * p[1]))

        return rate, lambda theta: start + p[0] + theta * (rise + p[1])

    def next_event(at):
        """How long until each joint switches, to what, and the rates till then."""
        rate, load = rates(at.sig)
        middle = (1 + at.theta) / 2
        speed, rests = rate(middle), (at.sig == 0) & ~smooth
        stops = ~rests & ~smooth & (at.sig * speed < 0)
        until_rest = jnp.maximum(-at.s / jnp.where(stops, speed, 1), 0)

        now, end = load(at.theta), load(1.0)
        d = jnp.sign(end)
        beyond = d * now >= f
        breaks = rests & jnp.where(beyond, d * load(middle) > f, d * end > f)
        grows = breaks & ~beyond
        crossed = (1 - at.theta) * (f - d * now) / jnp.where(grows, d * (end - now), 1)
        wait = jnp.where(stops, until_rest, jnp.where(breaks, jnp.where(grows, crossed, 0), jnp.inf))
        return wait, jnp.where(rests, d, 0), speed

    def go(at, wait, speed):
        s = at.s + wait * speed
        return at._replace(theta=at.theta + wait, s=s, slid=at.slid + wait * (at.s + s) / 2)

    def event(at, _):
        wait, to, speed = next_event(at)
        first = jnp.argmin(wait)
        due = wait[first] < 1 - at.theta
        after = go(at, jnp.where(due, wait[first], 0), speed)
        who = due & (jnp.arange(len(f)) == first)
        s = jnp.where(who, 0, after.s)
        return after._replace(s=s, sig=jnp.where(who, to, at.sig), kept=at.kept & ~who), None

    at = Moment(jnp.zeros((), s.dtype), jnp.where(stuck, 0, s), sig, jnp.zeros_like(s), ~stuck)
    at, _ = lax.scan(event, at, length=EVENTS * len(f))
    wait, _, speed = next_event(at)
    left = jnp.where(jnp.min(wait) < 1 - at.theta, 1 - at.theta, 0)
    end = go(at, 1 - at.theta, speed)
    s1 = jnp.where(end.kept, still, end.s)
    dtau = solve_some(W, ~end.kept, sf - s1)
    return Switch(s1, jnp.where(smooth, jnp.sign(sf - matvec(W, dtau)), end.sig), dtau, end.slid, end.kept), left
