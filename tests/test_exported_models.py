"""What exported C does beside the numbers of a run: derivatives, flags, inputs, names, refusals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled_c import Library, needs_compiler, numbers
from helpers import check_message, forward
from jax.flatten_util import ravel_pytree
from zoo import PROBLEMS

import hhtjax
from hhtjax import export_c, hht
from hhtjax.rotation import cross
from hhtjax.scenes import motor_joint, pendulum

pytestmark = needs_compiler


@pytest.fixture(scope="module")
def pendulum_library(tmp_path_factory):
    """The double pendulum with derivatives in its stiffnesses and one damper."""
    problem = PROBLEMS["forced double pendulum"]
    stepper = hht(-0.1, linearize="predictor")
    model = export_c(
        problem.system, stepper, problem.q0, problem.v0, problem.params, name="two", sensitivities=("k_0", "c_1")
    )
    return Library(model, tmp_path_factory.mktemp("two"), "-O2")


@pytest.mark.slow
def test_sensitivities_are_those_of_jax(pendulum_library):
    problem, dt, steps = PROBLEMS["forced double pendulum"], 1e-3, 1000
    stepper = hht(-0.1, linearize="predictor")

    def end(x):
        params = problem.params | {"k": (x[0], problem.params["k"][1]), "c": (problem.params["c"][0], x[1])}
        run = hhtjax.simulate(problem.system, stepper, problem.q0, problem.v0, params, dt=dt, num_steps=steps)
        return jnp.stack([run.q[-1], run.v[-1], run.acceleration[-1]])

    expected = jax.jacfwd(end)(jnp.array([problem.params["k"][0], problem.params["c"][1]]))
    state, _ = pendulum_library.begin(problem.q0, problem.v0, dt=dt)
    assert pendulum_library.run(state, steps, dt) == 0
    for i, name in enumerate("qvw"):
        for j, param in enumerate(("k_0", "c_1")):
            ours = numbers(state, f"d{name}_d{param}")
            assert np.max(abs(ours - expected[i, :, j])) < 1e-10 * np.max(abs(expected[i, :, j])), (name, param)


def hanging_body():
    """A rigid body on a point, off its axis."""
    J = jnp.array([0.8, 0.5, 0.9])

    def torque(R, Om, t, params):
        return cross(jnp.array([0.1, 0.0, 0.2]), -params["g"] * R[2]) - cross(Om, J * Om)

    problem = PROBLEMS["double pendulum"]
    system, v0 = hhtjax.System(J, torque), jnp.array([0.0, 0.5, 2.0])
    return problem._replace(system=system, params={"g": 9.81}, q0=jnp.eye(3), v0=v0)


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["rod", "motor", "body"])
def test_sensitivities_with_constraints_newton_and_rotations(scene, tmp_path):
    """Of velocities (and multipliers), in a parameter that moves them."""
    make, stepper, name, dt = {
        "rod": (pendulum.cartesian, hht(-0.1), "g", 1e-3),
        "motor": (motor_joint.tracking, hht(-0.1, iterations=None), "gear", 1e-3),
        "body": (hanging_body, hht(-0.1, linearize="predictor"), "g", 1e-3),
    }[scene]
    own = make()
    z0, steps = getattr(own, "z0", None), 200
    arguments = own.system, stepper, own.q0, own.v0
    library = Library(export_c(*arguments, own.params, z0=z0, sensitivities=(name,)), tmp_path)
    starts = [ravel_pytree(x)[0] for x in (own.q0, own.v0, z0) if x is not None]
    state, _ = library.begin(*starts, dt=dt)
    assert library.run(state, steps, dt) == 0

    def end(x):
        run = hhtjax.simulate(*arguments, own.params | {name: x}, z0=z0, dt=dt, num_steps=steps, save_every=steps)
        return run.v[-1] if run.multipliers is None else jnp.concatenate([run.v[-1], run.multipliers[-1]])

    expected = forward(end, jnp.asarray(own.params[name]))
    fields = [field.name for field in library.model.state if field.name in (f"dv_d{name}", f"dL_d{name}")]
    ours = np.concatenate([numbers(state, field) for field in fields])
    assert np.max(abs(expected)) > 1e-6
    assert np.max(abs(ours - expected)) < 1e-10 * np.max(abs(expected))


@pytest.mark.slow
def test_states_are_independent_and_params_may_change(pendulum_library):
    """Steps of two states in turns are those of each alone; params are read at each step."""
    library, problem, dt = pendulum_library, PROBLEMS["forced double pendulum"], 1e-3
    alone = library.begin(problem.q0, problem.v0, dt=dt)[0]
    library.run(alone, 50, dt)
    first = library.begin(problem.q0, problem.v0, dt=dt)[0]
    stiff = type(library.defaults).from_buffer_copy(library.defaults)
    stiff.k_0 *= 2
    other = library.begin(-problem.q0, problem.v0, dt=dt, params=stiff)[0]
    for _ in range(50):
        library.step(first, dt=dt)
        library.step(other, dt=dt, params=stiff)
    assert bytes(first) == bytes(alone)
    assert abs(other.q[0] + alone.q[0]) > 1e-3
    values = problem.params | {"k": (2 * problem.params["k"][0], problem.params["k"][1])}
    run = hhtjax.simulate(
        problem.system, hht(-0.1, linearize="predictor"), -problem.q0, problem.v0, values, dt=dt, num_steps=50
    )
    assert numbers(other, "q") == pytest.approx(np.asarray(run.q[-1]), rel=1e-12)


@pytest.mark.slow
def test_another_step_size_goes_on_from_the_same_time(pendulum_library):
    problem = PROBLEMS["forced double pendulum"]
    state, _ = pendulum_library.begin(problem.q0, problem.v0, t0=0.5, dt=1e-3)
    pendulum_library.run(state, 100, 1e-3)
    pendulum_library.run(state, 100, 5e-4)
    assert state.t == pytest.approx(0.65, rel=1e-14)


def test_a_flag_is_up_for_what_is_no_number(pendulum_library):
    problem = PROBLEMS["forced double pendulum"]
    bad = type(pendulum_library.defaults).from_buffer_copy(pendulum_library.defaults)
    bad.m_0 = float("nan")
    assert pendulum_library.begin(problem.q0, problem.v0, dt=1e-3, params=bad)[1] == 1
    state, flags = pendulum_library.begin(problem.q0, problem.v0, dt=1e-3)
    assert flags == 0
    assert pendulum_library.step(state, dt=1e-3, params=bad) == 1
    assert pendulum_library.step(state, dt=1e-3) == state.flags == 1  # and stays up
    state, _ = pendulum_library.begin(problem.q0, problem.v0, dt=1e-3)
    assert pendulum_library.run(state, 100, 1e300) == 1


@pytest.mark.slow
def test_flags_for_newton_and_for_constraints(tmp_path):
    """The step at which `simulate` names a failure, and its kind, are those of C."""
    rods = hhtjax.System(
        jnp.ones(2), lambda q, v, t, p: jnp.array([0.0, -9.81]),
        lambda q, t, p: jnp.stack([q[0], q[0] + p["tilt"] * jnp.maximum(0.1 - t, 0.0) * q[1]]),
    )  # fmt: skip
    problem = PROBLEMS["forced double pendulum"]
    cases = {
        2: (problem.system, hht(-0.1, iterations=None, max_iterations=2, tolerance=1e-13), problem.q0, problem.v0,
            problem.params, 0.05),
        4: (rods, hht(-0.1), jnp.zeros(2), jnp.zeros(2), {"tilt": 1.0}, 0.03),
    }  # fmt: skip
    for bit, (system, stepper, q0, v0, params, dt) in cases.items():
        library = Library(export_c(system, stepper, q0, v0, params, name=f"flag{bit}"), tmp_path)
        with hhtjax.plain():
            run = hhtjax.simulate(system, stepper, q0, v0, params, dt=dt, num_steps=20)
        state, flags = library.begin(q0, v0, dt=dt)
        assert flags == 0
        first = next(k for k in range(1, 21) if library.step(state, dt=dt))
        assert first == int(run.failure.step)
        assert state.flags & bit, bit


@pytest.mark.slow
def test_inputs_are_held_over_the_step(tmp_path):
    """As one with `sampled(..., order=0)`, jumps of the acceleration included; two channels, and one alone."""
    pairs, single = np.random.default_rng(0).normal(size=(50, 2)), np.linspace(-1.0, 2.0, 50) ** 2
    params = {
        "k": 4.0, "u": hhtjax.sampled(pairs, dt=0.01, order=0), "push": hhtjax.sampled(single, dt=0.01, order=0)
    }  # fmt: skip
    system = hhtjax.System(
        lambda q, p: jnp.array([[2.0 + q[0] ** 2, 0.3], [0.3, 1.0]]),
        lambda q, v, t, p: -p["k"] * q + p["u"](t) + p["push"](t),
    )
    q0 = jnp.array([0.1, 0.2])
    for stepper in (hht(-0.1, linearize="predictor"), hhtjax.rk4()):
        model = export_c(system, stepper, q0, jnp.zeros(2), params, name="driven")
        assert [(field.name, field.shape) for field in model.inputs] == [("push", ()), ("u", (2,))]
        library = Library(model, tmp_path)
        inputs = np.column_stack([single, pairs])
        state, _ = library.begin(q0, np.zeros(2), inputs[0], dt=0.01)
        assert library.run(state, 50, 0.01, inputs) == 0
        with hhtjax.plain():
            run = hhtjax.simulate(system, stepper, q0, jnp.zeros(2), params, dt=0.01, num_steps=50)
        for name, x in (("q", run.q), ("v", run.v), ("w", run.acceleration)):
            assert numbers(state, name) == pytest.approx(np.asarray(x[-1]), rel=1e-12)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::hhtjax.PrecisionWarning")
def test_single_precision(tmp_path):
    problem = PROBLEMS["forced Duffing"]
    single = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), (problem.q0, problem.v0, problem.params))
    model = export_c(problem.system, hht(-0.1), *single, name="single")
    assert "typedef float single_real;" in model.header
    assert "double" not in model.source
    library = Library(model, tmp_path)
    state, _ = library.begin(*single[:2], dt=1e-3)
    assert library.run(state, 1000, 1e-3) == 0
    run = hhtjax.simulate(problem.system, hht(-0.1), *single, dt=1e-3, num_steps=1000)
    assert numbers(state, "q") == pytest.approx(np.asarray(run.q[-1]), rel=1e-4)


def test_names_come_from_the_keys(tmp_path):
    """Pytrees of any shape, keys that C, C++, a compiler or <math.h> do not allow, names that two keys or a helper
    function share, and params of no numbers."""
    q0 = {"left arm": jnp.zeros((2, 2)), "if": jnp.ones(()), "3": [jnp.ones(1)], "3_0": jnp.ones(())}
    params = {"NAN": 0.5, "class": 1.5, "": 2.0, "empty": jnp.zeros(0), "__LINE__": 0.1, "max": 0.1, "real": 0.1}
    params |= {"k": jnp.array([0.1, 0.05]), "k__0": 0.05, "k_": {"0": jnp.full(1, 0.1)}, "π": 0.1, "ω": {7: 0.2}}

    def force(q, v, t, p):
        return jax.tree.map(lambda x: -jnp.maximum(sum(map(jnp.sum, jax.tree.leaves(p))) - 3.9, 0.5) * x, q)

    model = export_c(hhtjax.System(jnp.ones(7), force), hhtjax.rk4(), q0, q0, params, name="p", sensitivities=("k",))
    allowed = {"NAN_", "class_", "p", "p__LINE__", "max", "real", "k", "k__0", "k__0_2", "_", "p__7"}
    assert {field.name for field in model.params} == allowed
    names = {field.name: field.shape for field in model.state if field.name[0] == "q"}
    assert names == {"q_3_0": (1,), "q_3_0_2": (), "q_if": (), "q_left_arm": (2, 2)}
    library = Library(model, tmp_path)
    state, _ = library.begin(ravel_pytree(q0)[0], ravel_pytree(q0)[0], dt=0.1)
    assert library.step(state, dt=0.1) == 0
    assert state.q_if == state.q_3_0_2 == pytest.approx(np.cos(0.1) + np.sin(0.1), abs=1e-6)
    assert state.dq_3_0_2_dk_1 == pytest.approx((0.1 * np.cos(0.1) - 1.1 * np.sin(0.1)) / 2, abs=1e-6)
    assert numbers(state, "q_left_arm") == pytest.approx(np.zeros(4))


def sorted_force(q, v, t, params):
    return -jnp.sort(q)


def test_what_cannot_be_written_is_named_with_its_line():
    system, x = hhtjax.System(jnp.ones(2), sorted_force), jnp.ones(2)
    line = sorted_force.__code__.co_firstlineno + 1
    message = f"`sort` cannot be written in C; it is used in test_exported_models.py, line {line}, in sorted_force."
    check_message(NotImplementedError, message, lambda: export_c(system, hht(), x, x))
    roots = hhtjax.System(jnp.ones(2), lambda q, v, t, p: -jnp.linalg.eigh(jnp.diag(q))[0])
    check_message(NotImplementedError, "`eigh` cannot", lambda: export_c(roots, hht(), x, x))
    printing = hhtjax.System(jnp.ones(2), lambda q, v, t, p: (jax.debug.print("{}", q), -q)[1])
    check_message(NotImplementedError, "`debug_print` cannot", lambda: export_c(printing, hht(), x, x))


def test_wrong_arguments_are_named():
    problem = PROBLEMS["forced Duffing"]
    start = problem.system, hht(), problem.q0, problem.v0, problem.params
    for options, message in (
        ({"name": "2nd"}, "`name` must be one that C allows"),
        ({"name": "string"}, "`name` must not be that of a file that is included"),
        ({"sensitivities": ("stiffness",)}, "`sensitivities` must be different names among"),
        ({"z0": 1.0}, "leave `z0` out"),
        ({"units": {"stiffness": "N/m"}}, "`units` must name fields among q, v, w, a, "),
        ({"units": {"q": "m */"}}, "`units` must fit into a comment of C"),
    ):
        check_message(ValueError, f"export_c: {message}", lambda options=options: export_c(*start, **options))
    check_message(TypeError, "received tracers", lambda: jax.jit(lambda x: export_c(*start[:4], {"x": x}).name)(1.0))
