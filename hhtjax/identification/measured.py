"""Measurements: records cut into windows of one shape for `fit(..., records=...)`."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from hhtjax.checks import require_number
from hhtjax.description.presentation import shown


@shown
class Windows(NamedTuple):
    """Windows of measurements, each with its own clock; the last entries of shorter ones repeat, and are not present.

    Attributes:
        t: (windows, samples), s since the first sample of the window.
        y: (windows, samples, ...), measured.
        present: Booleans like y, the weights of `fit`.
        begin: (windows,), time of the first samples on the clock of the record.
    """

    t: Any
    y: Any
    present: Any
    begin: Any


def windows(t: Any, y: Any, duration: float, present: Any = None) -> Windows:
    """A record cut into windows of `duration`, one after the other; what is left at the end is dropped.

    Args:
        t: (samples,), s, increasing; not necessarily uniform: windows follow the clock, and may hold gaps.
        y: (samples, ...), measured. present: Booleans like y; False where a sample is missing, and may be NaN.
        duration: of a window, s. The next window begins with the first sample at its end or after it; without a gap
            there, the two share that sample.

    Returns:
        A `Windows`.

    Raises:
        TypeError, ValueError: unequal lengths; times that do not increase; NaN not declared missing; a record shorter
            than one window.

    >>> import numpy as np, hhtjax
    >>> t = np.array([0.0, 0.1, 0.2, 0.45, 0.5, 0.6, 0.8])
    >>> cut = hhtjax.windows(t, np.sin(t), duration=0.3)
    >>> cut.begin, cut.present.sum(axis=1)
    (array([0.  , 0.45]), array([3, 3]))
    """
    t, y = np.asarray(t, float), np.asarray(y, float)
    present = np.full(y.shape, True) if present is None else np.asarray(present, bool)
    if t.ndim != 1 or t.size == 0 or t.shape != y.shape[:1] or present.shape != y.shape:
        raise ValueError(
            "windows: `t`, `y` and `present` must have equal lengths, not 0, and `present` the shape of y; received "
            f"{t.shape}, {y.shape}, {present.shape}."
        )
    falls = np.flatnonzero(np.diff(t) <= 0)
    if not np.all(np.isfinite(t)) or falls.size:
        at = int(falls[0]) + 1 if falls.size else int(np.argmin(np.isfinite(t)))
        raise ValueError(f"windows: `t` must increase; received {t[at]} at sample {at}.")
    if not np.all(np.isfinite(y[present])):
        raise ValueError("windows: `y` must be finite, or declared missing by `present`; received NaN or inf.")
    require_number("windows", "duration", duration, lambda x: x > 0, "be positive")
    first = [0]
    while (following := max(first[-1] + 1, int(np.searchsorted(t, t[first[-1]] + duration * (1 - 1e-9))))) < len(t):
        first.append(following)
    if len(first) == 1:
        raise ValueError(f"windows: `duration` must be less than the record's, {t[-1] - t[0]}; received {duration}.")
    begin = t[first[:-1]]
    last = np.searchsorted(t, begin + duration * (1 + 1e-9), side="right") - 1
    steps = np.arange(np.max(last - first[:-1]) + 1)
    index = np.minimum(np.array(first[:-1])[:, None] + steps, last[:, None])
    real = (steps <= (last - first[:-1])[:, None]).reshape(*index.shape, *(1,) * (y.ndim - 1))
    y = np.where(present, y, 0)
    return Windows(t[index] - begin[:, None], y[index], present[index] & real, begin)


def wrap_angle(angle: Any) -> Any:
    """The same angle in [-pi, pi): for the difference of two angles of which one has lost its whole turns.

    Args:
        angle: rad, an array of any shape.

    Returns:
        Shaped like angle.

    Raises:
        TypeError: angle is not real.

    >>> round(float(wrap_angle(6.0)), 4)                                          # 6 - 2 pi
    -0.2832
    """
    angle = jnp.asarray(angle)
    return (angle + jnp.pi) % (2 * jnp.pi) - jnp.pi
