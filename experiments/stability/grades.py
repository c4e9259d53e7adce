"""How a run is graded, how far a method holds, and the page that shows all cells."""

from textwrap import wrap
from typing import NamedTuple

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.patches import Patch

from experiments.cells import ACCURATE
from hhtjax.plot import subplots

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


def page(scenes, causes, grades=GRADES, letters=LETTERS, columns_are="step size halved from column to column"):
    """Cells as of `cells`: scenes down, with why methods fail; methods across; the step shrinks to the right."""
    methods = list(next(iter(scenes.values()))["grades"])
    columns = max(len(row) for by_method in scenes.values() for rows in by_method["grades"].values() for row in rows)
    pitch = 4 + 1.5 * max((len(wrap(why, 95)) for why in causes.values()), default=0)
    figure, axes = subplots(width=175, height=30 + 2 * pitch * len(scenes))
    style = {
        "cmap": ListedColormap(list(grades.values())),
        "vmin": 0,
        "vmax": 3,
        "edgecolor": "white",
        "linewidth": 0.3,
    }
    for row, (name, scene) in enumerate(scenes.items()):
        for column, method in enumerate(methods):
            found = np.array([[letters.index(letter) for letter in line] for line in scene["grades"][method]])
            x = (columns + 1) * column + np.arange(found.shape[1] + 1)
            axes.pcolormesh(x, pitch * row + np.linspace(0, 3, len(found) + 1), found, **style)
        if causes:
            why = "\n".join(wrap(causes.get(name, ""), 95))
            line = axes.text(0, pitch * row + 3.2, why, va="top", style="italic", color="#444444")
            line.set_in_layout(False)
    axes.set_xticks(
        (columns + 1) * np.arange(len(methods)) + columns / 2, ["\n".join(wrap(name, 10)) for name in methods]
    )
    parts = [name.replace(", ", ",\n").split("\n") for name in scenes]
    names = ["\n".join(line for part in some for line in wrap(part, 20)) for some in parts]
    axes.set_yticks(pitch * np.arange(len(scenes)) + 1.5, names)
    axes.set_xlim(-1, (columns + 1) * len(methods))
    axes.set_ylim(pitch * len(scenes), -0.5)
    axes.xaxis.tick_top()
    axes.tick_params(length=0)
    axes.grid(False)
    axes.spines[:].set_visible(False)
    alphas = f"rows: alpha = {', '.join(map(str, ALPHAS))}, or one without alpha"
    axes.set_xlabel(f"In each block: {columns_are}\n{alphas}")
    handles = [Patch(color=colour, label=label) for label, colour in grades.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=2)
    return figure
