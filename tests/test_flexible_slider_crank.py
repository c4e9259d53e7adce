"""The flexible slider-crank: the published end, its equations from the energies of the rod, and a derivative."""

import json
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hhtjax import extrapolated, hht, simulate
from hhtjax.scenes.flexible_slider_crank import flexible_slider_crank

PUBLISHED = json.loads((Path(__file__).parent / "data" / "flexible_slider_crank.json").read_text())
AXIAL = 15  # the test set's mass along the rod, in terms of that of the shape functions


def end(stepper, num_steps, params, duration=PUBLISHED["t"]):
    scene = flexible_slider_crank()
    options = {"dt": duration / num_steps, "num_steps": num_steps, "save_every": num_steps}
    return simulate(scene.system, stepper, scene.q0, scene.v0, params, **options)


def test_published_end():
    run = end(extrapolated(levels=5), 4000, flexible_slider_crank().params)
    run.check()
    np.testing.assert_allclose(run.q[-1], PUBLISHED["q"], rtol=2e-9)
    np.testing.assert_allclose(run.v[-1], PUBLISHED["v"], rtol=1e-6)
    np.testing.assert_allclose(run.multipliers[-1], -np.array(PUBLISHED["lambda"]), rtol=1e-8)


def rod_energies(params, q, v):
    """Kinetic and potential energy of the rod, by a quadrature along it."""
    x, weights = np.polynomial.legendre.leggauss(20)
    s, weights = (x + 1) / 2, weights / 2
    m2, l1, l2 = params["m"][0], *params["l"]

    def place(q):
        """Of the points of the rod, (2, s)."""
        along = l2 * s + q[5] * 4 * s * (1 - s) + q[6] * s * (2 * s - 1)
        across = q[3] * np.sin(np.pi * s) + q[4] * np.sin(2 * np.pi * s)
        c, sine = jnp.cos(q[1]), jnp.sin(q[1])
        joint = l1 * jnp.array([jnp.cos(q[0]), jnp.sin(q[0])])
        return joint[:, None] + jnp.stack([c * along - sine * across, sine * along + c * across])

    def along_mass(u, u_dot, turn):
        u, u_dot = (x[0] * 4 * s * (1 - s) + x[1] * s * (2 * s - 1) for x in (u, u_dot))
        return u_dot**2 + turn**2 * u**2

    speed = jax.jvp(place, (q,), (v,))[1]
    density = jnp.sum(speed**2, axis=0) + (AXIAL - 1) * along_mass(q[5:], v[5:], v[1])
    rotary = params["J"][1] - m2 * l2**2 / 3
    kinetic = m2 / 2 * weights @ density + rotary / 2 * v[1] ** 2
    stretch = (q[5] * (4 - 8 * s) + q[6] * (4 * s - 1)) / l2
    slope = np.pi / l2 * (q[3] * np.cos(np.pi * s) + 2 * q[4] * np.cos(2 * np.pi * s))
    bending = (np.pi / l2) ** 2 * (q[3] * np.sin(np.pi * s) + 4 * q[4] * np.sin(2 * np.pi * s))
    tension = params["EA"] * (stretch**2 + params["stiffening"] * stretch * slope**2)
    return kinetic, l2 / 2 * weights @ (tension + params["EI"] * bending**2)


def lagrangian(params, q, v):
    kinetic, potential = rod_energies(params, q, v)
    return kinetic + (params["J"][0] * v[0] ** 2 + params["m"][1] * v[2] ** 2) / 2 - potential


@pytest.mark.parametrize("stiffening", [False, True])
def test_equations_are_those_of_the_energies(stiffening):
    """M and Q against the slopes of the Lagrangian, by automatic differentiation; pi is rounded to 1.5e-8."""
    scene = flexible_slider_crank(stiffening)
    rng = np.random.default_rng(0)
    q, v = (np.append(rng.normal(size=3), scale * rng.normal(size=4)) for scale in (1e-2, 1.0))
    of_q = partial(lagrangian, scene.params)
    momentum = jax.grad(of_q, 1)
    M = jax.jacfwd(momentum, 1)(q, v)
    Q = jax.grad(of_q)(q, v) - jax.jvp(lambda q: momentum(q, v), (q,), (v,))[1]
    np.testing.assert_allclose(scene.system.mass(q, scene.params), M, atol=1e-7 * abs(M).max())
    np.testing.assert_allclose(scene.system.force(q, v, 0.0, scene.params), Q, rtol=2e-7, atol=1e-6)


def test_dtype():
    scene = flexible_slider_crank(stiffening=True, damping=True)
    q, v, params = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), (scene.q0, scene.v0, scene.params))
    system = scene.system
    for x in system.mass(q, params), system.force(q, v, q[0], params), system.constraint(q, q[0], params):
        assert x.dtype == jnp.float32


def test_damping_takes_energy_out():
    scene = flexible_slider_crank(damping=True)
    D = scene.params["D"]
    assert np.all(np.linalg.eigvalsh(D) > 0)
    v = np.arange(7.0)
    lost = flexible_slider_crank().system.force(scene.q0, v, 0.0, flexible_slider_crank().params)
    lost -= scene.system.force(scene.q0, v, 0.0, scene.params)
    np.testing.assert_allclose(lost, np.append(np.zeros(3), D @ v[3:]), atol=1e-9)


def test_derivative_in_the_bending_stiffness():
    params = flexible_slider_crank().params

    @jax.jit
    def final(factor):
        run = end(hht(linearize="predictor"), 500, params | {"EI": factor * params["EI"]}, duration=0.01)
        return run.q[-1]

    one, h = jnp.ones(()), 1e-5
    slope = jax.jit(jax.jacfwd(final))(one)
    difference = (final(one + h) - final(one - h)) / (2 * h)
    assert abs(slope[3]) > 1e-5  # m
    np.testing.assert_allclose(slope[1:], difference[1:], rtol=1e-5, atol=1e-11)
