"""What a step size does to fitted parameters, and how to take it back.

A simulation with steps h has its own frequencies: its amplification matrix A(h) has eigenvalues mu = exp(s h) with
s not quite the eigenvalue of the equations. Parameters fitted through it make mu right, so the equations with these
parameters have eigenvalues s' that are wrong by as much. For HHT with alpha = 0 and x = w h/2

    |s'|^2/|s|^2 = (tan x/x)^2 = 1 + (w h)^2/6 + ...        stiffness over mass
    Re s'/Re s   = 1/cos(x)^2  = 1 + (w h)^2/4 + ...        damping over mass
"""

import warnings
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from hhtjax.analysis import amplification_matrix
from hhtjax.boundary import require_function, require_number
from hhtjax.identification.identifiability import parameter_names
from hhtjax.identification.identify import fit
from hhtjax.identification.result import FitResult
from hhtjax.steppers.stepper import require_stepper
from hhtjax.system import LinearSystem


class StepSizeWarning(UserWarning):
    """The step size shifts an estimate by more than its standard error."""


class ModeBias(NamedTuple):
    """Per mode with an oscillation, slowest first, arrays (modes,).

    frequency: w = |s|, rad/s, and damping: -Re s/w, of the motion itself; both free of the bias. wh: w h.
    stiffness_bias: |s'|^2/|s|^2 - 1. damping_bias: Re s'/Re s - 1, 0 for an undamped mode. s' belongs to the
    parameters as fitted with steps h.
    """

    frequency: Any
    damping: Any
    wh: Any
    stiffness_bias: Any
    damping_bias: Any


def step_size_bias(system, stepper, params, dt, q, v=None, t=0.0) -> ModeBias:
    """By how much stiffness and damping are off that were fitted through steps of dt.

    The system is linearised about (q, v, t): M, C = -dQ/dv, K = -dQ/dq, with the fitted params. Each of its
    eigenvalues s' is compared with the s = log(mu)/dt of the nearest eigenvalue mu of the real step's amplification
    matrix: s is what the data have.

    Args:
        system, stepper, dt: what the parameters were fitted through.
        params: the fitted ones.
        q: an equilibrium, or another point about which the motion is small. v: 0 by default.

    Raises:
        TypeError, ValueError: dt is no positive number.
        NotImplementedError: a system with constraints.

    References:
        Cook, Malkus, Plesha, Witt (2002), Sec. 11.13, for the period error of Newmark's method.

    >>> import jax.numpy as jnp, hhtjax
    >>> spring = hhtjax.System(jnp.array([1.0]), lambda q, v, t, params: -params * q)
    >>> bias = hhtjax.step_size_bias(spring, hhtjax.hht(alpha=0.0), 400.0, 0.01, q=jnp.zeros(1))
    >>> f"{float(bias.wh[0]):.4f} {float(bias.stiffness_bias[0]):.5f}"             # w h, and about (w h)^2/6
    '0.1993 0.00666'
    """
    require_number("step_size_bias", "dt", dt, lambda x: x > 0, "be positive")
    require_stepper("step_size_bias", stepper)
    if system.constraint is not None:
        raise NotImplementedError("step_size_bias: `system` has a constraint; give a minimal form of it.")
    q, unravel = ravel_pytree(jax.tree.map(lambda x: jnp.asarray(x, jnp.result_type(float)), q))
    v = jnp.zeros_like(q) if v is None else ravel_pytree(v)[0]

    def force(q, v):
        return ravel_pytree(system.force(unravel(q), unravel(v), t, params))[0]

    M = jnp.asarray(system.mass(unravel(q), params) if callable(system.mass) else system.mass)
    M = jnp.diag(M) if M.ndim == 1 else M
    K, C = (-D for D in jax.jacfwd(force, argnums=(0, 1))(q, v))
    linear, rest, n = LinearSystem(M, C, K), jnp.zeros_like(q), len(q)
    A = np.asarray(amplification_matrix(stepper, linear, stepper.init(linear, rest, rest, None, dt), dt=dt))
    first_order = np.block([[np.zeros((n, n)), np.eye(n)], [-np.linalg.solve(M, K), -np.linalg.solve(M, C)]])
    fitted = np.linalg.eigvals(first_order)
    fitted = fitted[fitted.imag > 1e-9 * np.abs(fitted)]
    fitted = fitted[np.argsort(np.abs(fitted))]
    mu = np.linalg.eigvals(A)
    mu = mu[mu.imag > 0]
    nearest = np.array([mu[np.argmin(np.abs(mu - np.exp(s * dt)))] for s in fitted])
    s = np.log(nearest) / dt
    w = np.abs(s)
    damped = np.abs(fitted.real) > 1e-9 * np.abs(fitted)
    damping_bias = np.where(damped, fitted.real / np.where(damped, s.real, 1) - 1, 0)
    return ModeBias(w, -s.real / w, w * dt, np.abs(fitted) ** 2 / w**2 - 1, damping_bias)


class Refined(NamedTuple):
    """What `refine` returns: an estimate together with the scheme and the step that it belongs to.

    stepper, dt: of `coarse`. coarse, fine: `FitResult` with steps of dt and dt/2. params: Richardson's extrapolation
    to dt = 0. shift: coarse - params in standard errors of `coarse`, a pytree like params.
    """

    stepper: Any
    dt: float
    coarse: FitResult
    fine: FitResult
    params: Any
    shift: Any


def refine(residuals_at, params0, stepper, dt, **options: Any) -> Refined:
    """Fits with dt and with dt/2, and extrapolates the parameters to dt = 0.

        params = fine + (fine - coarse)/(2^p - 1),    p the order of the stepper

    Parameters belong to the step size they were fitted with: for simulations with dt take `coarse.params`, for what
    they mean physically `params`.

    Args:
        residuals_at: (stepper, dt) -> the function residuals(params) of `fit`.
        params0, options: as in `fit`. The second fit starts where the first one ended.

    Warns:
        StepSizeWarning: some parameter is shifted by more than one standard error: names it.

    Raises:
        TypeError, ValueError: dt is no positive number, and whatever `fit` raises.
    """
    require_function("refine", "residuals_at", residuals_at, "residuals_at(stepper, dt)")
    require_number("refine", "dt", dt, lambda x: x > 0, "be positive")
    coarse = fit(residuals_at(stepper, dt), params0, **options)
    fine = fit(residuals_at(stepper, dt / 2), coarse.params, **options)
    gain = 1 / (2**stepper.order - 1)
    params = jax.tree.map(lambda a, b: b + gain * (b - a), coarse.params, fine.params)
    shift = jax.tree.map(
        lambda a, b, e: (a - b) / jnp.where(e > 0, e, jnp.inf), coarse.params, params, coarse.standard_errors
    )
    _warn_if_shifted(coarse, shift, dt)
    return Refined(stepper, dt, coarse, fine, params, shift)


def _warn_if_shifted(coarse, shift, dt):
    sizes = np.concatenate([np.ravel(x) for x in jax.tree.leaves(shift)])
    named = [f"{n} ({s:+.1f})" for n, s in zip(parameter_names(coarse.params), sizes, strict=True) if abs(s) > 1]
    if named:
        warnings.warn(
            f"refine: steps of {dt:.6g} shift {', '.join(named)} by that many standard errors.",
            StepSizeWarning,
            stacklevel=3,
        )
