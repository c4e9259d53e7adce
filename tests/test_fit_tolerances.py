"""Fits through runs under error control: steps frozen at one point, chosen again, until the estimates stay."""

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import zoo
from helpers import ONE, ZERO

import hhtjax
from hhtjax.identification.problem import solve
from hhtjax.runs.frozen_steps import with_steps_for


def force(q, v, t, p):
    return -p["k"] * q - p["k3"] * q**3 - 0.2 * v + 3 * jnp.cos(2 * t)


DUFFING = hhtjax.System(ONE, force)
TIMES = np.linspace(0, 5, 101)[1:]
TRUE, GUESS = {"k": 4.0, "k3": 2.0}, {"k": 5.0, "k3": 1.5}
STEPPER = hhtjax.dopri5()
LIGHT = hhtjax.hht(linearize="predictor")  # half the program of "auto"


def position(params, q0, rtol=1e-4, stepper: Any = STEPPER, system=DUFFING):
    dt = hhtjax.adaptive(rtol, 1e-3 * rtol, max_steps=1000)
    return hhtjax.simulate(system, stepper, q0, ZERO, params, dt=dt, times=TIMES).q[1:]


@pytest.fixture(scope="module")
def measured():
    return position(TRUE, ONE, 1e-9) + 1e-3 * np.random.default_rng(0).standard_normal((TIMES.size, 1))


@pytest.fixture(scope="module")
def residuals(measured):
    """By name of the stepper; a fit of each is compiled once."""
    steppers = {"hht": LIGHT, "dopri5": STEPPER}
    return {name: lambda p, x=x: position(p, ONE, stepper=x) - measured for name, x in steppers.items()}


def by_array(x, q0: Any = ONE, rtol=1e-3):
    return position({"k": x[0], "k3": x[1]}, q0, rtol, LIGHT)


@jax.jit
def by_closure(x):
    system = hhtjax.System(ONE, lambda q, v, t, k: force(q, v, t, {"k": k, "k3": x[1]}))
    return position(x[0], ONE, 1e-3, LIGHT, system)


def in_sweep(x):
    rtol = np.array([1e-2, 1e-3])
    dts, params = hhtjax.adaptive(rtol, 1e-3 * rtol, max_steps=1000), {"k": x[0], "k3": x[1]}
    return hhtjax.sweep(DUFFING, LIGHT, ONE, ZERO, params, dts=dts, times=TIMES).q[:, 1:]


FORMS = {  # of residuals, and the tolerances of their runs
    "alone": (by_array, [1e-3]),
    "jit": (by_closure, [1e-3]),
    "vmap": (lambda x: jax.vmap(lambda s: by_array(x, s * ONE))(jnp.array([1.0, 1.0])), [1e-3, 1e-3]),
    "scan": (lambda x: jax.lax.scan(lambda c, s: (c, by_array(x, s * ONE)), 0, jnp.array([1.0]))[1], [1e-3]),
    "sweep": (in_sweep, [1e-2, 1e-3]),
}


X, Y = np.array([4.0, 2.0]), np.array([5.0, 1.5])


@cache
def by_hand(rtol):
    """q at X, and its derivatives, over the steps for Y."""
    start = DUFFING, LIGHT, ONE, ZERO
    chosen = hhtjax.choose_steps(*start, {"k": Y[0], "k3": Y[1]}, times=TIMES, rtol=rtol, atol=1e-3 * rtol)

    @jax.jit
    def along(dx):
        def run(x):
            path = hhtjax.simulate(*start, {"k": x[0], "k3": x[1]}, dt=chosen.dt)
            return hhtjax.interpolate(path, TIMES).q

        return jax.jvp(run, (X,), (dx,))

    (value, first), (_, second) = map(along, np.eye(2))
    return np.asarray(value), np.stack([first, second], axis=-1)


@pytest.mark.slow
@pytest.mark.parametrize("name", zoo.each(FORMS, quick=("jit",), rest=("alone", "scan")))
def test_the_steps_are_those_of_the_other_point(name):
    """Values and derivatives against steps that are chosen by hand, whatever stands between."""
    f, tolerances = FORMS[name]
    if name == "jit":
        f(X)  # so that it knows the other form, too

    @jax.jit
    def ways(dx):
        value, forward = jax.jvp(lambda x: with_steps_for(f, x, Y), (X,), (dx,))
        return value, forward, jax.grad(lambda x: jnp.sum(with_steps_for(f, x, Y)))(X)

    (value, first, reverse), (_, second, _) = map(ways, np.eye(2))
    forward = np.stack([first, second], axis=-1)
    for found, expected in zip((value, forward), zip(*map(by_hand, tolerances), strict=True), strict=True):
        np.testing.assert_allclose(found.reshape(np.shape(expected)), expected, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(reverse, np.sum(forward.reshape(-1, 2), axis=0), rtol=1e-9)


CASES = [("hht", 0.001), pytest.param("dopri5", 0.3, marks=zoo.EVERY)]  # choices change its rejected steps


@pytest.mark.slow
@pytest.mark.parametrize(("name", "most"), CASES)
def test_a_fit_freezes_the_steps_and_chooses_again(name, most, residuals, measured):
    """The estimates are those of a fit by hand on the steps that are chosen for them, to a part of a standard error."""
    stepper = {"hht": LIGHT, "dopri5": STEPPER}[name]
    fitted = hhtjax.fit(residuals[name], GUESS)
    assert fitted.converged
    assert 1 <= fitted.choices <= 3
    assert f"; steps of the runs chosen {fitted.choices} times" in fitted.summary()
    assert hhtjax.FitResult.from_json(fitted.to_json()).choices == fitted.choices
    start = DUFFING, stepper, ONE, ZERO
    chosen = hhtjax.choose_steps(*start, fitted.params, times=TIMES, rtol=1e-4, atol=1e-7, max_steps=1000)

    def frozen(params):
        path = hhtjax.simulate(*start, params, dt=chosen.dt)
        return hhtjax.interpolate(path, TIMES).q - measured

    again = hhtjax.fit(frozen, fitted.params)
    assert again.choices is None
    for name, error in fitted.standard_errors.items():
        assert abs(again.params[name] - fitted.params[name]) < most * error
        assert abs(fitted.params[name] - TRUE[name]) < 4 * error
    assert fitted.history.cost[0] > 100 * fitted.cost
    assert fitted.history.cost.shape == (fitted.iterations + 1,)
    assert np.all(np.isfinite(fitted.history.cost))
    assert fitted.history.cost[-1] == fitted.cost


@pytest.mark.slow
def test_tolerances_above_the_noise_are_named(measured):
    def residuals(p):
        return position(p, ONE, 1e-2) - measured

    found = hhtjax.fit(residuals, GUESS)
    assert not found.converged
    assert found.reason == "stopped: the estimates change whenever steps are chosen anew; take a smaller rtol"
    assert found.choices == 5
    compiled = solve.number()
    assert hhtjax.fit(residuals, TRUE).choices is not None
    assert solve.number() == compiled


@pytest.mark.slow
def test_records_and_starts():
    """The start of each record is fitted with its own frozen steps."""
    starts = jnp.array([[1.0], [0.5]])
    data = jnp.stack([position(TRUE, q0, 1e-9) for q0 in starts])  # by the program of `measured`
    data += 1e-3 * np.random.default_rng(1).standard_normal(data.shape)

    def residuals(params, q0, record):
        return position(params, q0, 1e-5) - record

    found = hhtjax.fit(residuals, GUESS, records=data, starts=starts + 0.05)
    assert found.converged
    assert 1 <= found.choices <= 3
    np.testing.assert_allclose(found.starts, starts, atol=3e-3)
    for name, error in found.standard_errors.items():
        assert abs(found.params[name] - TRUE[name]) < 4 * error


@pytest.mark.slow
def test_inside_jit_and_from_several_starts(residuals):
    residuals = residuals["hht"]
    alone = hhtjax.fit(residuals, GUESS)
    several = jax.tree.map(lambda x: jnp.array([x, 1.1 * x]), GUESS)

    @jax.jit
    def inside(starts):
        found = hhtjax.multistart(residuals, starts).all
        return found.params, found.choices

    params, choices = inside(several)
    for name in GUESS:
        assert float(params[name][0]) == pytest.approx(float(alone.params[name]), rel=1e-8)
    assert choices[0] == alone.choices
