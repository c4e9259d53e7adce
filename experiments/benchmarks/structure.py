"""What structure saves: a constant or a diagonal mass, no constraint, no explicit time, a linear system."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.benchmarks.measure import least_seconds
from hhtjax.scenes import pendulum

DT = 1e-3
STEPPER = hhtjax.hht(-0.05, linearize="predictor")
ROSENBROCK = hhtjax.rowda()


def laplacian(N):
    """K/k of N masses between N + 1 springs."""
    return 2 * np.eye(N) - np.eye(N, k=1) - np.eye(N, k=-1)


def stiffening(q, v, t, params):
    """Forces of a row of hardening springs with weak damping."""
    springs = jnp.diff(q, prepend=0.0, append=0.0)
    tension = params["k"] * (springs + 0.1 * springs**3)
    return jnp.diff(tension) - params["c"] * v


def pushed(q, v, t, params):
    """The same, pushed at its end."""
    return stiffening(q, v, t, params) + jnp.where(jnp.arange(q.size) == q.size - 1, jnp.sin(3.0 * t), 0.0)


def linear(q, v, t, params):
    """Forces of linear springs."""
    return -params["k"] * (jnp.asarray(laplacian(q.size)) @ q) - params["c"] * v


def moving_mass(q, params):
    """A mass matrix that depends on q, by little."""
    return jnp.eye(q.size) * params["m"] * (1 + 1e-9 * q[:, None])


def full_mass(q, params):
    """A constant one as a function: full."""
    return jnp.eye(q.size) * params["m"]


def diagonal_mass(q, params):
    """A constant one as a function: its diagonal."""
    return jnp.full(q.size, params["m"])


def cases(N):
    """{what is saved: (with structure, without)}, each a (system, stepper)."""
    System = hhtjax.System
    array, diagonal = System(jnp.eye(N), stiffening), System(jnp.ones(N), stiffening)
    spring = hhtjax.LinearSystem(
        M=jnp.ones(N),
        C=lambda params: jnp.full(N, params["c"]),
        K=lambda params: params["k"] * jnp.asarray(laplacian(N)),
    )
    return {
        "constant mass, an array": ((array, STEPPER), (System(moving_mass, stiffening), STEPPER)),
        "constant mass, a function": (
            (System(full_mass, stiffening), STEPPER),
            (System(moving_mass, stiffening), STEPPER),
        ),
        "diagonal mass, an array": ((diagonal, STEPPER), (array, STEPPER)),
        "diagonal mass, a function": (
            (System(diagonal_mass, stiffening), STEPPER),
            (System(full_mass, stiffening), STEPPER),
        ),
        "no explicit time": ((diagonal, STEPPER), (System(jnp.ones(N), pushed), STEPPER)),
        "no explicit time, rowda": ((diagonal, ROSENBROCK), (System(jnp.ones(N), pushed), ROSENBROCK)),
        "LinearSystem": ((spring, STEPPER), (System(jnp.ones(N), linear), STEPPER)),
        "LinearSystem, rowda": ((spring, ROSENBROCK), (System(jnp.ones(N), linear), ROSENBROCK)),
    }


@partial(jax.jit, static_argnums=(1, 5))
def end(system, stepper, q0, v0, params, num_steps):
    """The last position."""
    return hhtjax.simulate(system, stepper, q0, v0, params, dt=DT, num_steps=num_steps, save_every=num_steps).q[-1]


def measure(N, num_steps, repeats, only=None):
    """us per step with and without, for a row of N masses."""
    params = {"m": 1.0, "k": 100.0, "c": 0.1}
    q0, v0 = 0.1 * jnp.sin(jnp.linspace(0.5, 3.0, N)), jnp.zeros(N)
    functions = {}
    for name, pair in cases(N).items():
        if only is None or name in only:
            for i, (system, stepper) in enumerate(pair):
                functions[name, i] = partial(end, system, stepper, q0, v0, params, num_steps)
    times = least_seconds(functions, repeats)
    return [
        {
            "structure": name,
            "N": N,
            "us_per_step": 1e6 * times[name, 0] / num_steps,
            "without_us_per_step": 1e6 * times[name, 1] / num_steps,
            "time_over_without": times[name, 0] / times[name, 1],
        }
        for name in dict.fromkeys(name for name, _ in functions)
    ]


def constraint(num_steps, repeats):
    """A pendulum in its angle, and in two coordinates with a rod."""
    functions = {}
    for name, scene in (("angle", pendulum.minimal()), ("rod", pendulum.cartesian())):
        functions[name] = partial(end, scene.system, STEPPER, scene.q0, scene.v0, scene.params, num_steps)
    times = least_seconds(functions, repeats)
    return {
        "structure": "no constraint (pendulum)",
        "N": 1,
        "us_per_step": 1e6 * times["angle"] / num_steps,
        "without_us_per_step": 1e6 * times["rod"] / num_steps,
        "time_over_without": times["angle"] / times["rod"],
    }


def run(report, fast):
    """Rows of 4 and 32 masses, and the pendulum."""
    rows = []
    for N, num_steps in ((4, 500),) if fast else ((4, 5000), (32, 300)):
        rows += measure(N, num_steps, 2 if fast else 9, ("LinearSystem",) if fast else None)
    if not fast:
        rows.append(constraint(5000, 9))
    report.table(list(rows[0]), [list(row.values()) for row in rows])
    return {"rows": rows}
