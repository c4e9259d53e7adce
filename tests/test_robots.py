"""Identification of robots: inertias that exist, what is identifiable, motions that tell, friction from records."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import check_gradient
from mechanisms import random_inertia, random_tree, servo_arm

import hhtjax
from hhtjax.identification import base_parameters, excitation, inertia_coordinates, physical_inertia


def test_physical_inertia_is_always_that_of_a_body():
    """Whatever the ten numbers; and the way back."""
    theta = jnp.asarray(np.random.default_rng(0).normal(size=(50, 10)))
    found = physical_inertia(theta)
    moments = np.linalg.eigvalsh(found["inertia"])
    assert np.all(np.asarray(found["mass"]) > 0)
    assert np.all(moments > 0)
    assert np.all(moments[:, 2] < moments[:, 0] + moments[:, 1])
    np.testing.assert_allclose(inertia_coordinates(**found), theta, atol=1e-6)
    rng = np.random.default_rng(1)
    inertia = random_inertia(rng)
    again = physical_inertia(inertia_coordinates(2.5, jnp.array([0.1, -0.2, 0.3]), inertia))
    np.testing.assert_allclose(again["inertia"], inertia, rtol=1e-12)
    check_gradient(lambda x: sum(jnp.sum(jnp.sin(y)) for y in physical_inertia(x).values()), theta[0])


def test_inertias_of_no_body_are_refused():
    with pytest.raises(ValueError, match="smaller than the sum"):
        inertia_coordinates(1.0, jnp.zeros(3), jnp.diag(jnp.array([1.0, 1.0, 2.0])))
    with pytest.raises(ValueError, match=r"shape \(\.\.\., 10\)"):
        physical_inertia(jnp.zeros(9))


def test_base_parameters_are_all_that_motions_tell():
    """Torques depend on theta through beta alone: 7 numbers of a planar arm's 20, and what is unseen moves nothing."""
    arm = servo_arm(gravity=(0, 0, -9.81))
    base = base_parameters(arm)
    assert base.count == len(base.names) == 6
    assert any("Ixx" in name for name in base.unseen)
    q, v, w = np.random.default_rng(3).normal(size=(3, 30, 2))
    Y = jax.vmap(lambda q, v, w: hhtjax.bodies.regressor(arm, q, v, w))(q, v, w).reshape(-1, 20)
    theta = np.random.default_rng(4).normal(size=20)
    np.testing.assert_allclose(Y @ theta, Y[:, base.independent] @ (base.combination @ theta), atol=1e-9)
    with pytest.raises(TypeError, match="must be a Mechanism"):
        base_parameters(arm.system)
    with pytest.raises(NotImplementedError, match="`motion` must be given"):
        base_parameters(random_tree(("ball",)))


@pytest.mark.slow
def test_excitation_is_better_conditioned_and_in_range():
    arm = random_tree(("revolute", "revolute", "prismatic"), seed=9)
    found = excitation(arm, period=5.0, harmonics=3, amplitude=0.8, speed=1.5, iterations=40)
    assert found.condition < 0.7 * found.start
    t = np.linspace(0, 5, 400)
    q, v, _ = jax.vmap(found.trajectory.motion)(t)
    assert float(jnp.max(jnp.abs(q - arm.q0[None]))) < 0.801
    assert float(jnp.max(jnp.abs(v))) < 1.502
    np.testing.assert_allclose(jax.vmap(jax.jacfwd(found.trajectory))(t), v, atol=1e-10)


@pytest.mark.slow
def test_friction_and_damping_from_a_record_of_angles_and_torques():
    """`equation_error` with dry friction, linear in what is unknown; no simulation, and within a per cent."""
    arm = servo_arm()
    motion = excitation(arm, period=4.0, harmonics=2, amplitude=0.6, iterations=5).trajectory
    true = arm.params | {"ctrl": motion, "frictionloss": jnp.array([1.5, 0.7]), "damping": jnp.array([0.8, 0.3])}
    run = hhtjax.simulate(
        arm.system, hhtjax.hht(), motion(0.0), motion.motion(0.0)[1], true, dt=1e-3, num_steps=4000, save_every=4
    )
    run.check()
    ctrl = jax.vmap(motion)(run.t)
    torque = true["kp"][None] * (ctrl - run.q) - true["kv"][None] * run.v
    residuals = hhtjax.equation_error(arm.system, run.q, 4e-3, cutoff=15.0)
    known = arm.params | {"torque": hhtjax.sampled(torque, 4e-3), "kp": jnp.zeros(2), "kv": jnp.zeros(2)}
    found = hhtjax.fit(lambda x: residuals(known | x), {"frictionloss": jnp.ones(2), "damping": jnp.ones(2)})
    for name in ("frictionloss", "damping"):
        np.testing.assert_allclose(found.params[name], true[name], rtol=0.02)


def test_rows_that_may_stick_are_left_out_and_count_as_no_samples():
    """A block that is pushed to and fro, with long rests in between: intervals are those of the rows that slide."""
    t, dt = np.arange(0, 20, 0.01), 0.01
    way = np.interp(t % 4, [0, 1, 2, 3, 4], [0, 0, 1, 1, 0])  # rests for half of the time
    q = 0.5 * np.convolve(np.pad(way, 20, mode="edge"), np.hanning(43)[1:-1] / np.hanning(43).sum(), "valid")
    v, a = np.gradient(q, dt), np.gradient(np.gradient(q, dt), dt)
    rng = np.random.default_rng(0)
    q = q + 2e-3 * rng.normal(size=t.size)
    system = hhtjax.System(
        jnp.array([2.0, 1.0]), lambda q, v, t, params: params["push"](t) - jnp.array([0.0, 1.0]) * q,
        friction=lambda q, v, t, params: params["F"] * np.ones(1), sliding=lambda q, v, t, params: v[:1],
    )  # fmt: skip
    push = 2 * a + 3 * np.sign(np.round(v, 6)) + 0.3 * rng.normal(size=t.size)
    push = hhtjax.sampled(np.stack([push, np.cos(t)], axis=1), dt)
    values = np.stack([q, np.zeros_like(q)], axis=1)
    residuals = hhtjax.equation_error(system, values, dt, cutoff=5.0)
    first, second = residuals({"F": 1.0, "push": push})
    moving = np.abs(v[20:-20]) > 0.1
    assert abs(len(first) - moving.sum()) < 0.15 * moving.sum()
    assert len(second) == t.size - 40
    found = hhtjax.fit(lambda F: residuals({"F": F, "push": push})[0], 1.0)
    assert float(found.params) == pytest.approx(3.0, abs=4 * float(found.standard_errors))
    assert len(found.residual) == len(first)
    of_values = jax.jit(lambda y: hhtjax.equation_error(system, y, dt, cutoff=5.0)({"F": 1.0, "push": push})[0])(values)
    np.testing.assert_allclose(of_values[np.asarray(of_values) != 0], first, rtol=1e-9)
    with_params = hhtjax.System(
        jnp.array([2.0, 1.0]), system.force, friction=system.friction,
        sliding=lambda q, v, t, params: v[:1] - params["belt"],
    )  # fmt: skip
    kept = hhtjax.equation_error(with_params, values, dt, cutoff=5.0)({"F": 1.0, "push": push, "belt": 0.0})
    assert [len(x) for x in kept] == [t.size - 40] * 2
    assert int(np.sum(np.asarray(kept[0]) != 0)) == len(first)
    np.testing.assert_allclose(np.asarray(kept[0])[np.asarray(kept[0]) != 0], first, rtol=1e-12)
    with pytest.warns(hhtjax.identification.IdentifiabilityWarning, match=r"determine params\[1\] not at all"):
        hhtjax.fit(lambda F: [F[0] - first, F[1] * first[:0]], jnp.ones(2))  # as of a joint that rests throughout
    with pytest.raises(ValueError, match="equation_error: in `values` some joint with dry friction must slide"):
        hhtjax.equation_error(hhtjax.scenes.dry_oscillator.SYSTEM, np.zeros((99, 1)), dt, cutoff=5.0)
