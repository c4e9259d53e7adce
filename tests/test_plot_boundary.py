"""Charts: what is no run, no fit, no axes, gets one error that names it."""

import matplotlib as mpl
import numpy as np
import plotted_runs
import pytest
from jax import numpy as jnp

import hhtjax
from hhtjax import plot

mpl.use("Agg")
import matplotlib.pyplot as plt

WRONG = {
    r"trajectory: `solution` must be a Solution": lambda run, batch: plot.trajectory(run.q),
    r"trajectory: `solution` must be of one run": lambda run, batch: plot.trajectory(batch),
    r"trajectory: `quantities` must be among": lambda run, batch: plot.trajectory(run, "speed"),
    r"trajectory: `entries` must be among phi, x; received 'y'": lambda run, batch: plot.trajectory(run, entries="y"),
    r"trajectory: `ax` must be matplotlib axes": lambda run, batch: plot.trajectory(run, ax="here"),
    r"trajectory: `ax` must be 2": lambda run, batch: plot.trajectory(run, ("q", "v"), ax=plt.figure().gca()),
    r"trajectory: the solution has no multipliers": lambda run, batch: plot.trajectory(run, "multipliers"),
    r"phase_plane: `units` must be two": lambda run, batch: plot.phase_plane(run, units="m"),
    r"energy_balance: `solution` must be": lambda run, batch: plot.energy_balance(plotted_runs.SYSTEM),
    r"energy_balance: `energy` must return a scalar": lambda run, batch: plot.energy_balance(
        plotted_runs.SYSTEM, run, energy=lambda q, v, t, params: jnp.ones(2)
    ),
    r"constraint_drift: `solution` must be of a system": lambda run, batch: plot.constraint_drift(run),
    r"error_against_h: `dt` must be a sweep": lambda run, batch: plot.error_against_h(run),
    r"error_against_h: `dt` and `error` must be": lambda run, batch: plot.error_against_h([0.1, 0.2], [1.0]),
    r"error_against_h: `dt` must be positive": lambda run, batch: plot.error_against_h([0.0, 0.2], [1.0, 2.0]),
    r"error_against_h: `reference` must be shaped": lambda run, batch: plot.error_against_h(batch, reference=run.q),
    r"error_against_h: `lines` must be of a; received 'b'": lambda run, batch: plot.error_against_h(
        {"a": ([0.1], [1.0])}, lines={"b": {}}
    ),
    r"work_precision: `lines` must be of a": lambda run, batch: plot.work_precision({"a": ([1], [1])}, lines={"b": {}}),
    r"work_precision: `curves` must be": lambda run, batch: plot.work_precision([1, 2]),
    r"work_precision: `ours` must be among a": lambda run, batch: plot.work_precision({"a": ([1], [1])}, ours="b"),
    r"work_precision: `curves` must hold": lambda run, batch: plot.work_precision({"a": ([1], [1, 2])}),
    r"spectral_radius: `steppers` must be": lambda run, batch: plot.spectral_radius([hhtjax.rk4()]),
    r"damping_ratio: `frequency` must be": lambda run, batch: plot.damping_ratio(hhtjax.rk4(), frequency=[-1.0]),
    r"stability_region: `real` must be": lambda run, batch: plot.stability_region(hhtjax.rk4(), real=(1, 0)),
    r"fit_against_data: `simulated` must be": lambda run, batch: plot.fit_against_data(range(9), range(9), [1.0]),
    r"fit_against_data: `times` must increase": lambda run, batch: plot.fit_against_data(
        np.arange(9) ** 2, range(9), range(9)
    ),
    r"fit_against_data: `names` must be two": lambda run, batch: plot.fit_against_data(
        range(9), range(9), range(9), names="ours"
    ),
    r"estimates: `results` must be a FitResult": lambda run, batch: plot.estimates(run),
    r"estimates: `level` must": lambda run, batch: plot.estimates(None, level=95),
    r"fit_overview: `result` must be a FitResult": lambda run, batch: plot.fit_overview(run),
    r"profile: `found` must be a Profile": lambda run, batch: plot.profile([1.0]),
    r"animation: `points` must return": lambda run, batch: plot.animation(run, lambda q: q["phi"]),
    r"animation: `fps` must be positive": lambda run, batch: plot.animation(run, lambda q: q, fps=0),
    r"configuration: `ax` must be axes with projection": lambda run, batch: plot.configuration(
        run, lambda q: np.zeros((2, 3)), 0.0, ax=plt.figure().gca()
    ),
    r"save: `formats` must be": lambda run, batch: plot.save(plt.figure(), "x", "png"),
    r"subplots: `width` must be positive": lambda run, batch: plot.subplots(width=0),
}


@pytest.mark.parametrize("message", WRONG)
def test_bad_input_is_named(message):
    with pytest.raises((TypeError, ValueError), match=message):
        WRONG[message](plotted_runs.run(), plotted_runs.sweep())
    plt.close("all")
