"""Charts of the effect of a step on a linear motion, over w h or in the complex plane."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.lines import Line2D

from hhtjax import analysis
from hhtjax.checks import require_integer
from hhtjax.plot.styles import canvas, legend, look
from hhtjax.steppers.stepper import Stepper, require_stepper

WIDE = np.logspace(-2, 3, 251)  # w h of the spectral radius
NEAR = np.linspace(0.02, 3.0, 150)  # w h of oscillations that the steps can represent


def spectral_radius(steppers: Any, *, frequency: Any = None, damping: float = 0.0, ax: Any = None) -> Any:
    """Draws the spectral radius over w h. Below 1 a step damps an oscillation; above 1 it is unstable.

        rho = max |eigenvalue of A|,    A: see `hhtjax.analysis.oscillator_matrix`

    Args:
        steppers: a stepper, or a dict of several, {label: stepper}.
        frequency: w h, natural frequency times step size in rad, a vector of positive numbers; by default 0.01 to 1000.
        damping: the damping ratio of the oscillator.
        ax: axes to draw into; None for a new figure.

    Returns:
        The axes.

    Raises:
        TypeError, ValueError: an argument of a wrong kind or value.

    >>> import matplotlib.pyplot as plt, numpy as np, hhtjax
    >>> ax = hhtjax.plot.spectral_radius({"hht": hhtjax.hht(alpha=-0.1)}, frequency=np.array([0.1, 10.0]))
    >>> ax.lines[0].get_ydata().round(3).tolist()
    [1.0, 0.838]
    >>> plt.close(ax.figure)
    """
    return _over_frequency("spectral_radius", "spectral radius", steppers, frequency, damping, ax, WIDE)


def damping_ratio(steppers: Any, *, frequency: Any = None, damping: float = 0.0, ax: Any = None) -> Any:
    """Draws the damping ratio of the oscillator in the steps, over w h.

        -Re(r)/|r|,    r = log(principal eigenvalue of A)

    With damping = 0 this is the numerical damping of the method. There is no curve where no eigenvalue oscillates.

    Args:
        steppers, damping, ax: as in `hhtjax.plot.spectral_radius`.
        frequency: w h in rad, a vector of positive numbers; by default up to 3.

    Returns:
        The axes.

    Raises:
        TypeError, ValueError: an argument of a wrong kind or value.

    >>> import matplotlib.pyplot as plt, numpy as np, hhtjax
    >>> ax = hhtjax.plot.damping_ratio(hhtjax.hht(alpha=-0.1), frequency=np.array([0.1, 1.0]))
    >>> ax.lines[0].get_ydata().round(5).tolist()
    [1e-05, 0.00675]
    >>> plt.close(ax.figure)
    """
    return _over_frequency("damping_ratio", "damping ratio", steppers, frequency, damping, ax, NEAR)


def period_elongation(steppers: Any, *, frequency: Any = None, damping: float = 0.0, ax: Any = None) -> Any:
    """Draws the relative error of the natural period over w h.

        w h/|r| - 1,    r = log(principal eigenvalue of A)

    There is no curve where no eigenvalue oscillates.

    Args:
        steppers, frequency, damping, ax: as in `hhtjax.plot.damping_ratio`.

    Returns:
        The axes.

    Raises:
        TypeError, ValueError: an argument of a wrong kind or value.

    >>> import matplotlib.pyplot as plt, numpy as np, hhtjax
    >>> ax = hhtjax.plot.period_elongation(hhtjax.hht(alpha=-0.1), frequency=np.array([0.1, 1.0]))
    >>> ax.lines[0].get_ydata().round(5).tolist()
    [0.00104, 0.09448]
    >>> plt.close(ax.figure)
    """
    return _over_frequency("period_elongation", "relative period error", steppers, frequency, damping, ax, NEAR)


def _over_frequency(
    caller: str, ylabel: str, steppers: dict, frequency: np.ndarray, damping: float, ax, default: np.ndarray
):
    """Draws the function of `hhtjax.analysis` that has the name of the caller, for each stepper."""
    named = _named(caller, steppers)
    frequency = default if frequency is None else np.asarray(frequency)
    if frequency.ndim != 1 or not np.all(frequency > 0):
        raise ValueError(f"{caller}: `frequency` must be a vector of positive numbers w h; received {frequency!r}.")
    curves = {label: np.asarray(getattr(analysis, caller)(one, frequency, damping)) for label, one in named.items()}
    with canvas(caller, ax) as (panel,):
        for i, (label, values) in enumerate(curves.items()):
            panel.plot(frequency, values, label=label, **look(i))
        if default is WIDE:
            panel.set_xscale("log")
        panel.set(xlabel="w h (rad)", ylabel=ylabel)
        legend(panel)
    return panel


def _named(caller: str, steppers: dict):
    """{label: stepper}; a single stepper has the label None."""
    if isinstance(steppers, Stepper):
        return {None: steppers}
    if not isinstance(steppers, dict) or not steppers:
        raise TypeError(f"{caller}: `steppers` must be a stepper or {{label: stepper}}; received {steppers!r}.")
    for stepper in steppers.values():
        require_stepper(caller, stepper)
    return steppers


def stability_region(
    steppers: Any, *, real: Any = (-8.0, 8.0), imag: Any = (-8.0, 8.0), points: int = 121, ax: Any = None
) -> Any:
    """Draws the region of z = h lambda in which a stepper is stable for y' = lambda y: shaded, with its edge.

        stable: |eigenvalue| <= 1 for all eigenvalues of the step, as in `hhtjax.analysis.stability_region`

    Args:
        steppers: a stepper, or a dict of several, {label: stepper}.
        real, imag: (smallest, largest), the range of the real and of the imaginary axis.
        points: number of points in each direction, at least 2. The edge is interpolated between them.
        ax: axes to draw into; None for a new figure.

    Returns:
        The axes.

    Raises:
        TypeError, ValueError: an argument of a wrong kind or value.

    >>> import matplotlib.pyplot as plt, numpy as np, hhtjax
    >>> ax = hhtjax.plot.stability_region(hhtjax.rk4(), real=(-4, 2), imag=(-1, 1), points=25)
    >>> edge = np.concatenate([path.vertices for path in ax.collections[1].get_paths()])
    >>> round(float(edge[abs(edge[:, 1]) < 1e-9, 0].min()), 1)                         # RK4 is stable from -2.785 to 0
    -2.8
    >>> plt.close(ax.figure)
    """
    named = _named("stability_region", steppers)
    points = require_integer("stability_region", "points", points, 2)
    for name, ends in {"real": real, "imag": imag}.items():
        if np.shape(ends) != (2,) or not ends[0] < ends[1]:
            raise ValueError(f"stability_region: `{name}` must be two increasing numbers; received {ends!r}.")
    x, y = np.linspace(real[0], real[1], points), np.linspace(imag[0], imag[1], points)
    z = x[None, :] + 1j * y[:, None]
    radii = {label: np.asarray(analysis.stability_region(one, z)) for label, one in named.items()}
    with canvas("stability_region", ax, height=80) as (panel,):
        for i, radius in enumerate(radii.values()):
            chosen = look(i)
            panel.contourf(x, y, radius, levels=[0, 1 + 1e-9], colors=[chosen["color"]], alpha=0.15)
            panel.contour(x, y, radius, levels=[1 + 1e-9], colors=[chosen["color"]], linestyles=[chosen["ls"]])
        panel.axhline(0, color="black", lw=0.5)
        panel.axvline(0, color="black", lw=0.5)
        panel.set_aspect("equal")
        panel.set(xlabel="Re h lambda", ylabel="Im h lambda")
        shown = [Line2D([], [], label=label, **look(i)) for i, label in enumerate(radii) if label is not None]
        legend(panel, shown, [label for label in radii if label is not None])
    return panel
