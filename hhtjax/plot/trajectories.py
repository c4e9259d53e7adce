"""Charts of one run: over time, in the phase plane, constraint drift, and energy balance."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax import analysis
from hhtjax.analysis.energy import EnergyBalance
from hhtjax.checks import require_function
from hhtjax.description import Array, PyTree
from hhtjax.plot.styles import (
    SYMBOLS,
    canvas,
    chosen_entries,
    legend,
    look,
    prefixed,
    require_run,
    shown_name,
    unit_of,
    with_unit,
)
from hhtjax.runs.solution import Solution

HEIGHT = 45  # mm of a panel over time


def trajectory(
    solution: Solution,
    quantities: Any = "q",
    *,
    entries: Any = None,
    units: Any = None,
    time_unit: str = "s",
    label: str | None = None,
    key: bool = True,
    ax: Any = None,
    **line: Any,
) -> Any:
    """Draws q, v, acceleration, multipliers or internal states over time, with a curve for each entry.

    Events of the run are thin vertical lines.

    Args:
        solution: solution of one run. Select member i of a batch by `jax.tree.map(lambda x: x[i], solution)`.
        quantities: "q", "v", "acceleration", "multipliers" or "z"; or a tuple of several, one panel for each.
        entries: names of the entries to draw: "[0]" of an array, "phi" or "x[1]" of a dict, "x" for a whole leaf.
        units: a unit; or units by entry or leaf, {"x": "m"}; or either by quantity, {"q": "rad", "v": "rad/s"}.
        time_unit: unit of time.
        label: prefix of the names of the curves, to distinguish several runs in one chart.
        key: whether to draw a legend. Pass False to draw one legend for several axes yourself.
        ax: axes to draw into, one for each quantity; None for a new figure.
        **line: further options of `ax.plot`.

    Returns:
        The axes; an array of axes for several quantities.

    Raises:
        TypeError, ValueError: an argument of a wrong kind or value; a batch of runs; a quantity that the run lacks.

    >>> import jax.numpy as jnp, matplotlib.pyplot as plt, hhtjax
    >>> spring = hhtjax.System(jnp.ones(1), lambda q, v, t, params: -4.0 * q)
    >>> run = hhtjax.simulate(spring, hhtjax.hht(), jnp.ones(1), jnp.zeros(1), dt=0.1, num_steps=10)
    >>> upper, lower = hhtjax.plot.trajectory(run, ("q", "v"), units={"q": "m", "v": "m/s"})
    >>> upper.get_ylabel(), lower.get_ylabel(), lower.get_xlabel()
    ('q[0] (m)', 'v[0] (m/s)', 't (s)')
    >>> plt.close(upper.figure)
    """
    require_run("trajectory", solution)
    names = (quantities,) if isinstance(quantities, str) else tuple(quantities)
    unknown = [name for name in names if name not in SYMBOLS]
    if unknown or not names:
        raise ValueError(f"trajectory: `quantities` must be among {', '.join(SYMBOLS)}; received {quantities!r}.")
    curves = [chosen_entries("trajectory", solution, name, entries) for name in names]
    options = {"height": HEIGHT * len(names) + 15, "sharex": True}
    with canvas("trajectory", ax, len(names), **options) as axes:
        for panel, name, found in zip(axes, names, curves, strict=True):
            by_quantity = isinstance(units, dict) and set(units) <= set(SYMBOLS)
            _draw(panel, solution.t, name, found, units.get(name) if by_quantity else units, label, line)
            if solution.events is not None:
                _mark(panel, np.asarray(solution.events.t))
            if key:
                legend(panel)
        axes[-1].set_xlabel(with_unit("t", time_unit))
        axes[0].figure.align_ylabels(axes)
    return axes[0] if isinstance(quantities, str) else axes


def _draw(ax, t, quantity, found, units, label, line):
    """Draws the entries of one quantity. A common unit is written at the axis, different units after each name."""
    each = [unit_of(units, name, leaf) for name, (leaf, _) in found.items()]
    shared = each[0] if len(set(each)) == 1 else None
    start = len(ax.lines)
    for i, ((name, (_, values)), unit) in enumerate(zip(found.items(), each, strict=True)):
        shown = with_unit(shown_name(quantity, name), None if shared else unit)
        alone = len(found) == 1 and label is not None
        ax.plot(np.asarray(t), values, label=label if alone else prefixed(label, shown), **(look(start + i) | line))
    name = shown_name(quantity, next(iter(found))) if len(found) == 1 else quantity
    ax.set_ylabel(with_unit(name, shared))


def _mark(ax, times):
    """Draws vertical lines behind the curves; they do not count as curves."""
    style = {"colors": "0.6", "lw": 0.6, "ls": ":", "zorder": 0, "label": "_event"}
    ax.vlines(times[np.isfinite(times)], 0, 1, transform=ax.get_xaxis_transform(), **style)


def phase_plane(
    solution: Solution,
    entries: Any = None,
    *,
    units: Any = None,
    label: str | None = None,
    ax: Any = None,
    **line: Any,
) -> Any:
    """Draws velocity over position, a curve for each entry, with its start marked.

    Args:
        solution: solution of one run.
        entries: names of the entries to draw, as in `trajectory`; by default all.
        units: (unit of position, unit of velocity).
        label, ax, **line: as in `trajectory`.

    Returns:
        The axes.

    Raises:
        TypeError, ValueError: an argument of a wrong kind or value; a rotation, which has no phase plane.

    >>> import jax.numpy as jnp, matplotlib.pyplot as plt, hhtjax
    >>> spring = hhtjax.System(jnp.ones(1), lambda q, v, t, params: -4.0 * q)
    >>> run = hhtjax.simulate(spring, hhtjax.hht(), jnp.ones(1), jnp.zeros(1), dt=0.1, num_steps=10)
    >>> ax = hhtjax.plot.phase_plane(run, units=("m", "m/s"))
    >>> ax.get_ylabel()
    'v[0] (m/s)'
    >>> plt.close(ax.figure)
    """
    require_run("phase_plane", solution)
    if units is not None and (isinstance(units, str) or len(units) != 2):
        raise ValueError(f"phase_plane: `units` must be two, of position and velocity; received {units!r}.")
    if solution.v is None:
        raise ValueError("phase_plane: `solution` must have velocities; received a run without velocities.")
    q = chosen_entries("phase_plane", solution, "q", entries)
    v = chosen_entries("phase_plane", solution, "v", None)
    if missing := [name for name in q if name not in v]:
        raise ValueError(f"phase_plane: `entries` must have a velocity of their own; received {missing[0]}.")
    position, velocity = units or (None, None)
    with canvas("phase_plane", ax, height=70) as (panel,):
        start = len([x for x in panel.lines if len(x.get_xdata()) > 1])
        for i, (name, (_, values)) in enumerate(q.items()):
            shown = label if len(q) == 1 and label is not None else prefixed(label, shown_name("q", name))
            (drawn,) = panel.plot(values, v[name][1], label=shown, **(look(start + i) | line))
            panel.plot(values[:1], v[name][1][:1], "o", ms=4, color=drawn.get_color(), label="_start")
        alone = next(iter(q)) if len(q) == 1 else None
        rate = f"d{alone}/dt" if alone and not alone.startswith("[") else f"v{alone or ''}"
        panel.set_xlabel(with_unit("q" if alone is None else shown_name("q", alone), position))
        panel.set_ylabel(with_unit(rate, velocity))
        if len(q) > 1 or label is not None:
            legend(panel)
    return panel


def constraint_drift(
    solution: Solution,
    *,
    unit: str | None = None,
    time_unit: str = "s",
    label: str | None = None,
    ax: Any = None,
    **line: Any,
) -> Any:
    """Draws the violation of constraints: the largest |Phi| and |dPhi/dt| between saved times, logarithmic.

    Zeros are not drawn.

    Args:
        solution: solution of one run of a system with constraints.
        unit: unit of Phi. time_unit: unit of time.
        label, ax, **line: as in `trajectory`.

    Returns:
        The axes.

    Raises:
        TypeError, ValueError: an argument of a wrong kind; a run without constraints.

    >>> import jax.numpy as jnp, matplotlib.pyplot as plt, hhtjax
    >>> pendulum = hhtjax.System(jnp.ones(2), lambda q, v, t, params: jnp.array([0.0, -9.81]),
    ...                          lambda q, t, params: jnp.sum(q**2, keepdims=True) - 1.0)
    >>> run = hhtjax.simulate(pendulum, hhtjax.hht(), jnp.array([1.0, 0.0]), jnp.zeros(2), dt=0.05, num_steps=10)
    >>> ax = hhtjax.plot.constraint_drift(run, unit="m²")
    >>> [line.get_label() for line in ax.lines], ax.get_yscale()
    (['|Phi| (m²)', '|dPhi/dt| (m²/s)'], 'log')
    >>> plt.close(ax.figure)
    """
    require_run("constraint_drift", solution)
    info = solution.info
    found = {"|Phi|": info.constraint, "|dPhi/dt|": info.constraint_rate}
    found = {name: np.asarray(x, float) for name, x in found.items() if x is not None}
    if not found:
        raise ValueError("constraint_drift: `solution` must be of a system with constraints; received one without.")
    with canvas("constraint_drift", ax, height=60) as (panel,):
        start = len(panel.lines)
        t = np.asarray(solution.t)[1:]
        for i, (name, values) in enumerate(found.items()):
            shown = prefixed(label, with_unit(name, unit and (unit if name == "|Phi|" else f"{unit}/{time_unit}")))
            panel.semilogy(t, np.where(values > 0, values, np.nan), label=shown, **(look(start + i) | line))
        panel.set(xlabel=with_unit("t", time_unit), ylabel="violation of the constraints")
        legend(panel)
    return panel


# ----------------------------------------------------------------------------
# A chart of the energy balance: energies, work, and the error of the method.


@dataclass(frozen=True)
class LagrangianPotential:
    """V(q, t) = -L(q, 0, t). It is a class, so that equal Lagrangians are compiled once."""

    lagrangian: Any

    def __call__(self, q: Array, t: Array, params: PyTree) -> Array:
        return -self.lagrangian(q, jax.tree.map(jnp.zeros_like, q), t, params)


def energy_balance(
    system: Any,
    solution: Any = None,
    params: Any = None,
    *,
    potential: Any = None,
    energy: Any = None,
    unit: str = "J",
    time_unit: str = "s",
    ax: Any = None,
) -> Any:
    """Draws the energies of a run over time, and below them the energy that the method has added or removed,

        made by the method(t) = T(t) + V(t) - T(0) - V(0) - W(t),

    with the work W of all forces that have no potential V.

    Args:
        system: system of the run; or only an `EnergyBalance`, without solution, params and potential.
        solution: solution of one run.
        params: params of the run.
        potential: `potential(q, t, params)`, a scalar. For a system `from_lagrangian` it is known. Without a potential,
            W is the work of all forces.
        energy: `energy(q, v, t, params)`, a scalar. If given, this energy is drawn instead of the balance, and below it
            its change since the start. Then system and potential are not used.
        unit: unit of energy. time_unit: unit of time.
        ax: two axes to draw into; None for a new figure.

    Returns:
        Two axes, (2,): energies, and error.

    Raises:
        TypeError, ValueError: an argument of a wrong kind or value; not a run, or a batch of runs; otherwise as
        `hhtjax.analysis.energy_balance`.

    >>> import jax.numpy as jnp, matplotlib.pyplot as plt, hhtjax
    >>> spring = hhtjax.System.from_lagrangian(lambda q, v, t, params: 0.5 * jnp.sum(v**2) - 2.0 * jnp.sum(q**2))
    >>> run = hhtjax.simulate(spring, hhtjax.hht(), jnp.ones(1), jnp.zeros(1), dt=0.1, num_steps=10)
    >>> upper, lower = hhtjax.plot.energy_balance(spring, run)
    >>> [line.get_label() for line in upper.lines]
    ['kinetic', 'potential', 'work of other forces', 'kinetic + potential']
    >>> plt.close(upper.figure)
    """
    if energy is not None:
        t, curves, error, drift = _given_energy(solution, params, energy)
    else:
        t, curves, error, drift = _balance(system, solution, params, potential)
    with canvas("energy_balance", ax, 2, height=95, sharex=True, gridspec_kw={"height_ratios": [3, 2]}) as axes:
        for i, (name, values) in enumerate(curves.items()):
            axes[0].plot(t, values, label=name, **look(i))
        axes[0].set_ylabel(with_unit("energy", unit))
        legend(axes[0])
        axes[0].figure.align_ylabels(axes)
        axes[1].plot(t, error, **look(1) | {"ls": "-"})
        axes[1].set_ylabel(with_unit(drift, unit))
        axes[1].set_xlabel(with_unit("t", time_unit))
    return axes


def _balance(system, solution, params: PyTree, potential):
    """Times, curves, error and its name, by `hhtjax.analysis`."""
    found = system
    if not isinstance(system, EnergyBalance):
        if solution is None:
            raise TypeError("energy_balance: `solution` must be a Solution, as of simulate; received None.")
        require_run("energy_balance", solution)
        lagrangian = getattr(getattr(system, "mass", None), "lagrangian", None)
        if potential is None and lagrangian is not None:
            potential = LagrangianPotential(lagrangian)
        found = analysis.energy_balance(system, solution, params, potential)
    t, kinetic, V, work, error = map(np.asarray, found)
    curves = {"kinetic": kinetic}
    if np.any(V):
        curves["potential"] = V
    curves["work of other forces" if np.any(V) else "work of all forces"] = work
    if np.any(V):
        curves["kinetic + potential"] = kinetic + V
    return t, curves, error, "made by the\nmethod"


def _given_energy(solution: Solution, params: PyTree, energy: Callable):
    """Times, curves, error and its name, for an energy function given by the user."""
    require_run("energy_balance", solution)
    require_function("energy_balance", "energy", energy, "energy(q, v, t, params)")
    values = jax.vmap(lambda q, v, t: energy(q, v, t, params))(solution.q, solution.v, solution.t)
    if np.shape(values) != np.shape(solution.t):
        raise ValueError(f"energy_balance: `energy` must return a scalar; received the shape {np.shape(values)[1:]}.")
    values = np.asarray(values)
    return np.asarray(solution.t), {"energy": values}, values - values[0], "change since\nthe start"
