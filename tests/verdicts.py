"""Whether what a program gave is what was expected, to rounding."""

import numpy as np
from by_numpy import Numbers, is_close, signs


def judge(found, reference, values, rtol, has_sums, ahead=None):
    """In a word, and what is expected. reference: Numbers -> that; values: how many are no derivatives;
    has_sums: the sign of a zero is rounding; ahead: how many are not of reverse mode, None: all."""
    expected = reference(Numbers())
    if len(found) != len(expected):
        return "different number of results", expected
    spread, is_matrix, worst = None, values == 0, "same"
    for i, (a, b) in enumerate(zip(found, expected, strict=True)):
        if i >= values and a.shape == b.shape:
            is_back = ahead is not None and i >= ahead
            known = ~np.isnan(b) & ~(np.isnan(a) & (is_matrix | (is_back & np.isinf(b))))
            a, b = np.where(known, a, 0), np.where(known, b, 0)
        near = is_close(a, b, rtol) or (is_matrix and _is_zero(a, b, rtol))
        if near and (i >= values or has_sums or np.array_equal(signs(a), signs(b))):
            continue
        if a.shape != b.shape or a.dtype != b.dtype:
            return "different", expected
        if spread is None:
            spread = [reference(Numbers(np.random.default_rng(i))) for i in range(6)]
        others = [x[i] for x in spread]
        if near:
            if not any((signs(x) != signs(b)).any() for x in others):
                return "different signs of zero", expected
            worst = "zero by rounding"
        elif not _within(a, b, others, rtol):
            return "different", expected
        else:
            worst = "badly conditioned"
    return worst, expected


def _kinds(x):
    """-inf, inf, NaN, or finite, in whole numbers."""
    return np.select([np.isnan(x), np.isposinf(x), np.isneginf(x)], [1, 2, 3], 0)


def _is_zero(a, b, rtol):
    """Of derivatives along numbers of size one: what cancels leaves rounding."""
    return a.shape == b.shape and bool(np.isfinite(a).all() and np.isfinite(b).all() and (np.abs(a - b) <= rtol).all())


def _within(a, b, others, rtol):
    """Whether a is as near to b as other roundings bring it."""
    if not np.issubdtype(b.dtype, np.inexact):
        return any((x != b).any() for x in others)
    with np.errstate(all="ignore"):
        if any((_kinds(x) != _kinds(b)).any() for x in others):
            return True
        finite = np.isfinite(b)
        reach = 30 * max(np.abs(x - b)[finite].max(initial=0.0) for x in others)
        reach = max(reach, rtol * np.abs(b)[finite].max(initial=0.0))
        return bool((_kinds(a) == _kinds(b)).all() and (np.abs(a - b)[finite] <= reach).all())
