"""Tables 3 and 6: time per step as ratios in one run, iterations per step, and error against time."""

import time
from functools import partial

import jax
import numpy as np

from experiments.kim2019 import pendulum
from hhtjax.plot import subplots, work_precision

METHODS = ("implicit Euler", "conventional HHT", "non-iterative HHT", "refreshed", "predictor", "auto")
ALPHA = 0.0  # as in the paper


@partial(jax.jit, static_argnames="method")
def _runs(scene, dt, num_steps, repeats, *, method):
    """The run `repeats` times over, one after the other; num_steps and repeats are traced."""
    stepper = pendulum.METHODS[method](ALPHA)

    def once(_, q0):
        start = stepper.init(scene.system, q0, scene.v0, scene.params, dt)
        state = jax.lax.fori_loop(0, num_steps, lambda i, s: stepper.step(scene.system, s, scene.params, dt)[0], start)
        return scene.q0 + 0 * state.q  # so that no run can be left out

    return jax.lax.fori_loop(0, repeats, once, scene.q0)


def seconds_per_run(scene, method, dt, budget_steps):
    """Wall time of one run, the minimum over five measurements of about budget_steps steps each."""
    num_steps = round(pendulum.SCENES[scene].duration / dt)
    repeats = max(1, budget_steps // num_steps)
    work = partial(_runs, pendulum.SCENES[scene], dt, num_steps, repeats, method=method)
    jax.block_until_ready(work())
    times = []
    for _ in range(5):
        start = time.perf_counter()
        jax.block_until_ready(work())
        times.append(time.perf_counter() - start)
    return min(times) / repeats


def run(report, fast):
    """Time, iterations and error of every method and step size."""
    sizes = pendulum.FAST_STEP_SIZES if fast else pendulum.STEP_SIZES
    numbers = []
    for scene in ("free",) if fast else ("stiff", "free"):
        for method in METHODS[::2][:2] if fast else METHODS:
            for h in sizes:
                errors, iterations = pendulum.rms_errors(scene, method, h)
                seconds = seconds_per_run(scene, method, h, 20_000 if fast else 100_000)
                num_steps = round(pendulum.SCENES[scene].duration / h)
                numbers.append(
                    {
                        "scene": scene,
                        "method": method,
                        "h_s": h,
                        "time_per_step_s": seconds / num_steps,
                        "time_per_run_s": seconds,
                        "iterations_per_step": float(iterations[0]),
                        "rms_error_q1_rad": float(errors[0, 0]),
                        "error_times_time_rad_s": float(errors[0, 0] * seconds),
                    }
                )
        report.progress(f"{scene} pendulum: timed")
    show(report, numbers, sizes)
    report.figure("kim2019_work_precision", figure(numbers))
    return {"alpha": ALPHA, "entries": numbers, "summary": summary(numbers)}


def show(report, numbers, sizes):
    """Times over implicit Euler's, and error times time over its own."""
    by = {(n["scene"], n["method"], n["h_s"]): n for n in numbers}
    for scene, table in (("stiff", "Table 3"), ("free", "Table 6")):
        methods = [m for m in METHODS if (scene, m, sizes[0]) in by]
        if not methods:
            continue
        rows = []
        for h in (h for h in sizes if h in (1e-4, 1e-3, 1e-2, 1e-1)):
            euler = by[scene, "implicit Euler", h]
            for m in methods:
                n = by[scene, m, h]
                ratio, product = (n[key] / euler[key] for key in ("time_per_step_s", "error_times_time_rad_s"))
                rows.append([f"{h:g}", m, 1e9 * n["time_per_step_s"], ratio, n["iterations_per_step"], product])
        print(f"{table}: {scene} double pendulum")
        header = ["h (s)", "method", "ns/step", "time / Euler's", "iterations/step", "error x time / Euler's"]
        report.table(header, rows)


def summary(numbers):
    """Time per step over implicit Euler's and over the non-iterative step's, medians over the step sizes."""
    result = {}
    for scene in dict.fromkeys(n["scene"] for n in numbers):
        times = {}
        for n in numbers:
            if n["scene"] == scene:
                times.setdefault(n["method"], []).append(n["time_per_step_s"])
        times = {m: np.array(t) for m, t in times.items()}
        result[scene] = {
            m: {
                "time_over_implicit_euler": float(np.median(t / times["implicit Euler"])),
                "time_over_non_iterative_hht": float(np.median(t / times["non-iterative HHT"])),
            }
            for m, t in times.items()
        }
    return result


def figure(numbers):
    """RMS error of q1 against the time of one run."""
    scenes = list(dict.fromkeys(n["scene"] for n in numbers))
    drawn, panels = subplots(1, len(scenes), width=175, height=90, squeeze=False)
    for axes, scene in zip(panels[0], scenes, strict=True):
        curves = {}
        for method in METHODS:
            mine = [n for n in numbers if (n["scene"], n["method"]) == (scene, method)]
            x, y = ([n[key] for n in mine] for key in ("time_per_run_s", "rms_error_q1_rad"))
            if mine:
                curves[method if method in METHODS[:3] else f"hht, {method}"] = 1e3 * np.array(x), y
        names = {"xlabel": "time of one run (ms)", "ylabel": "RMS error of $q_1$ (rad)"}
        work_precision(curves, ours=[x for x in curves if x.startswith("hht")], **names, key=False, ax=axes)
        axes.set(title=f"{scene} double pendulum, $\\alpha$ = 0", ylim=(None, 10))
    drawn.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return drawn
