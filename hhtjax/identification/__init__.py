"""Parameters from measurements, and how far to trust them. The everyday names are also in `hhtjax`.

You write a function of the unknown parameters that returns residuals, simulated minus measured. `fit` finds the
parameters that minimise their sum of squares. It uses Levenberg-Marquardt with exact derivatives through every step of
the simulation. Example: stiffness and damping of a pendulum from a measured angle, with standard errors:

>>> import jax, jax.numpy as jnp, hhtjax
>>> def force(q, v, t, params):
...     return -params["m"] * 9.81 * params["l"] * jnp.sin(q) - params["k"] * q - params["c"] * v
>>> pendulum = hhtjax.System(lambda q, params: jnp.array([params["m"] * params["l"] ** 2]), force)
>>> params = {"m": 1.0, "l": 0.5, "k": 2.0, "c": 0.05}
>>> def simulated(unknown):
...     stepper = hhtjax.hht(linearize="predictor")         # smooth in the parameters; "auto" survives larger steps
...     start = jnp.array([1.0]), jnp.array([0.0])
...     return hhtjax.simulate(pendulum, stepper, *start, params | unknown, dt=1e-2, num_steps=500).q
>>> measured = simulated({}) + 1e-3 * jax.random.normal(jax.random.key(0), (501, 1))
>>> result = hhtjax.fit(lambda unknown: simulated(unknown) - measured, {"k": 1.5, "c": 0.2})
>>> bool(result.converged), bool(abs(result.params["k"] - 2.0) < 5 * result.standard_errors["k"])
(True, True)

`print(result.summary())` shows the estimates with confidence intervals. It also names the parameters that the data do
not determine.

Standard errors
---------------

Textbook standard errors assume that every residual is independent noise. The residuals of a real fit are correlated,
because the model is never quite right. Textbook errors are then several times too small. `fit` therefore cuts the
record into segments that are long compared with the correlation time. The standard error comes from the scatter between
the segments. (In the literature: a cluster-robust, or "cluster sandwich", covariance.) `result.summary()` shows the
ratio of this error to the textbook error ("error / naive"). `profile` checks an interval by further fits: it fixes one
parameter at several values and fits the others again.

Derivatives of estimates
------------------------

Estimates are differentiable with respect to the inputs of a fit: samples, weights, priors, and all values that the
residuals read. Example: the derivative of the stiffness with respect to the mass, which was assumed to be known. (The
motion determines only k/m.)

>>> def stiffness(m):
...     known = lambda unknown: simulated(unknown | {"m": m}) - measured
...     return hhtjax.fit(known, result.params, covariance=False).params["k"]
>>> round(float(jax.jacfwd(stiffness)(1.0)), 2)                              # k/m; jax.grad works too
2.0

Options of a fit
----------------

==============  ==================================================================================================
option          meaning
==============  ==================================================================================================
`transforms=`   `positive`, `bounded(lower, upper)`, `fixed`: keep a parameter positive, inside bounds, or unchanged
`weights=`      one over the standard deviation of the noise; 0 marks missing samples
`loss=`         robust against outliers: `"huber"`, `"soft_l1"`, `"cauchy"`
`prior=`        `Gaussian(mean, deviation)`: prior knowledge of a parameter
`records=`      many records, or `windows` of one record. Each has its own initial values (`starts=`), which are fitted
                too. They are eliminated from each step, so that its linear system contains only the parameters
==============  ==================================================================================================

The algorithm
-------------

Each step of Levenberg-Marquardt solves a damped linear least-squares problem. When a step lowers the cost as predicted,
the damping falls; it falls faster with each further such step. When a step does not lower the cost, the next step is at
most half as long. Each simulation also returns its exact Jacobian. Two Jacobians give the curvature of the residuals
along the last step. The next step is corrected for this curvature (geodesic acceleration), so that it follows a curved
valley. The correction needs no further simulation.

A fit ends when the gradient vanishes. It also ends when the last step changes the cost, or the unknowns, by less than
`tolerance`. In that case two more conditions must hold: the gradient or the residual is small; and the damping is
small, or an undamped step would reduce the residual only a little.

With dry friction or stops the cost can have kinks. Each kink can be a local minimum, and the path of a fit decides
which one it finds. Fit again from points near the estimate, and keep the result with the lowest cost. `unconstrained`
gives the coordinates of a fit to optimisers of other packages.

Initial guesses
---------------

`equation_error` needs no guess: it inserts the measured motion into the equations of motion. `fit_progressively` starts
from a poor guess and fits longer and longer parts of a record. `multistart` runs many fits at once, each from its own
guess.

Sensors
-------

`measure` gives the readings of sensors along a run, with gain, offset, drift and delay. Each sensor can have its own
sampling times. `accelerometer` makes one such sensor. `windows` cuts a record into parts. `wrap_angle` removes
whole turns from an angle.

Robots
------

`base_parameters` finds the combinations of inertial parameters that motions can identify. `excitation` finds a motion
that identifies them well. `physical_inertia` keeps the mass and inertia of a body physically possible during a fit;
`inertia_coordinates` is its inverse, for the initial guess.

Choosing a model
----------------

`score_test` ranks terms that a model does not have yet. `compare` compares fitted models by AIC and BIC, by F tests of
nested models, and by their errors on segments that were left out of the fit. Both allow for correlated residuals.

The step size is part of the model
----------------------------------

A fitted stiffness depends on the step size, because a numerical method makes every vibration a little slower or more
damped. `step_size_bias` predicts this error of a parameter for motion near resonance. With `correct=True` it removes
the error from the stiffness. It removes it from the damping too if the masses were fitted, or if a single mode vibrates
freely. `refine` works for any motion: it fits with dt, dt/2, ... and extrapolates all parameters to dt = 0.

`experiments/identification/README.md` has results for four measured systems (`silverbox`, `double_pendulum_measured`,
`emps`, `tanks`) and a simulated benchmark with hysteresis (`bouc_wen`). It also tests the intervals on generated
records with known parameters: stiff joints, a vehicle, and a mechanism with six constraints.
"""

from hhtjax.identification.arguments import Gaussian
from hhtjax.identification.bias import ModeBias as ModeBias
from hhtjax.identification.bias import step_size_bias
from hhtjax.identification.comparison import Comparison as Comparison
from hhtjax.identification.comparison import NestedTest as NestedTest
from hhtjax.identification.comparison import compare
from hhtjax.identification.free_coordinates import Unconstrained, unconstrained
from hhtjax.identification.identifiability import IdentifiabilityWarning
from hhtjax.identification.identify import Multistart as Multistart
from hhtjax.identification.identify import fit, multistart
from hhtjax.identification.inference import Profile as Profile
from hhtjax.identification.inference import Score as Score
from hhtjax.identification.inference import prediction_errors as prediction_errors
from hhtjax.identification.inference import profile, score_test
from hhtjax.identification.initial_guesses import equation_error, fit_progressively
from hhtjax.identification.least_squares import History
from hhtjax.identification.refinement import Refined, StepSizeWarning, refine
from hhtjax.identification.result import FitResult
from hhtjax.identification.robots import (
    BaseParameters,
    Excitation,
    base_parameters,
    excitation,
    inertia_coordinates,
    physical_inertia,
)
from hhtjax.identification.sandwich import Uncertainty
from hhtjax.identification.sensors import Windows, accelerometer, measure, windows, wrap_angle
from hhtjax.identification.transforms import bounded, fixed, positive

__all__ = [
    "BaseParameters",
    "Excitation",
    "FitResult",
    "Gaussian",
    "History",
    "IdentifiabilityWarning",
    "Refined",
    "StepSizeWarning",
    "Uncertainty",
    "Unconstrained",
    "Windows",
    "accelerometer",
    "base_parameters",
    "bounded",
    "compare",
    "equation_error",
    "excitation",
    "fit",
    "fit_progressively",
    "fixed",
    "inertia_coordinates",
    "measure",
    "multistart",
    "physical_inertia",
    "positive",
    "profile",
    "refine",
    "score_test",
    "step_size_bias",
    "unconstrained",
    "windows",
    "wrap_angle",
]


def __dir__():
    return __all__
