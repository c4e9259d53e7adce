"""What a step does to a motion: amplification, damping, periods, stability, order, energy; and the step it needs.

A step of size h takes a small motion x to A x. The eigenvalues of this amplification matrix A, by automatic
differentiation of the real step, tell everything about a linear vibration: their largest modulus, the spectral radius,
whether it grows (above 1) and how much is left of it after one step; their logarithms, how much it is damped and how
much slower it becomes. Where as many eigenvalues meet as there are no eigenvectors for, in a Jordan block, a motion
grows before it decays, or for ever.

>>> import hhtjax
>>> stepper, wh = hhtjax.hht(alpha=-0.05), 0.3                                           # 21 steps in a period
>>> f"{hhtjax.analysis.damping_ratio(stepper, wh):.1e} {hhtjax.analysis.period_elongation(stepper, wh):.1e}"
'1.5e-04 8.5e-03'

Which stepper a motion needs is answered by `choose_stepper`, which step by `suggest_step_size`; what a run made or lost
by `energy_balance`; whether the error falls as it should by `observed_order`. `equilibrium` finds where a system is at
rest, `periodic_solution` a forced vibration or a limit cycle with its stability.
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
