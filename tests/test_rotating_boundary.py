"""What the library says to wrong rotations."""

import re

import jax.numpy as jnp
import numpy as np
import pytest

import hhtjax
from hhtjax.scenes import top


def test_bad_input():
    scene = top.minimal()

    def simulate(q0=scene.q0, v0=scene.v0, stepper=None, system=scene.system):
        stepper = hhtjax.hht() if stepper is None else stepper
        return hhtjax.simulate(system, stepper, q0, v0, scene.params, dt=0.01, num_steps=1)

    bad = "must be a rotation, because its velocity has 3 components; received a matrix R whose R^T R differs from I by"
    for error, message, call in (
        (ValueError, f"simulate: `q0` {bad} 0.0201", lambda: simulate(1.01 * jnp.eye(3))),
        (
            ValueError,
            "simulate: `q0` must be a rotation; received a reflection, det R = -1",
            lambda: simulate(-jnp.eye(3)),
        ),
        (
            ValueError,
            "but (3,) for a rotation, a matrix (3, 3); received shape (2,)",
            lambda: simulate(v0=jnp.zeros(2)),
        ),
        (ValueError, "but (3,) for a rotation, a matrix (3, 3); received shape (3,)", lambda: simulate(jnp.ones(4))),
        (
            NotImplementedError,
            "simulate: RK4 cannot move the rotations in `q0`",
            lambda: simulate(stepper=hhtjax.rk4()),
        ),
        (NotImplementedError, "KimHHT cannot move", lambda: simulate(stepper=hhtjax.kim_hht())),
        (NotImplementedError, "write a System(mass, force)", lambda: simulate(system=hhtjax.LinearSystem(jnp.ones(3)))),
        (
            NotImplementedError,
            "from_lagrangian",
            lambda: simulate(system=hhtjax.System.from_lagrangian(lambda q, v, t, p: jnp.sum(v**2))),
        ),
        (
            ValueError,
            'hht: `kinematics` must be "chart" or "lie"; received',
            lambda: hhtjax.hht(kinematics="quaternion"),
        ),
    ):
        with pytest.raises(error, match=re.escape(message)):
            call()


@pytest.mark.slow
def test_inconsistent_velocity():
    """Of the rod of the top, named with its size and with the way out."""
    scene = top.constrained()
    v0 = scene.v0 | {"x": scene.v0["x"] + 0.1}
    with pytest.raises(ValueError, match=r"`v0` violates the constraint: max\|dPhi/dt\| = 0\.1, .*consistent_initial"):
        hhtjax.simulate(scene.system, hhtjax.hht(), scene.q0, v0, scene.params, dt=0.01, num_steps=1)
    mended = hhtjax.consistent_initial(scene.system, scene.q0, v0, scene.params)
    np.testing.assert_allclose(np.cross(scene.q0["R"] @ mended.v["R"], mended.q["x"]), mended.v["x"], atol=1e-12)
