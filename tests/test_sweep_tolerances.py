"""Sweeps under error control: each member has the steps of its own run, whatever the others need."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import zoo
from helpers import ONE, ZERO, check_message

import hhtjax
from hhtjax.runs.sweep_controlled import run_chosen
from hhtjax.scenes import pendulum

TIMES = 2 + np.array([0.1, 0.13, 0.9, 1.3, 2.5])  # from t0 = 2
RTOL = np.array([1e-4, 1e-2, 1e-6, 1e-3, 1e-5])
STEPPER = hhtjax.hht(alpha=-0.1, linearize="predictor")
PARAMS = {"k": 4.0, "c": 0.1}


def force(q, v, t, params):
    """A softening spring, a damper and a load that depends on time."""
    return -params["k"] * jnp.sin(q) - params["c"] * v**3 + jnp.cos(3 * t)


SPRING = hhtjax.System(ONE, force)
CARTESIAN = pendulum.cartesian()
SCENES = {  # system, stepper, start, params, what differs
    "spring": (SPRING, STEPPER, ONE, ZERO, PARAMS),
    "dopri5": (SPRING, hhtjax.dopri5(), ONE, ZERO, PARAMS),
    "constrained": (CARTESIAN.system, STEPPER, CARTESIAN.q0, np.zeros(2), CARTESIAN.params),
}


def sweep(params=PARAMS, rtol=RTOL, scene="spring", in_axes=None, system=None, **options):
    usual, stepper, q0, v0, _ = SCENES[scene]
    dts = hhtjax.adaptive(rtol, 1e-3 * rtol, **{"max_steps": 4000} | options)
    return hhtjax.sweep(system or usual, stepper, q0, v0, params, dts=dts, times=TIMES, t0=2.0, in_axes=in_axes)


@pytest.mark.slow
@pytest.mark.parametrize(("verify", "name"), zoo.covering(("tolerance", False, True), SCENES))
def test_each_member_is_its_own_run(verify, name):
    system, stepper, q0, v0, params = SCENES[name]
    runs = sweep(params, scene=name, verify=verify)
    for i, rtol in enumerate(RTOL):
        dt = hhtjax.adaptive(rtol, 1e-3 * rtol, max_steps=4000, verify=verify)
        alone = hhtjax.simulate(system, stepper, q0, v0, params, dt=dt, times=TIMES, t0=2.0)
        for x, y in ((runs.steps.accepted, alone.steps.accepted), (runs.steps.rejected, alone.steps.rejected)):
            assert x[i] == y
        mine = jax.tree.map(lambda x, i=i: x[i], runs)
        np.testing.assert_allclose(mine.dt[: alone.dt.size], alone.dt, rtol=1e-7)
        assert np.all(np.isnan(mine.dt[alone.dt.size :]))
        for which in ("t", "q", "v", "acceleration", "multipliers", "error"):
            found, expected = (getattr(x, which) for x in (mine, alone))
            assert (found is None) == (expected is None)
            if expected is not None:
                np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-9)
    assert runs.dt.shape == (5, np.max(runs.steps.accepted))
    if verify:
        np.testing.assert_allclose(runs.allowed, 10 * RTOL * (np.max(abs(runs.q), (1, 2)) + 1e-3), rtol=1e-12)


@pytest.mark.slow
def test_the_work_is_about_the_sum_over_the_members():
    """Of members that take very different numbers of steps, which are known only when they are done."""
    system, counted = zoo.counting_oscillator()
    rtol = np.random.default_rng(0).permutation(np.logspace(-9, -3, 70))  # four in a block
    dts = hhtjax.adaptive(rtol, 1e-3 * rtol)
    steps = hhtjax.sweep(system, hhtjax.dopri5(), ONE, ZERO, dts=dts, duration=30.0, num_samples=2).steps
    jax.effects_barrier()
    lanes, stages = 4, 6
    tries, least = lanes * len(counted) / stages, int(np.sum(2 * steps.accepted + steps.rejected))
    assert np.max(steps.accepted) > 10 * np.min(steps.accepted)
    assert least <= tries < 1.1 * least


@pytest.mark.slow
def test_derivatives_are_those_of_the_accepted_steps():
    """Reverse by differences over the same steps, and forward along a direction; of what a force closes over, too."""
    at, rtol = jax.tree.map(jnp.asarray, PARAMS), np.array([1e-3, 1e-2, 3e-3, 2e-3, 5e-3])
    steps = sweep(at, rtol).steps
    padded = jnp.where(jnp.isfinite(steps.dt), steps.dt, 0.01)  # nobody looks behind the last time

    def loss(params):
        by_closure = hhtjax.System(ONE, lambda q, v, t, k: force(q, v, t, params | {"k": k}))
        return jnp.sum(sweep(params["k"], rtol, system=by_closure).q[:, 1:] ** 2)

    @jax.jit
    def frozen(params):
        def member(dt):
            path = hhtjax.simulate(SPRING, STEPPER, ONE, ZERO, params, dt=dt, t0=2.0)
            return hhtjax.interpolate(path, TIMES).q

        return jnp.sum(jax.vmap(member)(padded) ** 2)

    along = {"k": 1.0, "c": 0.5}
    (value, reverse), (_, forward) = jax.jit(lambda x: (jax.value_and_grad(loss)(x), jax.jvp(loss, (x,), (along,))))(at)
    assert float(value) == pytest.approx(float(frozen(at)), rel=1e-9)
    for name in at:
        h = 1e-5
        low, high = (float(frozen(at | {name: at[name] + s * h})) for s in (-1, 1))
        assert float(reverse[name]) == pytest.approx((high - low) / (2 * h), rel=1e-7)
    assert float(forward) == pytest.approx(sum(along[name] * float(reverse[name]) for name in at), rel=1e-10)


@pytest.mark.slow
def test_what_differs_is_data_and_failures_are_alone():
    """Stiffness per member, one tolerance; one member has too few steps, one is not finite from t = 3 on."""
    stiffness = {"k": jnp.array([1.0, 4e4, 4.0, 9.0, 1.0]), "c": jnp.array([0.1, 0.1, jnp.nan, 0.1, 0.2])}
    axes = None, None, None, 0
    good = sweep(stiffness | {"c": stiffness["c"].at[2].set(0.3)}, np.array(1e-4), in_axes=axes)
    compiled = run_chosen.number()
    runs = sweep(stiffness, np.array(2e-4), in_axes=axes)
    again = sweep(stiffness, np.array(1e-4), in_axes=axes)
    assert run_chosen.number() == compiled
    assert runs.steps.stop.tolist() == [0, 2, 3, 0, 0]
    assert runs.failed.tolist() == [False, True, True, False, False]
    with pytest.raises(hhtjax.SimulationError, match=r"member 1 \(2 of 5 failed\), stopped at t = .*max_steps=4000"):
        again.check()
    assert np.all(np.isnan(again.q[2, 1:]))
    assert np.all(np.isnan(again.q[1, -1]))
    for i in (0, 3, 4):
        np.testing.assert_array_equal(again.q[i], good.q[i])
        alone = hhtjax.simulate(
            SPRING, STEPPER, ONE, ZERO, jax.tree.map(lambda x, i=i: x[i], stiffness), t0=2.0, times=TIMES,
            dt=hhtjax.adaptive(1e-4, 1e-7, max_steps=4000),
        )  # fmt: skip
        np.testing.assert_allclose(again.q[i], alone.q, rtol=1e-9)


@pytest.mark.slow
def test_a_run_that_goes_too_far_is_named_with_the_step_that_got_there():
    runs = sweep()
    with pytest.raises(hhtjax.SimulationError, match=r"member 0 \(5 of 5 failed\), step \d+ \(to t = ") as told:
        runs.check(reach=0.5)
    step, time = re.findall(r"step (\d+) \(to t = (.*)\) failed", str(told.value))[0]
    first = TIMES[np.argmax(abs(runs.q[0, 1:, 0] - 1) > 0.5)]
    ends = 2 + np.cumsum(runs.dt[0])
    assert ends[int(step) - 2] < first <= ends[int(step) - 1] == pytest.approx(float(time), rel=1e-5)


MANY = hhtjax.adaptive(RTOL, 1e-6)
WRONG = {
    "array alone": (
        lambda: hhtjax.simulate(SPRING, STEPPER, ONE, ZERO, PARAMS, dt=MANY, times=TIMES, t0=2.0),
        "simulate: tolerances must be numbers; arrays (B,), one for each member, are for `sweep`.",
    ),
    "nothing differs": (
        lambda: sweep(rtol=np.array(1e-3)), "give an array (B,) of tolerances, or `in_axes`, else none differ."
    ),
    "negative": (
        lambda: sweep(rtol=np.array([1e-3, -1e-3])),
        "adaptive: `rtol` must be positive and finite; received rtol[1] = -0.001.",
    ),
    "lengths": (lambda: hhtjax.adaptive(RTOL, RTOL[1:]), "adaptive: arrays must have one length, that of the members"),
    "other length": (
        lambda: sweep({"k": jnp.ones(4), "c": jnp.ones(4)}, in_axes=(None, None, None, 0)),
        "sweep: `params['c']` must have a leading axis of 5 members",
    ),
    "no estimate": (
        lambda: hhtjax.sweep(SPRING, hhtjax.kim_hht(), ONE, ZERO, PARAMS, dts=MANY, times=TIMES),
        "sweep: KimHHT has no estimate",
    ),
    "mesh": (
        lambda: hhtjax.sweep(SPRING, STEPPER, ONE, ZERO, PARAMS, dts=MANY, times=TIMES, mesh=jax.make_mesh((1,), "x")),
        "sweep: with dts=adaptive(...), leave `mesh` out.",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_bad_input_is_named(name):
    call, message = WRONG[name]
    check_message((ValueError, TypeError, NotImplementedError), message, call)
