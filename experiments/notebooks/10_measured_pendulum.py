# %% [markdown]
# # 10. A measured double pendulum
#
# A camera followed the two arms of a double pendulum (Schmidt and Lipson 2009). The record
# has angles at about 100 Hz, with gaps and without an input. The motion is chaotic when it is
# large. We estimate inertia, weights and friction from **short windows** of the record, each
# with its own initial state.
#
# The file real_double_pend_h_1.txt belongs to the supplementary data of the paper. Put it
# into a folder `double_pendulum/`, and set `HHTJAX_DATA` to the folder that contains it.
# Without it, the notebook generates a record of the same kind, and says so.

# %%
import os
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import hhtjax
from hhtjax.identification import wrap_angle

jax.config.update("jax_enable_x64", True)
plt.rcParams.update(hhtjax.plot.styles.PARAMETERS)

file = (
    Path(os.environ.get("HHTJAX_DATA", ".")) / "double_pendulum" / "real_double_pend_h_1.txt"
)
measured = file.is_file()
print(
    "MEASURED (Schmidt and Lipson 2009)"
    if measured
    else f"GENERATED, known parameters; {file} is not there"
)

# %% [markdown]
# ## The model
#
# Both angles are measured from the downward vertical. Divided by the inertia of the first
# arm, the mass matrix is
#
# $$M = \begin{pmatrix} 1 & B\cos(q_1 - q_2)\\ \cdot & A\end{pmatrix}$$
#
# The forces are weights $g_1 \sin q_1$ and $g_2 \sin q_2$, the velocity terms that belong to
# $M$, and viscous friction in both joints. Angles alone determine only these ratios. The
# parameters are a dictionary; two of them are arrays:


# %%
def mass(q, p):
    coupling = p["B"] * jnp.cos(q[0] - q[1])
    return jnp.stack(
        [jnp.stack([jnp.ones_like(coupling), coupling]), jnp.stack([coupling, p["A"]])]
    )


def force(q, v, t, p):
    coupling = p["B"] * jnp.sin(q[0] - q[1])
    first = -p["g"][0] * jnp.sin(q[0]) - coupling * v[1] ** 2
    second = -p["g"][1] * jnp.sin(q[1]) + coupling * v[0] ** 2
    f1, f2 = p["friction"][0] * v[0], p["friction"][1] * (v[1] - v[0])
    return jnp.stack([first - f1 + f2, second - f2])


pendulum = hhtjax.System(mass, force)
DT = 2e-3  # s


def simulate(params, q0, v0, num_steps):
    stepper = hhtjax.hht(alpha=0.0, linearize="predictor")
    return hhtjax.simulate(pendulum, stepper, q0, v0, params, dt=DT, num_steps=num_steps)


TRUE = {
    "A": 0.28,
    "B": 0.26,
    "g": jnp.array([65.0, 17.0]),
    "friction": jnp.array([0.02, 0.01]),
}
if measured:
    table = np.genfromtxt(file, comments="%")
    table = table[table[:, 0] == 0]  # the first of two trials
    t, angle, rates = table[:, 1] - table[0, 1], table[:, 2:4], table[:, 4:6]
else:
    rng = np.random.default_rng(0)
    t = np.cumsum(np.where(rng.random(800) < 0.02, 0.1, 0.01))
    t -= t[0]
    run = simulate(
        TRUE, jnp.array([-1.1, -1.3]), jnp.array([0.0, -6.0]), int(np.ceil(t[-1] / DT))
    )
    dense = hhtjax.interpolate(run, t)
    angle = np.asarray(dense.q) + 1.2e-3 * rng.normal(size=(800, 2)) - [0.01, -0.02]
    rates = np.asarray(dense.v) + 0.05 * rng.normal(size=(800, 2))
print(
    f"{len(t)} samples in {t[-1]:.1f} s, {1e3 * np.diff(t).min():.1f} to "
    f"{1e3 * np.diff(t).max():.0f} ms apart"
)

# %% [markdown]
# ## Windows
#
# Over a few seconds the derivative of a chaotic motion with respect to its parameters becomes
# huge (notebook 6), and a fit over the whole record fails. `windows` cuts the record into
# pieces of equal duration. It uses the time stamps, so gaps do not matter. The initial state
# of each piece is fitted as well (`starts=`) and then eliminated. So the Jacobian stays small
# for any number of windows. `interpolate` evaluates the run at the times of the samples.
#
# The zero of the camera may be wrong by a small angle. `offset` adds two more unknowns for
# this.


# %%
def fit_windows(duration, params0, at_start, **options):
    records = hhtjax.windows(t, angle, duration)
    num_steps = int(np.ceil(records.t.max() / DT))

    def residuals(params, start, record):
        run = simulate(params, start["q"], start["v"], num_steps)
        return wrap_angle(hhtjax.interpolate(run, record.t).q - params["offset"] - record.y)

    first = np.searchsorted(t, records.begin)
    starts = {"q": jnp.asarray(angle[first]), "v": jnp.asarray(at_start[first])}
    positive = {name: hhtjax.positive if name in ("A", "B", "g") else None for name in params0}
    result = hhtjax.fit(
        residuals, params0, records=jax.tree.map(jnp.asarray, records), starts=starts,
        transforms=positive, weights=jnp.asarray(records.present, float), **options,
    )  # fmt: skip
    return result, records


guess = {
    "A": 0.5,
    "B": 0.3,
    "g": jnp.array([40.0, 30.0]),
    "friction": jnp.array([0.1, 0.1]),
    "offset": jnp.zeros(2),
}
short, records = fit_windows(0.25, guess, rates, covariance=False)
result, records = fit_windows(0.5, short.params, rates)
print(f"{len(records.begin)} windows of 0.5 s\n")
print(result.summary())
rmse = float(np.sqrt(np.mean(np.asarray(result.residual)[np.asarray(records.present)] ** 2)))
print(f"\nRMS error {1e3 * rmse:.2f} mrad")
if not measured:
    for name in ("A", "B", "g", "friction"):
        off = np.asarray((result.params[name] - TRUE[name]) / result.standard_errors[name])
        print(name, "off by", np.round(off, 1), "standard errors")

# %% [markdown]
# ## One window, and all residuals
#
# **Look at** the fit on the left, and at the residuals on the right. Residuals that rise and
# fall together are the error of the model: the friction of the joints is hardly viscous, and
# the arms are not rigid. Noise would be scatter.

# %%
k = int(np.argmax(np.ptp(records.y[:, :, 0], axis=1)))
here = records.present[k, :, 0]
run = simulate(result.params, result.starts["q"][k], result.starts["v"][k], int(0.5 / DT))
figure, (left, right) = hhtjax.plot.subplots(1, 2, width=175, height=70)
for i in range(2):
    left.plot(
        records.t[k][here],
        records.y[k][here, i],
        "os"[i],
        color=f"C{i}",
        ms=4,
        mfc="none",
        label=f"angle {i + 1}",
    )
    left.plot(run.t, run.q[:, i] - result.params["offset"][i], color=f"C{i}", lw=1.2)
    right.plot((records.begin[:, None] + records.t)[records.present[:, :, i]],
               1e3 * np.asarray(result.residual)[:, :, i][records.present[:, :, i]],
               ".", color=f"C{i}", ms=2, label=f"angle {i + 1}")  # fmt: skip
left.set(xlabel=f"time since {records.begin[k]:.2f} s (s)", ylabel="angle (rad)")
left.legend()
right.set(xlabel="time (s)", ylabel="simulated less measured (mrad)")
right.legend(markerscale=4)
plt.show()

# %% [markdown]
# ## How long can it predict?
#
# The same parameters predict longer and longer windows, from the fitted initial state. The
# error grows because neighbouring motions separate.

# %%
every = np.arange(0, len(records.begin), 2)
horizon = 4.0
inside = every[records.begin[every] + horizon < t[-1]]
ahead = jax.jit(
    jax.vmap(
        lambda q, v: simulate(result.params, q, v, int(horizon / DT)).q[:: int(0.02 / DT)]
    )
)(result.starts["q"][inside], result.starts["v"][inside])
grid = np.arange(ahead.shape[1]) * 0.02
gone = []
for path, begin in zip(np.asarray(ahead), records.begin[inside], strict=True):
    seen = np.stack(
        [np.interp(begin + grid, t, np.unwrap(angle[:, i])) for i in range(2)], axis=1
    )
    gone.append(
        np.abs(np.asarray(wrap_angle(path - np.asarray(result.params["offset"]) - seen))).max(
            axis=1
        )
    )
figure, axes = hhtjax.plot.subplots(width=130, height=60)
axes.semilogy(grid[1:], 1e3 * np.median(gone, axis=0)[1:], label="median of the windows")
axes.semilogy(grid[1:], 1e3 * np.max(gone, axis=0)[1:], "--", label="worst")
axes.axvline(0.5, color="black", ls=":", lw=1)
axes.set(
    xlabel="time since the beginning of the window (s)",
    ylabel="largest error of the angles (mrad)",
)
axes.legend()
plt.show()
print(
    f"median error after 0.5 s: {1e3 * np.median(gone, axis=0)[25]:.1f} mrad, "
    f"after {horizon:.0f} s: {1e3 * np.median(gone, axis=0)[-1]:.0f} mrad"
)

# %% [markdown]
# ## What to try next
#
# * Add dry friction, `d * jnp.tanh(v / 0.1)`, in both joints. Does the error fall?
# * Fit windows of 2 s at once from `guess`, and step by step with `hhtjax.fit_progressively`.
#   Which one arrives?
# * For the full study, with held-out parts and an unseen trial, run
#   `python -m experiments double_pendulum_measured`.
