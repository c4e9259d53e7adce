"""Analysis of steps and runs: choice of stepper and step size, damping, periods, stability, order, energy, equilibria.

`choose_stepper` recommends a stepper and its tolerances for a motion, `suggest_step_size` a step size. `observed_order`
measures whether the error falls with the step size as it should. `energy_balance` gives the energy that the numerical
method has added or removed. `equilibrium` finds where a system is at rest. `periodic_solution` finds a forced vibration
or a limit cycle, with its stability.

The other functions describe one step. A step of size h maps a small motion x to A x. The amplification matrix A is
computed by automatic differentiation of the real step. Its eigenvalues describe linear vibrations. Their largest
modulus, the spectral radius, is the factor by which a vibration is multiplied in a step; above 1 it grows. Their
logarithms give the numerical damping and the error of the period. If A has fewer eigenvectors than eigenvalues (a
Jordan block), a motion grows before it decays, or for ever.

>>> import hhtjax
>>> stepper, wh = hhtjax.hht(alpha=-0.05), 0.3                                           # 21 steps in a period
>>> f"{hhtjax.analysis.damping_ratio(stepper, wh):.1e} {hhtjax.analysis.period_elongation(stepper, wh):.1e}"
'1.5e-04 8.5e-03'
"""

from hhtjax.analysis.amplification import (
    amplification_matrix,
    constraint_matrix,
    damping_ratio,
    oscillator_matrix,
    period_elongation,
    spectral_radius,
)
from hhtjax.analysis.amplification import (
    overshoot as overshoot,
)
from hhtjax.analysis.amplification import (
    stability_region as stability_region,
)
from hhtjax.analysis.choice import Choice as Choice
from hhtjax.analysis.choice import choose_stepper
from hhtjax.analysis.convergence import ObservedOrder as ObservedOrder
from hhtjax.analysis.convergence import observed_order
from hhtjax.analysis.energy import EnergyBalance as EnergyBalance
from hhtjax.analysis.energy import energy_balance
from hhtjax.analysis.jordan import Eigenvalue as Eigenvalue
from hhtjax.analysis.jordan import jordan_structure, transient_growth
from hhtjax.analysis.modal import ModalReduction as ModalReduction
from hhtjax.analysis.modal import NormalModes as NormalModes
from hhtjax.analysis.modal import modal_reduction as modal_reduction
from hhtjax.analysis.modal import modes
from hhtjax.analysis.periodic import PeriodicSolution as PeriodicSolution
from hhtjax.analysis.periodic import periodic_solution
from hhtjax.analysis.statics import Equilibrium as Equilibrium
from hhtjax.analysis.statics import equilibrium
from hhtjax.analysis.step_size import Mode as Mode
from hhtjax.analysis.step_size import StepSize as StepSize
from hhtjax.analysis.step_size import suggest_step_size

__all__ = [
    "amplification_matrix",
    "choose_stepper",
    "constraint_matrix",
    "damping_ratio",
    "energy_balance",
    "equilibrium",
    "jordan_structure",
    "modes",
    "observed_order",
    "oscillator_matrix",
    "period_elongation",
    "periodic_solution",
    "spectral_radius",
    "suggest_step_size",
    "transient_growth",
]


def __dir__():
    return __all__
