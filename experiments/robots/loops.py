"""A row of four-bar loops in one model: rows that say nothing new are left out when it is made."""

from __future__ import annotations

import importlib.util
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.report import Report
from experiments.robots import by_mujoco, models
from experiments.robots.costs import clocks
from hhtjax import scenes
from hhtjax.bodies.equations import Loops


def run(report: Report, fast: bool) -> dict:
    """Its rows, gaps and times."""
    loops, num_steps = (4, 50) if fast else (40, 200)
    made: list = []
    _, made_s = clocks(lambda: made.append(models.four_bars(loops)))
    case = made[0]
    robot, dt = case.robot, case.duration / num_steps
    cranks = np.array([robot.index(f"crank{i}") for i in range(loops + 1)])
    every, scene = Loops(robot.model._replace(rows=None)), scenes.four_bars.four_bars(loops)

    def simulated(system, q0, v0, params, shift: float = 0.0):
        found = hhtjax.simulate(
            system, hhtjax.hht(), q0, v0, params, dt=dt * (1 + shift), num_steps=num_steps, save_every=num_steps // 10
        )
        return jax.block_until_ready(found)

    ours = partial(simulated, robot.system, case.q0, case.v0, robot.params)
    natural = partial(simulated, scene.system, scene.q0, scene.v0, scene.params)
    (_, first), (_, first_natural) = clocks(ours), clocks(natural)
    theirs = None
    times: dict[str, list] = {"ours": [], "natural": [], "mujoco": []}
    for turn in range(1, 3):
        times["ours"].append(clocks(lambda k=turn: ours(1e-9 * k)))
        times["natural"].append(clocks(lambda k=turn: natural(1e-9 * k)))
        if importlib.util.find_spec("mujoco"):
            model = by_mujoco.as_model(case.text, "implicitfast", dt)
            order = by_mujoco.order(case, model)
            path, *seconds = by_mujoco.rolled(model, case.q0[order], case.v0[order], np.zeros(0), num_steps)
            theirs = path[num_steps // 10 - 1 :: num_steps // 10, 1 : 1 + model.nq][:, np.argsort(order)[cranks]]
            times["mujoco"].append(seconds)
    least = {name: [min(x) / num_steps * 1e6 for x in zip(*values, strict=True)] for name, values in times.items()}
    solution = ours()
    solution.check()
    gap = jax.vmap(lambda q: every(q, 0.0, robot.params))(solution.q)
    B = np.asarray(jax.jacfwd(lambda q: every(q, 0.0, robot.params))(solution.q[-1]))
    exact = crank(loops, np.asarray(solution.t))
    found = {
        "loops": loops, "coordinates": int(B.shape[1]), "rows": int(B.shape[0]),
        "rank": int(np.linalg.matrix_rank(B, tol=1e-9)), "rows_kept": len(robot.model.rows or range(len(B))),
        "dt_s": dt, "num_steps": num_steps, "made_cpu_s": made_s, "first_cpu_s": first,
        "us_a_step": least["ours"][0], "cpu_us_a_step": least["ours"][1],
        "natural_us_a_step": least["natural"][0], "natural_first_cpu_s": first_natural,
        "mujoco_us_a_step": least["mujoco"][0] if least["mujoco"] else None,
        "mujoco_error_rad": None if theirs is None else float(np.max(np.abs(theirs - exact[1:, None]))),
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
