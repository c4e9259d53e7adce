"""A sweep over several devices and several processes has the bits of a sweep on one."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import PartitionSpec

import hhtjax
from experiments.sweeps.devices import case, swept
from hhtjax.jaxpr.scalar_rules import is_understood
from hhtjax.primitives import compat

MEMBERS = 300


@pytest.mark.slow
def test_three_devices_and_two_processes_give_the_bits_of_one():
    one = swept(MEMBERS, 1)["hash"]
    assert case(MEMBERS, 3)["hash"] == one
    assert case(MEMBERS, 2, processes=True)["hash"] == one


def test_what_is_no_mesh_is_named():
    with pytest.raises(TypeError, match=r"sweep: `mesh` must be a jax\.sharding\.Mesh; received 2"):
        hhtjax.sweep(
            hhtjax.System(np.ones(1), lambda q, v, t, params: -q), hhtjax.rk4(), np.ones(1), np.zeros(1),
            dts=[0.1], duration=1.0, num_samples=1, mesh=2,
        )  # fmt: skip


@pytest.mark.slow
def test_a_mesh_of_one_device_changes_nothing():
    def run(mesh):
        system = hhtjax.System(np.ones(1), lambda q, v, t, params: -q)
        return hhtjax.sweep(
            system, hhtjax.rk4(), np.ones(1), np.zeros(1), dts=[0.1, 0.02], duration=1.0, num_samples=1, mesh=mesh
        )

    jax.tree.map(np.testing.assert_array_equal, run(None), run(jax.make_mesh((1,), ("anything",))))


@pytest.mark.skipif(not compat.is_on(), reason="this JAX evaluates nothing on scalars")
def test_inside_shard_map_operations_are_understood():
    """JAX gives arrays that are made there a sharding, which says nothing."""

    def made(x):
        return jnp.ones_like(x) + x

    mesh, whole = jax.make_mesh((1,), ("members",)), PartitionSpec()
    split = jax.shard_map(made, mesh=mesh, in_specs=whole, out_specs=whole, check_vma=False)
    ((eqn,),) = [jax.make_jaxpr(split)(jnp.ones((2, 2))).eqns]
    inside = eqn.params["jaxpr"].eqns
    assert "broadcast_in_dim" in {x.primitive.name for x in inside}
    assert all(map(is_understood, inside))


def test_shard_map_that_checks_axes_is_refused_in_words():
    mesh = jax.make_mesh((1,), ("b",))
    system = hhtjax.System(np.ones(1), lambda q, v, t, p: -p * q)

    def end(k):
        return hhtjax.simulate(system, hhtjax.rk4(), jnp.ones(1), jnp.zeros(1), k, dt=0.1, num_steps=3).q[-1]

    given = jax.device_put(jnp.array([1.0, 2.0]), jax.NamedSharding(mesh, PartitionSpec("b")))
    spread = PartitionSpec("b")
    by_hand = partial(jax.shard_map, jax.vmap(end), mesh=mesh, in_specs=spread, out_specs=spread)
    with pytest.raises(TypeError, match=r"simulate: inside `jax.shard_map`.*axes \['b'\].*check_vma=False"):
        by_hand()(given)
    np.testing.assert_array_equal(jax.jit(by_hand(check_vma=False))(given), jax.vmap(end)(jnp.array([1.0, 2.0])))
