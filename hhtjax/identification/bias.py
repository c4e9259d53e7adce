"""The error of fitted parameters that is due to the step size, predicted from the step itself.

A simulation with steps h has frequencies of its own. Its amplification matrix A(h) has eigenvalues mu = exp(s h), where
s differs a little from the eigenvalue of the equations of motion. A fit adjusts the parameters until mu agrees with the
data. The equations with these parameters then have eigenvalues s' that differ from s. For HHT with alpha = 0 and
x = w h/2

    |s'|^2/|s|^2 = (tan x/x)^2 = 1 + (w h)^2/6 + ...        stiffness over mass
    Re s'/Re s   = 1/cos(x)^2  = 1 + (w h)^2/4 + ...        damping over mass

The response to a force is wrong too, by 1 + (w h)^2/3 + ... If the force is known, this is an error of the mass.

All this holds for motion at the frequencies of the modes: free vibration, or a force near resonance. A force at another
frequency W causes motion at W. A stiffness fitted with a known mass is then off by m W^2 (W h)^2/6, which the
eigenvalues do not show.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from hhtjax.analysis.amplification import amplification_matrix, at_rest, eigenvalues
from hhtjax.checks import describe, require_number, require_params
from hhtjax.description import Array, PyTree, Real, thaw
from hhtjax.description.presentation import all_known, between, shown
from hhtjax.identification.arguments import check_real, require_prefix
from hhtjax.identification.refinement import StepSizeWarning
from hhtjax.steppers.stepper import Stepper, require_stepper
from hhtjax.systems.initial_conditions import require_consistent
from hhtjax.systems.linear_system import require_dense
from hhtjax.systems.system import LinearSystem, System, mass_at, require_masses, require_smooth

OSCILLATES = 1e-9  # |Im s|/|s| above which a mode counts as an oscillation
LOST = 1e3  # distance of an eigenvalue of the steps from that of a mode which does not oscillate in them
DRIVEN = 64  # steps from t, in which a force that depends on the time has changed


@shown
class ModeBias(NamedTuple):
    """Result of `step_size_bias`: arrays (modes,), one entry for each mode that oscillates, slowest first.

    Attributes:
        frequency: w = |s|, rad/s, of the real motion, without the bias.
        damping: -Re s/w, the damping ratio of the real motion, without the bias.
        wh: w h.
        stiffness_bias: |s'|^2/|s|^2 - 1, with the eigenvalue s' of the equations with the fitted parameters.
        damping_bias: Re s'/Re s - 1, 0 for an undamped mode.
        params: the fitted parameters, corrected for the bias; None with correct=False.
    """

    frequency: np.ndarray
    damping: np.ndarray
    wh: np.ndarray
    stiffness_bias: np.ndarray
    damping_bias: np.ndarray
    params: PyTree = None

    def _verdict(self):
        """The frequencies, and the largest biases, in words."""
        numbers = all_known(self[:5])
        if len(numbers) < 5 or not numbers[0].size:
            return ""
        w, _, wh, stiffness, damping = numbers
        stiffness, damping = (between(100 * bias, "%", digits=3) for bias in (stiffness, damping))
        hertz = between(w / (2 * np.pi), "Hz", digits=3)
        modes = f"{w.size} mode{'s' * (w.size > 1)}"
        frequencies = f"{modes}, {between(w, 'rad/s')} ({hertz}), w h = {between(wh, digits=3)}"
        return f"{frequencies}: stiffness off by {stiffness}, damping by {damping}"


def step_size_bias(
    system: System | LinearSystem,
    stepper: Stepper,
    params: PyTree,
    dt: Real,
    q: PyTree,
    v: PyTree = None,
    t0: Real = 0.0,
    correct: Any = False,
) -> ModeBias:
    """The error of stiffness and damping that were fitted with steps of dt.

    The system is linearised about (q, v, t0) with the fitted params: M, C = -dQ/dv, K = -dQ/dq. Each of its eigenvalues
    s' is compared with s = log(mu)/dt, where mu is the corresponding eigenvalue of the amplification matrix of the
    stepper. s is the eigenvalue of the measured motion. Constraints are linearised too: M, C and K are then those of
    the motions that the constraints allow, and K includes the stiffness of the constraint forces.

    The prediction does not hold for parameters fitted to motion far from the frequencies of all modes, as under a force
    off resonance. Their bias depends on that motion; use `refine`.

    Args:
        system, stepper, dt: with which the parameters were fitted.
        params: the fitted parameters.
        q: an equilibrium, or another point about which the motion is small. It must satisfy the constraints.
        v: velocity there, structured like q, 0 by default. t0: time there.
        correct: True returns corrected `params`. They differ from the fitted ones by the smallest relative changes with
            which the equations have the eigenvalues s, and respond to forces as the steps did ("pre-warping"). This
            removes the bias of all parameters in two cases: the masses were fitted too (with several modes: every entry
            of M), or the motion was the free vibration of one mode. Otherwise the fit was a compromise between response
            and eigenvalues, which depends on the motion. Then only the frequencies are corrected, damping stays as
            fitted, and a warning says so. Parameters without influence on the linearised system are unchanged. Instead
            of True, pass Booleans for the leaves of params, or for whole branches: False for parameters that were not
            fitted, such as a known mass.

    Returns:
        A `ModeBias`; NaN for a mode that does not oscillate in the steps.

    Warns:
        StepSizeWarning: no params make the equations respond to forces as the steps did. Use `refine`, which takes two
            or three fits.

    Raises:
        TypeError, ValueError: an argument of a wrong kind; dt is not a positive number; q has another number of
            coordinates than the mass, or violates a constraint; dependent constraints; `correct` with a dt in which
            some mode does not oscillate, or for a system in which no mode oscillates.
        NotImplementedError: a system with internal states or rotations.

    References:
        Cook, Malkus, Plesha, Witt (2002), Sec. 11.13, for the period error of Newmark's method.

    >>> import jax.numpy as jnp, hhtjax
    >>> spring = hhtjax.System(jnp.array([1.0]), lambda q, v, t, params: -params * q)
    >>> bias = hhtjax.step_size_bias(spring, hhtjax.hht(alpha=0.0), 400.0, 0.01, q=jnp.zeros(1), correct=True)
    >>> f"{float(bias.wh[0]):.4f} {float(bias.stiffness_bias[0]):.5f}"             # w h, and about (w h)^2/6
    '0.1993 0.00666'
    >>> f"{float(bias.params):.3f} {float(bias.frequency[0]) ** 2:.3f}"
    '397.354 397.354'
    """
    require_number("step_size_bias", "dt", dt, lambda x: x > 0, "be positive")
    require_stepper("step_size_bias", stepper)
    if not isinstance(system, (System, LinearSystem)):
        raise TypeError(f"step_size_bias: `system` must be a System or LinearSystem; received {system!r}.")
    require_masses("step_size_bias", system, "give them some")
    frozen = require_params("step_size_bias", params)
    _require_flags(correct, params)
    _require_point(q, v)
    if system.internal is not None:
        raise NotImplementedError(
            "step_size_bias: `system` has internal states, which M, C and K cannot represent; use `refine` instead."
        )
    require_smooth("step_size_bias", system)
    require_dense("step_size_bias", system, params)
    matrices = _linear_part(system, params, q, v, t0)
    _require_on_constraint(system, frozen, q, t0)
    fitted = _rates_of_equations(*matrices)
    s = _rates_of_steps(stepper, dt, *matrices)
    w = np.abs(s)
    damped = np.abs(np.real(fitted)) > OSCILLATES * np.abs(fitted)
    damping_bias = np.where(damped, np.real(fitted) / np.where(damped, np.real(s), 1) - 1, 0)
    bias = ModeBias(w, -np.real(s) / w, w * dt, np.abs(fitted) ** 2 / w**2 - 1, damping_bias)
    if correct is False:
        return bias
    if not w.size:
        raise ValueError("step_size_bias: `params` must let a mode oscillate, to use `correct`; no mode does.")
    if np.any(np.isnan(w)):
        raise ValueError(
            f"step_size_bias: `dt` must let every mode oscillate, to use `correct`; received {dt}, with which "
            f"{np.sum(np.isnan(w))} of {len(w)} do not."
        )

    def linear_part(frozen: dict):
        return _linear_part(system, thaw(frozen), q, v, t0)

    target = motion(partial(_rates_of_steps, stepper, dt), *matrices, matrices[2])
    free = len(s) == 1 and not _is_driven(system, params, q, v, t0, dt)
    corrected = prewarped(frozen, correct, linear_part, _rates_of_equations, target, matrices[2], free)
    return bias._replace(params=thaw(corrected))


def _require_flags(correct: PyTree, params: PyTree):
    require_prefix("step_size_bias", "correct", correct, params, "params")
    for flag in jax.tree.leaves(correct):
        if not isinstance(flag, (bool, np.bool_)):
            raise TypeError(f"step_size_bias: `correct` must be True, False or a pytree of them; received {flag!r}.")


def _require_point(q: Array, v):
    for name, values in (("q", q), ("v", v)):
        for path, leaf in jax.tree_util.tree_leaves_with_path(values):
            check_real(f"step_size_bias: `{name}{jax.tree_util.keystr(path)}`", leaf)
    if not sum(map(np.size, jax.tree.leaves(q))):
        raise ValueError(f"step_size_bias: `q` must hold at least one number; received {q!r}.")


def _is_driven(system, params: PyTree, q: Array, v, t: Real, dt: Real) -> bool:
    """Whether the force at a state, or the mass, depends on the time."""
    v = jax.tree.map(jnp.zeros_like, q) if v is None else v

    def at(t: Array) -> Array:
        return ravel_pytree((system.force(q, v, t, params), mass_at(system, q, t, params)))[0]

    found = jax.vmap(at)(t + dt * jnp.arange(float(DRIVEN)))
    return bool(jnp.any(found != found[:1]))


def _linear_part(system, params: PyTree, q, v, t: Real):
    """M, C, K about a state, (n, n) each; with m constraints, those of the n - m motions that they allow."""
    given, (q, unravel) = q, ravel_pytree(jax.tree.map(lambda x: jnp.asarray(x, jnp.result_type(float)), q))
    M = jnp.asarray(mass_at(system, unravel(q), t, params))
    M = jnp.diag(M) if M.ndim == 1 else M
    _require_coordinates(len(M), given, v)
    v = jnp.zeros_like(q) if v is None else ravel_pytree(v)[0]

    def force(q: Array, v: Array) -> Array:
        return ravel_pytree(system.force(unravel(q), unravel(v), t, params))[0]

    K, C = (-D for D in jax.jacfwd(force, argnums=(0, 1))(q, v))
    if system.constraint is None:
        return M, C, K

    def constraint(q):
        return system.constraint(unravel(q), t, params)

    B = jax.jacfwd(constraint)(q)
    L = jnp.linalg.lstsq(B.T, -force(q, v))[0]  # at rest
    K = K - jax.jacfwd(lambda q: jax.vjp(constraint, q)[1](L)[0])(q)
    N = jnp.linalg.svd(B)[2][len(B) :].T  # B N = 0
    return N.T @ M @ N, N.T @ C @ N, N.T @ K @ N


def _require_coordinates(n: int, q, v):
    """An error for rotations, and for a q or v of another size than the mass."""
    shapes = [jnp.shape(x) for x in jax.tree.leaves(q)]
    size = sum(map(math.prod, shapes))
    if size != n and any(shape[-2:] == (3, 3) for shape in shapes):
        raise NotImplementedError("step_size_bias: `q` has rotations, which are not supported.")
    if size != n:
        raise ValueError(f"step_size_bias: `q` must have as many numbers as the mass, {n}; received {describe(q)}.")
    if v is not None and [jnp.shape(x) for x in jax.tree.leaves(v)] != shapes:
        raise ValueError(f"step_size_bias: `v` must have the shapes of q, {describe(q)}; received {describe(v)}.")


def _require_on_constraint(system, params: PyTree, q: Array, t: Real):
    if system.constraint is not None:
        q = jax.tree.map(lambda x: jnp.asarray(x, jnp.result_type(float)), q)
        rest = jax.tree.map(jnp.zeros_like, q)
        require_consistent("step_size_bias", system, q, rest, t, params, checked=(("q", "Phi"),))


def _rates_of_equations(M: Real, C: Real, K: Real) -> np.ndarray:
    """Eigenvalues s with an oscillation, one of each pair, slowest first."""
    n = len(M)
    first_order = np.block([[np.zeros((n, n)), np.eye(n)], [-np.linalg.solve(M, K), -np.linalg.solve(M, C)]])
    s = np.linalg.eigvals(first_order)
    s = s[s.imag > OSCILLATES * np.abs(s)]
    return s[np.argsort(np.abs(s))]


def _rates_of_steps(stepper: Stepper, dt: Real, M: Array, C: Array, K: Array) -> np.ndarray:
    """log(mu)/dt of the steps, in the order of the equations' eigenvalues."""
    from scipy.optimize import linear_sum_assignment  # which takes as long to import as hhtjax

    linear = LinearSystem(M, C, K)
    state = at_rest(linear, stepper, jnp.zeros(len(M)), None, dt)
    mu = np.linalg.eigvals(np.asarray(amplification_matrix(linear, stepper, state, dt=dt)))
    mu = mu[mu.imag > 0]
    s = _rates_of_equations(M, C, K)
    away = np.abs(mu[None, :] - _as_if_alone(stepper, s * dt)[:, None])
    found = np.full(len(s), np.nan, complex)
    modes, at = linear_sum_assignment(np.where(np.isnan(away), LOST, away))
    found[modes] = np.where(np.isnan(away[modes, at]), np.nan, np.log(mu[at]) / dt)
    return found


def _as_if_alone(stepper: Stepper, s) -> np.ndarray:
    """The eigenvalue of one step of size 1 for an oscillator with eigenvalue s; NaN if the steps do not oscillate.

    Eigenvalues of the steps are assigned to modes by these values. Assigning them by exp(s) could confuse two modes.
    """
    mu: Any = np.asarray(eigenvalues(stepper, -2 * s.real, np.abs(s) ** 2))
    away = np.where(mu.imag > 0, np.abs(mu - np.exp(s)[:, None]), np.inf)
    nearest = np.argmin(away, axis=1)[:, None]
    return np.where(np.isinf(away.min(axis=1)), np.nan, np.take_along_axis(mu, nearest, axis=1)[:, 0])


# ----------------------------------------------------------------------------
# The correction of `step_size_bias`: parameters with which the equations move as the steps did.
#
# The eigenvalues s of the amplification matrix give the free motion of a mode in the steps. The derivative of s with
# respect to the stiffness gives its response to forces, because a force -eps K q changes s in proportion to that
# response. So no force needs to be applied. Changing the stiffness of one part of the coordinates after the other also
# shows the shapes of the modes.


GAIN_WEIGHT = 1e-3  # frequency and damping first; the response to forces with the freedom that they leave
PROBE = 1e-4  # relative change of the stiffness that shows the response to forces
PARTS = 4  # of the coordinates, at most
FOLLOWED = 0.25  # share of the error of the response that may be left
LEAST = 0.02  # influence of a parameter on a frequency, below which it is no stiffness


class Motion(NamedTuple):
    """For each mode: rates (modes,), and their derivatives (parts, modes) by stiffness, one part at a time."""

    rates: Array
    response: Any


def motion(rates: Callable, M: Real, C: Real, K: Real, stiffness: Array) -> Motion:
    """rates: function of (M, C, K). stiffness: the K that is probed."""
    n = len(stiffness)
    changes = []
    for part in np.array_split(np.arange(n), min(n, PARTS)):
        D = PROBE * np.isin(np.arange(n), part)[:, None] * np.asarray(stiffness)
        D = (D + D.T) / 2
        changes.append((rates(M, C, K + D) - rates(M, C, K - D)) / (2 * PROBE))
    return Motion(rates(M, C, K), np.stack(changes))


def prewarped(
    params: PyTree, flags: PyTree, linear_part: Callable, rates: Callable, target: Motion, stiffness: Array, free: bool
):
    """params with the least relative changes that reproduce `target`, the `Motion` of the steps.

    flags: Booleans for leaves or branches of params. linear_part: params -> (M, C, K). rates: of those, in the order
    of the target. free: whether the only motion is the free vibration of one mode, whose response does not matter.
    """
    params = jax.tree.map(lambda p: jnp.asarray(p, jnp.result_type(float)), params)
    fitted, unravel = ravel_pytree(params)
    repeated = jax.tree.map(lambda flag, branch: jax.tree.map(lambda p: jnp.full(p.shape, flag), branch), flags, params)
    at = np.flatnonzero(ravel_pytree(repeated)[0])
    if not at.size:
        return params

    @jax.jit
    def moved(x: Array):
        params = unravel(fitted.at[at].multiply(1 + x))
        return params, linear_part(params)

    def matrices(x: np.ndarray):
        M, C, K = moved(x)[1]
        return np.asarray(M), np.asarray(C), np.asarray(K)

    def unlike(x: np.ndarray):
        M, C, K = matrices(x)
        now = motion(rates, M, C, K, stiffness)
        return now.rates / target.rates - 1, (now.response - target.response) / np.linalg.norm(target.response, axis=0)

    def apart(x: np.ndarray):
        off = np.concatenate([np.ravel(y) for y in unlike(x)])
        off[len(target.rates) :] *= GAIN_WEIGHT
        return np.concatenate([np.real(off), np.imag(off)])

    start = np.zeros(len(at))
    x = _least_change(apart, start)
    before, left = (np.linalg.norm(unlike(x)[1]) for x in (start, x))
    if not free and left > FOLLOWED * before:
        warnings.warn(_compromise(left), StepSizeWarning, stacklevel=3)
        x = _least_change(lambda x: np.abs(rates(*matrices(x))) / np.abs(target.rates) - 1, start, LEAST)
    return moved(x)[0]


def _compromise(left):
    return (
        f"step_size_bias: no values of params have the steps' response to forces ({100 * left:.2g} % of it is left). "
        "The fitted damping is a compromise that depends on the motion, so it is not corrected. Use `refine` to "
        "correct it, and to correct a stiffness that was fitted to motion far from the resonances."
    )


def _least_change(apart: Callable, x: np.ndarray, least: float = 0.0) -> np.ndarray:
    """Gauss-Newton steps of least norm towards apart(x) = 0, along directions that change it by more than `least`."""
    for _ in range(4):
        J = np.stack([(apart(x + e) - apart(x - e)) / 2e-5 for e in 1e-5 * np.eye(len(x))], axis=1)
        U, s, Vt = np.linalg.svd(J, full_matrices=False)
        seen = s > max(1e-5 * s[0], least)
        x = x - Vt[seen].T @ (U[:, seen].T @ apart(x) / s[seen])
    return x
