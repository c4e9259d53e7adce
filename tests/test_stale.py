"""A second call with other data, read from outside by the user's functions, gives the second answer."""

import sys
import types
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import hhtjax
from hhtjax.description import current

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


def test_a_fit_reads_the_new_record():
    global measured

    def residuals(p):
        return p * np.ones(3) - measured

    found = []
    for record in (np.full(3, 2.0), np.full(3, 5.0)):
        measured = record
        found.append(float(hhtjax.fit(residuals, 1.0, covariance=False).params))
    measured[:] = 7.0
    found.append(float(hhtjax.fit(residuals, 1.0, covariance=False).params))
    np.testing.assert_allclose(found, [2, 5, 7], rtol=1e-9)


def test_what_reads_nothing_stands_for_itself():
    assert current(jnp.sin) is jnp.sin
    assert current(change_global) is change_global
