"""Sweeps sampled at given times: members step from one to the next by equal steps, of another size in each interval."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import zoo

import hhtjax
from hhtjax.runs.sweep import run_sweep
from hhtjax.scenes import pendulum

ONE, ZERO = np.ones(1), np.zeros(1)
TIMES = 2 + np.array([0.1, 0.13, 0.6, 0.601, 1.3])  # from t0 = 2
DTS = np.append(np.logspace(-2, -1, 69), np.inf)  # four in a block
STEPPER = hhtjax.hht(alpha=-0.1, linearize="predictor")
PARAMS = {"k": 4.0, "c": 0.1}


def force(q, v, t, params):
    """A softening spring, a damper and a load that depends on time."""
    return -params["k"] * jnp.sin(q) - params["c"] * v + jnp.cos(3 * t)


SPRING = hhtjax.System(ONE, force)
LINEAR = hhtjax.LinearSystem(np.eye(2), C=0.1 * np.eye(2), K=np.array([[6.0, -2.0], [-2.0, 4.0]]))
CARTESIAN = pendulum.cartesian()
SCENES = {
    "spring": (SPRING, STEPPER, ONE, ZERO, PARAMS),
    "linear": (LINEAR, STEPPER, np.ones(2), np.zeros(2), None),  # whose matrix is factorised for each step size
    "constrained": (CARTESIAN.system, STEPPER, CARTESIAN.q0, np.zeros(2), CARTESIAN.params),
}
sweep = partial(hhtjax.sweep, SPRING, STEPPER, ONE, ZERO, PARAMS, t0=2.0)


def by_hand(scene, times, dt, t0):
    """q, v, acceleration and multipliers at the times, one step after the other."""
    system, stepper, q0, v0, params = scene

    @jax.jit
    def step(state, h, last):
        resized, state = stepper.resized(state, h / last)
        return resized.step(system, state, params, h)[0]

    spans = np.diff(times, prepend=t0)
    counts = np.maximum(np.ceil(spans / dt - 1e-12), 1).astype(int)
    state = jax.jit(lambda h: stepper.init(system, q0, v0, params, h, t0))(spans[0] / counts[0])
    found, last = [state], spans[0] / counts[0]
    for end, span, n in zip(times, spans, counts, strict=True):
        for i in range(n):
            state = step(state, span / n, last if i == 0 else span / n)._replace(
                t=jnp.asarray(end - span + (i + 1) * span / n)
            )
        last = span / n
        found.append(state)
    return spans / counts, jax.tree.map(lambda *x: np.stack(x), *((s.q, s.v, s.w, s.L) for s in found))


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["spring", *(pytest.param(x, marks=pytest.mark.slow) for x in ("linear", "constrained"))]
)
def test_each_member_takes_equal_steps_from_time_to_time(name):
    runs = hhtjax.sweep(*SCENES[name], dts=DTS, times=TIMES, t0=2.0)
    runs.check()
    np.testing.assert_array_equal(runs.t, np.tile([2.0, *TIMES], (70, 1)))
    assert runs.dt.shape == (70, 5)
    for i in (0, 41, 68, 69):
        h, expected = by_hand(SCENES[name], TIMES, DTS[i], 2.0)
        np.testing.assert_allclose(runs.dt[i], h, rtol=1e-14)
        found = jax.tree.map(lambda x, i=i: x[i], (runs.q, runs.v, runs.acceleration, runs.multipliers))
        found, expected = (jax.tree.map(lambda x: x[1:], y) for y in (found, expected))  # a run saves the given start
        jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-10, atol=1e-11), found, expected)


@pytest.mark.slow
def test_equal_distances_give_what_duration_and_number_give():
    """Also where dt is their distance, or a part of it, to rounding."""
    dts = np.concatenate([[0.2, 0.1, 0.2 / 3, 0.02], DTS[:-4]])
    given = {"dts": dts, "t0": 1000.0}
    runs = sweep(**given, times=1000 + np.arange(1, 6) * 0.2)
    equal = sweep(**given, duration=1.0, num_samples=5)
    np.testing.assert_allclose(runs.dt, np.tile(equal.dt[:, None], 5), rtol=1e-11)
    np.testing.assert_allclose(runs.t, equal.t, rtol=1e-15)
    for name in ("q", "v", "acceleration"):
        np.testing.assert_allclose(getattr(runs, name), getattr(equal, name), atol=1e-10)


def test_times_are_data():
    sweep(dts=DTS, times=TIMES)
    compiled = run_sweep.number()
    for times in ([3, 4, 5, 6, 9], jnp.asarray(TIMES), TIMES.astype(np.float32)):
        sweep(dts=DTS, times=times)
    assert run_sweep.number() == compiled


def test_the_work_is_about_the_sum_over_the_members():
    system, counted = zoo.counting_oscillator()
    runs = hhtjax.sweep(system, hhtjax.rk4(), ONE, ZERO, dts=DTS[::-1][1:], times=[0.001, 1.0, 1.02])
    jax.effects_barrier()
    lanes, stages = 4, 4
    iterations, steps = lanes * len(counted) / stages, np.sum(np.diff(runs.t) / np.asarray(runs.dt))
    assert steps <= iterations < 1.1 * steps


@pytest.mark.slow
def test_order_two_where_steps_change_at_each_time():
    problem = zoo.PROBLEMS["forced double pendulum"]
    dts = 0.01 / 2 ** np.arange(4)
    runs = hhtjax.sweep(
        problem.system, hhtjax.hht(alpha=-0.3), problem.q0, problem.v0, problem.params, dts=dts,
        times=[0.037, 0.347, 0.3673, 0.7673, problem.duration],
    )  # fmt: skip
    assert np.all(np.ptp(runs.dt, axis=1) > 0.04 * dts)
    error = np.linalg.norm(np.asarray(runs.q[:, -1]) - zoo.reference("forced double pendulum"), axis=1)
    assert np.polyfit(np.log(dts), np.log(error), 1)[0] == pytest.approx(2, abs=0.15)


@pytest.mark.slow
def test_derivatives_in_params_and_times_forward_and_reverse():
    def loss(k, times):
        runs = hhtjax.sweep(SPRING, STEPPER, ONE, ZERO, PARAMS | {"k": k}, t0=2.0, dts=[0.012, 0.07], times=times)
        return jnp.sum(runs.q[:, 1:, 0] ** 2 @ jnp.arange(1.0, 6.0)) + jnp.sum(runs.v)

    @jax.jit
    def along(k, times, dk, dtimes):
        return jax.jvp(loss, (k, times), (dk, dtimes))

    reverse = jax.jit(jax.grad(loss, (0, 1)))(4.0, TIMES)
    directions = [(1.0, np.zeros(5)), *((0.0, e) for e in np.eye(5))]
    forward = [along(4.0, TIMES, *direction)[1] for direction in directions]
    np.testing.assert_allclose([reverse[0], *reverse[1]], forward, rtol=1e-10)
    h, central = 1e-5, []
    for dk, e in directions:
        plus, minus = (along(4.0 + s * dk, TIMES + s * e, dk, e)[0] for s in (h, -h))
        central.append((plus - minus) / (2 * h))
    np.testing.assert_allclose(reverse[0], central[0], rtol=1e-7)
    np.testing.assert_allclose(reverse[1], central[1:], rtol=1e-6)


def broken(q, v, t, params):
    """A spring up to t = 2.5."""
    return jnp.where(t > 2.5, jnp.nan, -4 * q)


@jax.jit
def broken_runs(times, dts):
    """Their times are tracers, which pass unchecked."""
    return hhtjax.sweep(hhtjax.System(ONE, broken), STEPPER, ONE, ZERO, dts=dts, times=times, t0=2.0)


def test_a_failure_is_named_by_step_and_time():
    """Five steps to 2.1, two to 2.13, then 19 of 0.47/24."""
    runs = broken_runs(TIMES, np.array([0.02, 0.3]))
    with pytest.raises(hhtjax.SimulationError, match=r"member 0 \(2 of 2 failed\), step 26 \(to t = 2.50208\) failed"):
        runs.check()
    for reach, where in ((0.03, r"step 7 \(to t = 2.13\)"), (0.01, r"step 5 \(to t = 2.1\)")):
        with pytest.raises(hhtjax.SimulationError, match=rf"member 0 .*, {where} .* farther than {reach}"):
            runs.check(reach=reach)


@pytest.mark.parametrize(
    ("times", "good"),
    [
        ([2.1, 2.2, 2.2, 2.3, 2.4], 2),
        ([2.1, 2.05, 2.2, 2.3, 2.4], 1),
        ([2.1, 2.2, 2.3, 2.4, np.inf], 4),
        ([2.1, 2.2, 2.3, 2.4, np.nan], 4),
    ],
)
def test_traced_times_that_do_not_increase_and_step_sizes_that_are_negative_are_failures(times, good):
    runs = broken_runs(np.array(times), np.array([0.02, -1.0]))
    np.testing.assert_array_equal(np.isfinite(runs.q[0, :, 0]), np.arange(6) <= good)
    np.testing.assert_array_equal(runs.failure.step, [np.rint((times[good - 1] - 2) / 0.02) + 1, 1])
    with pytest.raises(
        hhtjax.SimulationError, match="`times` must increase, and lie after t0; with t0 in front they were"
    ):
        runs.check()


def test_a_traced_time_that_is_no_number_is_a_failure():
    """Also of a stepper for which all steps of an interval are alike, and might be none."""
    start = SPRING, hhtjax.rk4(), ONE, ZERO, PARAMS
    runs = jax.jit(lambda times: hhtjax.sweep(*start, dts=DTS, times=times))(np.array([0.1, 0.2, np.nan]))
    np.testing.assert_array_equal(np.isfinite(runs.q[:, :, 0]), len(runs.q) * [[True, True, True, False]])
    assert np.all(runs.failure.step > 0)


@pytest.mark.slow
def test_dense_output_between_the_times():
    """Motions of second degree are exact for every step, and for cubics between samples."""
    ball = hhtjax.System(ONE, lambda q, v, t, params: 0 * q - 9.81)
    runs = hhtjax.sweep(ball, hhtjax.rk4(), ZERO, ONE, dts=[0.1, np.inf], times=TIMES - 2)
    t = np.linspace(0.0, 1.3, 40)
    found = jax.vmap(lambda run: hhtjax.interpolate(run, t))(runs)
    for member in range(2):
        np.testing.assert_allclose(found.q[member, :, 0], t - 4.905 * t**2, atol=1e-13)
        np.testing.assert_allclose(found.v[member, :, 0], 1 - 9.81 * t, atol=1e-13)


@pytest.mark.slow
def test_on_disk(tmp_path):
    def write(times):
        return hhtjax.sweep_to_disk(
            tmp_path / "sweep", SPRING, hhtjax.rk4(), ONE, ZERO, PARAMS, dts=DTS[::14], times=times, chunk=2
        )

    read = hhtjax.load_sweep(write(TIMES))
    runs = hhtjax.sweep(SPRING, hhtjax.rk4(), ONE, ZERO, PARAMS, dts=DTS[::14], times=TIMES)
    np.testing.assert_array_equal(read["dt"], runs.dt)
    np.testing.assert_array_equal(read["t"], runs.t)
    np.testing.assert_allclose(read["q"], runs.q, atol=1e-13)
    with pytest.raises(ValueError, match="holds another sweep, whose inputs"):
        write(TIMES + 0.001)


def test_single_precision_rounds_times_first():
    runs = partial(
        hhtjax.sweep, SPRING, hhtjax.rk4(), ONE.astype(np.float32), ZERO.astype(np.float32), PARAMS, dts=[0.01], t0=100
    )
    times = 100 + 0.01 * np.arange(1, 21)
    with pytest.warns(hhtjax.PrecisionWarning):
        found = runs(times=times)
    assert {x.dtype for x in (found.q, found.t, found.dt)} == {np.dtype(np.float32)}
    np.testing.assert_array_equal(found.dt[0], np.diff(times.astype(np.float32), prepend=np.float32(100)))
    with (
        pytest.warns(hhtjax.PrecisionWarning),
        pytest.raises(ValueError, match=r"increasing, and after t0, in float32; .* times.1. = 101.0 after times.0."),
    ):
        runs(times=[101.0, 101.0 + 1e-6])


ORDER = r"`times` must be strictly increasing, and after t0, in float64; received times"
ONE_WAY = "give `duration` and `num_samples`, or `times` alone; received"
WRONG = {
    "unsorted": ({"times": [2.1, 2.5, 2.3]}, rf"{ORDER}.2. = 2.3 after times.1. = 2.5"),
    "twice": ({"times": [2.1, 2.1]}, rf"{ORDER}.1. = 2.1 after times.0. = 2.1"),
    "the start": ({"times": [2.0, 2.1]}, rf"{ORDER}.0. = 2.0 after t0 = 2.0"),
    "before the start": ({"times": [-1, 3]}, rf"{ORDER}.0. = -1.0 after t0 = 2.0"),
    "not a number": ({"times": [2.1, np.nan]}, r"`times` must be finite; received times.1. = nan"),
    "infinite": ({"times": [np.inf]}, r"`times` must be finite; received times.0. = inf"),
    "a scalar": ({"times": 3.0}, r"`times` must have shape \(K,\), one or more; received \(\)"),
    "two axes": ({"times": [[2.1, 2.2]]}, r"`times` must have shape \(K,\), one or more; received \(1, 2\)"),
    "none": ({"times": []}, r"`times` must have shape \(K,\), one or more; received \(0,\)"),
    "text": ({"times": ["noon"]}, "`times` must be real numbers"),
    "booleans": ({"times": [True]}, "`times` must be real numbers"),
    "both ways": ({"duration": 1.0, "num_samples": 5}, ONE_WAY),
    "one and a half": ({"duration": 1.0}, ONE_WAY),
    "neither way": ({"times": None}, ONE_WAY),
    "half a way": ({"times": None, "num_samples": 5}, f"{ONE_WAY} duration=None, num_samples=5, times=None"),
    "negative steps": ({"dts": [0.1, -0.1]}, r"`dts` must be positive; received dts.1. = -0.1"),
    "too many steps": ({"dts": [1e-10]}, "`dts` must take fewer than 2.31 steps"),
}


@pytest.mark.parametrize("name", WRONG)
def test_bad_input_is_named(name):
    changed, message = WRONG[name]
    with pytest.raises((ValueError, TypeError), match=f"sweep: {message}"):
        sweep(**{"dts": DTS, "times": TIMES} | changed)


@pytest.mark.parametrize("stepper", [hhtjax.houbolt(), hhtjax.park()], ids=["Houbolt", "Park"])
def test_steppers_that_need_equal_steps_refuse_times(stepper, tmp_path):
    for call in (hhtjax.sweep, partial(hhtjax.sweep_to_disk, tmp_path / "none")):
        with pytest.raises(NotImplementedError, match=r"sweep: (Houbolt|Park) needs steps of one size, which differ"):
            call(SPRING, stepper, ONE, ZERO, PARAMS, dts=[0.1], times=[1.0])
