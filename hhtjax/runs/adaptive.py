"""`adaptive`: the tolerances of error control, and their checks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from hhtjax.checks import require_integer, require_number
from hhtjax.description import Description, Real, is_array, is_concrete, is_real

if TYPE_CHECKING:
    from hhtjax.steppers.stepper import Stepper
    from hhtjax.systems.system import AnySystem

WITH_ESTIMATES = (
    "hht, newmark (gamma = 1/2), bossak, generalized_alpha, rosenbrock, rowda, rodas5p, extrapolated, tsit5, dopri5, "
    "dop853 or taylor"
)


@dataclass(frozen=True, eq=False)
class Adaptive(Description):
    """Error control; made by `adaptive`."""

    rtol: Any
    atol: Any
    atol_v: Any
    dt_min: Any
    dt_max: Any
    max_steps: int
    verify: Any


def adaptive(
    rtol: Real,
    atol: Real,
    *,
    atol_v: Real | None = None,
    dt_min: Real = 0.0,
    dt_max: Real = np.inf,
    max_steps: int = 10_000,
    verify: bool | str = False,
) -> Adaptive:
    """Tolerances from which step sizes are chosen, for `simulate(..., dt=adaptive(...), times=...)`.

    The estimated error of each step stays below (atol + rtol max|q_i|) rtol^(1/2) in q_i, and likewise in v_i, where
    the maximum is over the motion so far. The factor rtol^(1/2) allows for the sum of step errors; only the `hht`
    family has it. So the error of the run scales with rtol, but it is not guaranteed to stay below it. An estimate for
    one step cannot see errors that grow later: the phase of an undamped vibration, or chaos. Nor can it see an event
    shorter than the step (give dt_max).

    `verify` measures the error of the whole run, and verify="tighten" reduces it to the tolerance. On a planet's orbit,
    for example, an energy error changes the period, so the position error grows with every revolution. After one
    revolution (e = 0.5) the error is 13 to 40 tolerances with methods of order 2, up to 12 with `rowda`, 4 with
    `dopri5`, and below one with "tighten". Steps end where held inputs, `sampled(order=0)`, jump. With dry friction the
    error is that of the motion on either side of a switch: the jump of the acceleration does not reject a step.

    `events` divide steps as they do with given step sizes. The remainder of a step after an event has its own error
    estimate. Where there is no error, as in free flight, steps grow without bound. A guard that falls below zero
    and rises again within one step may then be missed: give dt_max.

    In `sweep(..., dts=adaptive(...))` each number may be an array (B,), one value for each member.

    Args:
        rtol: relative to the largest |q_i|, and |v_i|, so far; positive. Below 1e-4, float32 resolves only rounding
            errors.
        atol: in the unit of q (radians for rotations; the unit of internal states and of y), positive. It is the only
            tolerance for a coordinate at rest.
        atol_v: in the unit of v; default: atol per unit of time.
        dt_min, dt_max: bounds of the step. A step below dt_min is a failure that `check()` reports. Steps never get
            shorter than 16 roundings of t.
        max_steps: largest number of steps, including rejected ones. It is part of the program; all other arguments are
            data. Each call fills memory for max_steps steps, which takes 10 to 100 microseconds for 100,000. Ask for no
            more than you need.
        verify: True: run again with every step halved, and report `run.error`, the error of the whole run at each of
            `times`, for three times the solves. `check()` then fails where it exceeds 10 (atol + rtol max|q|). This is
            a false alarm if the motion jumps, as in relaxation oscillations, at times that differ by more than a step
            between the runs. For such motions use "tolerance": it runs again with a quarter of the tolerance instead.
            "tighten" continues from there with ever smaller tolerances, `run.steps.tightened` times the given ones. It
            ends when the error of the run, compared with the previous run, is below the tolerance itself at each of
            `times`. `check()` fails if this is never reached.

    Returns:
        An `Adaptive`.

    Raises:
        TypeError, ValueError: an argument of the wrong kind, or out of its range.

    >>> import hhtjax
    >>> hhtjax.adaptive(rtol=1e-4, atol=1e-7).max_steps
    10000
    >>> hhtjax.adaptive(rtol=0.0, atol=1e-7)
    Traceback (most recent call last):
    ValueError: adaptive: `rtol` must be positive and finite; received 0.0.
    """
    atol_v = atol if atol_v is None else atol_v
    for name, value in {"rtol": rtol, "atol": atol, "atol_v": atol_v}.items():
        _require(name, value, lambda x: np.isfinite(x) & (x > 0), "be positive and finite")
    _require("dt_min", dt_min, lambda x: np.isfinite(x) & (x >= 0), "be finite, and 0 or more")
    _require("dt_max", dt_max, lambda x: x > 0, "be positive")
    if len(sizes := lengths((rtol, atol, atol_v, dt_min, dt_max))) > 1:
        raise ValueError(f"adaptive: arrays must have one length, that of the members; received {sizes}.")
    if is_concrete(dt_min) and is_concrete(dt_max) and np.any(np.greater(dt_min, dt_max)):
        raise ValueError(f"adaptive: `dt_min` must not exceed dt_max={dt_max}; received {dt_min}.")
    if not isinstance(verify, bool) and verify not in ("tolerance", "tighten"):
        raise ValueError(f'adaptive: `verify` must be True, False, "tolerance" or "tighten"; received {verify!r}.')
    max_steps = require_integer("adaptive", "max_steps", max_steps)
    rtol, atol, atol_v, dt_min, dt_max = map(_as_data, (rtol, atol, atol_v, dt_min, dt_max))
    return Adaptive(rtol, atol, atol_v, dt_min, dt_max, max_steps, verify)


def _require(name: str, value: Real, valid: Callable, expectation: str):
    """Raises an error unless a number, or each of several (B,), is valid; names the first that is not."""
    value = np.asarray(value) if isinstance(value, (list, tuple)) else value
    if not (is_real(value) and np.ndim(value) == 1 and np.size(value)):
        require_number("adaptive", name, value, valid, expectation)
    elif is_concrete(value) and not (fine := valid(np.asarray(value))).all():
        bad = int(np.argmin(fine))
        raise ValueError(f"adaptive: `{name}` must {expectation}; received {name}[{bad}] = {value[bad]}.")


def _as_data(x: Real) -> np.ndarray:
    return x if is_array(x) else np.asarray(x, float)


def lengths(values: Sequence):
    """The lengths of the arrays among `values`, each once."""
    return sorted({np.size(x) for x in values if np.ndim(x)})


def require_single(caller: str, control: Adaptive):
    """Raises an error if tolerances are arrays, one for each member."""
    if lengths(jax.tree.leaves(control)):
        raise ValueError(f"{caller}: tolerances must be numbers; arrays (B,), one for each member, are for `sweep`.")


def require_controlled(caller: str, stepper: Stepper, system: AnySystem):
    """Raises an error for a stepper without an error estimate, and for a system with contact."""
    if system.contact is not None:
        raise NotImplementedError(
            f"{caller}: error control does not support `contact`, whose accelerations jump within steps: give `dt` as "
            "a number, and halve it to see the error."
        )
    if stepper.estimate_order is None:
        raise NotImplementedError(
            f"{caller}: {stepper.name} has no estimate of its error: give `dt` as a number, or take {WITH_ESTIMATES}."
        )
