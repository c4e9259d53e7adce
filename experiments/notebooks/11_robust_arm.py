# %% [markdown]
# # 11. A robot arm from noisy data with outliers
#
# An encoder that slips or a cable that loses contact gives a few wrong samples. They spoil a
# least-squares fit, because the square gives the worst samples the most weight. A **robust
# loss** grows more slowly for large residuals. Here we identify the joints of an arm with
# three links from a record in which every twentieth sample is wrong.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import hhtjax

jax.config.update("jax_enable_x64", True)
plt.rcParams.update(hhtjax.plot.styles.PARAMETERS)

# %% [markdown]
# ## The arm and its record
#
# `hhtjax.scenes.arm` is an open chain of rigid links. Masses and lengths are known, for
# example from drawings. Each joint has a spring (the gear and its position controller) and a
# damper, so there are six unknowns. The arm is released from a bent pose and recorded for 1.5
# s: 300 samples of three angles, with noise of 2 mrad. Then 5 % of the samples are replaced
# by values that are wrong by up to 0.3 rad.

# %%
arm = hhtjax.scenes.arm.swing(joints=3)
true = {name: arm.params[name] for name in ("stiffness", "damping")}
NOISE, SAMPLES = 2e-3, 300


def angles(unknown):
    stepper = hhtjax.hht(alpha=-0.05, linearize="predictor")
    run = hhtjax.simulate(
        arm.system,
        stepper,
        arm.q0,
        arm.v0,
        arm.params | unknown,
        dt=2.5e-3,
        num_steps=2 * SAMPLES,
        save_every=2,
    )
    return run.q[1:]


rng = np.random.default_rng(3)
clean = np.asarray(jax.jit(angles)(true))
record = clean + NOISE * rng.normal(size=clean.shape)
spoiled = rng.random(clean.shape) < 0.05
record = np.where(spoiled, record + rng.uniform(-0.05, 0.3, clean.shape), record)
print(f"{spoiled.sum()} of {record.size} samples are wrong")

# %% [markdown]
# ## Two fits
#
# `weights` is one over the standard deviation of the noise. A robust loss changes its shape
# where residual times weight is about 1, so it must know the usual size of the residuals.
# "cauchy" grows only like a logarithm and almost ignores the worst samples. "huber" and
# "soft_l1" are milder and grow like the size of the residual. `positive` keeps stiffness and
# damping above zero.


# %%
def residuals(unknown):
    return angles(unknown) - record


guess = jax.tree.map(lambda x: jnp.full(3, jnp.mean(x)), true)
positive = {"stiffness": hhtjax.positive, "damping": hhtjax.positive}
fits = {
    str(loss or "least squares"): hhtjax.fit(
        residuals,
        guess,
        loss=loss,
        weights=jnp.full(record.shape, 1 / NOISE),
        transforms=positive,
    )
    for loss in (None, "cauchy")
}
for name, result in fits.items():
    worst = max(float(jnp.max(jnp.abs(result.params[x] / true[x] - 1))) for x in true)
    print(f"{name:<14} {result.reason}; worst parameter {100 * worst:.2f} % off")
print()
print(fits["cauchy"].summary())

# %% [markdown]
# **Look at** the distance of the intervals of each fit from zero, the truth, and at their
# width. An interval should contain zero in 19 of 20 cases. The grey dots off the line, on the
# right, are the wrong samples.

# %%
figure, (left, right) = hhtjax.plot.subplots(1, 2, width=175, height=85, width_ratios=(3, 2))
hhtjax.plot.estimates(fits, truth=true, ax=left)
t = np.arange(1, SAMPLES + 1) * 5e-3
right.plot(t, record[:, 1], ".", color="0.6", ms=3, label="record, joint 2")
right.plot(t, clean[:, 1], color="black", lw=0.8, label="truth")
right.set(xlabel="time (s)", ylabel="angle (rad)")
right.legend(fontsize=7)
plt.show()

# %% [markdown]
# ## Which samples were wrong?
#
# The residuals of the robust fit show them: those larger than five standard deviations of the
# noise.

# %%
flagged = np.abs(np.asarray(fits["cauchy"].residual)) > 5 * NOISE
visible = spoiled & (np.abs(record - clean) > 6 * NOISE)
print(f"flagged: {flagged.sum()}, of which were right after all: {np.sum(flagged & ~spoiled)}")
print(
    f"of {visible.sum()} samples that are off by more than six deviations, found: "
    f"{np.sum(flagged & visible)}"
)

# %% [markdown]
# Leave them out (`weights=` with zeros) and fit the rest by least squares. This makes the
# best use of good data:

# %%
good = jnp.where(flagged, 0.0, 1 / NOISE)
last = hhtjax.fit(residuals, fits["cauchy"].params, weights=good, transforms=positive)
off = {
    x: np.round(np.asarray((last.params[x] - true[x]) / last.standard_errors[x]), 1)
    for x in true
}
print("off by", off, "standard errors")

# %% [markdown]
# ## What to try next
#
# * Make half of the samples wrong. Which loss still finds the joints?
# * Let the mass of the last link be unknown, too. Can the data distinguish stiffness and
#   mass? `summary()` names what they cannot.
# * Start far away, and use `hhtjax.multistart`.
