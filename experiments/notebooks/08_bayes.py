# %% [markdown]
# # 8. How sure are we? All parameters that the data allow
#
# A fit gives one estimate and standard errors. Bayes' rule gives the whole distribution of
# the parameters, given the data: the **posterior**. Samples are drawn from it by NUTS, a
# sampler that follows the gradient of the logarithm of its density, so every sample takes
# several derivatives through the whole simulation. This notebook draws them with
# [blackjax](https://blackjax-devs.github.io/blackjax/), compares their spread with the
# standard errors of `fit`, and the speed with that of the same sampler on top of
# [diffrax](https://docs.kidger.site/diffrax/).

# %%
import time

import blackjax
import diffrax
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from jax.flatten_util import ravel_pytree

import hhtjax

jax.config.update("jax_enable_x64", True)  # double precision; JAX starts in single precision

# %% [markdown]
# ## The record
#
# A mass on a hardening spring, $m\ddot q + c\dot q + kq + k_3 q^3 = u(t)$, is driven for 10 s
# by a random multisine up to 3 Hz. A D/A converter puts the force out, 1000 values a second,
# and holds each until the next (`sampled(..., order=0)`). The position is recorded with white
# noise. Truth is known here, since the record is generated: by RK4 with two steps for each
# sample.

# %%
DT, N = 1e-3, 10_000  # s, samples
truth = {"m": 2.0, "c": 1.5, "k": 80.0, "k3": 1500.0}  # kg, N s/m, N/m, N/m^3
rng = np.random.default_rng(8)
tone = np.arange(1, 31) / 10.0  # Hz
force_values = np.cos(
    2 * np.pi * tone * DT * np.arange(N + 1)[:, None] + rng.uniform(0, 2 * np.pi, 30)
).sum(axis=1)
force_values *= 6.0 / force_values.std()  # N
held = hhtjax.sampled(force_values, dt=DT, order=0)


def force(q, v, t, params):
    spring = params["k"] * q + params["k3"] * q**3
    return params["u"](t) - params["c"] * v - spring


oscillator = hhtjax.System(lambda q, params: jnp.reshape(params["m"], (1,)), force)
rest = jnp.zeros(1)


def exact(params):
    run = hhtjax.simulate(
        oscillator,
        hhtjax.rk4(),
        rest,
        rest,
        params | {"u": held},
        dt=DT / 2,
        num_steps=2 * N,
        save_every=2,
    )
    return run.q[1:, 0]


clean = exact(truth)
measured = clean + 0.05 * clean.std() * rng.standard_normal(N)
share = truth["k3"] * jnp.abs(clean).max() ** 2 / truth["k"]
print(
    f"displacement: {1e3 * clean.std():.0f} mm rms; at its largest, "
    f"{1e3 * jnp.abs(clean).max():.0f} mm,",
    end=" ",
)
print(f"the cubic part of the spring force is {share:.1f} times the linear one")

# %% [markdown]
# ## The estimate
#
# One step of `hht` for each sample, 10 000 steps. `fit` starts 30 % off.


# %%
def ours(params):
    stepper = hhtjax.hht(alpha=0.0, linearize="predictor")  # smooth in the parameters
    run = hhtjax.simulate(
        oscillator, stepper, rest, rest, params | {"u": held}, dt=DT, num_steps=N
    )
    return run.q[1:, 0]


guess = {name: 1.3 * value for name, value in truth.items()}
result = hhtjax.fit(lambda params: ours(params) - measured, guess, transforms=hhtjax.positive)
print(result.summary())
sigma = float(jnp.std(result.residual, ddof=4))
print(f"\nnoise: {1e3 * sigma:.2f} mm estimated, {1e3 * 0.05 * clean.std():.2f} mm put in")

# %% [markdown]
# ## The posterior
#
# With white noise of standard deviation $\sigma$ (the one just estimated) and a prior that is
# flat in the logarithms, which keeps all four positive, the logarithm of the posterior
# density is
#
# $$\ell(x) = -\frac{1}{2\sigma^2}\sum_i \left(q_i(\theta(x)) - y_i\right)^2, \qquad
# \log\theta = \log\hat\theta + L x, \qquad
# L L^T = \text{covariance of the fit, in logarithms.}$$
#
# In the coordinates $x$ the posterior is nearly a standard normal distribution: so the
# sampler needs no warm-up. Its gradient is $-J^T r$. With four parameters, four forward
# derivatives along with the run cost less than one pass backwards through it. NUTS asks for a
# gradient in reverse mode, so we hand it over by `jax.custom_vjp`.

# %%
estimate, unravel = ravel_pytree(result.params)
L = jnp.linalg.cholesky(result.covariance / jnp.outer(estimate, estimate))


def theta(x):
    return unravel(estimate * jnp.exp(L @ x))


def misfit(motion, x):
    """Residuals in units of the noise, (N,), and their derivatives, (4, N)."""

    def residual(x):
        return (motion(theta(x)) - measured) / sigma

    return jax.vmap(lambda e: jax.jvp(residual, (x,), (e,)), out_axes=(None, 0))(jnp.eye(4))


def log_density(motion, mode="forward"):
    def density(x):
        return -0.5 * jnp.sum(((motion(theta(x)) - measured) / sigma) ** 2)

    def value_and_slope(x):
        r, J = misfit(motion, x)
        return -0.5 * r @ r, -J @ r

    if mode == "reverse":
        return density
    with_slope = jax.custom_vjp(density)
    with_slope.defvjp(value_and_slope, lambda slope, cotangent: (cotangent * slope,))
    return with_slope


def seconds(f, *args, longest=0.3):
    """The result of the compiled function, and the shortest time of calls for 0.3 s."""
    compiled, times, value = jax.jit(f).lower(*args).compile(), [], None
    while not times or sum(times) < longest:
        begin = time.perf_counter()
        value = jax.block_until_ready(compiled(*args))
        times.append(time.perf_counter() - begin)
    return value, min(times)


here = jnp.zeros(4)
_, run_time = seconds(ours, result.params)
(_, forward), forward_time = seconds(jax.value_and_grad(log_density(ours)), here)
(_, reverse), reverse_time = seconds(jax.value_and_grad(log_density(ours, "reverse")), here)
assert jnp.allclose(forward, reverse, rtol=1e-8, atol=1e-6)
print(
    f"run {1e3 * run_time:.2f} ms; with the gradient, forwards {1e3 * forward_time:.2f} ms,",
    end=" ",
)
print(f"backwards {1e3 * reverse_time:.2f} ms")

# %% [markdown]
# ## Samples
#
# Four chains, one after the other on one core, each started at a point drawn from the normal
# distribution of the fit. The effective sample size (ESS) says how many independent samples
# are worth as much; `rhat` near 1 that the chains agree.


# %%
def sample(density, keys, starts):
    """Chains of positions x, numbers of gradients, divergences. keys: (chains, draws)."""
    nuts = blackjax.nuts(density, step_size=0.8, inverse_mass_matrix=jnp.ones(4))

    def draw(state, key):
        state, info = nuts.step(key, state)
        return state, (state.position, info.num_integration_steps, info.is_divergent)

    return jax.lax.map(lambda c: jax.lax.scan(draw, nuts.init(c[1]), c[0])[1], (keys, starts))


chains, draws = 4, 200
keys = jax.random.split(jax.random.key(1), (chains, draws))
starts = jax.random.normal(jax.random.key(2), (chains, 4))
(x, gradients, diverged), sampling_time = seconds(
    lambda *a: sample(log_density(ours), *a), keys, starts
)
ess, rhat = jax.jit(
    lambda x: (blackjax.diagnostics.ess_bulk(x), blackjax.diagnostics.rhat(x))
)(x)
print(
    f"{chains * draws} draws, {gradients.sum()} gradients, {diverged.sum()} divergences, "
    f"{sampling_time:.1f} s"
)
print(f"smallest ESS {ess.min():.0f}, largest rhat {rhat.max():.3f}")
print(
    f"{float(ess.min()) / sampling_time:.0f} effective samples per second (compiling not "
    "counted)"
)
assert diverged.sum() == 0
assert rhat.max() < 1.02

# %% [markdown]
# ## The spread, beside the standard errors
#
# **Look at** the curves: the normal distributions that `fit` promises, over histograms of the
# samples. The noise is white here, and there are many data, so both must agree, to within
# chance. `fit`'s errors come from the scatter between 32 segments of the record, with no
# assumption of whiteness, so they scatter themselves. The textbook ones assume it, as the
# posterior does.

# %%
samples = estimate * jnp.exp(x.reshape(-1, 4) @ L.T)
errors = {"fit": result.covariance, "textbook": result.uncertainty.naive}
errors = {name: jnp.sqrt(jnp.diagonal(covariance)) for name, covariance in errors.items()}
spread = samples.std(axis=0, ddof=1)
names, units = sorted(truth), {"c": "N s/m", "k": "N/m", "k3": "N/m³", "m": "kg"}

print(
    "      truth    posterior mean and deviation    deviation / error of fit    / textbook "
    "error"
)
for i, name in enumerate(names):
    print(
        f"{name:<4}{truth[name]:7g}{samples[:, i].mean():16.5g} +- {spread[i]:.2g}"
        f"{spread[i] / errors['fit'][i]:24.3f}{spread[i] / errors['textbook'][i]:23.3f}"
    )
chance = {
    "textbook": 1 / (2 * ess),
    "fit": 1 / (2 * ess) + 1 / (2 * (result.segments - 1)),
}  # variances of the ratios
for kind, variance in chance.items():
    assert jnp.all(jnp.abs(spread / errors[kind] - 1) < 4 * jnp.sqrt(variance)), kind
assert jnp.all(jnp.abs(samples.mean(axis=0) - estimate) < 4 * spread / jnp.sqrt(ess))

figure, panels = hhtjax.plot.subplots(1, 4, width=175, height=55)
for i, (name, ax) in enumerate(zip(names, panels, strict=True)):
    ax.hist(samples[:, i], bins=25, density=True, color="0.75", label="posterior")
    grid = np.linspace(samples[:, i].min(), samples[:, i].max(), 100)
    for (kind, error), line in zip(errors.items(), ("-", ":"), strict=True):
        normal = np.exp(-(((grid - estimate[i]) / error[i]) ** 2) / 2) / (
            error[i] * np.sqrt(2 * np.pi)
        )
        ax.plot(grid, normal, line, color=hhtjax.plot.COLOURS[0], label=kind)
    ax.axvline(truth[name], color=hhtjax.plot.COLOURS[1], ls="--", label="truth")
    ax.set(xlabel=f"{name} ({units[name]})", yticks=[])
    ax.locator_params(axis="x", nbins=3)
panels[0].set_ylabel("density")
figure.legend(
    *panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=4, fontsize=8
)
plt.show()

# %% [markdown]
# ## Beside diffrax
#
# The same posterior and the same sampler, with the simulation by diffrax. A force that jumps
# 1000 times a second makes every solver stop at each jump, so steps of constant length, one a
# sample, are its best choice here. The midpoint rule is of the same order as `hht`, and
# evaluates the force inside the step only. It is differentiated forwards, as ours is;
# backwards, by its checkpoints, takes several times longer (below, "What to try next"). It is
# accurate enough: its error $e$ moves the estimate by $(J J^T)^{-1} J e$, less than a tenth
# of a standard error.

# %%
values = jnp.asarray(force_values)


def rate(t, state, params):
    q, v = state
    u = values[
        jnp.floor(t / DT + 1e-3).astype(int)
    ]  # held; the small number is against rounding
    return v, (u - params["c"] * v - params["k"] * q - params["k3"] * q**3) / params["m"]


ADJOINT = diffrax.ForwardMode()


def by_diffrax(params):
    return diffrax.diffeqsolve(
        diffrax.ODETerm(rate), diffrax.Midpoint(), 0.0, N * DT, DT, (0.0, 0.0), params,
        max_steps=N, adjoint=ADJOINT, saveat=diffrax.SaveAt(steps=True),
        stepsize_controller=diffrax.ConstantStepSize(),
    ).ys[0]  # fmt: skip


_, J = jax.jit(lambda x: misfit(ours, x))(here)
reference = exact(result.params)


def shift(motion):
    """How far the error of the solution moves the estimate, in standard errors: the largest
    of four."""
    error = (jax.jit(motion)(result.params) - reference) / sigma
    relative = L @ jnp.linalg.solve(J @ J.T, J @ error)
    return float(jnp.abs(relative * estimate / errors["textbook"]).max())


def row(name, motion):
    """Time of the value with its gradient."""
    _, duration = seconds(jax.value_and_grad(log_density(motion)), here)
    moved = shift(motion)
    print(
        f"{name:<46}{1e3 * duration:8.2f} ms a gradient; the estimate moves by {moved:.4f} "
        "standard errors"
    )
    return duration, moved


moved = shift(ours)
print(
    f"{'hhtjax, hht':<46}{1e3 * forward_time:8.2f} ms a gradient; the estimate moves by "
    f"{moved:.4f} standard errors"
)
diffrax_time, diffrax_moved = row("diffrax, Midpoint", by_diffrax)
assert max(moved, diffrax_moved) < 0.1
print(f"\ndiffrax: {diffrax_time / forward_time:.0f} times the time of a gradient of hhtjax")

# %% [markdown]
# In the sampler: both posteriors are the same to a few hundredths of a standard error, so
# NUTS needs as many gradients for an effective sample with either, and the speeds compare as
# the times of a gradient within the sampler do. diffrax draws a few samples only, from the
# same random numbers, or this would take minutes. (Where a force is smooth, steps under error
# control are the better choice for both: error against time is on the page of
# `work_precision`.)

# %%
few = 2
density = log_density(by_diffrax)
(_, theirs, _), t_theirs = seconds(lambda *a: sample(density, *a), keys[:, :few], starts)
t_gradient = {
    "hhtjax": sampling_time / int(gradients.sum()),
    "diffrax": t_theirs / int(theirs.sum()),
}
per_second = {
    name: float(ess.min()) / int(gradients.sum()) / t for name, t in t_gradient.items()
}
ratio = per_second["hhtjax"] / per_second["diffrax"]
for name, count in (("hhtjax", gradients), ("diffrax", theirs)):
    work = (
        f"{count.size} draws, {count.mean():.1f} gradients each, "
        f"{1e3 * t_gradient[name]:.2f} ms a gradient"
    )
    print(f"{name:<8}{work}: {per_second[name]:.3g} effective samples per second")
print(f"hhtjax makes {ratio:.0f} times as many")

# %% [markdown]
# ## What to try next
#
# * Take 300 samples instead of 10 000: where do histogram and curve part?
# * Differentiate diffrax backwards: `ADJOINT = diffrax.RecursiveCheckpointAdjoint()`, and
#   `log_density(..., "reverse")`.
# * Give $\sigma$ a prior too, as a fifth parameter.
# * Colour the noise (`np.convolve` with a few ones): the posterior does not notice and
#   becomes too narrow, `fit`'s errors do notice. Which of the two is right? Repeat with 20
#   records.
