"""Runs with rotations: orthogonality, gradients, dense output, dtypes, batches."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_rotating_bodies import ARM, E3, OM0, R0, TIP, J

import hhtjax
from hhtjax.rotation import cross
from hhtjax.scenes import top


@pytest.mark.slow
@pytest.mark.parametrize("num_steps", [100_000, pytest.param(1_000_000, marks=pytest.mark.every)])
@pytest.mark.parametrize("kinematics", ["chart", "lie"])
def test_rotations_stay_orthogonal(kinematics, num_steps):
    """To rounding after many steps; the energy of a free body wanders by the square of the step."""
    inertia, dt = jnp.array([1.0, 2.0, 3.5]), 0.01
    free = hhtjax.System(inertia, lambda q, Om, t, params: -cross(Om, inertia * Om))
    stepper = hhtjax.hht(0.0, linearize="predictor", kinematics=kinematics)
    Om0 = jnp.array([0.3, 1.0, 0.2])
    run = hhtjax.simulate(free, stepper, jnp.eye(3), Om0, dt=dt, num_steps=num_steps, save_every=num_steps // 100)
    run.check()
    R, Om = np.array(run.q), np.array(run.v)
    assert np.max(np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3))) < 1e-14
    energy = Om**2 @ np.array(inertia)
    assert np.max(np.abs(energy / energy[0] - 1)) < 1e-4


@pytest.mark.slow
@pytest.mark.every
def test_leaves_of_several_rotations():
    """Two bodies in one leaf (2, 3, 3) move as each does alone."""
    inertia = jnp.array([1.0, 2.0, 3.0])

    def torque(R, Om, t, params):
        return cross(jnp.array([0.0, 0.1, 0.0]), R.T @ jnp.asarray(E3)) - cross(Om, params * Om)

    def torques(q, v, t, params):
        return jnp.stack([torque(R, Om, t, params) for R, Om in zip(q, v, strict=True)])

    def run(system, q0, v0):
        return hhtjax.simulate(system, hhtjax.hht(), q0, v0, inertia, dt=0.01, num_steps=20)

    q0, v0 = jnp.stack([jnp.asarray(R0), jnp.eye(3)]), jnp.stack([jnp.asarray(OM0), jnp.zeros(3)])
    together = run(hhtjax.System(jnp.tile(inertia, 2), torques), q0, v0)
    assert together.q.shape == (21, 2, 3, 3)
    single = hhtjax.System(inertia, torque)
    for i in (0, 1):
        alone = run(single, q0[i], v0[i])
        np.testing.assert_allclose(together.q[:, i], alone.q, atol=1e-14)
        np.testing.assert_allclose(together.v[:, i], alone.v, atol=1e-14)


@pytest.mark.slow
def test_gradients():
    """Reverse = central: mass, inertia, tip, v0 and dt, through the start; at zero rotation, from rest too."""

    def moments(R, Om, t, params):
        m, arm = params["m"], jnp.asarray(ARM)
        return cross(arm, R.T @ jnp.array([0.0, 0.0, -9.81 * m])) - cross(Om, params["J"] @ Om)

    def height(R, t, params):
        return jnp.sum(R[2] * params["tip"], keepdims=True) - TIP[2] + 0.05 * jnp.sin(2 * t)

    body = hhtjax.System(lambda R, params: params["J"], moments, height)

    def loss(x):
        m, inertia, tip, rate, dt = x
        params = {"m": 2.0 * m, "J": jnp.asarray(J) * inertia, "tip": jnp.asarray(TIP) * tip}
        begin = hhtjax.consistent_initial(body, jnp.eye(3), rate * jnp.asarray(OM0), params)[:2]
        run = hhtjax.simulate(body, hhtjax.hht(-0.05), *begin, params, dt=0.02 * dt, num_steps=20)
        parts = run.q * jnp.arange(9.0).reshape(1, 3, 3), run.v, run.multipliers
        return sum(jnp.sum(jnp.mean(y, 0) ** 2) for y in parts)

    both, direction = jax.jit(jax.value_and_grad(loss)), np.array([0.6, -0.7, 0.5, 0.8, 0.9])
    for x in (np.ones(5), np.array([1.0, 1.0, 1.0, 0.0, 1.0])):
        reverse = both(x)[1] @ direction
        one, two = (float(both(x + h * direction)[0] - both(x - h * direction)[0]) for h in (2e-4, 4e-4))
        assert abs((8 * one - two) / 24e-4 - reverse) < 1e-9 * abs(reverse)


@pytest.mark.slow
@pytest.mark.every
def test_gradient_without_a_constraint():
    """Forward along one direction in all params, v0 and dt = reverse = central; from rest too."""
    system, params, q0, v0, _ = top.minimal(spin=5.0)
    direction = jnp.array([0.6, 0.8, 0.5])

    def loss(x):
        start = q0, jax.tree.map(lambda v: v * x[1], v0), jax.tree.map(lambda p: p * x[0], params)
        run = hhtjax.simulate(system, hhtjax.hht(-0.05, linearize="predictor"), *start, dt=0.02 * x[2], num_steps=20)
        return jnp.sum(jnp.mean(run.q * jnp.arange(9.0).reshape(1, 3, 3), 0) ** 2) + jnp.sum(jnp.mean(run.v, 0) ** 2)

    along, reverse = jax.jit(lambda x: jax.jvp(loss, (x,), (direction,))), jax.jit(jax.grad(loss))
    for x in (jnp.ones(3), jnp.array([1.0, 0.0, 1.0])):
        forward = float(along(x)[1])
        assert abs(reverse(x) @ direction - forward) < 1e-10 * abs(forward)
        one, two = (float(along(x + h * direction)[0] - along(x - h * direction)[0]) for h in (1e-4, 2e-4))
        assert abs((8 * one - two) / 12e-4 - forward) < 1e-6 * abs(forward)


@pytest.mark.slow
def test_dense_output():
    """Between saved times R is a rotation, right to the fourth order of their spacing."""
    scene = top.minimal(spin=20.0)
    stepper, interpolate = hhtjax.hht(linearize="predictor"), jax.jit(hhtjax.interpolate)
    fine = hhtjax.simulate(scene.system, stepper, *scene[2:4], scene.params, dt=1e-3, num_steps=64)
    errors = []
    for every in (8, 16):  # four intervals, and 33 times in them: one program
        rows, times = slice(None, 4 * every + 1, every), slice(None, 4 * every + 1, every // 8)
        coarse = fine._replace(**{name: getattr(fine, name)[rows] for name in ("t", "q", "v", "acceleration")})
        R, Om = interpolate(coarse, fine.t[times])[:2]
        np.testing.assert_allclose(np.swapaxes(R, 1, 2) @ R, np.tile(np.eye(3), (len(R), 1, 1)), atol=1e-14)
        np.testing.assert_allclose(R[::8], coarse.q, atol=1e-13)
        middle = slice(4, 256 // every, 8)  # of the same stretch
        errors.append([np.max(np.abs(x[middle] - y[times][middle])) for x, y in ((R, fine.q), (Om, fine.v))])
    assert np.all(np.log2(np.array(errors[1]) / np.array(errors[0])) > 3.6)


@pytest.mark.slow
def test_float32_and_batches():
    """The dtype is kept; of a batch, one body keeps its angular momentum and one its place."""
    inertia = np.array([1.0, 2.0, 3.0], np.float32)
    free = hhtjax.System(inertia, lambda q, Om, t, params: -cross(Om, inertia * Om))

    def run(Om0):
        return hhtjax.simulate(free, hhtjax.hht(), jnp.eye(3, dtype=jnp.float32), Om0, dt=0.01, num_steps=10)

    Om0 = np.array([[1.0, 0.5, 0.2], [0.0, 0.0, 0.0]], np.float32)
    with pytest.warns(hhtjax.PrecisionWarning):
        batch = jax.vmap(run)(jnp.asarray(Om0))
    assert batch.q.dtype == batch.v.dtype == batch.acceleration.dtype == jnp.float32
    momentum = np.einsum("tij,tj->ti", batch.q[0], inertia * np.asarray(batch.v[0]))
    np.testing.assert_allclose(momentum, np.tile(inertia * Om0[0], (11, 1)), atol=1e-5)
    np.testing.assert_allclose(batch.v[0][-1], Om0[0] - 0.1 * np.cross(Om0[0], inertia * Om0[0]) / inertia, atol=5e-3)
    np.testing.assert_allclose(batch.q[1], np.tile(np.eye(3), (11, 1, 1)), atol=0)
