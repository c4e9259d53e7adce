"""First-order systems y' = f(y, t): closed forms, orders, gradients, batches, dtypes, dense output, bad input."""

import re
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import check_gradient, tight
from scipy.integrate import solve_ivp
from zoo import STEPPERS, Problem, as_data, end

import hhtjax

# two species and an input: nonlinear, coupled, with explicit time; a pytree whose keys sort differently
Y0 = {"prey": 1.0, "hunter": jnp.array([2.0])}
RATE = 2.0
DURATION = 2.0


def rate(y, t, params):
    prey, hunter = y["prey"], y["hunter"]
    return {"prey": jnp.cos(3 * t) - params * prey * hunter[0], "hunter": 0.5 * jnp.sin(hunter * prey)}


def autonomous(y, t, params):
    return rate(y, 0.3, params)


SYSTEM = hhtjax.FirstOrderSystem(rate)
AUTONOMOUS = hhtjax.FirstOrderSystem(autonomous)
DECAY = hhtjax.FirstOrderSystem(lambda y, t, params: -params * y)


def run(system, stepper, num_steps, **options):
    return hhtjax.simulate(system, stepper, Y0, params=RATE, dt=DURATION / num_steps, num_steps=num_steps, **options)


@cache
def reference(system):
    @jax.jit
    def f(t, y):
        out = system.rate({"prey": y[0], "hunter": y[1:]}, t, RATE)
        return jnp.append(out["hunter"], out["prey"])[::-1]

    return solve_ivp(f, (0, DURATION), [1.0, 2.0], "DOP853", rtol=1e-11, atol=1e-12).y[:, -1]


def order(system, stepper, steps=(400, 800)):
    expected = reference(system)
    errors = []
    for n in steps:
        state, converged = end(Problem(system, RATE, Y0, None, DURATION), as_data(stepper), n)
        assert converged
        errors.append(np.hypot(state.q["prey"] - expected[0], state.q["hunter"][0] - expected[1]))
    return np.log2(errors[0] / errors[1])


ORDERS = {name: stepper.order for name, stepper in STEPPERS.items()}
ORDERS["houbolt"] = 3  # its formula for the velocity alone


@pytest.mark.slow
@pytest.mark.parametrize("name", [x for x in STEPPERS if ORDERS[x] < 5])  # dopri5: h^6.6 here; see test_adaptive.py
def test_order_with_explicit_time(name):
    steps = (2000, 4000) if name == "implicit_euler" else (400, 800)  # it starts with errors that cancel
    assert order(SYSTEM, STEPPERS[name], steps) == pytest.approx(ORDERS[name], abs=0.15)


@pytest.mark.parametrize(("alpha", "expected"), [(0.0, 2), (-0.05, 1), (-0.3, 1)])
def test_kims_step_is_of_order_two_only_where_theta_is_one_half(alpha, expected):
    assert hhtjax.kim_hht(alpha).order == expected
    assert order(AUTONOMOUS, hhtjax.kim_hht(alpha), (2000, 4000)) == pytest.approx(expected, abs=0.15)


def test_kims_step_is_of_order_one_with_explicit_time_even_there():
    assert order(SYSTEM, hhtjax.kim_hht(0.0)) == pytest.approx(1, abs=0.15)


def test_conventional_hht_keeps_order_two_without_explicit_time():
    assert order(AUTONOMOUS, hhtjax.conventional_hht(-0.3)) == pytest.approx(2, abs=0.15)


@pytest.mark.parametrize("alpha", [0.0, -0.05, -0.3])
@pytest.mark.parametrize("dt", [1e-4, 1e-3, 1e-2, 1e-1])
def test_kims_step_on_the_test_equation(alpha, dt):
    """y_k = (1 + z/(1 - theta z))^k with z = -1000 h: Kim et al., Eq. 18."""
    path = hhtjax.simulate(DECAY, hhtjax.kim_hht(jnp.asarray(alpha)), jnp.ones(1), params=1000.0, dt=dt, num_steps=20)
    theta, z = (0.5 - alpha) * (1 + alpha), -1000 * dt
    np.testing.assert_allclose(path.q[:, 0], (1 + z / (1 - theta * z)) ** np.arange(21), rtol=1e-12)
    assert path.acceleration is None


@pytest.mark.parametrize("linearize", ["predictor", "held", "state", "auto"])
def test_a_linear_equation_is_solved_by_one_linearisation(linearize):
    """All points of linearisation give the converged step, up to the refreshed rate of the "state" form."""
    one, converged = (
        hhtjax.simulate(DECAY, stepper, jnp.ones(1), params=30.0, dt=0.1, num_steps=10)
        for stepper in (hhtjax.hht(-0.2, linearize=linearize), hhtjax.hht(-0.2, iterations=None, tolerance=1e-14))
    )
    np.testing.assert_allclose(one.q, converged.q, rtol=1e-12)
    np.testing.assert_allclose(one.v, -30 * one.q, rtol=1e-12)


SOME = ("hht auto", "hht converged", "kim_hht", "conventional_hht", "implicit_euler", "rk4")  # a family each


@pytest.mark.slow
@pytest.mark.parametrize("name", SOME)
def test_gradients(name):
    def loss(arguments):
        params, y0, dt, t0 = arguments
        path = hhtjax.simulate(SYSTEM, tight(STEPPERS[name]), y0, params=params, dt=dt, t0=t0, num_steps=30)
        return jnp.sum(path.q["hunter"] ** 2) + 0.3 * jnp.sum(path.q["prey"] ** 2) + 0.1 * jnp.sum(path.v["prey"] ** 2)

    check_gradient(loss, (RATE, Y0, 0.03, 0.1))


@pytest.mark.slow
@pytest.mark.parametrize("name", SOME)
def test_own_loop_equals_simulate_and_vmap_equals_loop(name):
    stepper = STEPPERS[name]

    def last(k, dt):
        path = hhtjax.simulate(SYSTEM, stepper, Y0, params=k, dt=dt, num_steps=3)
        return path.q["prey"][-1], path.v["hunter"][-1], path.failure.step

    rates, dts = jnp.array([0.5, 2.0, 4.0]), jnp.array([0.01, 0.05, 0.1])
    prey, slope, failures = jax.jit(jax.vmap(last))(rates, dts)
    assert not failures.any()
    step = jax.jit(partial(stepper.step, SYSTEM))
    for i in range(3):
        state = stepper.init(SYSTEM, Y0, None, rates[i], dts[i])
        for _ in range(3):
            state, _ = step(state, rates[i], dts[i])
        assert state.w is None
        np.testing.assert_allclose(prey[i], state.q["prey"], rtol=1e-11)
        np.testing.assert_allclose(slope[i], state.v["hunter"], rtol=1e-9)


def test_float32_is_kept():
    y0 = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), Y0)
    with pytest.warns(hhtjax.PrecisionWarning):
        path = hhtjax.simulate(SYSTEM, hhtjax.hht(), y0, params=jnp.float32(2), dt=0.01, num_steps=10)
    assert {x.dtype for x in jax.tree.leaves((path.q, path.v, path.t))} == {jnp.dtype("float32")}


def test_newton_does_not_loosen_by_what_y_piled_up():
    """The integral of a decayed component, 1e16, must not enter the stopping rule of the other one."""
    system = hhtjax.FirstOrderSystem(
        lambda y, t, params: jnp.array(
            [20.0 * jnp.cos(5.0 * t) - 50.0 * jnp.sin(y[0]) * (1 + y[0] ** 2), -100.0 * y[1]]
        )
    )
    stepper = hhtjax.implicit_euler(tolerance=1e-30)

    def first(other):
        path = hhtjax.simulate(system, stepper, jnp.array([0.5, other]), dt=0.02, num_steps=200, save_every=200)
        path.check()
        return float(path.q[-1, 0])

    assert first(1e18) == pytest.approx(first(0.0), abs=1e-11)


@pytest.mark.slow
def test_dense_output_is_of_order_four():
    def error(n):
        path = run(SYSTEM, hhtjax.rk4(), 8 * n, save_every=8)
        times = jnp.linspace(0.0, DURATION, 101)
        fine = run(SYSTEM, hhtjax.rk4(), 1600, save_every=16)
        dense = hhtjax.interpolate(path, times)
        assert dense.v is None
        return np.max(np.abs(dense.q["prey"] - fine.q["prey"]))

    assert np.log2(error(10) / error(20)) == pytest.approx(4, abs=0.3)


def simulate(system, y0=(1.0, 1.0), v0=None):
    return lambda: hhtjax.simulate(system, hhtjax.hht(), jnp.array(y0), v0, 1.0, dt=0.1, num_steps=1)


def returning(result):
    return hhtjax.FirstOrderSystem(lambda y, t, params: result)


second_order = hhtjax.System(jnp.ones(2), lambda q, v, t, params: -q)
BAD = [
    (TypeError, "FirstOrderSystem: `rate` must be a function rate(y, t, params)", lambda: hhtjax.FirstOrderSystem(3)),
    (ValueError, "simulate: `v0` must be left out for a FirstOrderSystem; received 1.0", simulate(DECAY, v0=1.0)),
    (ValueError, "simulate: `rate` must return a pytree like q0", simulate(returning(jnp.ones(3)))),
    (
        TypeError,
        "simulate: `rate` returned float32 for a state of",
        simulate(returning(jnp.ones(2, "float32"))),
    ),
    (ValueError, "simulate: `q0` must be finite", simulate(DECAY, (jnp.nan, 1.0))),
    (ValueError, "simulate: `v0` must be a pytree structured like q0", simulate(second_order)),
    (TypeError, "conventional_hht: `fictive_time` must be True or False", lambda: hhtjax.conventional_hht(0.0, 1)),
    (ValueError, "conventional_hht: `alpha` must lie in [-1/3, 0]", lambda: hhtjax.conventional_hht(0.1)),
    (ValueError, "conventional_hht: `tolerance` must be positive", lambda: hhtjax.conventional_hht(tolerance=0)),
]


@pytest.mark.parametrize(("kind", "message", "call"), BAD, ids=lambda x: x if isinstance(x, str) else "")
def test_bad_input(kind, message, call):
    with pytest.raises(kind, match=re.escape(message)):
        call()


def test_a_blow_up_is_reported():
    path = hhtjax.simulate(
        hhtjax.FirstOrderSystem(lambda y, t, params: y**2), hhtjax.rk4(), jnp.ones(1), dt=0.05, num_steps=40
    )
    with pytest.raises(hhtjax.SimulationError, match="failed: y' is not finite"):
        path.check()
