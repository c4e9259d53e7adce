"""The spring of the squeezing mechanism from its crank angle: stiffness and rest length, through six constraints.

Andrews' mechanism of `scenes.squeezer` runs for 0.03 s. Only its crank angle is measured, with noise of 1 mrad. The
guess of the spring's stiffness is 3 times too large, that of its rest length 5 % too large (more, and the crank does
not turn). One linear solve per step, with position and velocity constraints enforced.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.identification.coverage import fit_logarithms, judge, tell
from experiments.parts import rounded
from experiments.report import COLOURS, Report
from hhtjax.plot import legend, subplots
from hhtjax.scenes import squeezer

SCENE = squeezer.squeezer()
TRUTH = {"c0": 4530.0, "l0": 0.07785}
GUESS = {"c0": 3 * 4530.0, "l0": 1.05 * 0.07785}
SAMPLES, NOISE = 300, 1e-3  # rad
HORIZONS = (0.2, 0.5, 1.0)
STEPPER = hhtjax.hht(alpha=-0.05)


def crank_angle(params, steps_per_sample, stepper=STEPPER):
    """(SAMPLES,), rad, after the start."""
    steps = SAMPLES * steps_per_sample
    run = hhtjax.simulate(
        SCENE.system, stepper, SCENE.q0, SCENE.v0, SCENE.params | params, dt=SCENE.duration / steps, num_steps=steps,
        save_every=steps_per_sample,
    )  # fmt: skip
    return run.q[1:, 0]


@partial(jax.jit, static_argnames="steps_per_sample")
def fit_all(x, measured, horizon, steps_per_sample):
    """The fits to the first part of each record, one after the other: with vmap it would compile twice as long."""
    present = jnp.arange(1, SAMPLES + 1) <= horizon * SAMPLES
    weights = jnp.where(present, 1 / NOISE, 0)

    def fit_one(record):
        x, measured = record
        return fit_logarithms(lambda p: crank_angle(p, steps_per_sample) - measured, x, GUESS, weights=weights)

    return jax.lax.map(fit_one, (x, measured))


def run(report: Report, fast: bool):
    """Fits and coverage; fast: one fit to one record."""
    records = 1 if fast else 20
    finely = {"steps_per_sample": 1 if fast else 16, "stepper": STEPPER if fast else hhtjax.hht(alpha=0.0)}
    exact, guessed = (np.asarray(crank_angle(params, **finely)) for params in (TRUTH, GUESS))
    measured = exact + NOISE * jax.random.normal(jax.random.key(0), (records, SAMPLES))
    fits, x = [], {name: jnp.zeros(records) for name in TRUTH}
    for n in (1,) if fast else (1, 2):
        for horizon in HORIZONS if not fast and n == 1 else HORIZONS[-1:]:
            result = jax.block_until_ready(fit_all(x, measured, horizon, n))
            x = result.params
        fits.append(result)
        report.progress(f"{records} fits with {n} steps per sample, {int(np.sum(result.converged))} converged")
    off = {name: jnp.log(GUESS[name] / TRUTH[name]) for name in TRUTH}
    numbers: dict[str, Any] = judge(fits[0], fits[-1], off) | {"noise_rad": NOISE}
    tell(report, numbers)
    plot(
        report,
        numbers,
        np.asarray(measured[0]),
        guessed,
        np.asarray(exact),
    )
    report.numbers(rounded(numbers))


def plot(report, numbers, measured, guessed, exact):
    """The crank angle, and the estimates of all records."""
    figure, (left, right) = subplots(1, 2, width=175, height=75)
    t = 1e3 * SCENE.duration * np.arange(1, SAMPLES + 1) / SAMPLES
    left.plot(t, exact, color=COLOURS[0], lw=1, label="truth (and fits, to line width)")
    left.plot(t[::6], measured[::6], ".", color="black", ms=3, label="measured")
    left.plot(t, guessed, color=COLOURS[7], lw=1, ls="--", label="guess")
    left.set(xlabel="time (ms)", ylabel="crank angle (rad)")
    legend(left)
    (c0, c0_low, c0_high), (l0, l0_low, l0_high) = (
        100 * (np.array(x) - 1) for x in numbers["over_truth_with_interval"].values()
    )
    right.errorbar(
        c0, l0, [l0 - l0_low, l0_high - l0], [c0 - c0_low, c0_high - c0], fmt="o", ms=3, lw=0.6, color=COLOURS[1]
    )
    right.plot(0, 0, "+", color="black", ms=12)
    right.set(xlabel="stiffness, estimate less truth (%)", ylabel="rest length, estimate less truth (%)")
    report.figure("squeezer", figure)
