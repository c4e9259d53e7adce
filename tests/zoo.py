"""Problems with references, and the table of steppers that the generic tests run over."""

from dataclasses import replace
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import hhtjax
from hhtjax.scenes import belt, double_pendulum, duffing


class Problem(NamedTuple):
    """A system with parameters, initial values and a duration short enough for q to stay predictable."""

    system: Any
    params: Any
    q0: Any
    v0: Any
    duration: float


def forced(q, v, t, params):
    """Double pendulum with springs, dampers and a torque on each joint that depends on time."""
    return double_pendulum.force(q, v, t, params) + jnp.array([3.0 * jnp.sin(5.0 * t), 2.0 * jnp.cos(3.0 * t)])


def counting_oscillator():
    """A mass on a spring, and a list that grows by one with each evaluation of its force."""
    counted = []

    def force(q, v, t, params):
        jax.debug.callback(lambda: counted.append(1))
        return -q

    return hhtjax.System(np.ones(1), force), counted


def everywhere(jaxpr):
    """Its operations, those of functions within it included."""
    for eqn in jaxpr.eqns:
        yield eqn
        for inner in jax.tree.leaves(list(eqn.params.values())):
            if hasattr(inner, "eqns"):
                yield from everywhere(inner)


def _double_pendulum():
    scene = double_pendulum.free()
    return Problem(scene.system, scene.params, jnp.array([0.3, -0.2]), jnp.array([0.5, -1.0]), 1.0)


def _forced_double_pendulum():
    params = {"m": (1.5, 1.0), "l": (1.0, 1.5), "k": (20.0, 10.0), "c": (0.5, 0.3), "g": double_pendulum.GRAVITY}
    system = hhtjax.System(double_pendulum.mass, forced)
    return Problem(system, params, jnp.array([0.3, -0.2]), jnp.array([0.5, -1.0]), 1.0)


def _forced_duffing():
    scene = duffing.driven()
    return Problem(scene.system, scene.params, scene.q0, jnp.array([0.3]), 2.0)


PROBLEMS = {
    "double pendulum": _double_pendulum(),
    "forced Duffing": _forced_duffing(),
    "forced double pendulum": _forced_double_pendulum(),
}

# set-valued forces: for the hht family alone, with references of their own (friction_reference.py)
DRY = {"two masses on a belt": Problem(*belt.two_masses())}

STEPPERS = {
    "hht auto": hhtjax.hht(alpha=-0.05),
    "hht predictor": hhtjax.hht(alpha=-0.1, linearize="predictor"),
    "hht held": hhtjax.hht(alpha=-0.1, linearize="held"),
    "hht state": hhtjax.hht(alpha=-0.1, linearize="state"),
    "hht twice": hhtjax.hht(alpha=-0.1, iterations=2),
    "hht converged": hhtjax.hht(alpha=-0.1, iterations=None),
    "newmark": hhtjax.newmark(linearize="predictor"),
    "bossak": hhtjax.bossak(alpha=-0.1, linearize="predictor"),
    "generalized_alpha": hhtjax.generalized_alpha(rho_inf=0.8, linearize="predictor"),
    "kim_hht": hhtjax.kim_hht(alpha=-0.1),
    "conventional_hht": hhtjax.conventional_hht(alpha=-0.1),
    "kim_implicit_euler": hhtjax.kim_implicit_euler(),
    "implicit_euler": hhtjax.implicit_euler(),
    "operator_splitting": hhtjax.operator_splitting(alpha=-0.1),
    "houbolt": hhtjax.houbolt(),
    "wilson": hhtjax.wilson(),
    "rowda": hhtjax.rowda(),
    "extrapolated": hhtjax.extrapolated(levels=3),
    "rk4": hhtjax.rk4(),
    "rodas5p": hhtjax.rodas5p(),
    "dopri5": hhtjax.dopri5(),
    "dop853": hhtjax.dop853(),
    "taylor": hhtjax.taylor(order=4),
}


EVERY = pytest.mark.slow, pytest.mark.every  # of a product the tests take a part; `-m every` runs the rest


def each(names, quick=("hht auto", "hht converged", "rowda", "rk4"), rest=()):
    """Names to run a test over, of which the fast tests take only the quick ones, and all tests but `-m every` not the
    rest, which other tests cover."""
    marks = {name: EVERY if name in rest else () if name in quick else pytest.mark.slow for name in names}
    return [pytest.param(name, marks=marks[name]) for name in names]


def covering(rows, columns):
    """All pairs, of which the tests take each row once, with the columns in turn."""
    pairs = [((i - j) % len(columns), row, column) for i, row in enumerate(rows) for j, column in enumerate(columns)]
    return [pytest.param(*pair, marks=EVERY if away else ()) for away, *pair in pairs]


@cache
def reference(name):
    """q at the end of a problem, by SciPy's DOP853 at a tolerance of 1e-12."""
    problem = PROBLEMS[name]
    n = problem.q0.size

    @jax.jit
    def rate(t, y):
        q, v = y[:n], y[n:]
        M = problem.system.mass(q, problem.params)
        Q = problem.system.force(q, v, t, problem.params)
        return jnp.concatenate([v, Q / M if M.ndim == 1 else jnp.linalg.solve(M, Q)])

    y0 = np.concatenate([problem.q0, problem.v0])
    run = solve_ivp(lambda t, y: np.asarray(rate(t, y)), (0.0, problem.duration), y0, "DOP853", rtol=1e-12, atol=1e-13)
    return run.y[:n, -1]


def run(problem, stepper, num_steps, **options):
    """The problem from start to end in num_steps steps."""
    system, params, q0, v0, duration = problem
    return hhtjax.simulate(system, stepper, q0, v0, params, dt=duration / num_steps, num_steps=num_steps, **options)


def ends_of_two(problem, stepper, num_steps, **options):
    """Runs that reach the end of a problem in num_steps steps, and in twice as many, each with the row that is its end:
    one program, for the run with long steps goes on."""
    system, params, q0, v0, duration = problem
    more = {"num_steps": 2 * num_steps, "save_every": num_steps} | options
    return [
        (hhtjax.simulate(system, stepper, q0, v0, params, dt=duration / (k * num_steps), **more), k) for k in (1, 2)
    ]


def as_data(stepper):
    """The same stepper with its coefficients, or alpha, as arrays, so that a family is compiled once."""
    numbers = {name: getattr(stepper, name) for name in ("coefficients", "alpha") if hasattr(stepper, name)}
    return replace(stepper, **jax.tree.map(jnp.asarray, numbers))


@jax.jit
def end(problem, stepper, num_steps):
    """State at the end of a problem, and whether all steps converged; compiled once for all numbers of steps."""
    system, params, q0, v0, duration = problem
    dt = duration / num_steps
    step = partial(stepper.step, system, params=params, dt=dt)

    def advance(_, carry):
        state, converged = carry
        state, info = step(state)
        return state, converged & (True if info.converged is None else info.converged)

    start = stepper.init(system, q0, v0, params, dt)
    return jax.lax.fori_loop(0, num_steps, advance, (start, jnp.array(True)))
