# %% [markdown]
# # 5. Hundreds of runs in one call
#
# `hhtjax.sweep` takes step sizes, parameters, initial states and coefficients of the method
# as data, and runs any list of them in one compiled call. This notebook shows error against
# run time for three methods, a map of 600 members, the same map on two devices, and the same
# map written to disk in parts.

# %%
import json
import multiprocessing
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import hhtjax

jax.config.update("jax_enable_x64", True)
plt.rcParams.update(hhtjax.plot.styles.PARAMETERS)
jax.config.update(
    "jax_num_cpu_devices", 2
)  # before the first computation: split this processor into two "devices"

# %% [markdown]
# ## The scene
#
# A double pendulum has springs in both joints (`hhtjax.scenes.double_pendulum`, after Kim et
# al. 2019). It is released from the horizontal. The joints have 20 N m/rad. Later this
# parameter differs between members.

# %%
scene = hhtjax.scenes.double_pendulum.free()
params = scene.params | {"k": (20.0, 20.0), "c": (0.1, 0.1)}
start = scene.q0, scene.v0, params
DURATION, SAMPLES = 1.0, 10

# %% [markdown]
# ## Which error does a second of computing buy?
#
# The error at a step size matters less than the error after a given time of computing.
# `sweep` gives the errors of all step sizes at once. Then each member is timed alone. (Only
# the values of `dts` change, so nothing is compiled again.)

# %%
dts = jnp.geomspace(1e-4, 5e-2, 10)
methods = {"hht(-0.05)": hhtjax.hht(alpha=-0.05), "rowda": hhtjax.rowda(), "RK4": hhtjax.rk4()}


def run_all(stepper, dts):
    return hhtjax.sweep(
        scene.system, stepper, *start, dts=dts, duration=DURATION, num_samples=SAMPLES
    )


def seconds(function):
    """Least time of 20 calls, and the time of one before them, which may compile."""
    times = []
    for _ in range(21):
        begin = time.perf_counter()
        jax.block_until_ready(function())
        times.append(time.perf_counter() - begin)
    return min(times[1:]), times[0]


reference = run_all(hhtjax.rk4(), jnp.array([1e-5])).q[0]
errors, curves = {}, {}
for name, stepper in methods.items():
    together, first = seconds(lambda stepper=stepper: run_all(stepper, dts))
    members = run_all(stepper, dts)
    error = np.sqrt(np.mean((np.asarray(members.q) - reference) ** 2, axis=(1, 2)))
    alone = np.array(
        [
            seconds(lambda dt=dt, stepper=stepper: run_all(stepper, dt[None]))[0]
            for dt in members.dt
        ]
    )
    errors[name], curves[name] = (np.asarray(members.dt), error), (alone, error)
    print(
        f"{name:<11} first call {first:.1f} s, with compiling; then all {len(dts)} runs "
        f"{1e3 * together:.1f} ms"
    )

# %%
figure, (left, right) = hhtjax.plot.subplots(1, 2, width=175, height=75)
hhtjax.plot.error_against_h(errors, unit="rad", ax=left)
hhtjax.plot.work_precision(curves, ylabel="RMS error (rad)", ax=right)
right.get_legend().remove()
plt.show()

# %% [markdown]
# **Look at** the right figure. At a given error, the curve farthest to the left is the
# fastest. Nothing is stiff in this scene, so the explicit method is fastest if you need many
# digits. On the far left all curves end at the cost of a call, which no step size avoids.
#
# ## A map of 600 members
#
# The members are 20 step sizes times 30 stiffnesses of the second joint, from 1 to 10000 N
# m/rad. `in_axes` says what differs between members, as in `jax.vmap`. Here only the leaf `k`
# of the params has an axis of 600. The reference is a second sweep with 30 members and a more
# accurate method.

# %%
steps, stiffness = jnp.geomspace(2e-4, 5e-2, 20), jnp.geomspace(1.0, 1e4, 30)


def stiffened(k):
    return params | {"k": (jnp.full_like(k, 20.0), k)}


AXES = (None, None, None, {name: (0, 0) if name == "k" else None for name in params})
all_dts, all_k = (x.ravel() for x in jnp.meshgrid(steps, stiffness, indexing="ij"))


def many(**options):
    return hhtjax.sweep(
        scene.system, hhtjax.hht(), scene.q0, scene.v0, stiffened(all_k), dts=all_dts,
        duration=DURATION, num_samples=SAMPLES, in_axes=AXES, **options,
    )  # fmt: skip


runs = many()
runs.check()  # would name the first member that failed
exact = hhtjax.sweep(
    scene.system, hhtjax.rowda(), scene.q0, scene.v0, stiffened(stiffness),
    dts=jnp.full(30, 5e-5), duration=DURATION, num_samples=SAMPLES, in_axes=AXES,
)  # fmt: skip
error = jnp.sqrt(
    jnp.mean((runs.q.reshape(20, 30, SAMPLES + 1, 2) - exact.q) ** 2, axis=(2, 3))
)
total = float(jnp.sum(DURATION / runs.dt))
print(f"{runs.q.shape[0]} members, {total:.2e} steps in one call")

# %%
figure, axes = hhtjax.plot.subplots(width=120, height=80)
image = axes.pcolormesh(
    stiffness, 1e3 * steps, jnp.log10(error), cmap="viridis", shading="nearest"
)
contours = axes.contour(
    stiffness,
    1e3 * steps,
    jnp.log10(error),
    levels=[-4, -3, -2, -1],
    colors="white",
    linestyles="solid",
)
axes.clabel(contours, fmt=lambda x: f"$10^{{{x:.0f}}}$", fontsize=8)
axes.set(
    xscale="log",
    yscale="log",
    xlabel="stiffness of the joint (N m/rad)",
    ylabel="step size (ms)",
)
figure.colorbar(image, label="log10 of the RMS error (rad)")
plt.show()

# %% [markdown]
# **Look at** the white lines of equal error. On the left they are level, because there the
# swinging alone determines the step size. Further right the joint vibrates faster, and the
# same error needs a smaller step. At the top right the vibration is so fast and so small that
# leaving it unresolved costs little.
#
# Is the map right? A member of the sweep equals the run of `simulate`, up to rounding:

# %%
one = 250
n = round(DURATION / float(runs.dt[one]))
alone = hhtjax.simulate(
    scene.system, hhtjax.hht(), scene.q0, scene.v0, params | {"k": (20.0, all_k[one])},
    dt=DURATION / n, num_steps=n, save_every=n // SAMPLES,
)  # fmt: skip
print(
    f"member {one}: {n} steps; largest difference "
    f"{jnp.abs(alone.q - runs.q[one]).max():.0e} rad"
)

# %% [markdown]
# ## Two devices
#
# With a mesh of devices, members are split between them. (Here the "devices" are halves of
# one processor. If other programs use it, do not expect half the time.)

# %%
mesh = jax.make_mesh((2,), ("members",))
one_device, two_devices = seconds(many)[0], seconds(lambda: many(mesh=mesh))[0]
apart = np.abs(np.asarray(many(mesh=mesh).q) - np.asarray(runs.q)).max()
print(
    f"one device {1e3 * one_device:.0f} ms, two {1e3 * two_devices:.0f} ms; largest "
    f"difference {apart:.0e} rad"
)
assert apart < 1e-12

# %% [markdown]
# ## To disk, and on after an interruption
#
# For sweeps that take hours, `sweep_to_disk` writes chunks of members, one file each. Here
# there are 3 chunks of 200 members. We delete the second, as if the machine had stopped
# there, and repeat the call. Only the missing chunk is computed.


# %%
def to_disk(folder, **options):
    return hhtjax.sweep_to_disk(
        folder, scene.system, hhtjax.hht(), scene.q0, scene.v0, stiffened(all_k), dts=all_dts,
        duration=DURATION, num_samples=SAMPLES, in_axes=AXES, chunk=200, **options,
    )  # fmt: skip


with tempfile.TemporaryDirectory() as temporary:
    folder = to_disk(Path(temporary) / "sweep")
    print("written:", sorted(path.name for path in folder.iterdir()))
    written = {path.name: path.stat().st_mtime_ns for path in folder.glob("*.npz")}
    (folder / "chunk-00001.npz").unlink()
    to_disk(folder)
    again = [
        path.name
        for path in sorted(folder.glob("*.npz"))
        if path.stat().st_mtime_ns != written[path.name]
    ]
    print("computed again:", again)
    loaded = hhtjax.load_sweep(folder)
    print(
        "members in the manifest:",
        json.loads((folder / "manifest.json").read_text())["members"],
    )
print("leaves:", ", ".join(sorted(loaded)))
print("equal to the sweep in memory, to", float(np.abs(loaded["q"] - runs.q).max()), "rad")

# %% [markdown]
# ## With other processes
#
# `executor=` gives the chunks to the workers of any executor with the interface of Python's
# standard library. Here the workers are two processes on this machine; on a cluster they can
# be Dask's or MPI's. Workers receive the compiled program, not the functions of this
# notebook, so nothing has to be importable there. The files are bitwise the same.

# %%
with tempfile.TemporaryDirectory() as temporary:
    alone = hhtjax.load_sweep(to_disk(Path(temporary) / "alone"))
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as executor:
        shared = hhtjax.load_sweep(to_disk(Path(temporary) / "shared", executor=executor))
equal = all(np.array_equal(alone[name], shared[name]) for name in alone)
print("two processes, bitwise equal:", equal)
assert equal

# %% [markdown]
# ## What to try next
#
# * Use `times=` instead of `duration` and `num_samples`: samples at unequal times, as from a
#   data logger.
# * Let the coefficient of the method differ, too:
#   `jax.vmap(lambda a: hhtjax.hht(alpha=a))(alphas)` with the axis 0.
# * Use `jax.grad` through a sweep: the derivative of all 600 errors with respect to a
#   parameter, at once.
