# %% [markdown]
# # 6. Where methods fail
#
# No method with a fixed step is safe. This notebook makes methods fail on purpose, so that
# you recognise it. Runs blow up, or are wrong and look healthy. Energy disappears, forces
# ring, and one motion cannot be followed by any method. For each failure we show who notices
# it, and what helps.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import ListedColormap

import hhtjax
from hhtjax import analysis

jax.config.update("jax_enable_x64", True)
plt.rcParams.update(hhtjax.plot.styles.PARAMETERS)

# %% [markdown]
# ## Blown up, wrong, or fine
#
# There are two scenes, six methods, and steps that are halved ten times. A run is **fine** if
# the RMS error of q is below 5 % of the motion. It is **blown up** if it gets ten times as
# far from its start as the motion itself. Otherwise it is **wrong**. The scenes are
#
# * a mass on a spring that hardens strongly, $\ddot q = -100\,q - 10^4 q^3$, for 2 s,
# * a damper that grows with the cube of the speed, $\ddot q = -q - 100\,\dot q^3$, for 20 s.

# %%
hardening = hhtjax.System(jnp.ones(1), lambda q, v, t, p: -100.0 * q - 1e4 * q**3)
cubic = hhtjax.System(jnp.ones(1), lambda q, v, t, p: -q - 100.0 * v**3)
scenes = {
    "hardening spring": (hardening, jnp.ones(1), jnp.zeros(1), None, 2.0),
    "cubic damper": (cubic, jnp.ones(1), jnp.ones(1), None, 20.0),
}
methods = {
    "RK4": hhtjax.rk4(),
    "hht, predictor": hhtjax.hht(linearize="predictor"),
    "hht, the default": hhtjax.hht(),
    "hht, held": hhtjax.hht(linearize="held"),
    "hht, Newton": hhtjax.hht(iterations=None),
    "rosenbrock": hhtjax.rosenbrock(),
}
counts = 8 * 2 ** np.arange(10)


def grade(name, method):
    """0 fine, 1 wrong, 2 blown up, for each number of steps; all of them in one sweep."""
    system, q0, v0, params, duration = scenes[name]

    def sweep(stepper, counts):
        dts = duration / jnp.asarray(counts, float)
        return np.asarray(
            hhtjax.sweep(
                system, stepper, q0, v0, params, dts=dts, duration=duration, num_samples=8
            ).q[:, 1:]
        )

    if name not in references:
        references[name] = sweep(hhtjax.rowda(), [200_000])[0]
    exact, q = references[name], sweep(method, counts)
    reach = np.abs(exact - np.asarray(q0)).max()
    with np.errstate(all="ignore"):
        error = np.sqrt(np.mean((q - exact) ** 2, axis=(1, 2))) / np.sqrt(
            np.mean((exact - exact.mean(axis=0)) ** 2)
        )
        farthest = np.abs(q - np.asarray(q0)).max(axis=(1, 2)) / reach
    return np.where(~(farthest < 10), 2, np.where(error < 0.05, 0, 1))


references: dict = {}
grades = {
    scene: np.array([grade(scene, method) for method in methods.values()]) for scene in scenes
}

# %%
figure, axes = hhtjax.plot.subplots(1, 2, width=175, height=65, sharey=True)
colours = ListedColormap(["#009E73", "#E69F00", "#000000"])
for axis, (name, cells) in zip(axes, grades.items(), strict=True):
    axis.imshow(cells, cmap=colours, vmin=0, vmax=2, aspect="auto")
    for (i, j), value in np.ndenumerate(cells):
        axis.text(j, i, ".x!"[value], ha="center", va="center", color="white", fontsize=7)
    axis.set_title(name)
    axis.set_xticks(range(0, 10, 3), counts[::3])
    axis.set_xlabel("number of steps")
    axis.grid(False)
axes[0].set_yticks(range(len(methods)), methods)
plt.show()
print("a dot: fine (green), x: wrong (orange), ! blown up (black)")
for row, name in enumerate(methods):
    cells = np.concatenate([grades[scene][row] for scene in scenes])
    fine, wrong, gone = (np.sum(cells == k) for k in range(3))
    print(f"{name:<17} fine {fine:2d}, wrong {wrong:2d}, blown up {gone:2d} of {len(cells)}")

# %% [markdown]
# **Look at** the rows. The non-iterative step solves one linear system per step. Where it
# *linearises* decides which steps it can take. `linearize="predictor"` is the smoothest and
# blows up first. "held" stays bounded more often. The default chooses one of the two in each
# step, by the residual. Newton's iteration costs several times as much and turns runs that
# blow up into runs that are wrong: compare the counts. Only smaller steps make runs fine.
#
# ## Who notices?
#
# `check()` reports what is not finite, and steps that Newton's iteration could not solve. If
# a run is finite but absurd, you must say how far q can get. If a run is wrong but of the
# right size, nothing shows it. Then only a second run helps. `suggest_step_size` with a
# duration does this.

# %%
system, q0, v0, params, duration = scenes["hardening spring"]
for title, method, n, reach in (
    ("predictor, 32 steps, check()", methods["hht, predictor"], 32, None),
    ("predictor, 32 steps, check(reach=5)", methods["hht, predictor"], 32, 5.0),
    ("default, 64 steps, check(reach=5)", methods["hht, the default"], 64, 5.0),
):
    run = hhtjax.simulate(system, method, q0, v0, params, dt=duration / n, num_steps=n)
    try:
        run.check(reach)
        graded = ("fine", "wrong", "blown up")[
            grades["hardening spring"][list(methods.values()).index(method)][
                n.bit_length() - 4
            ]
        ]
        print(f"{title}: silent; |q| up to {jnp.abs(run.q).max():.3g}, graded {graded}")
    except hhtjax.SimulationError as error:
        print(f"{title}: {error}")
advice = analysis.suggest_step_size(
    system, methods["hht, the default"], q0, v0, params, duration=duration, tolerance=0.05
)
print(f"advice for 5 %: dt = {advice.dt:.2g} s, that is {duration / advice.dt:.0f} steps")

# %% [markdown]
# ## Energy that disappears
#
# Numerical damping is welcome for vibrations that are not of interest. It is a loss for those
# that matter. A dumbbell of two masses on a stiff spring turns and vibrates freely, with 30
# steps per vibration. It should lose no energy.

# %%
dumbbell = hhtjax.System(
    mass=jnp.ones(4),
    force=lambda q, v, t, p: (lambda d, r: jnp.concatenate([d, -d]) * p["k"] * (r - 1.0) / r)(
        q[2:] - q[:2], jnp.sqrt(jnp.sum((q[2:] - q[:2]) ** 2))
    ),
)
start = jnp.array([-0.55, 0.0, 0.55, 0.0]), jnp.array([0.0, -1.0, 0.0, 1.0]), {"k": 500.0}


def energy_of(run):
    r = jnp.sqrt(jnp.sum((run.q[:, 2:] - run.q[:, :2]) ** 2, axis=1))
    return 0.5 * jnp.sum(run.v**2, axis=1) + 0.5 * 500.0 * (r - 1.0) ** 2


figure, axes = hhtjax.plot.subplots(width=130, height=65)
for i, (name, method) in enumerate(
    {
        "hht(0)": hhtjax.hht(0.0),
        "hht(-0.05)": hhtjax.hht(-0.05),
        "hht(-0.3)": hhtjax.hht(-0.3),
        "RK4": hhtjax.rk4(),
    }.items()
):
    run = hhtjax.simulate(dumbbell, method, *start, dt=6.6e-3, num_steps=30000, save_every=100)
    energy = energy_of(run)
    axes.plot(run.t, energy, hhtjax.plot.LINES[i], label=name)
    print(
        f"{name:<11} loses {100 * float(1 - energy[-1] / energy[0]):.2f} % of "
        f"{energy[0]:.2f} J in 30000 steps"
    )
axes.set(xlabel="time (s)", ylabel="energy (J)")
axes.legend()
plt.show()

# %% [markdown]
# ## Ringing
#
# `alpha=0` damps nothing. A poor start or a jump can excite a stiff vibration that the step
# cannot resolve. Then the acceleration alternates from step to step for ever. Here the
# elastic pendulum of notebook 2 starts with its rod stretched by 0.1 mm too much.

# %%
pendulum = hhtjax.scenes.pendulum.elastic(k=1e6)
off = pendulum.q0 * (1 + 2e-4)
figure, axes = hhtjax.plot.subplots(width=130, height=60)
for alpha, line in ((0.0, "C1-"), (-0.05, "C0-"), (-0.3, "C2--")):
    run = hhtjax.simulate(
        pendulum.system,
        hhtjax.hht(alpha),
        off,
        pendulum.v0,
        pendulum.params,
        dt=1e-2,
        num_steps=100,
    )
    stretch = 1e6 * (jnp.sqrt(jnp.sum(run.q**2, axis=1)) - 0.5)
    axes.plot(run.t, stretch, line, lw=1, label=f"alpha = {alpha}")
    rough = float(jnp.std(jnp.diff(stretch[50:])))
    print(
        f"alpha = {alpha:<5} force in the rod = {float(stretch[-1]):7.1f} N at the end; "
        f"jumps by {rough:6.1f} N a step"
    )
axes.set(xlabel="time (s)", ylabel="force in the rod (N)")
figure.legend(loc="outside upper center", ncols=3)
plt.show()

# %% [markdown]
# ## What no method can follow
#
# The free double pendulum is **chaotic**: neighbouring motions separate exponentially. So the
# error of any method grows exponentially, and so does the derivative of the end with respect
# to the start. Both are right, and both are useless after a while. Fit such motions over
# short windows (`hhtjax.windows`).


# %%
double = hhtjax.scenes.double_pendulum.free()


@jax.jit
def path(q1):
    """The first angle over 20 s, let go from q1 above the horizontal."""
    run = hhtjax.simulate(
        double.system, hhtjax.rowda(), jnp.stack([q1, 1.0]), double.v0, double.params,
        dt=2e-3, num_steps=10000, save_every=50,
    )  # fmt: skip
    return run.q[:, 0]


t = np.arange(201) * 0.1
_, sensitivity = jax.jvp(path, (1.0,), (1.0,))
figure, axes = hhtjax.plot.subplots(width=130, height=60)
axes.semilogy(t[1:], jnp.abs(sensitivity[1:]), lw=1)
axes.set(xlabel="time (s)", ylabel="|d angle(t) / d angle(0)|")
plt.show()
growth = float(np.polyfit(t[1:], np.log(np.abs(sensitivity[1:])), 1)[0])
print(f"grows on average by a factor {np.exp(growth):.1f} each second")

# %% [markdown]
# ## Singular positions
#
# Constraints can become dependent during a motion. Squares of hinged bars that lie flat can
# continue folded or unfolded. The constraints do not say which, and the forces in the bars
# are not unique. An error names the rows concerned before the run, and `check()` does so if
# it happens during the run. `hht(redundant="least_squares")` takes the smallest forces.

# %%
bars = hhtjax.scenes.four_bars.four_bars()
flat = jnp.array([[1.0, 0.0], [2.0, 0.0], [3.0, 0.0]])
try:
    hhtjax.simulate(
        bars.system, hhtjax.hht(), flat, 0 * flat, bars.params, dt=1e-2, num_steps=10
    )
except ValueError as error:
    print("ValueError:", error)

# %% [markdown]
# ## What to try next
#
# * Repeat the gallery with `alpha=0.0` and with `alpha=-0.3`.
# * `python -m experiments stability` does all of this for more scenes and methods; see [its
#   page](../stability/README.md).
