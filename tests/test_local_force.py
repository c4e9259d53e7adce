"""A nonlinear force beside a linear system: the same motion as of a System, from one factorisation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hhtjax
from hhtjax import LinearSystem, System


def matrices(n):
    """Of a chain with a coupled mass matrix."""
    K = 40 * (2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1))
    return np.diag(np.linspace(1, 2, n)) + 0.05, 0.01 * K, K


def coupled(q, v, t, params):
    """On two coordinates, with a Jacobian that is neither symmetric nor constant, nor free of v and t."""
    return -params * q**3 - 0.5 * v * jnp.abs(v) * q[::-1] ** 2 + 0.1 * jnp.sin(t)


def three(n):
    """The same system: the force on named coordinates, on all of them, and in a general System."""
    M, C, K = matrices(n)
    at = [n - 1, 1]

    def load(t, params):
        return jnp.sin(3 * t) * jnp.linspace(0.0, 1.0, n)

    def everywhere(q, v, t, params):
        i = jnp.array(at)
        return jnp.zeros(n).at[i].set(coupled(q[i], v[i], t, params))

    def force(q, v, t, params):
        return load(t, params) - C @ v - jnp.asarray(K) @ q + everywhere(q, v, t, params)

    return (
        LinearSystem(M, C, K, load, nonlinear=coupled, at=at),
        LinearSystem(M, C, K, load, nonlinear=everywhere),
        System(M, force),
    )


def path(system, n, params, dt=0.05, **options):
    stepper = hhtjax.hht(alpha=-0.1, **options)
    start = jnp.linspace(0.0, 1.0, n), jnp.ones(n)
    return hhtjax.simulate(system, stepper, *start, params, dt=dt, num_steps=30)


@pytest.fixture(scope="module")
def compiled():
    """Of the three systems: the program and the run. A step that is known would be factorised before the program."""

    def both(system):
        program = jax.jit(lambda dt: path(system, 20, 300.0, dt)).lower(0.05).compile()
        return program.as_text(), program(0.05)

    return [both(system) for system in three(20)]


@pytest.mark.slow
@pytest.mark.parametrize("form", [{}, {"linearize": "state"}, {"iterations": None, "tolerance": 1e-11}], ids=str)
def test_the_motion_is_that_of_the_general_system(form, compiled):
    # on all coordinates it is like any other system; the plain form shows it
    local_and_general = [path(system, 20, 300.0, **form) for system in three(20)[::2]] if form else []
    runs = local_and_general or [run for _, run in compiled]
    for run in runs:
        run.check()
        np.testing.assert_allclose(run.q, runs[-1].q, rtol=1e-10, atol=1e-11)
        np.testing.assert_allclose(run.acceleration, runs[-1].acceleration, rtol=1e-9, atol=1e-9)
    if "iterations" in form:
        np.testing.assert_array_equal(runs[0].info.iterations, runs[-1].info.iterations)


@pytest.mark.slow
def test_derivatives_are_those_of_the_general_system():
    def end(system, params):
        return jnp.sum(path(system, 4, params, linearize="predictor").q[-1] ** 2)

    local, everywhere, general = three(4)

    def forward(f):
        return lambda p: jax.jvp(f, (p,), (1.0,))[1]

    exact = jax.jit(forward(lambda p: end(general, p)))(300.0)
    for derivative, system in ((jax.grad, local), (forward, local), (forward, everywhere)):
        np.testing.assert_allclose(jax.jit(derivative(lambda p, s=system: end(s, p)))(300.0), exact, rtol=1e-9)


@pytest.mark.slow
def test_order_two():
    n = 3
    system, start = three(n)[0], (jnp.linspace(0.0, 1.0, n), jnp.ones(n))
    dts = 0.5 / 2.0 ** np.array([6, 7, 11])
    runs = hhtjax.sweep(system, hhtjax.hht(-0.3), *start, 300.0, dts=dts, duration=0.5, num_samples=1)
    ends = np.asarray(runs.q[:, -1])
    coarse, fine = np.max(np.abs(ends[:2] - ends[2]), axis=1)
    assert abs(np.log2(coarse / fine) - 2) < 0.15


@pytest.mark.slow
def test_other_steppers_take_the_force_along():
    system, _, general = three(3)
    for stepper in (hhtjax.rk4(), hhtjax.rosenbrock()):
        start = jnp.ones(3), jnp.zeros(3)
        ours, theirs = (hhtjax.simulate(x, stepper, *start, 300.0, dt=0.02, num_steps=5) for x in (system, general))
        np.testing.assert_allclose(ours.q, theirs.q, rtol=1e-12, atol=1e-13)


@pytest.mark.slow
def test_a_force_at_few_coordinates_leaves_one_factorisation_outside_the_loop(compiled):
    """In the program of the run; of the force on all coordinates it stands inside."""

    def factorised_in_loops(text):
        found = [part for part in text.split("\n\n") if "lapack_dgetrf" in part]
        assert found
        return any("ENTRY" not in part for part in found)

    local, everywhere, _ = (text for text, _ in compiled)
    assert not factorised_in_loops(local)
    assert factorised_in_loops(everywhere)


ERRORS = [
    ("`at` must go with a `nonlinear` force; received [1] alone.", {"at": [1]}),
    ("`at` must be a list of different numbers of coordinates below 3; received [3].", {"at": [3]}),
    ("`at` must be a list of different numbers of coordinates below 3; received [1, 1].", {"at": [1, 1]}),
    ("`at` must be a list of different numbers of coordinates below 3; received 1.", {"at": 1}),
    ("`at` must be an integer, 0 or more; received -1.", {"at": [-1]}),
]


@pytest.mark.parametrize(("message", "arguments"), ERRORS)
def test_arguments_are_checked(message, arguments):
    force = {} if message.endswith("alone.") else {"nonlinear": coupled}
    with pytest.raises(ValueError, match="`") as caught:
        LinearSystem(np.ones(3), **force, **arguments)
    assert str(caught.value) == f"LinearSystem: {message}"


@pytest.mark.parametrize(
    ("message", "system"),
    [
        (
            "simulate: `nonlinear` must return a pytree like v0[at], shape (2,) float64; received shape (1,) float64.",
            LinearSystem(np.ones(3), nonlinear=lambda q, v, t, params: q[:1], at=[0, 2]),
        ),
        (
            "simulate: `nonlinear` must return a pytree like v0, shape (3,) float64; received shape () float64.",
            LinearSystem(np.ones(3), nonlinear=lambda q, v, t, params: q[0]),
        ),
        (
            "simulate: `at` must hold numbers of coordinates below 3; received [7].",
            LinearSystem(lambda params: jnp.ones(3), nonlinear=coupled, at=[7]),
        ),
    ],
)
def test_what_the_force_returns_is_checked(message, system):
    with pytest.raises(ValueError, match="`") as caught:
        hhtjax.simulate(system, hhtjax.hht(), jnp.ones(3), jnp.ones(3), 1.0, dt=0.1, num_steps=1)
    assert str(caught.value) == message
