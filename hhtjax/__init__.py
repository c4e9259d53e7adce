"""hhtjax: differentiable, functional time integrators for multibody dynamics.

Define a `System`, choose a stepper such as `hht`, run it by `simulate`, and differentiate through all of it; `fit`
identifies parameters. `hhtjax.analysis` shows how steps change a motion, `hhtjax.scenes` has examples to start from,
`hhtjax.plot` draws charts.

    params ---> System(mass, force, constraint) ---> Stepper(begin, bind) ---> simulate, one scan ---> Solution
                                                                                      |
                                                             sweep, fit, analysis, interpolate, your own loop

Structure
---------

Each folder answers one question. Folders form floors: an upper floor imports from lower ones, never the reverse.
`tests/test_floors.py` holds the floors as data and checks this.

    plot              charts of results; with the extra `plot`
    scenes            examples: systems with parameters and initial values
    identification    fits, and the uncertainty of their results
    analysis          accuracy, damping and energy of steps
    export            out of Python: a step as C, or as an FMU
    runs              simulate, sweep, interpolate; `driver.py` has the common driver of all runs,
                      `event_step.py` divides a step at an event
    bodies            mechanisms of bodies and joints, or from model files, as a system
    steppers          one step, one file for each family. HHT: the formulas in `residual.py`, the step in
                      `generalized_alpha.py`, its one solve in `implicit_solve.py`
    elements          beams, cables, springs and joints of structures, as functions of one element
    systems           what moves: pytrees outside, one flat vector inside; constraints, rotations, inputs
    numerics          solves, scans, loops, extrapolation: mathematics without mechanics; rotation, trigonometry
    xla               how a run becomes one kernel on the CPU
    jaxpr             evaluators of traced functions: number by number, as a matrix, as a list of operations
    primitives        our own JAX operations, with their rules for derivatives and batches; JAX's version
    description       frozen descriptions, compared by identity; checks: every check of an argument, once

Rules everywhere:

* Functions without state: a system and a stepper are frozen descriptions, static under `jit`; state, info and solution
  are named tuples of arrays; what may change is in `params`, which is passed as an argument.
* `jit`, `vmap` and `grad` work on everything. float32 and float64 keep their type.
* A wrong argument raises an error at the public function. The error names the argument, its value and what was
  expected. Inside a run nothing raises: a failure is recorded as data, and `solution.check()` turns it into an error.
* Features that a scene does not use cost nothing: without a constraint there is no row for it, with a constant mass no
  derivative of it.

`hhtjax.steppers` explains how to add a stepper, `hhtjax.scenes` a scene, `hhtjax.jaxpr` a rule for an operation. To
test it, add an entry to the table of problems and steppers in `tests/zoo.py`. This table drives the tests of order,
derivatives, dtypes, batches and memory, so a new entry is tested like all others. Any further test checks one
behaviour, compares with results that were not computed by the same code, and has been seen to fail.
"""

import importlib
import warnings

from hhtjax import analysis, bodies, elements, identification, rotation, scenes, trigonometry
from hhtjax.description import VERSION as __version__
from hhtjax.description.presentation import CHARTS as _CHARTS
from hhtjax.export.export_c import ExportedC, export_c
from hhtjax.export.export_fmu import ExportedFMU, export_fmu
from hhtjax.identification.arguments import Gaussian
from hhtjax.identification.bias import step_size_bias
from hhtjax.identification.comparison import compare
from hhtjax.identification.identify import fit, multistart
from hhtjax.identification.initial_guesses import equation_error, fit_progressively
from hhtjax.identification.refinement import refine
from hhtjax.identification.result import FitResult
from hhtjax.identification.sensors import accelerometer, measure, windows
from hhtjax.identification.transforms import bounded, fixed, positive
from hhtjax.numerics.structured_solve import banded, conjugate_gradients, sparse_lu
from hhtjax.runs.adaptive import adaptive
from hhtjax.runs.controlled_run import choose_steps
from hhtjax.runs.error_control import Steps
from hhtjax.runs.interpolate import Interpolant, interpolate
from hhtjax.runs.load_sweep import load_sweep
from hhtjax.runs.parallel_map import parallel_map
from hhtjax.runs.simulate import simulate
from hhtjax.runs.solution import Events, FailedRunWarning, Failure, SimulationError, Solution
from hhtjax.runs.sweep import sweep
from hhtjax.runs.sweep_to_disk import map_to_disk, sweep_to_disk
from hhtjax.steppers.collocation import wilson
from hhtjax.steppers.extrapolated import extrapolated
from hhtjax.steppers.generalized_alpha import bossak, generalized_alpha, hht, implicit_euler, newmark
from hhtjax.steppers.kim2019 import conventional_hht, kim_hht, kim_implicit_euler
from hhtjax.steppers.multistep import houbolt, park
from hhtjax.steppers.rosenbrock import rodas5p, rosenbrock, rowda
from hhtjax.steppers.runge_kutta import dop853, dopri5, rk4, tsit5
from hhtjax.steppers.splitting import operator_splitting
from hhtjax.steppers.stepper import Info, State, Stepper
from hhtjax.steppers.taylor import taylor
from hhtjax.systems import interop
from hhtjax.systems.contact import Contact
from hhtjax.systems.elements import Elements, Joints
from hhtjax.systems.events import Event, impact
from hhtjax.systems.initial_conditions import ConsistentInitial, PrecisionWarning, consistent_initial
from hhtjax.systems.matrices import sparse
from hhtjax.systems.sampled import Sampled, band_limited, band_limited_motion, sampled, spline_gain_error
from hhtjax.systems.system import FirstOrderSystem, LinearSystem, System
from hhtjax.systems.zero_order_hold import JumpWarning
from hhtjax.xla import Explanation, explain, keep_programs, plain

__all__ = [  # noqa: RUF022
    "__version__", "analysis", "bodies", "elements", "identification", "interop", "rotation", "scenes", "trigonometry",
    # systems
    "FirstOrderSystem", "LinearSystem", "System", "Elements", "Joints", "ConsistentInitial", "consistent_initial",
    "JumpWarning", "PrecisionWarning", "Contact", "Event", "impact", "Sampled", "band_limited", "band_limited_motion",
    "sampled", "sparse", "spline_gain_error",
    # steppers
    "Info", "State", "Stepper", "banded", "conjugate_gradients", "sparse_lu",
    "bossak", "conventional_hht", "dop853", "dopri5", "extrapolated", "generalized_alpha", "hht", "houbolt",
    "implicit_euler", "kim_hht", "kim_implicit_euler", "newmark", "operator_splitting", "park", "rk4", "rodas5p",
    "rosenbrock", "rowda", "taylor", "tsit5", "wilson",
    # runs
    "Failure", "FailedRunWarning", "SimulationError", "Solution", "simulate", "Interpolant", "interpolate",
    "Events", "Steps", "adaptive", "choose_steps", "sweep", "sweep_to_disk", "load_sweep",
    "parallel_map", "map_to_disk",
    "Explanation", "explain", "keep_programs", "plain",
    # out of Python
    "ExportedC", "ExportedFMU", "export_c", "export_fmu",
    # identification
    "FitResult", "Gaussian", "accelerometer", "bounded", "compare", "equation_error", "fit", "fit_progressively",
    "fixed", "measure", "multistart", "positive", "refine", "step_size_bias", "windows",
]  # fmt: skip


def _overview(result, sampling_rate):
    """The chart of a fit, for `FitResult.plot`: matplotlib is imported when it is asked for."""
    return importlib.import_module("hhtjax.plot").fit_overview(result, sampling_rate)[0].figure


_CHARTS["FitResult"] = _overview


def __dir__():
    return __all__


def __getattr__(name):
    """`hhtjax.plot`, imported when it is first asked for, as it needs matplotlib; and what moved, with a warning."""
    if name == "plot":
        return importlib.import_module("hhtjax.plot")
    if name == "collocation":
        warnings.warn(
            "hhtjax.collocation is hhtjax.steppers.collocation.collocation from the next version on; `wilson` stays.",
            DeprecationWarning, stacklevel=2,
        )  # fmt: skip
        return importlib.import_module("hhtjax.steppers.collocation").collocation
    raise AttributeError(f"module 'hhtjax' has no attribute {name!r}")
