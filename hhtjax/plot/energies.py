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
    """Energies of a run over time, and below them the energy that the method made or lost.

    Args:
        system, solution, params, potential: as in `hhtjax.analysis.energy_balance`; the potential of a system
            `from_lagrangian` is known. Or an `EnergyBalance` alone.
        energy: in their place, `energy(q, v, t, params)`, the energy itself, which then is shown with its drift.
        unit: of energy. time_unit: of t. ax: two axes.

    Returns:
        Two axes, of energies and of the error.

    Raises:
        TypeError, ValueError: an argument of a wrong kind or value.

    >>> import jax.numpy as jnp, hhtjax
    >>> spring = hhtjax.System.from_lagrangian(lambda q, v, t, params: 0.5 * jnp.sum(v**2) - 2.0 * jnp.sum(q**2))
    >>> run = hhtjax.simulate(spring, hhtjax.hht(), jnp.ones(1), jnp.zeros(1), dt=0.1, num_steps=10)
    >>> upper, lower = hhtjax.plot.energy_balance(spring, run)
    >>> [line.get_label() for line in upper.lines]
    ['kinetic', 'potential', 'work of other forces', 'kinetic + potential']
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
