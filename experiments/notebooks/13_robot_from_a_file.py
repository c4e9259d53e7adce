# %% [markdown]
# # 13. Your robot from a file
#
# MJCF and URDF files describe robots and machines. `hhtjax.bodies.load` reads both and makes
# a `System`. You can then use every integrator, fit and sweep of this library. Only reading
# needs the package `mujoco`: `pip install "hhtjax[models]"`.

# %%
import base64
import tempfile
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import mujoco
import numpy as np
from IPython.display import HTML, display

import hhtjax
from hhtjax import bodies

jax.config.update("jax_enable_x64", True)
plt.rcParams.update(hhtjax.plot.styles.PARAMETERS)
FILE = next(
    path
    for path in (Path("robot.xml"), Path("experiments/notebooks/robot.xml"))
    if path.exists()
)

# %% [markdown]
# ## Loading it
#
# `robot.xml`, beside this notebook, is an arm with three joints and a servo on each. Its
# shapes could touch, and its joints have ranges. If a file contains something that the model
# does not support, loading raises an error:

# %%
try:
    bodies.load(FILE)
except NotImplementedError as error:
    print(error)

# %% [markdown]
# So we say what we want: no contact, and no ranges of the joints. (`limits="stop"` would turn
# the ranges into springs, and `limits="event"` would end a motion there.)

# %%
robot = bodies.load(FILE, ignore=("contact",), limits="ignore")
print(robot)
print("bodies:", robot.bodies)
print("joints:", robot.joints)
print("what was left out:", robot.unsupported)
for name, value in robot.params.items():
    print(f"  params[{name!r}]: {jnp.shape(value)}")

# %% [markdown]
# All numbers are in `robot.params`, a dict of arrays. You can change, fit or differentiate
# them. One function returns the frames of bodies and of marked points:

# %%
q = jnp.array([0.4, 0.6, 0.9])
flange = robot.frames(q)["flange"]
print("flange at", np.round(flange.x, 4), "m")
J = jax.jacfwd(lambda q: robot.frames(q)["flange"].x)(q)
print("its Jacobian:\n", np.round(J, 4))

# %% [markdown]
# ## Are these the right equations?
#
# We compute the mass matrix and the acceleration of one state with MuJoCo, and compare them
# with ours.

# %%
theirs = mujoco.MjModel.from_xml_path(str(FILE))
theirs.opt.disableflags |= (
    mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
)
data = mujoco.MjData(theirs)
v, ctrl = jnp.array([0.5, -0.3, 0.8]), jnp.array([0.5, 0.5, 1.0])
data.qpos[:], data.qvel[:], data.ctrl[:] = q, v, ctrl
mujoco.mj_forward(theirs, data)
dense = np.zeros((3, 3))
mujoco.mj_fullM(theirs, data, dense)
params = robot.params | {"ctrl": ctrl}
M = bodies.mass_matrix(robot, q, params)
w = jnp.linalg.solve(M, robot.system.force(q, v, 0.0, params))
print(
    f"largest difference: mass matrix {np.abs(M - dense).max():.0e}, acceleration "
    f"{np.abs(w - data.qacc).max():.0e}"
)

# %% [markdown]
# ## From one pose to another
#
# The set points of the servos are functions of time. Here they move smoothly for one second
# and then rest. `params["ctrl"]` may be an array, a function of t, or a sampled record.

# %%
FIRST, LAST = np.array([-1.0, -0.4, 0.3]), np.array([1.0, 0.7, 1.1])


def ramp(t):
    """From one pose to the other in a second, at rest at both ends."""
    s = jnp.clip(t, 0.0, 1.0)
    return FIRST + (LAST - FIRST) * (10 * s**3 - 15 * s**4 + 6 * s**5)


params = robot.params | {"ctrl": ramp}
rest = jnp.zeros(3)


def move(robot, params, dt=5e-3):
    """A motion of 1.5 s."""
    return hhtjax.simulate(
        robot.system, hhtjax.hht(), FIRST, rest, params, dt=dt, num_steps=round(1.5 / dt)
    )


begin = time.perf_counter()
run = move(robot, params)
run.check()
print(f"first call {time.perf_counter() - begin:.1f} s, with compiling")
others = [params | {"damping": (1 + 0.01 * i) * params["damping"]} for i in range(1, 6)]
times = []
for other in others:
    begin = time.perf_counter()
    jax.block_until_ready(move(robot, other))
    times.append(time.perf_counter() - begin)
print(f"later calls {1e3 * min(times):.1f} ms, for 300 steps")

film = hhtjax.plot.animation(run, robot, fps=12, speed=0.5)
with tempfile.TemporaryDirectory() as folder:
    film.save(Path(folder) / "arm.gif", writer="pillow", dpi=70)
    plt.close()
    content = base64.b64encode((Path(folder) / "arm.gif").read_bytes()).decode()
display(HTML(f'<img alt="The arm on its way" src="data:image/gif;base64,{content}">'))

# %% [markdown]
# ## How long a step?
#
# Servos are stiff springs. We release the same arm from the first pose while the servos
# already demand the last pose. We compare the angles after 0.2 s from both programs, with
# several steps.

# %%
sudden = robot.params | {"ctrl": LAST}


def mujocos(dt, integrator):
    """The angles after 0.2 s, by MuJoCo."""
    theirs.opt.timestep, theirs.opt.integrator = dt, integrator
    mujoco.mj_resetData(theirs, data)
    data.qpos[:], data.ctrl[:] = FIRST, LAST
    for _ in range(round(0.2 / dt)):
        mujoco.mj_step(theirs, data)
    return np.array(data.qpos)


mujoco.set_mju_user_warning(lambda words: None)  # of runs that blow up: the figure shows them
STEPS = np.array([0.02, 0.01, 0.005, 0.0025])
ours = hhtjax.sweep(
    robot.system, hhtjax.hht(), FIRST, rest, sudden, dts=STEPS, duration=0.2, num_samples=1
)  # all steps in one program
exact = mujocos(1e-5, mujoco.mjtIntegrator.mjINT_RK4)
figure, axes = hhtjax.plot.subplots(width=120, height=65)
axes.loglog(
    1e3 * STEPS, np.abs(ours.q[:, -1] - exact).max(axis=1), "o-", label="hhtjax, hht()"
)
for name, line in (("IMPLICITFAST", "s--"), ("RK4", "^:")):
    found = [mujocos(dt, getattr(mujoco.mjtIntegrator, f"mjINT_{name}")) for dt in STEPS]
    errors = [np.abs(x - exact).max() for x in found]
    axes.loglog(1e3 * STEPS, errors, line, label=f"MuJoCo, {name.lower()}")
axes.set(xlabel="step (ms)", ylabel="error after 0.2 s (rad)", ylim=(1e-9, 1))
axes.set_xticks(1e3 * STEPS, [f"{1e3 * dt:g}" for dt in STEPS])
axes.minorticks_off()
axes.legend()
plt.show()

# %% [markdown]
# **Look at** the slopes. Ours has order 2, `implicitfast` order 1, and the method of Runge
# and Kutta order 4. The latter is the most accurate if the step is short compared with the
# servos' own motion. Otherwise it blows up. [Robots](../robots/README.md) compares more
# robots, with flexible joints and loops, and their times.
#
# ## Dry friction, in five lines
#
# Like most files, this one contains no friction. We add it by name. It is set-valued: a joint
# at rest holds any torque up to its limit, and does not creep.

# %%
rubbing = bodies.load(
    FILE,
    ignore=("contact",),
    limits="ignore",
    joints={"*": {"friction": 12.0}, "elbow": {"friction": 6.0}},
)
params = rubbing.params | {"ctrl": ramp}
stuck = move(rubbing, params)
stuck.check()

# %%
figure, panels = hhtjax.plot.subplots(1, 3, width=175, height=60)
for i, axes in enumerate(panels):
    for which, style, label in ((run, "-", "without friction"), (stuck, "--", "with")):
        behind = jax.vmap(ramp)(which.t)[:, i] - which.q[:, i]
        axes.plot(which.t, 1e3 * behind, style, label=label)
    axes.set(title=robot.joints[i], xlabel="time (s)", xlim=(0.9, 1.5), ylim=(-10, 20))
panels[0].set(ylabel="behind its set\npoint (mrad)")
panels[0].legend()
plt.show()

# %% [markdown]
# **Look at** the ends. With friction each joint stops where the servo's torque is within the
# limit, and stays there.
#
# ## What depends on what?
#
# Gradients pass through the integrator. How much would the end position change if the forearm
# were heavier?


# %%
def height(mass):
    """Of the flange at the end, m."""
    q = move(robot, robot.params | {"ctrl": ramp, "mass": mass}).q[-1]
    return robot.frames(q)["flange"].x[2]


slope = jax.grad(height)(robot.params["mass"])
for name, value in zip(robot.bodies, slope, strict=True):
    print(f"{name}: {1e3 * value:+.4f} mm for each kg more")

# %% [markdown]
# ## What to try next
#
# * Load your own file: `bodies.load("your_robot.urdf", base="free")` for a robot that is not
#   fixed to the ground.
# * `more=[bodies.Body("payload", "forearm", mass=2.5, position=(0.5, 0, 0), ...)]` attaches a
#   payload.
# * Use `limits="stop"`, and a set point beyond the range of the elbow.
# * Notebook 14 estimates friction and payload from a record.
