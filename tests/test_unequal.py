"""Runs over steps of given sizes: order 2 whatever they are, derivatives, and what is refused."""

import re
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import zoo
from helpers import ONE, SPRING, ZERO, check_gradient, run

import hhtjax
from hhtjax.scenes import pendulum, top

COUNTS = 100, 1600
FREE = zoo.PROBLEMS["forced double pendulum"]
CARTESIAN, TOP = pendulum.cartesian(), top.minimal()
SCENES = {  # and how long
    "free": (FREE.system, FREE.q0, FREE.v0, FREE.params, 1.0),
    "GGL": (CARTESIAN.system, CARTESIAN.q0, CARTESIAN.v0, CARTESIAN.params, 1.0),
    "rotation": (TOP.system, TOP.q0, TOP.v0, TOP.params, 0.05),
}
FAMILY = {
    **{f"hht({x})": hhtjax.hht(alpha=x, linearize="predictor", start="corrected") for x in (0.0, -0.05, -0.3)},
    **{
        f"rho = {x}": hhtjax.generalized_alpha(x, linearize="predictor", start="corrected")
        for x in (0.0, 0.5, 0.8, 1.0)
    },
}


def jittered(n, duration, seed=0):
    """n step sizes, 0.2 to 1.8 of their mean."""
    x = 1 + 0.8 * np.random.default_rng(seed).uniform(-1, 1, n)
    return duration * x / x.sum()


def uneven(n, duration):
    """Each second one three times as long, for errors without chance."""
    return duration / n * np.resize([0.5, 1.5], n)


def padded(dt, length):
    """More steps behind them, so that any number of them is one program."""
    return np.concatenate([dt, np.full(length - dt.size, dt[-1])])


def vectors(run, row):
    """q, v, acceleration and multipliers at a saved time."""
    parts = run.q, run.v, run.acceleration, run.multipliers
    return [jnp.concatenate([x[row].ravel() for x in jax.tree.leaves(part)]) for part in parts if part is not None]


@partial(jax.jit, static_argnames="scene")
def after(scene, stepper, dt):
    """The first steps, and all: as many as COUNTS."""
    system, q0, v0, params, _ = SCENES[scene]
    run = hhtjax.simulate(system, stepper, q0, v0, params, dt=dt, save_every=COUNTS[0])
    return [vectors(run, n // COUNTS[0]) for n in COUNTS]


@cache
def reference(scene):
    """After many equal steps."""
    system, q0, v0, params, duration = SCENES[scene]
    steps = {"dt": duration / 20_000, "num_steps": 20_000, "save_every": 20_000}
    return vectors(hhtjax.simulate(system, FAMILY["hht(-0.05)"], q0, v0, params, **steps), 1)


def slopes(scene, stepper):
    """Of the errors in q, v, acceleration, multipliers, over three seeds."""
    stepper, duration = zoo.as_data(stepper), SCENES[scene][-1]
    errors = []
    for i, n in enumerate(COUNTS):
        found = [after(scene, stepper, padded(jittered(n, duration, seed), COUNTS[1]))[i] for seed in range(3)]
        pairs = zip(*found, reference(scene), strict=True)
        errors.append([np.mean([np.log(np.max(abs(x - y))) for x in xs]) for *xs, y in pairs])
    return -np.subtract(*errors) / np.log(COUNTS[0] / COUNTS[1])


@pytest.mark.slow
@pytest.mark.parametrize("name", FAMILY)
def test_unequal_steps_keep_order_two(name):
    assert np.all(abs(slopes("free", FAMILY[name]) - 2.0) < 0.15)


@pytest.mark.slow
@pytest.mark.parametrize("name", FAMILY)
def test_with_constraints_the_multipliers_too(name):
    """Undamped, w and L keep the jump of h^2 that each change of the step gives them, which add up as square roots."""
    undamped = name in ("hht(0.0)", "rho = 1.0")
    found = slopes("GGL", FAMILY[name])
    assert np.all(found[:2] > 1.85)
    assert np.all(found[2:] > (1.4 if undamped else 1.85))


@pytest.mark.slow
@pytest.mark.parametrize("kinematics", ["chart", "lie"])
@pytest.mark.parametrize("alpha", [0.0, -0.05, -0.3])
def test_with_rotations(alpha, kinematics):
    assert np.all(
        slopes("rotation", hhtjax.hht(alpha, linearize="predictor", start="corrected", kinematics=kinematics)) > 1.85
    )


@pytest.mark.slow
def test_one_step_between_unequal_samples_keeps_order_two():
    system = hhtjax.System(ONE, lambda q, v, t, params: -4 * jnp.sin(q) + jnp.cos(3 * t))
    stepper, errors = FAMILY["rho = 0.0"], []
    exact = hhtjax.simulate(system, hhtjax.rk4(), ONE, ZERO, dt=1e-3, num_steps=1000).q[-1]
    for n in (50, 400):
        dt = padded(uneven(n, 1.0), 400)
        q = hhtjax.sweep(system, stepper, ONE, ZERO, dts=[np.inf], times=np.cumsum(dt)).q[0, n]
        given = hhtjax.simulate(system, stepper, ONE, ZERO, dt=dt)
        np.testing.assert_allclose(q, given.q[n], rtol=1e-9)
        errors.append(abs(float((q - exact)[0])))
    assert np.log2(errors[0] / errors[1]) / 3 == pytest.approx(2, abs=0.15)


def decay(q, v, z, t, params):
    return -4 * q - z


def rate(q, v, z, t, params):
    return -3.0 * z + v + jnp.sin(t)


@pytest.mark.slow
@pytest.mark.parametrize(
    "arguments",
    [
        (hhtjax.FirstOrderSystem(lambda y, t, params: -y + jnp.cos(3 * t)), np.array([1.0, 2.0])),
        (hhtjax.LinearSystem(np.eye(2), K=np.array([[6.0, -2.0], [-2.0, 4.0]])), np.ones(2), np.zeros(2)),
        (hhtjax.System(ONE, decay, internal=rate), ONE, ZERO),
    ],
    ids=["first order", "linear", "internal"],
)
def test_all_kinds_of_systems(arguments):
    internal = {"z0": ONE} if getattr(arguments[0], "internal", None) is not None else {}
    stepper = hhtjax.hht(alpha=-0.3)
    exact = hhtjax.simulate(arguments[0], hhtjax.rk4(), *arguments[1:], dt=1e-3, num_steps=2000, **internal).q[-1]
    errors = []
    for n in (50, 400):
        found = hhtjax.simulate(arguments[0], stepper, *arguments[1:], dt=padded(uneven(n, 2.0), 400), **internal)
        errors.append(np.max(abs(found.q[n] - exact)))
    assert np.log2(errors[0] / errors[1]) / 3 > 1.85


@pytest.mark.slow
def test_held_inputs_jump_where_they_do():
    """With steps that end on all jumps nothing but the order of the method is left."""
    load = hhtjax.sampled(np.array([0.0, 5.0, -3.0, 2.0]), 0.25, order=0)
    system = hhtjax.System(ONE, lambda q, v, t, params: -4 * q + params(t))
    fine = hhtjax.simulate(system, hhtjax.hht(), ONE, ZERO, load, dt=1 / 8192, num_steps=8192, save_every=8192)
    errors = []
    for n in (8, 32):
        dt = padded(np.concatenate([jittered(n, 0.25, seed) for seed in range(4)]), 128)
        found = hhtjax.simulate(system, hhtjax.hht(), ONE, ZERO, load, dt=dt)
        errors.append(abs(float((found.q[4 * n] - fine.q[-1])[0])))
    assert np.log2(errors[0] / errors[1]) / 2 > 1.85


def test_equal_steps_are_those_of_a_number():
    given = run(stepper=FAMILY["rho = 0.5"], dt=np.full(12, 0.1), num_steps=None, save_every=4)
    number = run(stepper=FAMILY["rho = 0.5"], dt=0.1, num_steps=12, save_every=4)
    for x, y in zip(jax.tree.leaves(given._replace(dt=0)), jax.tree.leaves(number._replace(dt=0)), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-15, atol=1e-15)
    np.testing.assert_array_equal(given.dt, np.full(12, 0.1))


@pytest.mark.slow
def test_derivatives_in_the_steps_forward_and_reverse():
    stepper = hhtjax.generalized_alpha(0.5, linearize="predictor")
    force = lambda q, v, t, params: -params["k"] * jnp.sin(q) + jnp.cos(3 * t)  # noqa: E731
    system = hhtjax.System(ONE, force)

    def loss(x):
        found = hhtjax.simulate(system, stepper, ONE, ZERO, {"k": x["k"]}, dt=x["dt"])
        return jnp.sum(found.q**2) + jnp.sum(found.v) + jnp.sum(found.acceleration**2)

    check_gradient(loss, {"dt": jnp.asarray(jittered(40, 2.0)[:6]), "k": jnp.asarray(4.0)})


@pytest.mark.slow
def test_dense_output_and_extrapolation():
    """Between samples a motion of second degree is exact; Richardson's halved steps are of order 3."""
    ball = hhtjax.System(ONE, lambda q, v, t, params: 0 * q - 9.81)
    fall = hhtjax.simulate(ball, hhtjax.hht(), ZERO, ONE, dt=jittered(12, 1.0), save_every=3)
    t = np.linspace(0, 1, 7)
    np.testing.assert_allclose(hhtjax.interpolate(fall, t).q[:, 0], t - 4.905 * t**2, atol=1e-13)
    errors = []
    for n in (20, 80):
        dt = padded(uneven(n, 1.0), 80)
        found = hhtjax.simulate(SPRING, hhtjax.hht(0.0), ONE, ZERO, dt=dt, save_every=20, extrapolate=2)
        assert found.dt.shape == (80,)
        errors.append(abs(float(found.q[n // 20, 0]) - np.cos(2.0)))
    assert np.log2(errors[0] / errors[1]) / 2 > 2.85


def test_a_failure_is_named_by_step_and_time():
    broken = hhtjax.System(ONE, lambda q, v, t, params: jnp.where(t > 0.55, jnp.nan, -q))
    found = hhtjax.simulate(broken, hhtjax.hht(), ONE, ZERO, dt=np.array([0.1, 0.2, 0.2, 0.1, 0.3, 0.1]), save_every=2)
    with pytest.raises(hhtjax.SimulationError, match=re.escape("step 4 (to t = 0.6) failed")):
        found.check()
    traced = jax.jit(lambda dt: run(dt=dt, num_steps=None))(np.array([0.1, -0.2, 0.1]))
    assert np.isfinite(traced.q[:, 0]).tolist() == [True, True, False, False]
    with pytest.raises(hhtjax.SimulationError, match=re.escape("`dt` must be positive and finite; it was -0.2")):
        traced.check()


WRONG = {
    "negative": ({"dt": [0.1, -0.2]}, "`dt` must be positive and finite; received dt[1] = -0.2."),
    "not finite": ({"dt": [np.nan, 0.1]}, "`dt` must be positive and finite; received dt[0] = nan."),
    "two axes": ({"dt": np.ones((2, 2))}, "`dt` must be a number, or of shape (N,), one step or more; received (2, 2)"),
    "none": ({"dt": []}, "`dt` must be a number, or of shape (N,), one step or more; received (0,)."),
    "text": ({"dt": ["a"]}, "`dt` must be real numbers; received"),
    "other number": (
        {"dt": [0.1], "num_steps": 2},
        "`num_steps` must be the length of dt, 1, or left out; received 2.",
    ),
    "no number": ({"dt": 0.1}, "`num_steps` must be a positive integer; received None."),
    "multistep": ({"dt": [0.1], "stepper": hhtjax.park()}, "Park needs steps of one size: give `dt` as a number"),
}


@pytest.mark.parametrize("name", WRONG)
def test_bad_steps_are_named(name):
    changed, message = WRONG[name]
    with pytest.raises((ValueError, TypeError, NotImplementedError), match=re.escape(f"simulate: {message}")):
        run(**{"num_steps": None} | changed)
