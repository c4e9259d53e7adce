"""Dry friction: bad input, refusals, held inputs, sweeps, dense output, and what shows itself."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hhtjax
from hhtjax.scenes import dry_oscillator

ONE, TWO, ZERO = jnp.ones(1), jnp.ones(2), jnp.zeros(1)
SCENE = dry_oscillator.driven()


def force(q, v, t, params):
    return -q


def limit(q, v, t, params):
    return 0.1 + 0 * q


def two(sliding=None, friction=limit):
    return hhtjax.System(TWO, force, friction=friction, sliding=sliding)


def simulate(system, stepper=hhtjax.hht(), q0=TWO, **options):  # noqa: B008 (frozen)
    return hhtjax.simulate(system, stepper, q0, 0 * q0, dt=0.1, num_steps=2, **options)


@pytest.mark.parametrize(
    ("error", "message", "call"),
    [
        (TypeError, "System: `friction` must be a function", lambda: two(friction=1.0)),
        (TypeError, r"friction\(q, v, t, params\)", lambda: two(friction=lambda q, v, params: q)),
        (TypeError, r"sliding\(q, v, t, params\)", lambda: two(sliding=lambda v: v)),
        (ValueError, "`sliding` must go with `friction`", lambda: hhtjax.System(ONE, force, sliding=limit)),
        (ValueError, "`friction` must return a pytree like v0", lambda: simulate(two(friction=lambda *_: 0.1))),
        (ValueError, r"`friction` must return \(1,\)", lambda: simulate(two(lambda q, v, t, p: v[:1]))),
        (ValueError, "`sliding` must return an array", lambda: simulate(two(lambda q, v, t, p: v[0]))),
        (ValueError, "row 0 of `sliding` does not depend on v", lambda: simulate(two(lambda q, v, t, p: v * (q - 1)))),
        (ValueError, "leave `linearize` out", lambda: simulate(two(), hhtjax.hht(linearize="held"))),
        (NotImplementedError, "RK4 cannot solve dry `friction`; use hht", lambda: simulate(two(), hhtjax.rk4())),
        (NotImplementedError, "rowda cannot solve dry", lambda: simulate(two(), hhtjax.rowda())),
        (NotImplementedError, "ode: `system` has dry", lambda: hhtjax.interop.ode(two())(0.0, (TWO, TWO), None)),
    ],
)
def test_bad_input_is_named(error, message, call):
    with pytest.raises(error, match=message):
        call()


def test_friction_without_mass_is_named():
    """Constraints may tie a coordinate without mass to others, but what rubs needs some mass of its own."""
    system = hhtjax.System(
        np.array([1.0, 0.0]),
        force,
        constraint=lambda q, t, params: q[:1] - q[1:],
        friction=lambda q, v, L, t, params: jnp.array([0.1]),
        sliding=lambda q, v, t, params: v[1:],
    )
    with pytest.warns(hhtjax.FailedRunWarning):
        run = simulate(system)
    with pytest.raises(hhtjax.SimulationError, match="`mass` must be positive where dry friction acts"):
        run.check()


def test_seventeen_joints_are_too_many():
    system = hhtjax.System(jnp.ones(17), force, friction=limit)
    with pytest.raises(ValueError, match="at most 16 directions; received one for each of 17 coordinates"):
        simulate(system, q0=jnp.ones(17))


@pytest.mark.slow
def test_friction_beside_redundant_constraints():
    """They take one direction, not two, at jumps of inputs too; and the energy balance knows what friction does."""
    system = hhtjax.System(
        TWO,
        lambda q, v, t, p: force(q, v, t, p) + p(t),
        lambda q, t, p: jnp.stack([q[1], 2 * q[1]]),
        friction=lambda q, v, L, t, p: 0.2 * ONE,
        sliding=lambda q, v, t, p: v[:1] - 0.1,
    )
    stepper, zero = hhtjax.hht(redundant="least_squares"), 0 * TWO
    held = hhtjax.sampled(jnp.array([[0.0, 0.0], [0.1, 0.1], [-0.1, 0.1]]), dt=1.0, order=0)
    found = hhtjax.simulate(system, stepper, zero, zero, held, dt=0.01, num_steps=400)
    found.check()
    assert 0.1 < np.mean(found.sticking) < 0.9
    assert np.max(np.abs(hhtjax.analysis.energy_balance(system, found, held).error)) < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("worst", [-1.0, np.nan, np.inf])
def test_a_limit_that_is_none_is_named(worst):
    """At the step where it becomes so, and of a batch the member."""
    system = hhtjax.System(ONE, force, friction=lambda q, v, t, p: jnp.where(t > 0.25, p, 0.1) + 0 * q)

    def run(p):
        return hhtjax.simulate(system, hhtjax.hht(), ONE, ZERO, p, dt=0.1, num_steps=5)

    with pytest.raises(
        hhtjax.SimulationError, match=r"step 3 .* a limit of the dry friction is negative or not finite"
    ):
        run(worst).check()
    batch = jax.vmap(run)(jnp.array([0.1, worst]))
    assert batch.failure.step.tolist() == [0, 3]
    assert "the dry friction was not found" in repr(jax.tree.map(lambda x: x[1], batch.failure))


@pytest.mark.slow
def test_joints_that_switch_too_often_are_named():
    """Forces that drive what slides, so strongly that in a long step friction would too: nothing settles."""
    driven = two(friction=lambda q, v, t, p: TWO)
    driven = replace(driven, force=lambda q, v, t, p: 30 * v + jnp.array([5.0, 1.5]) * jnp.sin(3 * t) - q)

    def run(dt):
        q0, v0 = jnp.array([0.1, -0.2]), jnp.array([0.3, -0.1])
        return hhtjax.simulate(driven, hhtjax.hht(), q0, v0, dt=dt, num_steps=3)

    run(0.01).check()
    with pytest.raises(hhtjax.SimulationError, match=r"step \d .* switch too often: 0\.\d+ of the step is left"):
        run(0.1).check()


@pytest.mark.slow
def test_what_shows_itself():
    found = simulate(two())
    assert "friction" in repr(found)
    assert "sticking" in repr(found)
    assert simulate(hhtjax.System(TWO, force)).friction is None


@pytest.mark.slow
def test_sweeps_files_and_dense_output(tmp_path):
    scene = SCENE
    arguments = scene.system, hhtjax.hht(), scene.q0, scene.v0, scene.params
    grid = {"dts": jnp.array([0.01, 0.005]), "duration": 0.8, "num_samples": 4}
    found = hhtjax.sweep(*arguments, **grid)
    loaded = hhtjax.load_sweep(hhtjax.sweep_to_disk(tmp_path / "runs", *arguments, **grid))
    assert found.friction.shape == found.sticking.shape == (2, 5, 1)
    assert found.sticking.any()
    assert not found.sticking.all()
    np.testing.assert_array_equal(loaded["friction"], found.friction)
    np.testing.assert_array_equal(loaded["sticking"], found.sticking)
    one = hhtjax.simulate(*arguments, dt=0.005, num_steps=160, save_every=40)
    np.testing.assert_allclose(one.friction, found.friction[1], rtol=1e-10)
    np.testing.assert_allclose(hhtjax.interpolate(one, one.t[2]).q, one.q[2], rtol=1e-12)


def test_a_held_input_breaks_a_joint_away_at_its_jump():
    """F/m (1 - limit) from the jump on: exact, since all is constant between."""
    u = hhtjax.sampled(jnp.array([0.5, 0.9, 1.5, 1.5]), dt=1.0, order=0)
    system = hhtjax.System(ONE, lambda q, v, t, u: u(t) + 0 * q, friction=lambda q, v, t, u: 1 + 0 * q)
    found = hhtjax.simulate(system, hhtjax.hht(0.0), ZERO, ZERO, u, dt=0.25, num_steps=11)
    found.check()
    t = np.maximum(np.asarray(found.t) - 2, 0)
    np.testing.assert_allclose(found.v[:, 0], 0.5 * t, atol=1e-12)
    np.testing.assert_array_equal(found.sticking[:9, 0], True)
    np.testing.assert_allclose(found.acceleration[9:, 0], 0.5, atol=1e-12)
    np.testing.assert_allclose(found.friction[1:8, 0], [0.5] * 4 + [0.9] * 3, rtol=1e-12)


@pytest.mark.slow
def test_a_limit_that_jumps_brakes_at_once():
    """Two coupled masses that slide, and a brake that is held: exact too."""
    mass, share, brake = np.array([[2.0, 0.7], [0.7, 1.0]]), np.array([1.0, 0.5]), np.array([1.0, 3.0])
    u = hhtjax.sampled(brake, dt=0.25, order=0)
    system = hhtjax.System(mass, lambda q, v, t, u: 0 * q, friction=lambda q, v, t, u: share * u(t))
    q, v = np.zeros(2), np.array([3.0, -3.0])
    found = hhtjax.simulate(system, hhtjax.hht(), q, v, u, dt=0.05, num_steps=10)
    found.check()
    for size in brake:
        w = -np.linalg.solve(mass, size * share * np.sign(v))
        q, v = q + 0.25 * v + w * 0.25**2 / 2, v + 0.25 * w
    np.testing.assert_allclose(found.q[-1], q, rtol=1e-12)
    np.testing.assert_allclose(found.v[-1], v, rtol=1e-12)


@pytest.mark.slow
def test_a_limit_is_fitted():
    """With a start off by a factor of 1.5."""

    def path(params):
        run = hhtjax.simulate(
            SCENE.system, hhtjax.hht(), SCENE.q0, SCENE.v0, {**SCENE.params, **params}, dt=0.02, num_steps=300
        )
        return run.q[:, 0]

    truth = {"F": 3.0, "k": 20.0}
    measured = path(truth)
    found = hhtjax.fit(lambda params: path(params) - measured, {"F": 2.0, "k": 24.0})
    assert found.params["F"] == pytest.approx(3.0, rel=1e-5)
    assert found.params["k"] == pytest.approx(20.0, rel=1e-5)
