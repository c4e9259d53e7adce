"""Systems and steppers as descriptions: equal and hashable by content, pytrees of their arrays, compiled once."""

from dataclasses import FrozenInstanceError
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hhtjax
from hhtjax import LinearSystem, System, simulate


def pull(q, v, t, params):
    """A spring of stiffness 4."""
    return -4.0 * q


def push(q, v, t, params):
    """The opposite of `pull`."""
    return 4.0 * q


def inertia(q, params):
    """A constant mass as a function."""
    return jnp.full(1, 2.0)


def hold(q, t, params):
    """A constraint."""
    return q


def load(t, params):
    """A constant load."""
    return jnp.ones(1)


def lagrangian(q, v, t, params):
    """Of a unit mass on a spring."""
    return 0.5 * jnp.sum(v**2) - 2.0 * jnp.sum(q**2)


def other_solve(A, b):
    """In place of the library's."""
    return jnp.linalg.solve(A, b)


ONE, TWO = np.ones(1), np.full(1, 2.0)

# each entry makes a description from scratch; no two of them are equal
DESCRIPTIONS = {
    "mass 1": lambda: System(np.ones(1), pull),
    "mass 2": lambda: System(np.full(1, 2.0), pull),
    "mass 1 read as an integer": lambda: System(np.ones(1).view(np.int64), pull),
    "mass matrix": lambda: System(np.ones((1, 1)), pull),
    "mass of two": lambda: System(np.ones(2), pull),
    "float32 mass": lambda: System(np.ones(1, np.float32), pull),
    "other force": lambda: System(np.ones(1), push),
    "mass function": lambda: System(inertia, pull),
    "constraint": lambda: System(np.ones(1), pull, hold),
    "partial force": lambda: System(np.ones(1), partial_pull),
    "lagrangian": lambda: System.from_lagrangian(lagrangian),
    "lagrangian and force": lambda: System.from_lagrangian(lagrangian, pull),
    "linear": lambda: LinearSystem(np.ones(1)),
    "linear, damped": lambda: LinearSystem(np.ones(1), C=np.ones(1)),
    "linear, stiff": lambda: LinearSystem(np.ones(1), K=np.ones(1)),
    "linear, stiffer": lambda: LinearSystem(np.ones(1), K=np.full(1, 2.0)),
    "linear, loaded": lambda: LinearSystem(np.ones(1), force=load),
    "linear, function": lambda: LinearSystem(lambda_matrix),
    "hht": lambda: hhtjax.hht(alpha=-0.05),
    "hht 0.1": lambda: hhtjax.hht(alpha=-0.1),
    "hht 0.1 as data": lambda: hhtjax.hht(alpha=jnp.asarray(-0.1, jnp.float64)),
    "hht 0.2 as data": lambda: hhtjax.hht(alpha=jnp.asarray(-0.2, jnp.float64)),
    "hht held": lambda: hhtjax.hht(alpha=-0.05, linearize="held"),
    "hht twice": lambda: hhtjax.hht(alpha=-0.05, iterations=2),
    "hht converged": lambda: hhtjax.hht(alpha=-0.05, iterations=None),
    "hht converged loosely": lambda: hhtjax.hht(alpha=-0.05, iterations=None, tolerance=1e-6),
    "hht converged soon": lambda: hhtjax.hht(alpha=-0.05, iterations=None, max_iterations=5),
    "hht corrected": lambda: hhtjax.hht(alpha=-0.05, start="corrected"),
    "hht solve": lambda: hhtjax.hht(alpha=-0.05, solve=other_solve),
    "newmark": lambda: hhtjax.newmark(),
    "newmark damped": lambda: hhtjax.newmark(beta=0.3025, gamma=0.6),
    "bossak": lambda: hhtjax.bossak(alpha=-0.05),
    "generalized_alpha": lambda: hhtjax.generalized_alpha(rho_inf=0.8),
    "implicit_euler": lambda: hhtjax.implicit_euler(),
    "kim_hht": lambda: hhtjax.kim_hht(alpha=0.0),
    "kim_hht 0.1": lambda: hhtjax.kim_hht(alpha=-0.1),
    "kim_implicit_euler": lambda: hhtjax.kim_implicit_euler(),
    "rk4": lambda: hhtjax.rk4(),
}
partial_pull = partial(pull, params=None)


def lambda_matrix(params):
    """A mass as a function of params."""
    return jnp.ones(1)


def run(system, stepper, q0=ONE, v0=0 * ONE, params=None, dt=0.1, num_steps=4, **options):
    """A short run."""
    return simulate(system, stepper, q0, v0, params, dt=dt, num_steps=num_steps, **options)


# ---------------------------------------------------------------------------------------------- equality


@pytest.mark.parametrize("name", DESCRIPTIONS)
def test_descriptions_are_equal_when_their_contents_are(name):
    first, second = DESCRIPTIONS[name](), DESCRIPTIONS[name]()
    assert first is not second
    assert first == second
    assert hash(first) == hash(second)
    assert {first: 1}[second] == 1
    for other, make in DESCRIPTIONS.items():
        assert (first == make()) == (other == name), other
        assert (first != make()) == (other != name), other


def test_different_descriptions_have_different_hashes():
    """Not a law, but a hash that ignored a field would show here."""
    assert len({hash(make()) for make in DESCRIPTIONS.values()}) == len(DESCRIPTIONS)


def test_a_description_equals_nothing_else():
    for make in DESCRIPTIONS.values():
        assert make() not in (None, 3, "hht", pull)


def test_equality_is_by_value_and_not_by_kind_of_array():
    assert System(np.ones(1), pull) == System(jnp.ones(1), pull) == System([1.0], pull)
    assert hash(System(np.ones(1), pull)) == hash(System(jnp.ones(1), pull)) == hash(System([1], pull))
    assert hhtjax.hht(alpha=np.float64(-0.1)) == hhtjax.hht(alpha=jnp.asarray(-0.1, jnp.float64))


def test_lambdas_that_look_alike_are_different():
    make = [lambda: System(ONE, lambda q, v, t, params: -q) for _ in range(2)]
    assert make[0]() != make[1]()


@pytest.mark.parametrize("name", ["mass 1", "linear, stiff", "hht", "rk4"])
def test_descriptions_are_frozen(name):
    description = DESCRIPTIONS[name]()
    field = next(iter(vars(description)))
    with pytest.raises(FrozenInstanceError):
        setattr(description, field, None)
    assert description == DESCRIPTIONS[name]()


# ---------------------------------------------------------------------------------------------- pytrees


@pytest.mark.parametrize("name", DESCRIPTIONS)
def test_round_trip_through_a_pytree(name):
    description = DESCRIPTIONS[name]()
    leaves, structure = jax.tree.flatten(description)
    assert all(isinstance(x, (np.ndarray, np.generic, jax.Array)) for x in leaves)
    copy = jax.tree.unflatten(structure, leaves)
    assert type(copy) is type(description)
    assert copy == description
    assert jax.tree.structure(copy) == structure
    assert hash(jax.tree.structure(copy)) == hash(structure)


@pytest.mark.parametrize(
    ("make", "leaves"),
    [
        (lambda: System(TWO, pull), [TWO]),
        (lambda: System(inertia, pull), []),
        (lambda: LinearSystem(TWO, K=3 * ONE), [3 * ONE, TWO]),
        (lambda: LinearSystem(TWO, C=ONE, K=lambda_matrix), [ONE, TWO]),
        (lambda: hhtjax.hht(alpha=-0.1), []),
        (lambda: hhtjax.kim_hht(alpha=jnp.asarray(-0.1)), [-0.1]),
        (lambda: hhtjax.newmark(beta=jnp.asarray(0.3)), [0.3]),
        (lambda: hhtjax.hht(alpha=np.float64(-0.25)), [0.25, 1.25**2 / 4, 0.75]),
    ],
)
def test_arrays_are_leaves_and_everything_else_is_not(make, leaves):
    found = jax.tree.leaves(make())
    assert len(found) == len(leaves)
    for x, y in zip(found, leaves, strict=True):
        assert np.allclose(x, y, rtol=1e-15)


def test_tree_map_acts_on_the_arrays():
    doubled = jax.tree.map(lambda x: 2 * x, System(ONE, pull))
    assert doubled == System(TWO, pull)
    assert jax.tree.map(lambda x: 2 * x, LinearSystem(ONE, K=TWO)) == LinearSystem(TWO, K=2 * TWO)


@pytest.mark.parametrize(
    "placeholder",
    [object(), 0, 1.5, "mass", jax.ShapeDtypeStruct((1,), float)],
    ids=["object", "axis", "number", "name", "shape"],
)
@pytest.mark.parametrize("name", ["linear, stiff", "hht 0.1 as data"])
def test_placeholders_for_arrays_keep_the_structure(name, placeholder):
    """JAX builds pytrees whose leaves are no arrays, and so do those who write in_axes: nothing may be validated."""
    description = DESCRIPTIONS[name]()
    other = jax.tree.map(lambda x: placeholder, description)
    assert jax.tree.structure(other) == jax.tree.structure(description)
    assert jax.tree.leaves(other) == [placeholder] * len(jax.tree.leaves(description))


def test_axes_of_a_batch_may_be_a_description():
    systems = [LinearSystem(ONE, K=4 * ONE), LinearSystem(TWO, K=9 * ONE)]
    batch = jax.tree.map(lambda *x: jnp.stack(x), *systems)
    axes = jax.tree.map(lambda x: 0, systems[0])
    found = jax.vmap(lambda system: run(system, hhtjax.rk4()).q[-1], in_axes=(axes,))(batch)
    assert np.allclose(found, [run(system, hhtjax.rk4()).q[-1] for system in systems], rtol=1e-13)


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
