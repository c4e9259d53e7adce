"""From data to C: the joints of a double pendulum identified from noisy angles, exported, and run beside Python."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.benchmarks import native
from experiments.export.native_model import Run
from hhtjax.plot import legend, subplots
from hhtjax.scenes import double_pendulum

TRUTH = {"k": (20.0, 10.0), "c": (0.5, 0.3)}  # N m/rad, N m s/rad
GUESS = {"k": (40.0, 5.0), "c": (1.0, 0.1)}
NOISE = 2e-3  # rad
RATE, DURATION = 100.0, 4.0  # 1/s, s
DT = 1e-3  # s, the step of the controller
STEPPER = hhtjax.hht(-0.05, linearize="predictor")


def scene():
    """Springs and dampers in its joints; let go from rest."""
    found = double_pendulum.free()
    return found._replace(params=found.params | TRUTH, q0=jnp.array([1.0, -0.5]))


def angles(joints, num_samples, stepper, steps):
    """(samples, 2), after the start."""
    own = scene()
    run = hhtjax.simulate(
        own.system, stepper, own.q0, own.v0, own.params | joints, dt=1 / RATE / steps,
        num_steps=num_samples * steps, save_every=steps,
    )  # fmt: skip
    return run.q[1:]


def identify(fast):
    """The measured angles, generated, and what fits them."""
    num_samples = round(RATE * DURATION) // (4 if fast else 1)
    exact = angles(TRUTH, num_samples, hhtjax.hht(0.0, iterations=None), 16)
    measured = exact + NOISE * jax.random.normal(jax.random.key(0), exact.shape)
    positive = jax.tree.map(lambda _: hhtjax.positive, GUESS)

    def residuals(joints):
        return angles(joints, num_samples, STEPPER, 4) - measured

    return measured, hhtjax.fit(residuals, GUESS, transforms=positive, weights=1 / NOISE)


def fitted(fast):
    """The scene with the joints that were found, the measured angles, and their errors relative to the truth."""
    measured, result = identify(fast)
    errors = jax.tree.map(lambda x, y: float(x / y - 1), result.params, TRUTH)
    joints = jax.tree.map(float, result.params)
    own = scene()
    return own._replace(params=own.params | joints), measured, errors


def run(report, fast):
    """Identification, export, and both trajectories."""
    own, measured, errors = fitted(fast)
    report.table(
        ["joint", "true", "found, relative error"],
        [[f"{key}{i + 1}", TRUTH[key][i], errors[key][i]] for key in TRUTH for i in (0, 1)],
    )
    numbers = {"data": "generated", "num_samples": len(measured), "relative_error_of": errors, "noise_rad": NOISE}
    if native.compiler() is None:
        print("No C compiler: nothing is compiled.", flush=True)
        return numbers
    num_steps = 1000 if fast else 10_000
    ours = Run(own, STEPPER, DT, num_steps)
    flags = ours(path=True)
    python = jax.jit(partial(hhtjax.simulate, own.system, STEPPER, dt=DT, num_steps=num_steps))
    path = np.asarray(python(own.q0, own.v0, own.params).q)[1:, 0]
    difference = float(np.max(abs(ours.path - path)))
    print(f"{num_steps} steps in C and in Python: at most {difference:.1e} rad apart, flags {flags}.\n")
    report.figure("export_trajectories", figure(ours.path, path, np.asarray(measured)))
    return numbers | {
        "num_steps": num_steps, "flags": flags, "difference_rad": difference, "operations": ours.model.operations,
        "functions": ours.model.functions, "lines": ours.model.source.count("\n"),
    }  # fmt: skip


def figure(c, python, measured):
    """The first angle, measured, in C and in Python; how far apart the two are."""
    drawn, (left, right) = subplots(1, 2, width=175, height=80)
    t, samples = DT * np.arange(1, 1 + len(c)), np.arange(1, 1 + len(measured)) / RATE
    shown = t <= samples[-1]
    left.plot(samples, measured[:, 0], ".", ms=2, color="0.6", label="measured (generated)")
    left.plot(t[shown], c[shown], label="C")
    left.plot(t[shown], python[shown], "--", label="Python")
    left.set(xlabel="time (s)", ylabel="first angle (rad)")
    legend(left)
    right.plot(t, abs(c - python))
    right.set(xlabel="time (s)", ylabel="|C - Python| (rad)")
    return drawn
