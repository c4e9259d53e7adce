"""Systems and steppers as descriptions: frozen, equal and hashable by content, pytrees of their arrays."""

from dataclasses import FrozenInstanceError

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from descriptions import DESCRIPTIONS, ONE, TWO, inertia, lambda_matrix, pull, run

import hhtjax
from hhtjax import LinearSystem, System

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
