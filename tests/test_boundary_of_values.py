"""What the library says to arguments of the right kind that mean nothing: masses, orders of arguments, params."""

import re
from contextlib import nullcontext
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hhtjax
from hhtjax import LinearSystem, System


def pull(q, v, t, params):
    return -4.0 * q


def run(system, n=2, params=None, dt=0.1, t0=0.0):
    return hhtjax.simulate(system, hhtjax.hht(), jnp.ones(n), jnp.zeros(n), params, dt=dt, num_steps=2, t0=t0)


NO_MASS = [
    (-np.ones(2), "must be positive definite; received one that is not"),
    (np.array([1.0, 0.0]), "must be positive definite; received one that is singular"),
    (np.ones((2, 2)), "must be positive definite; received one that is singular"),
    (np.array([[1.0, 2.0], [2.0, 1.0]]), "must be positive definite; received one that is not"),
    (np.array([[0.0, 1.0], [1.0, 0.0]]), "must be positive definite; received one that is"),
    (np.array([[1.0, 0.5], [0.0, 1.0]]), "must be symmetric; received one that differs from its transpose"),
]


@pytest.mark.parametrize(("mass", "message"), NO_MASS)
def test_a_constant_mass_is_symmetric_and_positive_definite(mass, message):
    with pytest.raises(ValueError, match=f"System: `mass` {message}"):
        System(mass, pull)
    with pytest.raises(ValueError, match=f"LinearSystem: `M` {message}"):
        LinearSystem(mass)


def test_masses_of_any_units_pass_and_with_constraints_massless_ones():
    mixed = np.array([1e9, 1e-9])
    System(np.diag(mixed) + 0.3 * (np.ones((2, 2)) - np.eye(2)), pull)
    System(np.array([1.0, 0.0]), pull, lambda q, t, params: q[1:] - 1)
    jax.vmap(lambda m: System(m, pull).mass.sum())(-jnp.ones((3, 2)))  # a tracer


@pytest.mark.slow
def test_a_mass_that_is_a_function_is_looked_at_where_the_run_starts():
    masses = np.array([[[2, 0.5], [0.5, 2]], np.ones((2, 2)), -np.eye(2), [[1, 0.5], [0, 1]], np.full((2, 2), np.nan)])
    found = jax.vmap(lambda M: run(System(lambda q, params: M, pull)))(masses)
    messages = [None, *2 * ["`mass` must be positive definite"], "`mass` must be symmetric", "not finite at the start"]
    for i, message in enumerate(messages):
        one = jax.tree.map(lambda x, i=i: x[i], found)
        with pytest.raises(hhtjax.SimulationError, match=message) if message else nullcontext():
            one.check()
    assert "mass is not symmetric" in repr(jax.tree.map(lambda x: x[3], found.failure))
    slider = System(lambda q, params: jnp.array([1.0, 0.0]), pull, lambda q, t, params: q[1:] - 1)
    run(slider).check()  # with constraints it may be singular
    with pytest.raises(hhtjax.SimulationError, match="member 1 "):
        found.check()


SWAPPED = [
    (lambda t, q, v, params: -q, "(t, q, v, params)"),
    (lambda v, q, t, p: -q, "(v, q, t, p)"),
    (lambda q, v, params, time: -q, "(q, v, params, time)"),
]


@pytest.mark.parametrize(("force", "received"), SWAPPED)
def test_arguments_in_another_order_are_named(force, received):
    message = f"System: `force` must be a function force(q, v, t, params); received one with the arguments {received}."
    with pytest.raises(TypeError, match=re.escape(message)):
        System(np.ones(2), force)


def test_so_are_those_of_other_functions_and_any_other_names_pass():
    with pytest.raises(
        TypeError, match=re.escape("constraint(q, t, params); received one with the arguments (t, q, p)")
    ):
        System(np.ones(2), pull, lambda t, q, p: q[:1])
    with pytest.raises(TypeError, match=re.escape("rate(y, t, params); received one with the arguments (t, y, p)")):
        hhtjax.FirstOrderSystem(lambda t, y, p: y)
    for force in (lambda x, xdot, s, p: -x, lambda *args: -args[0], lambda a, b, t, c=1: -a, partial(pull)):
        System(np.ones(2), force)


NO_DATA = [("steel", "'steel'"), (np.array(["a"]), "an array of <U1"), (np.array([None]), "an array of object")]


class Unhashable:
    """A function that cannot be part of a program."""

    __hash__ = None
    __call__ = __repr__ = lambda *_: "Unhashable()"


WORDS = "an array, a number or a function"
ENDS = {"Unhashable()": "Make it a pytree"}


@pytest.mark.parametrize(
    ("value", "received", "what"),
    [
        *((*x, WORDS) for x in NO_DATA),
        (Unhashable(), "Unhashable()", "hashable, because a function is static under jit"),
    ],
)
def test_params_are_numbers_or_functions(value, received, what):
    end = ENDS.get(received, "What is none of them")
    message = f"`params['k'][1]` must be {what}; received {received}. {end}"
    for call in (
        lambda params: run(System(np.ones(2), pull), params=params),
        lambda params: hhtjax.sweep(
            System(np.ones(2), pull),
            hhtjax.hht(),
            np.ones(2),
            np.zeros(2),
            params,
            dts=np.array([0.1]),
            duration=1.0,
            num_samples=1,
        ),
    ):
        with pytest.raises(TypeError, match=re.escape(message)):
            call({"k": [1.0, value]})


def test_a_negative_step_under_jit_is_told_by_check():
    found = jax.jit(lambda dt: run(System(np.ones(2), pull), dt=dt))(-0.1)
    with pytest.raises(hhtjax.SimulationError, match=r"simulate: `dt` must be positive and finite; it was -0.1"):
        found.check()


def test_arrays_are_shown_by_their_shape():
    message = r"must be a real number; received an array of shape \(1000,\)\.(\n-|$)"
    with pytest.raises(TypeError, match=f"sampled: `dt` {message}"):
        hhtjax.sampled(np.ones(9), np.linspace(0, 1, 1000))
    with pytest.raises(TypeError, match=f"simulate: `t0` {message}"):
        jax.jit(lambda t0: run(System(np.ones(2), pull), t0=t0).q)(jnp.ones(1000))
    with pytest.raises(ValueError, match=r"simulate: `num_steps` must be the length of dt, 1000.*received 2\.(\n-|$)"):
        jax.jit(lambda dt: run(System(np.ones(2), pull), dt=dt).q)(jnp.ones(1000))


def test_matrices_of_a_linear_system_fit():
    message = "LinearSystem: `C` must have shape (2, 2), or (2,) for a diagonal, to fit `M`; received shape (3, 3)."
    with pytest.raises(ValueError, match=re.escape(message)):
        LinearSystem(np.ones(2), np.eye(3), np.eye(2))


def test_a_gradient_that_is_rounding_is_none():
    def constraint(q, t, params):
        """The second row is always 1."""
        return jnp.stack([q[0] - 1, jnp.sin(0.3 * q[1]) ** 2 + jnp.cos(0.3 * q[1]) ** 2 - 1 + 1e-16 * (q[0] - 1)])

    with pytest.raises(
        ValueError, match=r"`constraint` rows \[1\] have no gradient in q at the start but for rounding"
    ):
        run(System(np.ones(2), pull, constraint))


def test_functions_are_told_apart_by_identity():
    """What the docstring of `simulate` says of globals, and of the way round."""
    stiffness = [1.0]

    def define():
        return lambda q, v, t, params: -stiffness[0] * q

    force = define()
    before = run(System(np.ones(2), force)).q
    stiffness[0] = 2.0
    np.testing.assert_array_equal(run(System(np.ones(2), force)).q, before)
    assert (run(System(np.ones(2), define())).q[-1] < before[-1]).all()
