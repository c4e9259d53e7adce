"""Sec. 2.4, Fig. 1: what the steps do at infinite frequency, from their own tangents, and to multipliers in a run."""

from collections import Counter
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from experiments.report import COLOURS, MARKERS
from hhtjax import hht
from hhtjax.analysis import (
    amplification_matrix,
    constraint_matrix,
    jordan_structure,
    oscillator_matrix,
    transient_growth,
)
from hhtjax.plot import legend, subplots
from hhtjax.scenes import pendulum, squeezer

ALPHAS = (0.0, -0.05, -0.1, -0.3)
FIG1_ALPHAS = (*ALPHAS, -0.01)
FORMULATIONS = ("index3", "ggl")
SCENES = {"pendulum": pendulum.cartesian(), "squeezer": squeezer.squeezer()}
TANGENT_DT = 1e-6  # s; short, so that what is not infinitely stiff has an eigenvalue of 1 or 0
NUM_STEPS = 100
RUN_DT, RUN_STEPS = 1e-3, 1000  # s, of the pendulum
SHOWN_STEPS = (1, 10, 100, 1000)


def double_root(alpha):
    """Closed form, Eq. 42: of the index-3 constraint."""
    return -(1 + alpha) / (1 - alpha)


def ggl_root(alpha):
    """-(1 - gamma)/gamma: of the stabilised one."""
    return -(0.5 + alpha) / (0.5 - alpha)


@partial(jax.jit, static_argnames="formulation")
def tangent(scene, alpha, formulation):
    """A of the first step of a mechanism."""
    stepper = hht(alpha, formulation=formulation)
    state = stepper.init(scene.system, scene.q0, scene.v0, scene.params, TANGENT_DT)
    return amplification_matrix(scene.system, stepper, state, scene.params, dt=TANGENT_DT)


@partial(jax.jit, static_argnames="formulation")
def multiplier_growth(scene, alpha, formulation):
    """Derivative of the tension in each step of a run, with respect to a radial velocity at its start: N s/m."""
    stepper = hht(alpha, formulation=formulation)
    start = stepper.init(scene.system, scene.q0, scene.v0, scene.params, RUN_DT)

    def tensions(speed):
        state = start._replace(v=start.v + speed * scene.q0 / scene.params["l"])

        def step(state, _):
            state, _ = stepper.step(scene.system, state, scene.params, RUN_DT)
            return state, -scene.params["l"] * state.L[0]

        return jax.lax.scan(step, state, None, RUN_STEPS)[1]

    return jax.jvp(tensions, (0.0,), (1.0,))[1]


def in_words(found):
    """Eigenvalues with number and size of their Jordan blocks: -1 (6 x 2), ..."""
    words = []
    for value, blocks in found:
        sizes = " + ".join(f"{number} x {size}" for size, number in Counter(blocks).items())
        words.append(f"{round(value.real, 6) + 0.0:.5g} ({sizes})")
    return ", ".join(words)


def fig1(alphas):
    """|D23| for n = 0, 1, ... from the powers of the step's tangent, its peak, and the peak of the closed form."""
    numbers, curves = {}, {}
    for alpha in alphas:
        growth = transient_growth(constraint_matrix(hht(jnp.asarray(alpha), formulation="index3")), NUM_STEPS)
        n = np.arange(NUM_STEPS + 1.0)
        exact = n * abs(double_root(alpha)) ** (n - 1)
        curves[alpha] = growth
        numbers[f"{alpha:g}"] = {
            "n_max": int(growth.argmax()) if alpha else None,
            "n_max_closed_form": float(-1 / np.log(abs(double_root(alpha)))) if alpha else None,
            "largest": float(growth.max()),
            "largest_relative_deviation_from_closed_form": float(np.max(abs(growth[1:] / exact[1:] - 1))),
        }
    return numbers, curves


def spectra(scenes, formulations):
    """Of the first step of each mechanism: eigenvalues, Jordan blocks, their distance from the closed form, n_max."""
    numbers, rows = [], []
    for name in scenes:
        scene = SCENES[name]
        for formulation in formulations:
            for alpha in ALPHAS:
                A = tangent(scene, alpha, formulation)
                found = jordan_structure(A)
                exact = double_root(alpha) if formulation == "index3" else ggl_root(alpha)
                root = min(found, key=lambda x: abs(x.value - exact))
                growth = transient_growth(A, NUM_STEPS, near=exact)
                peak = int(growth.argmax()) if growth.any() and alpha else None
                numbers.append(
                    {
                        "scene": name,
                        "formulation": formulation,
                        "alpha": alpha,
                        "eigenvalues": [[x.value.real, list(x.blocks)] for x in found],
                        "deviation_of_the_constraints_root": abs(root.value - exact),
                        "largest_block_of_the_constraints_root": root.blocks[0],
                        "n_max": peak,
                    }
                )
                shown = "grows" if growth.any() and not alpha else "-" if peak is None else str(peak)
                rows.append([name, formulation, f"{alpha:g}", in_words(found), abs(root.value - exact), shown])
    return numbers, rows


def loci(alphas):
    """Eigenvalues of the oscillator from W = 0.01 to 1000: {alpha: (points,), complex}."""
    W = jnp.geomspace(1e-2, 1e3, 200)
    matrices = jax.jit(lambda alpha: jax.vmap(lambda W: oscillator_matrix(hht(alpha, linearize="predictor"), W))(W))
    return {alpha: np.linalg.eigvals(np.asarray(matrices(alpha))).ravel() for alpha in alphas}


def run(report, fast):
    """Fig. 1, the spectra of two mechanisms, and the growth of a perturbation in a run of the pendulum."""
    peaks, curves = fig1(FIG1_ALPHAS)
    print("Fig. 1: |D23| from the powers of the step's tangent, and its closed form n |mu|^(n-1)")
    report.table(
        ["alpha", "n_max", "closed form", "largest |D23|", "relative deviation"],
        [[alpha, *("-" if x is None else x for x in row.values())] for alpha, row in peaks.items()],
    )
    scenes, formulations = (list(x)[: 1 if fast else None] for x in (SCENES, FORMULATIONS))
    numbers, rows = spectra(scenes, formulations)
    print(f"Tangent of the first step, dt = {TANGENT_DT:g} s: eigenvalues with the number and size of Jordan blocks")
    report.table(["scene", "form", "alpha", "eigenvalues (blocks)", "deviation", "n_max"], rows)
    report.progress("infinity: spectra")
    growth = {
        (formulation, alpha): np.asarray(multiplier_growth(SCENES["pendulum"], alpha, formulation))
        for formulation in formulations
        for alpha in ALPHAS
    }
    print(f"Pendulum, h = {RUN_DT:g} s: what 1 m/s of radial velocity at the start adds to the tension, in N")
    report.table(
        ["form", "alpha", *(f"step {n}" for n in SHOWN_STEPS)],
        [
            [formulation, f"{alpha:g}", *(abs(x[n - 1]) for n in SHOWN_STEPS)]
            for (formulation, alpha), x in growth.items()
        ],
    )
    report.figure("cardona_geradin1989_infinity", figure(curves, loci(ALPHAS), growth))
    return {
        "fig1": peaks,
        "spectra": numbers,
        "tension_per_radial_velocity_N_s_per_m": {
            f"{formulation}, alpha = {alpha:g}": {str(n): float(abs(x[n - 1])) for n in SHOWN_STEPS}
            for (formulation, alpha), x in growth.items()
        },
    }


def figure(curves, roots, growth):
    """Fig. 1; the roots of the oscillator on their way to infinity; the tension of the pendulum."""
    drawn, (left, middle, right) = subplots(1, 3, width=175, height=85)
    style = {alpha: {"color": COLOURS[i], "marker": MARKERS[i]} for i, alpha in enumerate(FIG1_ALPHAS)}
    n = np.linspace(0, NUM_STEPS, 1001)
    for alpha, curve in sorted(curves.items(), reverse=True):
        left.plot(n, n * abs(double_root(alpha)) ** (n - 1), color=style[alpha]["color"], lw=1)
        shown = np.arange(0, NUM_STEPS + 1, 4) if abs(alpha) < 0.05 else np.arange(0, 41, 2)
        left.plot(shown, curve[shown], **style[alpha], ls="", ms=3.5, label=f"$\\alpha$ = {alpha:g}")
    left.set(xlim=(0, NUM_STEPS), ylim=(0, 24), xlabel="step n", ylabel=r"$|D_{23}|$: what $A^n$ adds to $\mu^n$")
    legend(left, title="Fig. 1 (lines: closed form)")

    angle = np.linspace(0, 2 * np.pi, 300)
    middle.plot(np.cos(angle), np.sin(angle), color="0.7", lw=0.8)
    for alpha, mu in roots.items():
        middle.plot(np.real(mu), np.imag(mu), ".", color=style[alpha]["color"], ms=1.5)
        middle.plot(double_root(alpha), 0, **style[alpha], ms=7, fillstyle="none")
        middle.plot(ggl_root(alpha), 0, "|", color=style[alpha]["color"], ms=12, mew=1.5)
    middle.plot([], [], "k.", ms=2, label=r"$\omega h$ = 0.01 to 1000")
    middle.plot([], [], "ko", fillstyle="none", label="index 3, double")
    middle.plot([], [], "k|", ms=9, mew=1.5, label="GGL, simple")
    middle.set(xlabel=r"Re $\mu$", ylabel=r"Im $\mu$", aspect="equal", xlim=(-1.15, 1.15), ylim=(-1.15, 1.15))
    legend(middle, title="eigenvalues of the step")

    steps = np.arange(1, RUN_STEPS + 1)
    for (formulation, alpha), tension in growth.items():
        line = {"ls": "-"} if formulation == "index3" else {"ls": "--", "lw": 1}
        right.loglog(steps, abs(tension), color=style[alpha]["color"], **line)
    right.plot(steps, 4 / RUN_DT * steps, "k:", lw=1, label="4 n m/h")
    right.plot([], [], "k-", label="index 3")
    right.plot([], [], "k--", lw=1, label="GGL")
    right.set(xlabel="step n", ylabel="tension per radial velocity, N s/m", xlim=(1, RUN_STEPS), ylim=(1, 1e7))
    legend(right, title="pendulum, h = 1 ms")
    return drawn
