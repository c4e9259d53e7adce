"""100000 members: error and stability of the stiff double pendulum over step size, alpha and stiffness; and C's time.

The stiff joints of Kim et al., their springs scaled by 0.01 to 100, for a second; step sizes log-spaced, 2000 steps on
average. Error of the angles at the end, against ROWDA with h = 2e-5 s. The C source of the benchmarks steps a batch of
as many members as a block in the same run, by the same arithmetic with a common step.
"""

import resource
import sys

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.benchmarks import native
from experiments.benchmarks.measure import least_seconds, temporary_bytes
from hhtjax import trigonometry
from hhtjax.plot import subplots
from hhtjax.runs.sweep import run_sweep
from hhtjax.runs.sweep_inputs import Inputs
from hhtjax.scenes import double_pendulum

DURATION = 1.0
SCALES = np.logspace(-2, 2, 20)
ALPHAS = np.linspace(-1 / 3, 0.0, 10)
STEPS = np.logspace(np.log10(6.7e-5), -1, 500)
C_STEPS, C_MEMBERS = 20_000, 256
FAST = slice(None, None, 10)
SHOWN = 1e-4, 1e-2  # rad, limits of error that are counted


def members(fast):
    """scale, alpha, h of each member, and the shape of the grid."""
    axes = (SCALES[FAST], ALPHAS[::9], STEPS[200::100]) if fast else (SCALES, ALPHAS, STEPS)
    grid = np.meshgrid(*axes, indexing="ij")
    return [x.ravel() for x in grid], grid[0].shape, axes


def inputs(scene, scale, alpha, h):
    """The sweep, not run yet."""
    system, params, q0, v0, _ = scene
    k = tuple(x * scale for x in params["k"])
    stepper = jax.vmap(lambda alpha: hhtjax.hht(alpha, linearize="predictor"))(jnp.asarray(alpha))
    axes = (0, None, None, {**dict.fromkeys(params), "k": 0})
    return Inputs.checked(
        system, stepper, q0, v0, {**params, "k": k}, dts=h, duration=DURATION, num_samples=1, t0=0.0, in_axes=axes
    )  # fmt: skip


def references(scene, scales, fast):
    """Angles at the end for each scale."""
    system, params, q0, v0, _ = scene
    k = tuple(x * scales for x in params["k"])
    runs = hhtjax.sweep(
        system, hhtjax.rowda(), q0, v0, {**params, "k": k}, dts=np.full(len(scales), 1e-3 if fast else 2e-5),
        duration=DURATION, num_samples=1, in_axes=(None, None, None, {**dict.fromkeys(params), "k": 0}),
    )  # fmt: skip
    return np.asarray(runs.q[:, -1])


def c_runs(scene):
    """The batch in C, by compiler flags; empty without a compiler."""
    q0 = np.zeros((2, C_MEMBERS))
    return {name: native.Run(found, scene, q0, 5e-4, C_STEPS, -0.05) for name, found in native.libraries().items()}


def peak_bytes():
    """The largest resident memory of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def run(report, fast):
    """The map, its time and memory."""
    scene = double_pendulum.stiff(trigonometry=trigonometry)
    (scale, alpha, h), shape, axes = members(fast)
    prepared = inputs(scene, scale, alpha, h)
    arguments, keywords = prepared.call()
    program = run_sweep.of(keywords.pop("rates"), keywords.pop("numbers")).lower(*arguments, **keywords).compile()
    before = peak_bytes()
    functions = {"map": lambda: program(*arguments)} | c_runs(scene)
    times = least_seconds(functions, 0 if fast else 2)  # in turns
    runs = program(*arguments)
    steps = float(np.sum(DURATION / np.asarray(runs.dt)))
    report.progress(f"map: {scale.size} members, {steps:.3g} steps")
    exact = references(scene, axes[0], fast)
    error = np.abs(np.asarray(runs.q[:, -1]).reshape(*shape, 2) - exact[:, None, None]).max(axis=-1)
    error = np.where(np.isfinite(error), error, np.inf)
    numbers = {
        "members": int(scale.size),
        "mean_steps": steps / scale.size,
        "failed": int(np.count_nonzero(np.asarray(runs.failure.step))),
        "share_with_error_below": {str(limit): float(np.mean(error < limit)) for limit in SHOWN},
        "error_beyond_1_rad": int(np.count_nonzero(error > 1)),
        "peak_MB": peak_bytes() / 1e6,
        "peak_before_run_MB": before / 1e6,
        "temporary_MB": temporary_bytes(program) / 1e6,
    }
    if not fast:
        c_ns = min((1e9 * x / C_STEPS / C_MEMBERS for name, x in times.items() if name != "map"), default=None)
        numbers["ns_per_member_and_step"] = 1e9 * times["map"] / steps
        numbers["run_s"] = times["map"]
        numbers["c_ns_per_member_and_step"] = c_ns
        numbers["over_c"] = None if c_ns is None else numbers["ns_per_member_and_step"] / c_ns
        largest = []  # step size that keeps the error below 1e-2 rad, by alpha and scale
        for row in error:
            for column in row:
                large = np.flatnonzero(column > SHOWN[1])
                largest.append(float(axes[2][large[0] - 1] if large.size else axes[2][-1]))
        numbers["largest_h_s"] = {
            "scales": axes[0].tolist(), "alphas": axes[1].tolist(), "error_below_rad": SHOWN[1],
            "h_s": np.reshape(largest, shape[:2]).tolist(),
        }  # fmt: skip
        report.figure("sweeps_map", figure(axes, error))
    print("The map\n")
    report.table(["", "value"], [[k, x] for k, x in numbers.items() if isinstance(x, (int, float))])
    return numbers


def figure(axes, error):
    """Error over (h, stiffness) for two alphas, and over (h, alpha) for two stiffnesses."""
    scales, alphas, steps = axes
    drawn, grid = subplots(2, 2, width=175, height=145, sharex=True)
    panels = [
        (f"alpha = {alphas[-1]:.3g}", scales, error[:, -1], "stiffness / that of the paper"),
        (f"alpha = {alphas[0]:.3g}", scales, error[:, 0], "stiffness / that of the paper"),
        (f"stiffness x {scales[0]:.3g}", alphas, error[0], "alpha"),
        (f"stiffness x {scales[-1]:.3g}", alphas, error[-1], "alpha"),
    ]
    for axes_, (title, y, values, label) in zip(grid.ravel(), panels, strict=True):
        log = np.log10(np.clip(values, 1e-9, 10))
        shown = axes_.pcolormesh(steps, y, log, vmin=-9, vmax=1, cmap="cividis", shading="nearest", rasterized=True)
        axes_.set(xscale="log", title=title, ylabel=label)
        if label != "alpha":
            axes_.set_yscale("log")
        axes_.grid(visible=False)
    for axes_ in grid[1]:
        axes_.set_xlabel("step size (s)")
    drawn.colorbar(shown, ax=grid, label="log10 of the error of the angles after 1 s (rad)")
    return drawn
