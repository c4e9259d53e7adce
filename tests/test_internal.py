"""Internal states: orders, equivalences, derivatives, one factorisation, sweeps, dense output, analysis, bad input."""

from dataclasses import replace
from functools import partial
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import check_gradient, check_message
from internal_problems import CASES, LAG, arm, reference
from jax.flatten_util import ravel_pytree
from zoo import everywhere

import hhtjax
from hhtjax.scenes import bouc_wen, lugre, maxwell, motor_joint
from hhtjax.steppers.residual import Coefficients

FAMILY = {
    **{f"hht({alpha})": hhtjax.hht(alpha) for alpha in (0.0, -0.05, -0.3)},
    **{f"generalized_alpha({rho})": hhtjax.generalized_alpha(rho) for rho in (0.0, 0.5, 1.0)},
}
STEPS = 800, 1600


def stacked(stepper):
    """All of FAMILY, with the options of `stepper`, as data."""
    columns = zip(*(s.coefficients for s in FAMILY.values()), strict=True)
    return replace(stepper, coefficients=Coefficients(*map(jnp.array, columns)))


def ends(case, stepper, num_steps):
    """q, v, z and L at the end, for each number of steps."""

    def end(num_steps):
        dt = case.duration / num_steps.astype(float)
        start = stepper.init(case.system, case.q0, case.v0, case.params, dt, z0=case.z0)

        def advance(_, s):
            return stepper.step(case.system, s, case.params, dt)[0]

        s = jax.lax.fori_loop(0, num_steps, advance, start)
        return [jnp.zeros(0) if x is None else ravel_pytree(x)[0] for x in (s.q, s.v, s.z, s.L)]

    return jax.lax.map(end, num_steps)


ends_of_family = jax.jit(jax.vmap(ends, (None, 0, None)))


def orders(case, found, steps):
    """Observed orders in q, v, z and L."""
    slopes = []
    for x, exact in zip(found, reference(case), strict=True):
        if exact is not None:
            error = np.linalg.norm(x - np.expand_dims(np.asarray(exact), tuple(range(x.ndim - 1))), axis=-1)
            slopes.append(np.log(error[..., 0] / error[..., 1]) / np.log(steps[1] / steps[0]))
    return np.array(slopes)


@pytest.mark.parametrize("name", CASES)
def test_order_two_in_all_of_the_state(name):
    """For each of FAMILY, with internal states as slow as the motion, and with one of a thousandth of the step."""
    for lag in (0.1, LAG):
        case = CASES[name](lag)
        stepper = stacked(hhtjax.hht(linearize="predictor" if "rotation" in name else None))
        found = orders(case, ends_of_family(case._replace(exact=None), stepper, jnp.array(STEPS)), STEPS)
        assert np.all(np.abs(found - 2) < 0.15), (lag, found)


@pytest.mark.parametrize("stepper", [hhtjax.rk4(), hhtjax.rowda()], ids=["rk4", "rowda"])
def test_steppers_of_other_orders(stepper):
    case, steps = arm(0.1), (50, 100)
    found = orders(case, jax.jit(ends)(case, stepper, jnp.array(steps)), steps)
    assert np.all(np.abs(found - stepper.order) < 0.35), found


def decoupled_rate(y, t, params):
    return {"x": jnp.cos(3 * t) - params["a"] * y["x"] ** 3, "y": y["x"][:1] - y["y"]}


def test_system_and_first_order_system_are_the_two_ends():
    """A system whose force leaves z alone moves as without it, and its z as a FirstOrderSystem, to rounding."""
    q0, v0, z0 = jnp.array([0.3, -0.2]), jnp.array([0.5, -1.0]), {"x": jnp.array([1.0, 2.0]), "y": jnp.ones(1)}
    pull = lambda q, v, t, params: -4.0 * q - 0.3 * v**3 + jnp.sin(t)  # noqa: E731
    M = jnp.array([[2.0, 0.3], [0.3, 1.0]])
    both = hhtjax.System(
        M, lambda q, v, z, t, p: pull(q, v, t, p), internal=lambda q, v, z, t, p: decoupled_rate(z, t, p)
    )
    run = partial(hhtjax.simulate, params={"a": 2.0}, dt=0.05, num_steps=40)
    stepper = hhtjax.hht(linearize="predictor")
    joint = run(both, stepper, q0, v0, z0=z0)
    mechanics = run(hhtjax.System(M, pull), stepper, q0, v0)
    states = run(hhtjax.FirstOrderSystem(decoupled_rate), stepper, z0)
    for x, y in ((joint.q, mechanics.q), (joint.v, mechanics.v), (joint.acceleration, mechanics.acceleration)):
        np.testing.assert_allclose(x, y, rtol=1e-12, atol=1e-13)
    for name in z0:
        np.testing.assert_allclose(joint.z[name], states.q[name], rtol=1e-12)
        np.testing.assert_allclose(joint.zdot[name], states.v[name], rtol=1e-12, atol=1e-12)
    assert mechanics.z is None
    assert states.z is None


SCENES = {
    "motor": motor_joint.tracking(),
    "Maxwell": maxwell.vibration(),
    "Bouc-Wen": bouc_wen.benchmark(),
    "LuGre": lugre.stick_slip(),
}


@pytest.mark.parametrize("name", SCENES)
def test_scenes_are_the_same_with_the_machinery_and_without(name):
    system, params, q0, v0, duration, z0 = SCENES[name]
    n = 2000 if name == "LuGre" else 400

    @partial(jax.jit, static_argnums=0)
    def simulated(way, dt):
        run = hhtjax.simulate(system, hhtjax.hht(), q0, v0, params, z0=z0, dt=dt, num_steps=n, save_every=n // 4)
        return ravel_pytree([run.q, run.v, run.z])[0], run.failure.step

    fast, failed = simulated("fast", duration / n)
    with hhtjax.plain():
        slow, _ = simulated("plain", duration / n)
    assert not failed
    np.testing.assert_allclose(fast, slow, rtol=1e-8, atol=1e-11 * np.max(np.abs(fast)))


def test_own_loop_and_sweep_equal_simulate():
    """Of a scene whose z0 differs between members."""
    system, params, q0, v0, _, z0 = SCENES["motor"]
    stepper, dt = hhtjax.hht(linearize="predictor"), 0.01
    z0 = jax.tree.map(lambda z: jnp.stack([z, z + 0.3]), z0)
    sweep = hhtjax.sweep(
        system, stepper, q0, v0, params, z0=z0, dts=[dt, dt], duration=4 * dt, num_samples=2,
        in_axes=(None, None, None, None, {"current": 0, "integral": 0}),
    )  # fmt: skip
    sweep.check()
    step = jax.jit(partial(stepper.step, system, params=params, dt=dt))
    for i in range(2):
        start = jax.tree.map(lambda z, i=i: z[i], z0)
        state = stepper.init(system, q0, v0, params, dt, z0=start)
        states = [state]
        for _ in range(4):
            state = step(state)[0]
            states.append(state)
        assert jax.tree.structure(state.za) == jax.tree.structure(start)
        expected = jax.tree.map(lambda *x: jnp.stack(x), *states[::2])
        found = jax.tree.map(lambda x, i=i: x[i], (sweep.q, sweep.v, sweep.acceleration, sweep.z, sweep.zdot))
        expected = expected.q, expected.v, expected.w, expected.z, expected.zdot
        jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-9, atol=1e-9), found, expected)


def test_gradients():
    """In z0, in the parameters of g and of the force, in q0, v0 and dt."""

    def force(q, v, z, t, params):
        return params["kt"] * z["i"] - jnp.sin(q) - 0.1 * v**3

    def internal(q, v, z, t, params):
        return {"i": jnp.cos(3 * t) - z["i"] / params["lag"] - params["kt"] * v, "s": q * v - z["i"] * z["s"]}

    system = hhtjax.System(jnp.array([1.5]), force, internal=internal)

    def loss(arguments):
        z0, params, q0, v0, dt = arguments
        stepper = hhtjax.hht(linearize="predictor")
        run = hhtjax.simulate(system, stepper, q0, v0, params, z0=z0, dt=dt, num_steps=12, save_every=6)
        return sum(jnp.sum(x**2) for x in jax.tree.leaves((run.q, run.v, run.z, run.zdot)))

    one = jnp.ones(1)
    found = check_gradient(
        loss, ({"i": 0.4 * one, "s": one}, {"kt": 0.7, "lag": 0.2}, one, 0.5 * one, 0.05), rtol=1e-12
    )
    assert np.all(found != 0)


def test_one_factorisation_of_all_rates_in_a_step():
    n, k = 20, 7
    system = hhtjax.System(
        jnp.ones(n),
        lambda q, v, z, t, p: -q - v**3 - z["a"].sum() * q,
        internal=lambda q, v, z, t, p: {"a": v[:k] - z["a"]},
    )
    stepper, x, z0 = hhtjax.hht(linearize="predictor"), jnp.ones(n), {"a": jnp.ones(k)}
    state = stepper.init(system, x, x, None, 0.1, z0=z0)
    jaxpr = jax.make_jaxpr(lambda s: stepper.step(system, s, None, 0.1))(state).jaxpr
    sizes = [eqn.invars[0].aval.shape for eqn in everywhere(jaxpr) if eqn.primitive.name == "lu"]
    assert sizes == [(n + k, n + k)]


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


def test_amplification_is_the_trapezoidal_rule():
    """hht(0) takes each eigenvalue s of the equations to (1 + s h/2)/(1 - s h/2)."""
    system, stepper, h = linear_rates(A), hhtjax.newmark(linearize="predictor"), 0.1
    state = stepper.init(system, *STATES[:2], None, h, z0=STATES[2])
    found = np.linalg.eigvals(hhtjax.analysis.amplification_matrix(system, stepper, state, dt=h))
    for s in np.linalg.eigvals(A):
        assert np.min(np.abs(found - (1 + s * h / 2) / (1 - s * h / 2))) < 1e-9


def test_suggested_step_size_sees_the_modes_of_internal_states():
    found = hhtjax.analysis.suggest_step_size(linear_rates(A), hhtjax.hht(), *STATES[:2], z0=STATES[2], highest=10.0)
    expected = sorted(abs(s) for s in np.linalg.eigvals(A) if s.imag >= 0)
    np.testing.assert_allclose([mode.frequency for mode in found.modes], expected, rtol=1e-6)
    assert [mode.resolved for mode in found.modes] == [True, True, False]


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


def test_z0_can_be_fitted():
    system, stepper = linear_rates(A[:, :] * [1, 1, 1, 0]), hhtjax.hht(linearize="predictor")

    def path(unknown):
        z0 = jnp.stack([unknown["z0"], jnp.zeros(())])
        return hhtjax.simulate(system, stepper, *STATES[:2], z0=z0, dt=0.02, num_steps=100).q

    measured = path({"z0": jnp.array(0.7)})
    result = hhtjax.fit(lambda unknown: path(unknown) - measured, {"z0": 0.1})
    assert float(result.params["z0"]) == pytest.approx(0.7, abs=1e-6)


def test_sweeps_on_disk(tmp_path):
    system = linear_rates(A)
    grid = {"dts": [0.1, 0.05], "duration": 0.2, "num_samples": 1, "z0": STATES[2]}
    hhtjax.sweep_to_disk(tmp_path / "sweep", system, hhtjax.rk4(), *STATES[:2], **grid)
    found = hhtjax.load_sweep(tmp_path / "sweep")
    assert found["z"].shape == found["zdot"].shape == (2, 2, 2)
    np.testing.assert_allclose(found["zdot"][0, 0], (A @ np.concatenate(STATES))[2:])


def test_energy_that_an_internal_state_takes():
    """A Maxwell branch: the spring's force takes what it stores and what its damper makes heat."""
    system, params, q0, v0, _, z0 = SCENES["Maxwell"]
    params = {**params, "amplitude": 0.0}
    run = hhtjax.simulate(system, hhtjax.rosenbrock(), q0, v0, params, z0=z0, dt=1e-5, num_steps=2000)
    spring = lambda q, t, params: params["k"] * jnp.sum(q**2) / 2  # noqa: E731
    found = hhtjax.analysis.energy_balance(system, run, params, spring)
    taken = -np.trapezoid(np.sum(run.z, axis=1) * run.v[:, 0], run.t)
    assert found.work[-1] == pytest.approx(taken, rel=1e-6)
    assert abs(found.error[-1]) < 1e-6 * abs(taken)


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
    (TypeError, f"System: `force` must be a function {FIVE}", lambda: hhtjax.System(1.0, four, internal=FIVE.format)),
    (TypeError, FIVE, lambda: hhtjax.System(1.0, lambda q, v, t, params: -q, internal=lambda q, v, z, t, params: z)),
    (TypeError, "`internal` must be a function internal(q, v, z, t, params); received 3",
     lambda: hhtjax.System(1.0, lambda q, v, z, t, params: z, internal=3)),
    (TypeError, "System.from_lagrangian: `force` must be a function " + FIVE,
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
