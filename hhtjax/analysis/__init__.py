"""What a step does to a motion: amplification, damping, periods, stability, order, energy; and the step it needs."""

from hhtjax.analysis.amplification import amplification_matrix as amplification_matrix
from hhtjax.analysis.amplification import constraint_matrix as constraint_matrix
from hhtjax.analysis.amplification import oscillator_matrix as oscillator_matrix
from hhtjax.analysis.convergence import ObservedOrder as ObservedOrder
from hhtjax.analysis.convergence import observed_order as observed_order
from hhtjax.analysis.energy import EnergyBalance as EnergyBalance
from hhtjax.analysis.energy import energy_balance as energy_balance
from hhtjax.analysis.jordan import Eigenvalue as Eigenvalue
from hhtjax.analysis.jordan import jordan_structure as jordan_structure
from hhtjax.analysis.jordan import transient_growth as transient_growth
from hhtjax.analysis.oscillator import damping_ratio as damping_ratio
from hhtjax.analysis.oscillator import overshoot as overshoot
from hhtjax.analysis.oscillator import period_elongation as period_elongation
from hhtjax.analysis.oscillator import spectral_radius as spectral_radius
from hhtjax.analysis.oscillator import stability_region as stability_region
from hhtjax.analysis.step_size import Mode as Mode
from hhtjax.analysis.step_size import StepSize as StepSize
from hhtjax.analysis.step_size import suggest_step_size as suggest_step_size
