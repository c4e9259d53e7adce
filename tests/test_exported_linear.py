"""Exported linear systems of more than ten unknowns: factors kept in the state, matrices as loops."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled_c import Library, needs_compiler, numbers

import hhtjax
from hhtjax import export_c, hht

pytestmark = needs_compiler
SIZE = 24
RANDOM = np.random.default_rng(0).standard_normal((SIZE, SIZE))
MASS = np.eye(SIZE) + RANDOM @ RANDOM.T / SIZE
CHAIN = 2 * np.eye(SIZE) - np.eye(SIZE, k=1) - np.eye(SIZE, k=-1)


def stiffness(params):
    return params["k"] * CHAIN


def load(t, params):
    return params["load"] * jnp.sin(3 * t) * jnp.linspace(0.0, 1.0, SIZE)


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    system = hhtjax.LinearSystem(MASS, 0.1 * CHAIN, stiffness, load)
    zero, params = jnp.zeros(SIZE), {"k": 100.0, "load": 3.0}
    model = export_c(system, hht(-0.1), zero, zero, params, name="chain")
    return system, Library(model, tmp_path_factory.mktemp("chain"))


@pytest.mark.slow
def test_factors_are_kept_until_what_they_are_made_of_changes(library):
    """The numbers of the step in Python, while a load, a stiffness and the step size change."""
    system, library = library
    stepper, zero = hht(-0.1), jnp.zeros(SIZE)
    step = jax.jit(lambda state, params, dt: stepper.step(system, state, params, dt)[0])
    params, dt = {"k": jnp.asarray(100.0), "load": jnp.asarray(3.0)}, 1e-2
    expected = stepper.init(system, zero, zero, params, dt)
    state, flags = library.begin(zero, zero, dt=dt)
    assert flags == 0
    factors = [bytes(state.factors_0)]
    for k, amplitude, dt in ((100.0, 3.0, 1e-2), (100.0, 5.0, 1e-2), (300.0, 5.0, 1e-2), (300.0, 5.0, 5e-3)):
        given = type(library.defaults).from_buffer_copy(library.defaults)
        given.k, given.load = k, amplitude
        params = {"k": jnp.asarray(k), "load": jnp.asarray(amplitude)}
        for _ in range(40):
            assert library.step(state, dt=dt, params=given) == 0
            expected = step(expected, params, dt)
        factors.append(bytes(state.factors_0))
    for field, value in (("q", expected.q), ("v", expected.v), ("w", expected.w)):
        assert np.max(abs(numbers(state, field) - value)) < 1e-12 * np.max(abs(value)), field
    assert [a == b for a, b in itertools.pairwise(factors)] == [True, True, False, False]


@pytest.mark.slow
def test_matrices_are_loops(library):
    """So that a hundred unknowns are no million lines; what is small has neither loops nor factors."""
    _, library = library
    model = library.model
    assert len(model.source.splitlines()) < 5000  # of which the start, with three solves more than M^-1 Q, is half
    assert "double factors_0" not in model.header
    assert f"chain_real factors_0[{SIZE * SIZE}];" in model.header
    assert model.operations > 2 * SIZE**2
    two = hhtjax.LinearSystem(MASS[:2, :2], None, CHAIN[:2, :2])
    small = export_c(two, hht(), jnp.ones(2), jnp.zeros(2))
    assert "factor" not in small.header + small.source
    assert "for (" not in small.source
