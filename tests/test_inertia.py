"""A system that gives M(q) w itself: the same motion, without the matrix and its derivatives."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from zoo import each

import hhtjax
from hhtjax import System
from hhtjax.systems.flat_system import flatten

MU = jnp.array([[3.0, 2.0, 1.0], [2.0, 2.0, 1.0], [1.0, 1.0, 1.0]])


def mass(q, params):
    return params["m"] * MU * jnp.cos(q["q"][:, None] - q["q"][None, :])


def force(q, v, t, params):
    q, v = q["q"], v["q"]
    return {"q": -params["m"] * ((MU * jnp.sin(q[:, None] - q[None, :])) @ v**2 + 9.81 * jnp.diag(MU) * jnp.sin(q))}


def inertia(q, w, params):
    s, c, w = jnp.sin(q["q"]), jnp.cos(q["q"]), w["q"]
    return {"q": params["m"] * (c * (MU @ (c * w)) + s * (MU @ (s * w)))}


Q0, V0 = {"q": jnp.array([0.5, 0.2, -0.3])}, {"q": jnp.zeros(3)}
STEPPERS = {
    "auto": hhtjax.hht(),
    "newton": hhtjax.hht(iterations=None),
    "state": hhtjax.hht(linearize="state"),
    "rowda": hhtjax.rowda(),
    "kim": hhtjax.kim_hht(),
    "conventional": hhtjax.conventional_hht(-0.1),
}


def run(system, stepper, m=2.0):
    return hhtjax.simulate(system, stepper, Q0, V0, {"m": m}, dt=0.01, num_steps=20).q["q"]


@pytest.mark.slow
@pytest.mark.parametrize("name", each(STEPPERS, quick=["auto"]))
def test_the_motion_is_the_same(name):
    stepper = STEPPERS[name]
    exact, found = (run(System(mass, force, inertia=own), stepper) for own in (None, inertia))
    np.testing.assert_allclose(found, exact, rtol=0, atol=1e-9 if name in ("newton", "conventional") else 1e-13)


@pytest.mark.slow
def test_so_is_its_gradient():
    @partial(jax.jit, static_argnums=0)
    @partial(jax.grad, argnums=1)
    def gradient(own, m):
        return jnp.sum(run(System(mass, force, inertia=own), hhtjax.hht(linearize="predictor"), m) ** 2)

    exact, found = (gradient(own, 2.0) for own in (None, inertia))
    np.testing.assert_allclose(found, exact, rtol=0, atol=1e-12)


def test_it_stands_in_the_place_of_the_matrix():
    twice = System(mass, force, inertia=lambda q, w, params: {"q": 2 * inertia(q, w, params)["q"]})
    flat, q, _ = flatten("test", twice, Q0, V0, 0.0, {"m": 2.0})
    w = jnp.array([1.0, -2.0, 0.5])
    np.testing.assert_allclose(flat.inertia(q, w, 0.0, {"m": 2.0}), 2 * mass(Q0, {"m": 2.0}) @ w, rtol=1e-13)


@pytest.mark.slow
def test_lagrangians_have_one():
    def lagrangian(q, v, t, params):
        return (1 + q[0] ** 2) * v[0] ** 2 + v[0] * v[1] * jnp.sin(q[1]) + params * v[1] ** 2 - q @ q + t * v[0]

    system = System.from_lagrangian(lagrangian)
    q, w = jnp.array([0.3, -0.7]), jnp.array([1.1, 0.4])
    np.testing.assert_allclose(system.inertia(q, w, 0.5, 3.0), system.mass(q, 0.5, 3.0) @ w, rtol=1e-14)


def test_errors():
    with pytest.raises(TypeError, match=r"System: `inertia` must be a function inertia\(q, w, params\)"):
        System(mass, force, inertia=3)
    wrong = System(mass, force, inertia=lambda q, w, params: {"q": w["q"][:2]})
    with pytest.raises(ValueError, match="simulate: `inertia` must return a pytree like v0"):
        run(wrong, hhtjax.hht())
