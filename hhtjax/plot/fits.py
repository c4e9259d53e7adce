"""Charts of an identification: estimates with intervals, correlations, profiles, and a comparison of models."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from hhtjax.checks import require_number
from hhtjax.identification.comparison import Comparison
from hhtjax.identification.identifiability import parameter_names, parameter_values
from hhtjax.identification.inference import Profile
from hhtjax.identification.result import FitResult
from hhtjax.plot.records import MEASURED, densities
from hhtjax.plot.styles import COLOURS, MARKERS, PAGE, canvas, legend, look, style, subplots, with_unit

SHOWN_NUMBERS = 8  # parameters up to which the correlations are written into the matrix


def estimates(results: Any, *, level: float = 0.95, truth: Any = None, entries: Any = None, ax: Any = None) -> Any:
    """Draws estimates with their confidence intervals, in per cent of the estimate, or of the true value:

        100 (x - reference) / |reference|,    x: the estimate and the ends of `result.interval(level)`

    A parameter that the residuals do not determine is drawn as a cross without interval.

    Args:
        results: a `FitResult` with covariance, or a dict of several fits of the same model, {label: result}.
        level: confidence level of the intervals, between 0 and 1.
        truth: the true params, if they are known; used as reference instead of the first estimate.
        entries: names of the parameters to draw, as in `result.summary()`; by default all that were fitted.
        ax: axes to draw into; None for a new figure.

    Returns:
        The axes.

    Raises:
        TypeError, ValueError: an argument of a wrong kind or value; a fit without covariance; a parameter that is 0,
        for which a percentage is not defined (leave it out by `entries`).

    >>> import jax.numpy as jnp, matplotlib.pyplot as plt, hhtjax
    >>> t = jnp.arange(100.0)
    >>> result = hhtjax.fit(lambda p: p["a"] - 2.0 - jnp.sin(t), {"a": 1.0})
    >>> ax = hhtjax.plot.estimates(result)
    >>> [x.get_text() for x in ax.get_yticklabels()], ax.get_xlabel()
    (['a = 2.004'], '95 % interval (% of the estimate)')
    >>> plt.close(ax.figure)
    """
    require_number("estimates", "level", level, lambda x: 0 < x < 1, "lie between 0 and 1")
    named = results if isinstance(results, dict) else {None: results}
    for result in named.values():
        _require_fit("estimates", "results", result)
    first = next(iter(named.values()))
    names = parameter_names(first.params)
    kept = _kept(names, first, entries)
    against = first.params if truth is None else truth
    if jax.tree.structure(against) != jax.tree.structure(first.params):
        raise ValueError("estimates: `truth` must be structured like the params of the fit.")
    size = parameter_values(against)
    if zero := [names[i] for i in kept if size[i] == 0]:
        raise ValueError(f"estimates: `{zero[0]}` is 0, so per cent are not defined; leave it out by `entries`.")
    with canvas("estimates", ax, height=22 + 8 * len(kept)) as (panel,):
        panel.axvline(0, color="black", lw=0.6)
        for i, (label, result) in enumerate(named.items()):
            at = np.arange(len(kept)) + 0.5 * ((i + 0.5) / len(named) - 0.5)
            _intervals(panel, result, level, kept, size, at, label, i)
        of = "estimate" if truth is None else "truth"
        panel.set_xlabel(f"{100 * level:g} % interval (% of the {of})")
        value = (lambda i: f" = {parameter_values(first.params)[i]:.4g}") if len(named) == 1 else (lambda i: "")
        panel.set_yticks(np.arange(len(kept)), [f"{names[i]}{value(i)}" for i in kept])
        panel.set_ylim(len(kept) - 0.5, -0.5)
        legend(panel)
    return panel


def _kept(names: list, result: FitResult, entries) -> np.ndarray:
    """Indices of the parameters to draw."""
    if entries is None:
        return np.flatnonzero(result.free)
    entries = (entries,) if isinstance(entries, str) else tuple(entries)
    if unknown := [name for name in entries if name not in names]:
        raise ValueError(f"estimates: `entries` must be among {', '.join(names)}; received {unknown[0]!r}.")
    return np.array([names.index(name) for name in entries])


def _intervals(ax, result, level, kept, size, at, label, number):
    """Draws the markers and bars of one fit."""
    value = parameter_values(result.params)
    lower, upper = map(parameter_values, result.interval(level))
    middle, reach = 100 * (value - size) / abs(size), 100 * np.stack([value - lower, upper - value]) / abs(size)
    known = np.isfinite(reach).all(axis=0)[kept]
    colour, marker = COLOURS[number % 8], MARKERS[number % 8]
    shown = kept[known]
    ax.errorbar(
        middle[shown], at[known], xerr=reach[:, shown], fmt=marker, color=colour, capsize=2.5, lw=1.2, label=label
    )
    if not known.all():
        ax.plot(middle[kept[~known]], at[~known], "x", color=colour, ms=6, label="undetermined")


def correlations(result: FitResult, *, ax: Any = None) -> Any:
    """Draws the correlation matrix of the estimates; for up to 8 parameters with its numbers.

        R_ij = C_ij / sqrt(C_ii C_jj),    C: the covariance of the fit

    Args:
        result: a `FitResult` with covariance.
        ax: axes to draw into, with a colour bar beside them; None for a new figure.

    Returns:
        The axes.

    Raises:
        TypeError, ValueError: not a fit, or a fit without covariance.

    >>> import jax.numpy as jnp, matplotlib.pyplot as plt, hhtjax
    >>> t = jnp.arange(100.0)
    >>> result = hhtjax.fit(lambda p: p["a"] - 2.0 - jnp.sin(t), {"a": 1.0})
    >>> ax = hhtjax.plot.correlations(result)
    >>> [text.get_text() for text in ax.texts], [text.get_text() for text in ax.get_xticklabels()]
    (['1.00'], ['a'])
    >>> plt.close(ax.figure)
    """
    _require_fit("correlations", "result", result)
    free = np.flatnonzero(result.free)
    names = np.asarray(parameter_names(result.params))[free]
    R = np.asarray(result.correlation)[np.ix_(free, free)]
    with canvas("correlations", ax, height=64) as (panel,):
        image = panel.imshow(R, vmin=-1, vmax=1, cmap="RdBu")
        panel.grid(False)
        at = np.arange(len(free))
        panel.set_xticks(at, names, rotation=0 if max(map(len, names)) < 4 else 90)
        panel.set_yticks(at, names)
        for i, j in np.ndindex(R.shape) if len(free) <= SHOWN_NUMBERS else ():
            colour = "white" if abs(R[i, j]) > 0.6 else "black"
            panel.text(j, i, f"{R[i, j]:.2f}", ha="center", va="center", color=colour)
        bar = panel.figure.colorbar(image, ax=panel, shrink=0.8, label="correlation of the estimates")
        bar.ax.tick_params(labelsize=panel.yaxis.get_ticklabels()[0].get_size())
    return panel


def profile(
    found: Profile, *, name: str = "parameter", unit: str | None = None, result: FitResult | None = None, ax: Any = None
) -> Any:
    """Draws the deviance over one parameter, with its 95 % bound, 3.84. With `result` it also draws the parabola

        ((x - estimate) / standard error)^2.

    Args:
        found: a `Profile`, from `hhtjax.identification.profile`.
        name, unit: name and unit of the parameter.
        result: a `FitResult` that has the parameter `name`, for the parabola; None: no parabola.
        ax: axes to draw into; None for a new figure.

    Returns:
        The axes.

    Raises:
        TypeError, ValueError: an argument of a wrong kind; a name that the fit does not have.

    >>> import matplotlib.pyplot as plt, numpy as np, hhtjax
    >>> values = np.linspace(1.0, 3.0, 5)
    >>> found = hhtjax.identification.Profile(values, (values - 2) ** 2, 8 * (values - 2) ** 2)
    >>> ax = hhtjax.plot.profile(found, name="k", unit="N/m")
    >>> ax.get_xlabel()
    'k (N/m)'
    >>> plt.close(ax.figure)
    """
    if not isinstance(found, Profile):
        raise TypeError(f"profile: `found` must be a Profile, of identification.profile; received {found!r}.")
    values, deviance = np.asarray(found.values), np.asarray(found.deviance)
    order = np.argsort(values)
    with canvas("profile", ax) as (panel,):
        panel.plot(values[order], deviance[order], label="profile", **look(0, marker=True))
        if result is not None:
            estimate, error = _estimate_of(result, name)
            x = np.linspace(values.min(), values.max(), 101)
            panel.plot(x, ((x - estimate) / error) ** 2, label="parabola of the standard error", **look(1))
        panel.axhline(3.84, label="95 %", color=MEASURED, ls=":")
        panel.set(xlabel=with_unit(name, unit), ylabel="deviance")
        legend(panel)
    return panel


def _estimate_of(result, name):
    _require_fit("profile", "result", result)
    names = parameter_names(result.params)
    if name not in names:
        raise ValueError(f"profile: `name` must be one of {', '.join(names)}; received {name!r}.")
    at = names.index(name)
    return parameter_values(result.params)[at], parameter_values(result.standard_errors)[at]


def _require_fit(caller: str, name: str, result: FitResult):
    if not isinstance(result, FitResult):
        raise TypeError(f"{caller}: `{name}` must be a FitResult, as of fit; received {type(result).__name__}.")
    if result.uncertainty is None:
        raise ValueError(f"{caller}: `{name}` must have a covariance; received a fit made with covariance=False.")


# ----------------------------------------------------------------------------
# A fit on one page.


def fit_overview(
    result: FitResult,
    sampling_rate: float = 1.0,
    *,
    unit: str | None = None,
    time_unit: str = "s",
    frequency_unit: str = "Hz",
) -> Any:
    """Draws the residual of a fit over time and its spectrum, and below them the estimates and their correlations.

    The residual is that of the first channel (and of the first record, if there are several), as in
    `FitResult.residual`. Its spectrum is computed as in `hhtjax.plot.fit_against_data`. Parameters whose estimate is 0
    are left out of the estimates, because they cannot be drawn in per cent.

    Args:
        result: a `FitResult`. Its residuals (of each record) must have time as first axis, with at least 8 samples.
        sampling_rate: number of residuals in a unit of time.
        unit: unit of the residual. time_unit, frequency_unit: as in `hhtjax.plot.fit_against_data`.

    Returns:
        Axes (4,): residual, its spectrum, estimates, correlations; (2,) for a fit without covariance.

    Raises:
        TypeError, ValueError: not a fit; a sampling rate that is not positive; fewer than 8 residuals.

    >>> import jax.numpy as jnp, matplotlib.pyplot as plt, hhtjax
    >>> t = jnp.arange(100.0)
    >>> result = hhtjax.fit(lambda p: p["a"] - 2.0 - jnp.sin(t), {"a": 1.0})
    >>> axes = hhtjax.plot.fit_overview(result, 10.0, unit="mm")
    >>> [ax.get_ylabel() for ax in axes[:1]], axes[2].get_xlabel()
    (['residual (mm)'], '95 % interval (% of the estimate)')
    >>> plt.close(axes[0].figure)
    """
    if not isinstance(result, FitResult):
        raise TypeError(f"fit_overview: `result` must be a FitResult, as of fit; received {type(result).__name__}.")
    require_number(
        "fit_overview", "sampling_rate", sampling_rate, lambda x: np.isfinite(x) and x > 0, "be positive and finite"
    )
    residual = _first_channel(result)
    believed = result.uncertainty is not None
    with style():
        axes = subplots(1 + believed, 2, width=PAGE, height=65 * (1 + believed))[1].ravel()
        axes[0].plot(np.arange(len(residual)) / sampling_rate, residual, color=COLOURS[0], lw=0.7)
        axes[0].set(xlabel=with_unit("t", time_unit), ylabel=with_unit("residual", unit))
        densities(axes[1], {"residual": residual}, sampling_rate, unit, frequency_unit)
        if believed:
            names, values = parameter_names(result.params), parameter_values(result.params)
            estimates(result, entries=[names[i] for i in np.flatnonzero(result.free) if values[i] != 0], ax=axes[2])
            correlations(result, ax=axes[3])
    return axes


def _first_channel(result: FitResult) -> np.ndarray:
    """The residual over time, (N,)."""
    leaf = np.asarray(jax.tree.leaves(result.residual)[0], float)
    leaf = leaf if result.starts is None else leaf[0]
    residual = leaf.reshape(leaf.shape[0], -1)[:, 0] if leaf.ndim else leaf.reshape(1)
    if len(residual) < 8:
        raise ValueError(f"fit_overview: `result` must have 8 residuals or more; received {len(residual)}.")
    return residual


# ----------------------------------------------------------------------------
# A chart of models side by side: their errors on segments that were left out.


GREY = "#808080"


def held_out(found: Comparison, *, unit: str | None = None, ax: Any = None) -> Any:
    """Draws the errors of each model on the segments left out of its fits: one for each segment, and their rms,

        sqrt(mean_g e_g^2),    e_g: rms of the residual on segment g with the parameters fitted to the others.

    The marker of the model that `compare` has chosen is filled.

    Args:
        found: a `Comparison`, from `compare` with `residuals`.
        unit: unit of the residuals.
        ax: axes to draw into; None for a new figure.

    Returns:
        The axes.

    Raises:
        TypeError, ValueError: not a comparison, or one without errors on segments.

    >>> import matplotlib.pyplot as plt, numpy as np, hhtjax
    >>> errors = np.array([[2.0, 3.0], [1.0, 1.0]])
    >>> k, none = np.array([1, 2]), np.zeros(2)
    >>> found = hhtjax.identification.Comparison(("line", "cubic"), k, 99, 99.0, none, none, none, (), errors)
    >>> ax = hhtjax.plot.held_out(found, unit="mm")
    >>> [text.get_text() for text in ax.get_yticklabels()], ax.get_xlabel()
    (['line (1)', 'cubic (2)'], 'held-out rms (mm)')
    >>> plt.close(ax.figure)
    """
    if not isinstance(found, Comparison):
        raise TypeError(f"held_out: `found` must be a Comparison, of compare; received {type(found).__name__}.")
    if found.held_out is None:
        raise ValueError("held_out: `found` must have errors on segments left out: give `residuals` to compare.")
    count = len(found.names)
    with canvas("held_out", ax, height=22 + 8 * count) as (panel,):
        for i, errors in enumerate(found.held_out):
            segments = "each segment" if i == 0 else None
            panel.plot(errors, np.full(len(errors), i), "|", color=GREY, ms=7, label=segments)
        for name, face, words in zip(("o", "s"), ("white", COLOURS[0]), ("together", "taken"), strict=True):
            at = [i for i in range(count) if (found.names[i] == found.chosen) == (name == "s")]
            panel.plot(found.cross_validated[at], at, name, color=COLOURS[0], mfc=face, label=words)
        panel.set_yticks(range(count), [f"{n} ({k})" for n, k in zip(found.names, found.parameters, strict=True)])
        panel.set_ylim(count - 0.5, -0.5)
        panel.set_xlabel(with_unit("held-out rms", unit))
        legend(panel)
    return panel
