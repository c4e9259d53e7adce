"""Which point of linearisation should be the default of the non-iterative step: bounded, accurate, how accurate.

Every scene is run with every method, alpha and step size, and each run is a cell:

    bounded    finite, and never ten times as far from q0 as the reference gets
    accurate   RMS error of q below 5 % of the RMS of the reference's motion about its mean
    ratio      error / error of the converged method, a geometric mean over the cells where the latter is accurate

Each run is made from both starts: where alpha is not 0, "corrected" adds alpha h dw/dt to the first algorithmic
acceleration, and with a step far longer than the fastest decay that alone can throw a motion out.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.colors import ListedColormap, LogNorm
from matplotlib.patches import Patch

from experiments.cells import (
    ACCURATE,
    FARTHEST,
    geometric_mean,
    march,
    relative_error,
    solve_reference,
)
from experiments.linearization.scenes import cases
from hhtjax import hht
from hhtjax.plot import subplots

ALPHAS = (0.0, -0.05, -0.3)
STARTS = ("corrected", "simple")
METHODS = {
    "converged": {"iterations": None},
    "predictor": {"linearize": "predictor"},
    "held": {"linearize": "held"},
    "state": {"linearize": "state"},
    "auto": {"linearize": "auto"},
}
HALVINGS = 10  # step sizes: so many, each half the one before


class Outcome(NamedTuple):
    """What one method does on one scene; arrays (step sizes, starts, alphas)."""

    error: np.ndarray
    bounded: np.ndarray
    newton_failed: np.ndarray

    @property
    def accurate(self):
        """Where q is right."""
        return self.bounded & (self.error < ACCURATE)


@partial(jax.jit, static_argnames="method")
def simulate_all(scene, num_steps, method):
    """`march` for each start and alpha."""

    def simulate_one(corrected, alpha):
        stepper = hht(alpha, start="corrected", **METHODS[method])
        start = stepper.init(scene.system, scene.q0, scene.v0, scene.params, scene.duration / num_steps)
        return march(stepper, start._replace(a=jnp.where(corrected, start.a, start.w)), scene, num_steps)

    corrected = jnp.array([start == "corrected" for start in STARTS])
    return jax.vmap(jax.vmap(simulate_one, (None, 0)), (0, None))(corrected, jnp.array(ALPHAS))


def assess(case, method, sizes, reference) -> Outcome:
    """One method on one scene."""
    errors, bounded, failures = [], [], []
    for num_steps in sizes:
        path, farthest, failed = (np.asarray(x) for x in simulate_all(case.scene, num_steps, method))
        errors.append(relative_error(path, num_steps, reference))
        bounded.append(farthest <= FARTHEST * reference.reach)  # false for NaN
        failures.append(failed > 0)
    return Outcome(np.array(errors), np.array(bounded), np.array(failures))


def check_reference(case, sizes, reference):
    """Difference between scipy and the converged method with eight times the most steps."""
    num_steps = 8 * sizes[-1]
    path, _, _ = simulate_all(case.scene, num_steps, "converged")
    return relative_error(np.asarray(path), num_steps, reference)[0, 0]


def error_ratios(outcome, converged):
    """Error over that of the converged method, where that one is accurate; an error beyond 100 % counts as 100 %."""
    error = np.nan_to_num(outcome.error, nan=1.0).clip(max=1.0)
    return (error / converged.error)[converged.accurate]


def select(outcomes, *index):
    """The cells of one start, or of one start and one alpha."""
    return {
        name: {method: Outcome(*(x[:, *index] for x in outcome)) for method, outcome in by_method.items()}
        for name, by_method in outcomes.items()
    }


def percentages(outcomes, method, start, alpha):
    """Bounded %, accurate %, ratio over all scenes; the converged method of the ratio starts corrected."""
    here = [x[method] for x in select(outcomes, start, alpha).values()]
    converged = [x["converged"] for x in select(outcomes, 0, alpha).values()]
    ratios = np.concatenate([error_ratios(x, y) for x, y in zip(here, converged, strict=True)])
    bounded, accurate = (100 * float(np.mean([getattr(x, name) for x in here])) for name in ("bounded", "accurate"))
    return [round(bounded, 1), round(accurate, 1), geometric_mean(ratios)]


def summary_rows(outcomes):
    """Method, alpha, and the percentages from the one start and from the other."""
    return [
        [method, alpha, *percentages(outcomes, method, 0, i), *percentages(outcomes, method, 1, i)]
        for method in METHODS
        for i, alpha in enumerate(ALPHAS)
    ]


def scene_rows(outcomes):
    """For each scene and method: cells bounded / accurate, and the ratio."""
    rows = []
    for name, by_method in outcomes.items():
        converged = by_method["converged"]
        cells = [
            f"{x.bounded.sum()}/{x.accurate.sum()}  {geometric_mean(error_ratios(x, converged)):6.2f}"
            for x in by_method.values()
        ]
        rows.append([name, *cells, f"{converged.newton_failed.sum()}"])
    return rows


def cell_figure(outcomes):
    """Every cell: scenes down, methods across; in each block the step shrinks to the right."""
    colours = ("#000000", "#F2CF8D", "#0072B2")  # also apart in grey: black, light, middle
    labels = ("unbounded", "bounded, error above 5 %", "error below 5 %")
    figure, axes = subplots(width=175, height=23 + 10 * len(outcomes))
    columns = len(next(iter(outcomes.values()))["converged"].error)
    for row, by_method in enumerate(outcomes.values()):
        for column, outcome in enumerate(by_method.values()):
            grade = outcome.bounded.astype(int) + outcome.accurate
            x, y = (columns + 1) * column + np.arange(columns + 1), 4 * row + np.arange(4)
            style = {"cmap": ListedColormap(colours), "vmin": 0, "vmax": 2, "edgecolor": "white", "linewidth": 0.4}
            axes.pcolormesh(x, y, grade.T, **style)
    axes.set_xticks((columns + 1) * np.arange(len(METHODS)) + columns / 2, METHODS)
    axes.set_yticks(4 * np.arange(len(outcomes)) + 1.5, outcomes)
    axes.invert_yaxis()
    axes.xaxis.tick_top()
    axes.tick_params(length=0)
    axes.grid(False)
    axes.spines[:].set_visible(False)
    axes.set_xlabel(
        f"In each block: step size halved from column to column; rows: alpha = {', '.join(map(str, ALPHAS))}"
    )
    handles = [Patch(color=colour, label=label) for colour, label in zip(colours, labels, strict=True)]
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
    return figure


def ratio_figure(outcomes):
    """Error over that of the converged method, for each scene."""
    methods = list(METHODS)[1:]
    table = np.array([[geometric_mean(error_ratios(x[m], x["converged"])) for m in methods] for x in outcomes.values()])
    figure, axes = subplots(width=175, height=23 + 7.5 * len(outcomes))
    image = axes.imshow(table, aspect="auto", cmap="PuOr_r", norm=LogNorm(1 / 30, 30))
    for (row, column), value in np.ndenumerate(table):
        strong = abs(np.log10(value)) > 1 if np.isfinite(value) else False
        text = f"{value:.2f}" if np.isfinite(value) else "-"
        axes.text(column, row, text, ha="center", va="center", color="white" if strong else "black")
    axes.set_xticks(range(len(methods)), methods)
    axes.set_yticks(range(len(outcomes)), outcomes)
    axes.xaxis.tick_top()
    axes.tick_params(length=0)
    axes.grid(False)
    figure.colorbar(image, label="error / error of the converged method")
    return figure


def to_json(outcomes, sizes, checks, rows):
    """Everything that the tables and figures show; errors from the corrected start, with three digits."""

    def rounded(x):
        return [[float(f"{y:.3g}") if np.isfinite(y) else None for y in row] for row in x]

    return {
        "alphas": ALPHAS,
        "summary": [dict(zip(SUMMARY, row, strict=True)) for row in rows],
        "scenes": {
            name: {
                "num_steps": sizes[name],
                "reference_check": float(checks[name]),
                "error": {method: rounded(x.error) for method, x in by_method.items()},
                "bounded": {method: x.bounded.tolist() for method, x in by_method.items()},
            }
            for name, by_method in select(outcomes, 0).items()
        },
    }


SUMMARY = ("method", "alpha", "bounded %", "accurate %", "ratio", "simple: bounded %", "accurate % ", "ratio ")


def run(report, fast):
    """All scenes, methods, starts, alphas and step sizes."""
    outcomes, sizes, checks = {}, {}, {}
    for case in cases():
        if fast and not case.fast:
            continue
        steps = [case.fewest * 2**i for i in range(HALVINGS)][:: 2 if fast else 1]
        reference = solve_reference(case)
        outcomes[case.name] = {method: assess(case, method, steps, reference) for method in METHODS}
        sizes[case.name], checks[case.name] = steps, check_reference(case, steps, reference)
        report.progress(f"{case.name}: scipy and {8 * steps[-1]} converged steps differ by {checks[case.name]:.1e}")
    rows = summary_rows(outcomes)
    print('All scenes, from the corrected start and, on the right, with start="simple".\n')
    report.table(SUMMARY, rows)
    cells = len(ALPHAS) * (HALVINGS // 2 if fast else HALVINGS)
    print(f"By scene, corrected start: cells bounded/accurate of {cells}, ratio; last, cells in which Newton failed.\n")
    report.table(["scene", *METHODS, "failed"], scene_rows(select(outcomes, 0)))
    for i, start in enumerate(STARTS):
        report.figure(f"linearization_{start}", cell_figure(select(outcomes, i)))
    report.figure("linearization_ratio", ratio_figure(select(outcomes, 0)))
    report.numbers(to_json(outcomes, sizes, checks, rows))
