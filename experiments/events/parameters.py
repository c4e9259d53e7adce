"""Restitution and wall, and stiffness, damping and gap of a bump stop, from noisy records through the impacts.

The records are DOP853's motions, solved from event to event, with noise of 1 % of their RMS: each has a noise and
a guess of its own, in which every parameter is a third too large or too small (the wall and the restitution a tenth).
They are fitted with a step and with half of it, and with a mode that is decided by the position instead of an event.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.events.order import by_position
from experiments.events.reference import SCENES, reference
from experiments.identification.coverage import fit_logarithms, judge, tell
from experiments.report import COLOURS, MARKERS
from hhtjax.plot import legend, subplots
from hhtjax.scenes import bump_stop

NOISE, SAMPLES, STEPS = 0.01, 200, (4, 8)
DRIVE = {"wall": 0.2, "W": 2.2}  # a wall with a logarithm; steady impacts
PROBLEMS = {  # scene, changes of its params, what is fitted, guess over truth or its inverse
    "impact oscillator": ("impact oscillator", DRIVE, ("e", "wall"), 1.1),
    "bump stop": ("bump stop", {}, ("K", "C", "gap"), 1.3),
    "bump stop, not located": ("bump stop", {}, ("K", "C", "gap"), 1.3),
}
STEPPER = hhtjax.hht()


@partial(jax.jit, static_argnames=("problem", "steps_per_sample"))
def fit_record(problem, guess, measured, deviation, steps_per_sample):
    """The fit to a record, from the guess; of logarithms over it."""
    name, changed, _, _ = PROBLEMS[problem]
    scene, num_steps = SCENES[name], SAMPLES * steps_per_sample
    located = problem == name
    system = scene.system if located else hhtjax.System(bump_stop.mass, by_position)

    def residuals(fitted):
        run = hhtjax.simulate(
            system, STEPPER, scene.q0, scene.v0, scene.params | changed | fitted, dt=scene.duration / num_steps,
            num_steps=num_steps, save_every=steps_per_sample, events=scene.events if located else None,
        )  # fmt: skip
        return run.q[1:, 0] - measured

    return fit_logarithms(residuals, dict.fromkeys(guess, 0.0), guess, weights=1 / deviation)


def records(problem, number):
    """Truth, guesses, measured q (number, SAMPLES), and the deviation of the noise."""
    name, changed, fitted, off = PROBLEMS[problem]
    q = reference(name, np.linspace(0, SCENES[name].duration, SAMPLES + 1), **changed)[0][1:, 0]
    truth = {key: float((SCENES[name].params | changed)[key]) for key in fitted}
    random, deviation = np.random.default_rng(1), NOISE * float(np.sqrt(np.mean(q**2)))
    measured = q + deviation * random.normal(size=(number, SAMPLES))
    guesses = {key: value * off ** random.choice([-1, 1], number) for key, value in truth.items()}
    return truth, guesses, measured, deviation


def run(report, fast):
    """Fits of all records, and their figure; the smoke run has the first problem, and one program for both fits."""
    number, found = 6 if fast else 100, {}
    for problem in list(PROBLEMS)[:1] if fast else PROBLEMS:
        truth, guesses, measured, deviation = records(problem, number)
        off = {key: jnp.log(guess / truth[key]) for key, guess in guesses.items()}
        fits = []
        for steps_per_sample in STEPS[:1] * 2 if fast else STEPS:
            each = [
                fit_record(problem, {key: x[i] for key, x in guesses.items()}, measured[i], deviation, steps_per_sample)
                for i in range(number)
            ]
            fits.append(jax.tree.map(lambda *x: jnp.stack(x), *each))
            report.progress(f"{problem}, {steps_per_sample} steps of a sample")
        found[problem] = judge(fits[0], fits[1], off) | {
            "truth": truth,
            "noise_m": deviation,
            "h_s": SCENES[PROBLEMS[problem][0]].duration / SAMPLES / STEPS[0],
            "cost_per_residual": float(jnp.median(fits[1].cost)) / SAMPLES,
        }
        print(problem)
        tell(report, found[problem])
    figure(report, found)
    return found


def figure(report, found):
    """Errors of Richardson's values, and how many intervals hold the truth."""
    drawn, axes = subplots(1, 2, width=180, height=90)
    labels = []
    for i, (problem, numbers) in enumerate(found.items()):
        for name, (value, _, _) in numbers["over_truth_with_interval"].items():
            error = 100 * np.abs(np.log(value))
            spread = len(labels) + np.linspace(-0.3, 0.3, error.size)
            label = problem if name == next(iter(numbers["truth"])) else None
            axes[0].semilogy(spread, error, ".", ms=3, color=COLOURS[i], label=label)
            for j, (kind, by) in enumerate(numbers["covered"].items()):
                style = {"color": COLOURS[i], "marker": MARKERS[j], "ms": 4, "ls": "none"}
                label = f"steps: {kind}" if not labels else None
                axes[1].plot(len(labels) + 0.27 * (j - 1), 100 * by[name] / numbers["records"], label=label, **style)
            labels.append(name)
    for panel in axes:
        panel.set_xticks(range(len(labels)), labels)
    axes[0].set_ylabel("error of Richardson's value (%)")
    axes[1].axhline(95, color="black", lw=0.8)
    axes[1].set(ylabel="truth inside the 95 % interval (%)", ylim=(0, 104))
    legend(axes[0])
    legend(axes[1])
    report.figure("events_parameters", drawn)
