"""Starts, events and held inputs that leave a stiffly damped coordinate off its slow manifold.

    m q'' = F - k q - c q',  m -> 0,  q = F/k (1 - exp(-k t/c)) from rest

The layer of m/c is far shorter than a step. What a method leaves of it in q is its error over F/k.
"""

import jax.numpy as jnp
import numpy as np

import hhtjax

MASSES = 10.0 ** -np.arange(0, 13)
F, K, C, H = 1.0, 50.0, 5.0, 1e-3
STEPS = 200
LIGHT = 1e-3  # kg, up to which the layer is shorter than a few steps
STEPPERS = {
    "hht(0)": hhtjax.hht(0.0),
    "hht()": hhtjax.hht(),
    "hht(-1/3)": hhtjax.hht(-1 / 3),
    "generalized_alpha(.8)": hhtjax.generalized_alpha(0.8),
    "generalized_alpha(.2)": hhtjax.generalized_alpha(0.2),
    "bossak(-.1)": hhtjax.bossak(),
    "wilson": hhtjax.wilson(),
    "houbolt": hhtjax.houbolt(),
    "park": hhtjax.park(),
    "rosenbrock": hhtjax.rosenbrock(),
    "rowda": hhtjax.rowda(),
    "implicit_euler": hhtjax.implicit_euler(),
}


def mass(q, params):
    return params["m"] * jnp.ones(1)


PUSHED = hhtjax.System(mass, lambda q, v, t, params: F - K * q - C * v)
SWITCHED = hhtjax.System(mass, lambda q, v, t, params: params["on"] * F - K * q - C * v)
DRIVEN = hhtjax.System(mass, lambda q, v, t, params: params["u"](t) - K * q - C * v)
BESIDE = hhtjax.System(
    lambda q, params: jnp.stack([jnp.ones(()), jnp.ones(()), params["m"]]),
    lambda q, v, t, params: jnp.stack([jnp.zeros(()), -9.81 * jnp.ones(()), F - K * q[2] - C * v[2]]),
    constraint=lambda q, t, params: (q[:1] ** 2 + q[1:2] ** 2 - 1.0) / 2,
)  # a pendulum in x, y beside it, which does not feel it
ON = hhtjax.Event(
    lambda q, v, t, params: (params["at"] - t) * (1 - 2 * params["on"]), switch=lambda params: params | {"on": 1.0}
)
REST = jnp.zeros(1), jnp.zeros(1)


def exact(t, m, start=0.0):
    """From rest under F from `start` on: the solution of the linear equation."""
    root = np.sqrt(complex(C**2 - 4 * m * K))
    slow, fast = -2 * K / (C + root), -(C + root) / (2 * m)
    t = np.maximum(t - start, 0)
    return np.real(F / K * (1 - (fast * np.exp(slow * t) - slow * np.exp(fast * t)) / (fast - slow)))


def largest(q, t, m, start=0.0):
    """Error over F/k."""
    return float(np.max(np.abs(np.asarray(q)[:, 0] - exact(np.asarray(t), m, start))) * K / F)


def from_rest(stepper, m, h=H):
    """A force that acts from the start on."""
    run = hhtjax.simulate(PUSHED, stepper, *REST, {"m": m}, dt=h, num_steps=STEPS)
    return largest(run.q, run.t, m)


def after_an_event(stepper, m, at=50.5 * H):
    """A force that an event switches on, within a step."""
    params = {"m": m, "on": 0.0, "at": at}
    run = hhtjax.simulate(SWITCHED, stepper, *REST, params, dt=H, num_steps=STEPS, events=[ON])
    return largest(run.q, run.t, m, at)


def after_a_jump(stepper, m):
    """A held input that jumps between two steps."""
    u = hhtjax.sampled(jnp.array([0.0, F, F]), 50 * H, order=0)
    run = hhtjax.simulate(DRIVEN, stepper, *REST, {"m": m, "u": u}, dt=H, num_steps=STEPS)
    return largest(run.q, run.t, m, 50 * H)


def with_a_constraint(stepper, m):
    """The same beside a pendulum."""
    start = jnp.array([0.6, -0.8, 0.0]), jnp.zeros(3)
    run = hhtjax.simulate(BESIDE, stepper, *start, {"m": m}, dt=H, num_steps=STEPS)
    return largest(run.q[:, 2:], run.t, m)


KINDS = {
    "start": from_rest,
    "behind an event": after_an_event,
    "behind a held jump": after_a_jump,
    "with a constraint": with_a_constraint,
}


def errors(report, fast):
    """{kind: {stepper: errors over F/k, one for each mass}}; None where the stepper does not know the kind."""
    masses = MASSES[::4] if fast else MASSES
    names = list(STEPPERS)[:3] if fast else STEPPERS
    found = {}
    for kind, script in KINDS.items():
        found[kind] = {}
        for name in names:
            try:
                found[kind][name] = [script(STEPPERS[name], m) for m in masses]
            except NotImplementedError:
                continue
            report.progress(f"{kind}: {name}")
    return {"m_kg": [float(m) for m in masses], "error_over_F_by_k": found}


def orders(fast):
    """Of hht and its relatives from rest, where m is next to nothing: the slope between 4 h and h."""
    names = ("hht()", "hht(-1/3)", "generalized_alpha(.8)", "bossak(-.1)")[: 1 if fast else None]
    return {
        name: {f"{m:.0e}": float(np.log2(from_rest(STEPPERS[name], m, 4 * H) / from_rest(STEPPERS[name], m)) / 2)
               for m in (1e-6, 1e-9)}
        for name in names
    }  # fmt: skip
