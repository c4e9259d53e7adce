"""How a run is graded, how far a method holds, and the page that shows all cells."""

from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.patches import Patch

from experiments.cells import ACCURATE

ALPHAS = (0.0, -0.05, -0.3)
BLOWN_UP, WRONG, BOUNDED, GOOD = range(4)
GRADES = {
    "blown up": "#000000",
    "silently wrong: error above 100 %": "#D55E00",
    "bounded: error 5 to 100 %": "#F5DFB0",
    "accurate: error below 5 %": "#0072B2",
}
LETTERS = "XwbA"  # the same in one letter each


class Outcome(NamedTuple):
    """What one method does on one scene; arrays (step sizes, alphas), one alpha where it has none."""

    error: np.ndarray
    bounded: np.ndarray

    @property
    def grade(self):
        """An index into GRADES for each cell."""
        return np.where(
            self.bounded, np.select([self.error < ACCURATE, self.error < 1], [GOOD, BOUNDED], WRONG), BLOWN_UP
        )


def boundary(outcome, sizes):
    """For each alpha, the fewest steps from which on every run stays bounded; None if the finest does not."""
    steps = []
    for bounded in outcome.bounded.T:
        fails = np.flatnonzero(~bounded)
        first = fails[-1] + 1 if len(fails) else 0
        steps.append(sizes[first] if first < len(sizes) else None)
    return steps


def plain(method):
    """The name of a method in one line."""
    return method.replace("\n", " ")


def cells(outcomes, sizes):
    """For each method and alpha a letter of LETTERS for each step size, the coarsest first."""
    return {
        scene: {
            "num_steps": sizes[scene],
            "grades": {plain(m): ["".join(LETTERS[i] for i in row) for row in x.grade.T] for m, x in by_method.items()},
        }
        for scene, by_method in outcomes.items()
    }


def page(outcomes, causes):
    """Every cell: scenes down, with a line on why methods fail; methods across; the step shrinks to the right."""
    first = next(iter(outcomes.values()))
    methods, columns = list(first), len(next(iter(first.values())).error)
    size = max(7.4, 0.9 + 0.72 * len(methods)), 1.3 + 0.52 * len(outcomes)
    figure, axes = plt.subplots(figsize=size, dpi=115)
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
        f"In each block: step size halved from column to column\n"
        f"rows: alpha = {', '.join(map(str, ALPHAS))}, or one without alpha",
        fontsize=8,
    )
    handles = [Patch(color=colour, label=label) for label, colour in GRADES.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=8)
    return figure
