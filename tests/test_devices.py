"""A sweep over several devices and several processes has the bits of a sweep on one."""

import jax
import numpy as np
import pytest

import hhtjax
from experiments.sweeps.devices import case, swept

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
