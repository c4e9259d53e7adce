"""Stiff joints from noisy angles: k over five decades and c recovered, and what steps do to the gradient.

The double pendulum of Kim et al. (2019), Sec. 4, falls from rest: joint stiffness k = (400, 300) N m/rad times a factor
of 1e-2 to 1e3, damping c = (15, 10000) N m s/rad. Both angles are measured with noise of 1 % of their RMS. Each seed
has a k, a noise and a guess of its own, in which every parameter is 3 times too large or too small; all are fitted at
once, as logarithms over the guess. What a record does not determine, such as a soft spring beside the stiff damper of
joint 2, is left to a prior, that the guess is right within a factor of about 5.
"""

import time
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.identification import stiff_joint_gradients
from experiments.identification.coverage import fit_logarithms, judge, tell
from experiments.parts import rounded
from experiments.report import COLOURS, MARKERS, Report
from hhtjax.plot import legend, subplots, work_precision
from hhtjax.scenes import double_pendulum

SCENE = double_pendulum.stiff()
KIM = {"k1": 400.0, "k2": 300.0, "c1": 15.0, "c2": 10000.0}
NOISE = 0.01  # of the RMS of each angle
OFF = 3.0  # guess over truth, or its inverse
PERIODS, SAMPLES = 5, 400  # of a record
HORIZONS = (0.1, 0.3, 1.0)  # parts of a record, one fit after the other
PRIOR = hhtjax.Gaussian(0.0, 1.5)  # of the logarithms
SOUGHT = hhtjax.bounded(-7.0, 7.0)  # within a factor of 1000: the first parts of records tell little of some
STEPPER = hhtjax.hht(alpha=-0.05, linearize="predictor")


def angles(params, duration, stepper, steps_per_sample):
    """(SAMPLES, 2), after the start."""
    own = SCENE.params | {"k": (params["k1"], params["k2"]), "c": (params["c1"], params["c2"])}
    steps = SAMPLES * steps_per_sample
    run = hhtjax.simulate(
        SCENE.system, stepper, SCENE.q0, SCENE.v0, own, dt=duration / steps, num_steps=steps,
        save_every=steps_per_sample,
    )  # fmt: skip
    return run.q[1:]


def experiment(key):
    """Truth, guess, duration of the record, measured angles, and the deviation of their noise."""
    key_k, key_noise, key_guess = jax.random.split(key, 3)
    factor = 10 ** jax.random.uniform(key_k, minval=-2.0, maxval=3.0)
    truth = KIM | {"k1": KIM["k1"] * factor, "k2": KIM["k2"] * factor}
    inertia, gravity = 16.25, 122.6  # of the whole about the first joint: kg m^2, and N m/rad at most
    duration = PERIODS * 2 * jnp.pi * jnp.sqrt(inertia / (truth["k1"] + gravity))
    exact = angles(truth, duration, hhtjax.hht(alpha=0.0, iterations=None), 16)
    deviation = NOISE * jnp.sqrt(jnp.mean(exact**2, axis=0))
    measured = exact + deviation * jax.random.normal(key_noise, exact.shape)
    signs = jax.random.rademacher(key_guess, (len(truth),), jnp.result_type(float))
    guess = {name: value * OFF**sign for (name, value), sign in zip(truth.items(), signs, strict=True)}
    return truth, guess, duration, measured, deviation


@partial(jax.jit, static_argnames="steps_per_sample")
@partial(jax.vmap, in_axes=(0, 0, 0, 0, 0, None, None))
def fit_part(x, guess, duration, measured, deviation, horizon, steps_per_sample):
    """The fit to the first part of each record, from x, the logarithms of parameters over their guess."""
    present = jnp.arange(1, SAMPLES + 1) <= horizon * SAMPLES

    def residuals(params):
        return angles(params, duration, STEPPER, steps_per_sample) - measured

    return fit_logarithms(residuals, x, guess, weights=present[:, None] / deviation, prior=PRIOR, transforms=SOUGHT)


def recover(report, seeds, steps):
    """Fits with each of two numbers of steps per sample, and Richardson's value; errors and intervals of each."""
    keys = jax.random.split(jax.random.key(0), seeds)
    truth, *data = jax.jit(jax.vmap(experiment))(keys)
    off = {name: jnp.log(data[0][name] / truth[name]) for name in KIM}
    fits, seconds = [], []
    for steps_per_sample in steps:
        for _ in range(2):  # the first time compiles
            begin = time.perf_counter()
            x = {name: jnp.zeros(seeds) for name in KIM}
            for horizon in HORIZONS:
                result = jax.block_until_ready(fit_part(x, *data, horizon, steps_per_sample))
                x = result.params
            seconds.append(time.perf_counter() - begin)
        fits.append(result)
        report.progress(f"{seeds} fits, {steps_per_sample} steps per sample: {seconds[-1]:.2f} s, warm")
    deviation = jax.vmap(lambda r: r.standard_errors)(fits[1])
    return judge(fits[0], fits[1], off) | {
        "fit_time_s": sum(seconds[1::2]),
        "fit_with_compilation_s": sum(seconds[::2]),
        "k1_true_N_m_rad": np.asarray(truth["k1"]).tolist(),
        "determined": {n: int(np.sum(np.asarray(deviation[n]) < PRIOR.deviation / 2)) for n in KIM},
        "largest_cost_per_residual": float(jnp.max(fits[1].cost)) / SAMPLES,
    }


def run(report: Report, fast: bool):
    """Recovery over many seeds, and the quality of gradients."""
    numbers: dict[str, Any] = {"recovery": recover(report, *((8, (1, 1)) if fast else (100, (1, 2))))}
    found = numbers["recovery"]
    tell(report, found)
    print(
        "Intervals less than half the prior's:", ", ".join(f"{n} {count}" for n, count in found["determined"].items())
    )
    print(f"Largest cost per residual: {found['largest_cost_per_residual']:.3f}.\n")
    plot_recovery(report, found)
    numbers["gradients"] = stiff_joint_gradients.run(report, fast)
    plot_gradients(report, numbers["gradients"]["rows"])
    report.numbers(rounded(numbers))


def plot_recovery(report, found):
    """What the records determine, errors in units of the intervals, and how many intervals hold the truth."""
    figure, (left, middle, right) = subplots(1, 3, width=175, height=85)
    k = np.array(found["k1_true_N_m_rad"])
    for i, (name, values) in enumerate(found["over_truth_with_interval"].items()):
        value, lower, upper = np.log(values)
        style = {"color": COLOURS[i], "marker": MARKERS[i], "ms": 3.5, "ls": "none", "label": name}
        left.loglog(k, (upper - lower) / 2, **style)
        middle.semilogx(k, 2 * value / (upper - lower), **style)
    half = 1.96 * float(PRIOR.deviation)
    left.axhline(half, color="black", lw=0.8)
    left.text(k.max(), 1.15 * half, "prior alone", ha="right")
    left.set_ylim(top=4 * half)
    middle.axhspan(-1, 1, color="black", alpha=0.08)
    left.set_ylabel("half-width of the 95 % interval\n(of the logarithm of the parameter)")
    middle.set_ylabel("error of Richardson's value / half-width")
    for axis in (left, middle):
        axis.set_xlabel("true k1 (N m/rad)")
    for i, (kind, by) in enumerate(found["covered"].items()):
        share = 100 * np.array(list(by.values())) / found["records"]
        right.bar(np.arange(len(by)) + 0.27 * (i - 1), share, 0.25, color=COLOURS[i + 4], label=f"steps: {kind}")
    right.axhline(93, color="black", lw=0.8)
    right.set_xticks(range(len(KIM)), list(KIM))
    right.set_ylabel("truth inside the 95 % interval (%)")
    right.set_ylim(0, 100)
    legend(right)
    legend(left)
    report.figure("stiff_joint", figure)


def plot_gradients(report, rows):
    """Error of the gradient over h^2 against the step, and the error against time."""
    figure, (left, right) = subplots(1, 2, width=175, height=80)
    curves, lines = {}, {}
    for i, method in enumerate(dict.fromkeys(row["method"] for row in rows)):
        mine = [row for row in rows if row["method"] == method]
        error = np.array([row["relative_error"] for row in mine])
        style = {"color": COLOURS[i], "marker": MARKERS[i], "ms": 4, "lw": 1, "ls": "-"}
        curves[method], lines[method] = ([1e3 * row["seconds"] for row in mine], error), style
        if "h_s" in mine[0]:
            h = np.array([row["h_s"] for row in mine])
            left.semilogx(h, error / h**2, **style)
            left.set_xticks(h, [f"{x:g}" for x in h])
    words = {"xlabel": "time of a gradient (ms)", "ylabel": "relative error of the gradient"}
    work_precision(curves, lines=lines, **words, key=False, ax=right)
    left.minorticks_off()
    left.set(xlabel="step h (s)", ylabel="relative error of the gradient / h² (1/s²)", ylim=(0, None))
    figure.legend(loc="outside lower center", ncols=3)
    report.figure("stiff_joint_gradients", figure)
