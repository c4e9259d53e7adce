"""Steps of sizes that are given, one by one: the checks of what a user hands over."""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from hhtjax.checks import require_integer, require_number
from hhtjax.description import all_concrete, is_array, is_concrete, is_real
from hhtjax.runs.loop import loop_of
from hhtjax.systems import held


def require_steps(caller, stepper, dt, num_steps, parts=1):
    """dt, a number or (N,), and the number of steps, each of which may be divided into so many parts."""
    dt = np.asarray(dt) if isinstance(dt, (list, tuple)) else dt
    if not (is_array(dt) and dt.ndim):
        if num_steps is None:
            raise ValueError(
                f"{caller}: `num_steps` must be a positive integer; received None. Or give `duration`, or `times`."
            )
        num_steps = require_integer(caller, "num_steps", num_steps)
        if num_steps * parts >= 2**31:
            most = f"be less than {2**31 // parts}, because steps are counted in 32 bits"
            raise ValueError(f"{caller}: `num_steps` must {most}; received {num_steps}.")
        require_number(caller, "dt", dt, lambda x: np.isfinite(x) and x > 0, "be positive and finite")
        return float(dt) if is_concrete(dt) else dt, num_steps  # other number types would be compiled anew
    if not is_real(dt):
        raise TypeError(f"{caller}: `dt` must be real numbers; received {dt!r}.")
    if dt.ndim != 1 or not dt.size:
        raise ValueError(f"{caller}: `dt` must be a number, or of shape (N,), one step or more; received {dt.shape}.")
    if num_steps is not None and require_integer(caller, "num_steps", num_steps) != dt.size:
        raise ValueError(
            f"{caller}: `num_steps` must be the length of dt, {dt.size}, or left out; received {num_steps}."
        )
    if stepper.needs_equal_steps:
        raise NotImplementedError(
            f"{caller}: {type(stepper).__name__} needs steps of one size: give `dt` as a number, or another stepper."
        )
    if is_concrete(dt):
        fine = (np.asarray(dt) > 0) & np.isfinite(dt)
        if not fine.all():
            bad = int(np.argmin(fine))
            raise ValueError(f"{caller}: `dt` must be positive and finite; received dt[{bad}] = {dt[bad]}.")
    return dt, dt.size


def require_control_alone(caller, times, num_steps, save_every, extrapolate):
    """An error unless error control comes with times, and with nothing that belongs to steps of given sizes."""
    if times is None:
        raise TypeError(f"{caller}: with dt=adaptive(...), give `times`, (K,), at the last of which the run ends.")
    others = ("num_steps", num_steps, None), ("save_every", save_every, 1), ("extrapolate", extrapolate, 1)
    for name, value, default in others:
        if value != default:
            raise ValueError(f"{caller}: with dt=adaptive(...), leave `{name}` out; received {value!r}.")


def require_steps_to(caller, times, dt, num_steps, save_every, t0):
    """dt, of the steps that are read off at `times`."""
    for name, value, default in (("num_steps", num_steps, None), ("save_every", save_every, 1)):
        if value != default:
            raise ValueError(f"{caller}: with `times`, leave `{name}` out; received {value!r}.")
    dt = _require_one_size(caller, dt, "times")
    if all_concrete((dt, times, t0)) and (times[-1] - t0) / dt >= 2**31:
        raise ValueError(f"{caller}: `dt` must take fewer than 2^31 steps to times[-1]={times[-1]}; received {dt}.")
    return dt


def _require_one_size(caller, dt, beside):
    """dt, a number."""
    if isinstance(dt, (list, tuple)) or (is_array(dt) and dt.ndim):
        raise NotImplementedError(
            f"{caller}: with `{beside}`, `dt` must be a number or adaptive(...); received {np.shape(dt)}. Leave "
            f"`{beside}` out, and read the run off by `interpolate`."
        )
    require_number(caller, "dt", dt, lambda x: np.isfinite(x) and x > 0, "be positive and finite")
    return float(dt) if is_concrete(dt) else dt


def require_one_length(caller, duration, num_samples, **others):
    """An error where a run gets its length by `duration`, and by something else too."""
    if duration is None:
        raise TypeError(f"{caller}: `num_samples` goes with `duration`; received {num_samples!r} alone.")
    require_number(caller, "duration", duration, lambda x: np.isfinite(x) and x > 0, "be positive and finite")
    for name, value in others.items():
        if value is not None and not (name == "save_every" and value == 1):
            instead = ": give `num_samples`" if name == "save_every" else ""
            raise ValueError(f"{caller}: with `duration`, leave `{name}` out{instead}; received {value!r}.")
    if num_samples is not None:
        require_integer(caller, "num_samples", num_samples)


def steps_within(caller, dtype, dt, duration, num_samples):
    """dt, num_steps and save_every, with steps that are made smaller, if need be, to land on equal samples."""
    dt = _require_one_size(caller, dt, "duration")
    if not all_concrete((dt, duration)):
        raise TypeError(
            f"{caller}: with `duration`, `dt` and `duration` must be known, because the number of steps is part of the "
            "program: give `num_steps`, or take `sweep`, for which they are data."
        )
    H = float(duration) / (num_samples or 1)
    if dt > H * (1 + 1e-6):
        raise ValueError(
            f"{caller}: `dt` must be at most {H:.6g}, the distance of the samples (duration={duration:.6g}, "
            f"num_samples={num_samples or 1}); received {dt:.6g}."
        )
    substeps = max(math.ceil(H / dt * (1 - 64 * float(jnp.finfo(dtype).eps))), 1)
    num_steps = substeps * (num_samples or 1)
    return float(duration) / num_steps, num_steps, 1 if num_samples is None else substeps


class EqualSteps(NamedTuple):
    """Steps of one size from t0 on. counts: (K,), how many there are from one of some times to the next, the last of
    them ending at it or beyond; reached: how far they can be read off."""

    dt: Any
    counts: Any
    reached: Any

    @classmethod
    def to(cls, t0, times, dt):
        """Those to each of the times; none of a traced size that is not positive."""
        fine, eps = (dt > 0) & jnp.isfinite(dt), 8 * float(jnp.finfo(dt.dtype).eps)
        h = jnp.where(fine, dt, 1)
        number = (times - t0) / h
        rounding = eps * (jnp.abs(number) + jnp.maximum(jnp.abs(times), jnp.abs(t0)) / h)
        number = jnp.where(fine, jnp.maximum(jnp.ceil(number - rounding), 1), 0).astype(jnp.int32)
        counts = jnp.maximum(jnp.diff(number, prepend=0), 0)
        return cls(dt, counts, jnp.where(fine, jnp.inf, t0))

    def loop(self, flat, stepper, q, v, t0, params):
        """The `Loop` over them."""
        return loop_of(flat, stepper, q, v, t0, params, self.dt)


def refined(dt, k):
    """k steps in the place of each."""
    return jnp.repeat(dt / k, k) if jnp.ndim(dt) else dt / k


def warn_of_jumps_to(problem, dt, times):
    """The same of equal steps to the last of these times."""
    if held.holds(problem.params) and all_concrete((dt, times, problem.t0)):
        warn_of_jumps_in(problem, dt, int(np.ceil((float(times[-1]) - float(problem.t0)) / float(dt) - 1e-6)), 5)


def warn_of_jumps_in(problem, dt, num_steps, level=4):
    """A warning where a held input jumps within one of these steps, as far as all is known."""
    if held.holds(problem.params) and all_concrete((dt, problem.t0)):
        dt, t0 = np.asarray(dt, float), np.asarray(problem.t0, float)
        times = t0 + np.append(0.0, np.cumsum(dt) if dt.ndim else num_steps * dt)
        held.warn_of_jumps("simulate", problem.params, times, lambda H: H * 0 + (1 if dt.ndim else num_steps), level)
