# %% [markdown]
# # 2. Choosing a method and a step size
#
# Every step makes a small error. This notebook shows what the error does to a vibration, how
# it falls with the step, and which methods work on stiff systems. It then asks the library
# for a step size and for a method. A short table of advice is at the end.

# %%
import time

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import hhtjax
from hhtjax import analysis

jax.config.update("jax_enable_x64", True)
plt.rcParams.update(hhtjax.plot.styles.PARAMETERS)

# %% [markdown]
# ## What does a step do to one vibration?
#
# Take one undamped oscillator of circular frequency $\omega$ and step it with $h$. Only
# $\omega h$ matters. At $\omega h = 2\pi/20 \approx 0.31$ there are 20 steps per period. Two
# errors are visible. The period is too long or too short. The amplitude decays or grows; the
# decay is called **numerical damping** and is given as a damping ratio (Lehr's damping).
#
# **Look at** the left part of each figure for the vibrations that matter to you. The right
# part is for vibrations that your model has and that you do not want to resolve. There
# damping is welcome.

# %%
steppers = {
    "hht(0), trapezoidal": hhtjax.hht(alpha=0.0),
    "hht(-0.05), the default": hhtjax.hht(alpha=-0.05),
    "hht(-0.3)": hhtjax.hht(alpha=-0.3),
    "implicit Euler": hhtjax.implicit_euler(),
    "RK4": hhtjax.rk4(),
}
wh = np.geomspace(0.1, 20.0, 80)
figure, (left, right) = hhtjax.plot.subplots(1, 2, width=175, height=75)
hhtjax.plot.period_elongation(steppers, frequency=wh, ax=left)
hhtjax.plot.damping_ratio(steppers, frequency=wh, ax=right)
left.set_ylim(-0.2, 1.0)
right.set_ylim(-0.1, 0.6)
for axes in (left, right):
    axes.get_legend().remove()
figure.legend(*left.get_legend_handles_labels(), loc="outside upper center", ncols=3)
plt.show()

for name, stepper in steppers.items():
    period, damping = (
        float(f(stepper, 2 * np.pi / 20))
        for f in (analysis.period_elongation, analysis.damping_ratio)
    )
    print(
        f"20 steps a period, {name:<24} period {100 * period:+.3f} %, damping ratio "
        f"{100 * damping:+.4f} %"
    )

# %% [markdown]
# A rule of thumb from these numbers: with `hht`, 20 steps per period lengthen the period by
# about one per cent. The method has **second order**, so with 40 steps it is a quarter of
# that.
#
# ## How does the error fall with the step size?
#
# Order $p$ means that the error of a smooth motion falls like $h^p$. We measure it on a
# driven Duffing oscillator, a mass on a hardening spring:
# $\ddot q + 0.2\,\dot q + q + q^3 = 0.8 \cos 1.3\,t$. The reference is a run with very small
# steps. `analysis.observed_order` does the runs.
#
# **Look at** the slopes, and at the horizontal distances. A distance shows how many more
# steps one method needs than another for the same error.

# %%
scene = hhtjax.scenes.duffing.driven()
start = scene.q0, scene.v0, scene.params
candidates = {
    "hht(-0.05)": hhtjax.hht(alpha=-0.05),
    "newmark": hhtjax.newmark(),
    "rowda": hhtjax.rowda(),
    "RK4": hhtjax.rk4(),
    "implicit Euler": hhtjax.implicit_euler(),
}


def order_of(stepper, num_steps, **options):
    return analysis.observed_order(
        scene.system, stepper, *start, duration=10.0, num_steps=num_steps, **options
    )


fine = hhtjax.simulate(
    scene.system, hhtjax.rk4(), *start, dt=10.0 / 20000, num_steps=20000, save_every=20000
)
found = {
    name: order_of(s, (200, 400, 800, 1600, 3200), reference=fine.q[-1])
    for name, s in candidates.items()
}
axes = hhtjax.plot.error_against_h(found, unit="m")
axes.figure.set_size_inches(5.6, 3.6)
plt.show()
for name, result in found.items():
    print(f"{name:<15} slopes {np.round(result.slope, 2)}")

# %% [markdown]
# ## Which methods work on stiff systems?
#
# A weight of 1 kg swings on a rod. With its true stiffness of 1 MN/m the rod vibrates along
# its axis with $\sqrt{k/m}$ = 1000 rad/s. The swinging has about 4 rad/s. The fast vibration
# is not of interest. An **explicit** method such as RK4 must resolve it anyway, or it blows
# up. An **implicit** method need not.

# %%
pendulum = hhtjax.scenes.pendulum.elastic(k=1e6)
angle = {}
for name, stepper, dt in [
    ("RK4, 2 ms", hhtjax.rk4(), 2e-3),
    ("RK4, 4 ms", hhtjax.rk4(), 4e-3),
    ("hht, 4 ms", hhtjax.hht(), 4e-3),
    ("hht, 20 ms", hhtjax.hht(), 2e-2),
]:
    n = round(1.0 / dt)
    run = hhtjax.simulate(
        pendulum.system, stepper, pendulum.q0, pendulum.v0, pendulum.params, dt=dt, num_steps=n
    )
    try:
        run.check(
            reach=2.0
        )  # a run that gets farther than 2 m from its start counts as failed too
        angle[name] = run.t, jnp.degrees(jnp.arctan2(run.q[:, 0], -run.q[:, 1]))
        print(f"{name}: fine, with {n} steps")
    except hhtjax.SimulationError as error:
        print(f"{name}: {error}")

figure, axes = hhtjax.plot.subplots(width=175, height=60)
for (name, (t, value)), line in zip(angle.items(), ("-", "--", "o"), strict=True):
    axes.plot(t, value, line, label=name, ms=4)
axes.set(xlabel="time (s)", ylabel="angle of the rod (degrees)")
axes.legend()
plt.show()

# %% [markdown]
# ## Ask for a step size
#
# `analysis.suggest_step_size` has two ways to answer. Without a duration it looks at the
# vibrations about the initial state and at the error of the stepper for each. With a duration
# it simulates the motion with halved steps until the error stays within the tolerance. This
# is slower, but it covers the whole motion.

# %%
by_modes = analysis.suggest_step_size(scene.system, hhtjax.hht(), *start, tolerance=1e-2)
by_runs = analysis.suggest_step_size(
    scene.system, hhtjax.hht(), *start, tolerance=1e-2, duration=10.0
)
print("by the modes:", by_modes, "\n")
print("by runs:     ", by_runs)

# %% [markdown]
# ## What does a step cost?
#
# The methods differ in work per step. We time 20000 steps of the same oscillator, cold (the
# first call, which compiles) and warm (later calls). Absolute numbers depend on the machine,
# ratios less so. `iterations=None` repeats Newton's iteration until the equations hold to
# rounding. The default takes one solve per step and has the same order.


# %%
def nanoseconds(stepper, **options):
    def run():
        begin = time.perf_counter()
        jax.block_until_ready(
            hhtjax.simulate(
                scene.system,
                stepper,
                *start,
                dt=1e-3,
                num_steps=20000,
                save_every=2000,
                **options,
            )
        )
        return 1e9 * (time.perf_counter() - begin) / 20000

    return run(), min(run() for _ in range(5))


for name, stepper in {
    **candidates,
    "hht, Newton": hhtjax.hht(alpha=-0.05, iterations=None),
}.items():
    first, later = nanoseconds(stepper)
    print(
        f"{name:<15} {later:6.0f} ns a step;  first call, with compiling: "
        f"{first * 20000 / 1e9:.1f} s"
    )

# %% [markdown]
# ## More order from the same method
#
# For a smooth motion use `extrapolate=2`. It runs with $h$ and $h/2$ and removes the leading
# error (Richardson extrapolation). This gives one more order for three times the work. With
# `alpha=0`, as here, it gives two more orders.

# %%
sharp = hhtjax.hht(
    alpha=0.0, linearize="predictor"
)  # smooth in everything, which extrapolation needs
for extrapolate in (1, 2):
    error = []
    for n in (200, 400):
        run = hhtjax.simulate(
            scene.system,
            sharp,
            *start,
            dt=10 / n,
            num_steps=n,
            save_every=n,
            extrapolate=extrapolate,
        )
        error.append(float(jnp.abs(run.q[-1] - fine.q[-1])[0]))
    print(
        f"extrapolate={extrapolate}: error {error[0]:.1e} with 200 steps, "
        f"{error[1]:.1e} with 400: order {np.log2(error[0] / error[1]):.1f}"
    )

# %% [markdown]
# ## Ask for a method
#
# `analysis.choose_stepper` makes test runs. It finds how long a step the wanted error allows,
# and how fast the system can react to a push along the way. The product of the two says
# whether the system is stiff. It returns a method and tolerances that keep the error.
#
# **Look at** what a smaller tolerance changes for the oscillator, and at what makes the
# elastic pendulum stiff.

# %%
rod = pendulum.q0, pendulum.v0, pendulum.params
for tolerance in (1e-2, 1e-8):
    print(
        f"oscillator, {tolerance:g}:",
        analysis.choose_stepper(scene.system, *start, duration=10, tolerance=tolerance),
    )
print(
    "pendulum, 0.01:",
    analysis.choose_stepper(pendulum.system, *rod, duration=1, tolerance=1e-2),
)

# %% [markdown]
# ## Advice
#
# | your system | method | reason |
# |---|---|---|
# | stiff springs, contacts, constraints, unknown | `hht()` | one solve, damps fast modes |
# | as above, fit through the run | `hht(linearize="predictor")` | smooth in its parameters |
# | must lose no energy, everything resolved | `hht(alpha=0.0)` | no numerical damping |
# | stiff, more than three digits | `rodas5p()` with `dt=adaptive(rtol, atol)` | order 5 |
# | constraints or rotations, over two digits | `extrapolated()`, with `adaptive` | order 5 |
# | smooth, not stiff | `tsit5()`, with `adaptive` | no Jacobian |
# | as above, four digits or more | `taylor()` or `dop853()`, with `adaptive` | high order |
#
# Then ask `suggest_step_size`, or halve the step and compare, as in notebook 1. [Work and
# precision](../work_precision/README.md) compares the times of all these methods and of other
# packages on eight scenes.
#
# ## What to try next
#
# * Add `hht(-0.3)` to `candidates`. Where does it cross `hht(-0.05)` in the error figure?
# * Make the rod of the pendulum 100 times softer. Which step does RK4 need now?
# * Notebook 6 shows failures that this advice does not prevent.
