"""The choice of a stepper, from the parts of the system, its stiffness along the motion, and the wanted error."""

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
FEW = 12  # numbers of a state up to which `taylor` is fast enough, its first call included
ROUGH = 1e-3  # tolerance from which on an explicit method of order 5 is enough
ROUGHEST = 1e-2  # tolerance from which on hht is enough for systems with constraints
LINEARIZED_AT = 16  # samples
LARGEST_STATE = 400  # rates, whose eigenvalues take a second
FINEST = 1e-13  # rtol
MOST_STEPS = 10_000, 100_000
GROWN = 100.0  # the scale of atol is the size of the motion, but at most this many times its initial size
PARTS = 64  # of a duration: the longest steps if a run may have missed something
TIMED = 3


class Tried(NamedTuple):
    """A run, and its tolerances."""

    dt: Adaptive
    run: Solution


class Choice(NamedTuple):
    """Result of `choose_stepper`, for `simulate(system, choice.stepper, ..., dt=choice.dt, times=)`; prints as text.

    Attributes:
        stepper: a `Stepper`.
        dt: `adaptive(rtol, atol)`.
        error: estimated RMS error of q at the samples, relative to the RMS of q about its mean.
        seconds: time of one call of `simulate` with as many samples, without compilation, s.
        num_steps: number of accepted steps.
        stiffness: |lambda| h: the largest rate in 1/s along the motion, times the mean step that accuracy alone would
            allow; None if no explicit method was considered.
        reason: reason for the choice, in words.
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
    """Chooses a stepper for a motion, and tolerances with which it reaches a wanted error.

    First, a run with a method for stiff systems gives the step size h that accuracy alone would allow. Then the system
    is linearised at 16 samples of this run, as in `suggest_step_size`, and the largest |lambda| of each is averaged;
    beyond 400 velocities it is linearised at the last sample only. The choice is

        dry friction                        hht()
        constraints or rotations            extrapolated(); hht(linearize="predictor") from a tolerance of 1e-2 on, and
                                            with events
        |lambda| h > 4, or sparse matrices  rodas5p()
        nothing of these                    tsit5() from a tolerance of 1e-3 on; taylor() for 12 numbers of state or
                                            less; otherwise dop853()

    If a method does not support the system, has no series for its functions, or fails, the next method is tried. These
    methods are the fastest of their kinds on the scenes of `python -m experiments work_precision`, which compares each
    choice with the best method.

    Then rtol is reduced until two runs, at rtol and rtol/10, agree within the tolerance. If the second run takes no
    more steps than the first, it is repeated with steps of at most 1/64 of the duration. In total this takes as long as
    compiling two or three programs, plus some ten runs.

    Limits: two runs that agree can both be wrong. For example, both may damp out a fast vibration, or miss a short
    push. On chaotic motions no two runs agree. Methods with constant steps are not tried. They can be faster on linear
    systems, whose matrix they factorise only once, and for motions of a few dozen steps.

    Args:
        system, q0, v0, params, z0, t0, events: as in `simulate`.
        duration: s, positive.
        tolerance: in (1e-13, 1): RMS error of q at the samples, relative to the RMS of q about its mean.
        num_samples: number of equally spaced samples at which errors are compared. extrapolated() ends a step at each.

    Returns:
        A `Choice`, which prints as text.

    Raises:
        TypeError, ValueError: an argument of a wrong kind or value; a q that does not move; a tolerance that no method
            reaches (the message gives the failure of each); JAX in single precision; a call inside jit, vmap or grad.
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
        raise NotImplementedError(
            f"{caller}: `system` has contact: take hht(), and halve dt until the motion converges."
        )
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
        raise ValueError(f"{caller}: `q0` does not move within {duration:g} s, so the relative error is not defined.")

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
    """params, checked; raises an error for arguments for which no stepper can be chosen."""
    require_system(caller, system, massless=True)
    require_masses(caller, system, "no error control supports them; take hht() and constant steps")
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
    """The names of the methods that support the system, best first, and the reason in words."""
    rest = ["rodas5p()", "extrapolated()", 'hht(linearize="predictor")']
    if system.friction is not None:
        names, reason = ["hht()"], "dry friction: only the hht family solves it"
    elif "rodas5p()" not in able:
        names, reason = rest, "constraints or rotations: "
        if tolerance >= ROUGHEST:
            names, reason = rest[::-1], reason + "order 2 is enough"
        elif "extrapolated()" in able:
            reason += "the method of order 5 that supports them"
        else:
            reason += "only the hht family supports them together with the other parts of this system"
    elif stiffness is None:
        names, reason = rest, "sparse matrices: assumed to be stiff"
    else:
        steps = f"|lambda| h = {stiffness:.3g}, with h the step that accuracy alone would allow"
        if stiffness > STIFF:
            names, reason = rest, f"stiff: {steps}; an explicit method needs shorter steps to be stable"
        else:
            small = ["taylor()"] if numbers <= FEW else []
            names = [*(["tsit5()"] if tolerance >= ROUGH else [*small, "dop853()"]), *rest]
            reason = f"not stiff: {steps}; explicit methods are stable up to about {STIFF:g}"
    return [name for name in names if name in able], reason


def _first(names: Sequence, attempt: Callable, told: list):
    """The first name whose attempt succeeds, and its result. told: a list to which the failures are added."""
    for name in names:
        try:
            return name, attempt(name)
        except (NotImplementedError, SimulationError) as error:
            told.append(f"{name}: {error}")
    raise ValueError("\n  ".join(["choose_stepper: no method reaches the `tolerance`:", *told]))


def _within(run: Callable, tolerance: float, motion: float, scale: float, name: str):
    """The run with the largest rtol that reaches the tolerance, and its error, from a second run with rtol/10.

    atol is 1e-2 rtol times the scale. If the second run takes no more steps, both may have missed the same event. It is
    then repeated with steps of at most a PARTS-th of the duration.
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
    """Whether the method supports the system and its events."""
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
    """The largest absolute value of a position, or 1 if all are 0."""
    return max(float(np.max(np.abs(x), initial=0)) for x in jax.tree.leaves(q0)) or 1.0


def _size_at_first(run: Solution, part: float) -> float:
    """Size of q at the start: the largest |q| at the first two samples, or `part` times the largest initial rate.

    Infinite if all are 0. It limits atol, so that early errors, which may grow like the motion, stay relatively small.
    """
    rates = max(float(np.max(np.abs(x[0]), initial=0)) for x in jax.tree.leaves(run.v))
    return max(float(np.max(np.abs(_path(run)[:-1][:2]))), part * rates) or np.inf


def _numbers(*start: PyTree) -> int:
    """Number of entries of a state."""
    return sum(np.size(x) for x in jax.tree.leaves(start))


def _seconds(run: Callable) -> float:
    """Of a call."""
    begun = time.perf_counter()
    jax.block_until_ready(run())
    return time.perf_counter() - begun
