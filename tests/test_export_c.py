"""Exported C: compiled without a warning, clean under sanitizers, and the numbers of `simulate`."""

import re
from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled_c import SANITIZERS, Library, compiled, needs_compiler, numbers, printed
from friction_problems import CASES as RUBBING
from jax.flatten_util import ravel_pytree
from zoo import EVERY, PROBLEMS, STEPPERS

import hhtjax
from hhtjax import export_c, hht
from hhtjax.scenes import four_bars, maxwell, motor_joint, pendulum, slider_crank, squeezer, top

pytestmark = needs_compiler
STIFFNESS = 1e3 * (2 * jnp.eye(10) - jnp.eye(10, k=1) - jnp.eye(10, k=-1))


class Bar(NamedTuple):
    """A chain of springs with an end stop, and a load."""

    system: Any = hhtjax.LinearSystem(
        jnp.ones(10), 1e-3 * STIFFNESS, STIFFNESS, lambda t, p: p["load"] * jnp.sin(t) * jnp.ones(10),
        nonlinear=lambda q, v, t, p: -p["stop"] * jnp.maximum(q - 0.01, 0.0), at=[9],
    )  # fmt: skip
    params: Any = {"load": 3.0, "stop": 1e3}  # noqa: RUF012
    q0: Any = jnp.zeros(10)
    v0: Any = jnp.ones(10)
    duration: float = 1.0


class Case(NamedTuple):
    """A scene, a stepper, and how near C is to Python after so many steps; positions, relative to the largest."""

    scene: Callable
    stepper: Any
    dt: float
    steps: int = 2000
    rtol: float = 1e-12


def zoo(name):
    return lambda: PROBLEMS[name]


def decay():
    problem = PROBLEMS["double pendulum"]
    system = hhtjax.FirstOrderSystem(lambda y, t, p: {"a": -p["rate"] * y["b"], "b": jnp.tanh(y["a"]) + jnp.cos(t)})
    return problem._replace(system=system, params={"rate": 2.0}, q0={"a": jnp.ones(2), "b": jnp.zeros(2)}, v0=None)


def with_inertia():
    problem = PROBLEMS["double pendulum"]
    own = problem.system
    system = hhtjax.System(own.mass, own.force, inertia=lambda q, w, params: own.mass(q, params) @ w)
    return problem._replace(system=system)


def joints(count=4):
    """Masses between springs, each on a dry surface with stiction."""

    def force(q, v, t, params):
        ends = jnp.pad(q, 1)
        return params["k"] * (ends[2:] - 2 * q + ends[:-2]) + 6 * jnp.sin(3 * t + jnp.arange(1.0, count + 1))

    def limit(q, v, t, params):
        return params["F"] * (1 + 0.3 * jnp.exp(-jnp.abs(v) / 0.05))

    zero = jnp.zeros(count)
    system = hhtjax.System(jnp.ones(count), force, friction=limit)
    return RUBBING["an internal state"]._replace(system=system, params={"k": 40.0, "F": 3.0}, q0=zero, v0=zero, z0=None)


def spinning():
    """Nine masses on stiffening springs, with gyroscopic forces so large that elimination exchanges rows."""
    G = np.triu(np.ones((9, 9)), 1)

    def force(q, v, t, params):
        return -params["k"] * (q + 10 * q**3) + params["spin"] * ((G - G.T) @ v)

    system = hhtjax.System(jnp.ones(9), force)
    params = {"k": 20.0, "spin": 5e3}
    return PROBLEMS["double pendulum"]._replace(
        system=system, params=params, q0=jnp.sin(jnp.arange(9.0)), v0=jnp.zeros(9)
    )


def rubbing(name):
    return lambda: RUBBING[name]


def twice():
    """The constraint of the rod, and again."""
    scene = pendulum.cartesian()
    own = scene.system
    system = hhtjax.System(own.mass, own.force, lambda q, t, params: jnp.tile(own.constraint(q, t, params), 2))
    return scene._replace(system=system)


LEAST_SQUARES = hht(-0.1, redundant="least_squares")
ALIKE = "newmark", "bossak", "dopri5"  # what others print, with other coefficients
CASES = {
    "auto": Case(zoo("forced double pendulum"), STEPPERS["hht auto"], 1e-3),
    "an internal state": Case(rubbing("an internal state"), hht(-0.1), 2e-3),
}
SLOW = {
    "rod": Case(pendulum.cartesian, hht(-0.1), 1e-3),
    "motor": Case(motor_joint.tracking, hht(-0.1), 1e-4),
    "hht converged": Case(zoo("forced double pendulum"), STEPPERS["hht converged"], 1e-3),
    **{f"forced Duffing, {stepper}": Case(zoo("forced Duffing"), STEPPERS[stepper], 1e-3)
       for stepper in STEPPERS if stepper not in ("hht auto", "hht converged", *ALIKE)},
    "top, lie, converged": Case(top.minimal, hht(-0.1, kinematics="lie", iterations=None), 1e-4, 500),
    "maxwell, rosenbrock": Case(maxwell.vibration, hhtjax.rosenbrock(), 1e-3),
    "maxwell, rk4": Case(maxwell.vibration, hhtjax.rk4(), 1e-4),
    "stages in a loop": Case(zoo("forced double pendulum"), hhtjax.rodas5p(), 1e-3, 500),
    "stages in a loop, first order": Case(decay, hhtjax.dop853(), 1e-2, 500),
    "bar": Case(Bar, hht(-0.1), 1e-3),
    "bar, converged": Case(Bar, hht(-0.1, iterations=None), 1e-3, 500),
    "first order": Case(decay, hht(-0.1), 1e-3),
    "inertia": Case(with_inertia, hht(-0.1, linearize="predictor"), 1e-3),
    "rows exchanged": Case(spinning, hht(-0.1, linearize="predictor"), 1e-3, 500),
    "twice the same constraint": Case(twice, LEAST_SQUARES, 1e-3),
    "two masses on a belt": Case(rubbing("two masses on a belt"), hht(-0.1), 2e-3),
    "a constraint, H(q), a load": Case(rubbing("a constraint, H(q), a load"), hht(-0.1), 1.5e-3),
    "conjugate gradients": Case(Bar, hht(-0.1, solve=hhtjax.conjugate_gradients(20)), 1e-4, 500),
}  # fmt: skip
MORE = {
    **{f"{name}, {stepper}": Case(zoo(name), STEPPERS[stepper], PROBLEMS[name].duration / 10_000, 10_000)
       for name in ("forced Duffing", "forced double pendulum") for stepper in STEPPERS},
    "rosenbrock": Case(zoo("forced Duffing"), hhtjax.rosenbrock(), 1e-4),
    "squeezer": Case(squeezer.squeezer, hht(-0.1), 1e-6),
    "top": Case(top.minimal, hht(-0.1), 1e-5),
    "rod, converged": Case(pendulum.cartesian, hht(-0.1, iterations=None), 1e-4),
    "slider-crank": Case(slider_crank.driven, hht(-0.1), 1e-4),
    "four bars": Case(four_bars.four_bars, hht(-0.1), 1e-4),
    "top with constraints": Case(top.constrained, hht(-0.1), 1e-5),
    "bars through singular positions": Case(partial(four_bars.four_bars, loops=2), LEAST_SQUARES, 2e-3, 500),
    **{name: Case(rubbing(name), hht(-0.1), RUBBING[name].duration / 10_000, 10_000)
       for name in ("stick-slip, Stribeck", "a rotation, H(q)")},
    "M(q), two joints, converged": Case(rubbing("M(q), two joints"), hht(-0.1, iterations=None), 4e-4, 10_000),
    "four joints": Case(joints, hht(-0.1), 5e-4, 10_000),
}  # fmt: skip
ALL = MORE | SLOW | CASES


def exported(case):
    scene = case.scene()
    z0 = getattr(scene, "z0", None)
    return export_c(scene.system, case.stepper, scene.q0, scene.v0, scene.params, z0=z0)


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    """Of a case, made once."""

    @cache
    def of(name):
        return Library(exported(ALL[name]), tmp_path_factory.mktemp("c"))

    return of


def starts(scene):
    return [ravel_pytree(x)[0] for x in (scene.q0, scene.v0, getattr(scene, "z0", None)) if x is not None]


def simulated(case, **sizes):
    """On plain JAX, which shares nothing with the list of operations that C is."""
    scene, sizes = case.scene(), {"num_steps": case.steps} | sizes
    z0 = getattr(scene, "z0", None)
    with hhtjax.plain():
        return hhtjax.simulate(scene.system, case.stepper, scene.q0, scene.v0, scene.params, z0=z0, dt=case.dt, **sizes)


def group(state, model, prefix):
    """All fields of a name, flat."""
    names = [field.name for field in model.state if re.fullmatch(rf"{prefix}(_\w+)?", field.name)]
    return np.concatenate([numbers(state, name) for name in names])


def marked():
    """What the fast tests take, what all take, and the rest."""
    return [
        pytest.param(x, marks=() if x in CASES else pytest.mark.slow if x in SLOW else EVERY)
        for x in CASES | SLOW | MORE
    ]


@pytest.mark.parametrize("name", marked())
def test_c_is_simulate(name, library):
    case, c = ALL[name], library(name)
    scene, model = case.scene(), c.model
    state, flags = c.begin(*starts(scene), dt=case.dt)
    assert flags == 0
    flags = c.run(state, case.steps, case.dt)
    run = simulated(case, save_every=case.steps // 100)
    failed = int(run.failure.step) > 0
    assert (flags != 0) == failed
    assert abs(state.t - float(run.t[-1])) < 1e-15 * state.steps
    if run.friction is not None:
        assert np.any(run.sticking[1:] != run.sticking[:-1])
        assert np.array_equal(numbers(state, "friction_sig") == 0, run.sticking[-1])
    for prefix, tree in (("q", run.q), ("v", run.v), ("z", run.z), ("friction_tau", run.friction)):
        if tree is not None:
            expected = np.concatenate([np.ravel(leaf[-1]) for leaf in jax.tree.leaves(tree)])
            ours = group(state, model, prefix)
            assert np.max(abs(ours - expected)) <= case.rtol * np.max(abs(expected)), prefix
            assert any(np.max(np.ptp(x, axis=0)) > 0 for x in jax.tree.leaves(tree))  # it moved


SINGLE = [
    *("an internal state", "two masses on a belt", "twice the same constraint"),
    *(pytest.param(name, marks=EVERY) for name in ("motor", "top")),
]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::hhtjax.PrecisionWarning")
@pytest.mark.parametrize("name", SINGLE)
def test_in_single_precision_too(name, tmp_path):
    """As many roundings apart as in double precision: the bound of 1e-12 there is 4500 of them."""
    case = ALL[name]
    scene = case.scene()
    given = {key: getattr(scene, key, None) for key in ("q0", "v0", "z0", "params")}
    scene = scene._replace(**{key: single(x) for key, x in given.items() if x is not None})
    case = case._replace(scene=lambda: scene, dt=max(case.dt, 1e-4), steps=1000)
    model = exported(case)
    assert "double" not in model.source
    library = Library(model, tmp_path, "-O1")  # which warns of more
    state, _ = library.begin(*starts(scene), dt=case.dt)
    flags = library.run(state, 1000, case.dt)
    run = simulated(case, save_every=1000)
    assert flags == int(run.failure.step) == 0
    expected = np.concatenate([np.ravel(leaf[-1]) for leaf in jax.tree.leaves(run.q)])
    bound = case.rtol * np.finfo(np.float32).eps / np.finfo(float).eps
    assert np.max(abs(group(state, model, "q") - expected)) < bound * np.max(abs(expected))


def single(tree):
    """Its floating numbers in single precision."""
    floats = partial(jnp.asarray, dtype=jnp.float32)
    return jax.tree.map(lambda x: floats(x) if jnp.issubdtype(jnp.result_type(x), jnp.floating) else x, tree)


MAIN = """#include <stdio.h>
#include "{name}.h"
int main(void)
{{
    const {name}_real {arrays};
    {name}_state s;
    int i, flags = {name}_init(&s, &{name}_defaults, {names}, 0, {dt});
    for (i = 0; i < {steps}; i++) {{
        flags |= {name}_step(&s, &{name}_defaults, NULL, {dt});
    }}
    printf("%d %.17g\\n", flags, (double)s.{field});
    return 0;
}}
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["auto", "hht converged", "rows exchanged", "top, lie, converged", "bar", "motor", "two masses on a belt"]
)
def test_memory_and_arithmetic_are_clean(name, library, tmp_path):
    """Under the sanitizers of addresses and undefined behaviour, as a program of its own."""
    case, c = ALL[name], library(name)
    scene, model = case.scene(), c.model
    arrays = [f"x{i}[] = {{{', '.join(map(repr, np.asarray(x).tolist()))}}}" for i, x in enumerate(starts(scene))]
    first = model.state[0]
    text = MAIN.format(
        name=model.name, arrays=", ".join(arrays), names=", ".join(f"x{i}" for i in range(len(arrays))), dt=case.dt,
        steps=200, field=f"{first.name}{'[0]' * bool(first.shape)}",
    )  # fmt: skip
    source = model.write(tmp_path)[0]
    (tmp_path / "main.c").write_text(text)
    flags, value = printed(compiled([source, tmp_path / "main.c"], tmp_path / "main", *SANITIZERS)).split()
    state, _ = c.begin(*starts(scene), dt=case.dt)
    assert int(flags) == c.run(state, 200, case.dt) == 0
    assert float(value) == pytest.approx(numbers(state, first.name)[0], rel=1e-14)
