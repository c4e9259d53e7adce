"""Two other ways to compute the same scenes: a time-stepping scheme with impulses, and contact by stiff springs.

Moreau and Jean's scheme, theta = 1/2: contacts whose gap is closed at the predicted midpoint act on the velocity at the
end of the step, by Newton's law of impacts and Coulomb's of friction. Impulses by projected Gauss-Seidel.

References: M. Jean, Comput. Methods Appl. Mech. Eng. 177, 1999, 235-257; V. Acary, B. Brogliato, Numerical Methods for
Nonsmooth Dynamical Systems, 2008, Ch. 10.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

import hhtjax

SWEEPS = 50  # of Gauss-Seidel
CREEP = 1e-3  # m/s, of tanh(s / CREEP)


class Path(NamedTuple):
    """Of a run by impulses; f: the impulses of steps over the step."""

    q: jax.Array
    v: jax.Array
    f: jax.Array


def rates(scene, q, v, t, params):
    """(dg/dt, s), (2 m,)."""
    contact = scene.contact
    gdot = jax.jvp(lambda q, t: jnp.atleast_1d(contact.gap(q, t, params)), (q, t), (v, jnp.ones_like(t)))[1]
    s = jnp.zeros_like(gdot) if contact.sliding is None else jnp.atleast_1d(contact.sliding(q, v, t, params))
    return jnp.concatenate([gdot, s])


def coefficients(scene, params):
    """mu and e."""
    return [
        params.get(x, 0.0) if isinstance(x, str) else x for x in (scene.contact.friction, scene.contact.restitution)
    ]


def impulses(W, y, active, mu, bounce):
    """(p_N, p_T) >= 0 with y + W p: at least `bounce` along the normals, and by Coulomb's law along the surfaces."""
    m = len(active)

    def sweep(p, _):
        for i in range(m):
            n = p[i] - (y[i] + W[i] @ p - bounce[i]) / W[i, i]
            p = p.at[i].set(jnp.where(active[i], jnp.maximum(n, 0), 0))
            j, most = m + i, mu * p[i]
            along = p[j] - (y[j] + W[j] @ p) / jnp.where(W[j, j] > 0, W[j, j], 1)
            p = p.at[j].set(jnp.clip(along, -most, most))
        return p, None

    return jax.lax.scan(sweep, jnp.zeros_like(y), length=SWEEPS)[0]


def by_impulses(scene, dt, steps, every=1, params=None):
    """A `Path`, of its saved times."""
    params = scene.params if params is None else params
    mu, e = coefficients(scene, params)
    zero = jnp.zeros_like(scene.mass)

    def step(state, _):
        q, v, t, _ = state
        middle = q + dt / 2 * v
        gap = jnp.atleast_1d(scene.contact.gap(middle, t + dt / 2, params))
        stiffness, damping = jax.jacfwd(scene.force, (0, 1))(middle, v, t + dt / 2, params)
        inverse = jnp.linalg.inv(jnp.diag(scene.mass) - dt / 2 * damping - dt**2 / 4 * stiffness)
        free = v + inverse @ (dt * scene.force(middle, v, t + dt / 2, params))
        J = jax.jacfwd(lambda v: rates(scene, middle, v, t + dt / 2, params))(zero)
        before, y = rates(scene, middle, v, t, params), rates(scene, middle, free, t + dt, params)
        bounce, active = -e * jnp.minimum(before[: len(gap)], 0), gap <= 0
        p = jax.lax.cond(
            jnp.any(active), lambda: impulses(J @ inverse @ J.T, y, active, mu, bounce), lambda: jnp.zeros_like(y)
        )
        new = free + inverse @ J.T @ p
        return (q + dt / 2 * (v + new), new, t + dt, p / dt), None

    def steps_between(state, _):
        state = jax.lax.scan(step, state, length=every)[0]
        return state, state

    q, v = scene.start(params)
    t = jnp.zeros((), q.dtype)
    begin = q, v, t, jnp.zeros_like(rates(scene, q, v, t, params))
    saved = jax.lax.scan(steps_between, begin, length=steps // every)[1]
    q, v, _, f = (jnp.concatenate([a[None], b]) for a, b in zip(begin, saved, strict=True))
    return Path(q, v, f)


def compliant(scene, stiffness):
    """The system with a spring and a damper (of the restitution, for 1 kg) at each contact, and tanh friction."""

    def forces(q, v, t, params):
        mu, e = coefficients(scene, params)
        y = rates(scene, q, v, t, params)
        m = len(y) // 2
        decay = jnp.log(jnp.maximum(e, 1e-6))
        ratio = jnp.where(jnp.asarray(e) > 0, -decay / jnp.hypot(jnp.pi, decay), 1.0)
        depth = -jnp.atleast_1d(scene.contact.gap(q, t, params))
        push = stiffness * depth - 2 * ratio * jnp.sqrt(stiffness) * y[:m]
        normal = jnp.where(depth > 0, jnp.maximum(push, 0), 0)
        return jnp.concatenate([normal, -mu * normal * jnp.tanh(y[m:] / CREEP)])

    def force(q, v, t, params):
        back = jax.vjp(lambda v: rates(scene, q, v, t, params), v)[1](forces(q, v, t, params))[0]
        return scene.force(q, v, t, params) + back

    return hhtjax.System(scene.mass, force), forces


def by_springs(scene, stiffness, dt, steps, every=1, params=None):
    """A run of it, as `hhtjax.hht()` does it."""
    params = scene.params if params is None else params
    system, _ = compliant(scene, stiffness)
    return hhtjax.simulate(system, hhtjax.hht(), *scene.start(params), params, dt=dt, num_steps=steps, save_every=every)
