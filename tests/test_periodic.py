"""Periodic motions against closed forms, long runs and the literature; their stability and derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hhtjax
from hhtjax.analysis import periodic_solution
from hhtjax.rotation import exp

VAN_DER_POL = 6.6632868593231  # the period for mu = 1


def response(p):
    """Of x'' + 2 zeta x' + x = z to z' = F cos(w t) - a z, complex."""
    w = p["w"]
    return p["F"] / (p["a"] + 1j * w) / (1 - w**2 + 2j * p["zeta"] * w)


def filtered(params):
    """The same by shooting, with the force behind a filter, an internal state."""
    system = hhtjax.System(
        jnp.ones(1),
        lambda q, v, z, t, p: {"x": z["f"] - 2 * p["zeta"] * v["x"] - q["x"]},
        internal=lambda q, v, z, t, p: {"f": p["F"] * jnp.cos(p["w"] * t) - p["a"] * z["f"]},
    )
    start = {"x": jnp.zeros(1)}, {"x": jnp.zeros(1)}, params
    period = 2 * jnp.pi / params["w"]
    return periodic_solution(system, hhtjax.rk4(), *start, z0={"f": jnp.zeros(1)}, period=period, num_steps=400)


def test_a_driven_oscillator_its_multipliers_and_its_derivatives():
    params = {"F": 1.0, "w": 1.3, "zeta": 0.05, "a": 0.4}
    found, H, T = filtered(params), response(params), 2 * np.pi / 1.3
    np.testing.assert_allclose((found.q["x"][0], found.v["x"][0]), (H.real, (1.3j * H).real), atol=1e-8)
    np.testing.assert_allclose(found.z["f"][0], (1 / (0.4 + 1.3j)).real, atol=1e-8)
    assert found.left < 1e-13
    np.testing.assert_allclose(np.abs(found.multipliers), np.exp([-0.05 * T, -0.05 * T, -0.4 * T]), rtol=1e-7)
    assert found.stable

    def amplitude(params):
        found = filtered(params)
        return jnp.sqrt(found.q["x"][0] ** 2 + (found.v["x"][0] / params["w"]) ** 2)

    expected = jax.grad(lambda params: jnp.abs(response(params)))(params)
    for slopes in (jax.grad(amplitude)(params), jax.jacfwd(amplitude)(params)):
        for name in params:
            assert slopes[name] == pytest.approx(float(expected[name]), rel=1e-6)


def duffing(q, v, t, p):
    return 0.3 * jnp.cos(1.4 * t) - 0.1 * v - q - q**3


def test_three_motions_of_a_driven_duffing_oscillator():
    system, T = hhtjax.System(jnp.ones(1), duffing), 2 * np.pi / 1.4

    def of_amplitude(a):
        """Near A cos(w t - phase), by harmonic balance; a = A^2."""
        q, v = a * (1 - 1.4**2 + 0.75 * a) / 0.3, 1.4 * a * 0.1 * 1.4 / 0.3
        return periodic_solution(system, hhtjax.rk4(), jnp.array([q]), jnp.array([v]), period=T, num_steps=200)

    squares = np.sort(np.roots([0.5625, 1.5 * (1 - 1.96), (1 - 1.96) ** 2 + 0.0196, -0.09]).real)
    found = [of_amplitude(a) for a in squares]
    assert max(float(motion.left) for motion in found) < 1e-12
    sizes = [float(jnp.max(jnp.abs(motion.orbit.q))) for motion in found]
    np.testing.assert_allclose(sizes, np.sqrt(squares), rtol=0.03)
    assert [bool(motion.stable) for motion in found] == [True, False, True]
    for motion in found:  # Liouville: the flow shrinks areas by its damping
        assert np.linalg.det(motion.monodromy) == pytest.approx(np.exp(-0.1 * T), rel=1e-7)
    for motion in found[::2]:
        run = hhtjax.simulate(
            system, hhtjax.rk4(), motion.q + 0.02, motion.v, dt=T / 200, num_steps=200 * 80, save_every=200
        )  # fmt: skip
        np.testing.assert_allclose((run.q[-1], run.v[-1]), (motion.q, motion.v), atol=1e-7)


def van_der_pol(q, v, t, p):
    return p["mu"] * (1 - p["bend"] * q**2) * v - q


def test_the_limit_cycle_of_van_der_pol_and_its_equilibrium():
    system = hhtjax.System(jnp.ones(1), van_der_pol)

    def near(q, v, period, **params):
        start = jnp.array([q]), jnp.array([v]), params
        return periodic_solution(system, hhtjax.tsit5(), *start, period=period, num_steps=400, find_period=True)

    found = near(1.5, 1.0, 7.0, mu=1.0, bend=1.0)
    assert found.period == pytest.approx(VAN_DER_POL, abs=1e-9)
    np.testing.assert_allclose(found.multipliers[0], 1, atol=1e-9)
    assert found.multipliers[1].real == pytest.approx(8.5969e-4, rel=1e-4)
    assert found.stable
    np.testing.assert_allclose(jnp.max(found.orbit.q), 2.00862, atol=1e-4)
    with pytest.raises(ValueError, match="an equilibrium was found"):
        near(0.0, 0.0, 6.3, mu=1.0, bend=1.0)


def test_what_has_none_is_named_and_what_is_not_covered_is_refused():
    pushed = hhtjax.System(jnp.ones(1), lambda q, v, t, p: 1 + 0 * q)
    with pytest.raises(ValueError, match=r"none was found: the motion misses its start by .* of its size"):
        periodic_solution(pushed, hhtjax.rk4(), jnp.zeros(1), jnp.zeros(1), period=1.0, num_steps=4)
    with pytest.raises(ValueError, match=r"`period` must be positive and finite; received -1"):
        periodic_solution(pushed, hhtjax.rk4(), jnp.zeros(1), jnp.zeros(1), period=-1.0, num_steps=4)
    held = hhtjax.System(jnp.ones(2), lambda q, v, t, p: -q, constraint=lambda q, t, p: q[:1])
    with pytest.raises(NotImplementedError, match="has constraint: write it in minimal coordinates"):
        periodic_solution(held, hhtjax.hht(), jnp.zeros(2), jnp.zeros(2), period=1.0, num_steps=4)
    top = hhtjax.System(jnp.ones(3), lambda R, Om, t, p: -Om)
    with pytest.raises(NotImplementedError, match="`q0` has rotations"):
        periodic_solution(top, hhtjax.hht(), exp(jnp.zeros(3)), jnp.zeros(3), period=1.0, num_steps=4)
