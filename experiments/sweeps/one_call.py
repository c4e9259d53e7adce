"""31 step sizes, 1e-4 to 1e-1 s, in one compiled call, against 31 calls of `simulate`: compilation and run."""

import time

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.benchmarks.measure import least_seconds
from hhtjax import trigonometry
from hhtjax.scenes import double_pendulum

STEPPER = hhtjax.hht(-0.05, linearize="predictor")
DURATION, SAMPLES = 5.0, 50


def timed(function):
    """Its result, and the seconds of a first call."""
    start = time.perf_counter()
    result = jax.block_until_ready(function())
    return result, time.perf_counter() - start


def run(report, fast):
    """Double pendulum, polynomial sines, free."""
    system, params, q0, v0, _ = double_pendulum.free(trigonometry)
    dts = np.logspace(-4, -1, 31) if not fast else np.logspace(-2, -1, 2)

    def together():
        return hhtjax.sweep(
            system, STEPPER, q0, v0, params, dts=dts, duration=DURATION, num_samples=SAMPLES
        )  # fmt: skip

    jax.clear_caches()
    runs, first_s = timed(together)
    used = [float(h) for h in runs.dt]

    def alone(h):
        n = round(DURATION / h)
        return hhtjax.simulate(system, STEPPER, q0, v0, params, dt=h, num_steps=n, save_every=n // SAMPLES)

    firsts, difference = [], 0.0
    for i, h in enumerate(used):
        one, seconds = timed(lambda h=h: alone(h))
        firsts.append(seconds)
        if h <= 0.01:
            difference = max(difference, float(jnp.max(abs(one.q - runs.q[i]))))
    report.progress(f"one call: first {first_s:.1f} s, first calls one by one {sum(firsts):.1f} s")
    functions = {"together": together} | {str(i): lambda h=h: alone(h) for i, h in enumerate(used)}
    times = least_seconds(functions, 1 if fast else 9)
    separate = sum(times[str(i)] for i in range(len(used)))
    steps = float(np.sum(DURATION / np.array(used)))
    numbers = {
        "members": len(used),
        "steps": steps,
        "compile_s": first_s - times["together"],
        "compile_separately_s": sum(firsts) - separate,
        "run_s": times["together"],
        "run_separately_s": separate,
        "largest_difference_rad": difference,
    }
    numbers["compile_ratio"] = numbers["compile_s"] / numbers["compile_separately_s"]
    numbers["run_ratio"] = numbers["run_s"] / separate
    print("One compiled call against one for each step size\n")
    report.table(["", "together", "separately", "ratio"], [
        ["compilation (s)", numbers["compile_s"], numbers["compile_separately_s"], numbers["compile_ratio"]],
        ["run (ms)", 1e3 * times["together"], 1e3 * separate, numbers["run_ratio"]],
    ])  # fmt: skip
    return numbers
