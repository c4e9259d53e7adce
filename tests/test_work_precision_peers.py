"""Other packages get the scene's own right-hand side; what they return is its motion; runs that break are failures."""

import importlib.util
import math
from functools import cache

import jax
import numpy as np
import pytest

from experiments.work_precision import batches, compiled_gradients, compiled_peers, drake_peers, page
from experiments.work_precision.cases import cases, reference, rms_error
from experiments.work_precision.engines import links
from experiments.work_precision.expressions import Evaluation, diffsl, places, program, python_rate

NAMES = list(cases())
SOME = "stiff double pendulum", "forced Duffing"


def need(*modules):
    """Skips where one of them is missing."""
    missing = [name for name in modules if not importlib.util.find_spec(name)]
    if missing:
        pytest.skip(f"{', '.join(missing)} not installed")


@cache
def rate(name):
    return jax.jit(cases()[name].rate)


def states(name, count=3):
    """Times, states and our rates."""
    case, rng = cases()[name], np.random.default_rng(0)
    for t in rng.uniform(0.0, case.scene.duration, count):
        y = case.y0 + 0.1 * rng.normal(size=len(case.y0))
        yield t, y, np.asarray(rate(name)(t, y, case.scene.params))


def assert_same(found, exact):
    """To rounding of the largest, grown by the condition of the squeezer's elimination."""
    np.testing.assert_allclose(found, exact, rtol=0, atol=1e-12 * np.max(np.abs(exact)))


@pytest.mark.parametrize("name", NAMES)
def test_the_list_is_the_scene(name):
    """With its numbers folded, as data, in two parts, and as Python."""
    found = program(name)
    ahead, rest = found.split()
    constants = Evaluation(ahead, [float(x) for x in found.numbers], math).results()
    assert set(rest.arguments[1 + found.size :]).isdisjoint(x for y in rest.operations for x in y.results)
    printed = python_rate(name)
    for t, y, exact in states(name):
        state, dy = y.tolist(), np.zeros(found.size)
        assert_same(found.on(t, state), exact)
        assert_same(found.on(t, state, found.numbers.tolist()), exact)
        assert_same(Evaluation(rest, [t, *state, *constants], math).results(), exact)
        printed(t, y, dy)
        assert_same(dy, exact)


def test_what_is_shared_is_computed_once():
    """The cosine of the difference of the angles, and its sine: four functions, and one division."""
    text = diffsl("stiff double pendulum")
    assert text.count("sin(") == 1
    assert text.count("cos(") == 3
    assert text.count(" / ") == 1


@pytest.mark.parametrize("name", NAMES)
def test_heyoka_has_the_scene(name):
    need("heyoka")
    import heyoka

    system = compiled_peers.heyoka_system(name)
    compiled = heyoka.cfunc([x for _, x in system], vars=[y for y, _ in system])
    for t, y, exact in states(name):
        given = {"time": t} if compiled.is_time_dependent else {}
        assert_same(compiled(np.array(y), **given), exact)


@pytest.mark.parametrize("name", NAMES)
def test_casadi_has_the_scene(name):
    need("casadi")
    import casadi

    system = compiled_peers.casadi_system(name)
    compiled = casadi.Function("rate", [system["t"], system["x"]], [system["ode"]])
    for t, y, exact in states(name):
        assert_same(np.asarray(compiled(t, y)).ravel(), exact)


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param(x, marks=pytest.mark.every) if x not in SOME else x for x in NAMES])
def test_numba_has_the_scene(name):
    need("numba")
    compiled = compiled_peers.jitted(name)
    for t, y, exact in states(name):
        dy = np.zeros(len(y))
        compiled(t, y, dy)
        assert_same(dy, exact)


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param(x, marks=pytest.mark.every) if x not in SOME else x for x in NAMES])
def test_diffsol_has_the_scene(name):
    need("pydiffsol")
    import pydiffsol

    system = pydiffsol.Ode(diffsl(name), matrix_type=pydiffsol.nalgebra_dense, jit_backend=pydiffsol.llvm)
    for t, y, exact in states(name):
        assert_same(np.asarray(system.rhs(np.zeros(0), t, y)).ravel(), exact)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("module", "most"),
    [("heyoka", 1e-4), ("numbalsoda", 1e-4), ("casadi", 1e-3), ("sksundae", 1e-3), ("pydiffsol", 1e-3)],
)
def test_runs_follow_their_tolerance(module, most):
    need(module, *(("numba",) if module in ("numbalsoda", "sksundae") else ()))
    rows = compiled_peers.ENTRIES[module]("forced Duffing", (1e-5,))
    assert rows
    assert all(row["rms_error"] is not None and row["rms_error"] < most and row["time_s"] > 0 for row in rows)


@pytest.mark.slow
def test_infinite_steps_are_a_failure():
    """Two neighbouring coefficients vanish at the start of the free double pendulum, at this order and no other."""
    need("heyoka")
    fine, broken = compiled_peers.heyoka_entries("free double pendulum", (1e-5, 1e-6))
    assert fine["rms_error"] < 1e-5
    assert broken["rms_error"] is None


@pytest.mark.slow
def test_the_bodies_of_drake_are_the_scene():
    need("pydrake")
    name = "stiff double pendulum"
    *chain, _ = links(name)
    plant = drake_peers.chain(*chain)
    context = plant.CreateDefaultContext()
    for _, y, _ in states(name):
        q, v = np.split(y, 2)
        plant.SetPositionsAndVelocities(context, np.concatenate([np.diff(x, prepend=0.0) for x in (q, v)]))
        found = plant.EvalTimeDerivatives(context).CopyToVector()[len(q) :]
        exact = np.asarray(rate(name)(0.0, y, cases()[name].scene.params))[len(q) :]
        np.testing.assert_allclose(np.cumsum(found), exact, rtol=1e-6)


def test_the_hardening_spring_has_a_solution_in_closed_form():
    name = "hardening spring"
    case, tiny = cases()[name], 1e-6
    q, after = reference(name)[:1, 0], case.times[0]
    assert rms_error(name, reference(name)) == 0.0
    energy = 50.0 * q**2 + 2500.0 * q**4  # and the rest is kinetic
    speed = np.sqrt(2 * (2550.0 - energy))
    from experiments.work_precision.cases import swing

    near = swing(case.scene.params, case.y0[0], np.array([after - tiny, after + tiny]))
    np.testing.assert_allclose(np.abs(np.diff(near) / (2 * tiny)), speed, rtol=1e-6)


def test_parameters_are_found_in_the_vector():
    numbers = program("free double pendulum").numbers
    assert numbers[places("free double pendulum", ("l",))].tolist() == [1.0, 1.5]
    assert places("hardening spring", ("k", "k3")) == sorted(places("hardening spring", ("k", "k3")))


@pytest.mark.slow
@pytest.mark.parametrize("module", ["heyoka", "casadi"])
def test_gradients_follow_their_tolerance(module):
    need(module)
    (row,) = compiled_gradients.ROWS[module]("forced Duffing", (1e-7,))
    assert row["rms_error"] < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("module", ["heyoka", "numbalsoda"])
def test_members_of_batches_are_not_mixed_up(module):
    need(module, *(("numba",) if module == "numbalsoda" else ()))
    rows = batches.PEERS[module]("free double pendulum", 9)
    assert min(row["rms_error"] for row in rows if row["rms_error"] is not None) < 1e-6


def test_who_wins_is_counted():
    def entry(method, package, *times):
        return {"method": method, "package": package, "time_s": dict(zip(("0.01", "0.001"), times, strict=True))}

    scenes = {
        "a": [entry("hht", "ours", 1.0, 2.0), entry("heyoka Taylor", "heyoka", 2.0, 1.0)],
        "b": [entry("hht", "ours", 1.0, None), entry("heyoka Taylor", "heyoka", None, None)],
    }
    assert "| 0.01 | ours 2 |" in page.who_wins(scenes)
    assert "| 0.001 | heyoka 1 |" in page.who_wins(scenes)
