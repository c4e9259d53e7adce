"""A four-bar of three uniform bars, all of whose four joints rub: free or with a driven crank, and as one freedom."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import hhtjax

CRANK_LENGTH, COUPLER, ROCKER, GROUND = 1.0, 3.0, 2.5, 3.0
M1, M2, M3, G = 1.0, 2.0, 1.5, 9.81
LIMITS = jnp.array([0.5, 0.3, 0.2, 0.4])
PARAMS = {"A": 0.0, "W": 3.0, "F": LIMITS}
AMPLITUDE, RATE, START = 1.3, 2.0, 0.7  # of the driven crank


def mass(q, p):
    c, z = M2 * CRANK_LENGTH * COUPLER / 2 * jnp.cos(q[0] - q[1]), 0.0 * q[0]
    first, last = M1 * CRANK_LENGTH**2 / 3 + M2 * CRANK_LENGTH**2 + z, M3 * ROCKER**2 / 3 + z
    return jnp.stack([first, c, z, c, M2 * COUPLER**2 / 3 + z, z, z, z, last]).reshape(3, 3)


def lagrangian(q, v):
    s = jnp.sin(q)
    height = M1 * CRANK_LENGTH / 2 * s[0] + M2 * (CRANK_LENGTH * s[0] + COUPLER / 2 * s[1]) + M3 * ROCKER / 2 * s[2]
    return v @ mass(q, None) @ v / 2 - G * height


def force(q, v, t, p):
    momentum = jax.grad(lagrangian, argnums=1)
    own = jax.grad(lagrangian)(q, v) - jax.jvp(lambda q: momentum(q, v), (q,), (v,))[1]
    return own + jnp.stack([p["A"] * jnp.sin(p["W"] * t), 0.0 * t, 0.0 * t])


def loop(q, t, p):
    c, s = jnp.cos(q), jnp.sin(q)
    x = CRANK_LENGTH * c[0] + COUPLER * c[1] - ROCKER * c[2] - GROUND
    return jnp.stack([x, CRANK_LENGTH * s[0] + COUPLER * s[1] - ROCKER * s[2]])


def driven(q, t, p):
    return jnp.concatenate([loop(q, t, p), (q[0] - START - AMPLITUDE * jnp.sin(RATE * t))[None]])


def rates(q, v, t, p):
    """Of the four joints, the ground first."""
    return jnp.stack([v[0], v[1] - v[0], v[2] - v[1], v[2]])


def limits(q, v, L, t, p):
    return p["F"]


FREE = hhtjax.System(mass, force, loop, friction=limits, sliding=rates)
CRANK = hhtjax.System(mass, force, driven, friction=limits, sliding=rates)


def motion(t):
    """The angle of the driven crank, and its rate."""
    return START + AMPLITUDE * np.sin(RATE * t), AMPLITUDE * RATE * np.cos(RATE * t)


def angles(x, jnp=np):
    """All three, (3, ...), from that of the crank."""
    dx, dy = GROUND - CRANK_LENGTH * jnp.cos(x), -CRANK_LENGTH * jnp.sin(x)
    d2 = dx**2 + dy**2
    second = jnp.arctan2(dy, dx) + jnp.arccos((COUPLER**2 + d2 - ROCKER**2) / (2 * COUPLER * jnp.sqrt(d2)))
    up = CRANK_LENGTH * jnp.sin(x) + COUPLER * jnp.sin(second)
    along = CRANK_LENGTH * jnp.cos(x) + COUPLER * jnp.cos(second) - GROUND
    return jnp.stack([x, second, jnp.arctan2(up, along)])


def ratios(q):
    """Rates of the angles at unit rate of the crank."""
    s, c = np.sin(q), np.cos(q)
    B = np.array([[-COUPLER * s[1], ROCKER * s[2]], [COUPLER * c[1], -ROCKER * c[2]]])
    return np.append(1.0, np.linalg.solve(B, CRANK_LENGTH * np.array([s[0], -c[0]])))


@jax.jit
def _one_freedom(x, rate, F):
    """Its inertia, its force, and the limit of friction: the sum of F_i |ds_i/dx|."""

    def whole(x, rate):
        return lagrangian(*jax.jvp(lambda x: angles(x, jnp), (x,), (rate,)))

    momentum = jax.grad(whole, argnums=1)
    push = jax.grad(whole)(x, rate) - jax.jvp(lambda x: momentum(x, rate), (x,), (rate,))[1]
    slopes = rates(None, jax.jvp(lambda x: angles(x, jnp), (x,), (1.0,))[1], 0.0, None)
    return jax.grad(momentum, argnums=1)(x, rate), push, F @ jnp.abs(slopes)


def reduced(p, times):
    """Angle and rate of the crank from rest at START, solved from switch to switch, and the times of these."""

    def parts(t, y):
        M, push, limit = map(float, _one_freedom(y[0], y[1], p["F"]))
        return M, push + p["A"] * np.sin(p["W"] * t), limit

    t, y, sig, out, switches = 0.0, np.array([START, 0.0]), 0.0, np.zeros((2, len(times))), []
    while t < times[-1]:

        def event(t, y, sig=sig):
            _, push, limit = parts(t, y)
            return sig * y[1] if sig else limit - abs(push)

        def rate(t, y, sig=sig):
            M, push, limit = parts(t, y)
            return [y[1], (push - sig * limit) / M] if sig else [0.0, 0.0]

        event.terminal, event.direction = True, -1
        span = t, times[-1]
        run = solve_ivp(rate, span, y, "DOP853", rtol=1e-10, atol=1e-11, events=event, dense_output=True, max_step=0.05)
        here = (times >= t) & (times <= run.t[-1])
        if here.any():
            out[:, here] = run.sol(times[here])
        t, y = run.t[-1], run.y[:, -1]
        if run.t_events[0].size:
            switches.append(t)
            _, push, limit = parts(t, y)
            held = sig != 0 and abs(push) <= limit
            sig, short = (0.0, 0.0) if held else (np.sign(push), 1e-4 if sig == 0 else 1e-7)
            y = np.array([y[0], 0.0])
            if short:  # onwards, so that this is not found again
                M, push, limit = parts(t + short, y)
                a, grows = (push - sig * limit) / M, short == 1e-4
                y, t = y + np.array([a * short**2 / (6 if grows else 2), a * short / (2 if grows else 1)]), t + short
    return out, np.array(switches)
