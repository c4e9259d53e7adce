# %% [markdown]
# # 12. A beam with 200 degrees of freedom
#
# Beams, chains and frames have many unknowns, each coupled only to a few neighbours. There
# are two ways to use this. A `LinearSystem` factorises its matrix once for the whole run. For
# nonlinear systems, a solver can use the **bands** of the matrix.

# %%
import time

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import hhtjax

jax.config.update("jax_enable_x64", True)
plt.rcParams.update(hhtjax.plot.styles.PARAMETERS)

# %% [markdown]
# ## The beam
#
# A steel strip is 1 m long, 30 mm wide and 3 mm thick, and simply supported at both ends. Its
# equation is $\rho A\,\ddot w + EI\,w'''' = f$. We use finite differences at 200 interior
# points: the second difference twice. The mass matrix is a diagonal.

# %%
N, LENGTH = 200, 1.0
dx = LENGTH / (N + 1)
x = dx * np.arange(1, N + 1)
EI, rhoA = 210e9 * 0.03 * 0.003**3 / 12, 7850 * 0.03 * 0.003  # N m^2, kg/m
D2 = (np.eye(N, k=1) - 2 * np.eye(N) + np.eye(N, k=-1)) / dx**2
K = EI * dx * D2 @ D2
M = np.full(N, rhoA * dx)
C = 1e-5 * K  # damping in proportion to the stiffness
print(
    f"entries of K that are not zero: {np.count_nonzero(K)} of {K.size}, in {2 * 2 + 1} bands"
)

exact = (np.arange(1, 4) * np.pi / LENGTH) ** 2 * np.sqrt(EI / rhoA)
found = np.sqrt(np.sort(np.linalg.eigvalsh(K / M[0])))
print(
    "first frequencies (Hz):",
    np.round(found[:3] / 2 / np.pi, 3),
    " by theory:",
    np.round(exact / 2 / np.pi, 3),
)
print(
    f"highest: {found[-1] / 2 / np.pi:.0f} Hz. An explicit method would need steps below "
    f"{2.8 / found[-1]:.1e} s"
)

# %% [markdown]
# ## Struck with a hammer: linear
#
# The blow is a half sine of 1 ms at a quarter of the length. The step of 0.2 ms resolves the
# first modes. The highest modes are not resolved; the method damps them (`alpha=-0.1`).

# %%
DT, STEPS = 2e-4, 2500
strike = jnp.zeros(N).at[N // 4].set(200.0)  # N


def blow(t, params):
    return params["strike"] * jnp.where(t < 1e-3, jnp.sin(jnp.pi * t / 1e-3), 0.0)


linear = hhtjax.LinearSystem(M, C, K, blow)
stepper = hhtjax.hht(alpha=-0.1)
rest = jnp.zeros(N)


def timed(system, stepper, params):
    """A run, and microseconds per step of a second call."""
    for _ in range(2):
        begin = time.perf_counter()
        run = hhtjax.simulate(
            system, stepper, rest, rest, params, dt=DT, num_steps=STEPS, save_every=5
        )
        jax.block_until_ready(run)
        seconds = time.perf_counter() - begin
    run.check()
    return run, 1e6 * seconds / STEPS


free, cost = timed(linear, stepper, {"strike": strike})
print(f"{cost:.0f} microseconds a step")

figure, (left, right) = hhtjax.plot.subplots(1, 2, width=175, height=65, width_ratios=(3, 2))
image = left.pcolormesh(
    free.t[:100] * 1e3,
    x,
    1e3 * free.q[:100].T,
    cmap="RdBu",
    vmin=-8,
    vmax=8,
    shading="nearest",
)
left.set(xlabel="time (ms)", ylabel="place along the beam (m)")
left.grid(False)
figure.colorbar(image, label="deflection (mm)")
spectrum = np.abs(np.fft.rfft(free.q[:, N // 6]))
right.semilogy(np.fft.rfftfreq(len(free.t), 5 * DT), spectrum)
for f in exact / 2 / np.pi:
    right.axvline(f, color="black", ls=":", lw=0.8)
right.set(xlabel="frequency (Hz)", ylabel="amplitude at a sixth\nof the length", xlim=(0, 150))
plt.show()

# %% [markdown]
# **Look at** the left for the bulge that travels along the beam, and at the right for the
# peaks at the theoretical frequencies (dotted).
#
# ## With a stop: nonlinear
#
# Now the middle hits a stop 3 mm away, a one-sided spring. This is one nonlinear force among
# 200 unknowns, and the matrix changes in time. `hht(solve=hhtjax.banded(2))` computes the
# five bands of a step's matrix from five derivatives instead of 200, and eliminates within
# the bands. Was the number of bands right? The solver checks what it leaves unsolved, and
# `check()` would report it.


# %%
def stopped(q, v, t, params):
    def bend(w):
        w = jnp.pad(w, 1)  # zero at the supports
        return (w[2:] - 2 * w[1:-1] + w[:-2]) / dx**2

    elastic = -EI * dx * bend(bend(q + 1e-5 * v))
    beyond = jnp.maximum(q[N // 2] - params["gap"], 0.0)
    return (elastic + blow(t, params)).at[N // 2].add(-params["k_stop"] * beyond)


params = {"strike": strike, "gap": 3e-3, "k_stop": 1e5}
beam = hhtjax.System(jnp.asarray(M), stopped)
fast = hhtjax.hht(alpha=-0.1, linearize="predictor", solve=hhtjax.banded(2))
hit, cost = timed(beam, fast, params)
print(f"{cost:.0f} microseconds a step")
far, _ = timed(beam, fast, params | {"gap": 1.0})
print(
    f"with the stop out of reach: {1e3 * jnp.abs(far.q - free.q).max():.1e} mm from the "
    "linear run"
)
wrong = hhtjax.hht(alpha=-0.1, linearize="predictor", solve=hhtjax.banded(1))
try:
    timed(beam, wrong, params)
except hhtjax.SimulationError as error:
    print(error)

# %%
figure, axes = hhtjax.plot.subplots(width=175, height=60)
axes.plot(1e3 * free.t, 1e3 * free.q[:, N // 2], label="free")
axes.plot(1e3 * hit.t, 1e3 * hit.q[:, N // 2], label="with the stop")
axes.axhline(3.0, color="black", ls="--", lw=0.8)
axes.set(xlabel="time (ms)", ylabel="deflection of\nthe middle (mm)", xlim=(0, 300))
axes.legend()
plt.show()
depth = 1e3 * float(jnp.max(hit.q[:, N // 2])) - 3
print(
    f"the stop is pressed in by {depth:.2f} mm at most, a force of {1e5 * depth / 1e3:.0f} N"
)

# %% [markdown]
# ## What to try next
#
# * Halve the step. Does the force of the stop change? It is a contact; see notebook 7.
# * Take N = 2000 with `banded(2)`. The time of a step should grow tenfold, not a hundredfold.
# * Make EI a parameter, and differentiate the deflection with respect to it.
