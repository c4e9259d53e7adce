"""A second call with other data, read from outside by the user's functions, gives the second answer."""

import sys
import types
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax import lax

import hhtjax
from hhtjax.description import current
from hhtjax.identification import problem
from hhtjax.xla import Programs

k, measured, TRACES = 1.0, np.zeros(3), []
DATA = {"k": [1.0]}
ARRAY = np.ones(1)
module = types.ModuleType("of_the_user")
sys.modules["of_the_user"] = module
setattr(module, "k", 1.0)  # noqa: B010


def body(i, c):
    return c + k / 2


class Spring:
    def __init__(self):
        self.k, self.calls = 1.0, []

    def force(self, q, v, t, params):
        self.calls.append(None)
        return -self.k * q

    def __call__(self, q, v, t, params):
        return self.force(q, v, t, params)


def cell():
    k = 1.0

    def change(value):
        nonlocal k
        k = value

    return (lambda q, v, t, params: -k * q), change


def change_global(value):
    global k
    k = value


SPRING, (OF_CELL, CHANGE) = Spring(), cell()
KINDS = {
    "global": (lambda q, v, t, params: -k * q, change_global),
    "body of a loop": (lambda q, v, t, params: -q * lax.fori_loop(0, 2, body, 0.0), change_global),
    "cell": (OF_CELL, CHANGE),
    "array in place": (lambda q, v, t, params: -ARRAY * q, partial(ARRAY.__setitem__, 0)),
    "list in a dict": (lambda q, v, t, params: -DATA["k"][0] * q, partial(DATA["k"].__setitem__, 0)),
    "method": (SPRING.force, partial(setattr, SPRING, "k")),
    "callable": (SPRING, partial(setattr, SPRING, "k")),
    "module": (lambda q, v, t, params: -module.k * q, partial(setattr, module, "k")),
    "partial": (partial(lambda k, q, v, t, params: -k[0] * q, DATA["k"]), partial(DATA["k"].__setitem__, 0)),
}


@pytest.mark.parametrize("name", KINDS)
def test_what_a_force_reads(name):
    """A new function where it differs, the same where nothing does, and the old one where it is as it was."""
    force, change = KINDS[name]
    system = hhtjax.System(np.ones(1), force)
    value = jax.jit(lambda system: system.force(jnp.ones(1), None, None, None))
    change(1.0)
    one, first = jax.tree.structure(system), float(value(system)[0])
    assert jax.tree.structure(system) == jax.tree.structure(hhtjax.System(np.ones(1), force))
    change(9.0)
    assert (first, float(value(system)[0])) == (-1.0, -9.0)
    nine = jax.tree.structure(system)
    assert nine != one
    assert jax.tree.structure(system) == nine
    change(1.0)
    assert float(value(hhtjax.System(np.ones(1), force))[0]) == -1.0


def test_a_run_reads_a_new_global_and_is_not_traced_again_without():
    def force(q, v, t, params):
        TRACES.append(None)
        return -k * q

    system = hhtjax.System(np.ones(1), force)
    found, counts = [], []
    for value in (1.0, 1.0, 9.0, 9.0, 1.0):
        change_global(value)
        run = hhtjax.simulate(system, hhtjax.rk4(), jnp.ones(1), jnp.zeros(1), dt=0.01, num_steps=10)
        found.append(float(run.q[-1, 0]))
        counts.append(len(TRACES))
    np.testing.assert_allclose(found, np.cos(np.sqrt([1, 1, 9, 9, 1]) * 0.1), rtol=1e-8)
    assert counts[0] == counts[1] < counts[2] == counts[3] == counts[4]


def run(system, params=None, q0=1.0, v0=0.0, **options):
    """Ten steps of a hundredth."""
    q0, v0 = jnp.full(1, q0), jnp.full(1, v0)
    return hhtjax.simulate(system, hhtjax.rk4(), q0, v0, params, dt=0.01, num_steps=10, **options)


def met():
    """When a body has flown as far as a guard says, and its velocity after a push there."""
    there = run(FREE, {"F": 0.0, "ahead": 100.0}, q0=-0.01, v0=1.0, events=[PUSH])
    return there.events.t[0], there.v[-1, 0]


def load(t):
    return k + 0 * t


def moved(q):
    return k * q


def from_k(p):
    return p - k


def from_scipy(which):
    rhs = hhtjax.interop.scipy_rhs(SPRING_OF_K, np.ones(1), np.zeros(1))
    return lambda: getattr(rhs, which)(0.0, rhs.y0)[1]  # the same at each call


SPRING_OF_K = hhtjax.System(np.ones(1), lambda q, v, t, params: -k * q)
FREE = hhtjax.System(np.ones(1), lambda q, v, t, params: 0 * q + params["F"])
DRIVEN = hhtjax.System(np.ones(1), lambda q, v, t, params: 0 * q + params["F"](t))
ON_CIRCLE = hhtjax.System(
    np.ones(2), lambda q, v, t, params: 0 * q, lambda q, t, params: jnp.sum(q**2, keepdims=True) - k**2
)
LAGRANGIAN = hhtjax.System.from_lagrangian(lambda q, v, t, params: (v @ v - k * q @ q) / 2)
DESCENT = optax.sgd(0.5)
SLOW = {"gradient", "sweep", "lagrangian", "constraint", "events"}
PUSH = hhtjax.Event(
    guard=lambda q, v, t, p: 1 + p["ahead"] * (k / 100 - q[0]),
    reset=lambda q, v, t, p: k * v,
    switch=lambda p: {"F": p["F"] + k, "ahead": 0.0},
)
PLACES = {  # a value that is k, or what is to be found for it
    "gradient": (lambda: jax.grad(lambda x: run(SPRING_OF_K, q0=x).q[-1, 0])(1.0), lambda k: np.cos(np.sqrt(k) * 0.1)),
    "sweep": (
        lambda: hhtjax.sweep(
            SPRING_OF_K, hhtjax.rk4(), jnp.ones(1), jnp.zeros(1), dts=jnp.full(2, 0.01), duration=0.1, num_samples=1
        ).q[1, -1, 0],
        lambda k: np.cos(np.sqrt(k) * 0.1),
    ),
    "lagrangian": (lambda: run(LAGRANGIAN).q[-1, 0], lambda k: np.cos(np.sqrt(k) * 0.1)),
    "constraint": (lambda: hhtjax.consistent_initial(ON_CIRCLE, jnp.array([3.0, 0.0]), jnp.zeros(2)).q[0], None),
    "function among the params": (lambda: run(DRIVEN, {"F": load}).v[-1, 0], lambda k: k * 0.1),
    "output": (lambda: run(FREE, {"F": 0.0}, output=moved).output[0, 0], None),
    "events": (met, lambda k: (0.02 + k / 100, k + k * (0.08 - k / 100))),
    "scipy_rhs": (from_scipy("fun"), lambda k: -k),
    "its jacobian": (from_scipy("jac"), lambda k: [-k, 0]),
    "fit by gradients": (lambda: hhtjax.fit(from_k, 1.5, DESCENT, covariance=False).params, None),
}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name in SLOW else name for name in PLACES]
)
def test_every_place_sees_what_has_changed(name):
    value, expected = PLACES[name]
    for number in (1.0, 2.0):
        change_global(number)
        wanted = number if expected is None else expected(number)
        np.testing.assert_allclose(value(), wanted, rtol=1e-7, atol=1e-12)


RECORDS = 1.0, 2.0, 5.0, 7.0
HELD = {"record": measured}
WAYS = {  # residuals that read a record; how many programs these records take
    "as it is": (lambda p: p - measured, 2),
    "by another function": (lambda p: p - by_helper() / 2 - measured / 2, 2),
    "its mean": (lambda p: p * np.ones(2) - np.mean(measured), 2),
    "as a number": (lambda p: p * np.ones(2) - float(measured[0]), 4),
    "in a branch": (lambda p: p - (measured if measured[0] > 3 else 1.0 * measured), 4),
    "by its kind": (lambda p: p - (measured if isinstance(measured, np.ndarray) else np.ones(3)), 4),
    "in a dict, too": (lambda p: p - measured / 2 - HELD["record"] / 2, 4),
}


def by_helper():
    return measured


@pytest.mark.parametrize("way", WAYS)
def test_fits_read_new_records(way):
    """A record is data where what is computed from it can be traced, from the second program on."""
    global measured
    residuals, programs = WAYS[way]
    found, before = [], problem._see.number()
    for value in (*RECORDS, RECORDS[0]):
        HELD["record"] = measured = np.full(3, value)
        found.append(float(hhtjax.fit(residuals, 1.5, covariance=False).params))
    np.testing.assert_allclose(found, [*RECORDS, RECORDS[0]], rtol=1e-9)
    assert problem._see.number() - before == programs
    measured[:] = 9.0
    np.testing.assert_allclose(hhtjax.fit(residuals, 1.5, covariance=False).params, 9.0, rtol=1e-9)


def test_what_reads_nothing_stands_for_itself():
    assert current(jnp.sin) is jnp.sin
    assert current(change_global) is change_global


def scaled(q, factor=1.0, *, offset=0.0):
    return factor * q + offset


@pytest.mark.parametrize(
    "f", [partial(scaled, offset=2.0), partial(partial(scaled), factor=3.0), lambda q, x=(), *, y={}: q]
)
def test_what_has_not_changed_is_not_looked_through_again(f, monkeypatch):
    """Also where a container is empty, such as the arguments of a partial that has keywords alone."""
    form = current(f)
    monkeypatch.setattr(sys.modules["hhtjax.description.current"], "Look", None)
    assert current(f) is form


def test_a_loop_over_records_does_not_keep_all_programs(monkeypatch):
    jitted = Programs(lambda force, q: force(q, None, None, None), static_argnums=0)
    monkeypatch.setattr(sys.modules["hhtjax.description.current"], "programs", [jitted.quick])
    for number in range(40):
        change_global(float(number))
        assert float(jitted(current(KINDS["global"][0]), 2.0)) == -2.0 * number
        assert jitted.number() <= 17
    assert jitted.number() > 1
