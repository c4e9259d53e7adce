"""The methods on a six-axis arm: two formulations of it, error against step size and time."""

import time
from functools import partial

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from scipy.integrate import solve_ivp

from experiments.report import COLOURS, side_by_side
from hhtjax import hht, kim_hht, kim_implicit_euler
from hhtjax.plot import error_against_h, subplots, work_precision
from hhtjax.scenes import arm
from hhtjax.systems.system import mass_at

ALPHA = -0.05
METHODS = {
    "implicit Euler, as printed": kim_implicit_euler(),
    "non-iterative HHT, as printed": kim_hht(ALPHA),
    "hht, converged": hht(ALPHA, iterations=None),
    "hht, predictor": hht(ALPHA, linearize="predictor"),
    "hht, auto": hht(ALPHA),
}
FAST_METHODS = ("hht, predictor",)
FORMULATIONS = {"Newton-Euler": arm.mechanism().system, "Lagrange": arm.lagrange()}
SAMPLES = 20  # times at which q is compared; every number of steps is a multiple
COMPARED_STEPS = 320  # of the run that is made with both formulations


@partial(jax.jit, static_argnames="stepper")
def path(scene, num_steps, stepper):
    """q at the sample times, (SAMPLES, N), and how often Newton failed; num_steps is traced, so compiled once."""
    dt = scene.duration / num_steps

    def step(i, carry):
        state, q, failures = carry
        state, info = stepper.step(scene.system, state, scene.params, dt)
        q = q.at[i * SAMPLES // num_steps].set(state.q)  # the last one to write is the one on time
        return state, q, failures + (0 if info.converged is None else ~info.converged)

    start = stepper.init(scene.system, scene.q0, scene.v0, scene.params, dt)
    return jax.lax.fori_loop(0, num_steps, step, (start, jnp.zeros((SAMPLES, scene.q0.size)), 0))[1:]


def compile_paths(scenes):
    """`path` compiled for each of {name: (scene, stepper)}."""

    def compile_one(scene, stepper):
        return path.lower(scene, SAMPLES, stepper).compile()

    return dict(zip(scenes, side_by_side([partial(compile_one, *x) for x in scenes.values()]), strict=True))


def seconds(function, *arguments, repeats):
    """The least time of a few calls."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        times.append(time.perf_counter() - start)
    return min(times)


def relative_difference(x, y):
    """Largest difference, over the largest entry."""
    return float(np.max(np.abs(x - y)) / np.max(np.abs(y)))


def solve_reference(scene, evaluate):
    """q at the sample times by LSODA: DOP853 needs seven times as many evaluations, for stability's sake.

    evaluate: (q, v) -> (M, Q).
    """
    n = scene.q0.size
    times = np.linspace(0, scene.duration, SAMPLES + 1)[1:]

    def rate(t, y):
        M, Q = evaluate(y[:n], y[n:])
        return np.concatenate([y[n:], np.linalg.solve(M, Q)])

    y0 = np.concatenate([scene.q0, scene.v0])
    return solve_ivp(rate, (0, scene.duration), y0, "LSODA", times, rtol=1e-10, atol=1e-12).y[:n].T


def compare_formulations(scene, states):
    """M and Q of the two at random states: compiled functions (q, v) -> (M, Q), and numbers for the report."""
    q, v = np.random.default_rng(0).uniform(-3.0, 3.0, (2, states, scene.q0.size))
    compiled, compile_s, values = {}, {}, []
    for name, system in FORMULATIONS.items():

        def evaluate(q, v, system=system):
            return mass_at(system, q, 0.0, scene.params), system.force(q, v, 0.0, scene.params)

        start = time.perf_counter()
        compiled[name] = jax.jit(evaluate).lower(scene.q0, scene.v0).compile()
        compile_s[name] = time.perf_counter() - start
        values.append([np.stack(x) for x in zip(*map(compiled[name], q, v), strict=True)])
    M, Q = (relative_difference(*x) for x in zip(*values, strict=True))
    return compiled, {"M_relative_difference": M, "Q_relative_difference": Q, "compile_M_and_Q_s": compile_s}


def measure(program, scene, sizes, exact, repeats):
    """RMS error over the sample times and joints, observed orders, and times, by number of steps."""
    errors, times = [], []
    for num_steps in sizes:
        q, failures = program(scene, num_steps)
        if failures:
            raise RuntimeError(f"Newton failed in {failures} of {num_steps} steps.")
        errors.append(float(np.sqrt(np.mean((q - exact) ** 2))))
        times.append(seconds(program, scene, num_steps, repeats=repeats))
    return {
        "rms_error_rad": errors,
        "observed_orders": np.log2(np.array(errors[:-1]) / errors[1:]).tolist(),
        "time_per_run_s": times,
        "time_per_step_s": times[-1] / sizes[-1],
    }


def compare_runs(programs, scene, other):
    """One run with each formulation: how far apart they end up, and time per step."""
    runs = (programs["hht, predictor"], scene, COMPARED_STEPS), (programs["Lagrange"], other, COMPARED_STEPS)
    (q, _), (again, _) = (program(*arguments) for program, *arguments in runs)
    by_hand, by_autodiff = (seconds(*run, repeats=5) for run in runs)
    return {"run_relative_difference": relative_difference(q, again), "lagrange_step_time_ratio": by_autodiff / by_hand}


def run(report, fast):
    """Agreement of the formulations; error, order and time of every method; the motion."""
    scene = arm.swing()
    evaluate, numbers = compare_formulations(scene, 20 if fast else 200)
    report.progress("M and Q differ by {M_relative_difference:.1e} and {Q_relative_difference:.1e}".format(**numbers))
    exact = solve_reference(scene, evaluate["Lagrange"])

    methods = FAST_METHODS if fast else METHODS
    tasks = {method: (scene, METHODS[method]) for method in methods}
    other = scene._replace(system=arm.lagrange())
    if not fast:
        difference = np.max(np.abs(exact - solve_reference(scene, evaluate["Newton-Euler"])))
        numbers["reference_difference_rad"] = float(difference)
        report.progress(f"LSODA with either formulation: {difference:.1e} rad apart")
        tasks["Lagrange"] = (other, METHODS["hht, predictor"])
    programs = compile_paths(tasks)
    report.progress(f"{len(programs)} programs compiled")

    sizes = [SAMPLES * 2**i for i in ((3, 4) if fast else range(7))]
    numbers["step_sizes_s"] = [scene.duration / n for n in sizes]
    numbers["entries"] = [{"method": x} | measure(programs[x], scene, sizes, exact, 1 if fast else 2) for x in methods]
    if not fast:
        numbers |= compare_runs(programs, scene, other)
    report.progress("all methods run")
    print_tables(report, numbers)
    report.figure("kim2019_arm", figure(scene, exact, numbers))
    return numbers


def print_tables(report, numbers):
    """The formulations compared; the methods compared."""
    lines = {
        "M, relative difference of the formulations": "M_relative_difference",
        "Q": "Q_relative_difference",
        "q of a run": "run_relative_difference",
        "time per step of hht, Lagrange / Newton-Euler": "lagrange_step_time_ratio",
    }
    report.table(["arm, two formulations", ""], [[text, numbers[x]] for text, x in lines.items() if x in numbers])
    h, fastest = numbers["step_sizes_s"], min(e["time_per_step_s"] for e in numbers["entries"])
    shown = range(0, len(h), 2)
    rows = []
    for e in numbers["entries"]:
        errors = [e["rms_error_rad"][i] for i in shown]
        rows.append([e["method"], *errors, e["observed_orders"][-1], e["time_per_step_s"] / fastest])
    print("Arm: RMS error of q (rad) by step size, order at the finest, time per step over the least")
    report.table(["method", *(f"h = {h[i]:.2g} s" for i in shown), "order", "time"], rows)


def figure(scene, exact, numbers):
    """The motion from above and from the side; error against step size and against time."""
    drawn, axes = subplots(2, 2, width=175, height=140, height_ratios=(1, 2))
    draw_motion(axes[0], scene, exact)
    by_step, by_time = axes[1]
    h = np.array(numbers["step_sizes_s"])
    fastest = min(e["time_per_step_s"] for e in numbers["entries"])
    errors = {e["method"]: np.array(e["rms_error_rad"]) for e in numbers["entries"]}
    times = {e["method"]: np.array(e["time_per_run_s"]) / fastest for e in numbers["entries"]}
    lines = {
        name: {"ls": ":" if "printed" in name else "-", "lw": 1, "mfc": "none" if i > 2 else None}
        for i, name in enumerate(errors)
    }
    error_against_h({name: (h, x) for name, x in errors.items()}, lines=lines, key=False, ax=by_step)
    work_precision({name: (times[name], x) for name, x in errors.items()}, lines=lines, key=False, ax=by_time)
    by_time.set_xlabel("time of the run / least time of a step")
    for axes in (by_step, by_time):
        axes.set_ylabel("RMS error of q (rad)")
    drawn.legend(*by_step.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return drawn


def draw_motion(panels, scene, q):
    """The links at every second sample time, from light to dark, and the path of the tool."""

    @jax.jit
    @jax.vmap
    def corners(q):
        frames = list(arm.mechanism().frames(q, scene.params).values())
        tool = frames[-1].x + frames[-1].R @ scene.params["com"][-1]
        return jnp.stack([*(frame.x for frame in frames), tool])

    places = np.asarray(corners(jnp.concatenate([scene.q0[None], q])))
    for axes, down, label, place in zip(panels, (1, 2), "yz", ("above", "the side"), strict=True):
        for chain, shade in zip(places[::2], np.linspace(0.25, 1.0, SAMPLES // 2 + 1), strict=True):
            axes.plot(chain[:, 0], chain[:, down], color=plt.get_cmap("Blues")(shade), marker="o", ms=1.5, lw=1)
        axes.plot(places[:, -1, 0], places[:, -1, down], color=COLOURS[1], lw=0.8)
        axes.set_title(f"from {place}, every {2 * scene.duration / SAMPLES:g} s")
        axes.set(xlabel="x (m)", ylabel=f"{label} (m)", aspect="equal")
