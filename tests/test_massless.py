"""Linear systems with coordinates without mass that are damped, against the exact solution of what is left of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import hhtjax

M, K = np.diag([1.0, 0.0]), np.array([[100.0, -60.0], [-60.0, 60.0]])  # a mass, and a node behind a spring of 60
Q0, V0, END = np.array([0.1, 0.05]), np.array([0.3, 0.0]), 0.5


def maxwell(c):
    return hhtjax.LinearSystem(M, np.diag([0.0, c]), lambda params: params["k"] * K)


def exact(c, t, k=1.0):
    """q: the damper of the node moves as the spring pulls, and starts with that velocity."""
    s = 60 * k
    rates = np.array([[0, 1, 0], [-100 * k, 0, s], [s / c, 0, -s / c]])
    return (scipy.linalg.expm(t * rates) @ [Q0[0], V0[0], Q0[1]])[[0, 2]]


def path(system, stepper, dt, num_steps):
    start = jnp.asarray(Q0), jnp.asarray(V0)
    return hhtjax.simulate(system, stepper, *start, {"k": 1.0}, dt=dt, num_steps=num_steps).q


@pytest.mark.slow
@pytest.mark.parametrize("c", [5.0, 1e-6], ids=str)
def test_a_damped_node_without_mass_is_of_order_2(c):
    """Largest error of the run, from a velocity that is not the node's own, for all alpha."""
    alphas, errors = jnp.array([-1 / 3, -0.05, 0.0]), []
    all_times = np.array([exact(c, t) for t in np.linspace(0, END, 201)[1:]])
    runs = jax.jit(jax.vmap(lambda alpha, dt: path(maxwell(c), hhtjax.hht(alpha), dt, 200), (0, None)))
    for n in (100, 200):  # one program: the run with long steps goes on
        q = np.asarray(runs(alphas, END / n))[:, 1 : n + 1]
        errors.append(np.max(np.abs(q - all_times[200 // n - 1 :: 200 // n]), axis=(1, 2)))
    assert np.all(errors[1] < 1e-4)
    assert np.all(np.log2(errors[0] / errors[1]) > [1.95, 1.95, 1.8])  # with alpha = 0 the jump swings for ever


@pytest.mark.slow
def test_any_singular_mass_and_its_derivatives():
    """M of rank 2 in 4 general coordinates; forward = reverse = differences, and float32 stays so."""
    rng = np.random.default_rng(0)
    T, L = rng.normal(size=(2, 4, 4))
    C, K = 0.05 * L @ L.T + np.eye(4), 40 * (2 * np.eye(4) - np.eye(4, k=1) - np.eye(4, k=-1))
    mass, damping = (T.T @ A @ T for A in (np.diag([1.0, 2.0, 0.0, 0.0]), C))
    q, v = rng.normal(size=(2, 4)) / 10

    def general(mass, damping, k, num_steps=200, dtype=float):
        system = hhtjax.LinearSystem(
            (mass + mass.T) / 2, damping, lambda k: k.astype(dtype) * jnp.asarray(T.T @ K @ T, dtype)
        )
        start = jnp.asarray(np.linalg.solve(T, q), dtype), jnp.asarray(np.linalg.solve(T, v), dtype)
        run = hhtjax.simulate(system, hhtjax.hht(), *start, k, dt=END / num_steps, num_steps=num_steps)
        return jnp.asarray(T, dtype) @ run.q[-1]

    inverse = np.linalg.inv(C[2:, 2:])
    late = -inverse @ np.hstack([K[2:, :2], C[2:, :2], K[2:, 2:]])  # the velocities without mass
    force = -np.hstack([K[:2, :2], C[:2, :2], K[:2, 2:]]) - C[:2, 2:] @ late
    rates = np.vstack([np.eye(6)[2:4], np.diag([1.0, 0.5]) @ force, late])
    expected = (scipy.linalg.expm(END * rates) @ [*q[:2], *v[:2], *q[2:]])[[0, 1, 4, 5]]

    f = jax.jit(lambda k: general(mass, damping, k))
    np.testing.assert_allclose(f(jnp.array(1.0)), expected, atol=3e-5)
    forward, reverse = jax.jit(lambda k: (jax.jacfwd(f)(k), jax.jacrev(f)(k)))(jnp.array(1.0))
    h = 1e-4
    np.testing.assert_allclose(forward, (f(jnp.array(1 + h)) - f(jnp.array(1 - h))) / (2 * h), rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(reverse, forward, rtol=1e-9, atol=1e-12)
    with pytest.warns(hhtjax.PrecisionWarning):
        single = general(np.float32(mass), np.float32(damping), jnp.float32(1.0), dtype=jnp.float32)
    assert single.dtype == jnp.float32
    np.testing.assert_allclose(single, expected, atol=1e-4)


def held():
    return {"k": 1.0, "u": hhtjax.sampled(np.ones(3), 0.1, order=0)}


def adaptive():
    return hhtjax.simulate(maxwell(5.0), hhtjax.hht(), Q0, V0, {"k": 1.0}, dt=hhtjax.adaptive(1e-4, 1e-6), times=[END])


REFUSED = {
    "a start that divides by M": (lambda: path(maxwell(5.0), hhtjax.hht(start="simple"), END, 10), "smooth start"),
    "a stepper that does": (lambda: path(maxwell(5.0), hhtjax.rk4(), END, 10), "smooth start"),
    "error control": (adaptive, "without error control"),
    "events": (
        lambda: hhtjax.simulate(
            *(maxwell(5.0), hhtjax.hht(), Q0, V0, {"k": 1.0}),
            dt=0.1, num_steps=3, events=[hhtjax.Event(lambda q, v, t, p: q[0])],
        ),
        "leave out `events`",
    ),
    "a held input": (
        lambda: hhtjax.simulate(maxwell(5.0), hhtjax.hht(), Q0, V0, held(), dt=0.1, num_steps=3),
        "leave out held inputs",
    ),
    "an ode": (lambda: hhtjax.interop.ode(maxwell(5.0)), "Coordinates without mass"),
    "springs alone": (lambda: hhtjax.LinearSystem(M, None, K), "must be damped"),
    "one of two nodes damped": (
        lambda: hhtjax.LinearSystem(np.diag([1.0, 0, 0]), np.diag([0.0, 5, 0]), np.eye(3)),
        "must be damped",
    ),
    "a negative damper": (lambda: maxwell(-5.0), "must be damped"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_needs_a_mass_is_refused_by_name(case):
    run, message = REFUSED[case]
    with pytest.raises((NotImplementedError, ValueError), match=message):
        run()
