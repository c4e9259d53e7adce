"""`verify="tighten"`: the error of the whole run is what was asked for, where no estimate of one step sees it."""

import jax
import numpy as np
import pytest
from helpers import ONE, ZERO
from scipy.integrate import solve_ivp

import hhtjax
from hhtjax.runs import controlled_run
from hhtjax.runs.controlled_run import rounds

STEPPER = hhtjax.hht(alpha=-0.05, linearize="predictor")
TIMES = np.linspace(0, 1, 33)[1:]
K = 5e3


def hardening():
    """Undamped: its phase drifts. Another system each time, and so another program."""
    return hhtjax.System(ONE, lambda q, v, t, k: -100 * q - k * q**3)


SPRING = hardening()


def controlled(k=K, rtol=1e-3, system=SPRING, **options):
    control = hhtjax.adaptive(rtol, 1e-3 * rtol, **{"max_steps": 60_000, "verify": "tighten"} | options)
    return hhtjax.simulate(system, STEPPER, ONE, ZERO, k, dt=control, times=TIMES)


@pytest.fixture(scope="module")
def reference():
    """q at the samples, by DOP853."""
    return solve_ivp(
        lambda t, y: [y[1], -100 * y[0] - K * y[0] ** 3], (0, 1), [1.0, 0.0], "DOP853", TIMES, rtol=1e-12, atol=1e-12
    ).y[0]


@pytest.mark.slow
def test_the_error_is_what_was_asked_for(reference):
    compiled = []
    for rtol in (1e-2, 1e-3):
        tolerance = rtol * (1 + 1e-3)
        usual, run = controlled(rtol=rtol, verify=False), controlled(rtol=rtol)
        compiled.append(rounds.number())
        run.check()
        error, of_usual = (float(np.max(abs(x.q[1:, 0] - reference))) for x in (run, usual))
        assert of_usual > 10 * tolerance
        assert 0.1 * tolerance < error < tolerance
        assert 0.9 * error < np.max(run.error) < 3 * error  # errors of this motion fall faster than the tolerance
        assert float(run.allowed) == pytest.approx(tolerance, rel=1e-2)
        assert run.dt.size == run.steps.accepted > 2 * usual.steps.accepted
        share = float(run.steps.tightened)
        same = controlled(rtol=share * rtol, verify=False)
        np.testing.assert_allclose(run.dt, same.dt, rtol=1e-7)
        np.testing.assert_allclose(run.q, same.q, atol=1e-9)
    assert compiled[0] == compiled[1]


def slope_over(dt):
    """Of the last q in K, with these steps."""
    low, high = (float(hhtjax.simulate(SPRING, STEPPER, ONE, ZERO, K + d, dt=dt).q[-1, 0]) for d in (-1e-2, 1e-2))
    return (high - low) / 2e-2


@pytest.mark.slow
def test_derivatives_are_those_of_the_accepted_steps():
    """Also of a jit, which does not know that it will be differentiated, and of what a force closes over."""
    run = controlled(rtol=1e-2)

    def end(k):
        return controlled(None, rtol=1e-2, system=hhtjax.System(ONE, lambda q, v, t, _: -100 * q - k * q**3)).q[-1, 0]

    (value, reverse), (_, forward) = jax.jit(
        lambda k: (jax.value_and_grad(end)(k), jax.jvp(jax.jit(end), (k,), (1.0,)))
    )(K)
    assert float(value) == pytest.approx(float(run.q[-1, 0]), rel=1e-9)
    assert float(reverse) == pytest.approx(slope_over(run.dt), rel=1e-6)
    assert float(forward) == pytest.approx(float(reverse), rel=1e-9)


@pytest.mark.slow
def test_what_cannot_be_reached_is_named(monkeypatch):
    with pytest.raises(hhtjax.SimulationError, match=r"stopped at t = 0.\d+: max_steps=500 used up"):
        controlled(rtol=1e-2, max_steps=500).check()
    monkeypatch.setattr(controlled_run, "ROUNDS", 2)
    run = controlled(system=hardening())
    assert float(run.steps.tightened) == 0.25
    told = (
        r"the error of the run is 0.\d+, by a coarser run, and 0.001 was allowed, although steps were chosen for 0.25 "
    )
    with pytest.raises(hhtjax.SimulationError, match=r"at t = 0.\d+ " + told + r"of the tolerance\."):
        run.check()


@pytest.mark.slow
def test_members_of_a_sweep_wait_for_each_other():
    """A harmonic one and one whose phase drifts, which takes a round more."""
    stiffness = np.array([0.0, K])
    control = hhtjax.adaptive(1e-2, 1e-5, max_steps=60_000, verify="tighten")

    def members(k):
        return hhtjax.sweep(SPRING, STEPPER, ONE, ZERO, k, dts=control, times=TIMES, in_axes=(None, None, None, 0))

    def end(k):
        return members(k).q[1, -1, 0]

    runs = members(stiffness)
    _, slope = jax.jvp(jax.jit(end), (stiffness,), (np.array([0.0, 1.0]),))
    runs.check()
    shares = []
    for i, k in enumerate(stiffness):
        alone = controlled(k, rtol=1e-2)
        shares.append(float(alone.steps.tightened))
        mine = jax.tree.map(lambda x, i=i: x[i], runs)
        assert mine.steps.accepted == alone.steps.accepted
        assert float(mine.steps.tightened) == pytest.approx(shares[-1], rel=1e-7)
        np.testing.assert_allclose(mine.dt[: alone.dt.size], alone.dt, rtol=1e-5)
        for which in ("q", "v", "error", "allowed"):
            np.testing.assert_allclose(getattr(mine, which), getattr(alone, which), rtol=1e-6, atol=1e-9)
    assert shares[0] > 2 * shares[1]
    assert float(slope) == pytest.approx(slope_over(alone.dt), rel=1e-6)


@pytest.mark.slow
def test_with_events():
    """A spring that throws its mass against a wall, without loss: |cos(20 t)|."""
    system = hhtjax.System(ONE, lambda q, v, t, k: -400 * q)
    wall = hhtjax.Event(guard=lambda q, v, t, k: q[0], reset=hhtjax.impact(restitution=1.0))
    control = hhtjax.adaptive(1e-3, 1e-6, verify="tighten")
    run = hhtjax.simulate(system, STEPPER, ONE, ZERO, dt=control, times=TIMES, events=[wall], keep_events=8)
    run.check()
    assert run.events.count == 6
    error = float(np.max(abs(run.q[1:, 0] - abs(np.cos(20 * TIMES)))))
    assert error < 1.001e-3
    assert float(np.max(run.error)) == pytest.approx(error, rel=0.3)
