"""Mechanisms from bodies and joints, or from model files, as a `System` in minimal coordinates.

Joints connect a body to its parent. Each joint adds its own coordinates; there are no others. Example: a rod on a motor
that is driven to an angle:

>>> import jax.numpy as jnp, hhtjax
>>> from hhtjax.bodies import Body, Joint, Motor, tree
>>> rod = Body("rod", joints=Joint("revolute", axis=[0, 1, 0], armature=0.1, friction=0.5),
...            mass=2.0, com=[0.3, 0, 0], inertia=[0.001, 0.06, 0.06])
>>> arm = tree([rod], motors=[Motor("rod", "position", kp=400.0, kv=30.0)])
>>> run = hhtjax.simulate(
...     arm.system, hhtjax.hht(), arm.q0, arm.v0, arm.params | {"ctrl": jnp.array([-0.5])}, dt=5e-3, num_steps=400)
>>> run.check()
>>> round(float(run.q[-1, 0]), 2)                                           # gravity deflects it by m g c/kp
-0.49

All numbers of a mechanism are in `params`, a dict of arrays: they can be fitted, differentiated, and run in batches.
Positions and axes are exceptions: they are part of the compiled program, which is faster because it knows their zeros.
`free=("position",)` puts positions into params.

From a file
-----------

`load` reads MJCF and URDF files, with the package mujoco (`pip install "hhtjax[models]"`). If the file contains
features that are not modelled here, an error lists all of them. To load it without them, pass their names as
`ignore=`. `joints=` adds numbers that the file does not contain:

>>> from hhtjax import bodies
>>> pendulum = bodies.load('''<mujoco><worldbody><body name="rod"><joint name="pivot" axis="0 1 0"/>
...     <inertial mass="1" pos="0 0 -0.5" diaginertia="0.08 0.08 0.001"/></body></worldbody></mujoco>''',
...     joints={"pivot": {"friction": 0.1, "damping": 0.02}})                    # not in the file
>>> pendulum
Mechanism(1 bodies, 1 rates, 0 motors)

Friction from a record
----------------------

`equation_error` estimates dry friction with its 95 % interval from encoders and motor torques, without simulation. The
record in this example is generated, with friction of 1.5 and 0.7 N m, and with noise:

>>> import jax, numpy as np
>>> arm = bodies.load('''<mujoco><worldbody><body name="upper">
...     <joint name="shoulder" axis="0 1 0" frictionloss="1"/>
...     <inertial mass="2" pos="0.2 0 0" diaginertia="0.01 0.05 0.05"/><body name="fore" pos="0.4 0 0">
...     <joint name="elbow" axis="0 1 0" frictionloss="1"/>
...     <inertial mass="1" pos="0.2 0 0" diaginertia="0.01 0.02 0.02"/></body></body></worldbody></mujoco>''')
>>> rng, dt = np.random.default_rng(0), 0.005
>>> t = dt * np.arange(2000)
>>> angles = lambda t: jnp.stack([0.6 * jnp.sin(3 * t), 0.8 * jnp.cos(4 * t)])
>>> rates = jax.jacfwd(angles)
>>> q, v, a = (np.asarray(jax.vmap(f)(t)) for f in (angles, rates, jax.jacfwd(rates)))
>>> torque = jax.vmap(lambda q, v, a: bodies.inverse_dynamics(arm, q, v, a))(q, v, a) + np.sign(v) * [1.5, 0.7]
>>> torque, q = torque + 0.2 * rng.normal(size=q.shape), q + 1e-4 * rng.normal(size=q.shape)
>>> residuals = hhtjax.equation_error(arm.system, q, dt, cutoff=5.0)
>>> known = arm.params | {"torque": hhtjax.sampled(torque, dt)}
>>> found = hhtjax.fit(lambda friction: residuals(known | {"frictionloss": friction}), jnp.ones(2))
>>> for name, F, low, high in zip(arm.joints, found.params, *found.interval()):
...     print(f"{name}: {F:.3f} N m, {low:.3f} to {high:.3f}")
shoulder: 1.503 N m, 1.492 to 1.513
elbow: 0.696 N m, 0.688 to 0.704

Coordinates
-----------

q and v are arrays (n,) if there are only hinges and slides; `Mechanism.index` gives the index of a joint. Otherwise q
is a dict: "ball" has rotation matrices (., 3, 3) from the body to its parent; "free" has "R" (., 3, 3) and "x" (., 3)
in the world; "joint" has hinges and slides. v has angular velocities (., 3), in the axes of the body, instead of
matrices. Motors with an activation add internal states: start runs with `z0=robot.z0`, which is None if there are none.

Loops
-----

`Connect`, `Weld` and `Couple` close loops of a tree, by constraints of the system. Redundant rows are removed when the
mechanism is made: of the three rows of a pin in a plane, two remain.

Flexible links and gears
------------------------

`flexible` puts a spring behind the gear of a motor. `beam` divides a link into rigid pieces with springs between them.
Both use joints with `stiffness`, which is in params and can be fitted. Stiff springs do not require small steps.

How it is computed
------------------

A step calls one function, the inverse dynamics minus the forces that act (`System(dynamics=)`). Its derivatives with
respect to q, v and w are known in closed form, and autodiff uses them: see `hhtjax/bodies/newton_euler.py`.
"""

from hhtjax.bodies.beam import beam
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
    motor_forces,
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
    "beam",
    "denavit_hartenberg",
    "flexible",
    "forces",
    "frames",
    "inertial_parameters",
    "inverse_dynamics",
    "load",
    "mass_matrix",
    "motor_forces",
    "regressor",
    "tree",
]
