"""Internal states in analysis, dense output, held inputs, fits, files, energies, and where input is bad."""

from functools import partial
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import check_message

import hhtjax
from hhtjax.scenes import maxwell

STATES = jnp.array([0.3]), jnp.array([0.5]), jnp.array([0.2, -0.1])


def linear_rates(matrix):
    """A system of one coordinate and two internal states, (v, w, zdot) = matrix (q, v, z)."""

    def rates(q, v, z):
        return jnp.asarray(matrix) @ jnp.concatenate([q, v, z])

    return hhtjax.System(
        jnp.ones(1),
        lambda q, v, z, t, params: rates(q, v, z)[1:2],
        internal=lambda q, v, z, t, params: rates(q, v, z)[2:],
    )


A = np.array([[0, 1, 0, 0], [-9.0, -0.2, 1.0, 0.0], [0.0, 2.0, -3.0, 0.5], [1.0, 0.3, 0.0, -200.0]])


@pytest.mark.slow
def test_amplification_is_the_trapezoidal_rule():
    """hht(0) takes each eigenvalue s of the equations to (1 + s h/2)/(1 - s h/2)."""
    system, stepper, h = linear_rates(A), hhtjax.newmark(linearize="predictor"), 0.1
    state = stepper.init(system, *STATES[:2], None, h, z0=STATES[2])
    found = np.linalg.eigvals(hhtjax.analysis.amplification_matrix(system, stepper, state, dt=h))
    for s in np.linalg.eigvals(A):
        assert np.min(np.abs(found - (1 + s * h / 2) / (1 - s * h / 2))) < 1e-9


@pytest.mark.slow
def test_suggested_step_size_sees_the_modes_of_internal_states():
    found = hhtjax.analysis.suggest_step_size(linear_rates(A), hhtjax.hht(), *STATES[:2], z0=STATES[2], highest=10.0)
    expected = sorted(abs(s) for s in np.linalg.eigvals(A) if s.imag >= 0)
    np.testing.assert_allclose([mode.frequency for mode in found.modes], expected, rtol=1e-6)
    assert [mode.resolved for mode in found.modes] == [True, True, False]


@pytest.mark.slow
def test_dense_and_extrapolated_output_of_z():
    """A z (3, 3) is nine numbers: zdot = cos(t + i), interpolated to fourth order, extrapolated beyond the second."""
    phase = np.arange(9.0).reshape(3, 3)
    system = hhtjax.System(
        jnp.ones(3), lambda q, v, z, t, p: -q - z[0], internal=lambda q, v, z, t, p: jnp.cos(t + phase)
    )
    times = jnp.linspace(0.0, 1.0, 33)
    exact = np.sin(np.asarray(times)[:, None, None] + phase)
    run = partial(hhtjax.simulate, system, hhtjax.newmark(), jnp.ones(3), jnp.zeros(3), z0=np.sin(phase))
    errors = [np.max(np.abs(hhtjax.interpolate(run(dt=1 / n, num_steps=n, extrapolate=3), times).z - exact))
              for n in (4, 8)]  # fmt: skip
    assert np.log2(errors[0] / errors[1]) == pytest.approx(4, abs=0.3)


@pytest.mark.slow
@pytest.mark.parametrize("stepper", [hhtjax.hht(-0.05), hhtjax.rosenbrock()], ids=["hht", "rosenbrock"])
def test_held_inputs_restart_internal_states(stepper):
    values = jnp.array([1.0, -2.0, 0.5])
    system = hhtjax.System(
        jnp.ones(1),
        lambda q, v, z, t, params: params(t) + z - q,
        internal=lambda q, v, z, t, params: 5.0 * params(t) * jnp.cos(q) - 4.0 * z - v,
    )

    @jax.jit
    def end(steps):
        dt, params = 0.1 / steps.astype(float), hhtjax.sampled(values, 0.1, order=0)
        state = stepper.init(system, jnp.ones(1), jnp.zeros(1), params, dt, z0=jnp.zeros(1))
        advance = lambda _, s: stepper.step(system, s, params, dt)[0]  # noqa: E731
        state = jax.lax.fori_loop(0, 3 * steps, advance, state)
        return jnp.concatenate([state.q, state.v, state.z])

    ends = [end(jnp.array(n)) for n in (8, 16, 32)]
    changes = [np.linalg.norm(x - y) for x, y in pairwise(ends)]
    assert np.log2(changes[0] / changes[1]) == pytest.approx(2, abs=0.15)


@pytest.mark.slow
def test_z0_of_several_records_is_fitted_along():
    """As a start that each record has of its own, with a parameter of g that they share."""
    system = hhtjax.System(
        jnp.ones(1), lambda q, v, z, t, params: z - 9.0 * q, internal=lambda q, v, z, t, params: -params["rate"] * z - v
    )

    def path(params, start):
        run = hhtjax.simulate(system, hhtjax.newmark(linearize="predictor"), *STATES[:2], params, z0=start["z"],
                              dt=0.05, num_steps=40)  # fmt: skip
        return run.q

    true, starts = {"rate": 2.0}, {"z": jnp.array([[0.7], [-1.5]])}
    records = jax.vmap(lambda start: path(true, start))(starts)
    result = hhtjax.fit(
        lambda params, start, record: path(params, start) - record,
        {"rate": 1.0}, records=records, starts=jax.tree.map(jnp.zeros_like, starts),
    )  # fmt: skip
    assert float(result.params["rate"]) == pytest.approx(2.0, rel=1e-6)
    np.testing.assert_allclose(result.starts["z"], starts["z"], rtol=1e-5)


def test_sweeps_on_disk(tmp_path):
    system = linear_rates(A)
    grid = {"dts": [0.1, 0.05], "duration": 0.2, "num_samples": 1, "z0": STATES[2]}
    hhtjax.sweep_to_disk(tmp_path / "sweep", system, hhtjax.rk4(), *STATES[:2], **grid)
    found = hhtjax.load_sweep(tmp_path / "sweep")
    assert found["z"].shape == found["zdot"].shape == (2, 2, 2)
    np.testing.assert_allclose(found["zdot"][0, 0], (A @ np.concatenate(STATES))[2:])


@pytest.mark.slow
def test_energy_that_an_internal_state_takes():
    """A Maxwell branch: the spring's force takes what it stores and what its damper makes heat."""
    system, params, q0, v0, _, z0 = maxwell.vibration()
    params = {**params, "amplitude": 0.0}
    run = hhtjax.simulate(system, hhtjax.rosenbrock(), q0, v0, params, z0=z0, dt=1e-5, num_steps=2000)
    spring = lambda q, t, params: params["k"] * jnp.sum(q**2) / 2  # noqa: E731
    found = hhtjax.analysis.energy_balance(system, run, params, spring)
    taken = -np.trapezoid(np.sum(run.z, axis=1) * run.v[:, 0], run.t)
    assert found.work[-1] == pytest.approx(taken, rel=1e-6)
    assert abs(found.error[-1]) < 1e-6 * abs(taken)


@pytest.mark.slow
def test_consistent_initial_values_with_z():
    """The multiplier of a rod holds the force of z too; z0 stays."""
    system = hhtjax.System(
        jnp.ones(2),
        lambda q, v, z, t, params: z["pull"],
        lambda q, t, params: jnp.sum(q**2, keepdims=True) / 2 - 0.5,
        internal=lambda q, v, z, t, params: {"pull": -z["pull"]},
    )
    start = hhtjax.consistent_initial(system, jnp.array([1.1, 0.0]), jnp.zeros(2), z0={"pull": jnp.array([3.0, 1.0])})
    np.testing.assert_allclose(start.multipliers, [-3.0], rtol=1e-12)
    np.testing.assert_allclose(start.acceleration, [0.0, 1.0], atol=1e-12)


@pytest.mark.slow
def test_lagrangians_take_internal_states():
    def force(q, v, z, t, params):
        return z - 0.1 * v

    lagged = hhtjax.System.from_lagrangian(
        lambda q, v, t, params: jnp.sum(v**2) - 2 * jnp.sum(q**2), force, internal=lambda q, v, z, t, params: v - z
    )
    one = jnp.ones(2)
    np.testing.assert_allclose(lagged.force(one, 2 * one, 3 * one, 0.0, None), (3 - 0.2 - 4) * one)
    run = hhtjax.simulate(lagged, hhtjax.rk4(), one, one, z0=one, dt=0.1, num_steps=1)
    np.testing.assert_allclose(run.acceleration[0], (1 - 0.1 - 4) / 2 * one)


def test_float32_is_kept():
    values = [jnp.asarray(x, jnp.float32) for x in STATES]
    with pytest.warns(hhtjax.PrecisionWarning):
        run = hhtjax.simulate(
            linear_rates(A.astype(np.float32)), hhtjax.rk4(), *values[:2], z0=values[2], dt=0.001, num_steps=2
        )
    assert {x.dtype for x in jax.tree.leaves((run.q, run.v, run.z, run.zdot))} == {jnp.dtype("float32")}


@pytest.mark.parametrize("stepper", [hhtjax.rk4(), hhtjax.hht()], ids=["rk4", "hht"])
def test_an_internal_state_that_is_not_finite_is_named(stepper):
    system = hhtjax.System(
        jnp.ones(1), lambda q, v, z, t, p: z, internal=lambda q, v, z, t, p: jnp.where(t > 0.25, jnp.nan, 1.0) * z
    )
    one = jnp.ones(1)
    run = hhtjax.simulate(system, stepper, one, one, z0=one, dt=0.1, num_steps=5)
    check_message(hhtjax.SimulationError, "the internal state z is not finite", run.check)


def returning(zdot):
    return hhtjax.System(jnp.ones(1), lambda q, v, z, t, p: -q, internal=lambda q, v, z, t, p: zdot)


def spoilt(system=None, stepper=None, z0=STATES[2], **options):
    system = linear_rates(A) if system is None else system
    stepper = hhtjax.hht() if stepper is None else stepper
    return lambda: hhtjax.simulate(system, stepper, *STATES[:2], z0=z0, dt=0.1, num_steps=1, **options)


def four(q, v, s, p):
    return -q


PLAIN = hhtjax.System(jnp.ones(1), lambda q, v, t, params: -q)
FIVE = "force(q, v, z, t, params)"
BAD = [
    (ValueError, "simulate: leave `z0` out: the system has no internal states", spoilt(PLAIN)),
    (ValueError, "simulate: `z0` must be given: the system has internal states.", spoilt(z0=None)),
    (ValueError, "simulate: `z0` must hold at least one number", spoilt(z0=())),
    (ValueError, "simulate: `z0` must be finite", spoilt(z0=jnp.array([1.0, np.nan]))),
    (TypeError, "simulate: `q0`, `v0` and `z0` must share one dtype", spoilt(z0=STATES[2].astype("float32"))),
    (ValueError, "simulate: `internal` must return a pytree like z0, shape (2,) float64; received shape (3,)",
     spoilt(returning(jnp.ones(3)))),
    (TypeError, f"System: `force` is called as {FIVE}", lambda: hhtjax.System(1.0, four, internal=FIVE.format)),
    (TypeError, FIVE, lambda: hhtjax.System(1.0, lambda q, v, t, params: -q, internal=lambda q, v, z, t, params: z)),
    (TypeError, "`internal` must be a function internal(q, v, z, t, params); received 3",
     lambda: hhtjax.System(1.0, lambda q, v, z, t, params: z, internal=3)),
    (TypeError, "System.from_lagrangian: `force` is called as " + FIVE,
     lambda: hhtjax.System.from_lagrangian(four, four, internal=lambda q, v, z, t, params: z)),
    (ValueError, "sweep: `in_axes` must be a tuple of four, (stepper, q0, v0, params), or of five, with z0",
     lambda: hhtjax.sweep(PLAIN, hhtjax.hht(), *STATES[:2], dts=[0.1], duration=1.0, num_samples=1, in_axes=(0,))),
    *[
        (NotImplementedError, "cannot solve the `internal` states; use hht()", spoilt(stepper=stepper))
        for stepper in (hhtjax.houbolt(), hhtjax.wilson(), hhtjax.kim_hht(), hhtjax.conventional_hht(),
                        hhtjax.operator_splitting(), hhtjax.kim_implicit_euler(), hhtjax.park())
    ],
    (NotImplementedError, "step_size_bias: `system` has internal states",
     lambda: hhtjax.step_size_bias(linear_rates(A), hhtjax.hht(), None, 0.1, STATES[0])),
    (NotImplementedError, "equation_error: `system` has internal states",
     lambda: hhtjax.equation_error(linear_rates(A), jnp.ones((9, 1)), 0.1, 1.0)),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "message", "call"), BAD, ids=lambda x: x[:40] if isinstance(x, str) else "")
def test_bad_input(kind, message, call):
    check_message(kind, message, call)


@pytest.mark.slow
def test_at_a_sample_all_copies_of_a_time_are_in_one_interval():
    """3 * .1/.1 by a division is 3, and by a product with 10 a little more or less: XLA makes some of them products."""
    drive = hhtjax.sampled(np.sin(np.linspace(0, 1, 11)), 0.1, order=1)
    system = hhtjax.System(
        np.ones(1),
        lambda q, v, z, t, params: -params["k"] * q - z + params["u"](t),
        internal=lambda q, v, z, t, params: v - z,
    )

    def run(k):
        start = np.ones(1), np.zeros(1), {"k": k, "u": drive}
        return hhtjax.simulate(system, hhtjax.hht(0.0), *start, z0=np.zeros(1), dt=2e-3, num_steps=160).acceleration

    batch, _ = jax.vmap(lambda k: jax.jvp(run, (k,), (1.0,)))(jnp.array([3.0, 5.0]))
    np.testing.assert_allclose(batch[0], run(3.0), atol=1e-12)
