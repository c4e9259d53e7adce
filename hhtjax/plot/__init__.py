"""Charts of runs, steps and fits, by matplotlib: `pip install 'hhtjax[plot]'`.

Every function draws into the axes given as `ax` and returns them. Without `ax` it makes a figure, 85 mm wide, with 8 pt
text:

>>> import jax.numpy as jnp, matplotlib.pyplot as plt, hhtjax
>>> spring = hhtjax.System(jnp.ones(1), lambda q, v, t, params: -4.0 * q)
>>> run = hhtjax.simulate(spring, hhtjax.hht(), jnp.ones(1), jnp.zeros(1), dt=0.1, num_steps=10)
>>> ax = hhtjax.plot.trajectory(run, units="m")
>>> ax.get_xlabel(), ax.get_ylabel()
('t (s)', 'q[0] (m)')
>>> plt.close(ax.figure)

The functions do not show the figure and do not change global settings of matplotlib. To write files, call
`hhtjax.plot.save(ax.figure, "run", ("png", "pdf"))`.
"""

try:
    import matplotlib  # noqa: F401
except ModuleNotFoundError as error:
    raise ImportError("hhtjax.plot needs matplotlib: pip install 'hhtjax[plot]'") from error

from hhtjax.plot.convergence import error_against_h, work_precision
from hhtjax.plot.fits import correlations as correlations
from hhtjax.plot.fits import estimates, fit_overview, held_out, profile
from hhtjax.plot.mechanisms import Film, animation, configuration
from hhtjax.plot.records import fit_against_data
from hhtjax.plot.steps import damping_ratio, period_elongation, spectral_radius, stability_region
from hhtjax.plot.styles import COLOURS, LINES, MARKERS, PARAMETERS, legend, save, style, subplots
from hhtjax.plot.trajectories import constraint_drift as constraint_drift
from hhtjax.plot.trajectories import energy_balance, trajectory
from hhtjax.plot.trajectories import phase_plane as phase_plane

__all__ = [
    "COLOURS",
    "LINES",
    "MARKERS",
    "PARAMETERS",
    "Film",
    "animation",
    "configuration",
    "damping_ratio",
    "energy_balance",
    "error_against_h",
    "estimates",
    "fit_against_data",
    "fit_overview",
    "held_out",
    "legend",
    "period_elongation",
    "profile",
    "save",
    "spectral_radius",
    "stability_region",
    "style",
    "subplots",
    "trajectory",
    "work_precision",
]
