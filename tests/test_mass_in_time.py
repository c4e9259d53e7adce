"""Masses that depend on the time: a load on a rope that is hoisted, and what leaks."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled_c import Library, needs_compiler
from helpers import check_gradient
from scipy.integrate import solve_ivp
from zoo import Problem, as_data, each, ends_of_two

import hhtjax
from hhtjax import System

PARAMS = {"cart": 2.0, "load": 1.0, "c": 0.3, "amplitude": 0.5}
Q0, V0, DURATION = jnp.array([0.1, 0.6]), jnp.array([0.2, -0.3]), 2.0
STEPPERS = {
    "hht": (hhtjax.hht(), 2),
    "newton": (hhtjax.hht(-0.3, iterations=None), 2),
    "held": (hhtjax.hht(linearize="held"), 2),
    "state": (hhtjax.hht(linearize="state"), 2),
    "corrected": (hhtjax.hht(-0.3, start="corrected"), 2),
    "generalized_alpha": (hhtjax.generalized_alpha(0.5), 2),
    "bossak": (hhtjax.bossak(), 2),
    "wilson": (hhtjax.wilson(), 2),
    "houbolt": (hhtjax.houbolt(), 2),
    "park": (hhtjax.park(), 2),
    "rosenbrock": (hhtjax.rosenbrock(), 2),
    "rowda": (hhtjax.rowda(), 3),
    "rk4": (hhtjax.rk4(), 4),
    "dopri5": (hhtjax.dopri5(), 5),
    "implicit_euler": (hhtjax.implicit_euler(), 1),
    "conventional": (hhtjax.conventional_hht(), 2),
    "kim": (hhtjax.kim_hht(), 1),
    "kim_implicit_euler": (hhtjax.kim_implicit_euler(), 1),
    "operator_splitting": (hhtjax.operator_splitting(), 1),
}


def length(t, params):
    """Of the rope."""
    return 2.0 + params["amplitude"] * jnp.sin(3.0 * t)


def lagrangian(q, v, t, params):
    """A cart, and a load on a rope; q = (x, angle)."""
    r, rate = length(t, params), 3.0 * params["amplitude"] * jnp.cos(3.0 * t)
    sine, cosine = jnp.sin(q[1]), jnp.cos(q[1])
    velocity = jnp.stack([v[0] + rate * sine + r * cosine * v[1], r * sine * v[1] - rate * cosine])
    return 0.5 * params["cart"] * v[0] ** 2 + params["load"] * (0.5 * velocity @ velocity + 9.81 * r * cosine)


def damper(q, v, t, params):
    return jnp.stack([-params["c"] * v[0], 0.0 * v[1]])


CRANE = System.from_lagrangian(lagrangian, damper)


def mass(q, t, params):
    """By hand, from the accelerations along and across the rope."""
    m, r = params["load"], length(t, params)
    return jnp.array([[params["cart"] + m, m * r * jnp.cos(q[1])], [m * r * jnp.cos(q[1]), m * r**2]])


def force(q, v, t, params):
    m, (s, c) = params["load"], (jnp.sin(q[1]), jnp.cos(q[1]))
    r, rate = jax.jvp(lambda t: length(t, params), (t,), (jnp.ones_like(t),))
    second = -9.0 * (r - 2.0)
    on_cart = m * (r * s * v[1] ** 2 - 2 * rate * c * v[1] - second * s) - params["c"] * v[0]
    return jnp.stack([on_cart, -m * r * (2 * rate * v[1] + 9.81 * s)])


BY_HAND = System(mass, force)  # the same motion, from a third of the program of the Lagrangian


@jax.jit
def rate_by_hand(t, y, params):
    q, v, t = y[:2], y[2:], jnp.asarray(t, y.dtype)
    return jnp.concatenate([v, jnp.linalg.solve(mass(q, t, params), force(q, v, t, params))])


@cache
def by_scipy():
    y0 = np.concatenate([Q0, V0])
    path = solve_ivp(rate_by_hand, (0, DURATION), y0, "DOP853", args=(PARAMS,), rtol=1e-12, atol=1e-13)
    return path.y[:, -1]


def run(stepper, params=PARAMS, system=BY_HAND, num_steps=100, **options):
    return hhtjax.simulate(system, stepper, Q0, V0, params, dt=DURATION / num_steps, num_steps=num_steps, **options)


@cache
def two_runs(name, system=BY_HAND):
    """To the end, with twice as many steps in the second, and the rows that are the end; one program."""
    stepper, order = STEPPERS[name]
    return ends_of_two(Problem(system, PARAMS, Q0, V0, DURATION), as_data(stepper), 100 if order > 3 else 400)


@pytest.mark.parametrize("name", each(STEPPERS, quick=["hht", "rk4"]))
def test_order(name):
    """That of the stepper for masses which do not depend on the time."""
    order, exact, runs = STEPPERS[name][1], by_scipy(), two_runs(name)
    errors = [np.abs(np.concatenate([x.q[k], x.v[k]]) - exact).max() for x, k in runs]
    runs[-1][0].check()
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.25)
    assert errors[1] < {1: 5e-2, 2: 1e-3, 3: 1e-5, 4: 1e-6, 5: 1e-8}[order]


def test_a_spring_that_carries_more_and_more():
    """What M at t = 0 made -0.110: L = (1 + t) v^2/2 - 5 q^2; in closed form by Bessel functions."""
    from scipy.special import j0, j1, y0, y1

    def lagrangian(q, v, t, params):
        return 0.5 * (1 + t) * v**2 - 5 * q**2

    # (1 + t) q'' + q' + 10 q = 0: q = a J0(s) + b Y0(s), s = 2 sqrt(10 (1 + t))
    s0, s = 2 * np.sqrt(10.0), 2 * np.sqrt(40.0)
    a, b = np.linalg.solve([[j0(s0), y0(s0)], [j1(s0), y1(s0)]], [0.5, 0.0])
    system = System.from_lagrangian(lagrangian)
    end = hhtjax.simulate(system, hhtjax.hht(), 0.5, 0.0, dt=1e-3, num_steps=3000).q[-1]
    assert end == pytest.approx(0.3549, abs=5e-5)
    assert end == pytest.approx(a * j0(s) + b * y0(s), abs=1e-5)


@pytest.mark.slow
def test_by_hand_and_by_its_products():
    """What a Lagrangian makes moves as by hand; so does mass(q, time, params), with an inertia(q, w, t, params) in its
    place."""
    named = System(lambda q, time, params: mass(q, time - 0.0, params), force)
    by_products = System(mass, force, inertia=lambda q, w, t, params: mass(q, t, params) @ w)
    for name, system in (("hht", CRANE), ("rk4", CRANE), ("hht", named), ("hht", by_products)):
        for (found, _), (by_hand, _) in zip(two_runs(name, system), two_runs(name), strict=True):
            np.testing.assert_allclose(found.q, by_hand.q, rtol=0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(("system", "stepper"), [
    pytest.param(CRANE, hhtjax.hht(-0.1, linearize="predictor"), id="hht"),
    pytest.param(BY_HAND, hhtjax.hht(-0.1, iterations=None, tolerance=1e-13), id="newton"),
    pytest.param(BY_HAND, hhtjax.rk4(), id="rk4"),
])  # fmt: skip
def test_gradients(system, stepper):
    """In what the rope, and so the mass, depends on, and in t0."""

    def loss(arguments):
        params, t0 = arguments
        path = hhtjax.simulate(system, stepper, Q0, V0, params, dt=0.04, t0=t0, num_steps=20)
        return jnp.sum(path.q**2) + 0.3 * jnp.sum(path.v**2) + 0.1 * jnp.sum(path.acceleration**2)

    check_gradient(loss, (PARAMS, 0.2), rtol=1e-9)


@pytest.mark.slow
def test_with_error_control_and_in_a_batch():
    control = hhtjax.adaptive(1e-5, 1e-7)
    for stepper in (hhtjax.hht(), hhtjax.rowda()):
        chosen = hhtjax.simulate(BY_HAND, stepper, Q0, V0, PARAMS, dt=control, times=jnp.array([1.0, DURATION]))
        np.testing.assert_allclose(chosen.q[-1], by_scipy()[:2], rtol=0, atol=3e-5)
    both = {name: jnp.array([x, 1.1 * x]) for name, x in PARAMS.items()}
    batch = jax.vmap(lambda params: run(hhtjax.hht(), params).q[-1])(both)
    alone = run(hhtjax.hht(), {name: x[1] for name, x in both.items()}).q[-1]
    np.testing.assert_allclose(batch[1], alone, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_energy_balance_knows_of_it():
    """The work of what drives the rope; what the steps make of it is of order 2."""

    def made(dt):  # one program: the run with long steps goes on
        path = hhtjax.simulate(CRANE, hhtjax.hht(), Q0, V0, PARAMS, dt=dt, num_steps=400)
        within = np.asarray(path.t) < DURATION + dt / 2
        return np.max(np.abs(hhtjax.analysis.energy_balance(CRANE, path, PARAMS).error[within]))

    coarse, fine = made(DURATION / 200), made(DURATION / 400)
    assert fine < 5e-4
    assert np.log2(coarse / fine) == pytest.approx(2, abs=0.2)


@pytest.mark.slow
def test_impacts_take_the_mass_of_their_time():
    """A wall for the cart. It jerks the load by dangle = -cos(angle)/r dx', with the length r at that time."""
    wall = hhtjax.Event(guard=lambda q, v, t, params: 0.25 - q[0], reset=hhtjax.impact(restitution=0.5))
    path = run(hhtjax.hht(linearize="predictor"), events=[wall])
    path.check()
    t, angle, before, after = (np.asarray(x)[0] for x in (path.events.t, path.events.q[:, 1], *path.events[4:6]))
    jump, rope = after - before, float(length(t, PARAMS))
    np.testing.assert_allclose(jump, -1.5 * before[0] * np.array([1.0, -np.cos(angle) / rope]), rtol=1e-9)
    assert abs(rope - 2.0) > 0.1


@pytest.mark.slow
def test_constraint_friction_and_internal_states_pass_through():
    """What leaks from a pendulum in x, y keeps its velocity, so that nothing changes but the multiplier, with m."""

    def leaking(params, t):
        return jnp.exp(-params * t)

    def lagrangian(q, v, t, params):
        return leaking(params, t) * (0.5 * v @ v - 9.81 * q[1])

    def thrust(q, v, t, params):
        return -params * leaking(params, t) * v

    def rod(q, t, params):
        return jnp.array([jnp.sqrt(q @ q) - 2.0])

    made = System.from_lagrangian(lagrangian, thrust, constraint=rod)
    plain = System(jnp.ones(2), lambda q, v, t, params: jnp.array([0.0, -9.81]), rod)
    start, stepper = (jnp.array([1.2, -1.6]), jnp.zeros(2)), hhtjax.hht(-0.1, iterations=None, tolerance=1e-12)
    leaks, exact = (hhtjax.simulate(system, stepper, *start, 0.5, dt=0.01, num_steps=100) for system in (made, plain))
    np.testing.assert_allclose(leaks.q, exact.q, rtol=0, atol=1e-10)
    scale = leaking(0.5, exact.t)[:, None]
    np.testing.assert_allclose(leaks.multipliers, scale * exact.multipliers, rtol=1e-9)


@pytest.mark.slow
def test_momentum_in_closed_form():
    """M = 1 + t; what pushes fades, zdot = -z, and friction takes its limit: p = 1 - exp(-t) + 0.5 - 0.2 t."""
    system = System.from_lagrangian(
        lambda q, v, t, params: 0.5 * (1 + t) * v**2,
        force=lambda q, v, z, t, params: z,
        internal=lambda q, v, z, t, params: -z,
        friction=lambda q, v, z, t, params: 0.2 + 0 * q,
    )
    path = hhtjax.simulate(system, hhtjax.hht(), 0.0, 0.5, z0=1.0, dt=5e-3, num_steps=200)
    path.check()
    momentum = 1.5 - jnp.exp(-path.t) - 0.2 * path.t
    np.testing.assert_allclose((1 + path.t) * path.v, momentum, rtol=0, atol=2e-5)


@pytest.mark.slow
@needs_compiler
def test_in_c(tmp_path):
    model = hhtjax.export_c(CRANE, hhtjax.hht(), Q0, V0, PARAMS, name="crane")
    library = Library(model, tmp_path)
    state, _ = library.begin(Q0, V0, t0=0.3, dt=0.01)
    library.run(state, 100, 0.01)
    path = hhtjax.simulate(CRANE, hhtjax.hht(), Q0, V0, PARAMS, t0=0.3, dt=0.01, num_steps=100)
    np.testing.assert_allclose(np.ravel(np.array(state.q)), path.q[-1], rtol=0, atol=1e-12)


def test_other_arguments_are_refused():
    for function in (lambda q, v, params: q, lambda t, q, params: q, lambda q, t, params, more: q):
        with pytest.raises(TypeError, match=r"System: `mass` (must be|is called as|.*)mass\(q, "):
            System(function, force)
    with pytest.raises(TypeError, match=r"System: `inertia` is called as inertia\(q, w, params\)"):
        System(mass, force, inertia=lambda q, w, v, params: w)


def run_by(lagrangian, q0=1.0, v0=0.0):
    system = hhtjax.System.from_lagrangian(lagrangian)
    return hhtjax.simulate(system, hhtjax.hht(), jnp.array([q0]), jnp.array([v0]), dt=0.01, num_steps=2)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::hhtjax.FailedRunWarning")
@pytest.mark.parametrize("v0", [0.0, 0.5])
def test_energies_that_are_not_quadratic_are_named(v0):
    """Also from rest; what is quadratic in other words passes."""
    run = run_by(lambda q, v, t, p: 0.5 * v[0] ** 2 + 0.25 * v[0] ** 4 - 0.5 * q[0] ** 2, v0=v0)
    with pytest.raises(hhtjax.SimulationError, match=r"same at all velocities.*quadratic in v"):
        run.check()
    run_by(lambda q, v, t, p: 0.25 * v @ v + 0.25 * v[0] ** 2.0 + v[0] * q[0] - 0.5 * q[0] ** 2, v0=v0).check()


def test_a_lagrangian_that_is_no_scalar_is_named():
    with pytest.raises(ValueError, match=r"`lagrangian` must give a scalar, of shape \(\); received shape \(1,\)"):
        run_by(lambda q, v, t, p: 0.5 * v**2 - 0.5 * q**2)
