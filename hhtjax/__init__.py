"""hhtjax: differentiable, functional time integrators for multibody dynamics.

A system, a stepper, one run, and derivatives through all of it: `System`, `hht`, `simulate`, `fit`. What a step does to
a motion is in `hhtjax.analysis`, examples to start from are in `hhtjax.scenes`.
"""

from hhtjax import analysis, identification, rotation, scenes, trigonometry
from hhtjax.description import VERSION as __version__
from hhtjax.identification.arguments import Gaussian
from hhtjax.identification.bias import step_size_bias
from hhtjax.identification.identify import fit, multistart
from hhtjax.identification.measured import measure, windows
from hhtjax.identification.refinement import refine
from hhtjax.identification.result import FitResult
from hhtjax.identification.starts import equation_error, fit_progressively
from hhtjax.identification.transforms import bounded, fixed, positive
from hhtjax.numerics.structured_solve import banded, conjugate_gradients
from hhtjax.runs.interpolate import InternalInterpolant, Interpolant, interpolate
from hhtjax.runs.simulate import simulate
from hhtjax.runs.solution import Failure, SimulationError, Solution
from hhtjax.runs.sweep import sweep
from hhtjax.runs.sweep_to_disk import load_sweep, sweep_to_disk
from hhtjax.steppers.collocation import collocation, wilson
from hhtjax.steppers.explicit import rk4
from hhtjax.steppers.generalized_alpha import bossak, generalized_alpha, hht, newmark
from hhtjax.steppers.implicit_euler import implicit_euler
from hhtjax.steppers.kim2019 import conventional_hht, kim_hht, kim_implicit_euler
from hhtjax.steppers.multistep import houbolt, park
from hhtjax.steppers.rosenbrock import rosenbrock, rowda
from hhtjax.steppers.splitting import operator_splitting
from hhtjax.steppers.stepper import Info, State, Stepper
from hhtjax.systems.band_limited import band_limited, band_limited_motion, spline_gain_error
from hhtjax.systems.consistent import ConsistentInitial, consistent_initial
from hhtjax.systems.initial_values import PrecisionWarning
from hhtjax.systems.sampled import Sampled, sampled
from hhtjax.systems.system import FirstOrderSystem, LinearSystem, System
from hhtjax.xla import Explanation, explain, plain

__all__ = [  # noqa: RUF022
    "__version__", "analysis", "identification", "rotation", "scenes", "trigonometry",
    # systems
    "FirstOrderSystem", "LinearSystem", "System", "PrecisionWarning", "ConsistentInitial", "consistent_initial",
    "Sampled", "band_limited", "band_limited_motion", "sampled", "spline_gain_error",
    # steppers
    "Info", "State", "Stepper", "banded", "conjugate_gradients",
    "bossak", "collocation", "conventional_hht", "generalized_alpha", "hht", "houbolt", "implicit_euler", "kim_hht",
    "kim_implicit_euler", "newmark", "operator_splitting", "park", "rk4", "rosenbrock", "rowda", "wilson",
    # runs
    "Failure", "SimulationError", "Solution", "simulate", "Interpolant", "InternalInterpolant", "interpolate",
    "sweep", "sweep_to_disk", "load_sweep", "Explanation", "explain", "plain",
    # identification
    "FitResult", "Gaussian", "bounded", "equation_error", "fit", "fit_progressively", "fixed", "measure", "multistart",
    "positive", "refine", "step_size_bias", "windows",
]  # fmt: skip
