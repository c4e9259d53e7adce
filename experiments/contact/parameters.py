"""Friction and restitution of the ball, from noisy records of its way to rest.

The records are DOP853's motion, solved from impact to impact, with noise of 1 % of the RMS of each coordinate. Each has
a noise and a guess of its own, and is fitted with a step and with half of it.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.contact import reference
from experiments.contact.scenes import SCENES, run_of
from experiments.identification.coverage import fit_logarithms, judge, tell
from experiments.report import COLOURS
from hhtjax.plot import legend, subplots

NOISE, SAMPLES, STEPS, RECORDS = 0.01, 200, (2, 4), 20
FITTED = "e", "mu"
OFF = 1.2  # guess over truth, or its inverse


@partial(jax.jit, static_argnames=("steps_per_sample",))
def fit_record(guess, measured, weights, steps_per_sample):
    """The fit to a record, from the guess; of logarithms over it."""

    def residuals(fitted):
        run = run_of(SCENES["ball"], SAMPLES * steps_per_sample, steps_per_sample, **fitted)
        return run.q[1:] - measured

    return fit_logarithms(residuals, dict.fromkeys(guess, 0.0), guess, weights=weights)


def records(number):
    """Truth, guesses, measured q (number, SAMPLES, 2), and the deviations of the noise."""
    scene = SCENES["ball"]
    q = reference.motion("ball", scene, np.linspace(0, scene.T, SAMPLES + 1))[0][1:]
    truth = {key: float(scene.params[key]) for key in FITTED}
    random, deviation = np.random.default_rng(1), NOISE * np.sqrt(np.mean(q**2, axis=0))
    measured = q + deviation * random.normal(size=(number, *q.shape))
    guesses = {key: value * OFF ** random.choice([-1, 1], number) for key, value in truth.items()}
    return truth, guesses, measured, deviation, q


def run(report, fast):
    """All fits, and a figure of the first; none in the smoke run, as they take long to compile."""
    if fast:
        return {}
    number = RECORDS
    truth, guesses, measured, deviation, exact = records(number)
    weights, fits = jnp.broadcast_to(1 / deviation, exact.shape), []
    for steps in STEPS:
        each = [
            fit_record({key: x[i] for key, x in guesses.items()}, measured[i], weights, steps) for i in range(number)
        ]
        fits.append(jax.tree.map(lambda *x: jnp.stack(x), *each))
        report.progress(f"fits with {steps} steps of a sample")
    off = {key: jnp.log(guess / truth[key]) for key, guess in guesses.items()}
    found = judge(fits[0], fits[1], off) | {
        "truth": truth, "noise_m": deviation.tolist(), "samples": SAMPLES, "steps": [SAMPLES * n for n in STEPS],
        "iterations": int(jnp.max(fits[1].iterations)),
        "cost_per_residual": float(jnp.median(fits[1].cost)) / exact.size,
    }  # fmt: skip
    tell(report, found)
    first = {key: guesses[key][0] * float(jnp.exp(fits[1].params[key][0])) for key in FITTED}
    figure(report, measured[0], first, {key: x[0] for key, x in guesses.items()}, found)
    return found


def figure(report, measured, first, guess, found):
    """A record with the run of its fit and of its guess, and all intervals."""
    scene = SCENES["ball"]
    drawn, axes = subplots(1, 3, width=180, height=70)
    t = np.linspace(0, scene.T, SAMPLES + 1)
    steps = SAMPLES * STEPS[1]
    for j, (panel, name) in enumerate(zip(axes, ("x", "y"), strict=False)):
        panel.plot(t[1:], measured[:, j], ".", ms=2, color=COLOURS[7], label="record")
        for label, params, style in (("guess", guess, "--"), ("fit", first, "-")):
            values: Any = {key: float(x) for key, x in params.items()}
            run = run_of(scene, steps, **values)
            panel.plot(run.t, run.q[:, j], style, color=COLOURS[label == "guess"], lw=1, label=label)
        panel.set(xlabel="time (s)", ylabel=f"{name} (m)")
    for i, (name, numbers) in enumerate(found["over_truth_with_interval"].items()):
        value, low, high = (100 * (np.asarray(x) - 1) for x in numbers)
        place = np.arange(len(value)) + 0.3 * i
        axes[2].errorbar(
            place, value, (value - low, high - value), fmt="os"[i], ms=2, lw=0.8, color=COLOURS[i], label=name
        )
    axes[2].axhline(0, color="black", lw=0.8)
    axes[2].set(xlabel="record", ylabel="estimate against truth (%)")
    for panel in axes[1:]:
        legend(panel)
    report.figure("contact_parameters", drawn)
