"""Robots: accuracy against steps and time beside MuJoCo's integrators, rigid and flexible joints, a loop, long chains.

All motions are of equations that both programs share to rounding. The reference is MuJoCo's RK4 with small steps, or,
for the loop, whose constraint is soft there, our own with steps that are halved. Times of MuJoCo are those of whole
runs in compiled code (`mujoco.rollout`), ours the steps times that of a step in `simulate`, warm.
"""

import importlib.util
import os
import time
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.parts import rounded
from experiments.report import COLOURS, MARKERS, Report
from experiments.robots import models
from hhtjax import bodies
from hhtjax.bodies.equations import Loops
from hhtjax.plot import subplots

SAMPLES = 10  # times at which q is compared
INTEGRATORS = "RK4", "implicitfast", "implicit", "discrete"
OURS = "hht"
STEPPER = hhtjax.hht()
TARGET = 1e-4  # rad


def run(report: Report, fast: bool):
    """All parts, their figures and numbers."""
    numbers: dict = {"machine": f"{os.cpu_count()} cores ({jax.devices()[0].device_kind})", "fast": fast}
    with_peer = importlib.util.find_spec("mujoco") is not None
    if not with_peer:
        report.progress("mujoco is not installed (extra peers): ours alone")
    cases = [models.ur5(), models.four_bar()]
    cases += [models.flexible(k, ringing) for k in ((1e6,) if fast else (1e4, 1e6)) for ringing in (False, True)]
    cases += [] if fast else [models.chain(24), models.chain(50)]
    numbers["cases"] = []
    for case in cases:
        numbers["cases"].append(compare(report, case, with_peer, fast))
    tables(report, numbers["cases"])
    report.figure("robots_time", figure(numbers["cases"], "time_s"))
    report.figure("robots_steps", figure(numbers["cases"], "h_s"))
    numbers["step_times"] = step_times(report, with_peer, fast)
    numbers["gradient"] = gradient(report, fast)
    if not fast:
        numbers["humanoid"] = humanoid(report)
    report.numbers(rounded(numbers))


# ----------------------------------------------------------------------------
# Accuracy


@partial(jax.jit, static_argnames="system")
def path(system, q0, v0, params, dt, steps):
    """q at the samples, (SAMPLES, n); the number of steps is traced, so that one program serves all."""
    state = STEPPER.init(system, q0, v0, params, dt)

    def step(_, state):
        return STEPPER.step(system, state, params, dt)[0]

    def between(state, _):
        state = jax.lax.fori_loop(0, steps, step, state)
        return state, state.q

    return jax.lax.scan(between, state, length=SAMPLES)[1]


def ours(case, steps: int) -> Any:
    """q at the samples (SAMPLES, n); None where the run failed."""
    robot, dt = case.robot, case.duration / (SAMPLES * steps)
    q = np.asarray(path(robot.system, robot.q0 + case.q0, robot.v0, robot.params, dt, steps))
    return q if np.all(np.isfinite(q)) else None


def seconds_a_step(case, repeats: int = 5) -> float:
    """Of `simulate`, warm; the start varied, the least of some."""
    robot, num_steps, times = case.robot, 1000, []
    for k in range(repeats + 1):
        q0 = robot.q0 + case.q0 + 1e-9 * k
        start = time.perf_counter()
        run = hhtjax.simulate(
            robot.system,
            STEPPER,
            q0,
            robot.v0,
            robot.params,
            dt=case.duration / num_steps,
            num_steps=num_steps,
            save_every=100,
        )
        jax.block_until_ready(run.q)
        times.append(time.perf_counter() - start)
    return min(times[1:]) / num_steps


def theirs(case, integrator: str, steps: int):
    """The same of MuJoCo, all steps in one call."""
    mujoco, rollout = importlib.import_module("mujoco"), importlib.import_module("mujoco.rollout")
    mujoco.set_mju_user_warning(lambda text: None)
    model = mujoco.MjModel.from_xml_string(case.text)
    model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    model.opt.timestep = case.duration / (SAMPLES * steps)
    data = mujoco.MjData(model)
    data.qpos[:] = np.asarray(case.robot.q0) + case.q0
    whole = mujoco.mjtState.mjSTATE_FULLPHYSICS
    state = np.zeros(mujoco.mj_stateSize(model, whole))
    mujoco.mj_getState(model, data, state, whole)
    control = np.tile(np.asarray(case.robot.params.get("ctrl", np.zeros(0))), (1, SAMPLES * steps, 1))
    start = time.perf_counter()
    path, _ = rollout.rollout(model, data, state[None], control if model.nu else None, nstep=SAMPLES * steps)
    seconds = time.perf_counter() - start
    q = path[0, steps - 1 :: steps, 1 : 1 + model.nq]
    return (q if np.all(np.isfinite(q)) and np.max(np.abs(q)) < 1e6 else None), seconds


def integrators() -> list[str]:
    """Those that the MuJoCo at hand has."""
    kinds = importlib.import_module("mujoco").mjtIntegrator
    return [name for name in INTEGRATORS if hasattr(kinds, f"mjINT_{name.upper()}")]


def reference(case, with_peer: bool, fast: bool) -> Any:
    """By an independent program where it solves the same equations: not the loop, which is soft there."""
    if with_peer and not case.robot.model.loops:
        stiff = "flexible" in case.words
        return theirs(case, "RK4", (20_000 if fast else 50_000) if stiff else (4_000 if fast else 10_000))[0]
    return 4 / 3 * ours(case, 4000) - ours(case, 2000) / 3


def compare(report: Report, case, with_peer: bool, fast: bool) -> dict:
    """Errors and times of all methods, by the number of steps between samples."""
    exact = reference(case, with_peer, fast)
    sizes = [2**k for k in (range(3, 8) if fast else range(1, 12))]
    found: dict = {"case": case.words, "n": int(np.size(case.q0)), "methods": {}}
    methods, step_s = [OURS, *(integrators() if with_peer else [])], seconds_a_step(case)
    for name in methods:
        rows: dict = {"h_s": [], "error": [], "time_s": []}
        for steps in sizes:
            q, seconds = (ours(case, steps), step_s * SAMPLES * steps) if name == OURS else theirs(case, name, steps)
            error = None if q is None else float(np.sqrt(np.mean((q - exact) ** 2)))
            for key, value in zip(rows, (case.duration / (SAMPLES * steps), error, seconds), strict=True):
                rows[key].append(value)
        found["methods"][name] = rows
    if case.robot.model.loops:
        found["gap_m"] = largest_gap(case)
    report.progress(f"{case.words}: done")
    return found


def largest_gap(case) -> float:
    """Of all rows of the loop along a run of ours."""
    run = hhtjax.simulate(
        case.robot.system, STEPPER, case.robot.q0 + case.q0, case.robot.v0, case.robot.params, dt=2e-3, num_steps=1000
    )
    loops = Loops(case.robot.model._replace(rows=None))
    return float(jnp.max(jnp.abs(jax.vmap(lambda q: loops(q, 0.0, case.robot.params))(run.q))))


def largest_step(rows: dict, error: float):
    """The largest step from which on all are within an error; None if there is none."""
    best = None
    for h, found in zip(reversed(rows["h_s"]), reversed(rows["error"]), strict=True):
        if found is None or not found <= error:
            break
        best = h
    return best


def tables(report: Report, cases: list):
    """Of each case, the largest step and the least time within an error."""
    for case in cases:
        rows = []
        for name, x in case["methods"].items():
            steps = [largest_step(x, error) for error in (1e-3, TARGET, 1e-6)]
            times = [x["time_s"][x["h_s"].index(h)] * 1e3 if h else None for h in steps]
            rows.append([name, *("-" if y is None else y for pair in zip(steps, times, strict=True) for y in pair)])
        print(case["case"] + (f"; gap {case['gap_m']:.1e} m" if "gap_m" in case else ""))
        report.table(["method", *(f"{what} to {e:g}" for e in (1e-3, TARGET, 1e-6) for what in ("h (s)", "ms"))], rows)


def figure(cases: list, over: str):
    """Error against the step size ("h_s") or the time of a run ("time_s"), a panel for each case."""
    rows = (len(cases) + 1) // 2
    panels, axes = subplots(rows, 2, width=130, height=50 * rows)
    for panel, case in zip(np.ravel(axes), cases, strict=False):
        for i, (name, x) in enumerate(case["methods"].items()):
            error = np.array([np.nan if e is None else e for e in x["error"]], float)
            label = name if name == OURS else f"MuJoCo {name}"
            scale = 1e3 if over == "time_s" else 1.0
            panel.loglog(
                np.array(x[over]) * scale, error, color=COLOURS[i], marker=MARKERS[i], ms=2.5, lw=1.1, label=label
            )
        panel.set(
            xlabel="time of a run (ms)" if over == "time_s" else "step size (s)", ylabel="RMS error of q (rad)",
        )  # fmt: skip
        panel.set_title(case["case"], fontsize=6)
        low = [e for x in case["methods"].values() for e in x["error"] if e]
        panel.set_ylim(max(min(low) / 3, 1e-13), min(10.0, 3 * max(low)))
    for panel in np.ravel(axes)[len(cases) :]:
        panel.set_axis_off()
    np.ravel(axes)[0].legend(fontsize=5, loc="lower right")
    return panels


# ----------------------------------------------------------------------------
# Costs


def step_times(report: Report, with_peer: bool, fast: bool) -> dict:
    """Microseconds of a step, in turns, the start varied; least of several."""
    found = {}
    for case in [models.ur5()] if fast else [models.ur5(), models.chain(24), models.chain(50)]:
        steps = 100
        times: dict = {}
        for _ in range(3 if fast else 10):
            case = case._replace(q0=case.q0 + 1e-6)
            times.setdefault(OURS, []).append(seconds_a_step(case, 1) * SAMPLES * steps)
            for name in integrators() if with_peer else []:
                times.setdefault(name, []).append(theirs(case, name, steps)[1])
        found[case.words] = {name: min(x) / (SAMPLES * steps) * 1e6 for name, x in times.items()}
    report.table(
        ["us a step", *found], [[m, *(found[case].get(m, "-") for case in found)] for m in next(iter(found.values()))]
    )
    return found


def gradient(report: Report, fast: bool) -> dict:
    """A reverse gradient in all inertial parameters of the UR5, over the run; and what its first call takes."""
    case = models.ur5()
    names = ("mass", "com", "inertia", "damping", "armature")
    num_steps = 100 if fast else 1000

    def loss(some):
        run = hhtjax.simulate(
            case.robot.system, STEPPER, case.robot.q0 + case.q0, case.robot.v0, case.robot.params | some,
            dt=2e-3, num_steps=num_steps, save_every=num_steps // 10,
        )  # fmt: skip
        return jnp.sum(run.q**2)

    some = {name: case.robot.params[name] for name in names}
    functions = {"run": jax.jit(loss), "gradient": jax.jit(jax.grad(loss))}
    found = {}
    for name, function in functions.items():
        start = time.process_time()
        jax.block_until_ready(function(some))
        found[f"{name}_first_cpu_s"] = time.process_time() - start
    times: dict = {name: [] for name in functions}
    for k in range(7):
        changed = some | {"mass": some["mass"] * (1 + 1e-6 * k)}
        for name, function in functions.items():
            start = time.perf_counter()
            jax.block_until_ready(function(changed))
            times[name].append(time.perf_counter() - start)
    found |= {f"{name}_us_a_step": min(x) / num_steps * 1e6 for name, x in times.items()}
    found["ratio"] = found["gradient_us_a_step"] / found["run_us_a_step"]
    report.progress("gradient {ratio:.2f} of the run, compiled in {gradient_first_cpu_s:.1f} CPU s".format(**found))
    return found


def humanoid(report: Report) -> dict:
    """The humanoids of dm_control where it is installed: a motion in the air."""
    spec = importlib.util.find_spec("dm_control")
    if spec is None or importlib.util.find_spec("mujoco") is None:
        report.progress("SKIPPED: the humanoids, which need the packages dm_control and mujoco")
        return {}
    found: dict = {"dm_control": importlib.import_module("importlib.metadata").version("dm_control")}
    folder = os.path.join(os.path.dirname(spec.origin or ""), "suite")
    for name in ("humanoid", "humanoid_CMU"):
        robot = bodies.load(
            os.path.join(folder, f"{name}.xml"), ignore=("contact", "actuator"), limits="ignore", friction="ignore"
        )
        solve = partial(
            hhtjax.simulate,
            robot.system,
            STEPPER,
            v0=robot.v0,
            params=robot.params,
            dt=2e-3,
            num_steps=200,
            save_every=200,
        )
        start = time.process_time()
        jax.block_until_ready(solve(q0=robot.q0).v)
        first = time.process_time() - start
        start = time.perf_counter()
        run = solve(q0=robot.q0)
        jax.block_until_ready(run.v)
        found[name] = {
            "rates": robot.model.tree.rates, "first_cpu_s": first,
            "us_a_step": (time.perf_counter() - start) / 200 * 1e6,
            "finite": all(bool(np.isfinite(x).all()) for x in jax.tree.leaves(run.v)),
        }  # fmt: skip
        report.progress(f"{name}: {found[name]}")
    return found
