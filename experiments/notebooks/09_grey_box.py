# %% [markdown]
# # 9. Grey box: known physics, and a network for the rest
#
# Often most of a model is known and one part is not: friction in a guide, a rubber bushing, a
# seal. Then use physics for the known part and a small neural network for the unknown part.
# The network is a function inside `force`. Its weights are parameters like any other, and
# `fit` finds them through the simulation. You need no measurement of the friction force or of
# the velocity: a record of force and position is enough.

# %%
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import hhtjax

jax.config.update("jax_enable_x64", True)  # double precision; JAX starts in single precision

# %% [markdown]
# ## The record
#
# A slider of 1 kg on a spring has friction in its guide: $m\ddot q + kq + f(\dot q) = u(t)$.
# The record is generated, so that we can compare with the true friction at the end. Friction
# first falls when sliding begins, and then rises with speed (Stribeck's curve). There are two
# records of 3 s with different random forces up to 5 Hz: one for training, one for the test.
# Positions have white noise of 0.2 mm. The records use steps 8 times smaller than the
# model's.

# %%
DT, N, NOISE = 1e-3, 3000, 2e-4  # s, samples, m
rest = jnp.zeros(1)


def stribeck(v):
    return (1.0 + 0.8 * jnp.exp(-((v / 0.2) ** 2))) * jnp.tanh(v / 0.05) + 0.5 * v  # N


def multisine(seed, rms):
    tone = 0.25 * np.arange(1, 21)  # Hz
    phase = np.random.default_rng(seed).uniform(0, 2 * np.pi, tone.size)
    values = np.cos(2 * np.pi * tone * DT * np.arange(N + 1)[:, None] + phase).sum(axis=1)
    return hhtjax.sampled(rms * values / values.std(), dt=DT)


def system(friction):
    """The slider with friction(v, params)."""
    return hhtjax.System(
        mass=jnp.ones(1),
        force=lambda q, v, t, params: (
            params["u"](t) - params["k"] * q - friction(v[0], params)
        ),
    )


def simulate(model, params, u, finer=1):
    stepper = hhtjax.hht(alpha=0.0, linearize="predictor")  # smooth in the parameters
    sizes = {"dt": DT / finer, "num_steps": finer * N, "save_every": finer}
    return hhtjax.simulate(model, stepper, rest, rest, params | {"u": u}, **sizes)


real = system(lambda v, params: stribeck(v))
u_train, u_test = multisine(0, 4.0), multisine(1, 3.0)
truth_train, truth_test = (simulate(real, {"k": 400.0}, u, finer=8) for u in (u_train, u_test))
rng = np.random.default_rng(5)
train, test = (
    run.q[1:, 0] + NOISE * rng.standard_normal(N) for run in (truth_train, truth_test)
)
print(
    f"positions: {1e3 * train.std():.0f} mm rms (test {1e3 * test.std():.0f} mm), noise "
    f"{1e3 * NOISE} mm"
)

# %% [markdown]
# ## Physics alone
#
# First we try what most would try: a linear damper. The misfit is in units of the noise, so a
# perfect model has 1.


# %%
def misfit(model, params, u, measured):
    return (simulate(model, params, u).q[1:, 0] - measured) / NOISE


def rms(x):
    return float(jnp.sqrt(jnp.mean(x**2)))


linear = system(lambda v, params: params["c"] * v)
physics = hhtjax.fit(
    lambda params: misfit(linear, params, u_train, train), {"k": 300.0, "c": 3.0}
)
print(f"k = {physics.params['k']:.1f} N/m, c = {physics.params['c']:.2f} N s/m,", end=" ")
print(f"misfit {rms(physics.residual):.1f} times the noise")

# %% [markdown]
# ## The network in the force
#
# The force has a damper as before, and a network with one hidden layer of 8. Two things are
# known about friction, and we build them in:
#
# * It depends only on velocity and is **odd**: $f(-v) = -f(v)$. So we take $g(v) - g(-v)$.
# * It changes fast at low speeds and slowly at high speeds. So the input is
#   $\operatorname{arsinh}(v/v_0)$. This is linear below $v_0$ = 0.05 m/s, and a logarithm
#   above.
#
# An `equinox` module is a pytree. It goes into `params` unchanged, beside the stiffness.
# Damper and network can replace each other, so `c` alone has no meaning now; only their sum
# has. `k` is fitted with them and keeps its meaning.

# %%
net = eqx.nn.MLP(
    "scalar", "scalar", width_size=8, depth=1, activation=jnp.tanh, key=jax.random.key(0)
)


def friction(v, params):
    x = jnp.arcsinh(v / 0.05)
    return params["c"] * v + params["net"](x) - params["net"](-x)


grey = system(friction)
start = physics.params | {"net": net}
weights = sum(x.size for x in jax.tree.leaves(eqx.filter(net, eqx.is_array)))


def train_residuals(params):
    return misfit(grey, params, u_train, train)


begin = time.process_time()
found = hhtjax.fit(train_residuals, start, max_iterations=60, covariance=False)
used = time.process_time() - begin
print(
    f"{weights} weights, k and c: {found.iterations} iterations, {used:.0f} s of processor "
    "time with compiling"
)
print(
    f"misfit {rms(found.residual):.3f} times the noise (start "
    f"{rms(train_residuals(start)):.0f})"
)
print(
    f"k = {found.params['k']:.2f} N/m, true 400; physics alone said {physics.params['k']:.1f}"
)
assert rms(found.residual) < 1.1
assert abs(found.params["k"] - 400) < abs(physics.params["k"] - 400)

# %% [markdown]
# `fit` used Levenberg-Marquardt, its default for up to 64 parameters. It takes the
# derivatives of all samples with respect to all weights, through the non-iterative step. For
# larger networks pass an optax optimiser, such as `fit(residuals, start, optax.adam(1e-2))`.
# Or write the training loop yourself: the gradient of any loss is
# `eqx.filter_grad(loss)(params)`. We set `covariance=False`, because single weights have no
# meaning.
#
# The next cell shows the cost of the gradient in reverse mode, and how the loops over the
# steps run:

# %%
values, functions = eqx.partition(start, eqx.is_array)


def loss(values):
    return jnp.mean(train_residuals(eqx.combine(values, functions)) ** 2)


def shortest(f, x):
    jax.block_until_ready(f(x))  # compiles
    times = []
    for _ in range(5):
        begin = time.process_time()
        jax.block_until_ready(f(x))
        times.append(time.process_time() - begin)
    return min(times)


run_time, gradient_time = (
    shortest(jax.jit(loss), values),
    shortest(jax.jit(jax.value_and_grad(loss)), values),
)
print(
    f"run {1e3 * run_time:.2f} ms; with the gradient of all weights "
    f"{1e3 * gradient_time:.2f} ms"
)
print(hhtjax.explain(jax.value_and_grad(loss), values))

# %% [markdown]
# ## What did it find?
#
# **Look at** the shaded regions. There the training record has no data. Elsewhere the curve
# must be right. Do not use it in the shaded regions: nothing has checked it there, even if it
# looks right, as it may here (see the last number).

# %%
seen = float(jnp.abs(truth_train.v).max())
v = jnp.linspace(-1.6 * seen, 1.6 * seen, 401)
learned = jax.vmap(lambda v: friction(v, found.params))(v)
inside = jnp.abs(v) <= seen
off = learned - stribeck(v)
print(
    f"speeds up to {seen:.2f} m/s in the record, friction up to "
    f"{jnp.abs(stribeck(v[inside])).max():.2f} N"
)
print(
    f"friction found off by {rms(off[inside]):.3f} N rms, {jnp.abs(off[inside]).max():.3f} "
    "N at most;",
    end=" ",
)
print(f"outside, out to {1.6 * seen:.2f} m/s, by up to {jnp.abs(off[~inside]).max():.3f} N")
assert rms(off[inside]) < 0.05 * rms(stribeck(v[inside]))

blue, orange = hhtjax.plot.COLOURS[:2]
figure, ax = hhtjax.plot.subplots(width=120, height=70)
for side in (-1, 1):
    ax.axvspan(
        side * seen,
        side * 1.6 * seen,
        color="0.9",
        lw=0,
        label="no data" if side > 0 else None,
    )
ax.plot(v, stribeck(v), color="black", lw=2.5, alpha=0.35, label="truth")
ax.plot(v, learned, color=blue, label="damper and network")
ax.plot(v, physics.params["c"] * v, color=orange, ls="--", label="damper alone")
count = ax.twinx()
count.hist(np.ravel(truth_train.v), bins=60, color="0.7", alpha=0.5)
count.set(yticks=[], ylim=(0, 1500))
count.spines[:].set_visible(False)
ax.set(
    xlabel="velocity (m/s)",
    ylabel="friction (N)",
    xlim=(-1.6 * seen, 1.6 * seen),
    ylim=(-4, 4),
)
ax.legend(loc="lower right", fontsize=8, frameon=False)
plt.show()

# %% [markdown]
# The grey hill below is the histogram of the velocities in the record.
#
# ## A record it has not seen
#
# **Look at** the residual. That of the grey box should be only noise. All velocities of the
# test lie within those of the training record; the cell asserts this.

# %%
residuals = {
    "damper alone": misfit(linear, physics.params, u_test, test),
    "damper and network": misfit(grey, found.params, u_test, test),
}
assert jnp.abs(truth_test.v).max() < seen
for name, residual in residuals.items():
    print(
        f"{name:<20} error on the test record: {rms(residual):6.2f} times the noise,", end=" "
    )
    print(f"{100 * NOISE * rms(residual) / test.std():.2f} % of the motion")
assert rms(residuals["damper and network"]) < 1.2
assert rms(residuals["damper alone"]) > 3

t = truth_test.t[1:]
figure, (above, below) = hhtjax.plot.subplots(2, 1, width=175, height=85, sharex=True)
above.plot(t, 1e3 * test, color="0.7", lw=2.5, label="measured")
for (name, residual), colour, line in zip(
    residuals.items(), (orange, blue), ("--", "-"), strict=True
):
    above.plot(t, 1e3 * (test + NOISE * residual), color=colour, ls=line, label=name)
    below.plot(t, 1e3 * NOISE * residual, color=colour, lw=0.8)
above.set_ylabel("position (mm)")
above.legend(ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0), fontsize=8, frameon=False)
below.set(xlabel="time (s)", ylabel="simulated minus\nmeasured (mm)")
plt.show()

# %% [markdown]
# ## What to try next
#
# * Train on `multisine(0, 2.0)` and test on the stronger record. Where does the model leave
#   the data?
# * Remove the arsinh: `x = v / 0.05`. Where does the training stop?
# * Let the unknown part depend on position too: `eqx.nn.MLP(2, "scalar", ...)`. Does it find
#   the same `k`? Why not?
# * Replace the sum by Stribeck's formula with five parameters, now that its shape is known.
#   Notebook 3 shows how to get their errors.
