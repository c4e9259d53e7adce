"""Dry friction solved from switch to switch: what the steps are measured against, by formulas of its own."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

TOLERANCE = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-12}


@partial(jax.jit, static_argnums=0)
def terms(system, q, v, t, params):
    """M, Q, F, s, H and the part of ds/dt without w, of a system in minimal coordinates."""

    def s(q, v, t):
        return v if system.sliding is None else system.sliding(q, v, t, params)

    M = system.mass(q, params) if callable(system.mass) else jnp.asarray(system.mass)
    M = jnp.diag(M) if M.ndim == 1 else M
    F = system.friction(q, v, t, params)
    own = jax.jvp(lambda q, t: s(q, v, t), (q, t), (v, 1.0))[1]
    return M, system.force(q, v, t, params), F, s(q, v, t), jax.jacfwd(s, argnums=1)(q, v, t), own


def accelerations(system, params, sig, t, y):
    """w and tau, for joints that slide as sig says and stick where it is 0; limits and sliding velocities."""
    n = y.size // 2
    M, Q, F, s, H, own = (np.asarray(x) for x in terms(system, y[:n], y[n:], t, params))
    stuck = sig == 0
    free = np.linalg.solve(M, Q - H.T @ (sig * F))
    G = np.linalg.solve(M, H.T)
    tau = sig * F
    if stuck.any():
        tau[stuck] = np.linalg.solve((H @ G)[np.ix_(stuck, stuck)], (H @ free + own)[stuck])
    return free - G @ np.where(stuck, tau, 0), tau, F, s


def settled(system, params, sig, t, y):
    """sig after a switch: joints that nothing holds slide where their load pulls."""
    for _ in sig:
        _, tau, F, _ = accelerations(system, params, sig, t, y)
        over = (sig == 0) & (np.abs(tau) > F * (1 + 1e-9))
        if not over.any():
            break
        worst = np.argmax(np.where(over, np.abs(tau) - F, 0))
        sig = np.where(np.arange(sig.size) == worst, np.sign(tau), sig)
    return sig


def motion(system, params, q0, v0, times):
    """q, v and sticking at the times, and the times of all switches."""
    n, y, t, end = q0.size, np.concatenate([q0, v0]), 0.0, times[-1]
    s = accelerations(system, params, np.zeros(1), t, y)[3] if system.sliding is None and n == 1 else None
    s = np.asarray(terms(system, y[:n], y[n:], t, params)[3]) if s is None else s
    sig = settled(system, params, np.sign(s), t, y)
    out, switches = np.zeros((len(times), 2 * n)), []
    stuck = np.zeros((len(times), sig.size), bool)
    while True:
        events = [partial(_event, system, params, sig, i) for i in range(sig.size)]
        for event in events:
            event.terminal, event.direction = True, -1
        rate = partial(_rate, system, params, sig)
        run = solve_ivp(rate, (t, end), y, dense_output=True, events=events, **TOLERANCE)
        here = (times >= t) & (times <= run.t[-1])
        if here.any():
            out[here], stuck[here] = run.sol(times[here]).T, sig == 0
        t, y = run.t[-1], run.y[:, -1]
        if t >= end:
            return out[:, :n], out[:, n:], stuck, np.array(switches)
        i = next(i for i, found in enumerate(run.t_events) if found.size)
        switches.append(t)
        if sig[i]:
            sig = np.where(np.arange(sig.size) == i, 0, sig)
            y = np.concatenate([y[:n], _stopped(system, params, sig, t, y)])
        else:
            tau = accelerations(system, params, sig, t, y)[1]
            sig = np.where(np.arange(sig.size) == i, np.sign(tau), sig)
        sig = settled(system, params, sig, t, y)
        t, y = _past(system, params, sig, i, t, y)


def _rate(system, params, sig, t, y):
    return np.concatenate([y[y.size // 2 :], accelerations(system, params, sig, t, y)[0]])


def _event(system, params, sig, i, t, y):
    """Falls through 0 where joint i switches."""
    _, tau, F, s = accelerations(system, params, sig, t, y)
    return sig[i] * s[i] if sig[i] else F[i] - np.abs(tau[i])


def _stopped(system, params, sig, t, y):
    """v with the sliding velocities of stuck joints 0, but for rounding already."""
    n, stuck = y.size // 2, sig == 0
    M, _, _, s, H, _ = (np.asarray(x) for x in terms(system, y[:n], y[n:], t, params))
    G = np.linalg.solve(M, H[stuck].T)
    return y[n:] - G @ np.linalg.solve(H[stuck] @ G, s[stuck])


def _past(system, params, sig, i, t, y):
    """A little behind a switch, so that its event is not found again: Taylor's series over 1e-7 s."""
    if _event(system, params, sig, i, t, y) > 1e-9:
        return t, y
    h, n = 1e-7, y.size // 2
    first = _rate(system, params, sig, t, y)
    second = _rate(system, params, sig, t + h, y + h * first)
    return t + h, np.concatenate([y[:n] + h * y[n:] + h**2 / 2 * first[n:], y[n:] + h * (first + second)[n:] / 2])
