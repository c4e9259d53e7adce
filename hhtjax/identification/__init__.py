"""Parameters from measurements, and how far to trust them; the everyday names are those of `hhtjax` too.

A fit makes a sum of squares least: `fit` takes a function of the unknown parameters that returns residuals, simulated
less measured, and finds the parameters by Levenberg-Marquardt, with exact derivatives through every step of the run.
Stiffness and damping of a pendulum from what was measured, with standard errors:

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

`print(result.summary())` shows estimates with intervals, and names what the data cannot tell apart.

Errors one can trust
--------------------

Textbook standard errors take every residual for independent noise. Residuals of a real fit are correlated, because the
model is never quite right, and such errors are then several times too small. Here the record is cut into segments that
are long against that correlation, and the error comes from how much the segments disagree about the parameters. (In the
literature: a cluster-robust, or "cluster sandwich", covariance.) `result.summary()` shows how many times larger it is
than the textbook's.

What an estimate depends on
---------------------------

Estimates have derivatives in what a fit is given: in samples, weights, priors, and in all that the residuals read. By
how much the stiffness changes with the mass, which was taken for known (the motion tells k/m):

>>> def stiffness(m):
...     known = lambda unknown: simulated(unknown | {"m": m}) - measured
...     return hhtjax.fit(known, result.params, covariance=False).params["k"]
>>> round(float(jax.jacfwd(stiffness)(1.0)), 2)                              # k/m; by jax.grad too
2.0

What a fit can be told
----------------------

==============  ==================================================================================================
option          what it says
==============  ==================================================================================================
`transforms=`   `positive`, `bounded(lower, upper)`, `fixed`: kept positive, inside bounds, or as it is
`weights=`      one over the deviation of the noise; 0 marks missing samples
`loss=`         robust against outliers: `"huber"`, `"soft_l1"`, `"cauchy"`
`prior=`        `Gaussian(mean, deviation)`: what was known before
`records=`      many records, or `windows` of one, each with initial values of its own (`starts=`), which are fitted and
                eliminated: each step of the fit is solved as if only the parameters were unknown
==============  ==================================================================================================

How the minimum is found
------------------------

Levenberg-Marquardt solves a linear least-squares problem for each step, and damps it. Where a step lowers the cost as
predicted, the damping falls, faster with each such step in a row; where it does not, the next step is at most half as
long. Each run brings its exact Jacobian, and two Jacobians tell how the residuals bend along the last step. A further
step is corrected for that (geodesic acceleration), so that it follows a curved valley; this costs no run.

A fit ends where the gradient vanishes. It also ends where the last step changed the cost, or the unknowns, by less than
`tolerance`; then the gradient or the residual must be small too, and so the damping or what an undamped step
still takes off the residual. With dry friction or stops the cost may have kinks. A kink can be a local minimum;
which of them a fit finds depends on its path. Fit again from points near the estimate, and keep the least cost.

A start that is poor
--------------------

`equation_error` finds one without a guess, by putting the measured motion into the equations of motion.
`fit_progressively` goes from a poor one over longer and longer parts of a record. `multistart` tries many at once.
`measure` shows a run as sensors do, at their times, with gain, offset, drift and delay; `accelerometer` is one of them.

Which model
-----------

`score_test` ranks terms that a model does not have yet. `compare` judges models that were fitted: by AIC and BIC, by F
tests of nested ones, and by their errors on segments that were left out; all of it knows that residuals are correlated.

The step size is part of the model
----------------------------------

A fitted stiffness belongs to its step size, because a method makes every vibration a little slower or more damped than
it is. `step_size_bias` predicts by how much a parameter is off, and takes it out (`correct=True`) of stiffness, and of
damping where masses were fitted too or a single mode vibrates freely, from motion near resonance; `refine` fits with
dt, dt/2, ... and extrapolates all parameters to zero, whatever the motion was.

What comes of it in two measured systems, `silverbox` and `double_pendulum_measured`, and what can be found in
principle, in stiff joints, a vehicle and a mechanism with six constraints, is on a page,
`experiments/identification/README.md`.
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
