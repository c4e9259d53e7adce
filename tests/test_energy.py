"""Energy balance along a run: what is conserved, damped, put in by forces, by moved constraints, and by the method."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from event_problems import G, bounce
from friction_problems import free_vibration_exact
from scipy.integrate import simpson
from zoo import PROBLEMS, run

import hhtjax
from hhtjax.analysis import energy_balance
from hhtjax.scenes import belt, dry_oscillator, pendulum, top


def springs_and_weight(q, t, params):
    """V of the double pendulum, angles from the horizontal."""
    (m1, m2), (l1, l2), (k1, k2), g = params["m"], params["l"], params["k"], params["g"]
    weight = g * ((m1 + m2) * l1 * jnp.sin(q[0]) + m2 * l2 * jnp.sin(q[1]))
    return weight + k1 * q[0] ** 2 / 2 + k2 * (q[1] - q[0]) ** 2 / 2


@pytest.mark.slow
def test_the_balance_of_a_driven_and_damped_double_pendulum_closes_with_the_order_of_the_method():
    """With V and without; what is work without V is work or potential energy with it."""
    problem = PROBLEMS["forced double pendulum"]
    params = problem.params

    def torques(q, v, t):
        c1, c2 = params["c"]
        second = c2 * (v[:, 1] - v[:, 0])
        return np.stack([3 * np.sin(5 * t) - c1 * v[:, 0] + second, 2 * np.cos(3 * t) - second], axis=1)

    largest = []
    for part in (2.0, 1.0):  # one program: the run with long steps goes on
        path = run(problem._replace(duration=part * problem.duration), hhtjax.hht(-0.05), 400)
        kept = slice(None, int(400 / part) + 1)
        path = path._replace(**{name: getattr(path, name)[kept] for name in ("t", "q", "v", "acceleration")})
        found = energy_balance(problem.system, path, params, springs_and_weight)
        bare = energy_balance(problem.system, path, params)
        between = bare.work - (found.work - found.potential + found.potential[0])  # q is not quite the integral of v
        largest.append([float(jnp.max(jnp.abs(x))) for x in (found.error, bare.error, between)])
        assert np.all(bare.potential == 0)
    np.testing.assert_allclose(np.log2(np.divide(*largest)), 2, atol=0.2)
    assert max(largest[1]) < 1e-3
    power = np.sum(np.asarray(path.v) * torques(path.q, np.asarray(path.v), np.asarray(path.t)), axis=1)
    assert found.work[-1] == pytest.approx(simpson(power, x=path.t), rel=1e-6)
    M = jax.vmap(lambda q: problem.system.mass(q, params))(path.q)
    np.testing.assert_allclose(found.kinetic, np.einsum("ni,nij,nj->n", path.v, M, path.v) / 2, rtol=1e-12)


@pytest.mark.slow
def test_the_error_is_what_a_method_loses():
    """An undamped spring: all that HHT damps; with V that moves in time, the work of whoever moves it."""
    spring = hhtjax.LinearSystem(M=jnp.array([2.0]), K=jnp.array([50.0]))
    path = hhtjax.simulate(spring, hhtjax.hht(-0.3), jnp.ones(1), jnp.zeros(1), dt=0.02, num_steps=200)
    found = energy_balance(spring, path, potential=lambda q, t, params: 25 * jnp.sum(q**2))
    np.testing.assert_allclose(found.error, (path.v**2 + 25 * path.q**2)[:, 0] - 25, atol=1e-12)
    assert found.error[-1] < -0.02
    np.testing.assert_allclose(found.work, 0, atol=1e-12)

    moved = hhtjax.System(jnp.ones(1), lambda q, v, t, params: 9 * (jnp.sin(t) - q))
    path = hhtjax.simulate(moved, hhtjax.rk4(), jnp.zeros(1), jnp.zeros(1), dt=0.02, num_steps=100)
    found = energy_balance(moved, path, potential=lambda q, t, params: 4.5 * jnp.sum((q - jnp.sin(t)) ** 2))
    assert found.work[-1] > 0.1
    assert np.max(np.abs(found.error)) < 1e-6


@pytest.mark.slow
def test_a_rod_that_is_pulled_in_works():
    fixed = pendulum.cartesian()
    pulled = hhtjax.System(
        fixed.system.mass,
        fixed.system.force,
        lambda q, t, params: jnp.array([jnp.sqrt(jnp.sum(q**2)) - params["l"] * (1 - 0.3 * t)]),
    )

    def height(q, t, params):
        return params["m"] * params["g"] * q[1]

    v0 = fixed.v0 + jnp.array([0.0, 0.3 * 0.5])
    path = hhtjax.simulate(pulled, hhtjax.hht(0.0), fixed.q0, v0, fixed.params, dt=5e-3, num_steps=200)
    found = energy_balance(pulled, path, fixed.params, height)
    tension = -path.multipliers[:, 0]
    assert found.work[-1] == pytest.approx(simpson(tension * 0.3 * 0.5, x=path.t), rel=1e-4)
    assert found.work[-1] > 1
    assert np.max(np.abs(found.error)) < 5e-3


@pytest.mark.slow
def test_a_top_keeps_its_energy():
    scene = top.minimal(spin=20.0)

    def height(R, t, params):
        return params["m"] * params["g"] * params["l"] * R[2, 1]

    stepper = hhtjax.hht(0.0, linearize="predictor")
    path = hhtjax.simulate(scene.system, stepper, scene.q0, scene.v0, scene.params, dt=1e-3, num_steps=200)
    found = energy_balance(scene.system, path, scene.params, height)
    assert np.ptp(found.potential) > 1
    np.testing.assert_allclose(found.work, 0, atol=1e-6)
    assert np.max(np.abs(found.error)) < 1e-3 * found.kinetic[0]


def dry_balances(scene, numbers, potential=None):
    """Runs and their balances, of which the last has most steps."""
    for n in numbers:  # one program: runs with longer steps go on
        path = hhtjax.simulate(
            scene.system, hhtjax.hht(), scene.q0, scene.v0, scene.params, dt=scene.duration / n, num_steps=numbers[-1]
        )
        found, kept = energy_balance(scene.system, path, scene.params, potential), slice(n + 1)
        path = path._replace(**{name: getattr(path, name)[kept] for name in ("t", "q", "v", "sticking")})
        yield path, jax.tree.map(lambda x, kept=kept: x[kept], found)


@pytest.mark.slow
def test_dry_friction_takes_what_a_spring_loses_at_each_reversal():
    """In closed form: F times the way; nothing once it sticks; of order 2."""
    scene, errors = dry_oscillator.free(), []
    for path, found in dry_balances(scene, (400, 3200), lambda q, t, params: params["k"] * jnp.sum(q**2) / 2):
        q, v = free_vibration_exact(np.asarray(path.t))
        exact = (v**2 + 100 * (q**2 - 0.25)) / 2
        errors.append([np.max(np.abs(found.work - exact)), np.max(np.abs(found.error))])
        stuck = np.asarray(path.sticking[:, 0])
        assert np.sum(stuck) > 50
        np.testing.assert_allclose(np.asarray(found.work)[stuck], found.work[-1], rtol=1e-14)
    np.testing.assert_allclose(np.log2(np.divide(*errors)) / 3, 2, atol=0.15)
    assert found.work[-1] == pytest.approx(-12.48, rel=1e-5)


@pytest.mark.slow
def test_a_belt_drives_what_sticks_to_it():
    """Friction jumps where a mass gets caught by the belt, which moves on: the jump is found inside the interval."""
    (_, coarse), (path, fine) = dry_balances(belt.two_masses(), (6400, 25600))
    assert np.ptp(np.asarray(path.sticking, int), axis=0).all()
    order = np.log2(np.max(np.abs(coarse.error)) / np.max(np.abs(fine.error))) / 2
    assert order > 1.85
    assert np.max(np.abs(coarse.error)) < 1e-4 * np.max(fine.kinetic)


@pytest.mark.slow
def test_an_impact_takes_what_it_leaves_out_of_the_velocity():
    """A ball that drags and rubs, twice on the floor: only what the method makes is error, of its order."""
    ball = hhtjax.System(
        jnp.ones(1),
        lambda q, v, t, p: -G - 0.3 * v,
        friction=lambda q, v, t, p: jnp.array([0.5]),
        sliding=lambda q, v, t, p: v,
    )
    # one program: the run with long steps goes on, without a floor
    events = [hhtjax.Event(lambda q, v, t, p: q[0] + jnp.where(t > 1.501, 1e3, 0.0), hhtjax.impact(0.8))]
    end = bounce(
        lambda t, y: [y[1], -G - 0.3 * y[1] - 0.5 * np.sign(y[1])],
        [1.0, 0.0], 1.5, lambda y: y[0], lambda y: [0, -0.8 * y[1]],
    )  # fmt: skip

    def potential(q, t, p):
        return G * q[0]

    errors = []
    for n in (100, 400):
        path = hhtjax.simulate(
            ball, hhtjax.hht(), jnp.ones(1), jnp.zeros(1), dt=1.5 / n, num_steps=400, save_every=2, events=events
        )
        found = energy_balance(ball, path, potential=potential)
        np.testing.assert_array_equal(found.t, path.t)
        error, work = found.error[: n // 2 + 1], found.work[n // 2]
        errors.append([np.max(np.abs(error)), abs(work - (end[1] ** 2 / 2 + G * (end[0] - 1)))])
        assert int(path.events.count) == 2
    assert np.all(np.array(errors) < [[1e-2], [1e-3]]), errors
    slope = jax.grad(lambda v: energy_balance(ball, path._replace(v=v), potential=potential).work[-1])(path.v)
    assert np.all(np.isfinite(slope))


SPRING = hhtjax.System(jnp.ones(1), lambda q, v, t, params: -q)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda path: energy_balance(hhtjax.FirstOrderSystem(lambda y, t, p: -y), path), TypeError, "`system` must be"),
        (lambda path: energy_balance(SPRING, path.q), ValueError, "`solution` must be of one run"),
        (lambda path: energy_balance(SPRING, path, potential=1.0), TypeError, "`potential` must be a function"),
    ],
)
def test_bad_input(call, error, message):
    path = hhtjax.simulate(SPRING, hhtjax.rk4(), jnp.ones(1), jnp.ones(1), dt=0.1, num_steps=2)
    with pytest.raises(error, match=f"energy_balance: {message}"):
        call(path)
