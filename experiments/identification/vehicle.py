"""Tyre and damper of a vehicle from noisy accelerations: 6 parameters of the ride model, over many noise records.

The car of `scenes.vehicle` drives over a road of class B with a bump; the accelerations of its body and its wheels are
measured, with noise of 5 % of their RMS. Stiffness of the tyres and damping at rest, front and rear, and the damper's
speed v0 of saturation and asymmetry r are unknown and guessed 2 times too large or too small; masses, springs and road
are known. The estimate is scored on another road at a higher speed.
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
from hhtjax.scenes import vehicle

SCENE, OTHER_ROAD = vehicle.ride(), vehicle.ride(speed=15.0, seed=1)
TRUTH = {"k_tyre front": 200e3, "k_tyre rear": 200e3, "c front": 2000.0, "c rear": 1900.0, "v0": 0.4, "r": 0.4}
UNITS = {"k_tyre front": "N/m", "k_tyre rear": "N/m", "c front": "N s/m", "c rear": "N s/m", "v0": "m/s", "r": "1"}
GUESS = {name: value * factor for (name, value), factor in zip(TRUTH.items(), (2, 0.5, 2, 0.5, 2, 0.5), strict=True)}
SAMPLING_PERIOD = 5e-3  # s
NOISE = 0.05  # of the RMS of each channel
# without numerical damping, whose error of h^3 Richardson's value of two fits keeps
STEPPER: Any = hhtjax.hht(alpha=0.0, linearize="predictor")
CHANNELS = ("heave", "pitch", "roll", "wheel, front left", "front right", "rear left", "rear right")


def accelerations(params, steps_per_sample, scene=SCENE, stepper=STEPPER):
    """(samples, 7): of the body in heave, pitch and roll, and of the wheels."""
    ends = {name: jnp.stack([params[f"{name} front"]] * 2 + [params[f"{name} rear"]] * 2) for name in ("k_tyre", "c")}
    steps = round(scene.duration / SAMPLING_PERIOD) * steps_per_sample
    run = hhtjax.simulate(
        scene.system, stepper, scene.q0, scene.v0, scene.params | ends | {name: params[name] for name in ("v0", "r")},
        dt=SAMPLING_PERIOD / steps_per_sample, num_steps=steps, save_every=steps_per_sample,
    )  # fmt: skip
    return run.acceleration


@partial(jax.jit, static_argnames="steps_per_sample")
@partial(jax.vmap, in_axes=(0, None, None))
def fit_record(measured, deviation, steps_per_sample):
    """The fit to one noisy record, from the guess."""
    zero = dict.fromkeys(TRUTH, 0.0)
    weights = jnp.broadcast_to(1 / deviation, measured.shape)
    return fit_logarithms(lambda p: accelerations(p, steps_per_sample) - measured, zero, GUESS, weights=weights)


def run(report: Report, fast: bool):
    """Fits, coverage, and the score on the other road."""
    records = 4 if fast else 40
    exact = jax.jit(lambda: accelerations(TRUTH, 40, stepper=hhtjax.rk4()))()
    deviation = NOISE * jnp.sqrt(jnp.mean(exact**2, axis=0))
    measured = exact + deviation * jax.random.normal(jax.random.key(0), (records, *exact.shape))
    steps = (2,) if fast else (2, 4)
    fits = []
    for n in steps:
        fits.append(jax.block_until_ready(fit_record(measured, deviation, n)))
        report.progress(f"{records} fits with {n} steps per sample")
    off = {name: jnp.log(GUESS[name] / TRUTH[name]) for name in TRUTH}
    numbers: dict[str, Any] = judge(fits[0], fits[-1], off) | {
        "steps_per_sample": steps,
        "noise": NOISE,
        "records": records,
    }
    tell(report, numbers)
    estimate = {name: value * float(jnp.exp(fits[-1].params[name][0])) for name, value in GUESS.items()}
    found = {}
    for kind, params in {"estimate": estimate, "guess": GUESS, "truth": TRUTH}.items():
        stepper = hhtjax.rk4() if kind == "truth" else STEPPER
        n = 40 if kind == "truth" else steps[-1]
        found[kind] = np.asarray(jax.jit(partial(accelerations, params, n, OTHER_ROAD, stepper))())
    size = np.sqrt(np.mean(found["truth"] ** 2, axis=0))
    for kind in ("estimate", "guess"):
        error = np.sqrt(np.mean((found[kind] - found["truth"]) ** 2, axis=0)) / size
        numbers[f"other_road_error_of_{kind}"] = dict(zip(CHANNELS, error.tolist(), strict=True))
    header = ["other road, error / RMS", *CHANNELS]
    report.table(header, [[k, *numbers[f"other_road_error_of_{k}"].values()] for k in ("estimate", "guess")])
    plot(report, numbers, found)
    report.numbers(rounded(numbers))


def plot(report, numbers, found):
    """Intervals of all records, and a wheel on the other road."""
    figure, (left, right) = subplots(1, 2, width=175, height=75, width_ratios=(2, 3))
    for i, values in enumerate(numbers["over_truth_with_interval"].values()):
        value, lower, upper = 100 * (np.array(values) - 1)
        at = i + np.linspace(-0.3, 0.3, len(value))
        left.errorbar(at, value, [value - lower, upper - value], fmt="o", ms=2, lw=0.7, color=COLOURS[i])
    left.axhline(0, color="black", lw=0.8)
    left.set_xticks(range(len(TRUTH)), [name.replace(" ", "\n") for name in TRUTH])
    left.set_ylabel("estimate less truth, with its 95 % interval (%)")
    t = SAMPLING_PERIOD * np.arange(len(found["truth"]))
    part = (t > 1.0) & (t < 2.6)
    for (kind, a), colour, width in zip(
        found.items(), (COLOURS[1], COLOURS[0], "#808080"), (0.8, 0.8, 2.0), strict=True
    ):
        right.plot(
            t[part],
            a[part, 3],
            color=colour,
            lw=width,
            ls=":" if kind == "guess" else "-",
            label=kind,
            zorder=4 - width,
        )
    right.set(xlabel="time on the other road (s)", ylabel="acceleration of the front left wheel (m/s²)")
    legend(right)
    report.figure("vehicle", figure)
