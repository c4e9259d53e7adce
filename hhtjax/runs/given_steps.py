"""Steps of sizes that are given, one by one: the checks of what a user hands over."""

import jax.numpy as jnp
import numpy as np

from hhtjax.checks import require_integer, require_number
from hhtjax.description import all_concrete, is_array, is_concrete, is_real
from hhtjax.runs.adaptive import Adaptive
from hhtjax.systems import held


def require_steps(caller, stepper, dt, num_steps, parts=1):
    """dt, a number or (N,), and the number of steps, each of which may be divided into so many parts."""
    dt = np.asarray(dt) if isinstance(dt, (list, tuple)) else dt
    if not (is_array(dt) and dt.ndim):
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


def require_control_alone(caller, dt, times, num_steps, save_every, extrapolate):
    """An error unless error control comes with times, and with nothing that belongs to steps of given sizes."""
    if not isinstance(dt, Adaptive):
        raise TypeError(f"{caller}: `times` is for dt=adaptive(...): leave it out, or take `sweep`.")
    if times is None:
        raise TypeError(f"{caller}: with dt=adaptive(...), give `times`, (K,), at the last of which the run ends.")
    others = ("num_steps", num_steps, None), ("save_every", save_every, 1), ("extrapolate", extrapolate, 1)
    for name, value, default in others:
        if value != default:
            raise ValueError(f"{caller}: with dt=adaptive(...), leave `{name}` out; received {value!r}.")


def refined(dt, k):
    """k steps in the place of each."""
    return jnp.repeat(dt / k, k) if jnp.ndim(dt) else dt / k


def warn_of_jumps_in(problem, dt, num_steps):
    """A warning where a held input jumps within one of these steps, as far as all is known."""
    if held.holds(problem.params) and all_concrete((dt, problem.t0)):
        dt, t0 = np.asarray(dt, float), np.asarray(problem.t0, float)
        times = t0 + np.append(0.0, np.cumsum(dt) if dt.ndim else num_steps * dt)
        held.warn_of_jumps("simulate", problem.params, times, lambda H: H * 0 + (1 if dt.ndim else num_steps), 4)
