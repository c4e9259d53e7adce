"""Systems and steppers of every kind, each made from scratch, no two of them equal."""

from functools import partial

import jax.numpy as jnp
import numpy as np

import hhtjax
from hhtjax import LinearSystem, System, simulate


def pull(q, v, t, params):
    """A spring of stiffness 4."""
    return -4.0 * q


def drag(q, v, t, params, c):
    """A damper."""
    return -c * v


def push(q, v, t, params):
    """The opposite of `pull`."""
    return 4.0 * q


def inertia(q, params):
    """A constant mass as a function."""
    return jnp.full(1, 2.0)


def hold(q, t, params):
    """A constraint."""
    return q


def load(t, params):
    """A constant load."""
    return jnp.ones(1)


def lagrangian(q, v, t, params):
    """Of a unit mass on a spring."""
    return 0.5 * jnp.sum(v**2) - 2.0 * jnp.sum(q**2)


def other_solve(A, b):
    """In place of the library's."""
    return jnp.linalg.solve(A, b)


ONE, TWO = np.ones(1), np.full(1, 2.0)
# each entry makes a description from scratch; no two of them are equal
DESCRIPTIONS = {
    "mass 1": lambda: System(np.ones(1), pull),
    "mass 2": lambda: System(np.full(1, 2.0), pull),
    "mass 1 read as an integer": lambda: System(np.ones(1).view(np.int64), pull),
    "mass matrix": lambda: System(np.ones((1, 1)), pull),
    "mass of two": lambda: System(np.ones(2), pull),
    "float32 mass": lambda: System(np.ones(1, np.float32), pull),
    "other force": lambda: System(np.ones(1), push),
    "mass function": lambda: System(inertia, pull),
    "constraint": lambda: System(np.ones(1), pull, hold),
    "partial force": lambda: System(np.ones(1), partial_pull),
    "lagrangian": lambda: System.from_lagrangian(lagrangian),
    "lagrangian and force": lambda: System.from_lagrangian(lagrangian, pull),
    "linear": lambda: LinearSystem(np.ones(1)),
    "linear, damped": lambda: LinearSystem(np.ones(1), C=np.ones(1)),
    "linear, stiff": lambda: LinearSystem(np.ones(1), K=np.ones(1)),
    "linear, stiffer": lambda: LinearSystem(np.ones(1), K=np.full(1, 2.0)),
    "linear, loaded": lambda: LinearSystem(np.ones(1), force=load),
    "linear, function": lambda: LinearSystem(lambda_matrix),
    "hht": lambda: hhtjax.hht(alpha=-0.05),
    "hht 0.1": lambda: hhtjax.hht(alpha=-0.1),
    "hht 0.1 as data": lambda: hhtjax.hht(alpha=jnp.asarray(-0.1, jnp.float64)),
    "hht 0.2 as data": lambda: hhtjax.hht(alpha=jnp.asarray(-0.2, jnp.float64)),
    "hht held": lambda: hhtjax.hht(alpha=-0.05, linearize="held"),
    "hht twice": lambda: hhtjax.hht(alpha=-0.05, iterations=2),
    "hht converged": lambda: hhtjax.hht(alpha=-0.05, iterations=None),
    "hht converged loosely": lambda: hhtjax.hht(alpha=-0.05, iterations=None, tolerance=1e-6),
    "hht converged soon": lambda: hhtjax.hht(alpha=-0.05, iterations=None, max_iterations=5),
    "hht corrected": lambda: hhtjax.hht(alpha=-0.05, start="corrected"),
    "hht solve": lambda: hhtjax.hht(alpha=-0.05, solve=other_solve),
    "newmark": lambda: hhtjax.newmark(),
    "newmark damped": lambda: hhtjax.newmark(beta=0.3025, gamma=0.6),
    "bossak": lambda: hhtjax.bossak(alpha=-0.05),
    "generalized_alpha": lambda: hhtjax.generalized_alpha(rho_inf=0.8),
    "implicit_euler": lambda: hhtjax.implicit_euler(),
    "kim_hht": lambda: hhtjax.kim_hht(alpha=0.0),
    "kim_hht 0.1": lambda: hhtjax.kim_hht(alpha=-0.1),
    "kim_implicit_euler": lambda: hhtjax.kim_implicit_euler(),
    "rk4": lambda: hhtjax.rk4(),
}
partial_pull = partial(drag, c=0.5)


def lambda_matrix(params):
    """A mass as a function of params."""
    return jnp.ones(1)


def run(system, stepper, q0=ONE, v0=0 * ONE, params=None, dt=0.1, num_steps=4, **options):
    """A short run."""
    return simulate(system, stepper, q0, v0, params, dt=dt, num_steps=num_steps, **options)
