"""The step size that a system needs, from its modes and from their error in a stepper, or from runs."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from hhtjax.analysis.amplification import damping_ratio, eigenvalues, period_elongation
from hhtjax.checks import require_number
from hhtjax.description import Array, PyTree, Real, freeze
from hhtjax.description.presentation import frequency_cells
from hhtjax.runs.progress import stages
from hhtjax.steppers.stepper import Stepper, begun, require_capable, require_stepper
from hhtjax.systems.constraints import acceleration_and_multipliers, jacobian
from hhtjax.systems.flat_system import flatten
from hhtjax.systems.initial_conditions import initial_values
from hhtjax.systems.linear_system import require_dense
from hhtjax.systems.system import AnySystem, LinearSystem, System, require_masses

# of suggest_step_size
GRID = np.geomspace(1e-5, 1e6, 600)  # |lambda| h
NYQUIST = 3.0  # |lambda| h beyond which no motion is followed
STABLE_RADIUS = 1 + 1e-5  # what rounding makes of a double eigenvalue 1 stays below
RIGID = 1e-7  # |lambda| relative to the largest that counts as zero


class Mode(NamedTuple):
    """A mode of the linearised system, and its numerical solution with the suggested step.

    Attributes:
        frequency: |lambda|, natural frequency in rad/s, or rate of a motion that does not oscillate, in 1/s.
        damping_ratio: damping ratio of the mode; -1 for pure growth, 1 for pure decay.
        largest_dt: largest step with which the stepper keeps the error of the mode within the tolerance, s.
        numerical_damping_ratio: damping ratio of the mode in the steps.
        period_elongation: relative error of its period in the steps. Both are NaN if the mode, or its numerical
            solution, does not oscillate.
        resolved: whether the suggested step is at most largest_dt.
    """

    frequency: float
    damping_ratio: float
    largest_dt: float
    numerical_damping_ratio: float
    period_elongation: float
    resolved: bool


class StepSize(NamedTuple):
    """Result of `suggest_step_size`; prints as a table of the modes.

    Its columns: the natural frequency of a mode in rad/s and Hz; its period, 2 pi/frequency, and the change of
    the period in steps of dt; its damping ratio, and that in steps of dt; the largest step that resolves it; frequency
    times dt; whether dt resolves it.

    Attributes:
        dt: suggested step size, s.
        reason: what limits it, in words.
        modes: a `Mode` for each mode, slowest first.
    """

    dt: float
    reason: str
    modes: tuple[Mode, ...]

    def __str__(self) -> str:
        rows = [["rad/s", "Hz", "period", "in steps", "damping", "in steps", "largest dt", "w h", "resolved"]]
        for mode in self.modes:
            w = frequency_cells(mode.frequency)
            swings = mode.period_elongation == mode.period_elongation  # no NaN
            rows.append(
                [
                    *(w if abs(mode.damping_ratio) < 1 else [w[0], "-", "-"]),
                    f"{100 * mode.period_elongation:+.3g} %" if swings else "-",
                    f"{mode.damping_ratio:.3g}",
                    f"{mode.numerical_damping_ratio:.3g}" if swings else "-",
                    f"{mode.largest_dt:.3g} s",
                    f"{mode.frequency * self.dt:.3g}",
                    "yes" if mode.resolved else "no",
                ]
            )
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = ["  ".join(x.rjust(w) for x, w in zip(row, widths, strict=True)).rstrip() for row in rows]
        return "\n".join([f"dt = {self.dt:.3g} s: {self.reason}", *lines])


def suggest_step_size(
    system: AnySystem,
    stepper: Stepper,
    q0: PyTree,
    v0: PyTree,
    params: PyTree = None,
    *,
    z0: PyTree = None,
    tolerance: Real = 1e-2,
    highest: Real = None,
    duration: Real = None,
    t0: Real = 0.0,
    progress: bool = False,
) -> StepSize:
    """Suggests a step size that resolves the modes of the system, and lists the numerical error of each mode.

    The modes are those of the system linearised at a state. With `duration` the suggestion comes from runs instead, and
    keeps the error of the motion itself within the tolerance.

    Small motions x about the state obey  M xddot + C xdot + K x = 0,  C = -Q_v,  K = (M w - Q - B^T L)_q,  and with
    constraints B x = 0. In the steps each solution exp(lambda t) becomes powers of an eigenvalue mu of the stepper's
    oscillator. The mode is resolved if |log(mu)/(lambda h) - 1| <= tolerance, which combines the errors of the period
    and of the damping ratio. (For a real lambda the test equation is xddot = lambda xdot.) The suggested step is the
    largest one that resolves

        highest = None    every mode that oscillates or grows; if no mode of a LinearSystem does, the slowest decay;
        highest           every mode of |lambda| <= highest, in rad/s,

    and for which no decaying mode grows in the steps, whether resolved or not. This is fast, but only a guide: it does
    not consider how long the motion lasts, how large each mode is, or how the modes change later. If all modes of a
    nonlinear system decay at the state (for example, at rest with steep friction), it raises an error.

    With `duration`, it makes runs with 8, 16, 32, ... steps, until the RMS error of q over [t0, t0 + duration] stays
    within the tolerance. The error is relative to the RMS of q about its mean. The suggested step is the largest with
    such an error. It is one of all entries of q together: small differences of large entries, such as storey drifts
    above soft isolators, may be far less accurate. This takes about eight times as long as the suggested run, and at
    least 2000 steps. It is misled if all runs have the same error, for example if the method damps a fast vibration out
    of all of them.

    Args:
        system, stepper, q0, v0, params, z0, t0: as in `simulate`; no `FirstOrderSystem`. Modes change along a motion,
            so give its stiffest state. The modes are those of the frozen state. If the state changes fast, they also
            depend on the choice of coordinates.
        tolerance: in (0, 1).
        highest: largest frequency to be resolved, rad/s; None for all modes.
        duration: duration of the runs, s; not together with `highest`.
        progress: with `duration`, shows in one line on stderr which run is being made.

    Returns:
        A `StepSize`, which prints as a table.

    Raises:
        TypeError, ValueError: an argument of a wrong kind or value; a system without a time scale of its own; without
            `duration`, a nonlinear system whose modes all decay; a tolerance that no step reaches; JAX in single
            precision.
        NotImplementedError: constraints or rotations that the stepper does not support.

    Example: masses on a soft and on a stiff spring. The stiff spring determines the step, unless `highest` excludes it.

    >>> import jax.numpy as jnp, hhtjax
    >>> system = hhtjax.LinearSystem(M=jnp.ones(2), C=jnp.array([0.1, 0.0]), K=jnp.array([1.0, 1e4]))
    >>> found = suggest_step_size(system, hhtjax.hht(alpha=-0.05), jnp.zeros(2), jnp.zeros(2), highest=10.0)
    >>> print(found)
    dt = 0.316 s: resolves the mode at 1 rad/s to 0.01
    rad/s     Hz    period  in steps  damping  in steps  largest dt    w h  resolved
        1  0.159    6.28 s  +0.934 %     0.05    0.0492     0.316 s  0.316       yes
      100   15.9  0.0628 s    +949 %        0    0.0329   0.00316 s   31.6        no
    """
    caller = "suggest_step_size"
    require_stepper(caller, stepper)
    if not isinstance(system, (System, LinearSystem)):
        raise TypeError(f"{caller}: `system` must be a System or LinearSystem; received {system!r}.")
    require_number(caller, "tolerance", tolerance, lambda x: 0 < x < 1, "lie in (0, 1)")
    if highest is not None:
        require_number(caller, "highest", highest, lambda x: x > 0, "be positive")
    if duration is not None:
        require_number(caller, "duration", duration, lambda x: np.isfinite(x) and x > 0, "be positive and finite")
        if highest is not None:
            raise ValueError(f"{caller}: `highest` must be left out where there is a `duration`; received {highest}.")
    if jnp.result_type(float) != jnp.float64:
        raise ValueError(f"{caller}: needs double precision: call jax.config.update('jax_enable_x64', True) first.")
    require_dense(caller, system, params)
    require_masses(caller, system, "give them some")
    params = freeze(params)
    q0, v0, z0 = initial_values(caller, system, q0, v0, z0)
    require_capable(caller, system, stepper, q0, v0)
    rates = rates_of(*map(np.asarray, linearized(system, q0, v0, params, t0, z0)))
    reach = []
    for rate in rates:
        error, radius = _errors(stepper, rate / abs(rate))
        reach.append((_reach(error > tolerance), _reach(radius > STABLE_RADIUS) if rate.real <= 0 else np.inf))
    resolved, stable = np.reshape(reach, (-1, 2)).T / abs(rates)
    if duration is None:
        linear = isinstance(system, LinearSystem) and system.nonlinear is None
        dt, reason = _modal_step(rates, resolved, stable, tolerance, highest, linear)
    else:
        given = system, stepper, q0, v0, params, z0, float(t0), float(duration), tolerance
        with stages(caller, progress) as tell:
            dt, most = step_size_by_runs(*given, tell)
        reason = f"keeps q within {tolerance:g} of its motion over {duration:g} s, by runs of up to {most} steps"
        if coarse := sum(dt > largest for largest in resolved):
            reason += f"; {coarse} of {len(resolved)} modes have larger errors than that"

    modes = []
    for rate, largest in zip(rates, resolved, strict=True):
        W, zeta = abs(rate), -rate.real / abs(rate) + 0.0
        fake, late = (
            float(f(stepper, W * dt, zeta)) if rate.imag else np.nan for f in (damping_ratio, period_elongation)
        )
        modes.append(Mode(float(W), float(zeta), float(largest), fake, late, bool(dt <= largest)))
    return StepSize(dt, reason, tuple(modes))


def _modal_step(rates, resolved: np.ndarray, stable: np.ndarray, tolerance: Real, highest: Real, linear: bool):
    """The largest step that resolves the chosen modes and keeps all from growing, and why it is no larger."""
    caller, size = "suggest_step_size", abs(rates)
    if not len(rates):
        raise ValueError(f"{caller}: the `system` has no time scale of its own at q0, v0: take another state.")
    moves = (rates.imag > 0) | (rates.real > 0)
    if highest is None and not linear and not moves.any():
        raise ValueError(
            f"{caller}: no mode of the `system` oscillates or grows at q0, v0, and its decaying modes need not be what "
            "limits the step of the motion: give a `duration`, a `highest`, or another state."
        )
    chosen = size <= highest if highest is not None else moves if moves.any() else size == size[0]
    if not chosen.any():
        raise ValueError(f"{caller}: `highest` must reach the slowest mode, {size[0]:.4g} rad/s; received {highest}.")
    limits = np.concatenate([np.where(chosen, resolved, np.inf), stable])
    which = int(np.argmin(limits))
    dt, mode = float(limits[which]), f"the mode at {size[which % len(size)]:.4g} rad/s"
    if not dt:
        raise ValueError(f"{caller}: no step keeps {mode} within tolerance={tolerance:g}, or stable.")
    return dt, f"resolves {mode} to {tolerance:g}" if which < len(size) else f"with more, {mode} grows"


@jax.jit
def linearized(system: System, q0: PyTree, v0: PyTree, params: PyTree, t0: Array, z0: PyTree):
    """Derivatives of w by displacement and velocity, (N, N), and B, (m, N). Velocities include internal states."""
    flat, q, v = flatten("suggest_step_size", system, q0, v0, t0, params, z0)
    t = jnp.asarray(t0).astype(q.dtype)

    def acceleration(x: Array, v: Array) -> Array:
        at = flat.move(q, x), v, t, params
        return acceleration_and_multipliers(flat, *at)[0] if flat.num_constraints else flat.acceleration(*at)

    B = jacobian(flat, q, t, params) if flat.num_constraints else jnp.zeros((0, v.size), v.dtype)
    return *jax.jacfwd(acceleration, argnums=(0, 1))(jnp.zeros_like(v), v), B


def rates_of(w_x: np.ndarray, w_v: np.ndarray, B: np.ndarray) -> np.ndarray:
    """lambda of the motions with B x = 0, one of each conjugate pair, slowest first, without rigid motions."""
    N = np.linalg.svd(B)[2][len(B) :].T if len(B) else np.eye(len(w_x))
    zero = np.zeros((N.shape[1], N.shape[1]))
    A = np.block([[zero, np.eye(len(zero))], [N.T @ w_x @ N, N.T @ w_v @ N]])
    rates = np.linalg.eigvals(A)
    swings = abs(np.imag(rates)) > 1e-6 * abs(rates)
    rates = np.where(swings, rates, np.real(rates))
    rates = rates[(np.imag(rates) >= 0) & (abs(rates) > RIGID * abs(rates).max(initial=0))]
    return rates[np.argsort(abs(rates))]


def _errors(stepper: Stepper, direction: Real):
    """|log(mu)/(lambda h) - 1| and the spectral radius for lambda of unit modulus on GRID: (grid,) each."""
    lambda_h, followed = direction * GRID, GRID <= NYQUIST
    c, k = (-2 * lambda_h.real, GRID**2) if direction.imag else (-lambda_h.real, 0 * GRID)
    roots = np.asarray(eigenvalues(stepper, c, k))
    nearest = np.argmin(abs(roots - np.exp(np.where(followed, lambda_h, 0))[:, None]), axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        error = abs(np.log(roots[np.arange(len(GRID)), nearest]) / lambda_h - 1)
    return np.where(followed, error, np.inf), abs(roots).max(axis=-1)


def _reach(bad: np.ndarray) -> Real:
    """The last value of GRID before the first bad one; 0 if the first value is bad, inf if none is."""
    first = bad.argmax()
    return np.inf if not bad.any() else GRID[first - 1] if first else 0.0


# ----------------------------------------------------------------------------
# The step size that a motion needs, found by running it with steps that are halved.


SAMPLES = 64  # times at which runs are compared; a power of two, so that the coarsest hit a part of them
FEWEST, ENOUGH, MOST = 8, 1024, 2**20  # steps of the first run, and at least and at most of the last


def step_size_by_runs(
    system: AnySystem,
    stepper: Stepper,
    q0: PyTree,
    v0: PyTree,
    params: PyTree,
    z0: PyTree,
    t0: Real,
    duration: Real,
    tolerance: Real,
    tell: Callable,
):
    """The largest step from which on the error of q stays within the tolerance, and the steps of the finest run.

    The error is the RMS difference of q from the finest run, relative to the RMS of q about its mean. Halving ends when
    two runs in a row are within the tolerance, because a single one could agree by chance. It also goes on to a run of
    at least ENOUGH steps, because coarse runs agree if the method damps the same vibration out of all of them.
    tell: of `stages`.

    Raises:
        ValueError: more than MOST steps would be needed.
    """
    run = partial(_samples, system, stepper, q0, v0, params, z0, t0, duration)
    counts, paths = [], []

    def add(n: int):
        tell(f"run {len(counts) + 1}, {n} steps over {duration:g} s")
        counts.append(n)
        paths.append(np.asarray(run(n)))

    add(FEWEST)
    while counts[-1] < MOST:
        add(2 * counts[-1])
        errors = _errors_of_runs(counts, paths, stepper.order)
        good = np.append(errors <= tolerance, True)
        first = len(good) - int(np.argmin(good[::-1])) if not good.all() else 0
        if len(errors) - first >= 2 and counts[-1] >= ENOUGH:
            break
    else:
        raise ValueError(
            f"suggest_step_size: {MOST} steps do not bring the error of q within tolerance={tolerance:g} over "
            f"{duration:g} s."
        )
    dt = duration / counts[first]
    if first and np.isfinite(errors[first - 1]):  # up to twice as long: on a line in the logarithms
        dt *= 2 ** (np.log(tolerance / errors[first]) / np.log(errors[first - 1] / errors[first]))
    return float(dt), counts[-1]


def _errors_of_runs(counts: list, paths: list, order: int) -> np.ndarray:
    """Errors of all runs but the finest. The error of the finest run is allowed for by Richardson's extrapolation."""
    finest = paths[-1]
    with np.errstate(over="ignore", invalid="ignore"):
        motion = motion_of(finest) if np.isfinite(finest).all() else np.nan
        errors = []
        for n, path in zip(counts[:-1], paths[:-1], strict=True):
            hit = min(n, SAMPLES)
            every = SAMPLES // hit
            error = rms(path[:hit] - finest[every - 1 :: every]) / motion
            errors.append(error / (1 - (n / counts[-1]) ** order))
    return np.nan_to_num(np.array(errors), nan=np.inf)


def rms(x: np.ndarray) -> Real:
    """The root of the mean square."""
    return np.sqrt(np.mean(x**2))


def motion_of(path: np.ndarray) -> Real:
    """The RMS of a path (K, n) about its mean."""
    return rms(path - path.mean(axis=0))


@jax.jit
def _samples(
    system: System,
    stepper: Stepper,
    q0: PyTree,
    v0: PyTree,
    params: PyTree,
    z0: PyTree,
    t0: Array,
    duration: Array,
    num_steps: Array,
) -> Array:
    """q at SAMPLES times, or after every step if there are fewer; compiled once for all numbers of steps."""
    dt = duration / num_steps
    between = jnp.maximum(1, num_steps // SAMPLES)

    def step(i: Array, carry: tuple):
        state, path = carry
        state, _ = stepper.step(system, state, params, dt)
        return state, path.at[i // between].set(ravel_pytree(state.q)[0])  # the last to write is the one on time

    q, _ = ravel_pytree(q0)
    state = begun("suggest_step_size", system, stepper, q0, v0, z0, params, dt, t0)
    return jax.lax.fori_loop(0, num_steps, step, (state, jnp.zeros((SAMPLES, q.size), q.dtype)))[1]
