"""Operator splitting, which Kim et al. (2019) set out from: its order, and where its initial tangent is not enough.

Every scene is run with every method, alpha and step size. An error is relative: RMS of q - q_reference at 64 times,
over the RMS of the reference's motion about its mean; a run is bounded if it is finite and never ten times as far from
q0 as the reference gets.

Then the limits of h. Of an undamped oscillator with another stiffness than the initial one: the spectral radius of the
library's step, against the bounds in the docstring of `operator_splitting`. Of the hardening spring, over 1000 steps:
against the same bounds with the highest tangent of its orbit, held: a guide only, because the true tangent varies.
Where no h is stable, the motion grows slowly enough to last 1000 small steps. From q = 1 no tangent on the orbit
exceeds the initial one; but q~ does not move on that orbit: for alpha = 0 it starts as if from q0 - h^2 a0/4.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from experiments.cells import FARTHEST, SAMPLES, relative_error, solve_reference
from experiments.linearization.scenes import Case
from experiments.report import COLOURS, MARKERS
from hhtjax import System, hht, operator_splitting, simulate
from hhtjax.plot import error_against_h, legend, subplots
from hhtjax.scenes import double_pendulum, duffing

ALPHAS = (0.0, -0.05, -0.3)
DRAWN = 1  # alpha of the error panels
METHODS = {
    "splitting": operator_splitting,
    "splitting, modified": partial(operator_splitting, modified=True),
    "hht, non-iterative": hht,
    "hht, converged": partial(hht, iterations=None),
}
FAST_METHODS = ("splitting", "hht, non-iterative")
NUM_STEPS = SAMPLES * 2 ** np.arange(9, -1, -1)  # the smallest step first
RATIOS = np.geomspace(0.5, 20, 25)  # stiffness over initial stiffness of the oscillator
SPEED = 5100**0.5  # m/s, with which the hardening spring gets from q = 0 to q = 1 m
INITIAL = {"from q = 1": 30100.0, "from q = 0": 100.0}  # N/m, its tangent at the start
HIGHEST = 30100.0  # N/m, its tangent at q = 1 m
SPRING_STEPS = 1000
SPRING_DTS = np.arange(10, 301) * 1e-4  # s


def cases() -> list[Case]:
    """Nonlinear inertia; a stiff system; one orbit of a hardening spring, from its stiffest and its softest point."""
    stiff = double_pendulum.stiff(as_printed=True)
    free = double_pendulum.free()._replace(system=stiff.system)  # has no joint torques; one system compiles once
    spring = duffing.hardening_spring()
    struck = spring._replace(q0=jnp.array([0.0]), v0=jnp.array([SPEED]))
    return [
        Case("free double pendulum", free, SAMPLES, "DOP853"),
        Case("stiff double pendulum, as printed", stiff, SAMPLES, "LSODA"),
        Case("hardening spring from q = 1", spring, SAMPLES, "DOP853"),
        Case("hardening spring from q = 0", struck, SAMPLES, "DOP853", fast=True),
    ]


@partial(jax.jit, static_argnames="method")
def simulate_all(scene, num_steps, method):
    """For each alpha: q at the sample times, and its largest distance from q0. One compilation for all num_steps."""
    dt = scene.duration / num_steps

    def simulate_one(alpha):
        stepper = METHODS[method](alpha)

        def step(i, carry):
            state, path, farthest = carry
            state, _ = stepper.step(scene.system, state, scene.params, dt)
            path = path.at[i // (num_steps // SAMPLES)].set(state.q)  # the last one to write is the one on time
            return state, path, jnp.maximum(farthest, jnp.max(jnp.abs(state.q - scene.q0)))

        start = stepper.init(scene.system, scene.q0, scene.v0, scene.params, dt)
        return jax.lax.fori_loop(0, num_steps, step, (start, jnp.zeros((SAMPLES, scene.q0.size)), 0.0))[1:]

    return jax.vmap(simulate_one)(jnp.array(ALPHAS))


def relative_errors(case, method, reference):
    """(step sizes, alphas); NaN where the run is not bounded."""
    errors = []
    for num_steps in NUM_STEPS.tolist():
        path, farthest = (np.asarray(x) for x in simulate_all(case.scene, num_steps, method))
        error = relative_error(path, num_steps, reference)
        errors.append(np.where(farthest <= FARTHEST * reference.reach, error, np.nan))
    return np.array(errors)


def largest_bounded(bounded, dts):
    """Largest of the ascending dts up to which all are bounded; NaN if the first is not."""
    count = len(dts) if np.all(bounded) else int(np.argmin(bounded))
    return float(dts[count - 1]) if count else float("nan")


def predicted_limit(alpha, stiffness, initial):
    """Largest stable h of the undamped oscillator of unit mass: 0 where none is, inf where all are."""
    if -4 * alpha * stiffness > (1 - alpha) ** 2 * initial:
        return 0.0
    excess = (1 - 4 * alpha**2) * (stiffness - initial) - (1 + 2 * alpha) * alpha**2 * initial
    return 2 / excess**0.5 if excess > 0 else float("inf")


@jax.jit
def amplification_matrix(alpha, stiffness, initial, dt):
    """Of the library's own step on (q, v, a, P), by automatic differentiation."""
    stepper = operator_splitting(alpha)
    system = System(jnp.ones(1), lambda q, v, t, params: -stiffness * q)
    start = stepper.init(system, jnp.zeros(1), jnp.zeros(1), None, dt)
    memory = start.memory._replace(K=jnp.reshape(initial, (1, 1)))

    def step(x):
        q, v, a, P = x[:, None]
        state, _ = stepper.step(system, start._replace(q=q, v=v, w=a, memory=memory._replace(P=P)), None, dt)
        return jnp.concatenate([state.q, state.v, state.w, state.memory.P])

    return jax.jacfwd(step)(jnp.zeros(4))


def measured_limit(alpha, stiffness, initial, low=0.05, high=200.0):
    """The same by bisection on the spectral radius; 0 where it is below `low`, inf above `high`."""

    def stable(dt):
        matrix = amplification_matrix(alpha, stiffness, initial, dt)
        return np.max(np.abs(np.linalg.eigvals(matrix))) < 1 + 1e-9

    if not stable(low):
        return 0.0
    if stable(high):
        return float("inf")
    while high / low > 1 + 1e-6:
        middle = (low * high) ** 0.5
        low, high = (middle, high) if stable(middle) else (low, middle)
    return low


@jax.jit
def spring_paths(scene, alpha):
    """q for each of SPRING_DTS."""

    def path(dt):
        stepper = operator_splitting(alpha)
        return simulate(scene.system, stepper, scene.q0, scene.v0, scene.params, dt=dt, num_steps=SPRING_STEPS).q

    return jax.vmap(path)(jnp.asarray(SPRING_DTS))


def spring_reach(scene, alpha):
    """Largest |q| for each of SPRING_DTS; NaN where it overflows."""
    return np.abs(np.asarray(spring_paths(scene, alpha))).max(axis=(1, 2))


def error_panel(axes, case, errors):
    """Error against h; runs that are not bounded are crosses along the upper edge."""
    dts, curves, lines = case.scene.duration / NUM_STEPS, {}, {}
    for i, (method, error) in enumerate(errors.items()):
        drawn = error[:, DRAWN]
        lost = dts[np.isnan(drawn)]
        lines[method] = {"ls": "-", "lw": 1} | ({"ms": 3} if i % 2 else {"ms": 8, "fillstyle": "none"})
        curves[method] = dts, drawn
        axes.plot(lost, np.full(len(lost), 50 / 3**i), "x", color=COLOURS[i], label="_lost")
    error_against_h(curves, lines=lines, key=False, ax=axes)
    axes.set(title=case.name, ylabel="relative RMS error of q", ylim=(1e-7, 100))


def limit_panel(axes, limits):
    """Limits of the oscillator: lines predicted, markers measured."""
    fine = np.geomspace(1.001, RATIOS[-1], 500)
    for i, (alpha, (measured, _)) in enumerate(limits.items()):
        predicted = np.array([predicted_limit(alpha, ratio, 1.0) for ratio in fine])
        axes.loglog(fine, np.where(predicted > 0, predicted, np.nan), color=COLOURS[i], linewidth=1)
        axes.plot(RATIOS, measured, MARKERS[i], color=COLOURS[i], markersize=4, label=f"alpha = {alpha:g}")
        if alpha:
            axes.axvline((1 - alpha) ** 2 / (-4 * alpha), color=COLOURS[i], linestyle="--", linewidth=1)
    axes.set(xlabel="stiffness / initial stiffness", xlim=(0.9, 21))
    axes.set(ylabel="largest stable h sqrt(k0/m)", ylim=(0.4, 30))
    axes.set_xticks([1, 2, 5, 10, 20], ["1", "2", "5", "10", "20"])
    axes.minorticks_off()
    legend(axes, title="oscillator: none stable right of dashes")


def spring_panel(axes, reach):
    """Largest |q| of the hardening spring; a line ends where the first run leaves the picture."""
    for i, (alpha, q) in enumerate(reach["from q = 0"].items()):
        bounded = np.logical_and.accumulate(q < 2)
        axes.plot(1e3 * SPRING_DTS[bounded], q[bounded], color=COLOURS[i], label=f"alpha = {alpha:g}")
        axes.plot(1e3 * SPRING_DTS[bounded][-1], q[bounded][-1], "x", color=COLOURS[i])
    axes.axvline(1e3 * predicted_limit(0.0, HIGHEST, INITIAL["from q = 0"]), color="0.3", linestyle=":")
    axes.set(xlabel="h in ms")
    axes.set(ylabel=f"largest |q| in {SPRING_STEPS} steps, m", xlim=(0, 13), ylim=(0, 2))
    legend(axes, title="hardening spring from q = 0")


def draw(errors, limits, reach):
    """The scenes; the limit of the oscillator; the hardening spring against h."""
    figure, grid = subplots(2, 3, width=175, height=150)
    for axes, case in zip(grid[:, :2].flat, cases(), strict=True):
        if case.name in errors:
            error_panel(axes, case, errors[case.name])
        axes.set_visible(case.name in errors)
    limit_panel(grid[0, 2], limits)
    spring_panel(grid[1, 2], reach)
    title = f"Four scenes on the left: alpha = {ALPHAS[DRAWN]:g}; triangles: orders. Crosses: unbounded."
    figure.legend(*grid[1, 1].get_legend_handles_labels(), loc="outside lower center", ncols=4, title=title)
    return figure


def to_json(x):
    """Four digits; None for what is not finite."""
    if isinstance(x, dict):
        return {str(key): to_json(value) for key, value in x.items()}
    if np.ndim(x):
        return [to_json(y) for y in x]
    return float(f"{x:.4g}") if np.isfinite(x) else None


def run(report, fast):
    """Errors, slopes, limits, and the figure."""
    methods = FAST_METHODS if fast else tuple(METHODS)
    errors, rows = {}, []
    for case in cases():
        if fast and not case.fast:
            continue
        reference, dts = solve_reference(case), case.scene.duration / NUM_STEPS
        errors[case.name] = {method: relative_errors(case, method, reference) for method in methods}
        for method, error in errors[case.name].items():
            largest = [largest_bounded(np.isfinite(x), dts) for x in error.T]
            rows.append([case.name, method, *np.log2(error[1] / error[0]), *largest])
        report.progress(f"splitting: {case.name}")
    names = [f"alpha = {alpha:g}" for alpha in ALPHAS]
    print("Slope of the error over the two smallest steps; largest h in s tried that stays bounded.\n")
    report.table(["scene", "method", *(f"slope, {x}" for x in names), *(f"h, {x}" for x in names)], rows)

    limits = {
        alpha: [[limit(alpha, ratio, 1.0) for ratio in RATIOS.tolist()] for limit in (measured_limit, predicted_limit)]
        for alpha in ALPHAS
    }
    springs = dict(zip(INITIAL, cases()[-2:], strict=True))
    reach = {start: {alpha: spring_reach(case.scene, alpha) for alpha in ALPHAS} for start, case in springs.items()}
    spring = {
        f"{start}, alpha = {alpha:g}": [
            largest_bounded(q < FARTHEST, SPRING_DTS),
            predicted_limit(alpha, HIGHEST, INITIAL[start]),
        ]
        for start, by_alpha in reach.items()
        for alpha, q in by_alpha.items()
    }
    print(f"Hardening spring: largest h in s that stays bounded over {SPRING_STEPS} steps, and predicted.\n")
    report.table(["start", "measured", "predicted"], [[start, *row] for start, row in spring.items()])
    report.figure("kim2019_splitting", draw(errors, limits, reach))
    return to_json(
        {
            "alphas": ALPHAS,
            "slopes": {f"{case}, {method}": row for case, method, *row in (row[:5] for row in rows)},
            "largest_bounded_h_s": {f"{case}, {method}": row[3:] for case, method, *row in rows},
            "oscillator_stiffness_ratios": RATIOS,
            "oscillator_limit_of_h_sqrt_k0_over_m": {
                alpha: {"measured": measured, "predicted": predicted} for alpha, (measured, predicted) in limits.items()
            },
            "hardening_spring_limit_s": {
                start: {"measured": measured, "predicted": predicted} for start, (measured, predicted) in spring.items()
            },
        }
    )
