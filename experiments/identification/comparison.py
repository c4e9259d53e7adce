"""Silverbox, 6 parameters: the same fit by others, and from starts that are 2 and 3 times off in every parameter.

All minimise the same sum of squares, with 8 steps per sample; diffrax solves the same equation with 8 fixed steps of
its own per sample. Times are warm, of one run after the other.
"""

import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.flatten_util import ravel_pytree
from scipy.optimize import least_squares

import hhtjax
from experiments.identification import data
from experiments.identification.data import SAMPLING_RATE, Record
from experiments.identification.silverbox import SUBSTEPS, fit_training
from experiments.report import Report

PIECE = 16384  # samples, of the comparison with the others
PERIOD = 9  # samples
FAR = {
    "3 times off": (3.0, 5, 0),
    "3 times off, others": (3.0, 20, 1),
    "2 times off": (2.0, 20, 2),
}  # factor, starts, seed
SAME = 1.001  # cost over the least one found, below which it counts as the same


def problem(record: Record):
    """residuals(unknown), a function of a vector x = unknown/scale, and its start."""
    residuals = data.training_residuals(record, SUBSTEPS, 0.0)
    guess = {name: data.START.get(name, 0.0) for name in data.LINEAR}, data.first_state(record)
    scale, unravel = ravel_pytree((data.SCALE_OF_LINEAR, data.STATE_SCALE))
    return jax.jit(lambda x: residuals(unravel(scale * x))), ravel_pytree(guess)[0] / scale, unravel(scale)


def warm(function):
    """Result and seconds of the second call."""
    jax.block_until_ready(function())
    begin = time.perf_counter()
    result = jax.block_until_ready(function())
    return result, time.perf_counter() - begin


def by_scipy(residuals, x0):
    """SciPy with its 2-point Jacobian: cost, seconds, simulations."""
    calls = []

    def f(x):
        calls.append(None)
        return np.asarray(residuals(x))

    f(np.asarray(x0))
    begin = time.perf_counter()
    found = least_squares(f, np.asarray(x0), max_nfev=50)
    return float(found.cost), time.perf_counter() - begin, len(calls)


def by_optax(residuals, x0, optimizer, iterations):
    """Reverse-mode gradients: cost and seconds."""
    result, seconds = warm(
        lambda: hhtjax.fit(residuals, x0, optimizer, max_iterations=iterations, tolerance=1e-10, covariance=False)
    )
    return float(result.cost), seconds


def by_optimistix(optimistix, residuals, x0):
    """Levenberg-Marquardt of optimistix: cost and seconds."""

    @jax.jit
    def solve(x0):
        solver = optimistix.LevenbergMarquardt(rtol=1e-8, atol=1e-8)
        found = optimistix.least_squares(lambda x, _: residuals(x), solver, x0, max_steps=100, throw=False)
        return jnp.sum(residuals(found.value) ** 2) / 2

    cost, seconds = warm(lambda: solve(x0))
    return float(cost), seconds


def diffrax_residuals(diffrax, record: Record, scales):
    """The residual through diffrax's Tsit5 instead, differentiable by its default adjoint."""
    u, y = data.reconstruct(record.u), jnp.asarray(record.y)
    _, unravel = ravel_pytree(scales)
    flat = ravel_pytree(scales)[0]
    times = jnp.arange(len(y)) / SAMPLING_RATE

    def rate(t, state, args):
        q, v = state
        return v, data.force(q, v, t, args) / args[0]["m"]

    @jax.jit
    def residuals(x):
        params, start = unravel(flat * x)
        found = diffrax.diffeqsolve(
            diffrax.ODETerm(rate), diffrax.Tsit5(), 0.0, times[-1], 1 / SAMPLING_RATE / SUBSTEPS,
            (start["y"], start["v"]), (params, u), saveat=diffrax.SaveAt(ts=times),
            stepsize_controller=diffrax.ConstantStepSize(), max_steps=SUBSTEPS * len(y) + 8,
        )  # fmt: skip
        return found.ys[0] - y

    return residuals


def others(report, train):
    """Cost and time of each on a piece of the record."""
    piece = Record(train.u[:PIECE], train.y[:PIECE])
    residuals, x0, scales = problem(piece)
    result, seconds = warm(lambda: hhtjax.fit(residuals, x0, covariance=False))
    rows = [["hhtjax.fit, Levenberg-Marquardt", float(result.cost), seconds]]
    cost, seconds, _ = by_scipy(residuals, x0)
    rows.append(["SciPy least_squares, 2-point", cost, seconds])
    for name, optimizer, iterations in (("lbfgs", optax.lbfgs(), 200), ("adam", optax.adam(0.02), 300)):
        report.progress(f"the step of hhtjax with optax.{name}")
        rows.append(
            [f"hhtjax.fit, optax.{name}, {iterations} iterations", *by_optax(residuals, x0, optimizer, iterations)]
        )
    try:
        import optimistix  # pyright: ignore[reportMissingImports]  # of an extra of its own

        report.progress("optimistix")
        rows.append(["optimistix LevenbergMarquardt", *by_optimistix(optimistix, residuals, x0)])
    except ImportError:
        print("optimistix is not installed.")
    try:
        import diffrax  # pyright: ignore[reportMissingImports]  # of an extra of its own

        report.progress("diffrax")
        theirs = diffrax_residuals(diffrax, piece, scales)
        rows.append(["diffrax Tsit5 with optax.adam, 10 iterations", *by_optax(theirs, x0, optax.adam(0.02), 10)])
    except ImportError:
        print("diffrax is not installed.")
    report.table([f"{PIECE} samples", "cost V^2", "s"], rows)
    return [{"method": name, "cost_in_V^2": cost, "seconds": seconds} for name, cost, seconds in rows]


def far_starts(report, train, estimate):
    """Starts with each parameter of the estimate times a factor or over it: how many reach the least cost, how fast.

    By a part that grows, from one period, 5 and 50 to the whole; and by windows of half a period and then one, all over
    the record and with initial states of their own, before the whole.
    """
    piece, initial = Record(train.u[:PIECE], train.y[:PIECE]), data.first_state(train)
    parts = {
        n: data.training_residuals(Record(train.u[:n], train.y[:n]), SUBSTEPS, 0.0)
        for n in (PERIOD, 5 * PERIOD, 50 * PERIOD, PIECE)
    }
    windows = {n: data.windows_problem(piece, n, SUBSTEPS, 0.0) for n in (PERIOD // 2, PERIOD)}
    residuals = parts[PIECE]
    positive = {name: hhtjax.positive if name in ("m", "c", "k") else None for name in estimate}
    options = {"transforms": (positive, None), "scale": (data.SCALE_OF_LINEAR, data.STATE_SCALE), "covariance": False}
    of_windows = {"transforms": positive, "scale": data.SCALE_OF_LINEAR, "covariance": False}
    least = float(hhtjax.fit(residuals, (estimate, initial), **options).cost)
    flat, unravel = ravel_pytree((data.SCALE_OF_LINEAR, data.STATE_SCALE))
    scaled = jax.jit(lambda x: residuals(unravel(flat * x)))

    def alone(start):
        return hhtjax.fit(residuals, (start, initial), **options)

    def growing(start):
        return hhtjax.fit_progressively(lambda n, _: {"residuals": parts[n]}, (start, initial), list(parts), **options)

    def windowed(start):
        return alone(hhtjax.fit_progressively(lambda n, _: windows[n], start, list(windows), **of_windows).params)

    def ours(solve):
        def cost_and_seconds(start):
            result, seconds = warm(partial(solve, start))
            return float(result.cost), seconds

        return cost_and_seconds

    solvers = {
        "hhtjax.fit at once": ours(alone),
        "hhtjax.fit_progressively, a growing part": ours(growing),
        "hhtjax.fit_progressively, windows": ours(windowed),
        "SciPy least_squares, 2-point": lambda start: by_scipy(scaled, ravel_pytree((start, initial))[0] / flat)[:2],
    }
    counts = {}
    for name, (factor, count, seed) in FAR.items():
        signs = np.random.default_rng(seed).choice([-1.0, 1.0], (count, len(estimate)))
        starts = [{n: x * factor**s for (n, x), s in zip(estimate.items(), sign, strict=True)} for sign in signs]
        report.progress(f"starts {name}")
        counts[name] = {}
        for solver, solve in solvers.items():
            costs, seconds = zip(*map(solve, starts), strict=True)
            right = sum(cost <= SAME * least for cost in costs)
            counts[name][solver] = {"right": right, "of": count, "slowest_s": max(seconds)}
        report.table(
            [f"{name}, {PIECE} samples", "reach the least cost", "slowest, s"],
            [[solver, f"{c['right']} of {count}", c["slowest_s"]] for solver, c in counts[name].items()],
        )
    return counts


def whole_record(report, train):
    """SciPy and hhtjax on the whole training record: costs and seconds, twice in turns, the least."""
    residuals, x0, _ = problem(train)
    times, ours_times = [], []
    for _ in range(2):
        result, seconds = warm(lambda: hhtjax.fit(residuals, x0, covariance=False))
        ours_times.append(seconds)
        cost, seconds, simulations = by_scipy(residuals, x0)
        times.append(seconds)
    numbers = {
        "fit_time_s": min(ours_times), "cost_in_V^2": float(result.cost), "iterations": int(result.iterations),
        "scipy_s": min(times), "scipy_cost_in_V^2": cost, "scipy_simulations": simulations,
    }  # fmt: skip
    print(
        f"SciPy least_squares, 2-point Jacobian: cost {cost:.6g} V^2 in {min(times):.2f} s, {simulations} simulations;"
    )
    print(f"hhtjax.fit: cost {float(result.cost):.6g} V^2 in {min(ours_times):.2f} s (both without compiling).\n")
    return numbers


def run(report: Report, fast: bool):
    """The whole record; not if fast, a piece of it by everybody, and from far away."""
    sets = data.load(fast)
    print(f"Silverbox, {'measured' if sets.measured else 'GENERATED'} record.")
    numbers = {"data": "measured" if sets.measured else "generated", "whole_record": whole_record(report, sets.train)}
    if not fast:
        result, *_ = fit_training(sets.train, SUBSTEPS, 0.0)
        estimate = {name: float(value) for name, value in result.params[0].items()}
        numbers |= {"others": others(report, sets.train), "far_starts_samples": PIECE}
        numbers["far_starts"] = far_starts(report, sets.train, estimate)
    report.numbers(numbers)
