"""Charts of the error over the step size, with observed orders, and of the error over the computing time."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from hhtjax.analysis.convergence import ObservedOrder
from hhtjax.plot.styles import LINES, canvas, legend, look, with_unit
from hhtjax.runs.solution import Solution

GREY = "#606060"


def error_against_h(
    dt: Any,
    error: Any = None,
    *,
    reference: Any = None,
    label: str | None = None,
    slopes: Any = None,
    unit: str | None = None,
    time_unit: str = "s",
    lines: Any = None,
    key: bool = True,
    ax: Any = None,
) -> Any:
    """Draws the error over the step size, both logarithmic, with the observed orders and slope triangles.

    Error and order are

        e = sqrt(mean over samples and entries of (q - reference)^2)       for a sweep,
        p = median over neighbours of log(e_2/e_1) / log(h_2/h_1).

    Rounding at small steps, or too large steps, do not affect the median as long as most points are between them. If
    the slopes of a curve differ by more than 1, the smallest and the largest are given instead.

    Args:
        dt: step sizes (n,), with `error` of the same length; or an `ObservedOrder`; or a sweep over step sizes; or a
            dict of several of these, {label: sweep} or {label: (dt, error)}.
        error: (n,), if dt is step sizes; otherwise None. Errors that are not finite or not positive are left out.
        reference: for a sweep: the exact q of a member, at the same times; by default the finest member, which is then
            not drawn.
        label: label of a single curve.
        slopes: orders of the triangles; by default the observed orders, if they are close to a whole number.
        unit: unit of the error. time_unit: unit of dt.
        lines: options of `ax.plot` for some of the curves, {label: {"marker": "x"}}.
        key: whether to draw a legend. Without it the labels of curves have no orders, so that several axes can share a
            legend.
        ax: axes to draw into; None for a new figure.

    Returns:
        The axes.

    Raises:
        TypeError, ValueError: an argument of a wrong kind, shape or value; a run that is not a sweep; `lines` with a
        label that no curve has.

    >>> import matplotlib.pyplot as plt, numpy as np, hhtjax
    >>> h = np.array([0.01, 0.02, 0.04])
    >>> ax = hhtjax.plot.error_against_h(h, 3 * h**2, label="hht", unit="m")
    >>> ax.get_legend().get_texts()[0].get_text(), ax.get_ylabel()
    ('hht: order 2.00', 'error (m)')
    >>> plt.close(ax.figure)
    """
    given = dt if isinstance(dt, dict) else {label: dt if error is None else (dt, error)}
    curves = {name: _curve(one, reference) for name, one in given.items()}
    lines = _lines("error_against_h", lines, curves)
    with canvas("error_against_h", ax) as (panel,):
        orders = {name: _order(*curve) for name, curve in curves.items()}
        start = len([line for line in panel.lines if not line.get_label().startswith("_")])
        for i, (name, (h, e)) in enumerate(curves.items()):
            order = _in_words(h, e) if key else ""
            shown = ": ".join(x for x in (name, order) if x)
            panel.loglog(h, e, label=shown, **(look(start + i, marker=True) | lines.get(name, {})))
        if slopes is None:
            slopes = sorted({round(p) for p in orders.values() if abs(p - round(p)) < 0.3 and round(p) > 0})
        taken = []
        for p in slopes:
            nearest = min(curves, key=lambda name: abs(np.nan_to_num(orders[name], nan=np.inf) - p))
            taken.append(_triangle(panel, p, curves[nearest], list(curves.values()), taken))
        panel.set(xlabel=with_unit("step size h", time_unit), ylabel=with_unit("error", unit))
        if key:
            legend(panel)
    return panel


def _lines(caller: str, lines, curves):
    """{label: options} of the user; raises an error for a label that no curve has."""
    lines = lines or {}
    if unknown := [label for label in lines if label not in curves]:
        raise ValueError(f"{caller}: `lines` must be of {', '.join(map(str, curves))}; received {unknown[0]!r}.")
    return lines


def _curve(one, reference):
    """(step sizes, errors) of a curve, sorted, without errors that are not finite or not positive."""
    if isinstance(one, ObservedOrder):
        one = one.dt, one.error
    elif isinstance(one, Solution):
        one = _errors_of_sweep(one, reference)
    elif not isinstance(one, tuple) or len(one) != 2:
        raise TypeError(
            "error_against_h: `dt` must be a sweep, an ObservedOrder, step sizes with `error`, or several of these by "
            f"name; received {type(one).__name__}."
        )
    h, e = (np.asarray(x, float) for x in one)
    if h.ndim != 1 or h.shape != e.shape:
        raise ValueError(f"error_against_h: `dt` and `error` must be equally long; received {h.shape} and {e.shape}.")
    if not np.all(h > 0):
        raise ValueError(f"error_against_h: `dt` must be positive; received {h.min()}.")
    order = np.argsort(h)
    h, e = h[order], e[order]
    kept = np.isfinite(e) & (e > 0)
    return h[kept], e[kept]


def _errors_of_sweep(sweep, reference):
    """Step sizes, and RMS error of q over samples and entries; NaN for members that failed."""
    if np.ndim(sweep.t) != 2:
        raise ValueError(f"error_against_h: `dt` must be a sweep; received a run, t of shape {np.shape(sweep.t)}.")
    h = np.asarray(sweep.dt)
    h = h.max(axis=1) if h.ndim == 2 else h
    members = np.argsort(h)
    if reference is None:
        reference, members = jax.tree.map(lambda x: x[members[0]], sweep.q), members[1:]
    ours, exact = jax.tree.leaves(sweep.q), jax.tree.leaves(reference)
    if [np.shape(x)[1:] for x in ours] != [np.shape(x) for x in exact]:
        shapes = ", ".join(str(np.shape(x)[1:]) for x in ours)
        raise ValueError(
            f"error_against_h: `reference` must be shaped like q of one member, {shapes}; "
            f"received {', '.join(str(np.shape(x)) for x in exact)}."
        )
    squares = [np.square(np.asarray(x) - np.asarray(y)).reshape(len(h), -1) for x, y in zip(ours, exact, strict=True)]
    error = np.sqrt(np.mean(np.concatenate(squares, axis=1), axis=1))
    return h[members], np.where(np.asarray(sweep.failure.step) > 0, np.nan, error)[members]


def _order(h, e):
    """Median of the slopes between neighbours; NaN for a single point."""
    return float(np.median(np.diff(np.log(e)) / np.diff(np.log(h)))) if len(h) > 1 else np.nan


def _in_words(h, e):
    """The order in words; the smallest and the largest slope if they differ by more than 1; "" for a single point."""
    if len(h) < 2:
        return ""
    slopes = np.diff(np.log(e)) / np.diff(np.log(h))
    if np.ptp(slopes) > 1:
        return f"order {slopes.min():.1f} to {slopes.max():.1f}"
    return f"order {np.median(slopes):.2f}"


def _triangle(ax, p, curve, curves, taken):
    """Draws a triangle of slope p, with its number, where it covers fewest curves; returns its extent in x and y."""
    h, e = np.log(curve)
    places = []
    for start in (0.5, 0.25, 0.7, 0.05):
        x = h[0] + (h[-1] - h[0]) * np.array([start, start + 0.2])
        for gap in (-1.0, 1.0):  # below, with the right angle at the right; above, at the left
            shift = min if gap < 0 else max
            y = shift(np.interp(x, h, e) - p * x) + p * x + gap
            places.append((x, y, gap))
    x, y, gap = min(places, key=lambda place: _in_the_way(place[0], place[1], curves, taken))
    corner = (x[1], y[0]) if gap < 0 else (x[0], y[1])
    ax.plot(*np.exp([[x[0], y[0]], corner, [x[1], y[1]], [x[0], y[0]]]).T, color=GREY, lw=0.8, label="_slope")
    side = {"xytext": (3 if gap < 0 else -3, 0), "ha": "left" if gap < 0 else "right"}
    ax.annotate(f"{p:g}", np.exp([corner[0], y.mean()]), textcoords="offset points", color=GREY, va="center", **side)
    return x, y


def _in_the_way(x: Any, y: Any, curves: Any, taken: Any) -> int:
    """Number of curves and triangles that overlap the box between (x0, y0) and (x1, y1); all in logarithms."""
    hits = 0
    for h, e in curves:
        over = np.interp(np.linspace(x[0], x[1], 5), np.log(h), np.log(e), left=np.nan, right=np.nan)
        hits += bool(np.any((over > y[0] - 0.2) & (over < y[1] + 0.2)))
    return hits + sum(x[0] < a[1] and a[0] < x[1] and y[0] < b[1] and b[0] < y[1] for a, b in taken)


def work_precision(
    curves: Any,
    *,
    ours: Any = (),
    xlabel: str = "time of a run (s)",
    ylabel: str = "error",
    lines: Any = None,
    key: bool = True,
    ax: Any = None,
) -> Any:
    """Draws the error over the computing time, both logarithmic. Curves further down and to the left are better.

    Args:
        curves: {label: (times, errors)}, two vectors each. Numbers that are not finite or not positive are left out.
        ours: labels of the curves drawn with bold, solid lines. The others have thin, dashed ones.
        xlabel, ylabel: labels of the axes, with the units of work and error.
        lines, key, ax: as in `hhtjax.plot.error_against_h`.

    Returns:
        The axes.

    Raises:
        TypeError, ValueError: curves is not a dict, is empty, or has arrays of different lengths; ours or lines have
        labels that are not in curves.

    >>> import matplotlib.pyplot as plt, hhtjax
    >>> curves = {"hht": ([1e-3, 2e-3], [1e-2, 2.5e-3]), "peer": ([1e-2, 2e-2], [1e-2, 6e-4])}
    >>> ax = hhtjax.plot.work_precision(curves, ours=("hht",), ylabel="error (m)")
    >>> [line.get_linewidth() for line in ax.lines]
    [1.8, 0.9]
    >>> plt.close(ax.figure)
    """
    if not isinstance(curves, dict) or not curves:
        raise TypeError(f"work_precision: `curves` must be {{label: (times, errors)}}; received {curves!r}.")
    ours = (ours,) if isinstance(ours, str) else tuple(ours)
    if unknown := [label for label in ours if label not in curves]:
        raise ValueError(f"work_precision: `ours` must be among {', '.join(curves)}; received {unknown[0]!r}.")
    points = {label: _points(label, *curve) for label, curve in curves.items()}
    lines = _lines("work_precision", lines, curves)
    with canvas("work_precision", ax) as (panel,):
        for i, (label, (times, errors)) in enumerate(points.items()):
            mine = {"ls": "-", "lw": 1.8, "zorder": 3} if label in ours else {"ls": LINES[1 + i % 3], "lw": 0.9}
            panel.loglog(times, errors, label=label, **(look(i, marker=True) | mine | lines.get(label, {})))
        panel.set(xlabel=xlabel, ylabel=ylabel)
        if key:
            legend(panel)
    return panel


def _points(label, times, errors):
    times, errors = np.asarray(times, float), np.asarray(errors, float)
    if times.ndim != 1 or times.shape != errors.shape:
        raise ValueError(
            f"work_precision: `curves` must hold times and errors of equal length; those of {label!r} have the shapes "
            f"{times.shape} and {errors.shape}."
        )
    kept = np.isfinite(times) & np.isfinite(errors) & (times > 0) & (errors > 0)
    return times[kept], errors[kept]
