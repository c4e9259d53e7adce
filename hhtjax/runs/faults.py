"""What was wrong with the times and the step sizes of a run, in words: what was traced is not known before."""

import numpy as np

ORDER = "`times` must increase, and lie after t0; with it they were {}."
ALIKE = "times are alike in {}, near t = {:g}: count from a t0 near zero, or take float64."


def first_bad(bad):
    """The index of the first bad member of a batch, and words for it; () and none where there is no batch."""
    member = tuple(int(i) for i in np.argwhere(bad)[0])
    words = f"member {', '.join(map(str, member))} ({np.count_nonzero(bad)} of {bad.size} failed), "
    return member, words if member else ""


def bad_samples(t, dt):
    """Of a run under error control, with times (..., K + 1) and the steps that it chose, NaN behind the last."""
    if not np.all(np.diff(t) >= 0):  # behind an event that ends the run they are its end
        return ORDER.format(t)
    return ALIKE.format(t.dtype, t.flat[0]) if np.any(dt == 0) else None


def bad_steps(t, dt, has_events):
    """Of a run with given steps, and of a sweep, whose dt are NaN where they would be longer than between samples."""
    gaps, unknown = np.diff(t), np.isnan(dt)
    is_over_times = t.ndim > 1 and dt.shape == gaps.shape
    if is_over_times and unknown.any() and not np.all((gaps > 0) & np.isfinite(gaps)):
        return ORDER.format(t)
    if np.any(dt <= 0):
        return f"`dt` must be positive and finite; it was {dt[dt <= 0].flat[0]:g}."
    if unknown.any():
        which = first_bad(unknown.reshape(*t.shape[:-1], -1).any(axis=-1))[1]
        return f"{which}`dt` must be positive and finite, and in a sweep at most the distance of the samples."
    if np.any(gaps < 0):
        return ORDER.format(t)
    alike = gaps == 0
    if has_events:  # one may have ended the run, at the last time
        alike &= (t[..., 1:] < t[..., -1:]) | (t[..., :1] == t[..., -1:])
    return ALIKE.format(t.dtype, t.flat[0]) if alike.any() else None
