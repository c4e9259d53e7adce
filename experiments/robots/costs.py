"""Times of a step beside MuJoCo's, in turns, and a gradient over a run; a row of four-bar loops; humanoids.

Times are the least of several, of the clock and of the processor, the start of each run another.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import time
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.report import Report
from experiments.robots import by_mujoco, models
from experiments.robots.accuracy import OURS, large, whole
from hhtjax import bodies
from hhtjax.bodies.equations import Loops

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
    cases = [models.flexible(1e6, False), models.ur5(), models.four_bar(), models.chain(24), models.chain(50)]
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
    case = models.flexible(1e6, False) if fast else models.ur5()
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


def four_bars(report: Report, fast: bool) -> dict:
    """A row of loops in one model: rows that say nothing new are left out when it is made."""
    loops, num_steps, dt = (4, 50, 5e-3) if fast else (40, 200, 5e-3)
    made: list = []
    _, made_s = clocks(lambda: made.append(models.four_bars(loops)))
    robot = made[0]
    cranks = np.array([robot.index(f"crank{i}") for i in range(loops + 1)])
    v0 = np.full(robot.model.tree.rates, -1.0)
    v0[cranks] = 1.0  # the ends of the cranks at 1 m/s, couplers upright
    every = Loops(robot.model._replace(rows=None))

    def simulated(shift: float = 0.0):
        return jax.block_until_ready(
            hhtjax.simulate(
                robot.system, hhtjax.hht(), robot.q0, jnp.asarray(v0), robot.params,
                dt=dt * (1 + shift), num_steps=num_steps, save_every=num_steps // 10,
            )
        )  # fmt: skip

    _, first = clocks(simulated)
    seconds = [clocks(lambda k=k: simulated(1e-9 * k)) for k in (1, 2)]
    solution = simulated()
    solution.check()
    gap = jax.vmap(lambda q: every(q, 0.0, robot.params))(solution.q)
    B = np.asarray(jax.jacfwd(lambda q: every(q, 0.0, robot.params))(solution.q[-1]))
    exact = crank(loops, np.asarray(solution.t))
    found = {
        "loops": loops, "coordinates": int(B.shape[1]), "rows": int(B.shape[0]),
        "rank": int(np.linalg.matrix_rank(B, tol=1e-9)), "rows_kept": len(robot.model.rows or range(len(B))),
        "dt_s": dt, "num_steps": num_steps, "made_cpu_s": made_s, "first_cpu_s": first,
        "us_a_step": min(x[0] for x in seconds) / num_steps * 1e6,
        "cpu_us_a_step": min(x[1] for x in seconds) / num_steps * 1e6,
        "gap_m": float(jnp.max(jnp.abs(gap))),
        "error_rad": float(np.max(np.abs(np.asarray(solution.q)[:, cranks] - exact[:, None]))),
        "turned_rad": float(np.ptp(exact)),
    }  # fmt: skip
    report.progress(f"row of four-bars: {found}")
    return found


def crank(loops: int, times: np.ndarray) -> np.ndarray:
    """The angle of all cranks from upright, by the equation of one degree of freedom: ((N + 1)/3 + N) l a'' = ..."""
    from scipy.integrate import solve_ivp

    inertia, weight = (loops + 1) / 3 + loops, ((loops + 1) / 2 + loops) * 9.81
    found = solve_ivp(
        lambda t, y: (y[1], weight / inertia * np.sin(y[0])), (0, times[-1]), (0.0, 1.0),
        method="DOP853", t_eval=times, rtol=1e-12, atol=1e-13,
    )  # fmt: skip
    return found.y[0]


def humanoids(report: Report, fast: bool) -> dict:
    """Those of dm_control, where it is installed: a motion in the air, without contact, motors, friction and ranges."""
    spec = importlib.util.find_spec("dm_control")
    if fast or spec is None or importlib.util.find_spec("mujoco") is None:
        why = "in a smoke run they are left out" if fast else "they need the packages dm_control and mujoco"
        report.progress(f"SKIPPED: the humanoids; {why}")
        return {"skipped": why}
    found: dict[str, Any] = {"dm_control": version("dm_control"), "mujoco": version("mujoco"), "models": {}}
    folder = os.path.join(os.path.dirname(spec.origin or ""), "suite")
    for name in ("humanoid", "humanoid_CMU"):
        found["models"][name] = in_the_air(os.path.join(folder, f"{name}.xml"))
        report.progress(f"{name}: {found['models'][name]}")
    return found


def in_the_air(path: str, num_steps: int = 100, dt: float = 2e-3) -> dict:
    """A model of a file, falling: first call, and times of a step beside MuJoCo's in turns."""
    mujoco = importlib.import_module("mujoco")
    made: list = []
    _, made_s = clocks(
        lambda: made.append(bodies.load(path, ignore=("contact", "actuator"), limits="ignore", friction="ignore"))
    )
    robot = made[0]

    def simulated(shift: float = 0.0):
        found = hhtjax.simulate(
            robot.system, hhtjax.hht(), robot.q0, robot.v0, robot.params,
            dt=dt * (1 + shift), num_steps=num_steps, save_every=num_steps,
        )  # fmt: skip
        return jax.block_until_ready(found)

    first_s, first_cpu_s = clocks(simulated)
    model = by_mujoco.with_options(mujoco.MjModel.from_xml_path(path), "implicitfast", dt)
    kinds = mujoco.mjtDisableBit
    for kind in ("CONTACT", "LIMIT", "FRICTIONLOSS", "ACTUATION"):
        model.opt.disableflags |= int(getattr(kinds, f"mjDSBL_{kind}"))
    own, theirs = [], []
    for turn in range(3):
        own.append(clocks(lambda turn=turn: simulated(1e-9 * (1 + turn))))
        theirs.append(
            by_mujoco.rolled(model, model.qpos0, np.zeros(model.nv), np.zeros(model.nu), 10 * num_steps)[1:]
        )
    solution = simulated()
    clock, processor = (min(x) / num_steps * 1e6 for x in zip(*own, strict=True))
    peer = min(x[0] for x in theirs) / (10 * num_steps) * 1e6
    return {
        "rates": robot.model.tree.rates, "made_cpu_s": made_s, "first_s": first_s, "first_cpu_s": first_cpu_s,
        "us_a_step": clock, "cpu_us_a_step": processor, "mujoco_us_a_step": peer,
        "finite": all(bool(np.isfinite(x).all()) for x in jax.tree.leaves(solution.v)),
    }  # fmt: skip
