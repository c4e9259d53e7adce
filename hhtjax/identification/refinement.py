"""Fits with smaller and smaller steps, and their extrapolation, which removes the error of the step size."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.analysis import damping_ratio
from hhtjax.checks import require_function, require_integer, require_number
from hhtjax.description import PyTree, Real, freeze, thaw
from hhtjax.description.presentation import Table, as_text, shown
from hhtjax.identification import report
from hhtjax.identification.identifiability import parameter_names, parameter_values
from hhtjax.identification.identify import fit
from hhtjax.identification.result import NAMED, FitResult
from hhtjax.runs.extrapolate import richardson
from hhtjax.runs.progress import rewrite
from hhtjax.steppers.options import Options
from hhtjax.steppers.residual import Coefficients
from hhtjax.steppers.rosenbrock import RosenbrockTableau
from hhtjax.steppers.runge_kutta import ExplicitTableau
from hhtjax.steppers.stepper import Stepper, require_stepper

UNDAMPED = 1e-6  # damping ratio, rounding of float32 included


class StepSizeWarning(UserWarning):
    """The step size shifts an estimate by more than its standard error, or by an amount that cannot be corrected."""


@shown
class Refined(NamedTuple):
    """Result of `refine`: an extrapolated estimate, and the fits, stepper and step size that it was computed from.

    Attributes:
        stepper, dt: stepper and step size of the first fit.
        fits: a `FitResult` for each of dt, dt/2, ...
        params: the parameters extrapolated to dt = 0, by Richardson's method.
        shift: (fits[0].params - params) in standard errors of the first fit, a pytree like params.

    `print(result)` or `result.summary()` shows them as a table.
    """

    stepper: Stepper
    dt: float
    fits: tuple[FitResult, ...]
    params: PyTree
    shift: PyTree

    @property
    def standard_errors(self) -> PyTree:
        """Standard errors of `params`: those of the last fit, which has the smallest step. A pytree like params."""
        return self.fits[-1].standard_errors

    def summary(self) -> str:
        """Text: a table of the extrapolated estimates, their standard errors, and the shift by the first step size."""
        return as_text(self._table())

    def _table(self) -> Table:
        steps = ", ".join(f"{self.dt / 2**level:.6g}" for level in range(len(self.fits)))
        rows = report.table(self.fits[-1]._replace(params=self.params)).rows
        shifts = (f"{x:+.2g}" for x in parameter_values(self.shift))
        column = [f"shift with steps of {self.dt:.6g} s, in standard errors", *shifts]
        title = f"Refined: extrapolated to dt = 0 from fits with steps of {steps} s"
        return Table(title, [[*row, x] for row, x in zip(rows, column, strict=True)])

    def interval(self, level: float = 0.95) -> tuple[Any, Any]:
        """Confidence interval about `params`, with the standard errors of the last fit: two pytrees like params."""
        return self.fits[-1]._replace(params=self.params).interval(level)

    def to_json(self) -> str:
        """The whole result, with stepper and step size, as JSON text, to be read by `Refined.from_json`.

        Raises:
            TypeError: a stepper with a user-defined `solve`, or with a traced coefficient.
        """
        return json.dumps(report.encode(self))

    @staticmethod
    def from_json(text: str) -> Refined:
        """Reads a result from the text of `to_json`."""
        classes = Refined, Coefficients, Options, ExplicitTableau, RosenbrockTableau, *_subclasses(Stepper)
        return report.read(text, Refined, NAMED | {c.__name__: c for c in classes})


def _subclasses(base: type):
    for c in base.__subclasses__():
        yield c
        yield from _subclasses(c)


def refine(
    residuals_at: Callable[[Stepper, float], Callable[..., Any]],
    params0: PyTree,
    stepper: Stepper,
    dt: Real,
    levels: int | None = None,
    *,
    progress: bool = False,
    **options: Any,
) -> Refined:
    """Fits with step sizes dt, dt/2 and so on, and extrapolates the parameters to dt = 0.

    For a stepper of order p the extrapolation removes the errors of order h^p, h^(p + 1), ... one by one:

        levels = 2    R = fine + (fine - coarse)/(2^p - 1)
        levels = 3    the same formula with p + 1, applied to the R of (dt, dt/2) and the R of (dt/2, dt/4)

    A stepper that conserves the energy of an oscillation, like alpha = 0, has no error of order h^(p + 1). Two levels
    are then enough. The error of numerical damping has this order. Three levels remove it too; the third fit takes four
    times as long as the first.

    Fitted parameters belong to the step size of their fit. To simulate with dt, use `fits[0].params`. For the physical
    values, use `params`.

    Args:
        residuals_at: (stepper, dt) -> the function residuals(params) of `fit`.
        params0, options: as in `fit`. Each fit starts at the estimate of the previous one.
        stepper: passed to residuals_at. Its order and damping determine the extrapolation.
        dt: step size of the first fit, s.
        levels: number of fits, at least 2. None: 3 with numerical damping, otherwise 2.
        progress: shows on stderr which fit is running, and below it the progress line of that fit.

    Returns:
        A `Refined`, with `params`, `standard_errors`, `interval()` and `summary()`.

    Warns:
        StepSizeWarning: the step size shifts a parameter by more than one standard error. The warning names it.

    Raises:
        TypeError, ValueError: dt is not a positive number; covariance=False; and whatever `fit` raises.

    >>> import warnings, jax.numpy as jnp, hhtjax
    >>> spring = hhtjax.System(jnp.ones(1), lambda q, v, t, params: -params["k"] * q)
    >>> times = jnp.arange(1.0, 11.0)
    >>> def residuals_at(stepper, dt):
    ...     def residuals(params):
    ...         start = jnp.ones(1), jnp.zeros(1)
    ...         run = hhtjax.simulate(spring, stepper, *start, params, dt=dt, num_steps=round(10 / dt))
    ...         return run.q[round(1 / dt) :: round(1 / dt), 0] - jnp.cos(3 * times)                  # so k is 9
    ...     return residuals
    >>> trapezoidal = hhtjax.hht(alpha=0.0, linearize="predictor")
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("ignore", hhtjax.identification.StepSizeWarning)      # data without noise
    ...     found = hhtjax.refine(residuals_at, {"k": 8.9}, trapezoidal, 0.05)
    >>> f"{found.fits[0].params['k']:.2f} {found.params['k']:.4f}"
    '9.03 9.0000'
    """
    require_function("refine", "residuals_at", residuals_at, "residuals_at(stepper, dt)")
    require_stepper("refine", stepper)
    require_number("refine", "dt", dt, lambda x: x > 0, "be positive")
    if not options.get("covariance", True):
        raise ValueError(
            "refine: `covariance` must be True, because shifts are given in standard errors; received False."
        )
    levels = needed_levels(stepper) if levels is None else require_integer("refine", "levels", levels, 2)
    fits = []
    for level in range(levels):
        if progress:
            rewrite(f"refine: fit {level + 1} of {levels}, with steps of {dt / 2**level:.6g} s", last=True)
        start = fits[-1].params if fits else params0
        fits.append(fit(residuals_at(stepper, dt / 2**level), start, progress=progress, **options))
    params = richardson([freeze(result.params) for result in fits], stepper.order)
    shift = jax.tree.map(
        lambda p, q, e: (p - q) / jnp.where(e > 0, e, jnp.inf),
        *map(freeze, (fits[0].params, params, fits[0].standard_errors)),
    )
    _warn_if_shifted(params, shift, dt)
    return Refined(stepper, dt, tuple(fits), thaw(params), thaw(shift))


def needed_levels(stepper: Stepper) -> int:
    """3 if the stepper damps an undamped oscillation with w h = 1, otherwise 2."""
    return 2 if float(damping_ratio(stepper, 1.0)) <= UNDAMPED else 3  # it is NaN where none is left


def _warn_if_shifted(params: PyTree, shift, dt):
    sizes = np.concatenate([np.ravel(x) for x in jax.tree.leaves(shift)])
    named = [f"{n} ({s:+.1f})" for n, s in zip(parameter_names(params), sizes, strict=True) if abs(s) > 1]
    if named:
        warnings.warn(
            f"refine: steps of {dt:.6g} shift {', '.join(named)}; in brackets the shift in standard errors.",
            StepSizeWarning,
            stacklevel=3,
        )
