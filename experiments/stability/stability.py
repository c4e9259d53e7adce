"""Where every method fails: accurate, bounded, silently wrong or blown up, by scene, step size and numerical damping.

A run is a cell, by the largest distance of q from q0 and the RMS error of q relative to its motion about the mean:

    accurate         error below 5 %
    bounded          error below 100 %
    silently wrong   error above 100 %, yet never ten times as far from q0 as the reference
    blown up         that far, or not finite
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.patches import Patch

import hhtjax
from experiments.cells import ACCURATE, FARTHEST, geometric_mean, march, relative_error, solve_reference
from experiments.report import side_by_side
from experiments.stability.scenes import all_cases, held_out

ALPHAS = (0.0, -0.05, -0.3)
HALVINGS = 10  # step sizes: so many, each half the one before
BLOWN_UP, WRONG, BOUNDED, GOOD = range(4)
GRADES = {
    "blown up": "#000000",
    "silently wrong: error above 100 %": "#D55E00",
    "bounded: error 5 to 100 %": "#F5DFB0",
    "accurate: error below 5 %": "#0072B2",
}


class Method(NamedTuple):
    """make: of HHT's alpha, or of a rho_inf that damps as much at infinity; damped: whether it depends on alpha."""

    make: Any
    damped: bool = True


def rosenbrock_like(alpha):
    """`rosenbrock` with the spectral radius at infinity of `hht(alpha)`."""
    return hhtjax.rosenbrock((1 + alpha) / (1 - alpha))


METHODS = {
    "HHT\nconverged": Method(partial(hhtjax.hht, iterations=None)),
    "HHT\nauto": Method(partial(hhtjax.hht, linearize="auto")),
    "HHT\npredictor": Method(partial(hhtjax.hht, linearize="predictor")),
    "HHT\nheld": Method(partial(hhtjax.hht, linearize="held")),
    "HHT\nstate": Method(partial(hhtjax.hht, linearize="state")),
    "Kim\n2019": Method(hhtjax.kim_hht),
    "Rosen-\nbrock": Method(rosenbrock_like),
    "Rosenbr.\nL-stable": Method(lambda _: hhtjax.rosenbrock(0.0), damped=False),
    "ROWDA": Method(lambda _: hhtjax.rowda(), damped=False),
    "Wilson\n1.4": Method(lambda _: hhtjax.wilson(1.4), damped=False),
    "Houbolt": Method(lambda _: hhtjax.houbolt(), damped=False),
    "Park": Method(lambda _: hhtjax.park(), damped=False),
    "implicit\nEuler": Method(lambda _: hhtjax.implicit_euler(), damped=False),
    "RK4": Method(lambda _: hhtjax.rk4(), damped=False),
}
REFERENCE = "HHT\nconverged"
FAST = ("HHT\nconverged", "HHT\nauto", "Rosen-\nbrock")


class Outcome(NamedTuple):
    """What one method does on one scene; arrays (step sizes, alphas), one alpha where it has none."""

    error: np.ndarray
    bounded: np.ndarray

    @property
    def grade(self):
        """An index into GRADES for each cell."""
        return np.where(
            self.bounded, np.where(self.error < ACCURATE, GOOD, np.where(self.error < 1, BOUNDED, WRONG)), BLOWN_UP
        )


@partial(jax.jit, static_argnames="method")
def simulate_all(scene, num_steps, method):
    """`march` for each alpha."""
    make, damped = METHODS[method]

    def simulate_one(alpha):
        stepper = make(alpha)
        start = stepper.init(scene.system, scene.q0, scene.v0, scene.params, scene.duration / num_steps)
        return march(stepper, start, scene, num_steps)

    return jax.vmap(simulate_one)(jnp.array(ALPHAS if damped else ALPHAS[:1]))


def assess(case, sizes, reference, method) -> Outcome:
    """One method on one scene."""
    errors, bounded = [], []
    for num_steps in sizes:
        path, farthest, _ = (np.asarray(x) for x in simulate_all(case.scene, num_steps, method))
        errors.append(relative_error(path, num_steps, reference))
        bounded.append(farthest <= FARTHEST * reference.reach)  # false for NaN
    return Outcome(np.array(errors), np.array(bounded))


def boundary(outcome, sizes):
    """For each alpha, the fewest steps from which on every run stays bounded; None if the finest does not."""
    steps = []
    for bounded in outcome.bounded.T:
        fails = np.flatnonzero(~bounded)
        first = fails[-1] + 1 if len(fails) else 0
        steps.append(sizes[first] if first < len(sizes) else None)
    return steps


def error_ratios(outcome, converged):
    """Error over that of the converged method, where that one is accurate; an error beyond 100 % counts as 100 %."""
    error = np.nan_to_num(outcome.error, nan=1.0).clip(max=1.0)
    return (error / converged.error)[converged.bounded & (converged.error < ACCURATE)]


def summary_rows(outcomes, names):
    """Method, alpha, then accurate, bounded, silently wrong and blown up in % of cells, and the ratio of errors."""
    rows = []
    for method in next(iter(outcomes.values())):
        for i, alpha in enumerate(ALPHAS if METHODS[method].damped else ["-"]):
            here = [Outcome(*(x[:, i] for x in outcomes[name][method])) for name in names]
            j = i if METHODS[method].damped else 1  # a method without alpha is compared with alpha = -0.05
            converged = [Outcome(*(x[:, j] for x in outcomes[name][REFERENCE])) for name in names]
            grades = np.concatenate([x.grade for x in here])
            ratios = np.concatenate([error_ratios(x, y) for x, y in zip(here, converged, strict=True)])
            shares = [round(100 * float(np.mean(grades == grade)), 1) for grade in reversed(range(len(GRADES)))]
            rows.append([method.replace("\n", " "), alpha, *shares, geometric_mean(ratios)])
    return rows


SUMMARY = ("method", "alpha", "accurate %", "bounded %", "wrong %", "blown up %", "ratio")


def page(outcomes, causes):
    """Every cell: scenes down, with a line on why methods fail; methods across; the step shrinks to the right."""
    methods = list(next(iter(outcomes.values())))
    columns = len(next(iter(outcomes.values()))[REFERENCE].error)
    figure, axes = plt.subplots(figsize=(0.9 + 0.78 * len(methods), 1.1 + 0.52 * len(outcomes)))
    style = {
        "cmap": ListedColormap(list(GRADES.values())),
        "vmin": 0,
        "vmax": 3,
        "edgecolor": "white",
        "linewidth": 0.25,
    }
    for row, (name, by_method) in enumerate(outcomes.items()):
        for column, outcome in enumerate(by_method.values()):
            x = (columns + 1) * column + np.arange(columns + 1)
            y = 5.5 * row + np.linspace(0, 3, 1 + outcome.error.shape[1])
            axes.pcolormesh(x, y, outcome.grade.T, **style)
        axes.text(0, 5.5 * row + 4.1, causes.get(name, ""), fontsize=6.5, va="center", style="italic", color="#444444")
    axes.set_xticks((columns + 1) * np.arange(len(methods)) + columns / 2, methods, fontsize=8)
    axes.set_yticks(5.5 * np.arange(len(outcomes)) + 1.5, outcomes, fontsize=8)
    axes.set_xlim(-1, (columns + 1) * len(methods))
    axes.set_ylim(5.5 * len(outcomes), -0.5)
    axes.xaxis.tick_top()
    axes.tick_params(length=0)
    axes.grid(False)
    axes.spines[:].set_visible(False)
    axes.set_xlabel(
        f"In each block: step size halved from column to column; rows: alpha = {', '.join(map(str, ALPHAS))}, "
        "or one where a method has none",
        fontsize=8,
    )
    handles = [Patch(color=colour, label=label) for label, colour in GRADES.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=8)
    return figure


def to_json(outcomes, sizes, tuned, untouched):
    """Boundaries as in tests/data/stability.json, errors with three digits, summaries."""

    def rounded(x):
        return [[float(f"{y:.3g}") if np.isfinite(y) else None for y in row] for row in x]

    def plain(name):
        return name.replace("\n", " ")

    return {
        "alphas": ALPHAS,
        "summary_tuned_on": [dict(zip(SUMMARY, row, strict=True)) for row in tuned],
        "summary_held_out": [dict(zip(SUMMARY, row, strict=True)) for row in untouched],
        "boundaries": {
            scene: {plain(m): boundary(x, sizes[scene]) for m, x in by_method.items()}
            for scene, by_method in outcomes.items()
        },
        "scenes": {
            scene: {
                "num_steps": sizes[scene],
                "error": {plain(m): rounded(x.error) for m, x in by_method.items()},
                "bounded": {plain(m): x.bounded.tolist() for m, x in by_method.items()},
            }
            for scene, by_method in outcomes.items()
        },
    }


CAUSES: dict[str, str] = {}


def run(report, fast):
    """All scenes, methods, alphas and step sizes."""
    outcomes, sizes = {}, {}
    for case in all_cases():
        if fast and not case.fast:
            continue
        steps = [case.fewest * 2**i for i in range(HALVINGS)][:: 2 if fast else 1]
        reference = solve_reference(case)
        methods = FAST if fast else METHODS
        results = side_by_side([partial(assess, case, steps, reference, method) for method in methods])
        outcomes[case.name], sizes[case.name] = dict(zip(methods, results, strict=True)), steps
        report.progress(case.name)
    new = [case.name for case in held_out() if case.name in outcomes]
    tables = [summary_rows(outcomes, names) for names in ([x for x in outcomes if x not in new], new)]
    for title, rows in zip(("Scenes on which the default was chosen.\n", "Held-out scenes.\n"), tables, strict=True):
        print(title)
        report.table(SUMMARY, rows)
    report.figure("stability", page(outcomes, CAUSES))
    report.numbers(to_json(outcomes, sizes, *tables))
