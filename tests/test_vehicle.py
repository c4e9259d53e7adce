"""The vehicle: equilibrium, natural frequencies, energy, symmetry, its road, gradients, and SciPy."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import check_gradient
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from scipy.linalg import eigh
from scipy.signal import welch

import hhtjax
from hhtjax.scenes import vehicle

FLAT = vehicle.ride(roughness=0.0, bump=0.0, duration=1.0)
ROUGH = vehicle.ride(duration=1.0)
NON_ITERATIVE = hhtjax.hht(alpha=-0.05, linearize="predictor")


Q0 = jnp.array([0.05, 0.02, -0.03, 0.01, 0.0, 0.0, -0.01])


def drive(scene, stepper=NON_ITERATIVE, num_steps=200, q0=None):
    """The scene from start to end, saved a hundred times."""
    return hhtjax.simulate(
        scene.system,
        stepper,
        scene.q0 if q0 is None else q0,
        scene.v0,
        scene.params,
        dt=scene.duration / num_steps,
        num_steps=num_steps,
        save_every=num_steps // 100,
    )


def stiffness(params):
    """K at rest, assembled from the elongation of each of the eight springs as a row over q."""
    K = np.zeros((7, 7))
    for i in range(4):
        suspension, tyre = np.zeros(7), np.zeros(7)
        suspension[:3] = -1.0, params["x"][i], -params["y"][i]
        suspension[3 + i] = tyre[3 + i] = 1.0
        K += params["k"][i] * np.outer(suspension, suspension) + params["k_tyre"][i] * np.outer(tyre, tyre)
    return K


def potential(q, params):
    """Energy of the springs and tyres on flat road."""
    d = q[3:] - vehicle.corner_heights(q, params)
    return jnp.sum(params["k"] * d**2 / 2 + params["k3"] * d**4 / 4 + params["k_tyre"] * q[3:] ** 2 / 2)


@pytest.mark.slow
def test_at_rest_on_flat_road_it_stays():
    path = drive(FLAT)
    assert np.all(np.asarray(path.q) == 0)
    assert np.all(np.asarray(path.v) == 0)


def test_stiffness_and_natural_frequencies():
    system, params = FLAT.system, FLAT.params
    K = -np.asarray(jax.jit(jax.jacfwd(system.force))(FLAT.q0, FLAT.v0, 0.0, params))
    assert np.max(np.abs(K - stiffness(params))) < 1e-9
    squares, modes = eigh(K, np.diag(system.mass(FLAT.q0, params)))
    hertz = np.sqrt(squares) / (2 * np.pi)
    assert np.all((hertz[:3] > 1) & (hertz[:3] < 2))  # heave, pitch, roll
    assert np.all((hertz[3:] > 10) & (hertz[3:] < 15))  # wheel hop
    assert np.all(np.abs(modes[3:, 3:]).max(axis=0) > 10 * np.abs(modes[:3, 3:]).max(axis=0))


def test_damper():
    """Slope c at rest, (1 + r)/(1 - r) times stronger in fast rebound than in fast bump, growing with the rate."""
    params = {**FLAT.params, "c": 2000.0}
    assert float(jax.grad(vehicle.damper)(0.0, params)) == pytest.approx(2000.0, rel=1e-14)
    assert -float(vehicle.damper(-1e4, params) / vehicle.damper(1e4, params)) == pytest.approx(1.4 / 0.6, rel=1e-8)
    assert np.all(np.diff(vehicle.damper(jnp.linspace(-3, 3, 100), params)) > 0)


def test_force_without_dampers_is_minus_the_gradient_of_the_potential():
    params = {**FLAT.params, "c": jnp.zeros(4)}
    Q, slope = jax.jit(lambda q: (vehicle.force(q, jnp.ones(7), 0.0, params), jax.grad(potential)(q, params)))(Q0)
    assert np.allclose(Q, -slope, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("damped", [False, True])
def test_energy_is_conserved_and_dampers_take_it_out(damped):
    scene = FLAT if damped else FLAT._replace(params={**FLAT.params, "c": jnp.zeros(4)})
    path = drive(scene, hhtjax.rk4(), 1000, Q0)
    M = np.asarray(vehicle.mass(Q0, scene.params))
    energy = np.sum(M * np.asarray(path.v) ** 2, axis=1) / 2 + jax.vmap(potential, (0, None))(path.q, scene.params)
    if damped:
        assert np.all(np.diff(energy) < 0)
        assert energy[-1] < 0.05 * energy[0]
    else:
        assert np.max(np.abs(energy / energy[0] - 1)) < 1e-5


@pytest.mark.slow
def test_symmetric_road_gives_no_roll_and_a_rough_one_does():
    bump = vehicle.ride(roughness=0.0, duration=1.0)
    path = drive(bump)
    assert np.max(np.abs(path.q[:, 0])) > 5e-3
    assert np.max(np.abs(path.q[:, 2])) < 1e-12
    assert np.max(np.abs(path.q[:, 3] - path.q[:, 4])) < 1e-12
    assert np.max(np.abs(drive(ROUGH).q[:, 2])) > 1e-4


def test_front_wheels_first_and_the_nose_comes_up():
    """Pitch is positive nose down; the bump begins at half the duration."""
    path = drive(vehicle.ride(roughness=0.0, duration=1.0))
    t, q = np.asarray(path.t), np.asarray(path.q)
    on_bump = (t > 0.5) & (t < 0.7)
    assert np.max(np.abs(q[t <= 0.5])) < 1e-12
    assert np.max(q[on_bump, 3]) > 0.04
    assert np.max(np.abs(q[on_bump, 5])) < 5e-3
    assert np.min(q[on_bump, 1]) < -5e-3
    assert np.max(q[on_bump, 1]) < 1e-6


def test_a_raised_left_side_is_positive_roll():
    heights = np.broadcast_to([0.02, 0.0, 0.02, 0.0], (1001, 4))
    params = {**FLAT.params, "road": hhtjax.sampled(heights, vehicle.SAMPLING_PERIOD)}
    end = drive(FLAT._replace(params=params, duration=5.0)).q[-1]
    assert np.allclose(end, [0.01, 0.0, 0.02 / 1.5, 0.02, 0.0, 0.02, 0.0], atol=1e-5)


@pytest.mark.slow
def test_ride_converges_to_scipy():
    """To the equations written in NumPy, road included."""
    p = {name: np.asarray(x) for name, x in ROUGH.params.items() if name != "road"}
    samples = vehicle.road(10.0, 1.0)
    surface = CubicSpline(1e-3 * np.arange(len(samples)), samples)
    corners = np.stack([np.ones(4), -p["x"], p["y"]], axis=1)

    def rate(t, y):
        q, v = y[:7], y[7:]
        d, rate = q[3:] - corners @ q[:3], v[3:] - corners @ v[:3]
        s = rate / np.hypot(p["v0"], rate)
        S = p["k"] * d + p["k3"] * d**3 + p["c"] * p["v0"] * (s - p["r"] * s**2)
        return np.concatenate([v, corners.T @ S / p["body"], (p["k_tyre"] * (surface(t) - q[3:]) - S) / p["wheel"]])

    times = np.linspace(0, 1, 101)
    exact = solve_ivp(rate, (0, 1), np.zeros(14), "DOP853", times, rtol=1e-9, atol=1e-11).y[:7].T

    def error_mm(stepper, num_steps):
        return 1e3 * np.max(np.abs(drive(ROUGH, stepper, num_steps).q - exact))

    assert error_mm(hhtjax.rk4(), 1000) < 1e-4
    coarse, fine = error_mm(NON_ITERATIVE, 200), error_mm(NON_ITERATIVE, 800)
    assert coarse < 1
    assert np.log2(coarse / fine) / 2 == pytest.approx(2, abs=0.15)


@pytest.mark.slow
def test_gradient_with_respect_to_tyres_and_dampers():
    """Up to the bump and over it, in few enough steps to compile quickly."""
    scene = vehicle.ride(duration=0.3)

    def loss(numbers):
        params = {**scene.params, **{name: jnp.full(4, x) for name, x in numbers.items()}}
        path = hhtjax.simulate(scene.system, NON_ITERATIVE, scene.q0, scene.v0, params, dt=1e-2, num_steps=30)
        return 1e4 * jnp.sum(path.q**2) + jnp.sum(path.acceleration**2)

    check_gradient(loss, {"k_tyre": 200e3, "c": 2000.0})


def test_single_precision_stays():
    params, q = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), (FLAT.params, FLAT.q0))
    assert jax.eval_shape(vehicle.force, q, q, q[0], params).dtype == jnp.float32
    assert jax.eval_shape(vehicle.mass, q, params).dtype == jnp.float32


@pytest.mark.parametrize("roughness", [16e-6, 64e-6])
def test_road_has_the_spectral_density_of_its_class(roughness):
    """Welch's estimate, octave by octave, where its windows resolve the waves; and none above the shortest."""
    heights = vehicle.road(20.0, 60.0, roughness, bump=0.0, seed=3)[1000:]
    n, density = welch(heights, fs=1 / 0.02, nperseg=8192, axis=0, detrend=False)  # 1/m, m^3
    for lowest in 0.05, 0.1, 0.2, 0.4, 0.8:
        octave = (n >= lowest) & (n < 2 * lowest)
        level = np.mean(density[octave] * (n[octave, None] / 0.1) ** 2, axis=0)
        assert np.allclose(level, roughness, rtol=0.25), lowest
    assert np.max(density[n > 3.0]) < 1e-3 * np.max(density[(n > 2.5) & (n < 2.8)])


def test_road_tracks_differ_and_the_rear_wheels_follow():
    speed, wheelbase = 10.0, 2.7
    heights = vehicle.road(speed, 4.0, wheelbase=wheelbase)
    delay = round(wheelbase / speed / vehicle.SAMPLING_PERIOD)
    assert heights.shape == (4001, 4)
    assert np.allclose(heights[delay:, 2:], heights[:-delay, :2], atol=1e-12)
    assert np.all(heights[:delay, 2:] == 0)
    left, right = vehicle.road(speed, 100.0, bump=0.0)[:, :2].T
    assert np.std(left) == pytest.approx(np.std(right), rel=0.2)
    assert abs(np.corrcoef(left, right)[0, 1]) < 0.5
    assert not np.allclose(heights, vehicle.road(speed, 4.0, seed=1))
    assert np.all(heights == vehicle.road(speed, 4.0, seed=0))


def test_road_is_smooth_at_its_sampling_period():
    """Every other sample is enough for a cubic spline to find those between."""
    heights = vehicle.road(20.0, 4.0)
    t = np.arange(len(heights))
    between = CubicSpline(t[::2], heights[::2])(t[1::2])
    assert np.max(np.abs(between - heights[1::2])) < 1e-5


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"speed": 0.5}, ValueError, "road: `speed` must lie in [1, 40] m/s; received 0.5."),
        ({"speed": "10"}, TypeError, "road: `speed` must be a real number; received '10'."),
        (
            {"duration": 2e-3},
            ValueError,
            "road: `duration` must be finite, at least 3 sampling periods; received 0.002.",
        ),
        ({"duration": float("inf")}, ValueError, "road: `duration` must be finite"),
        ({"roughness": -1e-6}, ValueError, "road: `roughness` must be finite and not negative; received -1e-06."),
        ({"bump": float("nan")}, ValueError, "road: `bump` must be finite; received nan."),
        ({"bump": None}, TypeError, "road: `bump` must be a real number; received None."),
    ],
)
def test_bad_arguments(arguments, error, message):
    for function in (vehicle.ride, vehicle.road):
        with pytest.raises(error, match=re.escape(message)):
            function(**{"speed": 10.0, "duration": 1.0, **arguments})


def test_bad_wheelbase():
    with pytest.raises(ValueError, match=re.escape("road: `wheelbase` must be positive and finite; received 0.0.")):
        vehicle.road(10.0, 1.0, wheelbase=0.0)
