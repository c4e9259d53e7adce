"""What the dry friction of several joints does within a step: from event to event, as what one does jerks the others.

Between events the sliding velocities go linearly: p, by which the friction differs from that of the step in which
nobody switches, is known where a joint slides, and at rest it is what keeps the velocity there at 0,

    ds/dtheta = c - Wh p,    p = (sig f - base) where sliding,    (c - Wh p) = 0 where at rest,    theta = (t - t0)/h.

An event: a joint that slides comes to rest, or the load of one at rest grows to its limit and it breaks away. Who does
it first switches; of several at once, the first of them, until none is left (Murty 1974: finite, as K is positive).
How many that takes no small number bounds, so values come from a loop that ends with the step. Derivatives need a fixed
number, of what moves them only: the pieces between instants, however many switch at one.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from hhtjax.numerics.elimination import matvec
from hhtjax.numerics.seldom import choose, seldom
from hhtjax.steppers.friction_law import Switch
from hhtjax.systems.friction import ROUNDING, solve_some, solver_of_some

EVENTS = 64  # per joint and step: none needs so many, but without an end are those of a K that is not positive
PIECES = 4, 2  # and per joint, of a step that is differentiated; of 100 000 violent ones about one needs more


class Moment(NamedTuple):
    """Within a step: time since its start over h, sliding velocities, directions, distances over h, who kept on."""

    theta: Any
    s: Any
    sig: Any
    slid: Any
    kept: Any


class Steady(NamedTuple):
    """A step in which nobody switches: its ds/dtheta, and its friction, base = start + theta rise; limits; and Wh."""

    c: Any
    start: Any
    rise: Any
    f: Any
    Wh: Any


def run_events(sf, s, sig, tau, f, W, Wh):
    """How joints come out of a step that start with s and, unless they stick, would come out with sf; and what part of
    the step is left where the events were too many. W: fall of sf by units of friction; Wh: that of s in a time h."""
    smooth = f == 0  # where nothing rubs, nothing switches
    stuck = (sig == 0) & ~smooth
    held = solve_some(W, stuck, sf)
    still = sf - matvec(W, held)
    start, rise = jnp.where(stuck, tau, sig * f), jnp.where(stuck, held - tau, 0)
    begin = Moment(jnp.zeros((), s.dtype), jnp.where(stuck, 0, s), sig, jnp.zeros_like(s), ~stuck)
    end = _to_the_end(begin, Steady(jnp.where(stuck, 0, still - s), start, rise, f, Wh))
    s1 = jnp.where(end.kept, still, end.s)
    dtau = solve_some(W, ~end.kept, sf - s1)
    to = jnp.where(smooth, jnp.sign(sf - matvec(W, dtau)), end.sig)
    return Switch(s1, to, dtau, end.slid, end.kept), 1 - end.theta


@jax.custom_jvp
def _to_the_end(at, steady):
    """The end of the step, by as many events as there are."""

    def unfinished(carry):
        at, i = carry
        return (at.theta < 1) & (i < EVENTS * len(at.s))

    return lax.while_loop(unfinished, lambda x: (_event(x[0], steady), x[1] + 1), (at, 0))[0]


@_to_the_end.defjvp
def _(primals, tangents):
    return jax.jvp(_by_pieces, primals, tangents)


def _by_pieces(at, steady):
    """The same in a fixed number of pieces, for reverse mode."""

    def piece(at, steady):
        return _event(_settled(at, steady), steady)

    def visit(at, _):  # a `lax.cond` cannot be transposed in a batch, as this is the rule of a derivative
        return seldom(piece, at.theta < 1, at, steady), None

    return lax.scan(visit, at, length=PIECES[0] + PIECES[1] * len(at.s))[0]


def _settled(at, steady):
    """Past the events of this very instant; who switches has s = 0, whatever is differentiated."""
    sig, keeps = _switching(*lax.stop_gradient((at, steady)))
    return at._replace(s=jnp.where(keeps, at.s, 0), sig=sig, kept=at.kept & keeps)


def _switching(at, steady):
    """Directions behind the events of this very instant, and who keeps on."""

    def unfinished(carry):
        _, more, i = carry
        return more & (i < EVENTS * len(at.s))

    def visit(carry):
        at, _, i = carry
        wait, *rest = _next(at, steady)
        due = jnp.min(wait) <= 0
        after = _on(at, wait, *rest)
        return choose(due, after, at), due & (after.theta < 1), i + 1

    begin = at._replace(kept=jnp.ones_like(at.kept))
    end, *_ = lax.while_loop(unfinished, visit, (begin, at.theta < 1, 0))
    return end.sig, end.kept


def _event(at, steady):
    """On to the next event, and past it; or to the end of the step."""
    return _on(at, *_next(at, steady))


def _on(at, wait, to, speed):
    first, rest = jnp.argmin(wait), 1 - at.theta
    due = wait[first] < rest
    go = jnp.where(due, wait[first], rest)
    who = due & (jnp.arange(len(wait)) == first)
    s = at.s + go * speed
    slid = at.slid + go * (at.s + s) / 2
    theta = jnp.where(due, at.theta + go, 1)
    return Moment(theta, jnp.where(who, 0, s), jnp.where(who, to, at.sig), slid, at.kept & ~who)


def _next(at, steady):
    """How long until each joint switches, to what, and ds/dtheta till then."""
    f, smooth = steady.f, steady.f == 0
    rests = (at.sig == 0) & ~smooth
    rate, load = _motion(at.sig, rests, steady)
    middle = (1 + at.theta) / 2
    speed = rate(middle)
    stops = ~rests & ~smooth & (at.sig * speed < 0)
    until_rest = jnp.maximum(-at.s / jnp.where(stops, speed, 1), 0)

    now, end = load(at.theta), load(1.0)
    d = jnp.sign(end)
    beyond = d * now >= f
    most = f + ROUNDING * float(jnp.finfo(f.dtype).eps) * jnp.max(f)  # else it could stop and break away for ever
    breaks = rests & jnp.where(beyond, d * load(middle) > most, d * end > most)
    grows = breaks & ~beyond
    crossed = (1 - at.theta) * (f - d * now) / jnp.where(grows, d * (end - now), 1)
    wait = jnp.where(stops, until_rest, jnp.where(breaks, jnp.where(grows, crossed, 0), jnp.inf))
    return wait, jnp.where(rests, d, 0), speed


def _motion(sig, rests, steady):
    """ds/dtheta and the friction as functions of theta, with these directions; both are linear."""
    c, start, rise, f, Wh = steady
    p = [jnp.where(rests, 0, sig * f - start), jnp.where(rests, 0, -rise)]
    hold = solver_of_some(Wh, rests)
    p = [x + hold(y - matvec(Wh, x)) for x, y in zip(p, (c, jnp.zeros_like(c)), strict=True)]

    def rate(theta):
        return jnp.where(rests, 0, c - matvec(Wh, p[0] + theta * p[1]))

    return rate, lambda theta: start + p[0] + theta * (rise + p[1])
