"""Systems and steppers under transformations: static, traced, batched and differentiated; and compiled once."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import zoo
from descriptions import DESCRIPTIONS, ONE, TWO, lagrangian, pull, run

import hhtjax
from hhtjax import LinearSystem, System
from hhtjax.runs.error_control import Steps, trimmed
from hhtjax.scenes import double_pendulum

# ---------------------------------------------------------------------------------------------- jit


@pytest.mark.parametrize("name", ["mass 2", "mass function", "lagrangian", "linear, stiff", "hht 0.1 as data", "rk4"])
def test_as_static_argument_equal_descriptions_share_a_compilation(name):
    traces = []

    @partial(jax.jit, static_argnums=0)
    def double(description, x):
        traces.append(description)
        return 2 * x

    double(DESCRIPTIONS[name](), 1.0)
    double(DESCRIPTIONS[name](), 2.0)
    assert len(traces) == 1
    double(DESCRIPTIONS["mass 1"](), 1.0)
    assert len(traces) == 2


def test_a_run_with_static_descriptions_is_the_run():
    @partial(jax.jit, static_argnums=(0, 1))
    def end(system, stepper, q0):
        return run(system, stepper, q0).q[-1]

    system, stepper = LinearSystem(TWO, K=4 * ONE), hhtjax.hht(alpha=-0.1)
    assert np.allclose(end(system, stepper, ONE), run(system, stepper).q[-1], rtol=1e-14)


def test_descriptions_may_be_arguments_of_jit_and_vmap():
    """Then their arrays are traced: one compilation for all masses, and a batch of systems is one system."""
    traces = []

    @jax.jit
    def end(system, stepper):
        traces.append(None)
        return run(system, stepper).q[-1, 0]

    alphas, masses = [jnp.asarray(x, jnp.float64) for x in (0.0, -0.1, -0.3)], [ONE, TWO, 3 * ONE]
    single = [end(System(m, pull), hhtjax.hht(alpha=a)) for m, a in zip(masses, alphas, strict=True)]
    assert len(traces) == 1
    assert len(set(map(float, single))) == 3
    assert np.isclose(single[1], run(System(TWO, pull), hhtjax.hht(alpha=-0.1)).q[-1, 0], rtol=1e-13)
    batch = jax.tree.map(lambda *x: jnp.stack(x), *(System(m, pull) for m in masses))
    steppers = jax.vmap(lambda alpha: hhtjax.hht(alpha=alpha))(jnp.stack(alphas))
    assert np.allclose(jax.vmap(end)(batch, steppers), single, rtol=1e-13)


# ---------------------------------------------------------------------------------------------- derivatives


def check_derivative(f, x, rtol=1e-7):
    """Forward = reverse = central differences, for f of one number; returns the derivative."""
    f, x = jax.jit(f), jnp.asarray(x, jnp.float64)
    forward, reverse = jax.jit(jax.jacfwd(f))(x), jax.jit(jax.grad(f))(x)
    h = 1e-4
    central = (8 * (f(x + h) - f(x - h)) - (f(x + 2 * h) - f(x - 2 * h))) / (12 * h)
    assert np.isclose(forward, reverse, rtol=1e-12)
    assert np.isclose(forward, central, rtol=rtol)
    return forward


def test_gradient_with_respect_to_a_mass_in_a_system_made_in_a_traced_function():
    """And it is that of a mass in params."""
    stepper = hhtjax.hht(alpha=-0.1, linearize="predictor")
    by_params = System(lambda q, params: params["m"][None], pull)
    expected = jax.grad(lambda m: run(by_params, stepper, params={"m": m}).q[-1, 0])(2.0)
    found = check_derivative(lambda m: run(System(m[None], pull), stepper).q[-1, 0], 2.0)
    assert np.isclose(found, expected, rtol=1e-12)
    assert abs(found) > 1e-2


@pytest.mark.slow
def test_gradient_with_respect_to_a_whole_system():
    """The gradient is a system whose arrays are derivatives: here of all three matrices, against differences."""
    system = LinearSystem(TWO, C=ONE, K=9 * ONE)

    @jax.jit
    def end(system):
        return run(system, hhtjax.newmark()).q[-1, 0]

    gradient = jax.grad(end)(system)
    assert type(gradient) is LinearSystem
    for name in "MCK":
        plus, minus = (
            end(LinearSystem(**{"M": TWO, "C": ONE, "K": 9 * ONE, name: getattr(system, name) + h}))
            for h in (1e-5, -1e-5)
        )
        assert abs(getattr(gradient, name)[0]) > 1e-3
        assert np.isclose(getattr(gradient, name)[0], (plus - minus) / 2e-5, rtol=1e-7)


def test_gradient_with_respect_to_alpha():
    system = System(ONE, lambda q, v, t, params: -4.0 * jnp.sin(q))
    slope = check_derivative(
        lambda x: run(system, hhtjax.hht(alpha=x, linearize="predictor"), v0=ONE, dt=0.3).q[-1, 0], -0.1
    )
    assert abs(slope) > 1e-3


# ---------------------------------------------------------------------------------------------- compilations


def counted(calls):
    """A force that counts how often Python calls it: while tracing only."""

    def force(q, v, t, params):
        calls.append(None)
        return jax.tree.map(lambda x, k: -k * x, q, params["k"])

    return force


CHANGES = {
    "dt": {"dt": 0.05},
    "integer dt": {"dt": 1},
    "dt of NumPy": {"dt": np.float64(0.05)},
    "dt in float32": {"dt": np.float32(0.05)},
    "dt of JAX": {"dt": jnp.asarray(0.05, jnp.float64)},
    "t0": {"t0": 0.5},
    "integer t0": {"t0": 1},
    "q0": {"q0": {"x": TWO}},
    "q0 of JAX": {"q0": {"x": jnp.asarray(TWO)}},
    "integer q0": {"q0": {"x": np.array([3])}},
    "v0": {"v0": {"x": TWO}},
    "params": {"params": {"k": {"x": 9.0}}},
    "nothing": {},
}


@pytest.mark.parametrize("stepper", [hhtjax.hht(alpha=-0.05), hhtjax.rk4()], ids=["hht", "rk4"])
def test_new_values_cost_no_compilation(stepper):
    calls = []
    system = System(ONE, counted(calls))
    arguments = {"q0": {"x": ONE}, "v0": {"x": 0 * ONE}, "params": {"k": {"x": 4.0}}, "dt": 0.1, "t0": 0.0}
    first = run(system, stepper, **arguments)
    count = len(calls)
    assert 0 < count < 100
    recompiled = []
    for name, change in CHANGES.items():
        solution = run(system, stepper, **{**arguments, **change})
        if len(calls) > count:
            recompiled.append(name)
        count = len(calls)
        same = all(np.array_equal(x, y) for x, y in zip(*map(jax.tree.leaves, (solution, first)), strict=True))
        assert same == (name == "nothing"), name
    assert recompiled == []


def test_equal_systems_and_steppers_made_anew_cost_no_compilation():
    calls = []
    force = counted(calls)
    params = {"k": 4.0}
    run(System(np.ones(1), force), hhtjax.hht(alpha=-0.05), params=params)
    count = len(calls)
    assert count > 0
    run(System(np.ones(1), force), hhtjax.hht(alpha=-0.05), params=params)
    run(System(jnp.ones(1), force), hhtjax.hht(alpha=-0.05), params=params)
    run(System(np.full(1, 3.0), force), hhtjax.hht(alpha=-0.05), params=params)  # a mass is data
    assert len(calls) == count
    run(System(np.ones(1), force), hhtjax.hht(alpha=-0.1), params=params)  # a Python number is program
    assert len(calls) > count
    count = len(calls)
    for alpha in (-0.1, -0.2, -0.3):  # an array is data
        run(System(np.ones(1), force), hhtjax.hht(alpha=jnp.asarray(alpha, jnp.float64)), params=params)
        if alpha == -0.1:
            count = len(calls)
    assert len(calls) == count


def test_an_equal_lagrangian_costs_no_compilation():
    calls = []

    def counted_lagrangian(q, v, t, params):
        calls.append(None)
        return lagrangian(q, v, t, params)

    run(System.from_lagrangian(counted_lagrangian), hhtjax.rk4())
    count = len(calls)
    assert count > 0
    run(System.from_lagrangian(counted_lagrangian), hhtjax.rk4())
    assert len(calls) == count


def test_num_steps_and_save_every_are_part_of_the_program():
    """The counter counts: what must cost a compilation does."""
    calls = []
    system = System(ONE, counted(calls))
    counts = []
    for options in ({"num_steps": 4}, {"num_steps": 6}, {"num_steps": 6, "save_every": 2}):
        run(system, hhtjax.rk4(), params={"k": 4.0}, **options)
        counts.append(len(calls))
    assert 0 < counts[0] < counts[1] < counts[2]


@pytest.mark.slow
def test_both_solves_of_a_step_are_one_traced_function():
    """About the predicted state and about the held one."""
    scene = double_pendulum.free()
    stepper, dt = hhtjax.hht(), jnp.asarray(1e-3)
    state = stepper.init(scene.system, scene.q0, scene.v0, scene.params, dt)
    step = jax.make_jaxpr(lambda state: stepper.step(scene.system, state, scene.params, dt)[0])(state)
    solves = [eqn.params["jaxpr"] for eqn in zoo.everywhere(step.jaxpr) if eqn.params.get("name") == "solution"]
    assert len(solves) == 2
    assert solves[0] is solves[1]


def test_no_number_of_chosen_steps_is_compiled_for(caplog):
    """Outside of a jit, where `dt` has as many numbers as there are steps."""
    steps = Steps(jnp.ones(50), *6 * [jnp.ones((), jnp.int32)])
    with jax.log_compiles():
        found = [trimmed(steps._replace(accepted=jnp.array(n, jnp.int32))).dt for n in (7, 11)]
    assert [x.shape for x in found] == [(7,), (11,)]
    assert not [record for record in caplog.records if "Compiling" in record.getMessage()]
