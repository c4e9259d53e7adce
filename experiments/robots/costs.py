"""Times of a step beside MuJoCo's, in turns, and a gradient over a run.

Times are the least of several, of the clock and of the processor, the start of each run another.
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.report import Report
from experiments.robots import by_mujoco, models
from experiments.robots.accuracy import OURS, large, whole

INERTIAL = "mass", "com", "inertia"
OTHERS = "damping", "armature"


def run(report: Report, fast: bool) -> dict:
    """{"step_times": ..., "gradient": ...}."""
    return {"step_times": step_times(report, fast), "gradient": gradient(report, fast)}


def clocks(function: Callable) -> tuple[float, float]:
    """Seconds of the clock and of the processor of a call."""
    start = time.perf_counter(), time.process_time()
    function()
    return time.perf_counter() - start[0], time.process_time() - start[1]


def step_times(report: Report, fast: bool) -> dict:
    """Microseconds of a step, in turns; the ratio to implicitfast is the median over the turns."""
    found = {}
    peers = by_mujoco.integrators() if importlib.util.find_spec("mujoco") else []
    cases = [models.flexible(1e6, "jump"), models.ur5(), models.four_bar(), models.chain(24), models.chain(50)]
    for case in cases[:1] if fast else cases:
        steps = 300 if large(case) else 5000
        times: dict[str, list] = {name: [] for name in (OURS, *peers)}
        whole(case, steps)
        for turn in range(3 if fast else 5 if large(case) else 11):
            times[OURS].append(clocks(lambda case=case, turn=turn, n=steps: whole(case, n, 1e-9 * (1 + turn))))
            for name in peers:
                model = by_mujoco.as_model(case.text, name, case.duration / steps)
                start = case.q0 + 1e-9 * turn
                times[name].append(by_mujoco.rolled(model, start, case.v0, by_mujoco.control(case, steps), steps)[1:])
        rows = {}
        for name, values in times.items():
            clock, processor = (np.array(x) / steps * 1e6 for x in zip(*values, strict=True))
            rows[name] = {"us": float(np.min(clock)), "cpu_us": float(np.min(processor))}
            if "implicitfast" in times:
                own = np.array(times["implicitfast"])[:, 0] / steps * 1e6
                rows[name]["over_implicitfast"] = float(np.median(clock / own))
        found[case.words] = rows
        report.progress(f"us a step, {case.words}: " + ", ".join(f"{k} {v['us']:.3g}" for k, v in rows.items()))
    return found


def gradient(report: Report, fast: bool) -> dict:
    """A reverse gradient in all inertial parameters over the run; what first calls take."""
    case = models.chain(1) if fast else models.ur5()
    names = INERTIAL + OTHERS
    num_steps = 100 if fast else 1000

    def loss(some):
        found = hhtjax.simulate(
            case.robot.system, hhtjax.hht(), case.q0, case.v0, case.robot.params | some,
            dt=2e-3, num_steps=num_steps, save_every=num_steps // 10,
        )  # fmt: skip
        return jnp.sum(found.q**2)

    some = {name: jnp.asarray(case.robot.params[name]) for name in names}
    functions = {"run": jax.jit(loss), "gradient": jax.jit(jax.grad(loss))}
    found: dict[str, Any] = {"case": case.words, "parameters": sum(int(x.size) for x in some.values())}
    found |= {"names": list(names), "num_steps": num_steps}
    for name, function in functions.items():
        found[f"{name}_first_cpu_s"] = clocks(lambda f=function: jax.block_until_ready(f(some)))[1]
    times: dict[str, list] = {name: [] for name in functions}
    for k in range(3 if fast else 11):
        changed = some | {"mass": some["mass"] * (1 + 1e-6 * k)}
        for name, function in functions.items():
            times[name].append(clocks(lambda f=function, x=changed: jax.block_until_ready(f(x)))[0])
    found |= {f"{name}_us_a_step": min(x) / num_steps * 1e6 for name, x in times.items()}
    found["ratio"] = float(np.median(np.array(times["gradient"]) / np.array(times["run"])))
    report.progress("gradient {ratio:.2f} of the run, first call {gradient_first_cpu_s:.1f} CPU s".format(**found))
    return found
