"""Where fits start: from the equation of motion itself, and from shorter parts of a record; and what sensors show."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hhtjax
from hhtjax.scenes import double_pendulum


@pytest.mark.slow
def test_the_equation_of_motion_gives_stiffness_and_damping_without_a_guess():
    """Of a double pendulum with M(q), as a dict whose keys sort otherwise, with 0.1 mrad of noise; 20 times off."""
    scene = double_pendulum.free()
    joints = {"k": jnp.array([40.0, 20.0]), "c": jnp.array([1.0, 0.5])}

    def forces(q, v, t, params):
        angles, rates = (jnp.stack([x["upper"], x["fore"]]) for x in (q, v))
        Q = double_pendulum.force(angles, rates, t, scene.params | params)
        return {"upper": Q[0], "fore": Q[1]}

    def mass(q, params):  # rows in the order of ravel_pytree: fore, upper
        return double_pendulum.mass(jnp.stack([q["upper"], q["fore"]]), scene.params)[::-1, ::-1]

    arm, rest = hhtjax.System(mass, forces), {"upper": 0.0, "fore": 0.0}
    run = hhtjax.simulate(arm, hhtjax.rk4(), rest | {"upper": 0.5}, rest, joints, dt=0.005, num_steps=1000)
    noise = np.random.default_rng(0).normal(size=(2, 1001))
    measured = {name: run.q[name] + 1e-4 * e for name, e in zip(("upper", "fore"), noise, strict=True)}
    residuals = hhtjax.equation_error(arm, measured, 0.005, cutoff=5.0)
    guess = jax.tree.map(lambda x: 0.05 * x, joints)
    found = hhtjax.fit(residuals, guess, covariance=False)
    assert residuals(guess).shape == (1001 - 2 * 40, 2)
    np.testing.assert_allclose(found.params["k"], joints["k"], rtol=0.02)
    np.testing.assert_allclose(found.params["c"], joints["c"], rtol=0.1)


@pytest.mark.slow
def test_the_equation_of_motion_from_samples_at_any_times():
    """A decaying oscillation, its samples 2 to 18 ms apart: as good as from equal distances."""
    spring = hhtjax.System(jnp.ones(1), lambda q, v, t, params: -params["k"] * q - params["c"] * v)
    rng = np.random.default_rng(0)
    times = 0.3 + 0.01 * np.arange(1000) + np.append(0.0, rng.uniform(-0.004, 0.004, 999))

    def estimate(t, **grid):
        q = np.exp(-0.1 * t) * np.cos(3.0 * t)  # k = 9.01, c = 0.2
        residuals = hhtjax.equation_error(spring, q[:, None], cutoff=5.0, **grid)
        return hhtjax.fit(residuals, {"k": 1.0, "c": 1.0}, covariance=False).params

    for found in (estimate(times, times=times), estimate(0.3 + 0.01 * np.arange(1000), dt=0.01, t0=0.3)):
        np.testing.assert_allclose([found["k"], found["c"]], [9.01, 0.2], rtol=0.01)
    with pytest.raises(ValueError, match=r"sampled: `times` must be given without dt and t0; received dt=0.1"):
        hhtjax.equation_error(spring, times[:, None], 0.1, 5.0, times=times)
    with pytest.raises(TypeError, match="`cutoff` must be a real number; received None"):
        hhtjax.equation_error(spring, times[:, None], times=times)


@pytest.mark.slow
def test_sensors_show_a_delayed_signal():
    ball = hhtjax.System(mass=jnp.ones(1), force=lambda q, v, t, params: {"x": 0 * q["x"] + 2.0})
    zero = {"x": 0.0}
    run = hhtjax.simulate(ball, hhtjax.rk4(), zero, zero, dt=0.1, num_steps=10)  # x = t^2
    times = jnp.array([0.1, 0.5, 1.0])
    shown = hhtjax.measure(run, times, gain={"x": 3.0}, offset=0.25, delay=0.2)
    np.testing.assert_allclose(shown["x"], 3 * np.array([0.0, 0.3, 0.8]) ** 2 + 0.25, rtol=1e-12)
    slope = jax.grad(lambda delay: hhtjax.measure(run, times[1], delay=delay)["x"])(0.2)
    assert float(slope) == pytest.approx(-2 * 0.3, rel=1e-9)


def test_a_rate_is_compared_with_that_of_a_first_order_system():
    """y' = -k y + t, with y of a frequency that the cutoff passes; nothing is compiled but the residuals."""
    t = 2.0 + 0.01 * np.arange(400)
    y = np.sin(6.0 * t)
    system = hhtjax.FirstOrderSystem(lambda y, t, params: -params * y + t)
    found = hhtjax.equation_error(system, y[:, None], 0.01, cutoff=4.0, t0=2.0)(3.0)
    inside = t[25:-25]
    np.testing.assert_allclose(found[:, 0], 6 * np.cos(6 * inside) + 3 * np.sin(6 * inside) - inside, atol=0.2)


def test_bad_input_is_named():
    with pytest.raises(TypeError, match="equation_error: `system` must be a System, LinearSystem or First"):
        hhtjax.equation_error(jnp.sin, np.ones((9, 2)), 0.1, cutoff=1.0)
    four_bars = hhtjax.scenes.pendulum.cartesian().system
    with pytest.raises(NotImplementedError, match="equation_error: `system` has a constraint"):
        hhtjax.equation_error(four_bars, np.ones((9, 2)), 0.1, cutoff=1.0)
    spring = hhtjax.System(jnp.ones(1), lambda q, v, t, params: -q)
    with pytest.raises(ValueError, match=r"band_limited_motion: `cutoff` must lie in \(0, 1/\(2 dt\)\]; received 6.0"):
        hhtjax.equation_error(spring, np.ones((9, 1)), 0.1, cutoff=6.0)
    with pytest.raises(ValueError, match=r"equation_error: `values` must have more than 20 samples, .* received 20"):
        hhtjax.equation_error(spring, np.ones((20, 1)), 0.1, cutoff=1.0)
    turned = {"body": np.tile(np.eye(3), (50, 1, 1)), "cart": np.ones((50, 2))}
    for mass in (np.ones(5), lambda q, params: jnp.eye(5)):
        body = hhtjax.System(mass, lambda q, v, t, params: v)
        with pytest.raises(NotImplementedError, match="equation_error: `system` has rotations"):
            hhtjax.equation_error(body, turned, 0.1, cutoff=1.0)(None)
    for mass, many in ((np.ones(11), 1), (np.ones(5), -1)):
        flat = hhtjax.System(mass, lambda q, v, t, params: v)
        values = turned if many > 0 else turned["cart"].repeat(3, axis=1)[:, :5]
        assert hhtjax.equation_error(flat, values, 0.1, cutoff=1.0)(None).shape == (30, mass.size)
    with pytest.raises(TypeError, match="measure: `solution` must be a Solution, from simulate; received ArrayImpl"):
        hhtjax.measure(jnp.ones(3), jnp.ones(3))
    for horizons, problem_at, message in (
        ((), lambda n, before: {}, "`horizons` must hold at least one; received none"),
        (5, lambda n, before: {}, "`horizons` must be a sequence; received 5"),
        ([5], lambda n: {}, r"`problem_at` is called as problem_at\(horizon, before\); .* 1 positional argument \(n\)"),
        ([5], lambda n, before: [jnp.sin], "`problem_at` must return a dict .* received at horizon 5 a list"),
        ([5], lambda n, before: {"weights": 1.0}, "`problem_at` must .* at horizon 5 weights, without residuals"),
        (
            [5],
            lambda n, before: {"residuals": jnp.sin, "params0": 1.0},
            "`problem_at` .* 5 'params0', which is not an argument",
        ),
    ):
        with pytest.raises((TypeError, ValueError), match=f"^fit_progressively: {message}"):
            hhtjax.fit_progressively(problem_at, 1.0, horizons)
