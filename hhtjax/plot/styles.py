"""The style of charts: colours that colour-blind readers can distinguish, 8 pt text, the width of a column."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.textpath import TextPath
from matplotlib.ticker import Formatter, LogFormatterSciNotation

from hhtjax.checks import require_integer, require_number
from hhtjax.description import PyTree, Real, all_concrete
from hhtjax.runs.output import require_path
from hhtjax.runs.solution import Solution

# Okabe and Ito's colours, jfly.uni-koeln.de/color; each goes with a marker and a line style
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#999999")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
LINES: tuple[Any, ...] = (
    "-", "--", "-.", ":", (0, (6, 1, 1, 1, 1, 1)), (0, (3, 1)), (0, (8, 2)), (0, (1, 2)),
)  # fmt: skip
TEXT = 8.0  # pt
COLUMN, PAGE = 85, 175  # mm
PARAMETERS: Any = {
    "axes.formatter.use_mathtext": True,
    "axes.formatter.useoffset": False,
    "axes.grid": True,
    "axes.labelsize": TEXT,
    "axes.linewidth": 0.6,
    "axes.prop_cycle": cycler(color=COLOURS),
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlesize": TEXT,
    "figure.constrained_layout.use": True,
    "figure.dpi": 130,
    "figure.titlesize": TEXT,
    "font.size": TEXT,
    "grid.alpha": 0.3,
    "grid.linewidth": 0.5,
    "legend.fontsize": TEXT,
    "legend.frameon": False,
    "lines.linewidth": 1.2,
    "lines.markersize": 4,
    "pdf.fonttype": 42,
    "savefig.dpi": 200,
    "svg.fonttype": "none",
    "xtick.labelsize": TEXT,
    "ytick.labelsize": TEXT,
}
FORMATS = ("png", "pdf", "svg")
MM = 1 / 25.4  # inches


def style():
    """A context in which matplotlib draws in the style of this module: 8 pt text, Okabe and Ito's colours.

    The settings are `PARAMETERS`. Outside the context the settings of matplotlib are unchanged.

    Returns:
        A context manager.

    >>> import matplotlib, hhtjax
    >>> with hhtjax.plot.style():
    ...     inside = matplotlib.rcParams["font.size"]
    >>> inside
    8.0
    """
    return mpl.rc_context(PARAMETERS)


def subplots(
    rows: int = 1, columns: int = 1, *, width: float = COLUMN, height: float | None = None, **options: Any
) -> tuple[Any, Any]:
    """Makes a figure and its axes, like `plt.subplots`, in the style of this module, with sizes in mm.

    Args:
        rows, columns: number of panels.
        width: width of the figure in mm: 85 for a column of text, 175 for a page.
        height: height of the figure in mm; by default the panels have the ratio 4:3.
        **options: options of `plt.subplots`.

    Returns:
        The figure, and its axes as `plt.subplots` returns them: one, (n,) or (rows, columns).

    Raises:
        TypeError, ValueError: rows, columns, width or height is not a positive number.

    >>> import matplotlib.pyplot as plt, hhtjax
    >>> figure, axes = hhtjax.plot.subplots(1, 2, width=175)
    >>> axes.shape, [round(25.4 * float(x)) for x in figure.get_size_inches()]
    ((2,), [175, 66])
    >>> plt.close(figure)
    """
    rows, columns = require_integer("subplots", "rows", rows), require_integer("subplots", "columns", columns)
    require_number("subplots", "width", width, lambda x: np.isfinite(x) and x > 0, "be positive and finite")
    if height is None:
        height = 0.75 * width / columns * rows
    require_number("subplots", "height", height, lambda x: np.isfinite(x) and x > 0, "be positive and finite")
    with style():
        figure, axes = plt.subplots(rows, columns, figsize=(width * MM, height * MM), **options)
        for ax in np.ravel(axes):
            pin(ax)
    return figure, axes


def pin(ax):
    """Sets properties that matplotlib otherwise takes from the global settings when the figure is drawn."""
    ax.tick_params(which="both", labelsize=TEXT, width=0.6)
    ax.grid(True, color="#b0b0b0", alpha=0.3, linewidth=0.5)


class _Between(Formatter):
    """Labels between the decades of a logarithmic axis: 2 and 5, if fewer than two decades are labelled."""

    def __call__(self, x, pos=None):
        axis: Any = self.axis
        ends = np.log10(np.sort(axis.get_view_interval()))
        exponent = int(np.floor(np.log10(x) + 1e-9))
        leading = round(x / 10.0**exponent)
        if np.floor(ends[1]) - np.ceil(ends[0]) >= 1 or leading not in (2, 5):
            return ""
        return f"$\\mathdefault{{{leading}\\times10^{{{exponent}}}}}$"


def thin_ticks(ax):
    """Avoids overlapping labels between the decades of logarithmic axes."""
    for axis in (ax.xaxis, ax.yaxis):
        if axis.get_scale() == "log" and isinstance(axis.get_minor_formatter(), LogFormatterSciNotation):
            axis.set_minor_formatter(_Between())


@contextmanager
def canvas(caller: str, ax, rows: int = 1, width: int = COLUMN, height: Real = None, **options: PyTree):
    """A context with the given axes, checked, or those of a new figure in its style: an array (rows,)."""
    if ax is None:
        with style():
            axes = subplots(rows, 1, width=width, height=height, squeeze=False, **options)[1][:, 0]
            yield axes
            for panel in axes:
                thin_ticks(panel)
        return
    given = list(np.ravel(np.asarray(ax, dtype=object)))
    if len(given) != rows or not all(isinstance(x, Axes) for x in given):
        wanted = "matplotlib axes" if rows == 1 else f"{rows} matplotlib axes"
        raise TypeError(f"{caller}: `ax` must be {wanted}; received {ax!r}.")
    yield np.array(given, dtype=object)


def look(i: int, marker: bool = False) -> dict[str, Any]:
    """Colour, line style and optionally marker of curve number i."""
    chosen = {"color": COLOURS[i % len(COLOURS)], "ls": LINES[i % len(LINES)]}
    return chosen | ({"marker": MARKERS[i % len(MARKERS)]} if marker else {})


def legend(ax, handles=None, labels: list | None = None, **options: Any):
    """Draws a legend above the axes, where it covers no curve, in as many columns as fit.

    Args:
        ax: axes.
        handles, labels: as for `ax.legend`; by default all curves that have a label.
        **options: further options of `ax.legend`.

    Returns:
        matplotlib's legend; None if no curve has a label.

    Raises:
        TypeError: an option that `ax.legend` does not know.

    >>> import matplotlib.pyplot as plt, hhtjax
    >>> figure, ax = hhtjax.plot.subplots()
    >>> line = ax.plot([0, 1], label="a line")
    >>> hhtjax.plot.legend(ax).get_texts()[0].get_text()
    'a line'
    >>> plt.close(figure)
    """
    if handles is None:
        handles, labels = ax.get_legend_handles_labels()
    labels = [handle.get_label() for handle in handles] if labels is None else list(labels)
    if not labels:
        return None
    room = 72 * ax.get_figure(root=True).get_size_inches()[0] * _share(ax) - 36  # for the labels of the axis
    place = {"loc": "lower left", "bbox_to_anchor": (0, 1.0), "borderaxespad": 0.3}
    shape = {"ncols": _columns(labels, room), "handlelength": 1.8, "columnspacing": 1.0, "borderpad": 0.2}
    return ax.legend(handles, labels, **(place | shape | options))


def _share(ax) -> Real:
    """Share of the width of the figure that the axes have with their labels."""
    cell = ax.get_subplotspec()
    if cell is None:
        return ax.get_position().width
    grid = cell.get_gridspec()
    widths = np.array(grid.get_width_ratios() or [1] * grid.ncols)
    return widths[list(cell.colspan)].sum() / widths.sum()


def _columns(labels: list, room: Real) -> int:
    """The largest number of columns of a legend that fits into `room` points."""
    size = [TextPath((0, 0), label, size=TEXT).get_extents().width if label.strip() else 0 for label in labels]
    for columns in range(len(labels), 1, -1):
        widest = [max(part) for part in np.array_split(size, columns)]  # as matplotlib deals them out
        if sum(widest) + 28 * columns <= room:
            return columns
    return 1


def save(figure, path, formats: Sequence[str] = ("png",)) -> list[Path]:
    """Writes a figure as path.png (200 dpi), path.pdf or path.svg. pdf and svg contain text, not outlines.

    Args:
        figure: a figure of matplotlib.
        path: path without suffix; its folder must exist.
        formats: a tuple of "png", "pdf", "svg".

    Returns:
        The paths of the files.

    Raises:
        TypeError, ValueError: figure is not a figure; formats has entries other than png, pdf and svg.
        OSError: a file that cannot be written.

    >>> import matplotlib.pyplot as plt, pathlib, tempfile, hhtjax
    >>> figure, ax = hhtjax.plot.subplots()
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     [path.name for path in hhtjax.plot.save(figure, pathlib.Path(folder) / "empty", ("png", "svg"))]
    ['empty.png', 'empty.svg']
    >>> plt.close(figure)
    """
    if not hasattr(figure, "savefig"):
        raise TypeError(f"save: `figure` must be a matplotlib figure; received {figure!r}.")
    if isinstance(formats, str) or not set(formats) <= set(FORMATS):
        raise ValueError(f"save: `formats` must be a tuple of {', '.join(FORMATS)}; received {formats!r}.")
    for ax in figure.axes:
        thin_ticks(ax)
    paths = [Path(f"{path}.{ending}") for ending in formats]
    with style():
        for file in paths:
            dated = {"metadata": {"Date": None}} if file.suffix == ".svg" else {}
            figure.savefig(file, **dated)
    return paths


def with_unit(name: str, unit: str | None) -> str:
    """`name (unit)`."""
    return f"{name} ({unit})" if unit else name


# ----------------------------------------------------------------------------
# The entries of the pytrees of a run, by name.


SYMBOLS = {"q": "q", "v": "v", "acceleration": "w", "multipliers": "L", "z": "z"}


def require_run(caller: str, solution: Solution):
    """Raises an error unless it is the solution of one run, and outside of jit, vmap and grad."""
    if not isinstance(solution, Solution):
        raise TypeError(f"{caller}: `solution` must be a Solution, as of simulate; received {type(solution).__name__}.")
    require_path(caller, solution)
    if not all_concrete(solution):
        raise TypeError(f"{caller}: `solution` is a tracer: draw outside jit, vmap and grad.")
    if np.ndim(solution.t) != 1:
        raise ValueError(
            f"{caller}: `solution` must be of one run; received a batch, t of shape {np.shape(solution.t)}. "
            "Its member i is jax.tree.map(lambda x: x[i], solution)."
        )


def named_entries(tree: PyTree):
    """{name: (leaf name, values (K + 1,))} of each number: "[0]" of an array, "x[0]" and "phi" of a dict."""
    found = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        name = jax.tree_util.keystr(path, simple=True, separator=".")
        leaf = np.asarray(leaf)
        for i in np.ndindex(leaf.shape[1:]):
            found[f"{name}{list(map(int, i)) or ''}"] = name, leaf[(slice(None), *i)]
    return found


def chosen_entries(caller: str, solution, quantity, entries):
    """{name: (leaf name, values)} of one quantity of a solution: all entries, or those given by entry or leaf."""
    tree = getattr(solution, quantity)
    if tree is None:
        raise ValueError(f"{caller}: the solution has no {quantity}: received a run without.")
    found = named_entries(tree)
    if entries is None:
        return found
    entries = (entries,) if isinstance(entries, str) else tuple(entries)
    symbol = SYMBOLS[quantity]
    chosen = {}
    for wanted in entries:
        alike = {n: x for n, x in found.items() if wanted in (n, x[0] or None, f"{symbol}{n}")}
        if not alike:
            raise ValueError(f"{caller}: `entries` must be among {', '.join(found)}; received {wanted!r}.")
        chosen |= alike
    return chosen


def shown_name(quantity, name):
    """q[0] for the entry [0] of an array; for a dict the name of the entry."""
    return f"{SYMBOLS[quantity]}{name}" if name == "" or name.startswith("[") else name


def unit_of(units, name, leaf):
    """The unit of one entry. units: a unit for all, or a dict of units by entry or leaf, or None."""
    return units.get(name, units.get(leaf)) if isinstance(units, dict) else units


def prefixed(label, name):
    """`label: name`."""
    return name if label is None else f"{label}: {name}" if name else label
