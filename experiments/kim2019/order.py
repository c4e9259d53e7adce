"""What the paper does not say (2): its step and conventional HHT are of order one, by the modified equation."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import jvp

from experiments.report import COLOURS, side_by_side
from hhtjax import System, conventional_hht, hht, kim_hht, rk4
from hhtjax.numerics.linear_solve import solve
from hhtjax.plot import subplots
from hhtjax.scenes import double_pendulum

DURATION = 1.0  # s
STEPS = (50, 100, 200, 400, 800, 1600, 3200, 6400, 12800)
REFERENCE_STEPS = 6400  # of rk4
PARAMS = {"m": (1.5, 1.0), "l": (1.0, 1.5), "k": (20.0, 10.0), "c": (0.5, 0.3), "g": double_pendulum.GRAVITY}
Q0, V0 = jnp.array([0.3, -0.2]), jnp.array([0.5, -1.0])


def torques(t):
    """The explicit time: a torque on each joint, N m."""
    return jnp.array([3.0 * jnp.sin(5.0 * t), 2.0 * jnp.cos(3.0 * t)])


def force(q, v, t, params):
    """Q: the complete double pendulum; params["drive"] switches the explicit time on."""
    return double_pendulum.force(q, v, t, params) + params["drive"] * torques(t)


def mass(q, params):
    """M(q), or the one at q = 0 for params["varying_mass"] = 0."""
    return double_pendulum.mass(params["varying_mass"] * q, params)


SYSTEM = System(mass, force)


def mass_rate(q, v, w, params):
    """(dM/dt) w."""
    return jvp(lambda q: mass(q, params) @ w, (q,), (v,))[1]


def literal_defect(alpha, q, v, w, t, params):
    """M e of M(q1) a1 = (1 + alpha) Q1 - alpha Q0 (theory: e = alpha M^-1 (dM/dt) w)."""
    return alpha * mass_rate(q, v, w, params)


def fictive_defect(alpha, q, v, w, t, params):
    """The same with Q1 at the time t + (1 + alpha) h: alpha (1 + alpha) dQ/dt more."""
    explicit = jvp(lambda t: force(q, v, t, params), (t,), (jnp.ones_like(t),))[1]
    return literal_defect(alpha, q, v, w, t, params) + alpha * (1 + alpha) * explicit


def kim_defect(alpha, q, v, w, t, params):
    """M e of Kim's step: (-alpha/2 - alpha^2)(Q_q v + Q_v w) + alpha (dM/dt) w - (dQ/dt)/2."""
    explicit = jvp(lambda t: force(q, v, t, params), (t,), (jnp.ones_like(t),))[1]
    states = jvp(lambda q, v: force(q, v, t, params), (q, v), (v, w))[1]
    return (-alpha / 2 - alpha**2) * states + alpha * mass_rate(q, v, w, params) - explicit / 2


METHODS = {  # name: (alpha -> stepper, M e; None for a method of order two)
    "conventional HHT, Eq. 5 with t~": (partial(conventional_hht, tolerance=1e-12), fictive_defect),
    "conventional HHT": (partial(conventional_hht, tolerance=1e-12, fictive_time=False), literal_defect),
    "non-iterative HHT, Eq. 13": (kim_hht, kim_defect),
    "hht, converged": (partial(hht, iterations=None, tolerance=1e-12), None),
    "hht, refreshed": (partial(hht, linearize="state"), None),
    "hht, predictor": (partial(hht, linearize="predictor"), None),
}


def run_to_end(system, stepper, params, num_steps):
    """(q, v) after DURATION."""
    dt = DURATION / num_steps
    start = stepper.init(system, Q0, V0, params, dt)
    state = jax.lax.fori_loop(0, num_steps, lambda i, s: stepper.step(system, s, params, dt)[0], start)
    return jnp.concatenate([state.q, state.v])


@partial(jax.jit, static_argnames="method")
def end(method, alpha, params, num_steps):
    """(q, v) at the end; num_steps traced, so that one compilation serves all."""
    return run_to_end(SYSTEM, METHODS[method][0](alpha), params, num_steps)


@partial(jax.jit, static_argnames="defect")
def modified(defect, alpha, params, h):
    """(q, v) at the end of the modified equation M w = Q + h M e, that is v' = f + h e; no defect: the exact motion."""

    def perturbed(q, v, t, everything):
        params, alpha, h = everything
        Q = force(q, v, t, params)
        return Q if defect is None else Q + h * defect(alpha, q, v, solve(mass(q, params), Q), t, params)

    system = System(lambda q, everything: mass(q, everything[0]), perturbed)
    return run_to_end(system, rk4(), (params, alpha, h), REFERENCE_STEPS)


def order(steps, errors):
    """Order of convergence, by the two finest steps that rounding spares."""
    kept = np.flatnonzero(errors > 1e-9)[-2:]
    return float(-np.diff(np.log(errors[kept]))[0] / np.diff(np.log(np.array(steps)[kept]))[0])


SHOWN = ("conventional HHT, Eq. 5 with t~", "non-iterative HHT, Eq. 13", "hht, refreshed")
CASES = {  # name: alpha, varying mass, explicit time
    "M(q), explicit time": (-0.1, 1.0, 1.0),
    "M(q)": (-0.1, 1.0, 0.0),
    "explicit time": (-0.1, 0.0, 1.0),
    "neither": (-0.1, 0.0, 0.0),
    "alpha = 0, M(q)": (0.0, 1.0, 0.0),
    "alpha = 0, M(q), explicit time": (0.0, 1.0, 1.0),
}


def compile_all(methods):
    """Compiles everything, on all cores."""
    params = PARAMS | {"varying_mass": 1.0, "drive": 1.0}
    defects = dict.fromkeys(METHODS[method][1] for method in methods)
    side_by_side(
        [partial(end, method, -0.1, params, STEPS[0]) for method in methods]
        + [partial(modified, defect, -0.1, params, 0.01) for defect in defects]
    )


def run(report, fast):
    """For each case and method: order against the exact and against the modified motion."""
    steps = STEPS[::3] if fast else STEPS
    methods = SHOWN if fast else tuple(METHODS)
    compile_all(methods)
    curves = {}
    for case, (alpha, varying, drive) in list(CASES.items())[: 1 if fast else None]:
        params = PARAMS | {"varying_mass": varying, "drive": drive}
        for method in methods:
            rows, defect = [], METHODS[method][1]
            exact = modified(None, alpha, params, 0.0)
            for num_steps in steps:
                ours = end(method, alpha, params, num_steps)
                predicted = modified(defect, alpha, params, DURATION / num_steps)
                rows.append([jnp.linalg.norm(x) for x in (ours - exact, predicted - exact, ours - predicted)])
            curves[case, method] = np.array(rows)
        report.progress(f"orders: {case}")
    numbers, table = [], []
    for (case, method), errors in curves.items():
        observed, remainder = order(steps, errors[:, 0]), order(steps, errors[:, 2])
        ratio = float(errors[-1, 0] / errors[-1, 1]) if errors[-1, 1] > 1e-3 * errors[-1, 0] else None
        numbers.append(
            {
                "case": case,
                "alpha": CASES[case][0],
                "method": method,
                "order": observed,
                "order_after_subtracting_the_modified_motion": remainder,
                "error_over_predicted_at_finest": ratio,
                "error": errors[:, 0].tolist(),
                "predicted": errors[:, 1].tolist(),
                "remainder": errors[:, 2].tolist(),
            }
        )
        table.append([case, method, observed, remainder, "-" if ratio is None else f"{ratio:.4f}"])
    print("Order of convergence of (q, v) at t = 1 s, and what is left after the modified equation's prediction")
    report.table(["case", "method", "order", "order of the rest", "error / predicted"], table)
    report.figure("kim2019_order", figure(np.array(steps), curves))
    return {"step_sizes_s": [DURATION / n for n in steps], "entries": numbers}


def figure(steps, curves):
    """Errors, predicted errors and remainders of the first case, for three methods."""
    case = next(iter(CASES))
    drawn, panels = subplots(1, 3, width=175, height=80, sharey=True)
    h = DURATION / steps
    for axes, method in zip(panels, SHOWN, strict=True):
        error, predicted, rest = curves[case, method].T
        axes.loglog(h, error, "o", color=COLOURS[0], label="error")
        if predicted.max() > 1e-9:
            axes.loglog(h, predicted, "-", color=COLOURS[0], label="modified equation's prediction")
            axes.loglog(h, rest, "s", color=COLOURS[1], ms=5, label="error - prediction")
            axes.loglog(h, predicted[-1] * (h / h[-1]) / 2, "k:", lw=0.8, label="slopes 1 and 2")
        axes.loglog(h, rest[-1] * (h / h[-1]) ** 2 / 2, "k:", lw=0.8)
        axes.set_title(f"{method}")
        axes.set_xlabel("step size h (s)")
    panels[0].set_ylabel("norm of the error of (q, v) at t = 1 s")
    drawn.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    drawn.suptitle(f"forced double pendulum, $\\alpha$ = {CASES[case][0]:g}")
    return drawn
