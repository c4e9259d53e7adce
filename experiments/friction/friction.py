"""Dry friction without smoothing: error against steps and time, beside tanh(v/vt), MuJoCo, exudyn; creep in an hour.

A mass on a spring, driven by a sine, sticks and slips 20 times (hhtjax.scenes.dry_oscillator); its exact motion is
solved from switch to switch. MuJoCo's `frictionloss` is part of its soft constraints: with their default, and with the
stiffest that it takes. exudyn's is linear below a speed, or a stiff spring where a joint sticks.
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
from experiments.dry_motion import dry_motion
from experiments.friction import by_exudyn
from experiments.parts import rounded
from experiments.report import COLOURS, MARKERS, Report
from hhtjax.plot import legend, subplots
from hhtjax.scenes import dry_oscillator

ALPHA = -0.05
SAMPLES = 50
SOLVES = 4  # of tanh, in a step
SPEEDS = 1e-3, 1e-4, 1e-5  # vt of tanh(v/vt), m/s
IMPEDANCES = {"MuJoCo, default": None, "MuJoCo, stiffest": 0.9999}
HOUR = 3600.0
TARGETS = 1e-2, 1.5e-3, 1.5e-4, 1.5e-5  # m, just above what each vt comes down to


def smooth_force(q, v, t, params):
    """With tanh in the place of the law."""
    return dry_oscillator.force(q, v, t, params) - params["F"] * jnp.tanh(v / params["vt"])


SMOOTH = hhtjax.System(dry_oscillator.mass, smooth_force)


def run(report: Report, fast: bool):
    """Both parts, their figures and numbers."""
    scene = dry_oscillator.driven(0.0)
    rows = work_precision(report, scene, [2**k for k in (range(3, 6) if fast else range(2, 14))])
    creeping = creep(report, scene, 36.0 if fast else HOUR)
    numbers = {"rows": rows, "creep": creeping, "equal_errors": steps_saved(rows), "fast": fast}
    words = f"{os.cpu_count()} cores ({jax.devices()[0].device_kind}), load {os.getloadavg()[0]:.1f}"
    plot(report, rows, creeping)
    report.numbers(rounded({"machine": words, "samples": SAMPLES, "switches": switches(scene), **numbers}))


def exact(scene):
    """q at the samples and the times of switches."""
    p = scene.params

    def load(t, y):
        return p["A"] * np.sin(p["W"] * t) - p["k"] * y[0] - p["c"] * y[1]

    times = np.linspace(0, scene.duration, SAMPLES + 1)
    return dry_motion(load, lambda s: p["F"], np.zeros(2), times, p["m"])


def switches(scene):
    """How often it sticks or starts to slide."""
    return len(exact(scene)[1])


def timed(function):
    """Its result, and the least of three times in s, without compilation."""
    result, seconds = function(), []
    for _ in range(3):
        begun = time.perf_counter()
        result = function()
        seconds.append(time.perf_counter() - begun)
    return result, min(seconds)


def work_precision(report, scene, sizes):
    """Rows of all ways and all sizes, steps between two samples."""
    reference, rows = exact(scene)[0], []

    def entry(way, size, path, seconds, solves):
        error = float(np.max(np.abs(path - reference)))
        steps = size * SAMPLES
        rows.append({"way": way, "steps": steps, "solves": solves, "error_m": error, "time_s": seconds})

    for size in sizes:
        path, seconds = timed(lambda size=size: ours(scene, scene.system, hhtjax.hht(ALPHA), scene.params, size))
        entry("set-valued", size, np.asarray(path.q[:, 0]), seconds, size * SAMPLES)
        for vt in SPEEDS:
            stepper, params = hhtjax.hht(ALPHA, iterations=SOLVES), {**scene.params, "vt": vt}
            path, seconds = timed(lambda size=size, s=stepper, p=params: ours(scene, SMOOTH, s, p, size))
            entry(f"tanh, vt = {vt:g} m/s", size, np.asarray(path.q[:, 0]), seconds, SOLVES * size * SAMPLES)
        if importlib.util.find_spec("mujoco"):
            for way, impedance in IMPEDANCES.items():
                path, seconds = timed(lambda size=size, x=impedance: mujoco_path(scene, size, x))
                entry(way, size, path, seconds, None)
        if importlib.util.find_spec("exudyn"):
            load = float(scene.params["A"]), float(scene.params["W"]), 0.0
            for way in by_exudyn.WAYS:
                run = partial(by_exudyn.path, scene.params, way, *load, scene.duration, size * SAMPLES, SAMPLES)
                entry(way, size, *timed(run), None)
        report.progress(f"{size * SAMPLES} steps: {rows[-1]['way']} {rows[-1]['error_m']:.2g} m")
    return rows


def ours(scene, system, stepper, params, size):
    """A run, on the device until it is done."""
    steps = size * SAMPLES
    found = hhtjax.simulate(
        system, stepper, scene.q0, scene.v0, params, dt=scene.duration / steps, num_steps=steps, save_every=size
    )
    return jax.block_until_ready(found)


def mujoco_model(params, dt, impedance):
    """A slide with a spring, a damper and friction, pushed by a motor."""
    mujoco: Any = importlib.import_module("mujoco")  # of an extra of its own

    hard = "" if impedance is None else f'solimpfriction="{impedance} {impedance} 0.001" solreffriction="{2 * dt} 1" '
    text = (
        f'<mujoco><compiler autolimits="false"/><option gravity="0 0 0" timestep="{dt:.17g}" integrator="implicitfast" '
        f'tolerance="1e-12"><flag contact="disable"/></option><worldbody><body><joint name="x" type="slide" '
        f'axis="1 0 0" stiffness="{params["k"]}" damping="{params["c"]}" frictionloss="{params["F"]}" {hard}/>'
        f'<inertial pos="0 0 0" mass="{params["m"]}" diaginertia="1 1 1"/></body></worldbody>'
        f'<actuator><motor joint="x" gear="1"/></actuator></mujoco>'
    )
    return mujoco.MjModel.from_xml_string(text)


def mujoco_run(model, force, every):
    """q at the start and after each `every` steps, with a force for each step."""
    mujoco: Any = importlib.import_module("mujoco")  # of an extra of its own
    rollout: Any = importlib.import_module("mujoco.rollout")

    data, whole = mujoco.MjData(model), mujoco.mjtState.mjSTATE_FULLPHYSICS
    start = np.zeros(mujoco.mj_stateSize(model, whole))
    mujoco.mj_getState(model, data, start, whole)
    path, _ = rollout.rollout(model, data, start[None], force[None, :, None])
    return np.append(0.0, path[0, every - 1 :: every, 1])


def mujoco_path(scene, size, impedance):
    """q at the samples; the force is that in the middle of each step."""
    steps, p = size * SAMPLES, scene.params
    dt = scene.duration / steps
    force = p["A"] * np.sin(p["W"] * dt * (np.arange(steps) + 0.5))
    return mujoco_run(mujoco_model(p, dt, impedance), force, size)


def creep(report, scene, duration):
    """How far a joint gets under nine tenths of the load that it holds: 10 ms steps, without the spring."""
    params = {**scene.params, "k": 0.0, "c": 0.0, "load": 0.9 * scene.params["F"]}
    steps, keep = round(duration / 0.01), 60

    def pulled(force, q, v, t, params):
        return params["load"] + force(q, v, t, {**params, "A": 0.0})

    dry = hhtjax.System(dry_oscillator.mass, partial(pulled, dry_oscillator.force), friction=dry_oscillator.limit)
    smooth = hhtjax.System(dry_oscillator.mass, partial(pulled, smooth_force))
    options = {"dt": 0.01, "num_steps": steps, "save_every": steps // keep}
    zero, paths = jnp.zeros(1), {}
    found = hhtjax.simulate(dry, hhtjax.hht(ALPHA), zero, zero, params, **options)
    paths["set-valued"] = found.q[:, 0]
    for vt in SPEEDS[:2]:
        stepper = hhtjax.hht(ALPHA, iterations=None)
        path = hhtjax.simulate(smooth, stepper, zero, zero, {**params, "vt": vt}, **options)
        if not np.any(path.failure.step):  # Newton's iteration converged
            paths[f"tanh, vt = {vt:g} m/s"] = path.q[:, 0]
    if importlib.util.find_spec("mujoco"):
        for way, impedance in IMPEDANCES.items():
            model = mujoco_model(params, 0.01, impedance)
            paths[way] = mujoco_run(model, np.full(steps, params["load"]), steps // keep)
    if importlib.util.find_spec("exudyn"):
        for way in by_exudyn.WAYS:
            paths[way] = by_exudyn.path(params, way, 0.0, 0.0, float(params["load"]), duration, steps, keep)
    for way, path in paths.items():
        report.progress(f"creep in {duration:.0f} s, {way}: {float(path[-1]):.3g} m")
    return {"t_s": np.asarray(found.t).tolist(), "q_m": {way: np.asarray(path).tolist() for way, path in paths.items()}}


def steps_saved(rows):
    """For some errors: the steps of the set-valued step, and those that the others take over them, by the best vt."""
    groups = {
        way: [row for row in rows if row["way"].startswith(way)] for way in ("set-valued", "tanh", "MuJoCo", "exudyn")
    }
    line = np.log(sorted((row["error_m"], row["steps"]) for row in groups.pop("set-valued")))
    found = []
    for target in TARGETS:
        own = float(np.exp(np.interp(np.log(target), line[:, 0], line[:, 1])))
        entry = {"error_m": target, "steps": own}
        for way, group in groups.items():
            enough = [row["steps"] for row in group if row["error_m"] <= target]
            if enough:
                entry[way] = min(enough) / own
        found.append(entry)
    return found


def plot(report: Report, rows, creeping):
    """Error against steps and time, and the creep."""
    figure, (left, middle, right) = subplots(1, 3, width=180, height=95)
    for i, way in enumerate(dict.fromkeys(row["way"] for row in rows)):
        mine = [row for row in rows if row["way"] == way]
        style = {"color": COLOURS[i], "marker": MARKERS[i], "ms": 3, "lw": 1}
        for axes, key, scale in ((left, "steps", 1), (middle, "time_s", 1e3)):
            axes.loglog([scale * row[key] for row in mine], [row["error_m"] for row in mine], label=way, **style)
        if way in creeping["q_m"]:
            q = np.abs(creeping["q_m"][way][1:])
            right.semilogy(creeping["t_s"][1:], np.where(q > 0, q, 1e-18), label=way, color=COLOURS[i], lw=1)
    left.set_xlabel("steps")
    left.set_ylabel("largest error of q (m)")
    middle.set_xlabel("time of a run (ms)")
    right.set_xlabel("time (s)")
    right.set_ylabel("creep (m); 0 is drawn at 1e-18")
    legend(left)
    report.figure("friction", figure)
