"""Dry friction: orders, rest, derivatives, one factorisation, batches, dtypes."""

import warnings
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from friction_problems import arm, free_vibration_exact, of_scene
from helpers import check_gradient
from zoo import everywhere

import hhtjax
from hhtjax.scenes import belt, dry_oscillator
from hhtjax.steppers.residual import Coefficients

FAMILY = [*map(hhtjax.hht, (0.0, -0.05, -0.3)), *map(hhtjax.generalized_alpha, (0.0, 0.5, 1.0))]
COLUMNS = zip(*(s.coefficients for s in FAMILY), strict=True)
STACKED = replace(FAMILY[0], coefficients=Coefficients(*map(jnp.array, COLUMNS)))
NUM_STEPS = 400, 1600


def run(case, stepper, num_steps, save_every=1):
    system, params, q0, v0, duration, *_ = case
    dt = duration / num_steps
    return hhtjax.simulate(system, stepper, q0, v0, params, dt=dt, num_steps=num_steps, save_every=save_every)


@pytest.fixture(scope="module")
def family():
    """The free vibration by each of FAMILY, with each of NUM_STEPS in its duration: one program, so that the run with
    long steps goes on."""
    case, most = of_scene(dry_oscillator.free()), NUM_STEPS[-1]

    @jax.jit
    @partial(jax.vmap, in_axes=(0, None))
    def by(stepper, duration):
        return run(case._replace(duration=duration), stepper, most)

    return [by(STACKED, most / n * case.duration) for n in NUM_STEPS]


@pytest.mark.slow
def test_order_two_through_reversals(family):
    errors = []
    for found, n in zip(family, NUM_STEPS, strict=True):
        t, *found = (np.asarray(x)[:, : n + 1] for x in (found.t, found.q, found.v))
        exact = free_vibration_exact(t[0])
        errors.append([np.max(np.abs(x[..., 0] - y), axis=1) for x, y in zip(found, exact, strict=True)])
    order = np.log(np.divide(*errors)) / np.log(NUM_STEPS[1] / NUM_STEPS[0])
    assert np.all(np.abs(order - 2) < 0.1), order


@pytest.mark.slow
def test_extrapolation_takes_the_leading_error_out():
    """That of the switches too; dt^3 is left. Forces, which jump, are those of the finer run."""
    scene = dry_oscillator.free()
    arguments = scene.system, hhtjax.hht(), scene.q0, scene.v0, scene.params
    fine, better = (
        hhtjax.simulate(*arguments, dt=2.2 / n, num_steps=n, save_every=n // 50, extrapolate=k)
        for n, k in ((800, 1), (400, 2))
    )
    exact = free_vibration_exact(np.asarray(better.t))
    for name, x in zip("qv", exact, strict=True):
        fine_error, error = (np.max(np.abs(getattr(run, name)[:, 0] - x)) for run in (fine, better))
        assert error < fine_error / 20
    np.testing.assert_array_equal(better.friction, fine.friction)
    np.testing.assert_array_equal(better.sticking, fine.sticking)


@pytest.mark.slow
def test_what_stopped_stays(family):
    """Exactly: no creep, and no acceleration that alternates, also for alpha = 0."""
    for found in family:
        stuck = np.asarray(found.sticking[..., 0])
        assert np.all(stuck[:, -1] & (np.sum(stuck, axis=1) > 0.1 * stuck.shape[1]))
        for member, here in enumerate(stuck):
            q, tau = found.q[member, here, 0], found.friction[member, here, 0]
            assert np.ptp(q) == 0
            np.testing.assert_array_equal(found.v[member, here], 0)
            np.testing.assert_array_equal(found.acceleration[member, here], 0)
            np.testing.assert_allclose(tau[1:], -100 * q[1:], rtol=1e-12)


@pytest.mark.slow
def test_a_load_below_the_limit_moves_nothing():
    """For 10 s, however long the steps; tanh(v/vt) would creep."""
    system = hhtjax.System(jnp.ones(1), lambda q, v, t, F: 0.9 * F + 0 * q, friction=lambda q, v, t, F: F + 0 * q)
    for h in (0.01, 1.0):
        found = hhtjax.simulate(system, hhtjax.hht(0.0), jnp.zeros(1), jnp.zeros(1), 2.0, dt=h, num_steps=round(10 / h))
        assert not np.any(found.q)
        np.testing.assert_allclose(found.friction, 1.8, rtol=1e-14)
        assert found.sticking.all()


@pytest.mark.slow
def test_stuck_joints_of_a_mechanism_stay_to_the_order_of_the_step():
    """The relative velocity of two links, with M(q), is 0 to rounding while they stick, the angle exactly constant."""
    found = run(arm(), hhtjax.hht(0.0), 2000)
    found.check()
    stuck = np.asarray(found.sticking)
    for joint in range(2):
        here = stuck[1:, joint] & stuck[:-1, joint]
        assert here.sum() > 50 or joint
        np.testing.assert_array_equal(np.diff(found.q[:, joint])[here], 0)
        assert np.max(np.abs(np.asarray(found.v)[stuck[:, joint], joint]), initial=0) < 1e-16
        assert np.max(np.abs(np.asarray(found.acceleration)[stuck[:, joint], joint]), initial=0) < 1e-13


def sleigh():
    """On a knife edge, a behind its centre."""

    def lateral(q, v, t, params):
        return -jnp.sin(q[2:]) * v[0] + jnp.cos(q[2:]) * v[1] - 0.2 * v[2]

    mass, limit = jnp.array([1.0, 1.0, 0.06]), lambda q, v, t, params: 1e3 + 0 * q[:1]
    return hhtjax.System(mass, lambda q, v, t, p: 0 * q, friction=limit, sliding=lateral)


SLEIGH = sleigh()


def sledge(speed, dt=1e-2):
    """A run with this lateral velocity, 0.4 to stick, and how far its forward velocity is from one whose limit is never
    reached (Chaplygin): u = U tanh(a U t/I + c)."""
    start = jnp.zeros(3), jnp.array([1.0, speed, 2.0])
    found = hhtjax.simulate(SLEIGH, hhtjax.hht(), *start, dt=dt, num_steps=100)
    found.check()
    forward = jnp.cos(found.q[:, 2]) * found.v[:, 0] + jnp.sin(found.q[:, 2]) * found.v[:, 1]
    U = np.sqrt(1.4)
    return found, np.abs(forward - U * np.tanh(2 * U * np.asarray(found.t) + np.arctanh(1 / U)))


@pytest.mark.slow
def test_a_start_that_slides_by_a_rounding_sticks():
    """With one of the numbers beside it."""
    for speed in (0.4, np.nextafter(0.4, 1), np.nextafter(0.4, 0)):
        found, error = sledge(speed)
        assert found.sticking.all()
        assert np.max(error) < 2e-4
        assert np.max(np.abs(found.friction)) == pytest.approx(1.2, rel=1e-12)  # u w J/I, the largest at the start


def test_a_joint_that_stops_at_once_is_not_thrown_by_its_limit():
    """A thousand times the load, it acts for some nanoseconds, and would turn the sleigh by 1 rad in a step."""
    for speed in (0.4 + 1e-9, 0.4 - 1e-9):
        error = [np.max(sledge(speed, dt)[1][: n + 1]) for dt, n in ((1e-2, 50), (5e-3, 100))]
        assert error[0] < 0.15
        assert np.log2(error[0] / error[1]) == pytest.approx(2, abs=0.15)


@pytest.mark.slow
def test_without_limit_it_is_the_step_without_friction():
    case = of_scene(dry_oscillator.driven(0.0))
    smooth = replace(case.system, friction=None)
    params = {**case.params, "F": 0.0}
    found, expected = (run(case._replace(system=x, params=params), hhtjax.hht(), 200) for x in (case.system, smooth))
    for x, y in ((found.q, expected.q), (found.v, expected.v), (found.acceleration, expected.acceleration)):
        np.testing.assert_allclose(x, y, rtol=0, atol=1e-14)


def chain(n, **more):
    """n masses between springs, of which the first two rub."""
    return hhtjax.System(
        mass=jnp.ones(n),
        force=lambda q, v, t, p: -(q**3) - q + jnp.sin(t),
        friction=lambda q, v, *_: 0.1 * jnp.ones(2),
        sliding=lambda q, v, t, p: v[:2],
        **more,
    )


@pytest.mark.slow
def test_one_factorisation_per_step():
    """Of the step's matrix, whatever switches; with constraints too."""
    n, zero = 20, jnp.zeros(20)
    held = chain(n, constraint=lambda q, t, p: q[-1:])
    for system, L in ((chain(n), None), (held, jnp.zeros(1))):
        state = jax.eval_shape(lambda x=system: hhtjax.hht().init(x, zero, zero, None, 0.01))
        trace = jax.make_jaxpr(lambda s, x=system: hhtjax.hht().step(x, s, None, 0.01))(state)
        assert (state.L is None) == (L is None)
        assert sum(eqn.primitive.name == "lu" for eqn in everywhere(trace.jaxpr)) == 1


NAMES, SHORT = ("k", "c", "F", "m"), 1e-6  # of differences, so short that no switch leaves its step between
FEW = 32  # steps, as many as are not checkpointed


def last(found):
    """A number of the end of a run in which the first joint sticks and the last reverses, and no number of another."""
    switched = jnp.any(found.sticking[:, 0]) & (jnp.ptp(jnp.sign(found.friction[:, -1])) == 2)
    return jnp.where(switched, found.q[-1] @ jnp.arange(1.0, 1 + found.q.shape[1]), jnp.nan)


@pytest.mark.slow
def test_derivatives_are_those_of_the_exact_motion():
    """Forward = reverse = central differences; and those of steps 16 times shorter."""
    case = of_scene(dry_oscillator.driven())._replace(duration=6.0)

    def path(values, dts):
        params = {**case.params, **dict(zip(NAMES, values, strict=True))}
        options = {"dts": dts, "duration": case.duration, "num_samples": 40}
        return hhtjax.sweep(case.system, hhtjax.hht(), case.q0, case.v0, params, **options).q[..., 0]

    values = jnp.array([case.params[name] for name in NAMES])
    dts = jnp.array([case.duration / 3200, case.duration / 51200])
    coarse, fine = jax.jit(jax.jacfwd(path))(values, dts)
    away = np.max(np.abs(coarse - fine), axis=0) / np.max(np.abs(fine), axis=0)
    assert dict(zip(NAMES, away < 0.02, strict=True)) == dict.fromkeys(NAMES, True), away

    def end(params):
        return last(run(case._replace(params={**case.params, **params}, duration=3.2), hhtjax.hht(), FEW))

    check_gradient(end, {name: case.params[name] for name in NAMES}, step=SHORT)


@pytest.mark.slow
def test_derivatives_through_coupled_switches():
    """Of two joints: the times of the events within a step are differentiated, their order is not."""
    case = arm()._replace(duration=2.0)

    def end(start):
        return last(run(case._replace(params={"F": start[0]}, q0=start[1]), hhtjax.hht(), FEW))

    check_gradient(end, (2.5, case.q0), step=SHORT)


@pytest.mark.slow
def test_the_plain_program_gives_the_same():
    case = of_scene(belt.two_masses())._replace(duration=0.5)
    fast = run(case, hhtjax.hht(), 100)
    with hhtjax.plain():
        np.testing.assert_allclose(run(case, hhtjax.hht(), 100).q, fast.q, atol=1e-13)


@pytest.mark.slow
def test_batches_dtypes_and_single_steps():
    case = of_scene(dry_oscillator.driven())._replace(duration=1.0)

    def with_limit(F):
        return run(case._replace(params={**case.params, "F": F}), hhtjax.hht(), 100)

    single, batch = with_limit(3.0), jax.vmap(with_limit)(jnp.array([1.0, 3.0, 7.0]))
    np.testing.assert_allclose(batch.q[1], single.q, atol=1e-13)
    assert batch.sticking.all(axis=(1, 2)).tolist() == [False, False, True]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", hhtjax.PrecisionWarning)
        rough = run(case._replace(q0=jnp.zeros(1, jnp.float32), v0=jnp.zeros(1, jnp.float32)), hhtjax.hht(), 100)
    rough.check()
    assert {x.dtype for x in (rough.q, rough.friction)} == {np.dtype("float32")}
    np.testing.assert_allclose(rough.q, single.q, atol=2e-5)
    arguments = case.system, case.q0, case.v0, case.params, 0.01
    state = hhtjax.hht().init(*arguments)
    step = jax.jit(lambda s: hhtjax.hht().step(case.system, s, case.params, 0.01)[0])
    for i in range(1, 4):
        state = step(state)
        np.testing.assert_allclose(state.friction.tau, single.friction[i], rtol=1e-12)


@pytest.mark.slow
def test_newton_in_the_free_step():
    """Which is linear here: one solve or many."""
    case = of_scene(dry_oscillator.driven(0.0))._replace(duration=5.0)
    once, converged = (run(case, hhtjax.hht(iterations=k), 250) for k in (1, None))
    converged.check()
    np.testing.assert_allclose(once.q, converged.q, atol=1e-10)


@pytest.mark.slow
def test_joints_in_a_row():
    """They stick and slip one on the other; the switch of one jerks its neighbours within the step."""
    n, rates = 3, 1 + 0.3 * jnp.arange(3.0)
    row = hhtjax.System(
        jnp.ones(n),
        lambda q, v, t, p: 3.0 * jnp.sin(rates * t) - q,
        friction=lambda q, v, t, p: 0.5 * jnp.ones(n),
        sliding=lambda q, v, t, p: jnp.diff(v, prepend=0.0),
    )
    zero, steps = jnp.zeros(n), np.array([250, 2000, 16000])
    found = hhtjax.sweep(row, hhtjax.hht(), zero, zero, dts=5 / steps, duration=5.0, num_samples=10)
    found.check()
    assert not np.any(found.info.friction)
    errors = [np.max(np.abs(found.q[i] - found.q[-1])) for i in range(2)]
    assert errors[0] < 1.5e-3
    assert np.log(errors[0] / errors[1]) / np.log(steps[1] / steps[0]) > 1.85
    assert 0.02 < np.mean(found.sticking[-1]) < 0.9
