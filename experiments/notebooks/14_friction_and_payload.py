# %% [markdown]
# # 14. A robot's friction and payload
#
# An arm is loaded from a file. Its angles come from encoders and its torques from motors.
# Unknown are the dry and viscous friction of each joint, and the payload on the flange: its
# mass, centre and inertia. We first ask what a motion can show at all, and which motion shows
# it best. Then we make a first estimate without any simulation. Last is the fit through the
# integrator, with reliable errors.

# %%
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import hhtjax
from hhtjax import bodies
from hhtjax.identification import (
    base_parameters,
    excitation,
    inertia_coordinates,
    physical_inertia,
)

jax.config.update("jax_enable_x64", True)
plt.rcParams.update(hhtjax.plot.styles.PARAMETERS)
FILE = next(
    path
    for path in (Path("robot.xml"), Path("experiments/notebooks/robot.xml"))
    if path.exists()
)

# %% [markdown]
# This is the arm of notebook 13 with friction in its joints and a body on its flange. All
# numbers of friction and body are guesses.

# %%
payload = bodies.Body(
    "payload", "forearm", position=(0.5, 0, 0), mass=1.0, inertia=(0.01, 0.01, 0.01)
)
robot = bodies.load(
    FILE,
    ignore=("contact",),
    limits="ignore",
    joints={"*": {"friction": 5.0, "damping": 5.0}},
    more=[payload],
)
print(robot.bodies, robot.joints)

# %% [markdown]
# ## What can a motion show?
#
# Torques are linear in the ten inertial parameters of each body: mass, first moments, moments
# and products of inertia. Of the 40 parameters here many have no effect, or only as sums. The
# number of combinations that can be identified is the rank of a matrix, the *regressor*:

# %%
base = base_parameters(robot)
print(
    f"{len(robot.bodies) * 10} inertial parameters, of which a motion can tell "
    f"{base.count} combinations"
)
print("never seen:", ", ".join(base.unseen))

# %% [markdown]
# The links are known from their drawings, and the rotors (`armature`) from data sheets. Only
# the payload is unknown. `physical_inertia` makes mass, centre and inertia from ten numbers
# without limits. So no step of a fit leaves the range of real bodies.
#
# ## A motion that shows much
#
# `excitation` looks for a periodic motion, within ranges of angle and speed, whose regressor
# is well conditioned.

# %%
begin = time.perf_counter()
PERIOD, RATE = 5.0, 250
found = excitation(
    robot, period=PERIOD, harmonics=4, amplitude=[1.2, 0.7, 0.8], speed=2.0, iterations=60
)
print(
    f"condition {found.start:.0f} of a random motion, {found.condition:.0f} after "
    f"{time.perf_counter() - begin:.0f} s"
)
trajectory = found.trajectory

# %% [markdown]
# ## The record
#
# We generate the record, so we know the true values. The arm follows the motion for two
# periods, simulated with steps of a quarter of a millisecond. The encoders have a resolution
# of 2 pi/65536. The torques have noise of 0.3 N m. A sample is taken every 4 ms.

# %%
truth = {
    "frictionloss": np.array([9.0, 12.0, 4.0]),
    "damping": np.array([6.0, 9.0, 3.0]),
    "payload": inertia_coordinates(
        2.5, jnp.array([0.06, 0.02, -0.03]), jnp.diag(jnp.array([0.012, 0.015, 0.010]))
    ),
}
guess = {
    "frictionloss": 5.0 * np.ones(3),
    "damping": 5.0 * np.ones(3),
    "payload": inertia_coordinates(1.0, jnp.zeros(3), 0.01 * jnp.eye(3)),
}


def complete(unknown):
    """All params of the robot, with those that are to be found."""
    others = {name: value for name, value in unknown.items() if name != "payload"}
    body = physical_inertia(unknown["payload"])
    here = robot.bodies.index("payload")
    moved = {name: robot.params[name].at[here].set(body[name]) for name in body}
    return robot.params | others | moved | {"ctrl": trajectory}


def simulate(unknown, dt, num_steps, save_every=1):
    """The arm on its servos, along the motion."""
    start = trajectory.motion(0.0)[:2]
    return hhtjax.simulate(
        robot.system,
        hhtjax.hht(),
        *start,
        complete(unknown),
        dt=dt,
        num_steps=num_steps,
        save_every=save_every,
    )


SAMPLES = round(2 * PERIOD * RATE)
run = simulate(truth, 1 / RATE / 16, 16 * SAMPLES, save_every=16)
run.check()
rng = np.random.default_rng(0)
count = 2 * np.pi / 65536
angles = count * np.round(np.asarray(run.q) / count)
behind = jax.vmap(trajectory)(run.t) - run.q
torques = np.asarray(robot.params["kp"] * behind - robot.params["kv"] * run.v)
torques = torques + 0.3 * rng.normal(size=torques.shape)

figure, panels = hhtjax.plot.subplots(2, 3, width=175, height=90, sharex=True)
for i, name in enumerate(robot.joints):
    panels[0, i].plot(run.t, angles[:, i], lw=1)
    panels[1, i].plot(run.t, torques[:, i], lw=0.6, color="C1")
    panels[0, i].set(title=name)
    panels[1, i].set(xlabel="time (s)")
panels[0, 0].set(ylabel="angle (rad)")
panels[1, 0].set(ylabel="torque (N m)")
plt.show()

# %% [markdown]
# **Look at** the jumps of the torques where a joint reverses. They are dry friction.
#
# ## A first estimate, without simulation
#
# `equation_error` inserts filtered angles, speeds and accelerations into the equations of
# motion, with the measured torque instead of the servos. The fit minimises the rest. The
# payload's inertia stays at its guess.

# %%
rows = hhtjax.equation_error(robot.system, angles, 1 / RATE, cutoff=12.0)
off = {"kp": jnp.zeros(3), "kv": jnp.zeros(3), "torque": hhtjax.sampled(torques, 1 / RATE)}


def left_over(some):
    """Of the equations of motion; `some`: friction, and mass and centre of the payload."""
    unknown = {name: some[name] for name in ("frictionloss", "damping")}
    theta = guess["payload"].at[0].set(some["mass"]).at[7:].set(some["centre"])
    return rows(complete(unknown | {"payload": theta}) | off)


begin = time.perf_counter()
known = {name: guess[name] for name in ("frictionloss", "damping")}
first = hhtjax.fit(
    left_over, known | {"mass": guess["payload"][0], "centre": guess["payload"][7:]}
)
start = {name: first.params[name] for name in known}
start["payload"] = (
    guess["payload"].at[0].set(first.params["mass"]).at[7:].set(first.params["centre"])
)
print(f"{time.perf_counter() - begin:.0f} s")
for name in known:
    print(f"{name}: {np.round(start[name], 3)}, in truth {truth[name]}")
body = physical_inertia(start["payload"])
print(
    f"payload: {body['mass']:.3f} kg at {np.round(body['com'], 4)} m, in truth 2.5 kg at "
    "[0.06, 0.02, -0.03]"
)

# %% [markdown]
# ## The fit through the integrator
#
# Now the whole motion is simulated, with 2500 steps of 4 ms, and angles are compared with
# encoder readings. Derivatives go through every step, including those in which a joint
# sticks. The record does not determine all ten numbers of the payload. A wide prior says what
# a body of this size can have.

# %%
wide = hhtjax.Gaussian(
    np.asarray(guess["payload"]), np.array([2.0, *[1.0] * 3, *[0.5] * 3, *[0.3] * 3])
)
noise = count / np.sqrt(12)


def residuals(unknown):
    """Simulated less measured angles, relative to their noise."""
    return (simulate(unknown, 1 / RATE, SAMPLES).q - angles) / noise


begin = time.perf_counter()
result = hhtjax.fit(residuals, start, prior={**dict.fromkeys(known), "payload": wide})
print(f"{time.perf_counter() - begin:.0f} s\n")
print(result.summary())

# %%
body = physical_inertia(result.params["payload"])
within = 1.96 * 2 * body["mass"] * result.standard_errors["payload"][0]  # m = exp(2 alpha)
print(f"payload {body['mass']:.3f} kg, 95 % within {within:.3f}, in truth 2.5 kg")
print(f"its centre {np.round(1e3 * body['com'], 1)} mm, in truth [60, 20, -30]")

names = [f"{kind}\n{joint}" for kind in known for joint in robot.joints] + ["payload\nmass"]


def in_a_row(x, mass):
    """Friction, damping and the mass of the payload."""
    return np.concatenate([*(np.ravel(x[kind]) for kind in known), [mass]])


true, initial = (
    in_a_row(truth, 2.5),
    in_a_row(start, physical_inertia(start["payload"])["mass"]),
)
estimates, errors = (
    in_a_row(result.params, body["mass"]),
    in_a_row(result.standard_errors, within / 1.96),
)
figure, axes = hhtjax.plot.subplots(width=150, height=90)
place = np.arange(len(names))
axes.plot(100 * (initial / true - 1), place, "s", label="equation error")
axes.errorbar(
    100 * (estimates / true - 1),
    place,
    xerr=196 * errors / true,
    fmt="o",
    capsize=3,
    label="fit, 95 %",
)
axes.axvline(0, color="black", lw=0.8)
axes.set_yticks(place, names)
axes.invert_yaxis()
axes.set(xlabel="estimate less truth (%)")
axes.legend()
plt.show()

# %% [markdown]
# **Look at** the errors of the first estimate, and at what the fit leaves of them. The
# intervals do not contain the error of the step, which is 4 ms here and a quarter of a
# millisecond in the record: see notebook 3.
#
# ## What to try next
#
# * Use a random motion instead of the excitation. Which intervals grow?
# * Use `joints={"*": {"friction": 0.0}}` and a smooth tanh friction. The residuals show where
#   it creeps.
# * Use your own record: `angles` and `torques` are arrays (samples, joints). Nothing else is
#   needed.
