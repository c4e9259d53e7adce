"""The times at which a sweep is sampled: the checks of what a user hands over, and the steps that land on them."""

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.checks import require_integer, require_number
from hhtjax.description import all_concrete, is_array, is_concrete, is_real
from hhtjax.runs.loop import GROWTH


def require_one_grid(stepper, duration, num_samples, times):
    """An error unless the samples are given in one of the two ways, and in one that the stepper can step on."""
    given = [x is not None for x in (duration, num_samples, times)]
    if given not in ([True, True, False], [False, False, True]):
        raise TypeError(
            "sweep: give `duration` and `num_samples`, or `times` alone; "
            f"received duration={duration!r}, num_samples={num_samples!r}, times={times!r}."
        )
    if times is not None:
        if stepper.needs_equal_steps:
            raise NotImplementedError(
                f"sweep: {type(stepper).__name__} needs steps of one size, which differ between `times`: give "
                "`duration` and `num_samples`, or another stepper."
            )
        return
    require_integer("sweep", "num_samples", num_samples)
    require_number("sweep", "duration", duration, lambda x: np.isfinite(x) and x > 0, "be positive and finite")


def equal_times(t0, duration, num_samples):
    """The times of so many samples at equal distances."""
    return t0 + duration * np.arange(1, num_samples + 1) / num_samples


def require_times(times, t0, dtype, caller="sweep"):
    """times (K,) in the dtype of the state, in which they must increase, checked as far as they are known."""
    times = times if is_array(times) else np.asarray(times)
    if not is_real(times):
        raise TypeError(f"{caller}: `times` must be real numbers; received {times!r}.")
    if times.ndim != 1 or not times.size:
        raise ValueError(f"{caller}: `times` must have shape (K,), one or more; received {times.shape}.")
    if not is_concrete(times):
        return times
    times = np.asarray(times).astype(dtype)
    if not np.all(np.isfinite(times)):
        bad = int(np.argmin(np.isfinite(times)))
        raise ValueError(f"{caller}: `times` must be finite; received times[{bad}] = {times[bad]}.")
    before = np.full(1, t0 if is_concrete(t0) else -np.inf, dtype)
    late = np.diff(times, prepend=before) > 0
    if not late.all():
        bad = int(np.argmin(late))
        last = f"times[{bad - 1}] = {times[bad - 1]}" if bad else f"t0 = {before[0]}"
        at_start = " Leave t0 out: the start is saved in any case." if not bad and times[0] == before[0] else ""
        raise ValueError(
            f"{caller}: `times` must be strictly increasing, and after t0, in {times.dtype}; "
            f"received times[{bad}] = {times[bad]} after {last}.{at_start}"
        )
    return times


def require_step_sizes(dts):
    """dts as an array (B,)."""
    dts = dts if is_array(dts) else np.asarray(dts)
    if not is_real(dts):
        raise TypeError(f"sweep: `dts` must be real numbers; received {dts!r}.")
    if dts.ndim != 1 or not dts.size:
        raise ValueError(f"sweep: `dts` must have shape (B,), one step size for each member; received {dts.shape}.")
    return dts


def require_steps_within(dts, start, end, num_samples=None):
    """An error for step sizes that are not positive, take too many steps, or exceed the distance of equal samples."""
    if not all_concrete((dts, start, end)):
        return
    h, span = np.asarray(dts, float), float(end) - float(start)
    limit, at_most = np.inf, ""
    if num_samples is not None:
        limit = span / num_samples
        at_most = (
            f", and at most {limit:.6g}, the distance of the samples (duration={span:.6g}, num_samples={num_samples})"
        )
    fine = (h > 0) & (h <= limit * (1 + 1e-6))
    if not fine.all():
        bad = int(np.argmin(fine))
        raise ValueError(f"sweep: `dts` must be positive{at_most}; received dts[{bad}] = {h[bad]:.6g}.")
    if span / h.min() >= 2**31:
        raise ValueError(f"sweep: `dts` must take fewer than 2^31 steps; received dts[{h.argmin()}] = {h.min():.6g}.")


def fit_to_samples(dts, H):
    """The numbers of steps between two samples, and the step sizes; NaN where a traced dt is not in (0, H]."""
    slack = 64 * float(jnp.finfo(dts.dtype).eps)
    return _fit(dts, H, (dts > 0) & (dts <= H * (1 + 1e-6)), slack)


def fit_to_times(dts, times):
    """The same for each interval, (B, K); NaN where a traced dt is not positive, or a time not after the last."""
    H, eps = jnp.diff(times), float(jnp.finfo(dts.dtype).eps)
    increasing = (H > 0) & jnp.isfinite(H)
    H = jnp.where(increasing, H, 1)
    size = jnp.where(increasing, jnp.maximum(jnp.abs(times[1:]), jnp.abs(times[:-1])), 0)
    slack = eps * (64 + 4 * size / H)  # H is a difference of rounded times
    return jax.vmap(lambda dt: _fit(dt, H, (dt > 0) & increasing, slack))(dts)


def may_grow(dts, t0, times):
    """Whether steps may be too long behind the one before, as far as all is known: one after a short interval."""
    if not all_concrete((dts, t0, times)):
        return True
    H = np.diff(np.asarray(times, float), prepend=float(t0))
    return bool(np.any(np.minimum(H[1:], np.max(dts)) > GROWTH * H[:-1]))


def _fit(dts, H, fine, slack):
    """The least numbers of steps in H that are no longer than dts, but for the slack, and their sizes."""
    substeps = jnp.maximum(jnp.ceil(H / jnp.where(fine, dts, H) * (1 - slack)), 1).astype(jnp.int32)
    return substeps, jnp.where(fine, H / substeps.astype(dts.dtype), jnp.nan)
