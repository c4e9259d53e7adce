"""The constrained scenes: consistent starts, masses, power, energy, gradients; by no stepper of ours.

They are solved in index-1 form, [M -B^T; B 0] [w; L] = [Q; -gamma], where gamma is the second time derivative of Phi
without B w. As an ODE that keeps Phi = 0 to the accuracy of SciPy's integrator.
"""

import re
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import check_gradient
from index_1 import SCENES, flat, index_1, path, times
from jax.flatten_util import ravel_pytree

from hhtjax.scenes import four_bars, pendulum, squeezer

CONSTRAINED = [name for name, scene in SCENES.items() if scene.system.constraint]
CONSERVATIVE = [name for name in SCENES if "driven" not in name]


def states(scene, number=20):
    """Random q and v about the start, (number, n); they close no loops."""
    q0 = flat(scene)[3]
    q, v = np.random.default_rng(0).normal(size=(2, number, q0.size))
    return np.asarray(q0) + q, v


def bodies(name, q, params):
    """Uniform bars: masses, and both ends (bars, 2); a point mass is one of no length."""
    if "slider" in name:
        l1, l2 = params["l"]
        joint = l1 * jnp.array([jnp.cos(q[0]), jnp.sin(q[0])])
        end, slider = joint + l2 * jnp.array([jnp.cos(q[1]), jnp.sin(q[1])]), jnp.array([q[2], 0.0])
        return jnp.array(params["m"]), jnp.array([jnp.zeros(2), joint, slider]), jnp.array([joint, end, slider])
    if "four" in name:
        B = q.reshape(-1, 2)
        A = params["l"] * jnp.stack([jnp.arange(len(B), dtype=float), jnp.zeros(len(B))], axis=1)
        return params["m"], jnp.concatenate([A, B[:-1]]), jnp.concatenate([B, B[1:]])
    point = jnp.array([params["l"] * jnp.sin(q[0]), -params["l"] * jnp.cos(q[0])]) if "minimal" in name else q
    return params["m"], point[None], point[None]


def kinetic_energy(name, q, v, params):
    """Of `bodies`: Simpson's rule, exact for a bar."""

    def ends(q):
        return bodies(name, q, params)[1:]

    (u1, u2), (m, *_) = jax.jvp(ends, (q,), (v,))[1], bodies(name, q, params)
    return jnp.sum(m / 6 * jnp.sum(u1**2 + (u1 + u2) ** 2 + u2**2, axis=1)) / 2


def potential_energy(name, q, params):
    """Of weights and springs, and of a constant moment."""
    p = params
    if name == "squeezer":
        sd, sc, gamma = p["sd"], p["sc"], q[2]
        x = p["B"][0] + sd * jnp.cos(gamma) + sc * jnp.sin(gamma) - p["C"][0]
        y = p["B"][1] + sd * jnp.sin(gamma) - sc * jnp.cos(gamma) - p["C"][1]
        return p["c0"] / 2 * (jnp.hypot(x, y) - p["l0"]) ** 2 - p["moment"] * q[0]
    m, start, end = bodies(name, q, params)
    V = p["g"] * jnp.sum(m * (start + end)[:, 1] / 2)
    if "slider" in name:
        V += p["k"] / 2 * (q[2] - p["rest"]) ** 2 - p["moment"] * q[0]
    if "elastic" in name:
        V += p["k"] / 2 * (jnp.hypot(*q) - p["l"]) ** 2
    return V


@pytest.mark.parametrize("name", CONSTRAINED)
def test_start_is_consistent(name):
    _, _, constraint, q0, v0 = flat(SCENES[name])
    at_start = jax.jit(lambda q0, v0: jax.jvp(partial(constraint, params=SCENES[name].params), (q0, 0.0), (v0, 1.0)))
    Phi, rate = at_start(q0, v0)
    assert np.max(np.abs(Phi)) < 1e-12
    assert np.max(np.abs(rate)) < 1e-12


@pytest.mark.parametrize("name", SCENES)
def test_mass_is_symmetric_and_positive_definite(name):
    scene = SCENES[name]
    # uncompiled: a compiler may round M[i, j] otherwise than M[j, i]
    M = np.asarray(jax.vmap(flat(scene)[0], (0, None))(states(scene)[0], scene.params))
    np.testing.assert_array_equal(M, np.swapaxes(M, 1, 2))
    assert np.min(np.linalg.eigvalsh(M)) > 1e-3 * np.min(np.diagonal(M, axis1=1, axis2=2))


@pytest.mark.parametrize("name", [name for name in SCENES if name != "squeezer"])
def test_mass_is_that_of_uniform_bars(name):
    """v.M v/2 is the kinetic energy of the bodies."""
    scene = SCENES[name]

    @jax.jit
    @jax.vmap
    def energies(q, v):
        return v @ flat(scene)[0](q, scene.params) @ v / 2, kinetic_energy(name, q, v, scene.params)

    np.testing.assert_allclose(*energies(*states(scene)), rtol=1e-13)


@pytest.mark.parametrize("name", SCENES)
def test_power_balance(name):
    """v.(Q + (dM/dt) v/2) is what weights, springs, the moment and the damper do: the inertia forces do no work."""
    scene = SCENES[name]
    mass, force, *_ = flat(scene)

    @jax.jit
    @jax.vmap
    def powers(q, v):
        kinetic = jax.jvp(lambda q: v @ mass(q, scene.params) @ v / 2, (q,), (v,))[1]
        potential = jax.jvp(lambda q: potential_energy(name, q, scene.params), (q,), (v,))[1]
        damper = scene.params["c"] * v[2] ** 2 if "slider" in name else 0.0
        return v @ force(q, v, 0.0, scene.params) + kinetic, -potential - damper

    done, given = powers(*states(scene))
    assert np.max(np.abs(done - given)) < 1e-12 * np.max(np.abs(given))


@pytest.mark.parametrize("name", CONSERVATIVE)
def test_energy_is_conserved_and_loops_stay_closed(name):
    scene = SCENES[name]
    mass, _, constraint, *_ = flat(scene)

    @jax.jit
    @jax.vmap
    def measure(q, v):
        T, V = v @ mass(q, scene.params) @ v / 2, potential_energy(name, q, scene.params)
        return T, T + V, constraint(q, 0.0, scene.params)

    T, energy, Phi = measure(*path(name, times(name)))
    assert np.max(T) > 1.2 * np.min(T)  # it moves
    assert np.max(np.abs(energy - energy[0])) < 1e-9 * np.max(T)
    assert not Phi.size or np.max(np.abs(Phi)) < 1e-10


@pytest.mark.slow
@pytest.mark.parametrize("name", ["squeezer", "pendulum", "elastic pendulum", "driven slider-crank", "four bars"])
def test_gradients_in_all_params(name):
    """Of M, Q, Phi, and of the accelerations and multipliers they give, at a random state, in factors of the params."""
    scene = SCENES[name]
    mass, force, constraint, *_ = flat(scene)
    q, v = (jnp.asarray(x[0]) for x in states(scene))

    @jax.jit
    def measures(params):
        M, Q, Phi = mass(q, params), force(q, v, 0.0, params), constraint(q, 0.0, params)
        return ravel_pytree((M, Q, Phi, index_1(scene, params, q, v)))[0]

    size = np.abs(measures(scene.params))
    weight = np.random.default_rng(1).normal(size=size.size) / np.where(size > 0, size, 1.0)

    def loss(factors):
        return weight @ measures(jax.tree.map(jnp.multiply, factors, scene.params))

    factors = jax.tree.map(jnp.ones_like, scene.params)
    gradient = check_gradient(loss, factors)
    assert np.all(np.abs(gradient) > 1e-6 * np.max(np.abs(gradient)))  # each of them matters


def test_a_pendulum_of_any_length_starts_consistently():
    """Traced lengths, speeds and stiffnesses: the gap of the loop does not depend on the length."""

    def gap(length):
        scene = pendulum.cartesian(length=length)
        _, _, constraint, q0, _ = flat(scene)
        return constraint(q0, 0.0, scene.params)[0]

    def radial_force(k):
        """Of weight, spring and inertia at the start of an elastic pendulum."""
        scene = pendulum.elastic(k, speed=3.0, length=0.7)
        return scene.system.force(scene.q0, scene.v0, 0.0, scene.params)[1] + scene.v0[0] ** 2 / scene.q0[1]

    for function, x in (gap, 0.8), (radial_force, 100.0):
        assert abs(float(function(x))) < 1e-12
        assert abs(float(jax.jit(jax.grad(function))(x))) < 1e-12
    rate = jax.grad(lambda length: pendulum.minimal(3.0, length).v0[0])(0.5)
    assert float(rate) == pytest.approx(-3.0 / 0.5**2)


@pytest.mark.parametrize("name", SCENES)
def test_single_precision_is_kept(name):
    system, params, q, v, _ = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), SCENES[name])
    t = jnp.float32(0)
    assert jax.eval_shape(system.mass, q, params).dtype == jnp.float32
    assert jax.eval_shape(system.force, q, v, t, params).dtype == jnp.float32
    assert system.constraint is None or jax.eval_shape(system.constraint, q, t, params).dtype == jnp.float32


def test_params_are_no_part_of_the_program():
    """Scenes that differ in their params share one system, and so one compilation."""
    assert squeezer.squeezer(0.05).system == SCENES["squeezer"].system
    assert SCENES["driven slider-crank"].system == SCENES["free slider-crank"].system
    assert SCENES["five four-bars"].system == SCENES["four bars"].system


@pytest.mark.parametrize(
    ("constructor", "arguments", "error", "message"),
    [
        (squeezer.squeezer, {"moment": np.nan}, ValueError, "squeezer: `moment` must be finite; received nan."),
        (squeezer.squeezer, {"moment": "1"}, TypeError, "squeezer: `moment` must be a real number; received '1'."),
        (pendulum.cartesian, {"length": 0.0}, ValueError, "cartesian: `length` must be positive and finite; received"),
        (pendulum.minimal, {"length": np.inf}, ValueError, "minimal: `length` must be positive and finite; received"),
        (pendulum.minimal, {"speed": np.nan}, ValueError, "minimal: `speed` must be finite; received nan."),
        (pendulum.elastic, {"speed": [1.0]}, TypeError, "elastic: `speed` must be a real number; received [1.0]."),
        (pendulum.elastic, {"k": -1.0}, ValueError, "elastic: `k` must be positive and finite; received -1.0."),
        (four_bars.four_bars, {"loops": 0}, ValueError, "four_bars: `loops` must be a positive integer; received 0."),
        (four_bars.four_bars, {"loops": 1.5}, ValueError, "four_bars: `loops` must be a positive integer; received"),
        (four_bars.four_bars, {"loops": np.inf}, ValueError, "four_bars: `loops` must be a positive integer; received"),
        (
            four_bars.four_bars,
            {"loops": "2"},
            ValueError,
            "four_bars: `loops` must be a positive integer; received '2'.",
        ),
    ],
)
def test_bad_arguments(constructor, arguments, error, message):
    with pytest.raises(error, match=re.escape(message)):
        constructor(**arguments)
