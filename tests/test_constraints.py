"""Constraints: orders, drift, multipliers, the squeezer, consistent starts, gradients, and what bad input gets."""

import json
from functools import cache, partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import check_gradient
from scipy.integrate import solve_ivp

import hhtjax
from hhtjax.scenes import Scene, four_bars, squeezer
from hhtjax.systems.constraints import acceleration_and_multipliers, violation
from hhtjax.systems.flat_system import flatten

SQUEEZER = json.loads((Path(__file__).parent / "data" / "squeezer.json").read_text())
# arrays all, so that runs with others in their place share a compilation
PARAMS = {"m": jnp.array([2.0, 1.0]), **{name: jnp.array(x) for name, x in (("l", 0.8), ("k", 30.0), ("c", 0.4))}}
Q0 = jnp.array([0.0, np.arcsin((0.1 - 0.2 * 0.3**2) / 0.8), 0.3])
GUESS = jnp.array([0.0, 0.5, -0.4])
DURATION = 1.0
HHT = hhtjax.hht(-0.1)
FORMS = [("index3", 1), ("index3", None), ("ggl", 1), ("ggl", None)]


def mass(q, params):
    """A cart, a pendulum on it, and a wheel whose inertia depends on its angle."""
    (m1, m2), length = params["m"], params["l"]
    coupling, wheel = m2 * length * jnp.cos(q[1]), 0.5 * (1 + 0.3 * jnp.sin(q[2]) ** 2)
    return jnp.array([[m1 + m2, coupling, 0.0], [coupling, m2 * length**2, 0.0], [0.0, 0.0, wheel]])


def force(q, v, t, params):
    m2, length = params["m"][1], params["l"]
    cart = m2 * length * jnp.sin(q[1]) * v[1] ** 2 - params["k"] * q[0] - params["c"] * v[0] + 2 * jnp.sin(4 * t)
    pendulum = -m2 * 9.81 * length * jnp.sin(q[1]) - 0.1 * v[1]
    wheel = -5 * q[2] - 0.15 * jnp.sin(q[2]) * jnp.cos(q[2]) * v[2] ** 2 + jnp.cos(t)
    return jnp.array([cart, pendulum, wheel])


def constraint(q, t, params):
    """The tip of the pendulum follows a given motion, which the wheel shifts."""
    return jnp.array([q[0] + params["l"] * jnp.sin(q[1]) + 0.2 * q[2] ** 2 - 0.3 * jnp.sin(2 * t) - 0.1])


SLIDER = hhtjax.System(mass, force, constraint)


@cache
def start():
    return hhtjax.consistent_initial(SLIDER, Q0, GUESS, PARAMS)


@cache
def reference():
    """(q, v, L, w) at the end, by SciPy on the index-1 system."""
    flat, _, _ = flatten("test", SLIDER, Q0, GUESS, 0.0, PARAMS)

    @jax.jit
    def solve(t, y):
        return acceleration_and_multipliers(flat, y[:3], y[3:], jnp.asarray(t), PARAMS)

    def rate(t, y):
        return np.concatenate([y[3:], solve(t, y)[0]])

    y0 = np.concatenate([start().q, start().v])
    y = solve_ivp(rate, (0.0, DURATION), y0, "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    w, L = solve(DURATION, y)
    return y[:3], y[3:], np.asarray(L), np.asarray(w)


def run(system=SLIDER, q0=None, stiffness=PARAMS["k"], stepper=HHT):
    """20 steps, compiled once for all stiffnesses."""
    begin = start()
    q0, params = begin.q if q0 is None else q0, PARAMS | {"k": stiffness}
    return hhtjax.simulate(system, stepper, q0, begin.v, params, dt=0.01, num_steps=20)


@partial(jax.jit, static_argnames=("formulation", "iterations"))
def end(scene, alpha, num_steps, formulation, iterations):
    """State at the end, and the largest violations; alpha and num_steps traced, so that each form compiles once."""
    stepper = hhtjax.hht(alpha, formulation=formulation, iterations=iterations, tolerance=1e-12)
    system, params, q0, v0, duration = scene
    dt = duration / num_steps

    def step(i, carry):
        state, *worst = carry
        state, info = stepper.step(system, state, params, dt)
        return state, jnp.maximum(worst[0], info.constraint), jnp.maximum(worst[1], info.constraint_rate)

    begin = stepper.init(system, q0, v0, params, dt)
    return jax.lax.fori_loop(0, num_steps, step, (begin, 0.0, 0.0))


@pytest.mark.slow
@pytest.mark.parametrize(("formulation", "iterations"), FORMS)
def test_order_and_drift(formulation, iterations):
    """Order 2 in q, v, L and w; of the drift 5 in Phi without iterations, 4 in dPhi/dt with GGL, 2 without."""
    scene = Scene(SLIDER, PARAMS, start().q, start().v, DURATION)
    for alpha in (0.0, -0.1, -0.3):
        (coarse, *drift), (fine, *less) = (end(scene, alpha, n, formulation, iterations) for n in (100, 200))
        errors = [
            [np.abs(x - y).max() for x, y in zip((s.q, s.v, s.L, s.w), reference(), strict=True)]
            for s in (coarse, fine)
        ]
        slopes = np.log2(np.array(errors[0]) / np.array(errors[1]))
        np.testing.assert_allclose(slopes[:2], 2, atol=0.15)
        if (formulation, alpha) == ("index3", 0.0):  # the trapezoidal rule: an undamped oscillation of L and w
            assert errors[1][2] > 0.1
            continue
        np.testing.assert_allclose(slopes[2:], 2, atol=0.15)
        if iterations is None:
            assert drift[0] < 1e-14
        else:
            assert np.log2(drift[0] / less[0]) > 4.7
        if formulation == "index3":
            assert np.log2(drift[1] / less[1]) == pytest.approx(2, abs=0.15)
        elif iterations == 1:
            assert np.log2(drift[1] / less[1]) > 4


BARS = {2e-4: 6e-2, 1e-4: 1.2e-2, 5e-5: 2.6e-3, 1e-5: 1e-4}  # step size: max |q error|


@pytest.mark.slow
def test_squeezer_without_iterations():
    """t = 0.03 s, alpha = -0.1, GGL: below the errors that theory.md, section 5, has for the converged method."""
    scene, exact = squeezer.squeezer(), SQUEEZER["states"][-1]
    assert exact["t"] == pytest.approx(scene.duration)
    for h, bar in BARS.items():
        state, _, _ = end(scene, -0.1, round(scene.duration / h), "ggl", 1)
        assert np.abs(state.q - np.array(exact["q"])).max() <= bar


@pytest.mark.slow
@pytest.mark.parametrize("formulation", ["index3", "ggl"])
@pytest.mark.compiled
def test_multipliers_of_a_pendulum(formulation):
    """In the unit of force, for a Phi in units of length: minus the tension m (g cos + v^2/l)."""
    length = 0.5
    system = hhtjax.System(
        jnp.ones(2),
        lambda q, v, t, params: jnp.array([0.0, -9.81]),
        lambda q, t, params: jnp.array([jnp.sqrt(jnp.sum(q**2)) - length]),
    )
    stepper = hhtjax.hht(-0.1, formulation=formulation)
    path = hhtjax.simulate(system, stepper, jnp.array([0.0, -length]), jnp.array([2.505, 0.0]), dt=1e-4, num_steps=2000)
    path.check()
    tension = -9.81 * path.q[:, 1] / length + jnp.sum(path.v**2, axis=1) / length
    np.testing.assert_allclose(path.multipliers[:, 0], -tension, rtol=1e-4)
    energy = 0.5 * jnp.sum(path.v**2, axis=1) + 9.81 * path.q[:, 1]
    np.testing.assert_allclose(energy, energy[0], atol=1e-5)


@pytest.mark.slow
def test_a_linear_solve_of_the_users_own():
    def by_numpy(A, b):
        return jnp.linalg.solve(A, b)

    theirs = run(stepper=hhtjax.hht(-0.1, solve=by_numpy))
    np.testing.assert_allclose(run().q, theirs.q, rtol=1e-11, atol=1e-13)


@pytest.mark.slow
def test_redundant_constraints_by_least_squares():
    """The same constraint twice: half of the multiplier each, and the same motion."""

    def twice(q, t, params):
        return jnp.tile(constraint(q, t, params), 2)

    system = hhtjax.System(mass, force, twice)
    with pytest.raises(ValueError, match=r"simulate: `constraint` rows \[0, 1\] depend on each other .*rank 1 of 2"):
        run(system)
    begin = hhtjax.consistent_initial(system, Q0, GUESS, PARAMS, redundant="least_squares")
    np.testing.assert_allclose(begin.q, start().q, atol=1e-13)
    np.testing.assert_allclose(begin.multipliers, start().multipliers[0] / 2, rtol=1e-10)
    path, single = run(system, stepper=hhtjax.hht(-0.1, redundant="least_squares")), run()
    path.check()
    np.testing.assert_allclose(path.q, single.q, atol=1e-9)
    np.testing.assert_allclose(path.multipliers.sum(axis=1), single.multipliers[:, 0], rtol=1e-6)


@pytest.mark.slow
def test_a_singular_position_on_the_way_is_named():
    """Rows that are parallel at t = 1: the run names the step to there or from there, as rounding has it, and the row;
    least squares goes on."""

    def crossing(q, t, params):
        return jnp.array([q[0] - t, q[1] * (q[0] - 1) + q[0] - t])

    system = hhtjax.System(jnp.ones(3), lambda q, v, t, params: jnp.array([0.0, 0.0, -9.81]), crossing)
    q0, v0 = jnp.zeros(3), jnp.array([1.0, 0.0, 0.0])
    for stepper in (hhtjax.hht(), hhtjax.hht(redundant="least_squares")):
        run = hhtjax.simulate(system, stepper, q0, v0, dt=0.125, num_steps=12, save_every=6)
        if stepper.redundant:
            run.check()
            np.testing.assert_allclose(run.q[-1], [1.5, 0, -9.81 * 1.5**2 / 2], atol=1e-9)
        else:
            with pytest.raises(hhtjax.SimulationError, match=r"step [89] .*failed: row 1 of the constraint depends on"):
                run.check()


@pytest.mark.slow
def test_four_bars_through_their_singular_position():
    """Twice per turn the rank falls from 5 to 3: least squares keeps to the exact motion of one angle."""
    scene = four_bars.four_bars(loops=2)
    stepper = hhtjax.hht(-0.1, redundant="least_squares")
    run = hhtjax.simulate(*[scene.system, stepper, *scene[2:4], scene.params], dt=2e-3, num_steps=500, save_every=25)
    run.check()
    rate = -(1.5 + 2) * 9.81 / (1 + 2)
    exact = solve_ivp(
        lambda t, y: [y[1], rate * np.cos(y[0])], (0, 1.0), [np.pi / 2, -1.0], "DOP853", run.t, rtol=1e-12
    )
    angle = np.unwrap(np.arctan2(run.q[:, 0, 1], run.q[:, 0, 0]))
    assert angle[-1] < -1.0  # it has fallen through
    np.testing.assert_allclose(angle, exact.y[0], atol=2e-3)


def test_consistent_initial_is_nearest_and_consistent():
    far, t = np.asarray(Q0) + 0.05, jnp.asarray(0.2)

    @jax.jit
    def project():
        off = hhtjax.consistent_initial(SLIDER, far, GUESS, PARAMS, t0=t)
        flat, q, v = flatten("test", SLIDER, off.q, off.v, t, PARAMS)
        B = jax.jacfwd(lambda q: constraint(q, t, PARAMS))(q)[0]
        reactionary = mass(far, PARAMS) @ (q - far), mass(q, PARAMS) @ (v - GUESS)
        wL = acceleration_and_multipliers(flat, q, v, t, PARAMS)
        return off, B, reactionary, violation(flat, q, v, t, PARAMS), wL

    off, B, reactionary, left, (w, L) = jax.device_get(project())
    assert off.converged
    np.testing.assert_allclose(left, 0, atol=1e-13)
    for x in reactionary:  # parallel to B^T: no direction along the constraint is left
        np.testing.assert_allclose(x, B * (x @ B) / (B @ B), atol=1e-10)
    np.testing.assert_allclose(off.acceleration, w, rtol=1e-12)
    np.testing.assert_allclose(off.multipliers, L, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(("formulation", "iterations"), [("ggl", 1), ("index3", None)])
def test_gradients(formulation, iterations):
    """Of a loss of the whole path, once through the projection of the start: stiffness, damping, length, v0 and dt."""

    consistent = start()

    def loss(arguments):
        k, c, length, v0, dt = arguments
        params = PARAMS | {"k": k, "c": c, "l": length}
        begin = hhtjax.consistent_initial(SLIDER, Q0, v0, params) if formulation == "ggl" else consistent
        stepper = hhtjax.hht(-0.1, formulation=formulation, iterations=iterations, tolerance=1e-13)
        path = hhtjax.simulate(SLIDER, stepper, begin.q, begin.v, params, dt=dt, num_steps=12)
        return jnp.sum(path.q**2) + 0.1 * jnp.sum(path.v**2) + 1e-3 * jnp.sum(path.multipliers**2)

    check_gradient(loss, (30.0, 0.4, 0.8, GUESS if formulation == "ggl" else None, 0.02))


@pytest.mark.slow
def test_batches_equal_loops_and_pytrees_equal_vectors():
    flat = run()  # `start` is known from here on: within jit, its cache would keep tracers

    def end(k):
        path = run(stiffness=k)
        return path.q[-1], path.multipliers[-1]

    stiffness = jnp.array([10.0, 30.0])
    batch = jax.jit(jax.vmap(end))(stiffness)
    for i, k in enumerate(stiffness):
        for x, y in zip(batch, end(k), strict=True):
            np.testing.assert_allclose(x[i], y, rtol=1e-11)

    def vector(tree):
        return jnp.append(tree["cart"], tree["swing"])

    def tree_of(x):
        return {"cart": x[0], "swing": x[1:]}

    system = hhtjax.System(
        lambda q, params: mass(vector(q), params),
        lambda q, v, t, params: tree_of(force(vector(q), vector(v), t, params)),
        lambda q, t, params: constraint(vector(q), t, params),
    )
    q0, v0 = tree_of(start().q), tree_of(start().v)
    tree = hhtjax.simulate(system, hhtjax.hht(-0.1), q0, v0, PARAMS, dt=0.01, num_steps=20)
    np.testing.assert_allclose(tree.q["swing"], flat.q[:, 1:], rtol=1e-12)
    np.testing.assert_allclose(tree.multipliers, flat.multipliers, rtol=1e-12)
