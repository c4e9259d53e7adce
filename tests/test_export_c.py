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
from zoo import PROBLEMS, STEPPERS, covering

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
    steps: int = 10_000
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


def rubbing(name):
    return lambda: RUBBING[name]


def twice():
    """The constraint of the rod, and again."""
    scene = pendulum.cartesian()
    own = scene.system
    system = hhtjax.System(own.mass, own.force, lambda q, t, params: jnp.tile(own.constraint(q, t, params), 2))
    return scene._replace(system=system)


LEAST_SQUARES = hht(-0.1, redundant="least_squares")
CASES = {
    "auto": Case(zoo("forced double pendulum"), STEPPERS["hht auto"], 1e-4),
    "an internal state": Case(rubbing("an internal state"), hht(-0.1), 5e-4),
}
SLOW = {
    "rod": Case(pendulum.cartesian, hht(-0.1), 1e-4),
    "motor": Case(motor_joint.tracking, hht(-0.1), 1e-4),
    **{f"{name}, {stepper}": Case(zoo(name), STEPPERS[stepper], PROBLEMS[name].duration / 10_000)
       for name in ("forced Duffing", "forced double pendulum") for stepper in STEPPERS
       if (name, stepper) != ("forced double pendulum", "hht auto")},
    "rosenbrock": Case(zoo("forced Duffing"), hhtjax.rosenbrock(), 1e-4),
    "squeezer": Case(squeezer.squeezer, hht(-0.1), 1e-6, 2000),
    "top": Case(top.minimal, hht(-0.1), 1e-5),
    "rod, converged": Case(pendulum.cartesian, hht(-0.1, iterations=None), 1e-4),
    "slider-crank": Case(slider_crank.driven, hht(-0.1), 1e-4),
    "four bars": Case(four_bars.four_bars, hht(-0.1), 1e-4),
    "top with constraints": Case(top.constrained, hht(-0.1), 1e-5),
    "top, lie, converged": Case(top.minimal, hht(-0.1, kinematics="lie", iterations=None), 1e-5),
    "maxwell, rosenbrock": Case(maxwell.vibration, hhtjax.rosenbrock(), 1e-4),
    "maxwell, rk4": Case(maxwell.vibration, hhtjax.rk4(), 1e-4),
    "bar": Case(Bar, hht(-0.1), 1e-4),
    "bar, converged": Case(Bar, hht(-0.1, iterations=None), 1e-4, 1000),
    "first order": Case(decay, hht(-0.1), 1e-4),
    "inertia": Case(with_inertia, hht(-0.1, linearize="predictor"), 1e-4),
    "twice the same constraint": Case(twice, LEAST_SQUARES, 1e-3, 2000),
    "bars through singular positions": Case(partial(four_bars.four_bars, loops=2), LEAST_SQUARES, 2e-3, 500),
    **{name: Case(rubbing(name), hht(-0.1), RUBBING[name].duration / 10_000)
       for name in ("stick-slip, Stribeck", "two masses on a belt", "a constraint, H(q), a load", "a rotation, H(q)")},
    "M(q), two joints, converged": Case(rubbing("M(q), two joints"), hht(-0.1, iterations=None), 4e-4),
    "four joints": Case(joints, hht(-0.1), 5e-4),
    "conjugate gradients": Case(Bar, hht(-0.1, solve=hhtjax.conjugate_gradients(20)), 1e-4, 1000),
}  # fmt: skip


def exported(case):
    scene = case.scene()
    z0 = getattr(scene, "z0", None)
    return export_c(scene.system, case.stepper, scene.q0, scene.v0, scene.params, z0=z0)


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    """Of a case, made once."""

    @cache
    def of(name):
        return Library(exported({**CASES, **SLOW}[name]), tmp_path_factory.mktemp("c"))

    return of


def starts(scene):
    return [ravel_pytree(x)[0] for x in (scene.q0, scene.v0, getattr(scene, "z0", None)) if x is not None]


def group(state, model, prefix):
    """All fields of a name, flat."""
    names = [field.name for field in model.state if re.fullmatch(rf"{prefix}(_\w+)?", field.name)]
    return np.concatenate([numbers(state, name) for name in names])


PAIRS = covering(STEPPERS, ("forced Duffing", "forced double pendulum"))  # what whole runs leave out
MARKS = {f"{problem}, {stepper}": marks for (stepper, problem), marks, *_ in PAIRS}


def with_marks(names):
    return [pytest.param(name, marks=MARKS.get(name) or pytest.mark.slow) for name in names]


@pytest.mark.parametrize("name", [*CASES, *with_marks(SLOW)])
def test_c_is_simulate(name, library):
    case, c = {**CASES, **SLOW}[name], library(name)
    scene, model = case.scene(), c.model
    state, flags = c.begin(*starts(scene), dt=case.dt)
    assert flags == 0
    flags = c.run(state, case.steps, case.dt)
    run = hhtjax.simulate(
        scene.system, case.stepper, scene.q0, scene.v0, scene.params, z0=getattr(scene, "z0", None),
        dt=case.dt, num_steps=case.steps, save_every=case.steps // 100,
    )  # fmt: skip
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


SINGLE = "an internal state", "motor", "top", "two masses on a belt", "twice the same constraint"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::hhtjax.PrecisionWarning")
@pytest.mark.parametrize("name", SINGLE)
def test_in_single_precision_too(name, tmp_path):
    """As many roundings apart as in double precision: the bound of 1e-12 there is 4500 of them."""
    case = {**CASES, **SLOW}[name]
    scene, dt = case.scene(), max(case.dt, 1e-4)
    given = {key: getattr(scene, key, None) for key in ("q0", "v0", "z0", "params")}
    scene = scene._replace(**{key: single(x) for key, x in given.items() if x is not None})
    model = exported(case._replace(scene=lambda: scene))
    assert "double" not in model.source
    library = Library(model, tmp_path)
    state, _ = library.begin(*starts(scene), dt=dt)
    flags = library.run(state, 1000, dt)
    run = hhtjax.simulate(
        scene.system, case.stepper, scene.q0, scene.v0, scene.params, z0=getattr(scene, "z0", None),
        dt=dt, num_steps=1000, save_every=1000,
    )  # fmt: skip
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
    "name", ["auto", "forced double pendulum, hht converged", "squeezer", "top", "bar", "motor", "two masses on a belt"]
)
def test_memory_and_arithmetic_are_clean(name, library, tmp_path):
    """Under the sanitizers of addresses and undefined behaviour, as a program of its own."""
    case, c = {**CASES, **SLOW}[name], library(name)
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
