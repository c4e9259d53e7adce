"""Error against step size for every stepper and alpha, one compiled call for each stepper, with fitted orders.

Double pendulum without springs, from (0.3, -0.2) rad and (0.5, -1) rad/s, for a second; error of the angles at its end
against RK4 with h = 1e-4 s. Then what the step size does to an identified stiffness: of the first joint's spring, by
Gauss-Newton on exact derivatives, all step sizes at once, each with its own estimate.
"""

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.report import COLOURS, MARKERS
from hhtjax import trigonometry
from hhtjax.plot import error_against_h, legend, subplots
from hhtjax.scenes import double_pendulum

DURATION = 1.0
Q0, V0 = np.array([0.3, -0.2]), np.array([0.5, -1.0])
ALPHAS = (0.0, -0.05, -0.1, -0.3)
WITH_ALPHA = {
    "hht auto": lambda alpha: hhtjax.hht(alpha),
    "hht predictor": lambda alpha: hhtjax.hht(alpha, linearize="predictor"),
    "hht converged": lambda alpha: hhtjax.hht(alpha, iterations=None),
    "bossak": lambda alpha: hhtjax.bossak(alpha),
    "kim_hht": hhtjax.kim_hht,
    "operator_splitting": hhtjax.operator_splitting,
}
WITHOUT = {
    "newmark": hhtjax.newmark(),
    "generalized_alpha": hhtjax.generalized_alpha(0.8),
    "rosenbrock": hhtjax.rosenbrock(),
    "rowda": hhtjax.rowda(),
    "implicit_euler": hhtjax.implicit_euler(),
    "houbolt": hhtjax.houbolt(),
    "park": hhtjax.park(),
    "wilson": hhtjax.wilson(),
    "rk4": hhtjax.rk4(),
}
TRUE_STIFFNESS = 20.0  # N m/rad


def scene():
    """The free pendulum with polynomial sines."""
    return double_pendulum.free(trigonometry)


def errors(name, dts):
    """(alphas, step sizes): largest error of an angle at the end."""
    system, params, *_ = scene()
    exact = reference(system, params)
    if name in WITHOUT:
        alphas, stepper, axis = [None], WITHOUT[name], None
    else:
        alphas, axis = ALPHAS, 0
        stepper = jax.vmap(WITH_ALPHA[name])(jnp.repeat(jnp.array(ALPHAS), len(dts)))
    runs = hhtjax.sweep(
        system, stepper, Q0, V0, params, dts=np.tile(dts, len(alphas)), duration=DURATION, num_samples=1,
        in_axes=(axis, None, None, None),
    )  # fmt: skip
    found = np.abs(np.asarray(runs.q[:, -1]) - exact).max(axis=1)
    return alphas, found.reshape(len(alphas), len(dts)), np.asarray(runs.dt[: len(dts)])


def reference(system, params):
    """The angles at the end."""
    runs = hhtjax.sweep(
        system, hhtjax.rk4(), Q0, V0, params, dts=np.array([1e-4]), duration=DURATION, num_samples=1
    )  # fmt: skip
    return np.asarray(runs.q[0, -1])


def fitted_order(dts, error):
    """Slope of log error in log h, over the six smallest steps whose error is not rounding."""
    good = np.isfinite(error) & (error > 1e-11) & (dts <= 0.02)
    order = np.argsort(dts[good])[:6]
    return float(np.polyfit(np.log(dts[good][order]), np.log(error[good][order]), 1)[0])


def stiffness(steppers, dts, iterations=6):
    """{name: relative error of the stiffness identified at each step size} from 40 samples without noise."""
    system, params, *_ = scene()
    samples = 40

    def motion(stepper, k, dts):
        return hhtjax.sweep(
            system, stepper, Q0, V0, params | {"k": (k, 10.0)}, dts=dts, duration=4.0, num_samples=samples,
            in_axes=(None, None, None, {**dict.fromkeys(params), "k": (0, None)}),
        ).q  # fmt: skip

    truth = motion(hhtjax.rk4(), np.array([TRUE_STIFFNESS]), np.array([1e-4]))[0]

    @jax.jit
    def improve(stepper, k, dts):
        q, slope = jax.jvp(lambda k: motion(stepper, k, dts), (k,), (jnp.ones_like(k),))
        return k - jnp.sum(slope * (q - truth), axis=(1, 2)) / jnp.sum(slope**2, axis=(1, 2))

    found = {}
    for name, stepper in steppers.items():
        k = np.full(len(dts), TRUE_STIFFNESS)
        for _ in range(iterations):
            k = improve(stepper, k, dts)
        found[name] = (np.asarray(k) / TRUE_STIFFNESS - 1).tolist()
    return found


def run(report, fast):
    """All steppers; the stiffness with four of them."""
    dts = np.logspace(-3.5, -1, 6 if fast else 26)
    rows = []
    for name in ["rk4"] if fast else [*WITH_ALPHA, *WITHOUT]:
        alphas, found, used = errors(name, dts)
        for alpha, error in zip(alphas, found, strict=True):
            order = fitted_order(used, error)
            rows.append(
                {"method": name, "alpha": alpha, "order": order, "h_s": used.tolist(), "error_rad": error.tolist()}
            )
        report.progress(f"orders: {name}")
    print("Fitted orders\n")
    report.table(
        ["method", "alpha", "order"],
        [[r["method"], "-" if r["alpha"] is None else f"{r['alpha']:g}", r["order"]] for r in rows],
    )
    if fast:
        return {"rows": rows}
    chosen = {"hht(-0.05)": hhtjax.hht(-0.05, linearize="predictor"), "kim_hht(-0.05)": hhtjax.kim_hht(-0.05)}
    chosen |= {"newmark": hhtjax.newmark(linearize="predictor"), "rosenbrock": hhtjax.rosenbrock()}
    coarse = np.logspace(-3.5, -1.6, 16)
    biases = stiffness(chosen, coarse)
    report.progress("orders: stiffness")
    report.figure("sweeps_orders", figure(rows, coarse, biases))
    return {"rows": rows, "stiffness": {"h_s": coarse.tolist(), "relative_error": biases}}


def figure(rows, coarse, biases):
    """Errors of the steppers, of alpha, and of the stiffness."""
    drawn, grid = subplots(2, 2, width=175, height=165)
    left, middle, right, key = grid.flat
    shown = [row for row in rows if row["alpha"] in (None, -0.1) and row["method"] != "hht predictor"]
    curves = {f"{row['method']} ({row['order']:.2f})": (row["h_s"], row["error_rad"]) for row in shown}
    lines = {name: {"ms": 3, "ls": ("-", "--")[i // 8], "lw": 1} for i, name in enumerate(curves)}
    error_against_h(curves, lines=lines, key=False, ax=left)
    left.set_ylim(1e-13, 10)
    curves, lines = {}, {}
    for i, alpha in enumerate(ALPHAS):
        for name, line in (("hht predictor", "-"), ("kim_hht", "--")):
            row = next(r for r in rows if r["method"] == name and r["alpha"] == alpha)
            label = f"{name}, {alpha:g} ({row['order']:.2f})"
            curves[label] = row["h_s"], row["error_rad"]
            lines[label] = {"ls": line, "color": COLOURS[i], "marker": MARKERS[i], "ms": 3}
    error_against_h(curves, lines=lines, key=False, ax=middle)
    error_against_h({name: (coarse, np.abs(bias)) for name, bias in biases.items()}, ax=right)
    right.set_ylabel("relative error of the stiffness")
    for axes in (left, middle):
        axes.set_ylabel("error of the angles after 1 s (rad)")
    key.axis("off")
    key.legend(*left.get_legend_handles_labels(), title="upper left", loc="center")
    legend(middle)
    return drawn
