"""Error against step size and time of a run, beside MuJoCo and exudyn, for equations that all programs share.

Errors are the largest of any coordinate at all samples, 20 ms apart. The reference is MuJoCo's RK4 with small steps, so
an independent program. SciPy's DOP853 is it for the loop, which is soft in MuJoCo, and for set points that move, which
MuJoCo holds for a step. Times of ours are steps times that of a step in `simulate`, warm; those of the others are of
their runs, in compiled code.
"""

from __future__ import annotations

import importlib.util
import time
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.report import Report
from experiments.robots import by_exudyn, by_mujoco, models
from experiments.robots.models import Case
from hhtjax.bodies.equations import Loops

SAMPLE = 0.02  # s
STEPS = 1, 2, 4, 10, 20, 40, 100, 200, 400, 1000  # between two samples
LATE = 0.2  # s, when what a start throws is over
OURS = "hht"  # of the default alpha, -0.05
VARIANTS = {  # options and alpha
    OURS: ({}, -0.05),
    "hht, predictor": ({"linearize": "predictor"}, -0.05),
    "hht, alpha = 0": ({}, 0.0),
    "hht, alpha = -0.3": ({}, -0.3),
    "hht, Newton": ({"iterations": None}, -0.05),
}
TARGETS = 1e-3, 1e-4, 1e-5, 1e-7  # rad, errors at which steps and times are told
SAME = 1e-8  # relative difference of accelerations up to which a program solves the same equations


def run(report: Report, fast: bool) -> dict:
    """{"cases": ...}, each with the errors and times of all methods."""
    peers = {name: importlib.util.find_spec(name) is not None for name in ("mujoco", "exudyn")}
    for name in (name for name, found in peers.items() if not found):
        report.progress(f"{name} is not installed (extra peers): without it")
    cases = [(models.ur5(smooth=True), [*VARIANTS]), (models.ur5(), [*VARIANTS])]
    elastic = [OURS, "hht, alpha = 0", "hht, alpha = -0.3", "hht, Newton"]
    for k in (1e6,) if fast else (1e4, 1e6):
        cases += [(models.flexible(k, start), elastic) for start in ("at rest", "ringing", "jump")]
    cases += [(models.four_bar(), [OURS])]
    cases += [] if fast else [(models.chain(24), [OURS]), (models.chain(50), [OURS])]
    if fast:
        cases = [(case, [OURS]) for case, _ in cases[2:]]
    found = []
    for case, variants in cases:
        found.append(compared(case, variants, peers, (1, 4, 20) if fast else STEPS[:7] if large(case) else STEPS))
        report.progress(f"{case.words}: done")
    for case in found:
        table(report, case)
    return {"installed": peers, "sample_s": SAMPLE, "cases": found}


def large(case: Case) -> bool:
    """Whether steps take too long for the finest grids."""
    return len(case.q0) > 16


def compared(case: Case, variants: list[str], peers: dict, sizes: tuple) -> dict:
    """Errors and times of all methods, by the number of steps between samples."""
    samples = round(case.duration / SAMPLE)
    exact, coarser = reference(case, peers["mujoco"], samples)
    found: dict[str, Any] = {"case": case.words, "n": len(case.q0), "duration_s": case.duration}
    found["largest_q_rad"] = float(np.max(np.abs(exact)))
    found["reference_error"] = None if coarser is None else float(np.max(np.abs(exact - coarser)))
    found["accelerations"] = agreement(case, peers)
    found["methods"] = {}

    def entry(name: str, sizes: tuple, path) -> None:
        rows: dict[str, list] = {"h_s": [], "error_rad": [], "late_error_rad": [], "time_s": []}
        rows |= {"torque_error": [], "late_torque_error": []} if case.springs else {}
        for steps in sizes:
            q, seconds = path(steps)
            values = [SAMPLE / steps, error(q, exact), error(q, exact, after=LATE), seconds]
            if case.springs:  # of torques -k q, over the largest of them
                scale = largest(exact, case.springs)
                values += [error(q, exact, case.springs, after) / scale for after in (0.0, LATE)]
            for key, value in zip(rows, values, strict=True):
                rows[key].append(value)
        found["methods"][name] = rows

    step_s = seconds_a_step(case)
    for name in variants:
        options, alpha = VARIANTS[name]
        timed = name == OURS
        entry(name, sizes, lambda steps, o=options, a=alpha, s=timed: (
            ours(case, samples, steps, a, **o), step_s * samples * steps if s else None))  # fmt: skip
    if peers["mujoco"] and same(found, "mujoco"):
        names = by_mujoco.integrators() + ([by_mujoco.STIFFEST] if case.robot.model.loops else [])
        for name in names:
            entry(f"MuJoCo {name}", sizes, partial(by_mujoco.path, case, name, samples))
    if peers["exudyn"] and same(found, "exudyn"):
        for way in by_exudyn.WAYS:
            entry(way, sizes, lambda steps, way=way: by_exudyn.path(
                case.robot, case.q0, case.v0, way, case.duration, samples * steps, samples))  # fmt: skip
    if case.robot.model.loops:
        found |= gaps(case)
    return found


def error(q: Any, exact: np.ndarray, which: tuple = (), after: float = 0.0) -> float:
    """The largest of all coordinates, or of some, after a time; infinite where the run failed."""
    if q is None:
        return np.inf
    apart = (q - exact)[round(after / SAMPLE) :]
    return float(np.max(np.abs(apart[:, list(which)] if which else apart)))


def largest(q: np.ndarray, which: tuple) -> float:
    """The largest of some coordinates."""
    return float(np.max(np.abs(q[:, list(which)])))


# ----------------------------------------------------------------------------
# Ours


@partial(jax.jit, static_argnames=("system", "samples", "options"))
def path(system, q0, v0, params, dt, steps, alpha, samples: int, options: tuple):
    """q at the samples, (samples, n); steps and alpha are traced, so that one program serves all."""
    stepper = hhtjax.hht(alpha, **dict(options))
    state = stepper.init(system, q0, v0, params, dt)

    def step(_, state):
        return stepper.step(system, state, params, dt)[0]

    def between(state, _):
        state = jax.lax.fori_loop(0, steps, step, state)
        return state, state.q

    return jax.lax.scan(between, state, length=samples)[1]


def ours(case: Case, samples: int, steps: int, alpha: float, **options) -> Any:
    """q at the samples; None where the run failed."""
    robot, dt = case.robot, case.duration / (samples * steps)
    some = tuple(sorted(options.items()))
    q = np.asarray(path(robot.system, case.q0, case.v0, robot.params, dt, steps, alpha, samples, some))
    return q if np.all(np.isfinite(q)) and np.max(np.abs(q)) < 1e6 else None


def whole(case: Case, num_steps: int, shift: float = 0.0):
    """A run of so many steps by `simulate`, when it is done."""
    found = hhtjax.simulate(
        case.robot.system, hhtjax.hht(), case.q0, case.v0, case.robot.params,
        dt=case.duration / num_steps * (1 + shift), num_steps=num_steps, save_every=num_steps // 10,
    )  # fmt: skip
    return jax.block_until_ready(found)


def seconds_a_step(case: Case, repeats: int = 4) -> float:
    """Of `simulate`, warm, nothing of it known from the run before; the least of some."""
    num_steps, times = 300 if large(case) else 5000, []
    for k in range(repeats + 1):
        start = time.perf_counter()
        whole(case, num_steps, 1e-9 * k)
        times.append(time.perf_counter() - start)
    return min(times[1:]) / num_steps


def gaps(case: Case) -> dict:
    """What all rows of a loop are open by along a run of ours, at the most, and where the time of its steps goes."""
    found = hhtjax.simulate(
        case.robot.system, hhtjax.hht(), case.q0, case.v0, case.robot.params, dt=2e-3, num_steps=1000
    )
    loops = Loops(case.robot.model._replace(rows=None))
    gap = jax.vmap(lambda q: loops(q, 0.0, case.robot.params))(found.q)
    explained = hhtjax.explain(
        lambda q: hhtjax.simulate(
            case.robot.system, hhtjax.hht(), q, case.v0, case.robot.params, dt=2e-3, num_steps=1000, save_every=100
        ),
        case.q0,
    )
    return {"gap_m": float(jnp.max(jnp.abs(gap))), "gap_dt_s": 2e-3, "loop_over_steps": explained.paths[0]}


# ----------------------------------------------------------------------------
# What they are compared with


def agreement(case: Case, peers: dict) -> dict:
    """Largest relative difference of accelerations at the start, with rates of all joints, before loops hold."""
    robot, v0 = case.robot, 0.3 * np.arange(1, 1 + len(case.q0))
    M = np.asarray(robot.system.mass(jnp.asarray(case.q0), robot.params))
    r = robot.system.dynamics(jnp.asarray(case.q0), jnp.asarray(v0), jnp.zeros(len(v0)), 0.0, robot.params)
    w = np.linalg.solve(M, -np.asarray(r))
    found = {}
    if peers["mujoco"]:
        found["mujoco"] = by_mujoco.accelerations(case, v0)
    if peers["exudyn"] and not case.is_driven and not large(case):
        found["exudyn"] = by_exudyn.accelerations(robot, case.q0, v0)
    return {name: float(np.max(np.abs(a - w)) / np.max(np.abs(w))) for name, a in found.items()}


def same(found: dict, peer: str) -> bool:
    """Whether it solves these equations."""
    return found["accelerations"].get(peer, np.inf) <= SAME


def reference(case: Case, with_mujoco: bool, samples: int) -> tuple[Any, Any]:
    """q at the samples, and the same with half of the steps, None by DOP853."""
    if case.robot.model.loops or case.is_driven or not with_mujoco:
        return by_dop853(case, samples), None
    steps = 4000 if case.springs else 400 if large(case) else 800
    return by_mujoco.path(case, "RK4", samples, steps)[0], by_mujoco.path(case, "RK4", samples, steps // 2)[0]


def by_dop853(case: Case, samples: int) -> np.ndarray:
    """The equations of index 1, whose solution stays on the loops to the tolerance."""
    from scipy.integrate import solve_ivp

    robot, n = case.robot, len(case.q0)
    constraint = robot.system.constraint or (lambda q, t, params: jnp.zeros(0))

    @jax.jit
    def slope(t, y):
        q, v = y[:n], y[n:]

        def B(q):
            return jax.jacfwd(lambda q: constraint(q, t, robot.params))(q)

        _, curved = jax.jvp(lambda q: B(q) @ v, (q,), (v,))
        M, rows = robot.system.mass(q, robot.params), B(q)
        force = -robot.system.dynamics(q, v, jnp.zeros(n), t, robot.params)
        A = jnp.block([[M, rows.T], [rows, jnp.zeros((len(rows), len(rows)))]])
        return jnp.concatenate([v, jnp.linalg.solve(A, jnp.concatenate([force, -curved]))[:n]])

    times = np.linspace(0, case.duration, samples + 1)[1:]
    found = solve_ivp(
        lambda t, y: np.asarray(slope(t, y)), (0, case.duration), np.concatenate([case.q0, case.v0]),
        method="DOP853", t_eval=times, rtol=1e-12, atol=1e-13,
    )  # fmt: skip
    return found.y[:n].T


# ----------------------------------------------------------------------------
# What is reached


def reached(rows: dict, target: float, key: str = "error_rad") -> Any:
    """The largest step within an error, and the time of its run: between those of the grid along a line of logarithms.

    None where no step is within it. A step counts only if all smaller ones are within the error, too.
    """
    points = sorted(
        (h, e, s)
        for h, e, s in zip(rows["h_s"], rows[key], rows["time_s"], strict=True)
        if e is not None and (s is not None or rows["time_s"][0] is None)
    )
    failed = len(points) < len(rows["h_s"])
    inside = 0
    while inside < len(points) and points[inside][1] <= target:
        inside += 1
    if not inside:
        return None
    h, e, s = points[inside - 1]
    if inside < len(points) and np.isfinite(points[inside][1]):
        H, E, S = points[inside]
        part = np.log(target / e) / np.log(E / e)
        h = float(h * (H / h) ** part)
        s = None if s is None else float(s * (S / s) ** part)
    return {"h_s": h, "time_s": s, "on_edge": inside == len(points) and not failed}


def table(report: Report, case: dict):
    """Of a case, the largest steps and the times of runs within errors."""
    rows = []
    for name, x in case["methods"].items():
        cells: list = [name]
        for target in TARGETS:
            found = reached(x, target)
            cells += ["-" if y is None else y * 1e3 for y in ((found or {}).get("h_s"), (found or {}).get("time_s"))]
        rows.append(cells)
    print(case["case"] + (f"; gap {case['gap_m']:.1e} m" if "gap_m" in case else ""))
    report.table(["method", *(f"{what} (ms) to {e:g}" for e in TARGETS for what in ("h", "run"))], rows)
