"""Error control of motions whose acceleration jumps: held inputs, and dry friction."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import zoo
from friction_problems import CASES, Case, arm, free_vibration_exact, of_scene
from friction_reference import Motion
from helpers import ONE, ZERO
from scipy.integrate import solve_ivp
from test_held import SYSTEM, VALUES

import hhtjax
from hhtjax.runs.controlled_run import Grid
from hhtjax.scenes import belt, dry_oscillator

START = np.array([0.4, -0.3]), np.array([0.0, 1.0])
DURATION = 0.6
UNEVEN = np.array([0.0, 0.07, 0.08, 0.25, 0.31, 0.5])
BEHIND = np.concatenate([UNEVEN[1:], [0.1, 0.2, 0.3, 0.4]]) + 1e-3
TIMES = np.sort(np.concatenate([DURATION * np.arange(1, 26) / 25, BEHIND]))  # some in the first step behind a jump
HELD = {"even": {"dt": 0.1}, "uneven": {"times": UNEVEN}}
LIGHT = hhtjax.hht(linearize="predictor")  # half the program of "auto"
METHODS = {"hht": hhtjax.hht(-0.3, linearize="predictor"), "rowda": hhtjax.rowda(), "dopri5": hhtjax.dopri5()}


def held(name, values: Any = VALUES):
    return {"u": hhtjax.sampled(jnp.asarray(values), **HELD[name], order=0)}


def jumps_of(name):
    return UNEVEN[1:] if name == "uneven" else 0.1 * np.arange(1, 6)


def pushed(name, stepper, rtol, values=VALUES, **options):
    dt = hhtjax.adaptive(rtol, 1e-3 * rtol, max_steps=4000, **options)
    return hhtjax.simulate(SYSTEM, stepper, *START, held(name, values), dt=dt, times=TIMES)


def taken(steps):
    """Of the array of a traced run, which is as long as there may be steps."""
    return np.asarray(steps)[np.asarray(steps) > 0]


def pushed_exactly(name):
    """q and v from jump to jump, by SciPy."""
    y, found, ends = np.concatenate(START), [], [0.0, *jumps_of(name), DURATION]
    for u, a, b in zip(VALUES, ends, ends[1:], strict=False):

        def rate(t, y, u=u):
            c = np.cos(y[0] - y[1])
            load = np.array([u - 9 * np.sin(y[0]) - 0.3 * y[2], -20 * y[1] - y[1] ** 3])
            return np.concatenate([y[2:], np.linalg.solve([[2, c], [c, 1]], load)])

        run = solve_ivp(rate, (a, b), y, "DOP853", dense_output=True, rtol=1e-11, atol=1e-12)
        here = np.searchsorted([a + 1e-12, b + 1e-12], TIMES) == 1
        found.append(run.sol(np.append(TIMES[here], b)).T[:-1])
        y = run.y[:, -1]
    return np.split(np.concatenate(found), 2, axis=1)


@pytest.mark.slow
@pytest.mark.parametrize(("method", "name"), zoo.covering(METHODS, HELD))
def test_steps_end_where_held_inputs_jump(method, name):
    """So errors of q, and of v between the steps, follow the tolerance."""
    exact = pushed_exactly(name)
    for rtol in (1e-2, 1e-3, 1e-5):
        found = pushed(name, METHODS[method], rtol)
        found.check()
        ends = np.cumsum(np.asarray(found.dt))
        assert all(np.min(np.abs(ends - t)) < 1e-13 for t in jumps_of(name))
        for x, y in zip((found.q, found.v), exact, strict=True):
            assert np.max(np.abs(x[1:] - y)) / np.max(np.abs(y)) < 10 * rtol
        if method == "hht":
            assert np.max(np.abs(found.q[1:] - exact[0])) / np.max(np.abs(exact[0])) > 0.02 * rtol
        assert int(found.steps.rejected) < 0.1 * int(found.steps.accepted)


@pytest.mark.slow
def test_a_batch_takes_the_steps_of_its_members():
    """To the last digit, through 39 jumps: a difference in rounding would grow with each."""
    pattern, rtol = jnp.sign(jnp.sin(jnp.arange(40.0) ** 2)), jnp.logspace(-4, -2, 16)
    inputs = jax.vmap(lambda x: {"u": hhtjax.sampled(x * pattern, 0.07, order=0)})(jnp.linspace(3.0, 30.0, rtol.size))
    start, times = (SYSTEM, METHODS["hht"], *START), [1.0, 2.8]

    def control(rtol):
        return hhtjax.adaptive(rtol, 1e-3 * rtol, max_steps=400)

    def run(rtol, u):
        return hhtjax.simulate(*start, u, dt=control(rtol), times=times)

    alone = [run(rtol[i], jax.tree.map(lambda x, i=i: x[i], inputs)) for i in range(rtol.size)]
    batch = jax.jit(jax.vmap(run))(rtol, inputs)
    swept = hhtjax.sweep(*start, inputs, dts=control(rtol), times=times, in_axes=(None, None, None, 0))
    assert 0 < sum(int(one.steps.stop) > 0 for one in alone) < rtol.size  # some have too few steps
    for many in (batch, swept):
        for i, one in enumerate(alone):
            np.testing.assert_array_equal(taken(many.dt[i]), one.dt)
            np.testing.assert_allclose(many.q[i], one.q, rtol=1e-9)


SPRING = hhtjax.System(ONE, lambda q, v, t, u: u(t) - 4 * jnp.sin(q))


@pytest.mark.slow
def test_derivatives_in_held_inputs():
    """Forward = reverse = differences over the same steps."""
    controlled = {"dt": hhtjax.adaptive(1e-3, 1e-6, max_steps=4000), "times": TIMES[-1:]}

    def run(values, **options):
        return hhtjax.simulate(SPRING, METHODS["hht"], ONE, ZERO, held("uneven", values)["u"], **options)

    def end(values):
        found = run(values, **controlled)
        return found.q[-1, 0], found.dt

    @jax.jit
    def ways(values, along):
        _, forward, steps = jax.jvp(end, (values,), (along,), has_aux=True)
        return jax.grad(end, has_aux=True)(values)[0], forward, steps

    start, eye = jnp.asarray(VALUES), jnp.eye(6)
    reverse, forward, steps = zip(*(ways(start, e) for e in eye), strict=True)
    np.testing.assert_allclose(reverse[0], forward, rtol=1e-9)
    frozen = jax.jit(lambda values: run(values, dt=taken(steps[0])).q[-1, 0])
    for i in (0, 3):
        e = 1e-4 * eye[i]
        assert (frozen(start + e) - frozen(start - e)) / 2e-4 == pytest.approx(float(forward[i]), rel=1e-6)


@pytest.mark.slow
def test_held_inputs_in_single_precision():
    dt, u = hhtjax.adaptive(1e-3, 1e-6), held("even", VALUES.astype(np.float32))["u"]
    single = ONE.astype(np.float32), ZERO.astype(np.float32), u
    with pytest.warns(hhtjax.PrecisionWarning):
        found = hhtjax.simulate(SPRING, METHODS["hht"], *single, dt=dt, times=[0.55])
    found.check()
    assert found.q.dtype == np.float32
    double = hhtjax.simulate(SPRING, METHODS["hht"], ONE, ZERO, held("even")["u"], dt=dt, times=[0.55])
    np.testing.assert_allclose(found.q, double.q, atol=1e-3)


RUBBING = {
    "free": of_scene(dry_oscillator.free()),
    "stick-slip": of_scene(dry_oscillator.driven()),
    "belt": of_scene(belt.two_masses()),
    "arm": arm(),
}


def rubbed(name, rtol):
    """One program for all tolerances."""
    system, params, q0, v0, duration, *_ = RUBBING[name]
    dt = hhtjax.adaptive(rtol, 1e-3 * rtol, max_steps=100_000)
    return hhtjax.simulate(system, LIGHT, q0, v0, params, dt=dt, times=duration * np.arange(1, 65) / 64)


@pytest.mark.slow
@pytest.mark.parametrize("name", zoo.each(RUBBING, quick=("free",), rest=("belt",)))
def test_the_error_of_dry_friction_follows_the_tolerance(name):
    """Through all switches, 6 to 25; those of the free vibration, which end no sticking, reject nothing."""
    system, params, q0, v0, duration, *_ = RUBBING[name]
    times = duration * np.arange(65) / 64
    if name == "free":
        exact = free_vibration_exact(times)[0][:, None]
    else:
        exact = Motion(system, params, np.array(q0), np.array(v0)).at(times)[0]
    for rtol in (1e-2, 1e-4):
        found = rubbed(name, rtol)
        found.check()
        assert 0.02 < np.max(np.abs(found.q - exact)) / np.max(np.abs(exact)) / rtol < 10
        assert int(found.steps.rejected) <= (0 if name == "free" else 0.15 * int(found.steps.accepted))


def push(q, v, t, params):
    """A spring, and a force that jumps."""
    return params["u"](t) - 100 * q


def own_axis(R, Om, t, params):
    """The rate about it."""
    return Om[2:]


def constant_limit(q, v, t, params):
    """F."""
    return jnp.full(1, params["F"])


FORCES = hhtjax.sampled(30 * np.random.default_rng(0).uniform(-1, 1, (11, 1)), dt=0.2, order=0)
TOP = CASES["a rotation, H(q)"]
BEARING = hhtjax.System(TOP.system.mass, TOP.system.force, friction=constant_limit, sliding=own_axis)
PUSHED = hhtjax.System(ONE, push, friction=constant_limit)
KINDS = {
    "an internal state": CASES["an internal state"],
    "a constraint": CASES["a constraint, H(q), a load"],
    "a rotation": TOP._replace(system=BEARING),
    "held inputs": Case(PUSHED, {"F": 4.0, "u": FORCES}, ONE, ZERO, 2.0),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", zoo.each(KINDS, quick=(), rest=("a rotation",)))
def test_dry_friction_with_more_than_coordinates(name):
    """Against the same at 1e-5, whose order is tested elsewhere; through all switches."""
    system, params, q0, v0, duration, z0, *_ = KINDS[name]
    times = duration * np.arange(1, 65) / 64

    @jax.jit
    def go(rtol):
        dt = hhtjax.adaptive(rtol, 1e-3 * rtol, max_steps=20_000)
        return hhtjax.simulate(system, LIGHT, q0, v0, params, z0=z0, dt=dt, times=times)

    fine = go(1e-5)
    assert np.sum(np.diff(np.sign(fine.friction), axis=0) != 0) >= 2
    for rtol in (1e-2, 1e-3):
        found = go(rtol)
        found.check()
        assert 0.02 < np.max(np.abs(found.q - fine.q)) / np.max(np.abs(fine.q)) / rtol < 10
        assert int(found.steps.rejected) <= 0.1 * int(found.steps.accepted)


@pytest.mark.slow
def test_controlled_steps_of_stick_slip_are_fewer_than_equal_ones():
    """For the same error."""
    system, params, q0, v0, duration, *_ = RUBBING["stick-slip"]
    found = rubbed("stick-slip", 1e-4)
    fine = rubbed("stick-slip", 1e-6)
    tries = int(found.steps.accepted + found.steps.rejected)
    equal = hhtjax.sweep(system, LIGHT, q0, v0, params, dts=[duration / tries], times=found.t[1:])
    errors = [np.max(np.abs(x - fine.q)) for x in (found.q, equal.q[0])]
    assert errors[1] > 1.5 * errors[0]


@pytest.mark.slow
def test_derivatives_through_switches():
    """Forward = reverse = differences over the same steps."""
    system, params, q0, v0, *_ = RUBBING["free"]
    controlled = {"dt": hhtjax.adaptive(1e-3, 1e-6, max_steps=1000), "times": np.linspace(0.1, 0.5, 5)}

    def run(F, **options):
        return hhtjax.simulate(system, LIGHT, q0, v0, params | {"F": F}, **options)

    def end(F):
        found = run(F, **controlled)
        return found.q[-1, 0], found.dt

    @jax.jit
    def ways(F):
        _, forward, steps = jax.jvp(end, (F,), (1.0,), has_aux=True)
        return jax.grad(end, has_aux=True)(F)[0], forward, steps

    F = 4.0
    reverse, forward, steps = ways(F)
    assert float(reverse) == pytest.approx(float(forward), rel=1e-10)
    frozen = jax.jit(lambda F: hhtjax.interpolate(run(F, dt=taken(steps)), 0.5).q[0])
    high, low = (float(frozen(F + h)) for h in (1e-6, -1e-6))
    assert (high - low) / 2e-6 == pytest.approx(float(forward), rel=1e-6)


def test_a_sample_is_read_off_in_the_step_that_ends_at_it_or_beyond():
    """Whole or halved, and before the first step none; where steps end too early the last one counts."""
    ends, t0 = jnp.array([1.0, 2.0, 3.0, jnp.inf]), jnp.array(0.0)
    times = jnp.array([0.0, 0.4, 0.6, 1.0, 2.5, 2.7, 3.0, 9.0])
    for halved, needed in ((False, [0, 1, 1, 1, 3, 3, 3, 3]), (True, [0, 1, 2, 2, 5, 6, 6, 6])):
        grid = Grid.of(t0, times, ends, 3, halved)
        assert np.cumsum(grid.counts).tolist() == needed
        assert grid.reached == 3.0
        size = 1 - 0.5 * halved
        assert [float(x) for x in grid.sizes(1)] == [size, size, 2 * size]
        assert [float(x) for x in grid.sizes(3 * (1 + halved))] == [1.0, size, np.inf]
