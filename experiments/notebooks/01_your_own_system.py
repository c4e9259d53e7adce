# %% [markdown]
# # 1. Your own system in twenty lines
#
# hhtjax simulates mechanical systems
#
# $$M(q)\,\ddot q = Q(q, \dot q, t)$$
#
# You write two plain functions, the mass matrix $M$ and the force $Q$. The library
# differentiates them, solves for the accelerations and steps through time. The example is a
# quarter car: one wheel of a car with its share of the body. It drives over a recorded bump
# and hits a bump stop.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import hhtjax

jax.config.update("jax_enable_x64", True)  # double precision; JAX starts in single precision
plt.rcParams.update(hhtjax.plot.styles.PARAMETERS)  # the look of all figures

# %% [markdown]
# ## The record of the road
#
# Real records have irregular time stamps. This one has 300 heights at unequal times.
# `sampled` turns them into a function of time. `order=1` connects them by straight lines, 3
# by a smooth spline, and 0 holds each value until the next.

# %%
rng = np.random.default_rng(1)
t_road = np.sort(np.append(rng.uniform(0.0, 3.0, 298), [0.0, 3.0]))  # s
z_road = 0.05 * np.exp(-(((t_road - 1.0) / 0.08) ** 2)) - 0.03 * np.exp(
    -(((t_road - 1.9) / 0.15) ** 2)
)  # m

road = hhtjax.sampled(z_road, times=t_road, order=1)
print(
    f"time steps of the record: {np.diff(t_road).min() * 1e3:.2f} to "
    f"{np.diff(t_road).max() * 1e3:.0f} ms"
)

# %% [markdown]
# ## The system
#
# There are two coordinates, both measured upwards from the rest position on a flat road: the
# body $q_0$ and the wheel $q_1$. The spring between them is compressed by $d = q_1 - q_0$.
# Beyond a gap, a rubber stop pushes with $k_b\,(d - g)^2$. A second, much stiffer spring
# connects wheel and road: the tyre.
#
# Put everything that may change into `params`, a dictionary; here this includes the road. The
# functions read nothing from outside. So you can change, fit or differentiate every number
# later.


# %%
def mass(q, params):  # a diagonal: one number for each coordinate
    return jnp.stack([params["body"], params["wheel"]])


def stop_force(d, params):
    return params["k_stop"] * jnp.maximum(d - params["gap"], 0.0) ** 2


def force(q, v, t, params):
    d, rate = q[1] - q[0], v[1] - v[0]
    strut = params["k"] * d + params["c"] * rate + stop_force(d, params)
    tyre = params["k_tyre"] * (params["road"](t) - q[1])
    return jnp.stack([strut, tyre - strut])


quarter_car = hhtjax.System(mass, force)
params: dict = {
    "body": 320.0,
    "wheel": 40.0,
    "k": 18e3,
    "c": 1200.0,
    "k_tyre": 200e3,
}  # kg, N/m, N s/m
params |= {"k_stop": 30e6, "gap": 0.02, "road": road}  # N/m^2, m
rest = jnp.zeros(2)

run = hhtjax.simulate(
    quarter_car, hhtjax.hht(alpha=-0.05), rest, rest, params, dt=1e-3, num_steps=3000
)
run.check()  # an error that names the first bad step, if there is one
print(
    "times", run.t.shape, " positions", run.q.shape, " accelerations", run.acceleration.shape
)

# %% [markdown]
# `hht(alpha=-0.05)` is the method: the HHT-alpha step of structural dynamics. It has second
# order and is stable for stiff springs. `alpha` adds a little damping to the fastest
# vibrations; see notebook 2. `run` holds the whole motion, including the start.
#
# **Look at** the lower figure: where the compression is above the dashed line, the stop is in
# contact.

# %%
compression = run.q[:, 1] - run.q[:, 0]
figure, (above, below) = hhtjax.plot.subplots(2, 1, width=175, height=105, sharex=True)
above.plot(t_road, 1e3 * z_road, ".", color="0.6", ms=3, label="road, as recorded")
above.plot(run.t, 1e3 * run.q[:, 1], label="wheel", lw=1.2)
above.plot(run.t, 1e3 * run.q[:, 0], label="body", lw=1.8)
above.set_ylabel("height (mm)")
above.legend(ncols=3, loc="lower left")
below.plot(run.t, 1e3 * compression, color="C2")
below.axhline(1e3 * params["gap"], color="black", ls="--", lw=1)
below.annotate("bump stop begins", (3.0, 1e3 * params["gap"]), ha="right", va="bottom")
below.set(xlabel="time (s)", ylabel="compression\nof the strut (mm)")
plt.show()

touching = float(jnp.mean(compression > params["gap"]) * 3.0)
print(
    f"largest compression {1e3 * compression.max():.1f} mm; the stop is touched for "
    f"{1e3 * touching:.0f} ms"
)
print(f"largest force of the stop {stop_force(compression, params).max():.0f} N")
print(f"largest acceleration of the body {jnp.abs(run.acceleration[:, 0]).max():.1f} m/s^2")

# %% [markdown]
# ## Is the step small enough?
#
# The simplest check is to halve the step. The method has second order, so the difference
# should become about four times smaller each time. (A new `dt` needs no compilation. A new
# number of steps does, about a second each time. Notebook 5 runs many step sizes in one
# call.)

# %%
ends = {
    n: hhtjax.simulate(
        quarter_car,
        hhtjax.hht(),
        rest,
        rest,
        params,
        dt=3.0 / n,
        num_steps=n,
        save_every=n // 300,
    )
    for n in (1200, 2400, 4800)
}
coarse, middle, fine = (1e3 * run.q[:, 0] for run in ends.values())
print(f"body, steps of 2.5 against 1.25 ms:   {jnp.abs(coarse - middle).max():.4f} mm")
print(f"body, steps of 1.25 against 0.625 ms: {jnp.abs(middle - fine).max():.4f} mm")

# %% [markdown]
# ## A derivative, and a design
#
# The run is a function of its parameters. JAX differentiates it exactly, through all steps.
# How does the largest acceleration of the body depend on the damper?


# %%
def ride(c):
    """For a damper c: the largest acceleration of the body, the least load of the tyre, and
    the time of that acceleration."""
    stepper = hhtjax.hht(alpha=-0.05)
    run = hhtjax.simulate(
        quarter_car, stepper, rest, rest, params | {"c": c}, dt=1e-3, num_steps=3000
    )
    tyre = params["k_tyre"] * (jax.vmap(road)(run.t) - run.q[:, 1])
    weight = 9.81 * (params["body"] + params["wheel"])
    a = jnp.abs(run.acceleration[:, 0])
    return a.max(), jnp.min(weight + tyre), run.t[jnp.argmax(a)]


slope = jax.jacfwd(lambda c: ride(c)[0])(1200.0)
around = (ride(1201.0)[0] - ride(1199.0)[0]) / 2
print(
    f"d(acceleration)/dc: {slope:.6f} by differentiating the run, {around:.6f} by finite "
    "differences, m/s^2 per N s/m"
)
assert abs(slope / around - 1) < 1e-3

# %% [markdown]
# `jax.vmap` runs 60 dampers at once. **Look at** the corners of the comfort curve. There a
# different moment of the ride becomes the worst one (the times are printed below), and the
# derivative jumps. The derivative computed above is the slope of the dotted line.

# %%
c = jnp.linspace(300.0, 4000.0, 60)
acceleration, load, worst = jax.jit(jax.vmap(ride))(c)
best = int(jnp.argmin(acceleration))

figure, left = hhtjax.plot.subplots(width=140, height=75)
left.plot(c, acceleration, label="body acceleration (left)")
left.plot(c[:25], ride(1200.0)[0] + slope * (c[:25] - 1200.0), "k:", lw=1.2)
left.plot(c[best], acceleration[best], "o", color="C0")
left.set(xlabel="damper c (N s/m)", ylabel="largest body\nacceleration (m/s²)")
right = left.twinx()
right.grid(False)
right.spines["right"].set_visible(True)
right.plot(c, load / 1e3, color="C1", ls="--", label="least load of the tyre (right)")
right.set_ylabel("least load of\nthe tyre (kN)")
figure.legend(loc="outside upper center", ncols=2)
plt.show()
print(
    f"smoothest ride: c = {c[best]:.0f} N s/m, {acceleration[best]:.1f} m/s^2 (with c = "
    f"1200: {ride(1200.0)[0]:.1f})"
)
for i in (0, best - 5, best + 5):
    print(f"with c = {c[i]:4.0f} N s/m the body is accelerated most at t = {worst[i]:.2f} s")

# %% [markdown]
# ## When something is wrong
#
# Errors are reported before anything is compiled, with the name of the argument. Two common
# ones:

# %%
for wrong in (
    lambda: hhtjax.simulate(
        quarter_car, hhtjax.hht(), rest, jnp.zeros(3), params, dt=1e-3, num_steps=10
    ),
    lambda: hhtjax.simulate(
        quarter_car, hhtjax.hht(alpha=0.2), rest, rest, params, dt=1e-3, num_steps=10
    ),
):
    try:
        wrong()
    except ValueError as error:
        print("ValueError:", error, "\n")

# %% [markdown]
# ## What to try next
#
# * Replace the stop's square by a linear spring of 1 MN/m. How small must the step become?
# * Add a second wheel and the pitch of the body. That makes four coordinates; nothing else
#   changes.
# * Differentiate with respect to the wheel's mass, too. Which parameter matters most for the
#   ride?
# * Notebook 2: which method and which step. Notebook 3: parameters from measured data.
