"""A chart of a record: measured and simulated output, residual, and spectra."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib import mlab

from hhtjax.plot.styles import COLOURS, canvas, legend, with_unit

MEASURED = "#808080"


def fit_against_data(
    times: Any,
    measured: Any,
    simulated: Any,
    *,
    unit: str | None = None,
    ylabel: str = "output",
    time_unit: str = "s",
    frequency_unit: str = "Hz",
    show: Any = None,
    names: Any = ("measured", "simulated"),
    ax: Any = None,
) -> Any:
    """Draws measured and simulated output, the residual (measured - simulated), and spectra of record and residual.

    A spectrum is the square root of the one-sided power spectral density, by Welch's method: the mean over windows of a
    quarter to a half of the record, which overlap by half, each with its own mean subtracted. Its unit is that of the
    output over the square root of a frequency. The integral of its square is the variance.

    Args:
        times: (N,), equally spaced, N >= 8.
        measured, simulated: (N,), in the same unit. NaN where nothing was measured; the spectra use the mean there.
        unit, ylabel: unit and name of the output.
        time_unit: unit of times. frequency_unit: the unit of 1/time_unit.
        show: (first, last), the part of the time to draw. Spectra use the whole record.
        names: names of the two records in the legend.
        ax: three axes to draw into, or two, for output and residual only; None for a new figure.

    Returns:
        Three axes, (3,): output, residual, spectra; or the two that were given.

    Raises:
        TypeError, ValueError: an argument of a wrong kind, shape or value; times at unequal distances.

    References:
        Welch, The use of fast Fourier transform for the estimation of power spectra, 1967.

    >>> import matplotlib.pyplot as plt, numpy as np, hhtjax
    >>> t = np.arange(256) / 100.0
    >>> upper, middle, lower = hhtjax.plot.fit_against_data(t, np.sin(t), np.sin(t) - 0.1, unit="mV")
    >>> middle.get_ylabel(), round(float(middle.lines[0].get_ydata()[7]), 3), lower.get_xlabel()
    ('residual (mV)', 0.1, 'frequency (Hz)')
    >>> plt.close(upper.figure)
    """
    times, measured, simulated = _record(times, measured, simulated)
    inside = slice(None)
    if show is not None:
        if np.shape(show) != (2,) or not show[0] < show[1]:
            raise ValueError(f"fit_against_data: `show` must be two increasing times; received {show!r}.")
        inside = (times >= show[0]) & (times <= show[1])
    if isinstance(names, str) or len(names) != 2:
        raise ValueError(f"fit_against_data: `names` must be two words; received {names!r}.")
    residual = measured - simulated
    rate = (len(times) - 1) / (times[-1] - times[0])
    options = {"height": 115, "gridspec_kw": {"height_ratios": [3, 2, 3]}}
    with canvas("fit_against_data", ax, 2 if np.size(ax) == 2 else 3, **options) as axes:
        upper, middle, *rest = axes
        upper.plot(times[inside], measured[inside], label=names[0], color=MEASURED, lw=1.6)
        upper.plot(times[inside], simulated[inside], label=names[1], color=COLOURS[1], lw=0.8)
        middle.plot(times[inside], residual[inside], color=COLOURS[0], lw=0.7)
        upper.set_ylabel(with_unit(ylabel, unit))
        middle.set(ylabel=with_unit("residual", unit), xlabel=with_unit("t", time_unit))
        upper.sharex(middle)
        upper.tick_params(labelbottom=False)
        for lower in rest:
            densities(lower, {names[0]: measured, "residual": residual}, rate, unit, frequency_unit)
        upper.figure.align_ylabels(axes)
        legend(upper)
    return axes


def densities(ax, records: dict, rate: float, unit: str | None, frequency_unit: str):
    """Draws spectra of records, {name: values}: the residual in blue, measurements in grey."""
    for name, values in records.items():
        frequency, density = _spectrum(values, rate)
        colour = COLOURS[0] if name == "residual" else MEASURED
        ax.semilogy(frequency[1:], density[1:], label=name, color=colour, lw=0.9)
    ax.set_xlabel(with_unit("frequency", frequency_unit))
    root = f"{unit or '1'}/$\\sqrt{{\\mathrm{{{frequency_unit}}}}}$"
    ax.set_ylabel(f"density\n({root})")
    legend(ax)


def _record(times, measured, simulated):
    times, measured, simulated = (np.asarray(x, float) for x in (times, measured, simulated))
    for name, x in {"measured": measured, "simulated": simulated}.items():
        if times.ndim != 1 or x.shape != times.shape or len(times) < 8:
            raise ValueError(
                f"fit_against_data: `{name}` must be as long as `times`, 8 samples or more; "
                f"received the shapes {x.shape} and {times.shape}."
            )
    distances = np.diff(times)
    if not np.all(distances > 0) or np.ptp(distances) > 1e-3 * distances.mean():
        raise ValueError(
            "fit_against_data: `times` must increase by equal distances; received distances from "
            f"{distances.min():.6g} to {distances.max():.6g}."
        )
    return times, measured, simulated


def _spectrum(values: np.ndarray, rate: float):
    """Frequencies, and square roots of the power spectral density, by Welch's method."""
    there = np.isfinite(values)
    values = np.where(there, values, np.mean(values[there]) if there.any() else 0.0)
    length = 2 ** int(np.log2(max(8, len(values) // 2)))
    power, frequency = mlab.psd(values, NFFT=length, Fs=rate, noverlap=length // 2, detrend="mean")
    return np.asarray(frequency), np.sqrt(power)
