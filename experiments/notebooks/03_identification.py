# %% [markdown]
# # 3. Parameters from measured data
#
# An electronic oscillator was driven by a known voltage $u$, and its output $y$ was recorded:
# the Silverbox benchmark of Wigren and Schoukens (2013). We estimate mass, damping and
# stiffness with standard errors. We find a term that the model lacks, test the model on
# unseen data, and see what the step size does to the result.
#
# The data are public (nonlinearbenchmark.org, file SNLS80mV.csv), but we may not redistribute
# them. Put the file into a folder `silverbox/` and set the environment variable `HHTJAX_DATA`
# to the folder that contains it. Without it this notebook generates a record of the same kind
# with known parameters, and says so.

# %%
import os
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import hhtjax
from hhtjax.identification import score_test

jax.config.update("jax_enable_x64", True)
plt.rcParams.update(hhtjax.plot.styles.PARAMETERS)

RATE = 1e7 / 2**14  # samples per second
TRUE = {
    "m": 5.4e-6,
    "c": 2.2e-4,
    "k": 1.0,
    "k2": -0.03,
    "k3": 4.0,
    "offset": -5e-3,
    "c2": 1.5e-3,
    "d": 0.0,
}
TRAIN, TEST = 16000, 16000  # samples

file = Path(os.environ.get("HHTJAX_DATA", ".")) / "silverbox" / "SNLS80mV.csv"
measured = file.is_file()
print(
    "MEASURED record (Silverbox)"
    if measured
    else f"GENERATED record with known parameters; {file} is not there"
)

# %% [markdown]
# ## The model
#
# $$m\ddot y + (c + c_2 y^2 + d\,|\dot y|)\,\dot y + k y + k_2 y^2 + k_3 y^3 = u(t) + u_0$$
#
# $u$ and $y$ are in V. From two voltages only ratios can be found, so the gain of the input
# is set to 1. Therefore $m$, $c$ and $k$ do not have the SI units of mass, damping and
# stiffness, but V per V s², and so on.
#
# With more than one step per sample the input between samples matters. These signals contain
# only frequencies well below half the sampling rate. `band_limited` reconstructs such
# signals.


# %%
def mass(q, params):
    return jnp.reshape(params["m"], (1,))


def force(q, v, t, params):
    damping = (params["c"] + params["c2"] * q**2 + params["d"] * jnp.abs(v)) * v
    spring = q * (params["k"] + q * (params["k2"] + q * params["k3"]))
    return params["u"](t) + params["offset"] - damping - spring


oscillator = hhtjax.System(mass, force)


def output(params, start, u, samples, substeps):
    """y at the samples, in V, by `substeps` steps from each to the next."""
    run = hhtjax.simulate(
        oscillator,
        hhtjax.hht(
            alpha=0.0, linearize="predictor"
        ),  # smooth in the parameters: what a fit needs
        jnp.reshape(start["y"], (1,)),
        jnp.reshape(start["v"], (1,)),
        params | {"u": u},
        dt=1 / RATE / substeps,
        num_steps=(samples - 1) * substeps,
        save_every=substeps,
    )
    return run.q[:, 0]


def generate(samples):
    """A record from known parameters: noise up to 200 Hz as input, 16 steps per sample, and
    0.3 mV of noise on the output."""
    rng = np.random.default_rng(0)
    spectrum = np.fft.rfft(rng.normal(size=samples))
    spectrum[np.fft.rfftfreq(samples, 1 / RATE) > 200.0] = 0
    u = np.fft.irfft(spectrum, samples)
    u = 0.055 * u / u.std()
    y = output(TRUE, {"y": 0.0, "v": 0.0}, hhtjax.band_limited(u, 1 / RATE), samples, 16)
    return u, np.asarray(y) + 3e-4 * rng.normal(size=samples)


if measured:
    u_all, y_all = np.loadtxt(file, delimiter=",", skiprows=1, usecols=(0, 1)).T[
        :, 40650:127400
    ]  # the multisine
else:
    u_all, y_all = generate(TRAIN + TEST)
train = slice(0, TRAIN)
test = slice(len(y_all) - TEST, len(y_all))
print(
    f"{TRAIN} samples to learn from, {TEST} others to be judged by; RMS of the output "
    f"{1e3 * y_all.std():.1f} mV"
)

# %% [markdown]
# ## A fit
#
# `residuals` is any function of the unknowns. `fit` minimises the sum of their squares by
# Levenberg-Marquardt, with exact derivatives of the whole run. The initial position and
# velocity are unknown too, so they are fitted as well. The start is crude: a linear
# oscillator with the resonance that the spectrum shows, near 68 Hz.

# %%
NAMES = ("m", "c", "k", "k2", "k3", "offset")
ABSENT = {"c2": 0.0, "d": 0.0}
OMEGA = 2 * np.pi * 68.0
guess = {"m": OMEGA**-2.0, "c": 0.04 / OMEGA, "k": 1.0, "k2": 0.0, "k3": 0.0, "offset": 0.0}
scale = {"m": 5e-6, "c": 1e-4, "k": 1.0, "k2": 1.0, "k3": 1.0, "offset": 0.01}


def start_of(part):
    y = y_all[part]
    return {"y": float(y[0]), "v": float(y[1] - y[0]) * RATE}


def problem(substeps, fixed):
    """The residuals, in V, of parameters and initial state on the training part."""
    u, y = hhtjax.band_limited(u_all[train], 1 / RATE), jnp.asarray(y_all[train])
    return lambda unknown: output(fixed | unknown[0], unknown[1], u, TRAIN, substeps) - y


scale_of_start = {"y": 0.01, "v": 5.0}
first = hhtjax.fit(problem(4, ABSENT), (guess, start_of(train)), scale=(scale, scale_of_start))
print(first.summary())

# %% [markdown]
# Read the table from the right. The column **error / naive** needs an explanation. Textbook
# standard errors assume that residuals are independent. Residuals of a measured system are
# correlated, because the model is never exact. So the library estimates the errors from
# segments of the record (a cluster sandwich). The last column gives how many times larger
# they are than the textbook errors.
#
# ## Which term is missing?
#
# The score test needs no second fit. It computes for each candidate how much of the residual
# it would explain. A statistic above 10.8 means a term with 99.9 % confidence. The candidates
# are damping that grows with the amplitude, and damping that grows with the speed.


# %%
def with_candidates(unknown, extra):
    u, y = hhtjax.band_limited(u_all[train], 1 / RATE), jnp.asarray(y_all[train])
    return output(ABSENT | unknown[0] | extra, unknown[1], u, TRAIN, 4) - y


found = score_test(with_candidates, first.params, ABSENT)
for name, statistic, drop in zip(found.names, found.statistic, found.cost_drop, strict=True):
    print(
        f"{name:<3} statistic {statistic:5.1f}, would take away {100 * drop:4.1f} % of the "
        "cost"
    )
best = found.names[int(np.argmax(found.cost_drop))]
print(f"the one to add: {best}")

# %% [markdown]
# So we add that term and fit again.

# %%
rest = {name: 0.0 for name in ABSENT if name != best}
more_guess = {**first.params[0], best: 0.0}
more_scale = {**scale, best: {"c2": 1e-3, "d": 1e-5}[best]}
second = hhtjax.fit(
    problem(4, rest), (more_guess, first.params[1]), scale=(more_scale, scale_of_start)
)
print(second.summary())
if not measured:
    for name in second.params[0]:
        off = (second.params[0][name] - TRUE[name]) / second.standard_errors[0][name]
        print(
            f"{name}: {off:+.1f} standard errors from the truth (the reason is the step "
            "size: see the end)"
        )

# %% [markdown]
# ## The test: data that the fit has not seen
#
# Both models predict the other part of the record from the input alone. Only the initial
# state has to be estimated, from the first 50 samples, which are not scored.


# %%
def predict(params, part):
    u, y = hhtjax.band_limited(u_all[part], 1 / RATE), jnp.asarray(y_all[part])
    head = hhtjax.fit(
        lambda start: output(ABSENT | params, start, u, 50, 4) - y[:50],
        start_of(part),
        scale=scale_of_start,
    )
    return np.asarray(output(ABSENT | params, head.params, u, len(y), 4))


def millivolts(error):
    return 1e3 * float(np.sqrt(np.mean(error[50:] ** 2)))


models = {"without the term": first, f"with {best}": second}
predicted = {name: predict(result.params[0], test) for name, result in models.items()}
for name, result in models.items():
    on_train, on_test = (
        millivolts(np.asarray(result.residual)),
        millivolts(predicted[name] - y_all[test]),
    )
    print(
        f"{name:<18} RMS error {on_train:.3f} mV where it was fitted, {on_test:.3f} mV on "
        "the unseen part"
    )

# %% [markdown]
# **Look at** the residual in the middle, in its own units, and at the spectra below. Where
# the residual is close to the output, the model is wrong or the signal is noise.

# %%
seconds = np.arange(TEST) / RATE
axes = hhtjax.plot.fit_against_data(
    seconds,
    y_all[test],
    predicted[f"with {best}"],
    unit="V",
    ylabel="output",
    show=(10.0, 10.4),
)
axes[0].figure.set_size_inches(6.5, 5.5)
plt.show()

# %% [markdown]
# ## What does the step size do to the estimate?
#
# A parameter is fitted *through* the steps. The fit compensates for what the steps do to a
# vibration. If $h$ equals the sampling period, $\omega h$ is about 0.7 here, or nine steps
# per period. Notebook 2 showed what this does to a period. `step_size_bias` predicts the
# resulting error of stiffness and damping (both divided by the mass) for small vibrations. We
# check the prediction by fits with 1, 2 and 4 steps per sample.

# %%
fits = {1: None, 2: None, 4: second}
for substeps in (1, 2):
    fits[substeps] = hhtjax.fit(
        problem(substeps, rest),
        second.params,
        scale=(more_scale, scale_of_start),
        covariance=False,
    )

rows = []
for substeps, result in fits.items():
    params = result.params[0]
    linear = hhtjax.LinearSystem(
        *(jnp.reshape(params[name], (1,)) for name in ("m", "c", "k"))
    )
    bias = hhtjax.step_size_bias(
        linear, hhtjax.hht(0.0), None, 1 / RATE / substeps, q=jnp.zeros(1)
    )
    rows.append((substeps, params["k"] / params["m"], params["c"] / params["m"], bias))

# the two finest, extrapolated to steps of no length: errors are of order h^2
limit = [rows[2][i] + (rows[2][i] - rows[1][i]) / 3 for i in (1, 2)]
print("steps per sample   w h    k/m off by  predicted    c/m off by  predicted")
for substeps, stiffness, damping, bias in rows:
    print(
        f"{substeps:>16}  {bias.wh[0]:4.2f}  {100 * (stiffness / limit[0] - 1):9.2f} %  "
        f"{100 * bias.stiffness_bias[0]:7.2f} %  {100 * (damping / limit[1] - 1):10.2f} %  "
        f"{100 * bias.damping_bias[0]:7.2f} %"
    )
error = second.standard_errors[0]["k"] / second.params[0]["k"]
print(f"standard error of k with 4 steps per sample: {100 * error:.3f} %")
if not measured:
    exact = TRUE["k"] / TRUE["m"], TRUE["c"] / TRUE["m"]
    print(
        "extrapolated, off from the truth:",
        *(f"{100 * (x / y - 1):.3f} %" for x, y in zip(limit, exact, strict=True)),
    )

# %% [markdown]
# Compare the bias of the stiffness with its standard error. The standard error does not
# contain the bias, so the bias can go unnoticed. There are two remedies. `hhtjax.refine` fits
# with $h$ and $h/2$ and extrapolates, as done by hand above.
# `step_size_bias(..., correct=True)` removes the bias afterwards.

# %%
figure, axes = hhtjax.plot.subplots(width=130, height=70)
counts = np.array([row[0] for row in rows])
for i, (name, colour) in enumerate({"k/m": "#0072B2", "c/m": "#D55E00"}.items()):
    off = [abs(100 * (row[1 + i] / limit[i] - 1)) for row in rows]
    predicted_bias = [abs(100 * float(row[3][3 + i][0])) for row in rows]
    axes.loglog(counts, off, "os"[i], color=colour, label=f"{name}, found")
    axes.loglog(counts, predicted_bias, color=colour, lw=1, label=f"{name}, predicted")
axes.set_xticks(counts, counts)
axes.minorticks_off()
axes.set(xlabel="steps per sample", ylabel="bias of the fit (%)")
axes.legend(fontsize=8)
plt.show()

# %% [markdown]
# ## What to try next
#
# * Leave out `start_of` and start from rest. What happens to the residual at the beginning?
# * Spoil a few samples and use `loss="huber"`. Notebook 11 does this with an arm.
# * Try `transforms={"m": hhtjax.positive}`, `prior=` and `hhtjax.multistart`; see
#   `help(hhtjax.fit)`.
# * `hhtjax.identification.profile` plots the cost against one parameter while the others are
#   fitted again.
