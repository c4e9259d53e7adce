"""Internal states: orders, equivalences, derivatives, one factorisation, sweeps, dense output, analysis, bad input."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import check_gradient
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


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_order_two_in_all_of_the_state(name):
    """For each of FAMILY, with internal states as slow as the motion, and with one of a thousandth of the step."""
    for lag in (0.1, LAG):
        case = CASES[name](lag)
        stepper = stacked(hhtjax.hht(linearize="predictor" if "rotation" in name else None))
        found = orders(case, ends_of_family(case._replace(exact=None), stepper, jnp.array(STEPS)), STEPS)
        assert np.all(np.abs(found - 2) < 0.15), (lag, found)


@pytest.mark.slow
def test_index_3_is_of_order_two_too():
    """But for the multipliers of the undamped rule, which grow with or without internal states."""
    case = CASES["a constraint"](LAG)
    stepper = stacked(hhtjax.hht(formulation="index3"))
    found = orders(case, ends_of_family(case._replace(exact=None), stepper, jnp.array(STEPS)), STEPS)
    damped = [i for i, name in enumerate(FAMILY) if name not in ("hht(0.0)", "generalized_alpha(1.0)")]
    assert np.all(np.abs(found[:3] - 2) < 0.15), found
    assert np.all(np.abs(found[3, damped] - 2) < 0.15), found


@pytest.mark.slow
def test_the_start_is_corrected_for_positions_alone():
    """What is faster than the step would start with an acceleration of 1/lag^2 else."""
    case = CASES["a constraint"](LAG)
    init = jax.jit(hhtjax.hht(-0.3).init)
    state = init(case.system, case.q0, case.v0, case.params, 1e-3, z0=case.z0 + 0.1)
    assert np.all(state.za == state.zdot)
    assert np.all(state.a != state.w)


@pytest.mark.slow
@pytest.mark.parametrize("stepper", [hhtjax.rk4(), hhtjax.rowda()], ids=["rk4", "rowda"])
def test_steppers_of_other_orders(stepper):
    case, steps = arm(0.1), (50, 100)
    found = orders(case, jax.jit(ends)(case, stepper, jnp.array(steps)), steps)
    assert np.all(np.abs(found - stepper.order) < 0.35), found


def decoupled_rate(y, t, params):
    return {"x": jnp.cos(3 * t) - params["a"] * y["x"] ** 3, "y": y["x"][:1] - y["y"]}


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
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
