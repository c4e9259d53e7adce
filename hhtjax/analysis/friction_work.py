"""The work of dry friction between the saved times of a run."""

from functools import partial

import jax
import jax.numpy as jnp

from hhtjax.numerics.elimination import matvec
from hhtjax.systems import held
from hhtjax.systems.constraints import answers
from hhtjax.systems.friction import directions, responses
from hhtjax.systems.friction_rows import rows_of


def directions_of(solution):
    """In which direction each joint slides: (K + 1, m), 0 where it sticks."""
    return jnp.where(solution.sticking, 0, jnp.sign(solution.friction))


def switches(solution):
    """Whether some joint switches in an interval: (K, 1)."""
    sig = directions_of(solution)
    return jnp.any(sig[1:] != sig[:-1], axis=1, keepdims=True)


def friction_work(flat, solution, ends, middles, w, params):
    """What dry friction did to the system in each interval, minus the integral of tau' H v: (K,).

    H v = s + c, where c is the speed of what a joint rubs on. Joints that keep on: Simpson's rule, with the limit in
    the middle where they slide. Of one that switches, s goes to 0 at theta h and on from there, both linearly, over
    the distance d; and the jump of w, which is not in the change of v, tells the mean of tau, for c:

        integral tau s = h (theta tau0 s0 + (1 - theta) tau1 s1)/2,    d = h (theta s0 + (1 - theta) s1)/2
        mean tau = (tau0 + tau1)/2 + K^-1 H [(w0 + w1)/2 - (v1 - v0)/h],    K = H G

    ends: q, v, t at the saved times, middles: q, v, t, L between; w: (K + 1, N).
    """
    h, v = jnp.diff(solution.t), ends[1]
    unseen = (w[1:] + w[:-1]) / 2 - jnp.diff(v, axis=0) / jnp.where(h > 0, h, 1)[:, None]
    saved = (*ends, solution.friction, directions_of(solution))
    first, last = (jax.tree.map(lambda x, part=part: x[part], saved) for part in (slice(-1), slice(1, None)))
    return -h * jax.vmap(partial(_power, flat, params))(first, middles, last, unseen)


def _power(flat, params, first, middle, last, unseen):
    """The mean of tau' H v over an interval; a held input has the value that it has inside."""
    (*_, tau0, sig0), (q, v, t, L), (*_, tau1, sig1) = first, middle, last
    params = held.held_at(params, t)
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
    """The mean over an interval, of values at its ends and in its middle."""
    return (x[0] + 4 * x[1] + x[2]) / 6
