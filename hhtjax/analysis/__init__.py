"""What a step does to a motion: amplification, damping, periods, stability, order, energy; and the step it needs."""

from hhtjax.analysis.amplification import amplification_matrix, constraint_matrix, oscillator_matrix
from hhtjax.analysis.convergence import ObservedOrder, observed_order
from hhtjax.analysis.energy import EnergyBalance, energy_balance
from hhtjax.analysis.jordan import Eigenvalue, jordan_structure, transient_growth
from hhtjax.analysis.modal import ModalReduction, NormalModes, modal_reduction, modes
from hhtjax.analysis.oscillator import damping_ratio, overshoot, period_elongation, spectral_radius, stability_region
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
