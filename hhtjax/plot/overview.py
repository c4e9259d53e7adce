"""A fit on one page."""

from typing import Any

import jax
import numpy as np

from hhtjax.checks import require_number
from hhtjax.identification.identifiability import parameter_names, parameter_values
from hhtjax.identification.result import FitResult
from hhtjax.plot.fits import correlations, estimates
from hhtjax.plot.records import densities
from hhtjax.plot.styles import COLOURS, PAGE, style, subplots, with_unit


def fit_overview(
    result: FitResult,
    sampling_rate: float = 1.0,
    *,
    unit: str | None = None,
    time_unit: str = "s",
    frequency_unit: str = "Hz",
) -> Any:
    """What a fit leaves over, in time and frequency, and below it estimates and correlations, where it has any.

    The residual is that of the first channel, of the first record where there are many, as in `FitResult.residual`; its
    spectrum that of `hhtjax.plot.fit_against_data`. Where the parameters cannot be drawn as in
    `hhtjax.plot.estimates`, because the estimate is 0, they are left out there.

    Args:
        result: a `FitResult`, whose residuals (of each record) have time as their first axis, 8 of them or more.
        sampling_rate: residuals in a unit of time.
        unit: of the residual. time_unit, frequency_unit: as in `hhtjax.plot.fit_against_data`.

    Returns:
        Axes (4,): residual, its spectrum, estimates, correlations; (2,) of a fit without covariance.

    Raises:
        TypeError, ValueError: no fit; a sampling rate that is not positive; residuals that are too few.

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


def _first_channel(result):
    """The residual over time, (N,)."""
    leaf = np.asarray(jax.tree.leaves(result.residual)[0], float)
    leaf = leaf if result.starts is None else leaf[0]
    residual = leaf.reshape(leaf.shape[0], -1)[:, 0] if leaf.ndim else leaf.reshape(1)
    if len(residual) < 8:
        raise ValueError(f"fit_overview: `result` must have 8 residuals or more; received {len(residual)}.")
    return residual
