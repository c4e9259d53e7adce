"""Dry friction solved from switch to switch: what the steps are measured against, by formulas of its own."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

from hhtjax.rotation import hat

TOLERANCE = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-12, "max_step": 0.02}


def terms(system, shapes, t, y, params):
    """M, Q, F, s, H, the part of ds/dt without w, and the rates of q and z, without constraints."""
    ends = np.cumsum([np.prod(shape, dtype=int) for shape in shapes])
    q, v, z = (part.reshape(shape) for part, shape in zip(jnp.split(y, ends[:-1]), shapes, strict=True))
    z = () if system.internal is None else (z,)

    def s(q, v, t):
        return v if system.sliding is None else system.sliding(q, v, t, params)

    M = system.mass(q, params) if callable(system.mass) else jnp.asarray(system.mass)
    M = jnp.diag(M) if M.ndim == 1 else M
    qdot = q @ hat(v) if q.shape == (3, 3) else v
    own = jax.jvp(lambda q, t: s(q, v, t), (q, t), (qdot, 1.0))[1]
    F, Q = (f(q, v, *z, t, params) for f in (system.friction, system.force))
    zdot = system.internal(q, v, *z, t, params) if z else jnp.zeros(0)
    return M, Q, F, s(q, v, t), jax.jacfwd(s, argnums=1)(q, v, t), own, qdot.ravel(), zdot


def state(system, shapes, params, sig, t, y):
    """Rates of y, tau, F and s; sig as below."""
    M, Q, F, s, H, own, qdot, zdot = terms(system, shapes, t, y, params)
    stuck, G = sig == 0, jnp.linalg.solve(M, H.T)
    w = jnp.linalg.solve(M, Q - H.T @ (sig * F))
    among = jnp.where(jnp.outer(stuck, stuck), H @ G, jnp.eye(sig.size))
    held = jnp.where(stuck, jnp.linalg.solve(among, jnp.where(stuck, H @ w + own, 0.0)), 0.0)
    return jnp.concatenate([qdot, w - G @ held, zdot]), sig * F + held, F, s


@cache
def compiled(system, shapes):
    """The two functions above, of this system."""
    return jax.jit(partial(terms, system, shapes)), jax.jit(partial(state, system, shapes))


class Motion:
    """A system on its way; sig: the directions in which its joints slide, 0 where they stick."""

    def __init__(self, system, params, q0, v0, z0=None):
        z0 = np.zeros(0) if z0 is None else z0
        self.shapes = tuple(np.shape(x) for x in (q0, v0, z0))
        self.split = np.cumsum([np.size(q0), np.size(v0)])
        self.params = jax.tree.map(jnp.asarray, params)
        self.of_system = compiled(system, self.shapes)
        self.t, self.y = 0.0, np.concatenate([np.ravel(x) for x in (q0, v0, z0)])
        _, _, _, s, *_ = self.terms(self.t, self.y)
        self.sig = np.where(np.abs(s) < 1e-14, 0, np.sign(s))
        self.settle()

    def terms(self, t, y):
        return map(np.asarray, self.of_system[0](t, y, self.params))

    def state(self, t, y):
        return tuple(map(np.asarray, self.of_system[1](self.params, self.sig, t, y)))

    def event(self, i, t, y):
        """Falls through 0 where joint i switches."""
        _, tau, F, s = self.state(t, y)
        return self.sig[i] * s[i] if self.sig[i] else F[i] - np.abs(tau[i])

    def settle(self):
        """Joints that nothing holds slide where their load pulls, those first that it pulls most."""
        for _ in self.sig:
            _, tau, F, _ = self.state(self.t, self.y)
            over = np.where(self.sig == 0, np.abs(tau) - F * (1 + 1e-9), -1)
            if np.all(over <= 0):
                break
            self.sig[np.argmax(over)] = np.sign(tau[np.argmax(over)])

    def stop(self):
        """Sliding velocities of stuck joints 0, but for rounding already."""
        M, _, _, s, H, *_ = self.terms(self.t, self.y)
        stuck = self.sig == 0
        G = np.linalg.solve(M, H[stuck].T)
        self.y[slice(*self.split)] -= G @ np.linalg.solve(H[stuck] @ G, s[stuck])

    def switch(self, i):
        """Joint i stops, or breaks away; then a little onwards, so that this is not found again."""
        if self.sig[i]:
            self.sig[i] = 0
            self.stop()
        else:
            self.sig[i] = np.sign(self.state(self.t, self.y)[1][i])
        self.settle()
        if self.event(i, self.t, self.y) < 1e-9:
            h, first = 1e-7, self.state(self.t, self.y)[0]
            self.y = self.y + h / 2 * (first + self.state(self.t + h, self.y + h * first)[0])
            self.t += h

    def at(self, times):
        """q, v, z and sticking at the times, and the times of all switches."""
        out, switches = np.zeros((len(times), self.y.size)), []
        stuck = np.zeros((len(times), self.sig.size), bool)
        while self.t < times[-1]:
            events = [partial(self.event, i) for i in range(self.sig.size)]
            for event in events:
                event.terminal, event.direction = True, -1
            span = self.t, times[-1]
            run = solve_ivp(
                lambda t, y: self.state(t, y)[0], span, self.y, dense_output=True, events=events, **TOLERANCE
            )
            here = (times >= self.t) & (times <= run.t[-1])
            if here.any():
                out[here], stuck[here] = run.sol(times[here]).T, self.sig == 0
            self.t, self.y = run.t[-1], run.y[:, -1]
            found = [i for i, x in enumerate(run.t_events) if x.size]
            if found:
                switches.append(self.t)
                self.switch(found[0])
        q, v, z = np.split(out, self.split, axis=1)
        q, v = (x.reshape(len(times), *shape) for x, shape in zip((q, v), self.shapes, strict=False))
        return q, v, z, stuck, np.array(switches)
