"""A row of four-bar loops in one model: rows that say nothing new are left out when it is made."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.report import Report
from experiments.robots import models
from experiments.robots.costs import clocks
from hhtjax.bodies.equations import Loops


def run(report: Report, fast: bool) -> dict:
    """Its rows, gaps and times."""
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
