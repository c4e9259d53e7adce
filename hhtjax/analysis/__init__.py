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

Which step a system needs is answered by `suggest_step_size`; what a run made or lost by `energy_balance`; whether the
error falls as it should by `observed_order`.
"""

from hhtjax.analysis.amplification import (
    amplification_matrix,
    constraint_matrix,
    damping_ratio,
    oscillator_matrix,
    overshoot,
    period_elongation,
    spectral_radius,
    stability_region,
)
from hhtjax.analysis.convergence import ObservedOrder, observed_order
from hhtjax.analysis.energy import EnergyBalance, energy_balance
from hhtjax.analysis.jordan import Eigenvalue, jordan_structure, transient_growth
from hhtjax.analysis.modal import ModalReduction, NormalModes, modal_reduction, modes
from hhtjax.analysis.step_size import Mode, StepSize, suggest_step_size

__all__ = [
    "Eigenvalue",
    "EnergyBalance",
    "ModalReduction",
    "Mode",
    "NormalModes",
    "ObservedOrder",
    "StepSize",
    "amplification_matrix",
    "constraint_matrix",
    "damping_ratio",
    "energy_balance",
    "jordan_structure",
    "modal_reduction",
    "modes",
    "observed_order",
    "oscillator_matrix",
    "overshoot",
    "period_elongation",
    "spectral_radius",
    "stability_region",
    "suggest_step_size",
    "transient_growth",
]


def __dir__():
    return __all__
