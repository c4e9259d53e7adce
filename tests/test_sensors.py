"""Sensors: accelerometers against closed forms; delays, offsets, drifts and clocks; all that dense output gives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import check_gradient

import hhtjax
from hhtjax import accelerometer, interpolate, measure
from hhtjax.scenes import dry_oscillator, pendulum

G = np.array([0.0, 0.0, -9.81])
BALL = hhtjax.System(mass=jnp.ones(1), force=lambda q, v, t, params: {"x": 0 * q["x"] + 6 * t})  # x = t^3
TIMES = jnp.array([0.25, 0.5, 0.95])


@pytest.fixture(scope="module")
def cubic():
    zero = {"x": 0.0}
    return hhtjax.simulate(BALL, hhtjax.rk4(), zero, zero, dt=0.1, num_steps=10)


@pytest.fixture(scope="module")
def swing():
    """A pendulum as an angle, l = 0.5."""
    system = hhtjax.System(jnp.ones(1), lambda q, v, t, params: -9.81 / params["l"] * jnp.sin(q))
    return hhtjax.simulate(system, hhtjax.rk4(), jnp.ones(1), jnp.zeros(1), {"l": 0.5}, dt=0.01, num_steps=100)


def on_body(q, t, params):
    return q["x"] + q["R"] @ params + t**2 * jnp.array([0.5, 0.0, 0.0])


def test_an_accelerometer_on_a_body():
    """R^T (a - g) + Om' x r + Om x (Om x r), with a support that accelerates by 1 along x."""
    rng = np.random.default_rng(0)
    x, v, w, Om, A, r = rng.normal(size=(6, 3))
    R = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    R *= np.linalg.det(R)
    sensor = accelerometer(on_body, G, frame=lambda q, t, params: q["R"])
    shown = jax.jit(sensor)({"R": R, "x": x}, {"R": Om, "x": v}, {"R": A, "x": w}, 0.3, r)
    expected = R.T @ (w + np.array([1.0, 0.0, 0.0]) - G) + np.cross(A, r) + np.cross(Om, np.cross(Om, r))
    np.testing.assert_allclose(shown, expected, rtol=1e-12)
    at_rest = accelerometer(lambda q, t, params: q, lambda params: params["g"])
    still = at_rest(jnp.zeros(3), jnp.zeros(3), jnp.zeros(3), 0.0, {"g": jnp.asarray(G)})
    np.testing.assert_allclose(still, -G)
    falling = at_rest(jnp.zeros(3), jnp.ones(3), jnp.asarray(G), 0.0, {"g": jnp.asarray(G)})
    np.testing.assert_allclose(falling, 0.0, atol=1e-15)


def test_an_accelerometer_on_a_pendulum(swing):
    """Along the rod g cos(phi) + l v^2, across nothing: a point of mass has no other support."""

    def position(q, t, params):
        return params["l"] * jnp.array([jnp.sin(q[0]), -jnp.cos(q[0])])

    def frame(q, t, params):
        s, c = jnp.sin(q[0]), jnp.cos(q[0])
        return jnp.array([[c, -s], [s, c]])

    bob, times = accelerometer(position, (0.0, -9.81), frame), jnp.array([[0.0, 0.123], [0.5, 1.0]])
    shown = measure(swing, times, output=bob, params={"l": 0.5})
    assert shown.shape == (2, 2, 2)
    found = interpolate(swing, times)
    np.testing.assert_allclose(shown[..., 0], 0.0, atol=2e-4)
    along = 9.81 * np.cos(found.q[..., 0]) + 0.5 * found.v[..., 0] ** 2
    np.testing.assert_allclose(shown[..., 1], along, rtol=1e-9)


WRONG = {
    "position": ((3, G), {}, TypeError, r"accelerometer: `position` must be a function position\(q, t, params\)"),
    "frame": ((on_body, G, 3), {}, TypeError, r"accelerometer: `frame` must be a function frame\(q, t, params\)"),
    "gravity": ((on_body, 9.81), {}, TypeError, r"accelerometer: `gravity` must be \(d,\) real numbers, or a function"),
    "function": ((on_body, lambda: 1), {}, TypeError, r"accelerometer: `gravity` is called as gravity\(params\)"),
}


@pytest.mark.parametrize("name", WRONG)
def test_bad_accelerometers_are_named(name):
    args, keywords, error, message = WRONG[name]
    with pytest.raises(error, match=f"^{message}"):
        accelerometer(*args, **keywords)


@pytest.mark.parametrize(("gravity", "frame", "message"), [
    (G[:2], None, r"`gravity` must have the shape of what `position` returns, \(3,\), \(d,\); received \(2,\)"),
    (G, lambda q, t, params: jnp.eye(2), r"`frame` must return \(3, 3\); received \(2, 2\)"),
])  # fmt: skip
def test_shapes_of_an_accelerometer_are_named(gravity, frame, message):
    sensor = accelerometer(lambda q, t, params: q, gravity, frame)
    with pytest.raises(ValueError, match=f"accelerometer: {message}"):
        sensor(*jnp.zeros((3, 3)), 0.0, None)


@pytest.mark.slow
def test_flaws_of_a_sensor_and_their_derivatives(cubic):
    """gain (t - delay)^3 + offset + drift t."""

    def shown(gain, offset, drift, delay):
        return measure(cubic, TIMES, gain, {"x": offset}, delay, drift=drift)["x"]

    x = 2.0, 0.25, -0.5, 0.15
    late = TIMES - 0.15
    np.testing.assert_allclose(shown(*x), 2 * late**3 + 0.25 - 0.5 * TIMES, rtol=1e-10)
    for derivative in (jax.jacfwd, jax.jacrev):
        found = jax.jit(derivative(shown, (0, 1, 2, 3)))(*x)
        for y, expected in zip(found, (late**3, jnp.ones(3), TIMES, -6 * late**2), strict=True):
            np.testing.assert_allclose(y, expected, rtol=1e-9, atol=1e-12)

    def felt(x):
        offset, drift, delay, scale = x
        flaws = {"offset": offset, "drift": drift, "delay": delay}
        acceleration = measure(cubic, TIMES, **flaws, output=lambda w, params: params * w["x"], params=scale)
        return jnp.sum(acceleration * jnp.arange(1.0, 4.0))

    slopes = check_gradient(felt, (0.25, -0.5, 0.15, 2.0))
    np.testing.assert_allclose(slopes[2], -12.0 * 6, rtol=1e-8)  # 2 x''' = 12


def test_sensors_have_clocks_of_their_own(cubic):
    def sensors(q, w):
        return {"tape": q["x"], "unit": {"felt": w["x"] * jnp.ones(2), "late": q["x"]}}

    times = {"tape": TIMES, "unit": jnp.array([0.45, 1.0])}
    found = measure(
        cubic, times, output=sensors, delay={"tape": 0.0, "unit": {"felt": 0.2, "late": 0.4}},
        gain={"tape": 2.0, "unit": 1.0}, offset={"tape": 0.0, "unit": {"felt": np.array([1.0, 2.0]), "late": 0.0}},
        drift={"tape": 0.0, "unit": {"felt": np.array([0.0, 10.0]), "late": 0.0}})  # fmt: skip
    np.testing.assert_allclose(found["tape"], 2 * TIMES**3, rtol=1e-10)
    felt = np.array([[1.5 + 1, 1.5 + 2 + 4.5], [4.8 + 1, 4.8 + 2 + 10]])
    np.testing.assert_allclose(found["unit"]["felt"], felt, rtol=1e-8)
    np.testing.assert_allclose(found["unit"]["late"], [0.05**3, 0.6**3], rtol=1e-8)
    at_once = measure(cubic, TIMES, output=sensors)
    np.testing.assert_array_equal(at_once["tape"], found["tape"] / 2)
    with pytest.raises(
        ValueError, match=r"measure: `delay` must be one for all, or one for each part of what is measured"
    ):
        measure(cubic, TIMES, output=sensors, delay={"tap": 0.0, "unit": 0.0})
    with pytest.raises(TypeError, match="measure: `delay` must be a real number; received 'late'"):
        measure(cubic, TIMES, delay={"x": "late"})
    with pytest.raises(TypeError, match="measure: `output` must be a function of some of q, v, w"):
        measure(cubic, TIMES, output=lambda position: position)


@pytest.mark.slow
def test_dense_output_has_accelerations_and_multipliers():
    """Of a pendulum in x, y, whose multiplier is known: m (g cos(phi) + l v^2)/l, but for its sign and scale."""
    scene = pendulum.cartesian()
    errors = []
    for n in (40, 80):
        run = hhtjax.simulate(scene.system, hhtjax.hht(0.0), *scene[2:4], scene.params, dt=1.0 / n, num_steps=n)
        fine = hhtjax.simulate(
            scene.system, hhtjax.hht(0.0), *scene[2:4], scene.params, dt=1.0 / n / 8, num_steps=8 * n
        )
        found = interpolate(run, fine.t)
        middle = slice(4, None, 8)
        errors.append([
            np.max(np.abs(x[middle] - y[middle]))
            for x, y in ((found.acceleration, fine.acceleration), (found.multipliers, fine.multipliers))
        ])  # fmt: skip
        np.testing.assert_allclose(found.multipliers[::8], run.multipliers, rtol=1e-9)
        np.testing.assert_allclose(found.acceleration[::8], run.acceleration, atol=1e-9)
    assert np.all(np.log2(np.array(errors[0]) / np.array(errors[1])) > 1.8)  # the order of the steps themselves


@pytest.mark.slow
def test_dense_output_has_friction():
    """tau = F sign(v) where it slides, the spring's force where it sticks; never a mean of both."""
    scene = dry_oscillator.free()
    run = hhtjax.simulate(scene.system, hhtjax.hht(), *scene[2:4], scene.params, dt=0.02, num_steps=110)
    times = np.linspace(0.001, 2.199, 400)
    found = interpolate(run, times)
    tau, sticking = np.asarray(found.friction)[:, 0], np.asarray(found.sticking)[:, 0]
    sliding = ~sticking
    np.testing.assert_allclose(np.abs(tau[sliding]), 4.0, rtol=1e-9)
    assert np.mean(np.sign(tau[sliding]) == np.sign(found.v[sliding, 0])) > 0.97  # five steps have a reversal within
    assert sticking[-1]
    np.testing.assert_allclose(tau[-20:], -100 * np.asarray(found.q)[-20:, 0], rtol=1e-6)


@pytest.mark.slow
def test_dense_output_beside_an_event_takes_no_mean():
    """The multiplier of a mass on a line, pushed across it until an event: before it 3, behind it -1."""
    system = hhtjax.System(
        jnp.ones(2), lambda q, v, t, p: jnp.stack([jnp.ones_like(t), p["push"]]), lambda q, t, p: q[1:] + 0 * t
    )
    here = hhtjax.Event(lambda q, v, t, p: (0.5 - q[0]) * p["push"], switch=lambda p: p | {"push": -1.0})
    run = hhtjax.simulate(
        system, hhtjax.hht(), jnp.zeros(2), jnp.zeros(2), {"push": 3.0}, dt=0.3, num_steps=5, events=[here]
    )
    run.check()
    assert run.events.t[0] == pytest.approx(1.0, abs=1e-6)
    found = interpolate(run, jnp.array([0.95, 0.999, 1.001, 1.1]))
    np.testing.assert_allclose(found.multipliers[:, 0], [-3.0, -3.0, 1.0, 1.0], atol=1e-9)


@pytest.mark.slow
def test_a_fit_finds_the_delay_and_the_offset_of_an_accelerometer():
    """And the stiffness, from a record with a drift and a clock of its own."""
    spring = hhtjax.System(jnp.ones(1), lambda q, v, t, params: -params["k"] * q - 0.1 * v)
    times = jnp.linspace(0.4, 4.0, 150)
    on_mass = accelerometer(lambda q, t, params: q, jnp.array([0.0]))

    def shown(params):
        run = hhtjax.simulate(spring, hhtjax.rk4(), jnp.ones(1), jnp.zeros(1), params, dt=0.02, num_steps=200)
        flaws = {name: params[name] for name in ("offset", "drift", "delay")}
        return measure(run, times, output=on_mass, params=params, **flaws)[:, 0]

    true = {"k": 9.0, "offset": 0.3, "drift": -0.05, "delay": 0.08}
    record = jax.jit(shown)(true) + 0.01 * np.random.default_rng(1).normal(size=150)
    result = hhtjax.fit(lambda params: shown(params) - record, {"k": 7.5, "offset": 0.0, "drift": 0.0, "delay": 0.02})
    assert result.converged
    for name, value in true.items():
        assert abs(result.params[name] - value) < 4 * result.standard_errors[name]
        assert result.standard_errors[name] < 0.01
