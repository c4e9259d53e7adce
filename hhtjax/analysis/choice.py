"""Which stepper a motion needs: what the system has, how stiff it is along the motion, and the error that is wanted."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.analysis.step_size import linearized, motion_of, rates_of, rms
from hhtjax.checks import require_integer, require_number, require_params
from hhtjax.description import PyTree, Real, all_concrete
from hhtjax.runs.adaptive import Adaptive, adaptive
from hhtjax.runs.simulate import simulate
from hhtjax.runs.solution import SimulationError, Solution
from hhtjax.steppers.extrapolated import extrapolated
from hhtjax.steppers.generalized_alpha import hht
from hhtjax.steppers.rosenbrock import rodas5p
from hhtjax.steppers.runge_kutta import dop853, tsit5
from hhtjax.steppers.stepper import Stepper, require_capable
from hhtjax.steppers.taylor import taylor
from hhtjax.systems.events import Event
from hhtjax.systems.initial_conditions import initial_values
from hhtjax.systems.linear_system import sparse_matrices
from hhtjax.systems.system import AnySystem, FirstOrderSystem, require_masses, require_system

METHODS = {
    "taylor()": taylor(),
    "dop853()": dop853(),
    "tsit5()": tsit5(),
    "rodas5p()": rodas5p(),
    "extrapolated()": extrapolated(),
    'hht(linearize="predictor")': hht(linearize="predictor"),
    "hht()": hht(),
}
STIFF = 4.0  # |lambda| h beyond which stable steps of an explicit method cost more; a step of dop853 is stable up to 6
FEW = 12  # numbers of a state up to which a series is worth its first call, and its recurrences their work
ROUGH = 1e-3  # tolerance from which on a method of order 5 is enough, of those that are explicit
ROUGHEST = 1e-2  # from which on hht is enough, of those that know constraints
LINEARIZED_AT = 16  # samples
LARGEST_STATE = 400  # rates, whose eigenvalues take a second
FINEST = 1e-13  # rtol
MOST_STEPS = 10_000, 100_000
GROWN = 100.0  # times its size at first, up to which a motion is the scale of atol
PARTS = 64  # of a duration: the longest steps where something may have been passed over
TIMED = 3


class Tried(NamedTuple):
    """A run, and its tolerances."""

    dt: Adaptive
    run: Solution


class Choice(NamedTuple):
    """A stepper and its tolerances, for `simulate(system, choice.stepper, ..., dt=choice.dt, times=)`; as text, why.

    Attributes:
        stepper: a `Stepper`.
        dt: `adaptive(rtol, atol)`.
        error: estimated RMS error of q at the samples, relative to its motion about its mean.
        seconds: of a call of `simulate` with so many samples, once it is compiled.
        num_steps: accepted.
        stiffness: |lambda| h: the largest rate in 1/s along the motion, times the mean step that the error alone asks
            for; None where no explicit method was in question.
        reason: in words.
    """

    stepper: Stepper
    dt: Adaptive
    error: float
    seconds: float
    num_steps: int
    stiffness: float | None
    reason: str

    def __str__(self) -> str:
        name = next(name for name, stepper in METHODS.items() if stepper is self.stepper)
        most = "" if self.dt.max_steps == MOST_STEPS[0] else f", max_steps={self.dt.max_steps}"
        return (
            f"{name}, dt=adaptive(rtol={float(self.dt.rtol):.1e}, atol={float(self.dt.atol):.1e}{most})\n"
            f"error {self.error:.1e} of the motion, {self.num_steps} steps, {1e3 * self.seconds:.3g} ms a call\n"
            f"{self.reason}"
        )


def choose_stepper(
    system: AnySystem,
    q0: PyTree,
    v0: PyTree = None,
    params: PyTree = None,
    *,
    duration: Real,
    z0: PyTree = None,
    tolerance: Real = 1e-3,
    num_samples: int = 64,
    t0: Real = 0.0,
    events: Sequence[Event] | None = None,
) -> Choice:
    """The stepper for a motion, and the tolerances with which it keeps the error that is wanted.

    A run with a method for stiff systems tells how long a step h the error alone asks for. At 16 of its samples the
    system is linearised, as in `suggest_step_size`, and the mean of the largest |lambda| found; beyond 400 velocities
    only at the last. Then

        dry friction                        hht()
        constraints or rotations            extrapolated(); hht(linearize="predictor") from a tolerance of 1e-2 on, and
                                            with events
        |lambda| h > 4, or sparse matrices  rodas5p()
        nothing of these                    tsit5() from a tolerance of 1e-3 on; taylor() for 12 numbers of state or
                                            less; otherwise dop853()

    and where a method does not know what the system has, has no series for its functions, or fails, the next of them.
    These are the fastest of their kinds on the scenes of `python -m experiments work_precision`, which shows what each
    choice costs beside the best one. The tolerance becomes smaller until two runs, at rtol and rtol/10, agree within
    what is wanted; where the second takes no more steps than the first, it is made again with steps of at most 1/64 of
    the duration. It takes as long as compiling two or three programs and some ten runs.

    Where it fails: two runs that agree can both be wrong, as where a fast vibration is damped out of both, or both
    pass over a short push; on chaos no two agree. Methods at constant steps are not tried: on linear systems, whose
    matrix is factorised once then, and for motions of a few dozen steps they can be faster.

    Args:
        system, q0, v0, params, z0, t0, events: as in `simulate`.
        duration: s, positive.
        tolerance: in (1e-13, 1), of the RMS error of q at the samples, relative to the motion of q about its mean.
        num_samples: at equal distances; where errors are compared. extrapolated() ends a step at each.

    Returns:
        A `Choice`, which prints as text.

    Raises:
        TypeError, ValueError: an argument of a wrong kind or value; a q that does not move; a tolerance that no method
            reaches, with what each of them did; JAX in single precision; called inside of jit, vmap or grad.
        NotImplementedError: coordinates without mass; contact.

    >>> import jax.numpy as jnp, hhtjax
    >>> pendulum = hhtjax.System(jnp.ones(1), lambda q, v, t, c: -9.81 * jnp.sin(q) - c * v)
    >>> start = jnp.ones(1), jnp.zeros(1)
    >>> choice = hhtjax.analysis.choose_stepper(pendulum, *start, 0.1, duration=5.0, tolerance=1e-3)
    >>> print(str(choice).splitlines()[0].split(",")[0])
    tsit5()
    >>> run = hhtjax.simulate(pendulum, choice.stepper, *start, 0.1, dt=choice.dt, times=[1.0, 5.0])
    >>> stiff = hhtjax.System(jnp.ones(1), lambda q, v, t, c: -1e6 * (q - jnp.sin(t)) - 1e4 * v)
    >>> choice = hhtjax.analysis.choose_stepper(stiff, *start, 0.1, duration=5.0, tolerance=1e-6)
    >>> print(str(choice).splitlines()[0].split(",")[0])
    rodas5p()
    """
    caller = "choose_stepper"
    if getattr(system, "contact", None) is not None:
        raise NotImplementedError(f"{caller}: with contact take hht(), and halve dt until the motion stays the same.")
    params = _require(caller, system, params, (q0, v0, z0), duration, tolerance, num_samples, t0)
    tolerance, told = float(tolerance), []
    start = initial_values(caller, system, q0, v0, z0)
    q0, v0, z0 = start if not isinstance(system, FirstOrderSystem) else (start[0], None, None)

    def run_at(name: str, dt: Adaptive) -> Tried:
        start = {"z0": z0, "t0": t0, "duration": duration, "num_samples": num_samples, "events": events}
        return Tried(dt, simulate(system, METHODS[name], q0, v0, params, dt=dt, throw=True, **start))

    def run(name: str, rtol: Real, atol: Real, parts: int = 1) -> Tried:
        dt = partial(adaptive, rtol, atol, dt_max=float(duration) / parts if parts > 1 else np.inf)
        try:
            return run_at(name, dt(max_steps=MOST_STEPS[0]))
        except SimulationError:
            return run_at(name, dt(max_steps=MOST_STEPS[1]))

    sparse = bool(sparse_matrices(caller, system, params))
    able = [name for name, stepper in METHODS.items() if _is_able(system, stepper, q0, v0, events, sparse)]
    probes = [name for name in ("rodas5p()", "extrapolated()", "hht()") if name in able]
    probe = _first(probes, lambda name: run(name, tolerance, 1e-2 * tolerance * _size(q0)).run, told)[1]
    motion, size = float(motion_of(_path(probe))), _size_at_first(probe, float(duration) / PARTS)
    if not motion > np.finfo(probe.t.dtype).eps * np.max(np.abs(_path(probe))):
        raise ValueError(f"{caller}: `q0` does not move within {duration:g} s: there is no error relative to a motion.")

    stiffness = None
    if "tsit5()" in able and not sparse:
        stiffness = _largest_rate(system, probe, params) * float(probe.t[-1] - probe.t[0]) / int(probe.steps.accepted)
    names, reason = _in_order(able, system, stiffness, tolerance, _numbers(q0, v0, z0))
    name, (found, error) = _first(names, partial(_within, run, tolerance, motion, min(motion, GROWN * size)), told)
    seconds = min(_seconds(partial(run_at, name, found.dt)) for _ in range(TIMED))
    reason = "\n".join([reason, *(f"not {line}" for line in told)])
    return Choice(METHODS[name], found.dt, error, seconds, int(found.run.steps.accepted), stiffness, reason)


def _require(
    caller: str, system: AnySystem, params: PyTree, start: tuple, duration, tolerance, num_samples, t0: Real
) -> PyTree:
    """params, checked; an error for what cannot be chosen for."""
    require_system(caller, system, massless=True)
    require_masses(caller, system, "no error control knows them; take hht() and steps of one size")
    if not all_concrete((start, params, duration, tolerance, t0)):
        raise TypeError(
            f"{caller}: the arguments must be known numbers; received a tracer: call it outside of jit, vmap and grad."
        )
    require_number(caller, "t0", t0, np.isfinite, "be finite")
    require_number(caller, "duration", duration, lambda x: np.isfinite(x) and x > 0, "be positive and finite")
    require_number(caller, "tolerance", tolerance, lambda x: FINEST < x < 1, f"lie in ({FINEST:g}, 1)")
    require_integer(caller, "num_samples", num_samples)
    if jnp.result_type(float) != jnp.float64:
        raise ValueError(f"{caller}: needs double precision: call jax.config.update('jax_enable_x64', True) first.")
    return require_params(caller, params)


def _in_order(able: Sequence, system: AnySystem, stiffness: float | None, tolerance: float, numbers: int):
    """The names of the methods that are able, best first, and why."""
    rest = ["rodas5p()", "extrapolated()", 'hht(linearize="predictor")']
    if system.friction is not None:
        names, reason = ["hht()"], "dry friction: only the hht family solves it"
    elif "rodas5p()" not in able:
        names, reason = rest, "constraints or rotations: "
        if tolerance >= ROUGHEST:
            names, reason = rest[::-1], reason + "order 2 is enough"
        elif "extrapolated()" in able:
            reason += "the method of order 5 that knows them"
        else:
            reason += "only the hht family knows them and all else that there is"
    elif stiffness is None:
        names, reason = rest, "sparse matrices: taken as stiff"
    else:
        steps = f"|lambda| h = {stiffness:.3g}, h the step that the error alone asks for"
        if stiffness > STIFF:
            names, reason = rest, f"stiff: {steps}; an explicit method needs shorter ones to be stable"
        else:
            small = ["taylor()"] if numbers <= FEW else []
            names = [*(["tsit5()"] if tolerance >= ROUGH else [*small, "dop853()"]), *rest]
            reason = f"not stiff: {steps}; explicit methods are stable with it up to some {STIFF:g}"
    return [name for name in names if name in able], reason


def _first(names: Sequence, attempt: Callable, told: list):
    """The first name whose attempt is neither refused nor fails, and what came of it; told: what of the others."""
    for name in names:
        try:
            return name, attempt(name)
        except (NotImplementedError, SimulationError) as error:
            told.append(f"{name}: {error}")
    raise ValueError("\n  ".join(["choose_stepper: no method keeps to the `tolerance`:", *told]))


def _within(run: Callable, tolerance: float, motion: float, scale: float, name: str):
    """The run with the largest rtol that keeps to the tolerance, and its error by one with a tenth of that.

    atol is 1e-2 rtol of the scale. Where the second run takes no more steps, both may pass over the same: then it is
    made again, with steps no longer than a PARTS-th of the whole.
    """
    rtol, error = tolerance, np.inf
    now = run(name, rtol, 1e-2 * rtol * scale)
    while rtol > FINEST:
        rtol *= 0.1
        then = run(name, rtol, 1e-2 * rtol * scale)
        blind = int(then.run.steps.accepted) <= int(now.run.steps.accepted)
        other = run(name, rtol, 1e-2 * rtol * scale, PARTS) if blind else then
        error = float(rms(_path(now.run) - _path(other.run)) / motion)
        if error <= tolerance:
            return now, error
        now = then
    raise SimulationError(f"errors of {error:.1e} with rtol={rtol:.1e}")


def _largest_rate(system: AnySystem, run: Solution, params: PyTree) -> float:
    """The mean of the largest |lambda| over some samples."""
    t = np.asarray(run.t)
    count = LINEARIZED_AT if sum(np.size(x[0]) for x in jax.tree.leaves(run.v)) <= LARGEST_STATE else 1
    some = np.unique(np.linspace(0, len(t) - 1, count + 1).astype(int)[1:])
    v = None if isinstance(system, FirstOrderSystem) else run.v
    q, v, z, t = jax.tree.map(lambda x: x[some], (run.q, v, run.z, run.t))
    w_x, w_v, B = (np.asarray(x) for x in jax.vmap(partial(_linearized, system, params))(q, v, z, t))
    return float(np.mean([np.abs(rates_of(*x)).max(initial=0) for x in zip(w_x, w_v, B, strict=True)]))


def _linearized(system: AnySystem, params: PyTree, q: PyTree, v: PyTree, z: PyTree, t: Real):
    return linearized(system, q, v, params, t, z)


def _is_able(
    system: AnySystem, stepper: Stepper, q0: PyTree, v0: PyTree, events: Sequence[Event] | None, sparse: bool
) -> bool:
    """Whether the method knows what the system has."""
    if (events and not stepper.meets_events) or (sparse and not stepper.keeps_sparse):
        return False
    try:
        require_capable("choose_stepper", system, stepper, q0, v0)
    except (NotImplementedError, ValueError):
        return False
    return True


def _path(run: Solution) -> np.ndarray:
    """q at the samples, (K, N)."""
    return np.concatenate([np.reshape(x, (len(run.t), -1)) for x in jax.tree.leaves(run.q)], axis=1)


def _size(q0: PyTree) -> float:
    """The largest number of a position, or 1 where all are 0."""
    return max(float(np.max(np.abs(x), initial=0)) for x in jax.tree.leaves(q0)) or 1.0


def _size_at_first(run: Solution, part: float) -> float:
    """How far from 0 a number of q is at the start or the sample behind it, or comes at its first rate in that part of
    the time; infinite where all is 0. Errors made at first, which may grow as the motion does, are small beside it."""
    rates = max(float(np.max(np.abs(x[0]), initial=0)) for x in jax.tree.leaves(run.v))
    return max(float(np.max(np.abs(_path(run)[:-1][:2]))), part * rates) or np.inf


def _numbers(*start: PyTree) -> int:
    """How many numbers a state has."""
    return sum(np.size(x) for x in jax.tree.leaves(start))


def _seconds(run: Callable) -> float:
    """Of a call."""
    begun = time.perf_counter()
    jax.block_until_ready(run())
    return time.perf_counter() - begun
