"""Model no more than a scene needs: one pendulum as a constraint, as a stiff spring, and as an angle."""

from functools import partial

import numpy as np

from experiments.cardona_geradin1989.pendulum import SPEED, exact
from experiments.cardona_geradin1989.runs import end, least_seconds
from hhtjax import hht, rk4
from hhtjax.scenes import pendulum

ALPHA = -0.05
NUM_STEPS = (200, 1000, 5000)
TIMED_STEPS = 20_000
CASES = {  # scene, stepper, unknowns of its linear solve
    "angle, RK4": (pendulum.minimal(), rk4(), 0),
    "angle, HHT": (pendulum.minimal(), hht(ALPHA), 1),
    "spring, k = 1e4 N/m": (pendulum.elastic(1e4), hht(ALPHA), 2),
    "spring, k = 1e6 N/m": (pendulum.elastic(1e6), hht(ALPHA), 2),
    "spring, k = 1e6 N/m, RK4": (pendulum.elastic(1e6), rk4(), 0),
    "rod, index 3": (pendulum.cartesian(), hht(ALPHA, formulation="index3"), 3),
    "rod, GGL": (pendulum.cartesian(), hht(ALPHA), 4),
    "rod, GGL, converged": (pendulum.cartesian(), hht(ALPHA, iterations=None), 4),
}
FAST_CASES = "angle, HHT", "rod, GGL"


def place(scene, q):
    """(x, y) of the mass."""
    return np.array(q) if q.size == 2 else scene.params["l"] * np.array([np.sin(q[0]), -np.cos(q[0])])


def run(report, fast):
    """Error of the position after 1 s, and time per step."""
    cases = {name: CASES[name] for name in FAST_CASES} if fast else CASES
    true = exact(SPEED, np.array([pendulum.DURATION]))[0][0]
    work = [partial(end, scene, stepper, TIMED_STEPS) for scene, stepper, _ in cases.values()]
    seconds = least_seconds(work, 1 if fast else 40)
    entries = []
    for (name, (scene, stepper, unknowns)), time in zip(cases.items(), seconds, strict=True):
        errors = [np.hypot(*(place(scene, end(scene, stepper, n)[0].q) - true)) for n in NUM_STEPS]
        entries.append(
            {
                "formulation": name,
                "unknowns": unknowns,
                "position_error_m": [float(e) for e in errors],
                "cpu_time_per_step_us": 1e6 * time / TIMED_STEPS,
                "time_over_angle": time / seconds[list(cases).index("angle, HHT")],
            }
        )
    print("One pendulum, three formulations: error of the position after 1 s, m, and time per step\n")
    header = [
        "formulation",
        "unknowns",
        *(f"h = {pendulum.DURATION / n:g} s" for n in NUM_STEPS),
        "time / HHT on the angle",
    ]
    report.table(
        header, [[e["formulation"], e["unknowns"], *e["position_error_m"], e["time_over_angle"]] for e in entries]
    )
    return {"alpha": ALPHA, "step_sizes_s": [pendulum.DURATION / n for n in NUM_STEPS], "entries": entries}
