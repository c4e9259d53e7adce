"""What several test files share: a spring to spoil, messages of errors, three ways to a derivative, a slope."""

import re
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from zoo import PROBLEMS, STEPPERS, as_data, end, reference

import hhtjax
from hhtjax import System, simulate

NAN, INF = float("nan"), float("inf")
ONE, ZERO = np.ones(1), np.zeros(1)
SINGLE = ONE.astype(np.float32)
EYE = np.eye(2)
COMPLEX = np.array([1j])
STEPS = 200, 400
FEW = 40, 80  # for high orders, before rounding


def pull(q, v, t, params):
    """Springs of stiffness 4 on every coordinate."""
    return jax.tree.map(lambda x: -4.0 * x, q)


def lagrangian(q, v, t, params):
    """Of `pull`, with unit masses."""
    return 0.5 * jnp.sum(v**2) - 2.0 * jnp.sum(q**2)


class Unhashable:
    """A function that cannot be a key of JAX's cache."""

    __hash__ = None  # pyright: ignore[reportAssignmentType]

    def __call__(self, *args):
        return args[0]

    def __repr__(self):
        return "Unhashable()"


SPRING = System(ONE, pull)


def run(system=SPRING, stepper=STEPPERS["rk4"], q0=ONE, v0=ZERO, params=None, dt=0.1, num_steps=4, **options):
    """A short run, of which the tests spoil one argument."""
    return simulate(system, stepper, q0, v0, params, dt=dt, num_steps=num_steps, **options)


def check_message(error, message, call):
    """`message` must be part of the text of the error that call() raises."""
    with pytest.raises(error, match=re.escape(message)):
        call()


def with_tolerance(stepper, tolerance):
    """The same, Newton's tolerance changed, where there is one."""
    if getattr(stepper, "options", None) is None:
        return stepper
    return replace(stepper, options=replace(stepper.options, tolerance=tolerance))


def tight(stepper):
    """Newton to rounding, where there is one: central differences see its tolerance."""
    return with_tolerance(stepper, 1e-13)


def check_gradient(loss, arguments, rtol=1e-10, step=1e-4):
    """Compares three derivatives of loss(arguments), a pytree of numbers; returns that of reverse mode, a vector.

    Reverse mode by differences in each argument; forward mode along one direction, in which each counts as much.
    step: of the differences, relative.
    """
    x0, unravel = ravel_pytree(arguments)
    x0 = np.asarray(x0)

    def f(x):
        return loss(unravel(x))

    reverse = np.asarray(jax.jit(jax.grad(f))(x0))
    size = np.maximum(np.abs(reverse), 1e-3 * np.max(np.abs(reverse)))
    assert np.all(np.isfinite(reverse))
    # one program gives the derivative along a direction and, for the differences, the values
    value_and_forward = jax.jit(lambda x, direction: jax.jvp(f, (x,), (direction,)))
    direction = np.where(reverse < 0, -1, 1) * np.linspace(1.0, 0.5, x0.size) / size  # nothing cancels
    assert abs(value_and_forward(x0, direction)[1] - reverse @ direction) < rtol
    for i, value in enumerate(x0):
        h = step * (abs(value) or 1.0)
        e = h * np.eye(x0.size)[i]

        def at(shift, e=e):
            return float(value_and_forward(x0 + shift * e, direction)[0])

        # fourth order, so that truncation and rounding both stay below 1e-7
        central = (8 * (at(1) - at(-1)) - (at(2) - at(-2))) / (12 * h)
        assert abs(central - reverse[i]) < 1e-6 * size[i], (i, central, reverse[i])
    return reverse


def path_loss(problem, stepper, num_steps, save_every):
    """A loss of the whole path, of positions, velocities and accelerations."""

    def loss(arguments):
        params, q0, v0, dt, t0 = arguments
        path = hhtjax.simulate(
            problem.system, stepper, q0, v0, params, dt=dt, t0=t0, num_steps=num_steps, save_every=save_every
        )
        return jnp.sum(path.q**2) + 0.3 * jnp.sum(path.v**2) + 0.1 * jnp.sum(path.acceleration**2) + jnp.sum(path.t)

    return loss


def slope(problem, stepper):
    """log2 of the ratio of the errors at the end with STEPS steps, or FEW."""
    ends = [end(PROBLEMS[problem], as_data(stepper), n) for n in (STEPS if stepper.order < 5 else FEW)]
    assert all(converged for _, converged in ends)
    errors = [np.linalg.norm(state.q - reference(problem)) for state, _ in ends]
    return np.log2(errors[0] / errors[1])


def forward(f, x):
    """f' by plain JAX."""
    with hhtjax.plain():
        return jax.jit(lambda x: jax.jvp(f, (x,), (jnp.ones_like(x),))[1])(x)
