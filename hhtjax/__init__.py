"""hhtjax: differentiable, functional time integrators for multibody dynamics."""

from hhtjax import analysis as analysis
from hhtjax import rotation as rotation
from hhtjax import scenes as scenes
from hhtjax.band_limited import band_limited as band_limited
from hhtjax.band_limited import band_limited_motion as band_limited_motion
from hhtjax.band_limited import spline_gain_error as spline_gain_error
from hhtjax.constraints import consistent_initial as consistent_initial
from hhtjax.flat_system import PrecisionWarning as PrecisionWarning
from hhtjax.identification.arguments import Gaussian as Gaussian
from hhtjax.identification.bias import step_size_bias as step_size_bias
from hhtjax.identification.identifiability import IdentifiabilityWarning as IdentifiabilityWarning
from hhtjax.identification.identify import fit as fit
from hhtjax.identification.identify import multistart as multistart
from hhtjax.identification.inference import prediction_errors as prediction_errors
from hhtjax.identification.inference import profile as profile
from hhtjax.identification.inference import score_test as score_test
from hhtjax.identification.refine import StepSizeWarning as StepSizeWarning
from hhtjax.identification.refine import refine as refine
from hhtjax.identification.starts import equation_error as equation_error
from hhtjax.identification.starts import fit_progressively as fit_progressively
from hhtjax.identification.transforms import bounded as bounded
from hhtjax.identification.transforms import fixed as fixed
from hhtjax.identification.transforms import positive as positive
from hhtjax.identification.windows import measure as measure
from hhtjax.identification.windows import windows as windows
from hhtjax.identification.windows import wrap_angle as wrap_angle
from hhtjax.sampled import sampled as sampled
from hhtjax.simulate import SimulationError as SimulationError
from hhtjax.simulate import interpolate as interpolate
from hhtjax.simulate import simulate as simulate
from hhtjax.steppers.explicit import rk4 as rk4
from hhtjax.steppers.generalized_alpha import bossak as bossak
from hhtjax.steppers.generalized_alpha import generalized_alpha as generalized_alpha
from hhtjax.steppers.generalized_alpha import hht as hht
from hhtjax.steppers.generalized_alpha import newmark as newmark
from hhtjax.steppers.implicit_euler import implicit_euler as implicit_euler
from hhtjax.steppers.kim2019 import conventional_hht as conventional_hht
from hhtjax.steppers.kim2019 import kim_hht as kim_hht
from hhtjax.steppers.kim2019 import kim_implicit_euler as kim_implicit_euler
from hhtjax.steppers.splitting import operator_splitting as operator_splitting
from hhtjax.system import FirstOrderSystem as FirstOrderSystem
from hhtjax.system import LinearSystem as LinearSystem
from hhtjax.system import System as System

__version__ = "0.1.0"
