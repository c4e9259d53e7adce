"""The stepper chosen for a motion: which one, that it keeps to the error wanted, and what is said if none does."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse
from scipy.integrate import solve_ivp

import hhtjax
from hhtjax.analysis import choice, choose_stepper

ONE = jnp.ones(1), jnp.zeros(1)
SMOOTH = hhtjax.System(jnp.ones(1), lambda q, v, t, c: -9.81 * jnp.sin(q) - c * v)
STIFF = hhtjax.System(jnp.ones(1), lambda q, v, t, c: -1e6 * (q - jnp.sin(t)) - 1e4 * v)
WITHOUT_SERIES = hhtjax.System(jnp.ones(1), lambda q, v, t, c: -9.81 * jnp.sin(q) - jnp.where(v > 0, c, 0.5 * c) * v)
MANY = hhtjax.System(jnp.ones(8), lambda q, v, t, c: -jnp.arange(1.0, 9.0) * jnp.sin(q))
ON_CIRCLE = hhtjax.System(jnp.ones(2), lambda q, v, t, c: jnp.array([0.0, -9.81]), lambda q, t, c: (q @ q - 1.0)[None])
CIRCLE = jnp.array([1.0, 0.0]), jnp.zeros(2)
RUBBED = hhtjax.System(jnp.ones(1), lambda q, v, t, c: -9.0 * q, friction=lambda q, v, t, c: c * jnp.ones_like(v))
DECAY = hhtjax.FirstOrderSystem(lambda y, t, c: jnp.array([-y[1], y[0]]))
MASSLESS = hhtjax.LinearSystem(M=jnp.array([1.0, 0.0]), C=jnp.ones(2), K=jnp.ones(2))
CHAIN = 2.0 * jnp.eye(4) - jnp.eye(4, k=1) - jnp.eye(4, k=-1)


def name_of(choice):
    return str(choice).split(", dt=")[0]


def scipy_pendulum(t, damping):
    run = solve_ivp(
        lambda t, y: [y[1], -9.81 * np.sin(y[0]) - damping(y[1]) * y[1]], (0, t[-1]), [1, 0], "DOP853", t,
        rtol=1e-12, atol=1e-12, max_step=0.02,
    )  # fmt: skip
    return run.y[0]


@pytest.mark.parametrize(
    ("system", "start", "tolerance", "expected"),
    [
        (SMOOTH, ONE, 1e-3, "tsit5()"),
        (SMOOTH, ONE, 1e-7, "taylor()"),
        (MANY, (jnp.ones(8), jnp.zeros(8)), 1e-7, "dop853()"),
        (STIFF, ONE, 1e-5, "rodas5p()"),
        (ON_CIRCLE, CIRCLE, 1e-6, "extrapolated()"),
        (ON_CIRCLE, CIRCLE, 2e-2, 'hht(linearize="predictor")'),
        (RUBBED, (3.0 * jnp.ones(1), jnp.zeros(1)), 1e-3, "hht()"),
        (DECAY, (jnp.array([1.0, 0.0]),), 1e-6, "taylor()"),
    ],
)
def test_the_kind_of_motion_decides(system, start, tolerance, expected):
    found = choose_stepper(system, *start, params=0.3, duration=2.0, tolerance=tolerance)
    assert name_of(found) == expected
    assert found.error <= tolerance
    assert (found.stiffness or 0) > 4 if system is STIFF else (found.stiffness or 0) < 4
    sharp = {"rtol": 1e-3 * tolerance, "atol": 1e-5 * tolerance, "max_steps": 100_000}
    params, times = 0.3, np.linspace(0, 2, 65)[1:]
    run = partial(hhtjax.simulate, system, q0=start[0], v0=start[1] if len(start) > 1 else None, params=params)
    other = {  # a method of another kind
        "rodas5p()": hhtjax.extrapolated(), "extrapolated()": hhtjax.hht(), 'hht(linearize="predictor")': hhtjax.hht(),
        "hht()": hhtjax.hht(alpha=-0.1),
    }.get(expected, hhtjax.rodas5p())  # fmt: skip
    if expected == "extrapolated()":
        sharp |= {"rtol": 1e-8, "atol": 1e-8}
    exact = run(stepper=other, dt=hhtjax.adaptive(**sharp), times=times).q
    exact, q = map(np.asarray, (exact, run(stepper=found.stepper, dt=found.dt, times=times).q))
    error = np.sqrt(np.mean((q - exact) ** 2))
    assert error <= 1.5 * tolerance * np.sqrt(np.mean((exact - exact.mean(axis=0)) ** 2))


def test_what_has_no_series_is_said_and_passed_over():
    found = choose_stepper(WITHOUT_SERIES, *ONE, 0.3, duration=2.0, tolerance=1e-6)
    assert name_of(found) == "dop853()"
    assert "not taylor(): taylor: " in str(found)
    assert "has no Taylor series" in str(found)
    run = hhtjax.simulate(WITHOUT_SERIES, found.stepper, *ONE, 0.3, dt=found.dt, times=[0.5, 1.0, 2.0])
    exact = scipy_pendulum(np.array([0, 0.5, 1.0, 2.0]), lambda v: 0.3 if v > 0 else 0.15)
    assert np.max(abs(run.q[:, 0] - exact)) < 2e-6


def test_sparse_matrices_are_kept():
    K = hhtjax.sparse(scipy.sparse.csr_matrix(np.asarray(CHAIN)))
    found = choose_stepper(hhtjax.LinearSystem(M=jnp.ones(4), K=K), jnp.arange(4.0), jnp.zeros(4), duration=2.0)
    assert name_of(found) == "rodas5p()"
    assert found.stiffness is None
    assert "sparse" in found.reason


@pytest.mark.slow
def test_events_with_a_constraint_leave_hht():
    low = hhtjax.Event(lambda q, v, t, c: q[1] + 2.0)
    found = choose_stepper(ON_CIRCLE, *CIRCLE, duration=1.0, tolerance=1e-3, events=[low])
    assert name_of(found).startswith("hht(")
    assert "order 5" not in found.reason


def test_growth_asks_for_a_smaller_tolerance():
    upright = jnp.array([np.pi - 1e-3]), jnp.zeros(1)
    found = choose_stepper(SMOOTH, *upright, 0.0, duration=6.0, tolerance=1e-3)
    assert float(found.dt.rtol) < 1e-3
    assert found.error <= 1e-3


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"duration": 0.0}, "`duration` must be positive and finite; received 0.0"),
        ({"tolerance": 2.0}, r"`tolerance` must lie in \(1e-13, 1\); received 2.0"),
        ({"tolerance": 1e-14}, r"`tolerance` must lie in \(1e-13, 1\); received 1e-14"),
        ({"t0": jnp.nan}, "choose_stepper: `t0` must be finite; received nan"),
        ({"num_samples": 0}, "`num_samples` must"),
        ({"q0": jnp.zeros(1)}, "`q0` does not move within 1 s"),
        ({"q0": jnp.array([jnp.pi])}, "`q0` does not move within 1 s"),  # but for the rounding of pi
        ({"q0": jnp.array([jnp.nan])}, "`q0` must"),
    ],
)
def test_bad_arguments_are_named(change, message):
    given = {"q0": ONE[0], "v0": ONE[1], "params": 0.3, "duration": 1.0} | change
    with pytest.raises(ValueError, match=message):
        choose_stepper(SMOOTH, **given)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"system": 3}, TypeError, "choose_stepper: `system` must be a System, LinearSystem or .*; received 3"),
        ({"params": "soft"}, TypeError, "choose_stepper: `params` must be an array, .*; received 'soft'"),
        ({"system": MASSLESS}, NotImplementedError, "choose_stepper: the `M` of the system is singular"),
    ],
)
def test_what_no_run_can_take_is_refused_at_once(change, error, message):
    given = {"system": SMOOTH, "q0": jnp.ones(2), "v0": jnp.zeros(2), "params": 0.3, "duration": 1.0} | change
    with pytest.raises(error, match=message):
        choose_stepper(**given)


@pytest.mark.parametrize("wrt", ["q0", "params"])
def test_inside_jit_nothing_can_be_chosen(wrt):
    given = {"q0": ONE[0], "v0": ONE[1], "params": 0.3, "duration": 1.0}
    with pytest.raises(TypeError, match="choose_stepper: the arguments must be known numbers; received a tracer"):
        jax.jit(lambda x: choose_stepper(SMOOTH, **given | {wrt: x}).error)(given[wrt])


@pytest.mark.parametrize(("q0", "duration", "num_samples"), [(1.0, 8.0, 64), (1.0, 20.0, 64), (0.0, 20.0, 1)])
def test_motion_that_grows_far_beyond_its_start_is_followed_from_there(q0, duration, num_samples):
    """q'' = 25 q: an atol beside exp(100) let all steps pass, and two runs with the same steps agreed."""
    start = jnp.array([q0]), jnp.ones(1)
    system = hhtjax.System(jnp.ones(1), lambda q, v, t, c: 25.0 * q)
    found = choose_stepper(system, *start, duration=duration, num_samples=num_samples)
    times = np.linspace(0, duration, num_samples + 1)
    q = np.asarray(hhtjax.simulate(system, found.stepper, *start, dt=found.dt, times=times[1:]).q)[:, 0]
    exact = q0 * np.cosh(5 * times) + np.sinh(5 * times) / 5
    error = np.sqrt(np.mean((q - exact) ** 2)) / np.std(exact)
    assert error <= 1e-3
    assert found.error == pytest.approx(error, rel=0.5)


def test_a_push_that_long_steps_pass_over_is_found():
    """Two runs without it took the same 7 steps, and agreed."""
    at_rest = jnp.zeros(1), jnp.zeros(1)
    pushed = hhtjax.System(jnp.ones(1), lambda q, v, t, c: -4.0 * q + 50.0 * jnp.exp(-(((t - 4.0) / 0.02) ** 2)))
    found = choose_stepper(pushed, *at_rest, duration=5.0)
    run = hhtjax.simulate(pushed, found.stepper, *at_rest, dt=found.dt, times=[4.3, 5.0])
    exact = 0.5 * np.sqrt(np.pi) * np.exp(-(0.02**2)) * np.sin(2 * (np.array([4.3, 5.0]) - 4.0))
    assert np.max(abs(run.q[1:, 0] - exact)) < 2e-3


@pytest.mark.slow
def test_motion_that_an_event_ends_is_stiff_by_the_time_it_takes():
    ends = hhtjax.Event(at=0.15, terminal=True)
    found = choose_stepper(SMOOTH, *ONE, 0.3, duration=1000.0, events=[ends])
    assert name_of(found) == "tsit5()"
    assert found.stiffness is not None
    assert found.stiffness < 1


def test_the_time_of_a_call_is_that_of_a_run_that_succeeds(monkeypatch):
    """Where 10,000 steps are too few, the run that failed for it was timed too."""
    asked = []

    def counted(*args, **options):
        asked.append(options["dt"].max_steps)
        return hhtjax.simulate(*args, **options)

    monkeypatch.setattr(choice, "MOST_STEPS", (10, 100_000))
    monkeypatch.setattr(choice, "simulate", counted)
    found = choose_stepper(SMOOTH, *ONE, 0.3, duration=20.0)
    assert found.num_steps > 10
    assert asked[-choice.TIMED :] == [100_000] * choice.TIMED


def test_a_tolerance_that_none_reaches_is_said_with_what_each_did():
    with pytest.raises(ValueError, match=r"no method reaches the `tolerance`:\n  hht\(\): "):
        choose_stepper(RUBBED, 3.0 * jnp.ones(1), jnp.zeros(1), 0.3, duration=2.0, tolerance=1e-11)
