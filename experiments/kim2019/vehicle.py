"""The passenger vehicle that Kim et al. announced: error in mm against step size, and how much faster than real time.

A ride over a rough road and a bump, with every method at every step size. The error is the largest, over the sample
times (every 10 ms, or every step if that is longer), of the heights of the body's four corners and of the four wheels.
The real-time factor is simulated seconds per second of one core, in a compiled loop that keeps these samples,
the best of several runs. Nothing on this vehicle is stiff (its fastest rate is the wheel hop's, 80 rad/s), so the
explicit RK4 is the method to beat.
"""

import os
import time
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import hhtjax
from experiments.report import COLOURS, MARKERS
from hhtjax.plot import error_against_h, legend, subplots
from hhtjax.scenes import vehicle

ALPHA = -0.05
METHODS = {
    "implicit Euler": hhtjax.kim_implicit_euler(),
    "Kim's HHT": hhtjax.kim_hht(ALPHA),
    "HHT, converged": hhtjax.hht(ALPHA, iterations=None, tolerance=1e-3),  # N, of loads of some kN
    "HHT, auto": hhtjax.hht(ALPHA),
    "HHT, predictor": hhtjax.hht(ALPHA, linearize="predictor"),
    "RK4": hhtjax.rk4(),
}
NON_ITERATIVE = "HHT, predictor"
IN_FAST = (NON_ITERATIVE,)
STEP_SIZES = (  # s, divisors of 2 s
    *(0.05, 0.025, 0.02, 0.016, 0.0125, 0.01, 0.008, 0.00625, 0.005, 0.004, 0.0025),
    *(2e-3, 1.6e-3, 1e-3, 5e-4, 2.5e-4, 1e-4),
)
SAMPLING_PERIOD = 0.01  # s
ASYMPTOTIC = 1e-3, 4e-3  # s, step sizes between which the slope is taken
GRAVITY = 9.81


@partial(jax.jit, static_argnames="samples")
def simulate_samples(stepper, scene, num_steps, every, samples):
    """q after each `every` steps; a loop with a traced num_steps, so that all step sizes share one compilation."""
    dt = scene.duration / num_steps

    def step(i, carry):
        state, path = carry
        state, _ = stepper.step(scene.system, state, scene.params, dt)
        state = state._replace(t=(i + 1) * dt)
        return state, path.at[i // every].set(state.q)  # the last one to write is the one on time

    start = stepper.init(scene.system, scene.q0, scene.v0, scene.params, dt)
    return jax.lax.fori_loop(0, num_steps, step, (start, jnp.zeros((samples, scene.q0.size))))[1]


def sampling(scene, num_steps):
    """Steps between samples, and the times of the samples."""
    dt = scene.duration / num_steps
    every = int(np.ceil(SAMPLING_PERIOD / dt - 1e-9))
    return every, dt * every * np.arange(1, num_steps // every + 1)


def heights(q, params):
    """Heights of the four corners and the four wheels, (times, 8), in mm; q (times, 7) and params of NumPy."""
    corners = vehicle.corner_heights(q.T[:, :, None], params)
    return 1e3 * np.concatenate([corners, q[:, 3:]], axis=1)


def solve_reference(scene):
    """The motion as a function of the times, (times, 14), by scipy with tight tolerances."""
    rhs = hhtjax.interop.scipy_rhs(scene.system, scene.q0, scene.v0, scene.params)
    options = {"rtol": 1e-10, "atol": 1e-12, "dense_output": True}
    run = solve_ivp(rhs.fun, (0, scene.duration), rhs.y0, "DOP853", **options)
    return lambda times: run.sol(times).T


@contextmanager
def one_core():
    """All threads of this process on one core, where the operating system lets us; yields whether it does."""
    tasks = Path("/proc/self/task")
    if not (hasattr(os, "sched_setaffinity") and tasks.is_dir()):
        yield False
        return
    before = {int(task.name): os.sched_getaffinity(int(task.name)) for task in tasks.iterdir()}
    try:
        for thread in before:
            os.sched_setaffinity(thread, {max(before[thread])})
        yield True
    finally:
        for thread, cores in before.items():
            with suppress(ProcessLookupError):  # it has ended
                os.sched_setaffinity(thread, cores)


def best_time(function, seconds=0.05):
    """Shortest wall time of one call, after one to compile, and the CPU time per wall time of all."""
    jax.block_until_ready(function())
    times, cpu, start = [], time.process_time(), time.perf_counter()
    while len(times) < 3 or time.perf_counter() - start < seconds:
        begin = time.perf_counter()
        jax.block_until_ready(function())
        times.append(time.perf_counter() - begin)
    return min(times), (time.process_time() - cpu) / (time.perf_counter() - start)


def assess(stepper, scene, reference):
    """Error in mm, real-time factor and CPU time per wall time, for each step size."""
    samples = round(scene.duration / SAMPLING_PERIOD)
    params = jax.tree.map(np.asarray, scene.params)
    rows = []
    for h in STEP_SIZES:
        num_steps = round(scene.duration / h)
        every, times = sampling(scene, num_steps)
        drive = partial(simulate_samples, stepper, scene, num_steps, every, samples)
        q, exact = np.asarray(drive())[: len(times)], reference(times)[:, :7]
        error = np.abs(heights(q, params) - heights(exact, params)).max()
        seconds, load = best_time(drive)
        rows.append((error, scene.duration / seconds, load))
    return np.array(rows).T


def summarize(error, factor, load):
    """What the table and the JSON say of one method; largest h: with an error below 1 mm there and at all smaller h."""
    h = np.array(STEP_SIZES)
    inside = (h >= ASYMPTOTIC[0]) & (h <= ASYMPTOTIC[1])
    too_large = np.flatnonzero(~(error < 1))  # NaN is too large
    first = too_large[-1] + 1 if len(too_large) else 0
    found = first < len(h)
    return {
        "slope": float(np.polyfit(np.log(h[inside]), np.log(error[inside]), 1)[0]),
        "largest_h_below_1_mm_s": float(h[first]) if found else None,
        "error_at_it_mm": float(error[first]) if found else None,
        "real_time_factor_at_it": float(factor[first]) if found else None,
        "us_per_step_at_it": float(1e6 * h[first] / factor[first]) if found else None,
        "cpu_time_over_wall_time": float(np.median(load)),
        "error_mm": [float(f"{x:.4g}") if np.isfinite(x) else None for x in error],
        "real_time_factor": [float(f"{x:.4g}") for x in factor],
    }


def library_factor(scene, h):
    """Real-time factor of `hhtjax.simulate` itself, non-iterative, keeping the same samples."""
    num_steps = round(scene.duration / h)
    system, params, q0, v0, _ = scene
    save_every, _ = sampling(scene, num_steps)

    def drive():
        return hhtjax.simulate(
            system, METHODS[NON_ITERATIVE], q0, v0, params, dt=h, num_steps=num_steps, save_every=save_every
        )

    return scene.duration / best_time(drive)[0]


def static_loads(params):
    """Loads of the four wheels at rest, in N, the same left and right."""
    front, rear = params["x"][0], -params["x"][2]
    share = np.array([rear, rear, front, front]) / (2 * (front + rear))
    return GRAVITY * (params["body"][0] * share + params["wheel"])


def lowest_load(scene, times, q):
    """The smallest wheel load of the ride, in N: below zero the tyres would pull."""
    change = jax.jit(jax.vmap(vehicle.tyre, (0, 0, None)))(q[:, 3:], times, scene.params)
    return float(np.min(static_loads(scene.params) + change))


def draw(scene, times, q, errors, factors):
    """The ride, error against step size, and real-time factor against error."""
    figure, axes = subplots(2, 2, width=175, height=150, height_ratios=(2, 3))
    by_step, by_error = axes[1]
    ride = figure.add_subplot(axes[0, 0].get_gridspec()[0, :])
    for panel in axes[0]:
        panel.remove()
    height = heights(q, jax.tree.map(np.asarray, scene.params))
    ride.plot(times, 1e3 * scene.params["road"](times)[:, 0], color="0.6", lw=1, label="road")
    ride.plot(times, height[:, 4], color=COLOURS[1], lw=1, ls="--", label="wheel")
    ride.plot(times, height[:, 0], color=COLOURS[0], label="body")
    ride.set(xlabel="time (s)", ylabel="height, front left (mm)", xlim=(0, scene.duration))
    legend(ride)

    h, lines = 1e3 * np.array(STEP_SIZES), {}
    for i, (name, error) in enumerate(errors.items()):
        size = {"HHT, converged": 8, "HHT, auto": 5.5}.get(name, 3.5)  # these and the predictor lie on each other
        style = {
            "color": COLOURS[i],
            "marker": MARKERS[i],
            "ms": size,
            "lw": 1.2,
            "ls": "-",
            "mfc": "none" if size > 5 else None,
        }
        lines[name] = style
        by_error.loglog(error, factors[name], **style)
    curves = {
        name: (h, np.where(error > 1e-6, error, np.nan)) for name, error in errors.items()
    }  # what is in the picture
    error_against_h(curves, lines=lines, slopes=(1, 2, 4), key=False, ax=by_step)
    by_step.axhline(1, color="black", ls=":")
    by_error.axvline(1, color="black", ls=":")
    by_error.axhline(1000, color="black", ls=":")
    by_step.set(xlabel="step size (ms)", ylabel="largest error (mm)", ylim=(1e-6, 100))
    by_error.set(xlabel="largest error (mm)", ylabel="real-time factor, one core", xlim=(1e-4, 100))
    figure.legend(*by_step.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


def run(report, fast):
    """Errors and real-time factors of all methods."""
    scene = vehicle.ride(duration=2.0 if fast else 4.0)
    reference = solve_reference(scene)
    times = np.linspace(0, scene.duration, 2001)
    q = reference(times)[:, :7]
    report.progress("vehicle: reference by scipy")
    measured = {}
    with one_core() as pinned:
        for name in IN_FAST if fast else METHODS:
            measured[name] = assess(METHODS[name], scene, reference)
            report.progress(f"vehicle: {name}")
        summary = {name: summarize(*rows) for name, rows in measured.items()}
        best = summary[NON_ITERATIVE]["largest_h_below_1_mm_s"]
        by_library = None if fast or best is None else library_factor(scene, best)
    load = lowest_load(scene, times, q)
    print(
        f"Passenger vehicle, 7 degrees of freedom, {scene.duration:g} s over a class B road and a bump at 10 m/s; "
        f"lowest wheel load {load:.0f} N.\n"
        "Largest step size with an error below 1 mm, and what it takes on one core.\n"
    )
    keys = "largest_h_below_1_mm_s", "error_at_it_mm", "us_per_step_at_it", "real_time_factor_at_it", "slope"
    report.table(
        ["method", "h s", "error mm", "us/step", "x real time", "slope"],
        [[name, *("-" if x[key] is None else x[key] for key in keys)] for name, x in summary.items()],
    )
    errors, factors = ({name: rows[i] for name, rows in measured.items()} for i in (0, 1))
    report.figure("kim2019_vehicle", draw(scene, times, q, errors, factors))
    return {
        "duration_s": scene.duration,
        "step_sizes_s": STEP_SIZES,
        "lowest_wheel_load_N": load,
        "reference_check_mm": None if fast else float(measured["RK4"][0, -1]),
        "pinned_to_one_core": pinned,
        "simulate_real_time_factor": by_library,
        "methods": summary,
    }
