"""Numbers and arrays of every kind as arguments: float32 and float64 stay what they are."""

import re
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ONE, SINGLE, ZERO, lagrangian, pull, run, with_tolerance
from zoo import STEPPERS

import hhtjax
from hhtjax import LinearSystem, PrecisionWarning, System


def float_dtypes(solution):
    """Dtypes of all numbers in a solution, but those that count."""
    return {x.dtype.name for x in jax.tree.leaves(solution) if jnp.issubdtype(x.dtype, jnp.inexact)}


def run_and_catch(**arguments):
    """A run, and the warnings it gave."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        solution = run(**arguments)
    return solution, caught


@pytest.mark.parametrize(
    "name", ["rk4", "hht state", "hht converged", "generalized_alpha", "kim_hht", "kim_implicit_euler"]
)
def test_float32_stays_float32_and_warns_once_a_call(name):
    for _ in range(2):  # a cached compilation warns too
        solution, caught = run_and_catch(
            stepper=with_tolerance(STEPPERS[name], 1e-5), q0=SINGLE, v0=0 * SINGLE, save_every=2
        )
        assert float_dtypes(solution) == {"float32"}
        assert [x.category for x in caught] == [PrecisionWarning]
        assert caught[0].filename == run.__code__.co_filename
        assert re.match(
            r"simulate: in float32 expect about 4 correct digits .* jax.config.update\('jax_enable_x64', True\)",
            str(caught[0].message),
        )
        assert np.isclose(solution.q[-1, 0], np.cos(0.8), atol=0.3)
    late, _ = run_and_catch(
        stepper=with_tolerance(STEPPERS[name], 1e-5), q0=SINGLE, v0=0 * SINGLE, save_every=2, t0=1e8
    )
    with pytest.raises(hhtjax.SimulationError, match=r"times are equal in float32, near t = 1e\+08: count from a t0"):
        late.check()


@pytest.mark.parametrize("name", ["rk4", "hht auto", "kim_hht"])
def test_float64_stays_float64_and_does_not_warn(name):
    solution, caught = run_and_catch(stepper=STEPPERS[name], save_every=2)
    assert float_dtypes(solution) == {"float64"}
    assert caught == []


@pytest.mark.parametrize(
    "system",
    [
        System([1.0], pull),
        System(np.array([[1]]), pull),
        System(lambda q, params: 1.0, pull),
        System.from_lagrangian(lagrangian),
        LinearSystem([1.0], C=[0.0], K=[4.0]),
        LinearSystem(np.array([1]), K=np.array([[4]])),
        LinearSystem(lambda params: jnp.ones(1, jnp.float32), K=np.array([4.0])),
    ],
)
def test_constants_of_a_system_take_the_dtype_of_the_state(system):
    stepper = STEPPERS["newmark" if isinstance(system, LinearSystem) else "rk4"]
    single, _ = run_and_catch(system=system, stepper=stepper, q0=SINGLE, v0=0 * SINGLE)
    assert float_dtypes(single) == {"float32"}
    assert np.allclose(single.q, run(stepper=stepper).q, atol=1e-6)


def test_integer_and_single_constants_do_not_spoil_double_precision():
    expected = run(stepper=STEPPERS["newmark"])
    solution = run(LinearSystem(np.array([1]), C=0 * SINGLE, K=np.array([[4]])), STEPPERS["newmark"])
    assert float_dtypes(solution) == {"float64"}
    assert np.allclose(solution.q, expected.q, rtol=1e-14)


@pytest.mark.parametrize(
    ("make", "number", "dtype"),
    [
        (lambda x: {"stepper": hhtjax.hht(alpha=-x)}, np.float32, np.float64),
        (lambda x: {"stepper": hhtjax.kim_hht(alpha=-x)}, jnp.float64, np.float32),
        (lambda x: {"stepper": hhtjax.hht(alpha=-0.125, iterations=None, tolerance=x)}, np.float64, np.float32),
        (lambda x: {"dt": x, "t0": x}, np.float32, np.float64),
    ],
    ids=["alpha", "kim alpha", "tolerance", "dt"],
)
def test_numbers_of_any_precision_take_the_dtype_of_the_state(make, number, dtype):
    """1/8 is exact in both precisions, so the run must be that of the Python number."""
    solution, _ = run_and_catch(**{"q0": ONE.astype(dtype), "v0": ZERO.astype(dtype), **make(number(0.125))})
    expected, _ = run_and_catch(**{"q0": ONE.astype(dtype), "v0": ZERO.astype(dtype), **make(0.125)})
    assert float_dtypes(solution) == {np.dtype(dtype).name}
    assert np.allclose(solution.q, expected.q, rtol=4 * np.finfo(dtype).eps)


@pytest.mark.parametrize(
    ("q0", "v0", "dtype"),
    [
        (1, 0, "float64"),
        (1.0, 0, "float64"),
        (np.array([1]), np.array([0]), "float64"),
        (np.array([1], np.int8), np.array([0], np.uint8), "float64"),
        (jnp.array([1]), np.array([0.0]), "float64"),
        (np.array([1]), np.zeros(1, np.float32), "float32"),
        (np.float32(1), 0.0, "float32"),
        (np.float64(1), 0, "float64"),
        ({"a": 1, "b": [1.0, np.ones(2)]}, {"a": 0, "b": [0.0, np.zeros(2)]}, "float64"),
        ((1, np.float32(1)), (0, 0), "float32"),
    ],
    ids=repr,
)
def test_integers_numbers_and_numpy_arrays_are_initial_values(q0, v0, dtype):
    """Integers and Python numbers take the float type of the others, or the default one."""
    size = sum(np.size(x) for x in jax.tree.leaves(q0))
    solution, caught = run_and_catch(system=System(np.ones(size), pull), q0=q0, v0=v0)
    assert float_dtypes(solution) == {dtype}
    assert len(caught) == (dtype == "float32")
    assert jax.tree.structure(solution.q) == jax.tree.structure(solution.v) == jax.tree.structure(q0)
    for x, start in zip(jax.tree.leaves(solution.q), jax.tree.leaves(q0), strict=True):
        assert x.shape == (5, *np.shape(start))
        assert np.allclose(x[-1], np.cos(0.8), atol=1e-3)


@pytest.mark.parametrize(
    ("name", "mass"),
    [
        ("hht state", lambda q, params: jnp.array(2.0)),
        ("hht state", lambda q, params: jnp.array([[2.0]])),
        ("hht state", np.array([2.0])),
        ("kim_hht", lambda q, params: jnp.array(2.0)),
        ("rk4", lambda q, params: jnp.array([2.0])),
    ],
)
def test_a_scalar_coordinate_is_a_vector_of_one(name, mass):
    solution = run(System(mass, lambda q, v, t, params: -8.0 * q), STEPPERS[name], 1.0, 0.0)
    expected = run(stepper=STEPPERS[name])
    assert solution.q.shape == solution.v.shape == solution.acceleration.shape == (5,)
    assert np.allclose(solution.q, expected.q[:, 0], rtol=1e-12)


@pytest.mark.parametrize(
    "make",
    [
        lambda: System(np.array(2.0), lambda q, v, t, params: -8.0 * q),
        lambda: System(2.0, lambda q, v, t, params: -8.0 * q),
        lambda: LinearSystem(lambda params: jnp.array(2.0), K=lambda params: jnp.array(8.0)),
        lambda: LinearSystem(lambda params: 2.0, K=lambda params: 8.0),
    ],
)
def test_a_scalar_coordinate_may_have_scalar_coefficients(make):
    assert np.allclose(run(make(), q0=1.0, v0=0.0).q, run().q[:, 0], rtol=1e-12)
