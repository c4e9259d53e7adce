"""A chart of where energy is, where it went, and what the method made of it."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax import analysis
from hhtjax.analysis.energy import EnergyBalance
from hhtjax.checks import require_function
from hhtjax.plot.entries import require_run
from hhtjax.plot.styles import canvas, legend, look, with_unit


@dataclass(frozen=True)
class LagrangianPotential:
    """V(q, t) = -L(q, 0, t). A class, so that equal Lagrangians are compiled once."""

    lagrangian: Any

    def __call__(self, q, t, params):
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
    """Energies of a run over time, and below them the energy that the method made or lost,

        made by the method(t) = T(t) + V(t) - T(0) - V(0) - W(t),

    with the work W of all forces that have no potential V.

    Args:
        system: of the run; or an `EnergyBalance` alone, in place of it and the next three.
        solution: of one run.
        params: those of the run.
        potential: `potential(q, t, params)`, a scalar; that of a system `from_lagrangian` is known. Without one the
            work is that of all forces.
        energy: `energy(q, v, t, params)`, a scalar: instead of the balance, this energy is drawn, and below it how far
            it is from its first value. Then system and potential are not used.
        unit: of energy. time_unit: of the times.
        ax: two axes to draw into; None for a figure of its own.

    Returns:
        Two axes, (2,), of energies and of the error.

    Raises:
        TypeError, ValueError: an argument of a wrong kind or value; no run, or a batch of them; otherwise as
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


def _balance(system, solution, params, potential):
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


def _given_energy(solution, params, energy):
    """The same of an energy function of the user's."""
    require_run("energy_balance", solution)
    require_function("energy_balance", "energy", energy, "energy(q, v, t, params)")
    values = jax.vmap(lambda q, v, t: energy(q, v, t, params))(solution.q, solution.v, solution.t)
    if np.shape(values) != np.shape(solution.t):
        raise ValueError(f"energy_balance: `energy` must return a scalar; received the shape {np.shape(values)[1:]}.")
    values = np.asarray(values)
    return np.asarray(solution.t), {"energy": values}, values - values[0], "change since\nthe start"
