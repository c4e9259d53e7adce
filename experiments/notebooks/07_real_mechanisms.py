# %% [markdown]
# # 7. Real mechanisms: friction, hysteresis, impacts
#
# Joints stick, the force of rubber depends on the past, and parts collide. This notebook
# shows set-valued dry friction, internal states, and a contact by a stiff force with its
# cost.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import hhtjax

jax.config.update("jax_enable_x64", True)
plt.rcParams.update(hhtjax.plot.styles.PARAMETERS)

# %% [markdown]
# ## Stick-slip: a mass on a moving belt
#
# A mass on a spring lies on a moving belt. It sticks to the belt until the spring pulls
# harder than friction can hold. Then it slips back and sticks again. Brakes squeal and
# violins sound in the same way. Friction is **set-valued**. While the mass slides with speed
# $s$, friction equals its limit, which falls with the speed (Stribeck). While the mass
# sticks, friction takes any value up to that limit:
#
# $$\tau = F(s)\,\mathrm{sign}(s) \;\text{ if } s \ne 0, \quad |\tau| \le F(0) \;\text{ if } s = 0, \qquad
# F(s) = F_k + (F_s - F_k)\,e^{-(s/v_s)^2}$$
#
# `System(mass, force, friction=limit, sliding=rates)` states this law. `limit` is $F$, which
# must not be negative. `sliding` is the velocity that is zero while the joint sticks; its
# default is $v$. There is no smoothing parameter.


# %%
def belt_force(q, v, t, params):
    return -params["k"] * q


def sliding(q, v, t, params):
    return v - params["belt"]


def limit(q, v, t, params):
    s = sliding(q, v, t, params)
    return params["Fk"] + (params["Fs"] - params["Fk"]) * jnp.exp(-((s / params["vs"]) ** 2))


rubbing = hhtjax.System(jnp.ones(1), belt_force, friction=limit, sliding=sliding)
params = {"k": 100.0, "Fk": 3.0, "Fs": 5.0, "vs": 0.05, "belt": 0.1}  # N/m, N, N, m/s, m/s
run = hhtjax.simulate(
    rubbing, hhtjax.hht(), jnp.zeros(1), jnp.zeros(1), params, dt=5e-3, num_steps=1000
)
run.check()

figure, (above, below) = hhtjax.plot.subplots(2, 1, width=175, height=85, sharex=True)
above.plot(run.t, 1e3 * run.q[:, 0])
above.axhline(1e3 * params["Fs"] / params["k"], color="black", ls="--", lw=0.8)
above.set_ylabel("position (mm)")
below.plot(run.t, run.friction[:, 0], color="C1")
below.set(xlabel="time (s)", ylabel="friction (N)")
plt.show()
print(
    "after the first second it sticks for "
    f"{100 * float(jnp.mean(run.sticking[200:, 0])):.0f} % of the time"
)

# %% [markdown]
# **Look at** the dashed line. It is the stretch at which the spring pulls with $F_s$. While
# the mass sticks, its position is a straight line and friction follows the spring.
# `run.friction` is $\tau$, and `run.sticking` says where it sticks. Each switch is resolved
# inside its step, without additional steps or iterations. `hht` keeps order 2 through all
# switches.
#
# ## What would smooth friction cost?
#
# A common replacement is $F \tanh(v/v_t)$, a very strong damper below $v_t$. It never sticks
# completely: a block at rest creeps under a load of 90 % of what friction can hold. A smaller
# $v_t$ creeps less, but then a reversal needs smaller steps. The error below is that of a
# free vibration with dry friction. Its exact motion is known: between reversals it is a
# cosine about $\pm F/k$.

# %%
zero = jnp.zeros(1)
still = hhtjax.System(
    jnp.ones(1),
    lambda q, v, t, p: p["load"] + 0 * q,
    friction=lambda q, v, t, p: p["F"] + 0 * q,
)
held = hhtjax.simulate(
    still, hhtjax.hht(), zero, zero, {"load": 3.6, "F": 4.0}, dt=1e-2, num_steps=1000
)
print(f"set-valued: moves {float(held.q[-1, 0])} m in 10 s")
block = hhtjax.System(
    jnp.ones(1), lambda q, v, t, p: p["load"] - p["F"] * jnp.tanh(v / p["vt"])
)
stepper = hhtjax.hht(linearize="state")  # the best one with such dampers
for vt in (1e-2, 1e-3, 1e-4):
    rest = zero, zero, {"load": 3.6, "F": 4.0, "vt": vt}
    moved = hhtjax.simulate(block, stepper, *rest, dt=1e-2, num_steps=1000, save_every=1000).q[
        -1, 0
    ]
    print(f"tanh, vt = {vt:.0e} m/s: creeps {1e3 * moved:7.3f} mm in 10 s")


def exact(t):
    """k = 100, m = 1, F = 4, from 0.5 m.

    The amplitude falls by 2 F/k = 0.08 m each half period."""
    half = np.floor(10 * t / np.pi)
    centre = np.where(half % 2 == 0, 0.04, -0.04)
    return centre + (0.5 - 0.04 - 0.08 * half) * np.cos(10 * t)


dry = hhtjax.System(
    jnp.ones(1), lambda q, v, t, p: -100.0 * q, friction=lambda q, v, t, p: 4.0 + 0 * q
)
smooth = hhtjax.System(jnp.ones(1), lambda q, v, t, p: -100.0 * q - 4.0 * jnp.tanh(v / p))
laws = {"set-valued": (dry, hhtjax.hht(), None)}
laws |= {
    f"tanh, vt = {vt:g} m/s": (smooth, stepper, jnp.asarray(vt)) for vt in (1e-1, 1e-2, 1e-3)
}
counts = np.array([150, 300, 600, 1200, 2400, 4800, 9600])
curves = {}
for name, (system, method, p) in laws.items():
    sweep = hhtjax.sweep(
        system,
        method,
        jnp.array([0.5]),
        zero,
        p,
        dts=1.5 / counts,
        duration=1.5,
        num_samples=75,
    )
    error = np.abs(np.asarray(sweep.q[:, :, 0]) - exact(np.asarray(sweep.t))).max(axis=1)
    curves[name] = np.asarray(sweep.dt), error
figure, axes = hhtjax.plot.subplots(width=130, height=75)
for i, (name, (dt, error)) in enumerate(curves.items()):
    axes.loglog(
        dt,
        error,
        marker=hhtjax.plot.MARKERS[i],
        ls=hhtjax.plot.LINES[i % len(hhtjax.plot.LINES)],
        label=name,
    )
axes.set(xlabel="step size (s)", ylabel="largest error of the position (m)")
axes.legend()
plt.show()
for name, (_, error) in curves.items():
    print(
        f"{name}: error {1e3 * error[0]:.2g} mm with {counts[0]} steps, "
        f"{1e3 * error[-1]:.2g} mm with {counts[-1]}"
    )

# %% [markdown]
# **Look at** the left ends of the curves. There the error no longer depends on the step: it
# is the error of the smooth law. The set-valued line falls as $h^2$. The documentation of
# `System` explains friction of several joints, with constraints and rotations, and limits
# that depend on a normal load. [Dry friction](../friction/README.md) compares with MuJoCo and
# exudyn. [Identification](../identification/README.md) fits the friction of a measured axis
# (EMPS).
#
# ## Hysteresis: a state that remembers
#
# Rubber mounts, wire ropes and bolted joints have a force that depends on the past. The Bouc-Wen model gives it a
# state $z$ of its own:
#
# $$m\ddot q + c\dot q + k q + z = u(t), \qquad \dot z = A\dot q - \beta\,(\gamma\,|\dot q|\,z + \delta\,\dot q\,|z|)$$
#
# `System(mass, force, internal=)` has a place for such **internal states**, any pytree: `internal` is their rate, the
# force takes them too, and runs take a `z0`. They are solved along with the motion, in the one linear solve of a
# step.


# %%
def mount_force(q, v, z, t, p):
    u = p["amplitude"] * t * jnp.sin(2 * jnp.pi * p["frequency"] * t)  # grows with time
    return u - p["c"] * v - p["k"] * q - z


def rate(q, v, z, t, p):
    return p["A"] * v - p["beta"] * (p["gamma"] * jnp.abs(v) * z + p["delta"] * v * jnp.abs(z))


mount = hhtjax.System(lambda q, p: jnp.reshape(p["m"], (1,)), mount_force, internal=rate)
rubber = {"m": 2.0, "c": 10.0, "k": 5e4, "A": 5e4, "beta": 1e3, "gamma": 0.8, "delta": -1.1}
rubber |= {"amplitude": 120.0, "frequency": 5.0}  # N/s, Hz
rest = jnp.zeros(1)
loops = hhtjax.simulate(mount, hhtjax.hht(), rest, rest, rubber, z0=rest, dt=2e-4, num_steps=10000)
loops.check()

figure, axes = hhtjax.plot.subplots(width=100, height=75)
for i, end in enumerate((0.6, 1.2, 2.0)):
    cycle = (loops.t > end - 1 / rubber["frequency"]) & (loops.t <= end)
    axes.plot(1e3 * loops.q[cycle, 0], loops.z[cycle, 0], ls=hhtjax.plot.LINES[i], label=f"cycle that ends at {end} s")
axes.fill(1e3 * loops.q[cycle, 0], loops.z[cycle, 0], color=hhtjax.plot.COLOURS[2], alpha=0.1, lw=0)  # what is lost
for text, at, towards in (("out", (-0.9, 40), (-0.1, 85)), ("back", (0.9, -50), (0.1, -95))):
    axes.annotate(text, towards, at, ha="center", va="center", arrowprops={"arrowstyle": "->"})
axes.set(xlabel="displacement (mm)", ylabel="hysteretic force z (N)")
axes.legend()
plt.show()
last = loops.t > loops.t[-1] - 1 / rubber["frequency"]
eaten = float(jnp.sum((loops.z * loops.v)[last]) * 2e-4)
damped = float(jnp.sum(rubber["c"] * loops.v[last] ** 2) * 2e-4)
print(f"the hysteresis takes {1e3 * eaten:.0f} mJ out of the last cycle, the damper {1e3 * damped:.1f} mJ")

# %% [markdown]
# **Look at** the loop of the last cycle. It is run through clockwise: at one displacement the mount pushes back more
# on the way to the right ("out", the upper branch) than on the way to the left ("back", the lower branch). So a cycle
# takes more work than it gives back, and the area inside the loop is the energy that it loses. Small motions hardly
# open a loop; large ones lose much.
#
# The tips are sharp because $\dot z$ changes at once when the velocity changes its sign: with these $\gamma$ and
# $\delta$ the force falls much faster behind a turn than it rose before it. Each turn also makes the mass vibrate a
# little, at a frequency far above that of the load. Where that turns the velocity once more, a notch appears beside the
# tip: a small loop of its own. The loops do not close, as the load grows from cycle to cycle.
#
# `hhtjax.scenes` has more that remembers: friction with bristles that bend before they slip (`lugre`), a rubber
# mount of Maxwell branches (`maxwell`), a motor with its controller (`motor_joint`).
#
# ## A bouncing ball: a stiff contact
#
# A ball falls on a plate. At the depth $\delta$ the plate pushes back with
# $k\,\delta\,(1 + c\,\dot\delta)$ (Hunt and Crossley). This is a spring with losses that
# vanish at the end of the contact. The contact lasts some milliseconds, and the step must
# resolve it.


# %%
def contact(q, v, t, p):
    depth, into = jnp.maximum(-q, 0.0), -v
    return -9.81 * p["m"] + jnp.maximum(p["k"] * depth * (1 + p["c"] * into), 0.0)


ball = hhtjax.System(lambda q, p: jnp.reshape(p["m"], (1,)), contact)
thrown = {"m": 1.0, "k": 1e5, "c": 0.1}  # kg, N/m, s/m
high, still = jnp.ones(1), jnp.zeros(1)
bounce = hhtjax.simulate(ball, hhtjax.hht(), high, still, thrown, dt=2e-4, num_steps=15000)
bounce.check(reach=1.1)

figure, (left, right) = hhtjax.plot.subplots(1, 2, width=175, height=65, width_ratios=(3, 2))
left.plot(bounce.t, bounce.q[:, 0])
left.set(xlabel="time (s)", ylabel="height (m)")
near = slice(2240, 2340)
right.plot(1e3 * bounce.t[near], 1e3 * bounce.q[near, 0], ".-", ms=3)
right.axhline(0, color="black", lw=0.8)
right.set(xlabel="time (ms)", ylabel="height at the first impact (mm)")
plt.show()
height, speed = np.asarray(bounce.q[:, 0]), np.asarray(bounce.v[:, 0])
touching = np.sum(height[2000:2600] < 0) * 0.2  # ms
tops = height[:-1][(speed[:-1] > 0) & (speed[1:] <= 0)]
print(
    f"the first contact lasts {touching:.1f} ms; tops of the first jumps "
    f"{', '.join(f'{x:.3f}' for x in tops[:4])} m"
)
print(f"restitution at the first impact, from the tops: {np.sqrt(tops[0]):.3f}")

# %% [markdown]
# How many steps does a contact need? One sweep runs all step sizes. We compare the height 0.8
# s after the start, well after the first impact:

# %%
dts = jnp.geomspace(2e-5, 5e-3, 25)
heights = hhtjax.sweep(
    ball, hhtjax.hht(), high, still, thrown, dts=dts, duration=0.8, num_samples=1
)
off = jnp.abs(heights.q[1:, -1, 0] - heights.q[0, -1, 0])
per_contact = touching / 1e3 / heights.dt[1:]
figure, axes = hhtjax.plot.subplots(width=120, height=60)
axes.loglog(per_contact, 1e3 * off, "o-", ms=4)
axes.set(xlabel="steps per contact", ylabel="error of the height\nat 0.8 s (mm)")
plt.show()
for wanted in (4, 20, 100):
    i = int(jnp.argmin(jnp.abs(jnp.log(per_contact / wanted))))
    print(f"{float(per_contact[i]):5.0f} steps per contact: {1e3 * float(off[i]):8.3f} mm off")

# %% [markdown]
# The error falls, but not along a straight line. A step that contains the beginning or the
# end of a contact loses its order, and where these fall changes with the step. To keep the
# order, locate the impact within the step:
# `simulate(..., events=[Event(guard, reset=impact(e))])`. Such **events** have a coefficient
# of restitution instead of a stiffness. See [events](../events/README.md). For contacts that
# also rest, stick and slide see [contact](../contact/README.md).
#
# ## What to try next
#
# * Fit `Fs`, `Fk` and `vs` of the belt from a noisy run, as in notebook 3.
# * Set the frequency of the mount to 30 Hz, closer to its resonance. How do the loops change?
# * Drop the ball with `hht(alpha=0.0)`. Is the energy after an impact always less than
#   before?
