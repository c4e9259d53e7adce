"""Parameters from measurements, and how far to trust them; the everyday names are those of `hhtjax` too."""

from hhtjax.identification.arguments import Gaussian
from hhtjax.identification.bias import ModeBias, step_size_bias
from hhtjax.identification.identifiability import IdentifiabilityWarning
from hhtjax.identification.identify import Multistart, fit, multistart
from hhtjax.identification.inference import Profile, Score, prediction_errors, profile, score_test
from hhtjax.identification.measured import Windows, measure, windows, wrap_angle
from hhtjax.identification.progress import History
from hhtjax.identification.refinement import Refined, StepSizeWarning, refine
from hhtjax.identification.result import FitResult
from hhtjax.identification.sandwich import Uncertainty
from hhtjax.identification.starts import equation_error, fit_progressively
from hhtjax.identification.transforms import bounded, fixed, positive

__all__ = [
    "FitResult",
    "Gaussian",
    "History",
    "IdentifiabilityWarning",
    "ModeBias",
    "Multistart",
    "Profile",
    "Refined",
    "Score",
    "StepSizeWarning",
    "Uncertainty",
    "Windows",
    "bounded",
    "equation_error",
    "fit",
    "fit_progressively",
    "fixed",
    "measure",
    "multistart",
    "positive",
    "prediction_errors",
    "profile",
    "refine",
    "score_test",
    "step_size_bias",
    "windows",
    "wrap_angle",
]


def __dir__():
    return __all__
