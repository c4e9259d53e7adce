"""Mechanisms from bodies and joints, or from model files: their equations in minimal coordinates as a `System`.

A body hangs on its parent by joints; each joint brings its own coordinates, and nothing else moves. A rod on a motor,
driven to an angle:

>>> import jax.numpy as jnp, hhtjax
>>> from hhtjax.bodies import Body, Joint, Motor, tree
>>> rod = Body("rod", joints=Joint("revolute", axis=[0, 1, 0], armature=0.1, friction=0.5),
...            mass=2.0, com=[0.3, 0, 0], inertia=[0.001, 0.06, 0.06])
>>> arm = tree([rod], motors=[Motor("rod", "position", kp=400.0, kv=30.0)])
>>> run = hhtjax.simulate(
...     arm.system, hhtjax.hht(), arm.q0, arm.v0, arm.params | {"ctrl": jnp.array([-0.5])}, dt=5e-3, num_steps=400)
>>> run.check()
>>> round(float(run.q[-1, 0]), 2)                                           # gravity holds it off by m g c/kp
-0.49

All numbers of a mechanism are in `params`, a dict of arrays: they can be fitted, differentiated, and run in batches.
Places and axes are part of the program, because known zeros make it fast; `free=("position",)` makes places data.

From a file
-----------

`load` reads MJCF and URDF, by the package mujoco (`pip install "hhtjax[models]"`). What acts in the file and is not
modelled here is refused in one list, unless you ignore it by name:

>>> from hhtjax import bodies
>>> pendulum = bodies.load('''<mujoco><worldbody><body name="rod"><joint name="pivot" axis="0 1 0"/>
...     <inertial mass="1" pos="0 0 -0.5" diaginertia="0.08 0.08 0.001"/></body></worldbody></mujoco>''',
...     joints={"pivot": {"friction": 0.1, "damping": 0.02}})                    # what the file does not say
>>> pendulum
Mechanism(1 bodies, 1 rates, 0 motors)

Coordinates
-----------

q and v are arrays (n,) where there are hinges and slides only: `Mechanism.index` gives the place of a joint. Otherwise
q is a dict: "ball", rotation matrices (., 3, 3) from the body to its parent; "free", with "R" (., 3, 3) and "x" (., 3)
in the world; "joint", hinges and slides. v has material angular velocities (., 3) in the place of matrices.

Loops
-----

`Connect`, `Weld` and `Couple` close loops of a tree, as constraints of the system. Rows that only repeat what others
say are left out when the mechanism is made: a pin in the plane has three rows, and two that count.

How it is computed
------------------

A step calls one function, the inverse dynamics less the forces that act (`System(dynamics=)`). Its slopes in q, v and w
are known in closed form, and autodiff uses them: see `hhtjax/bodies/newton_euler.py`.
"""

from hhtjax.bodies.description import (
    Body,
    Connect,
    Couple,
    Joint,
    Marker,
    Motor,
    Weld,
    denavit_hartenberg,
    flexible,
)
from hhtjax.bodies.equations import Frame
from hhtjax.bodies.functions import (
    forces,
    frames,
    inertial_parameters,
    inverse_dynamics,
    mass_matrix,
    regressor,
)
from hhtjax.bodies.mechanism import Mechanism, tree
from hhtjax.bodies.model_file import load

__all__ = [
    "Body",
    "Connect",
    "Couple",
    "Frame",
    "Joint",
    "Marker",
    "Mechanism",
    "Motor",
    "Weld",
    "denavit_hartenberg",
    "flexible",
    "forces",
    "frames",
    "inertial_parameters",
    "inverse_dynamics",
    "load",
    "mass_matrix",
    "regressor",
    "tree",
]
