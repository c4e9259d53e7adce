"""A chart of models side by side: their errors on segments that were left out."""

from typing import Any

import numpy as np

from hhtjax.identification.comparison import Comparison
from hhtjax.plot.styles import COLOURS, canvas, legend, with_unit

GREY = "#808080"


def held_out(found: Comparison, *, unit: str | None = None, ax: Any = None) -> Any:
    """Errors of each model on the segments that its fit did not see: each segment, and the root of their mean square,

        sqrt(mean_g e_g^2),    e_g: rms of the residual on segment g by the parameters fitted to the others.

    The model that `compare` takes is filled.

    Args:
        found: of `compare`, given the residual functions.
        unit: of the residuals.
        ax: axes to draw into; None for a figure of its own.

    Returns:
        The axes.

    Raises:
        TypeError, ValueError: no comparison, or one without errors on segments.

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
        raise ValueError("held_out: `found` has no errors on segments; give `residuals` to compare.")
    count = len(found.names)
    with canvas("held_out", ax, height=22 + 8 * count) as (panel,):
        for i, errors in enumerate(found.held_out):
            segments = "each segment" if i == 0 else None
            panel.plot(errors, np.full(len(errors), i), "|", color=GREY, ms=7, label=segments)
        for name, face, words in zip(("o", "s"), ("white", COLOURS[0]), ("together", "together, taken"), strict=True):
            at = [i for i in range(count) if (found.names[i] == found.chosen) == (name == "s")]
            panel.plot(found.cross_validated[at], at, name, color=COLOURS[0], mfc=face, label=words)
        panel.set_yticks(range(count), [f"{n} ({k})" for n, k in zip(found.names, found.parameters, strict=True)])
        panel.set_ylim(count - 0.5, -0.5)
        panel.set_xlabel(with_unit("held-out rms", unit))
        legend(panel)
    return panel
