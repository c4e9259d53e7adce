"""Figs. 3 and 4: the highly damped and the highly oscillatory equation, with amplitude and period errors."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from experiments.report import COLOURS, MARKERS
from hhtjax import FirstOrderSystem, LinearSystem, hht, kim_hht, simulate
from hhtjax.plot import legend, subplots, trajectory

RATE = 1000.0  # 1/s, of y' = -RATE y
STIFFNESS = 1000.0  # 1/s^2, of q'' + STIFFNESS q = 0
OMEGA = STIFFNESS**0.5
STEP_SIZES = (1e-4, 1e-3, 1e-2, 1e-1)  # s
ALPHAS = (0.0, -0.05, -0.3)

DAMPED = FirstOrderSystem(lambda y, t, params: -params * y)
OSCILLATOR = LinearSystem(M=jnp.ones(1), K=lambda params: params.reshape(1))


def run(report, fast):
    """Both figures, and the errors per step against theory."""
    numbers = {"damped": damped(report)}
    report.progress("Fig. 3: highly damped equation")
    numbers["oscillator"] = oscillatory(report, fast)
    report.progress("Fig. 4: highly oscillatory equation")
    return numbers


def damped(report):
    """Fig. 3, and the amplification per step, measured and mu = 1 + z/(1 - theta z), z = -RATE h."""
    figure, panels = subplots(1, 4, width=175, height=60)
    rows, numbers = [], []
    for axes, h in zip(panels, STEP_SIZES, strict=True):
        num_steps = 40
        time = np.linspace(0, num_steps * h, 1000)
        axes.plot(time, np.exp(-RATE * time), "k", lw=1, label="exact")
        for i, alpha in enumerate(ALPHAS):
            path = simulate(DAMPED, kim_hht(jnp.asarray(alpha)), jnp.ones(1), params=RATE, dt=h, num_steps=num_steps)
            path.check()
            line = {"color": COLOURS[i], "marker": MARKERS[i], "ms": 3, "lw": 0.8, "ls": "-"}
            trajectory(path, label=f"$\\alpha$ = {alpha:g}", key=False, ax=axes, **line)
            theta, z = (0.5 - alpha) * (1 + alpha), -RATE * h
            measured, theory = float(path.q[1, 0]), 1 + z / (1 - theta * z)
            rows.append([f"{h:g}", f"{alpha:g}", measured, theory, float(np.exp(z))])
            numbers.append({"h_s": h, "alpha": alpha, "factor_per_step": measured, "closed_form": theory})
        axes.set(title=f"h = {h:g} s", ylabel="")
    panels[0].set_ylabel("y")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=5)
    report.figure("kim2019_damped", figure)
    print("Fig. 3: y' = -1000 y with Kim's step, factor per step")
    report.table(["h (s)", "alpha", "of the run", "closed form", "exp(-1000 h)"], rows)
    return numbers


def polynomial(method, alpha, x):
    """Coefficients, highest first, of the characteristic polynomial for q'' + w^2 q = 0 with x = w h.

    The accelerations a of Newmark's formulas satisfy (mu - 1)^2 q = h^2 N(mu) a, and
        hht:          mu a = -w^2 [(1 + alpha) mu - alpha] q
        Kim's step:   (gamma mu + 1 - gamma) a = -w^2 [1 + gamma (1 + alpha)(mu - 1)] q    (Eq. 12, 13)
    """
    beta, gamma = (1 - alpha) ** 2 / 4, 0.5 - alpha
    newmark = [beta, 0.5 + gamma - 2 * beta, 0.5 - gamma + beta]
    if method == "hht":
        left, right = [1.0, 0.0], [1 + alpha, -alpha]
    else:
        left, right = [gamma, 1 - gamma], [gamma * (1 + alpha), 1 - gamma * (1 + alpha)]
    return np.polyadd(np.polymul([1.0, -2.0, 1.0], left), x**2 * np.polymul(newmark, right))


def theory(method, alpha, x):
    """(decrement, phase) per step of the principal root: mu = exp(-decrement + i phase)."""
    roots = np.roots(polynomial(method, alpha, x))
    mu = max(roots[roots.imag > 1e-12], key=abs)
    return -np.log(abs(mu)), np.angle(mu)


METHODS = {"Kim's step": kim_hht, "hht": partial(hht, linearize="predictor")}
SAMPLES = 200


@partial(jax.jit, static_argnames="method")
def sampled_run(alphas, h, stride, *, method):
    """q of the oscillator from v = 1 m/s at every stride-th step, (alphas, SAMPLES)."""

    def run(alpha):
        stepper = METHODS[method](alpha)

        def take(i, state):
            return stepper.step(OSCILLATOR, state, params, h)[0]

        def sample(state, _):
            return jax.lax.fori_loop(0, stride, take, state), state.q[0]

        params = jnp.asarray(STIFFNESS)
        start = stepper.init(OSCILLATOR, jnp.zeros(1), jnp.ones(1), params, h)
        return jax.lax.scan(sample, start, None, SAMPLES)[1]

    return jax.vmap(run)(alphas)


def measured(method, x):
    """(decrement, phase) per step for each alpha, from a run: the roots of the recurrence that its samples obey.

    Samples about one radian apart, for which the roots are well conditioned.
    """
    stride = max(1, round(1 / x))
    pairs = []
    for q in np.asarray(sampled_run(jnp.array(ALPHAS), x / OMEGA, stride, method=method)):
        past = np.stack([q[2:-1], q[1:-2], q[:-3]], axis=1)
        roots = np.roots([1.0, *-np.linalg.lstsq(past, q[3:], rcond=None)[0]])
        mu = max(roots[roots.imag > 1e-9], key=abs)
        pairs.append((-np.log(abs(mu)) / stride, np.angle(mu) / stride))
    return pairs


def oscillatory(report, fast):
    """Fig. 4, and amplitude and period errors against w h."""
    points, duration = (9, 20.0) if fast else (25, 100.0)
    report.figure("kim2019_oscillatory", oscillation_figure(duration, STEP_SIZES[2:] if fast else STEP_SIZES))
    sizes = np.logspace(-2.5, 0.5, points)
    numbers, curves = [], {}
    for method in METHODS:
        runs = [measured(method, x) for x in sizes]
        for i, alpha in enumerate(ALPHAS):
            ours, expected = np.array([run[i] for run in runs]), np.array([theory(method, alpha, x) for x in sizes])
            curves[method, alpha] = ours, expected
            numbers.append(
                {
                    "method": method,
                    "alpha": alpha,
                    "largest_difference_of_decrement_to_theory": float(np.max(abs(ours - expected)[:, 0])),
                    "largest_difference_of_phase_to_theory_rad": float(np.max(abs(ours - expected)[:, 1])),
                    **errors_at(method, alpha, 0.1),
                }
            )
    header = ["method", "alpha", "run - theory", "damping ratio at w h = .1", "period error at w h = .1"]
    rows = [
        [n["method"], f"{n['alpha']:g}", n["largest_difference_of_decrement_to_theory"], *list(n.values())[-2:]]
        for n in numbers
    ]
    print("Fig. 4: damping and period that the steps themselves add to q'' + 1000 q = 0")
    report.table(header, rows)
    report.figure("kim2019_amplitude_and_period", error_figure(sizes, curves))
    return numbers


def errors_at(method, alpha, x):
    """Numerical damping ratio and relative period error at w h = x."""
    decrement, phase = theory(method, alpha, x)
    return {
        "damping_ratio_at_wh_0.1": float(decrement / np.hypot(decrement, phase)),
        "period_error_at_wh_0.1": x / phase - 1,
    }


def oscillation_figure(duration, step_sizes):
    """Solutions over two periods, envelopes over a long time: of Kim's step and of the repaired one."""
    figure, (left, right) = subplots(1, 2, width=175, height=95)
    alpha = -0.05
    time = np.linspace(0, 0.4, 500)
    left.plot(time, 1e3 * np.sin(OMEGA * time) / OMEGA, "k", lw=1, label="exact")
    for i, h in enumerate(step_sizes):
        for method, style in (("Kim's step", "-"), ("hht", "--")):
            num_steps = round(duration / h)
            path = simulate(
                OSCILLATOR,
                METHODS[method](jnp.asarray(alpha)),
                jnp.zeros(1),
                jnp.ones(1),
                jnp.asarray(STIFFNESS),
                dt=h,
                num_steps=num_steps,
            )
            envelope = 1e3 * np.hypot(path.q[:, 0], path.v[:, 0] / OMEGA)
            every = max(1, num_steps // 1000)
            right.plot(
                path.t[::every], envelope[::every], style, color=COLOURS[i], lw=1.2, label=f"{method}, h = {h:g} s"
            )
            if method == "Kim's step" and h > 2e-4:
                shown = path.t <= 0.4
                style = {"color": COLOURS[i], "marker": MARKERS[i] if h > 2e-3 else "", "ms": 3, "lw": 0.9}
                left.plot(path.t[shown], 1e3 * path.q[shown, 0], label=f"Kim's step, h = {h:g} s", **style)
    for axes in (left, right):
        axes.set_xlabel("time (s)")
        axes.set_ylabel("q (mm)")
    right.set_ylabel("amplitude (mm)")
    legend(left, title=f"solution, $\\alpha$ = {alpha:g}")
    legend(right, title=f"envelope, $\\alpha$ = {alpha:g}")
    return figure


def error_figure(sizes, curves):
    """Damping ratio and period error of the methods themselves: lines by theory, markers of runs."""
    figure, (left, right) = subplots(1, 2, width=175, height=95)
    fine = np.logspace(-2.5, 0.5, 200)
    for j, method in enumerate(METHODS):
        for i, alpha in enumerate(ALPHAS):
            ours, _ = curves[method, alpha]
            expected = np.array([theory(method, alpha, x) for x in fine])
            line = {"color": COLOURS[i], "ls": "-" if j == 0 else "--", "lw": 1}
            dots = {"color": COLOURS[i], "marker": MARKERS[j], "ls": "", "ms": 4, "mfc": "none" if j else COLOURS[i]}
            if alpha:
                left.loglog(fine, expected[:, 0] / np.hypot(*expected.T), **line)
                left.loglog(sizes, ours[:, 0] / np.hypot(*ours.T), label=f"{method}, $\\alpha$ = {alpha:g}", **dots)
            right.loglog(fine, fine / expected[:, 1] - 1, **line)
            right.loglog(sizes, sizes / ours[:, 1] - 1, label=f"{method}, $\\alpha$ = {alpha:g}", **dots)
    left.set_ylim(1e-11, 1)
    left.set_ylabel("numerical damping ratio")
    right.set_ylabel("relative period error")
    for axes in (left, right):
        axes.set_xlabel(r"$\omega h$ (rad)")
        legend(axes)
    left.text(0.02, 0.98, "lines: theory, markers: runs", transform=left.transAxes, va="top")
    return figure
