"""Static equilibria against closed forms, with derivatives; what has none is named."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hhtjax
from hhtjax.analysis import equilibrium
from hhtjax.rotation import exp

G = 9.81


def test_a_spring_sags_and_its_slope_is_known():
    spring = hhtjax.System(jnp.full(1, 2.0), lambda q, v, t, p: -2.0 * G - p["k"] * q + 5 * v)

    def sag(k):
        return equilibrium(spring, jnp.zeros(1), params={"k": k}).q[0]

    assert sag(50.0) == pytest.approx(-2 * G / 50, rel=1e-12)
    for slope in (jax.grad(sag), jax.jacfwd(sag), jax.jit(jax.grad(sag))):
        assert slope(50.0) == pytest.approx(2 * G / 50**2, rel=1e-12)
    many = jax.vmap(sag)(jnp.array([10.0, 20.0]))
    np.testing.assert_allclose(many, [-2 * G / 10, -2 * G / 20], rtol=1e-12)


def test_a_pendulum_of_cartesian_coordinates_hangs_and_its_rod_pulls():
    pendulum = hhtjax.System(
        jnp.full(2, 3.0),
        lambda q, v, t, p: jnp.array([0.0, -3.0 * G]),
        constraint=lambda q, t, p: jnp.stack([jnp.sqrt(jnp.sum(q**2)) - p["l"]]),
    )
    found = equilibrium(pendulum, jnp.array([1.5, -0.5]), params={"l": 2.0})
    np.testing.assert_allclose(found.q, [0.0, -2.0], atol=1e-9)
    np.testing.assert_allclose(found.multipliers, [-3 * G], rtol=1e-9)

    def height(length):
        return equilibrium(pendulum, jnp.array([1.5, -0.5]), params={"l": length}).q[1]

    assert jax.grad(height)(2.0) == pytest.approx(-1.0, rel=1e-8)


def test_a_rotation_internal_states_trees_and_first_order_systems():
    body = hhtjax.System(
        jnp.ones(3), lambda R, Om, t, p: jnp.cross(R.T @ jnp.array([0.0, 0.0, -1.0]), jnp.array([0.0, 0.0, -2.0]))
        - 1e-3 * R.T @ jnp.array([0.0, 0.0, 0.0]) - 0.1 * (R - R.T)[jnp.array([2, 0, 1]), jnp.array([1, 2, 0])],
    )  # fmt: skip
    found = equilibrium(body, exp(jnp.array([0.4, -0.3, 0.2])), jnp.zeros(3))
    assert found.converged
    np.testing.assert_allclose(found.q, np.eye(3), atol=1e-7)

    motor = hhtjax.System(
        jnp.ones(1), lambda q, v, z, t, p: z - 4.0 * q, internal=lambda q, v, z, t, p: p["u"] - 2.0 * z - v
    )
    found = equilibrium(motor, jnp.ones(1), params={"u": 6.0}, z0=jnp.zeros(1))
    np.testing.assert_allclose((found.q[0], found.z[0]), (0.75, 3.0), rtol=1e-10)

    tree = hhtjax.System(jnp.ones(2), lambda q, v, t, p: {"a": 1 - q["a"], "b": q["a"] - 2 * q["b"]})
    found = equilibrium(tree, {"a": jnp.zeros(1), "b": jnp.zeros(1)})
    np.testing.assert_allclose((found.q["a"][0], found.q["b"][0]), (1.0, 0.5), rtol=1e-10)

    tank = hhtjax.FirstOrderSystem(lambda y, t, p: p - jnp.sqrt(jnp.abs(y)))
    np.testing.assert_allclose(equilibrium(tank, jnp.ones(1), params=3.0).q, [9.0], rtol=1e-9)


@pytest.mark.filterwarnings("ignore:equilibrium. in float32")
def test_float32_is_kept():
    spring = hhtjax.System(np.ones(1, np.float32), lambda q, v, t, p: 1 - 4 * q)
    found = equilibrium(spring, np.zeros(1, np.float32))
    assert found.q.dtype == np.float32
    assert found.q[0] == pytest.approx(0.25, rel=1e-6)


def test_what_has_none_is_named():
    falling = hhtjax.System(jnp.ones(1), lambda q, v, t, p: -G + 0 * q)
    with pytest.raises(ValueError, match=r"equilibrium: none was found near `q0`: 1 of the forces is left"):
        equilibrium(falling, jnp.zeros(1))
    assert not jax.jit(lambda q: equilibrium(falling, q).converged)(jnp.zeros(1))
    rubbing = hhtjax.System(jnp.ones(1), lambda q, v, t, p: -q, friction=lambda q, v, t, p: jnp.ones(1))
    with pytest.raises(NotImplementedError, match="has friction, so its equilibria are not isolated"):
        equilibrium(rubbing, jnp.zeros(1))
