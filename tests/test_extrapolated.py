"""The extrapolated mid-point rule: orders, constraints, rotations, error control, samples, derivatives, flags."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import hhtjax
from hhtjax.scenes import double_pendulum, pendulum, top

STEPPER = hhtjax.extrapolated(levels=3)
HELD = pendulum.cartesian()


@cache
def angle(duration):
    """Of the pendulum from its lowest point, by SciPy, in one coordinate and without constraints."""
    p = HELD.params
    start = [0.0, float(HELD.v0[0]) / p["l"]]
    rate = lambda t, y: [y[1], -p["g"] / p["l"] * np.sin(y[0])]  # noqa: E731
    return solve_ivp(rate, (0, duration), start, "DOP853", rtol=1e-13, atol=1e-14).y[0, -1]


def place(duration):
    """x and y."""
    at = angle(duration)
    return HELD.params["l"] * np.array([np.sin(at), -np.cos(at)])


@cache
def turned():
    """The rotation of the top after 0.05 s, as nine numbers, by SciPy."""
    scene = top.minimal()
    flat = hhtjax.interop.flat_ode(scene.system, scene.q0, scene.v0)
    rate = jax.jit(lambda t, y: flat.rate(t, y, scene.params))
    return solve_ivp(rate, (0, 0.05), flat.y0, "DOP853", rtol=1e-13, atol=1e-14).y[:9, -1].reshape(3, 3)


def end(scene, stepper, duration, steps):
    """The run, in so many equal steps."""
    dt = duration / steps
    return hhtjax.simulate(scene.system, stepper, scene.q0, scene.v0, scene.params, dt=dt, num_steps=steps)


@pytest.mark.parametrize("levels", [2, 3, 4])
def test_order_with_a_constraint(levels):
    stepper = hhtjax.extrapolated(levels)
    runs = [end(HELD, stepper, 1.0, n) for n in (16, 32)]
    errors = [np.abs(run.q[-1] - place(1.0)).max() for run in runs]
    assert abs(np.log2(errors[0] / errors[1]) - stepper.order) < 0.15
    assert runs[1].info.constraint.max() < 1e-5
    assert runs[1].info.constraint_rate.max() < 1e-9
    assert (runs[1].info.dependent_row == -1).all()


@pytest.mark.parametrize("scene", [top.minimal(), top.constrained()], ids=["free", "held"])
def test_order_of_rotations(scene):
    runs = [end(scene, STEPPER, 0.05, n) for n in (16, 32)]
    R = [run.q["R"][-1] if isinstance(run.q, dict) else run.q[-1] for run in runs]
    errors = [np.abs(x - turned()).max() for x in R]
    assert abs(np.log2(errors[0] / errors[1]) - 5) < 0.3
    assert np.abs(R[1].T @ R[1] - np.eye(3)).max() < 1e-14


def test_multipliers_are_those_of_the_motion():
    run = end(HELD, STEPPER, 1.0, 64)
    p, q, v = HELD.params, run.q, run.v
    tension = p["m"] * (jnp.sum(v**2, axis=1) - p["g"] * q[:, 1]) / p["l"]  # m v^2/l - m g y/l
    np.testing.assert_allclose(-p["l"] * run.multipliers[:, 0], tension, rtol=1e-9)


def controlled(params, tolerance=1e-8, scene=HELD, times=(0.3, 0.77, 1.0), **options):
    dt = hhtjax.adaptive(tolerance, tolerance)
    return hhtjax.simulate(
        scene.system, hhtjax.extrapolated(), scene.q0, scene.v0, params, dt=dt, times=np.array(times), **options
    )


@pytest.mark.parametrize("tolerance", [1e-5, 1e-8])
def test_error_control_keeps_the_tolerance_at_each_of_the_times(tolerance):
    run = controlled(HELD.params, tolerance)
    run.check()
    found = np.array([place(t) for t in (0.3, 0.77, 1.0)])
    assert np.abs(run.q[1:] - found).max() < 5 * tolerance
    ends = np.cumsum(run.steps.dt[: int(run.steps.accepted)])
    assert all(np.abs(ends - t).min() < 1e-12 for t in (0.3, 0.77, 1.0))


def test_steps_are_few():
    """Ten digits of the stiff double pendulum; `rowda` takes thousands."""
    scene = double_pendulum.stiff()
    run = controlled(scene.params, 1e-9, scene, (1.0,))
    assert int(run.steps.accepted) < 100
    assert int(run.steps.rejected) <= 3


def test_derivatives():
    """Forward, reverse and central differences, over the steps that were accepted."""

    def last(length):
        scene = pendulum.cartesian(length=0.5)
        return controlled(HELD.params | {"m": length, "g": 9.81 * length}, 1e-7, scene, (0.4,)).q[-1, 0]

    x, h = 1.1, 1e-4
    forward, reverse = (float(f(last)(x)) for f in (jax.jacfwd, jax.grad))
    both = [float(last(x + s)) for s in (h, -h)]
    assert forward == pytest.approx(reverse, rel=1e-10)
    assert forward == pytest.approx((both[0] - both[1]) / (2 * h), rel=1e-4)


def test_batch_is_what_its_members_are():
    masses = jnp.array([0.8, 1.3])
    one = partial(controlled, tolerance=1e-6)
    weights = {"m": HELD.params["m"], "l": HELD.params["l"]}
    both = jax.vmap(lambda g: one(HELD.params | weights | {"g": 9.81 * g}).q)(masses)
    single = one(HELD.params | weights | {"g": 9.81 * 1.3}).q
    np.testing.assert_allclose(both[1], single, atol=1e-9)


def test_sweep_lands_too():
    dts, times = hhtjax.adaptive(np.array([1e-6, 1e-8]), 1e-8), np.array([0.3, 1.0])
    start = HELD.system, hhtjax.extrapolated(), HELD.q0, HELD.v0, HELD.params
    runs = hhtjax.sweep(*start, dts=dts, times=times)
    assert np.abs(runs.q[1, 1:] - np.array([place(t) for t in times])).max() < 5e-8


def test_levels_are_checked():
    with pytest.raises(ValueError, match="levels"):
        hhtjax.extrapolated(levels=1)
    scene = double_pendulum.stopped()
    start = scene.system, hhtjax.extrapolated(), scene.q0, scene.v0, scene.params
    with pytest.raises(NotImplementedError, match="Extrapolated"):
        hhtjax.simulate(*start, dt=1e-3, num_steps=4, events=scene.events)
